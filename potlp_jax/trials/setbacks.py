"""What a robot does about places that it failed to get to: try again, then leave them aside for a while.

A failed leg says nothing about the map: a person may have stood in the door. So the target is tried again first. Then
it is set aside: what is unobserved beside its frontier counts as an obstacle for some decisions, so that another
frontier is chosen; a known target is closed itself. Every decision records what was set aside, and why.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from potlp_jax.checks import AT_LEAST_ONE, require_fields
from potlp_jax.errors import ConfigurationError
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.moves import SIDES, Cell

_SAME_WITHIN: int = 2
"""Cells, in rows and in columns, within which a target is the one that failed before: a frontier's middle moves."""


@dataclasses.dataclass(frozen=True)
class SetbackConfig:
    """When a target is set aside.

    Attributes:
        attempts: failed legs to a target after which it is set aside.
        decisions: so long it is set aside.
        give_up: failed legs in a row, without a cell entered, after which the trial ends as stuck.
    """

    attempts: int = 2
    decisions: int = 8
    give_up: int = 12

    def __post_init__(self) -> None:
        require_fields(self, ("attempts", "decisions", "give_up"), AT_LEAST_ONE, ConfigurationError)


@dataclasses.dataclass(frozen=True)
class _Closed:
    """Cells that are closed before decision ``until``; ``unobserved`` ones only for as long as they are."""

    cells: tuple[Cell, ...]
    unobserved: bool
    until: int


class Setbacks:
    """The failed legs of a running trial. Cells are those of the map as it is now (``shift``)."""

    def __init__(self, config: SetbackConfig) -> None:
        self._config = config
        self._failed: dict[Cell, int] = {}
        self._closed: list[_Closed] = []
        self._in_a_row = 0

    @property
    def is_stuck(self) -> bool:
        """Whether so many legs failed that nothing more is to be expected."""
        return self._in_a_row >= self._config.give_up

    def closed_at(self, decision: int, belief: BeliefMap) -> tuple[Cell, ...]:
        """Cells that count as obstacles in a decision, in row-major order."""
        self._closed = [entry for entry in self._closed if decision < entry.until]
        if not self._closed:
            return ()
        unknown = np.asarray(belief.unknown)
        cells = {cell for entry in self._closed for cell in entry.cells if unknown[cell] or not entry.unobserved}
        return tuple(sorted(cells))

    def went_well(self) -> None:
        """The robot moved, and nothing failed."""
        self._failed.clear()
        self._in_a_row = 0

    def failed(self, target: Cell, belief: BeliefMap, decision: int, moved: bool) -> bool:
        """Count a failed leg.

        Args:
            target: where it was to end.
            belief: what is known after the leg.
            decision: number of the decision that it carried out.
            moved: whether a cell was entered.

        Returns:
            Whether the target is set aside now.
        """
        self._in_a_row = 0 if moved else self._in_a_row + 1
        # A frontier's middle moves when a cell more is seen: it is the same place nevertheless.
        known = next((cell for cell in self._failed if _is_near(cell, target)), target)
        self._failed[known] = self._failed.get(known, 0) + 1
        if self._failed[known] < self._config.attempts:
            return False
        del self._failed[known]
        cells, unobserved = _to_close(target, belief)
        self._closed.append(_Closed(cells, unobserved, decision + 1 + self._config.decisions))
        return True

    def release(self) -> bool:
        """Open all that is set aside, because nothing remains otherwise. Returns whether there was anything."""
        # The failed legs in a row go on being counted: this ends.
        anything, self._closed = bool(self._closed), []
        return anything

    def shift(self, rows: int, columns: int) -> None:
        """The map has so many rows and columns more above and to the left."""
        self._failed = {(row + rows, column + columns): count for (row, column), count in self._failed.items()}
        self._closed = [
            dataclasses.replace(entry, cells=tuple((row + rows, column + columns) for row, column in entry.cells))
            for entry in self._closed
        ]


def _is_near(one: Cell, other: Cell) -> bool:
    return max(abs(one[0] - other[0]), abs(one[1] - other[1])) <= _SAME_WITHIN


def _to_close(target: Cell, belief: BeliefMap) -> tuple[tuple[Cell, ...], bool]:
    """What to close so that a target is none: unobserved cells beside its frontier (True), or the cell itself."""
    unknown, free = np.asarray(belief.unknown), np.asarray(belief.free)
    frontier = free & _beside(unknown)
    if not frontier[target]:
        return (target,), False
    # As components of frontier cells are elsewhere: joined by corners, too.
    labels = np.zeros(frontier.shape, np.int32)
    ndimage.label(frontier, np.ones((3, 3)), output=labels)
    cells = np.argwhere(_beside(labels == labels[target]) & unknown)
    return tuple((int(row), int(column)) for row, column in cells), True


def _beside(cells: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Cells that touch a marked one with a side."""
    padded = np.pad(cells, 1)
    height, width = cells.shape
    return np.any([padded[1 + r : 1 + r + height, 1 + c : 1 + c + width] for r, c in SIDES], axis=0)
