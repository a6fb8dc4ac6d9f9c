"""A robot whose every word is checked, and whose maps are remembered, so that a record can be made without a true map.

The loop believes what a robot says. A class that somebody wrote for a machine of their own may be wrong, and what
follows would be a wrong automaton's state and a wrong record, found late or never. So each observation and each leg is
compared with the contract (``trials.robot``), and an error says what was wrong and what is right.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, UInt8

from potlp_jax.errors import RobotError, WorldError
from potlp_jax.files import short
from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.trials.record import NEVER_SEEN, Correction, belief_seen_by
from potlp_jax.trials.robot import GrowingRobot, Leg, NoticesDoubts, RemembersItsWay, Robot
from potlp_jax.trials.rules import Stop
from potlp_jax.world.grid import BeliefMap, World, check_belief
from potlp_jax.world.moves import Cell

Shown = tuple[int, int]
"""What a map says of a cell: the value of ``BeliefMap.cells`` and the letter."""

_NOTHING: Shown = (BeliefMap.UNKNOWN, 0)


class WatchedRobot:
    """A robot, checked. ``history`` knows what it saw, ``notes`` what was noticed.

    Raises ``RobotError`` from its methods where the robot broke the contract.
    """

    def __init__(
        self, robot: Robot, seconds_per_cell: float | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Watch a robot.

        Args:
            robot: to be watched.
            seconds_per_cell: a leg that takes longer, for each cell of its path, is late, which is noted; None: never.
            clock: seconds.
        """
        if not isinstance(robot, Robot):
            raise RobotError(f"{type(robot).__name__} is no robot: it needs the methods observe, panorama and advance")
        self._robot, self._seconds_per_cell, self._clock = robot, seconds_per_cell, clock
        self.history = MapHistory()
        self._late: list[str] = []
        self._belief: BeliefMap | None = None
        self._last_origin: Cell = (0, 0)
        self._expected: Cell | None = None
        self._picture: tuple[int, ...] | None = None
        # Where the last leg led, in the lattice that never moves.
        self._leg: tuple[Cell, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """What was noticed, here and by the robot itself."""
        return (*self._late, *self._noticed())

    @property
    def last_map(self) -> BeliefMap:
        """The map that the robot reported last."""
        assert self._belief is not None
        return self._belief

    @property
    def last_origin(self) -> Cell:
        """That of the map that the robot reported last."""
        return self._last_origin

    @property
    def origin(self) -> Cell:
        """That of the robot."""
        with its_own("origin of the robot"):
            origin = self._robot.origin if isinstance(self._robot, GrowingRobot) else (0, 0)
        return _as_cell(origin, "the origin of a robot's map")

    def observe(self) -> tuple[BeliefMap, Cell]:
        """The map and the robot's cell."""
        with its_own("observe() of the robot"):
            observed = self._robot.observe()
        if not (isinstance(observed, tuple) and len(observed) == 2 and isinstance(observed[0], BeliefMap)):
            raise RobotError(f"observe() returns a BeliefMap and a cell (row, column), found {type(observed).__name__}")
        belief, cell = observed[0], _as_cell(observed[1], "the cell that observe() returns")
        # A map may be one that nothing can be compared with.
        with its_own("the check of the map that observe() returned"):
            self._check_map(belief)
            self._check_cell(belief, cell)
            self.history.add(belief, self.origin, len(self._leg))
        self._belief, self._last_origin = belief, self.origin
        self._leg = ()
        return belief, cell

    def panorama(self) -> UInt8[Array, "rows columns 3"]:
        """What the robot's camera sees."""
        with its_own("panorama() of the robot"):
            found = self._robot.panorama()
        return self._as_picture(found, "panorama()")

    def panorama_before(self, back: int) -> UInt8[Array, "rows columns 3"] | None:
        """What the robot's camera saw on its way, where it remembers that."""
        with its_own("panorama_before() of the robot"):
            found = self._robot.panorama_before(back) if isinstance(self._robot, RemembersItsWay) else None
        return None if found is None else self._as_picture(found, "panorama_before()")

    def _as_picture(self, found: Any, what: str) -> UInt8[Array, "rows columns 3"]:
        shape = np.shape(found)
        if getattr(found, "dtype", None) != np.uint8 or len(shape) != 3 or shape[2] != 3:
            kind = getattr(found, "dtype", type(found).__name__)
            raise RobotError(f"{what} returns a picture, an array of uint8 [rows, columns, 3], found {kind}{[*shape]}")
        if self._picture is not None and self._picture != shape:
            raise RobotError(f"{what} returned a picture of {self._picture} before, and one of {shape} now")
        self._picture = shape
        return jnp.asarray(found)

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Follow a path."""
        row, column = self.origin
        begun = self._clock()
        with its_own("advance() of the robot"):
            leg = self._robot.advance(path, stop)
        seconds = self._clock() - begun
        leg = _as_leg(leg)
        start = tuple(int(entry) for entry in np.asarray(path.cells)[0])
        self._check_leg(leg, (start[0], start[1]))
        self._leg = tuple((row + there[0], column + there[1]) for there in leg.cells)
        # Without a cell entered the robot is expected where it was.
        at = leg.cells[-1] if leg.cells else (start[0], start[1])
        self._expected = (row + at[0], column + at[1])
        self._note_late(seconds, int(path.length))
        return leg

    def _check_map(self, belief: BeliefMap) -> None:
        _check_values(belief)
        before = self._belief
        if before is None:
            return
        if belief.propositions != before.propositions:
            raise RobotError(
                f"the robot's map had the propositions {before.propositions} and has {belief.propositions} now: they "
                "stay the same throughout a trial"
            )
        if float(belief.resolution) != float(before.resolution):
            raise RobotError(
                f"the robot's map had cells of {float(before.resolution):g} and has cells of "
                f"{float(belief.resolution):g} now: bring its maps onto one grid (potlp_jax.drive.lattice)"
            )
        if belief.cells.shape != before.cells.shape and not isinstance(self._robot, GrowingRobot):
            raise RobotError(
                f"the robot's map had {_size(before)} cells and has {_size(belief)} now: a robot whose map grows tells "
                "where it begins, as the property origin (GrowingRobot)"
            )
        # Earlier decisions and the path are told on the last map: there is no place on it for what it has lost.
        now, then = self.origin, self._last_origin
        ends = zip(now, belief.cells.shape, then, before.cells.shape, strict=True)
        if not all(
            first <= first_then and first + size >= first_then + size_then
            for first, size, first_then, size_then in ends
        ):
            raise RobotError(
                f"the robot's map had {_size(before)} cells from {then} on and has {_size(belief)} from {now} on: "
                "a map may grow, but loses no row or column (potlp_jax.drive.lattice makes such maps)"
            )

    def _check_cell(self, belief: BeliefMap, cell: Cell) -> None:
        height, width = belief.cells.shape
        if not (0 <= cell[0] < height and 0 <= cell[1] < width):
            raise RobotError(f"the robot says that it is in cell {cell}, and its map has {_size(belief)} cells")
        row, column = self.origin
        cells = np.asarray(belief.cells)
        # What it entered must be free in the map that it reports next, or no letter is known there.
        for there in (*self._leg, (row + cell[0], column + cell[1])):
            at = there[0] - row, there[1] - column
            if not (0 <= at[0] < height and 0 <= at[1] < width and cells[at] == BeliefMap.FREE):
                raise RobotError(
                    f"the robot was in cell {at}, which is not free in the map that it reports: a robot knows the "
                    "cells that it has entered"
                )
        if self._expected is not None and self._expected != (row + cell[0], column + cell[1]):
            expected = self._expected[0] - row, self._expected[1] - column
            raise RobotError(
                f"the leg ended in cell {expected}, and the robot says that it is in cell {cell}: a leg's cells reach "
                "to where the robot is, whatever moved it"
            )

    def _check_leg(self, leg: Leg, start: Cell) -> None:
        before = start
        for number, cell in enumerate(leg.cells):
            if max(abs(cell[0] - before[0]), abs(cell[1] - before[1])) != 1:
                raise RobotError(
                    f"cell {number} of the leg, {cell}, is no neighbour of {before}: a leg names every cell that was "
                    "entered, in order, the start left out"
                )
            before = cell

    def _noticed(self) -> tuple[str, ...]:
        # At the end of a drive, whose record shall not be lost for a remark.
        try:
            return tuple(map(str, self._robot.noticed)) if isinstance(self._robot, NoticesDoubts) else ()
        except Exception as error:
            return (f"noticed of the robot raised {type(error).__name__}: {error}",)

    def _note_late(self, seconds: float, length: int) -> None:
        limit = None if self._seconds_per_cell is None else self._seconds_per_cell * max(length, 1)
        if limit is not None and seconds > limit:
            self._late.append(
                f"a leg of {length} cells took {seconds:.1f} s, more than {limit:.1f} s: the robot is late"
            )


@contextmanager
def its_own(what: str) -> Iterator[None]:
    """Whatever somebody else's method raises is the robot's error, so that the record of the drive is kept."""
    try:
        yield
    except RobotError:
        raise
    # Errors of this library, too: a map that could not be made is one of ``WorldError``.
    except Exception as error:
        raise RobotError(f"{what} raised {type(error).__name__}: {error}") from error


def _as_cell(value: object, what: str) -> Cell:
    """Row and column as Python's numbers, whatever pair of whole numbers they are. Raises RobotError."""
    try:
        found = np.asarray(value)
        row, column = found.tolist()
    # It has no order, other entries than numbers, or more or fewer than two.
    except Exception as error:
        raise RobotError(f"{what} is a pair (row, column), found {short(value)}") from error
    if found.dtype.kind not in "iu" or found.ndim != 1:
        raise RobotError(f"{what} is a pair (row, column) of whole numbers, found {short(value)}")
    return row, column


def _as_leg(leg: object) -> Leg:
    """A leg with a tuple of Python's cells: the loop compares them with those of the path. Raises RobotError."""
    if not isinstance(leg, Leg):
        raise RobotError(f"advance() returns a Leg, found {type(leg).__name__}")
    if not isinstance(leg.failure, str):
        raise RobotError(f"the failure of a leg is in words, found {short(leg.failure)}")
    with its_own("the check of the cells of the leg"):
        cells = tuple(_as_cell(cell, "each cell of a leg") for cell in leg.cells)
    return dataclasses.replace(leg, cells=cells)


def _check_values(belief: BeliefMap) -> None:
    """Raise RobotError where a map holds what no map may: the planner would take it for something else."""
    cells, letters, extent = (np.asarray(array) for array in (belief.cells, belief.letters, belief.extent))
    for name, array in (("cells", cells), ("letters", letters), ("extent", extent)):
        if array.dtype.kind not in "iu":
            raise RobotError(f"the {name} of the robot's map are {array.dtype}; give whole numbers")
    if extent.shape != (2,) or not np.all((extent >= 1) & (extent <= cells.shape)):
        raise RobotError(f"the robot's map has {_size(belief)} cells and the extent {extent.tolist()}")
    try:
        check_belief(cells, letters, float(belief.resolution), belief.propositions)
    except WorldError as error:
        raise RobotError(f"the robot's map: {error}") from error


class MapHistory:
    """All maps that a robot reported: what each showed anew, in the lattice that never moves."""

    def __init__(self) -> None:
        self._shown: dict[Cell, Shown] = {}
        # Per observation, the cells that it shows otherwise than the one before.
        self._changes: list[dict[Cell, Shown]] = []
        self._extents: list[tuple[int, int]] = []
        self._steps: list[int] = []
        self._last: tuple[BeliefMap, Cell] | None = None

    def add(self, belief: BeliefMap, origin: Cell, moved: int) -> None:
        """An observation, made after so many cells were entered since the one before."""
        # First what may fail: one that was not taken leaves what was known before.
        (rows, columns), changes = np.asarray(belief.extent).tolist(), self._changes_of(belief, origin)
        self._steps.append(moved + (self._steps[-1] if self._steps else 0))
        self._extents.append((rows, columns))
        self._changes.append(changes)
        self._shown |= self._changes[-1]
        self._last = belief, origin

    def extent_of(self, decision: int) -> tuple[int, int]:
        """Rows and columns of the map at a decision: there is one observation before each."""
        return self._extents[decision]

    def first_seen(self, origin: Cell, shape: tuple[int, int], last: int) -> Int32[np.ndarray, "H W"]:
        """Index into the path at which each cell was first observed.

        Args:
            origin: of the map, in the lattice.
            shape: of the map.
            last: the last index of the path; what was seen later counts as seen then.

        Returns:
            On that map; ``NEVER_SEEN`` where a cell was not observed, or is not known any more.
        """
        first = np.full(shape, NEVER_SEEN, np.int32)
        for step, changes in zip(reversed(self._steps), reversed(self._changes), strict=True):
            for (row, column), (value, _) in changes.items():
                at = row - origin[0], column - origin[1]
                if value != BeliefMap.UNKNOWN and self._shown[(row, column)][0] != BeliefMap.UNKNOWN:
                    first[at] = min(step, last)
        return first

    def corrections(
        self, world: World, first_seen: Int32[np.ndarray, "H W"], origin: Cell, steps: list[int]
    ) -> tuple[Correction, ...]:
        """Where world and ``first_seen`` say otherwise than the maps at the decisions.

        Args:
            world: what is known at the end.
            first_seen: of its cells.
            origin: of the world, in the lattice.
            steps: index into the path of each decision.

        Returns:
            The corrections that make each decision's map what it was.
        """
        shape = world.shape
        cells, letters = np.full(shape, BeliefMap.UNKNOWN, np.int8), np.zeros(shape, np.int32)
        running: dict[Cell, tuple[int, Shown]] = {}
        found: list[Correction] = []
        for decision, step in enumerate(steps):
            for (row, column), (value, letter) in self._changes[decision].items():
                at = row - origin[0], column - origin[1]
                cells[at], letters[at] = value, letter
            said = belief_seen_by(world, first_seen, step)
            differs = (cells != np.asarray(said.cells)) | (letters != np.asarray(said.letters))
            wrong = {(int(r), int(c)): (int(cells[r, c]), int(letters[r, c])) for r, c in np.argwhere(differs)}
            # A run ends where the map agrees again, or shows yet another value.
            for cell in [cell for cell, (_, shown) in running.items() if wrong.get(cell) != shown]:
                first, shown = running.pop(cell)
                found.append(Correction(cell, first, decision, *shown))
            for cell, shown in wrong.items():
                running.setdefault(cell, (decision, shown))
        found += [Correction(cell, first, len(steps), *shown) for cell, (first, shown) in running.items()]
        return tuple(sorted(found, key=lambda entry: (entry.first, entry.cell)))

    def _changes_of(self, belief: BeliefMap, origin: Cell) -> dict[Cell, Shown]:
        cells, letters = np.asarray(belief.cells), np.asarray(belief.letters)
        if self._last is not None and self._last[1] == origin and self._last[0].cells.shape == cells.shape:
            before = self._last[0]
            differs = (cells != np.asarray(before.cells)) | (letters != np.asarray(before.letters))
            changed = {
                (int(row) + origin[0], int(column) + origin[1]): (int(cells[row, column]), int(letters[row, column]))
                for row, column in np.argwhere(differs)
            }
            return changed
        # The array has moved: all cells are compared by their place in the lattice.
        shown = {
            (int(row) + origin[0], int(column) + origin[1]): (int(cells[row, column]), int(letters[row, column]))
            for row, column in np.argwhere(cells != BeliefMap.UNKNOWN)
        }
        gone = {cell: _NOTHING for cell, now in self._shown.items() if now != _NOTHING and cell not in shown}
        return gone | {cell: now for cell, now in shown.items() if self._shown.get(cell, _NOTHING) != now}


def _size(belief: BeliefMap) -> str:
    return " x ".join(map(str, belief.cells.shape))
