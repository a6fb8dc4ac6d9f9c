"""Cheapest ways through squares of a map whose passages may be closed, for many lanes side by side.

A step through a square (``learning.squares``) may be closed, with some chance. The chances are added up along a way:
its **obstacles**, the expected number of closed steps. They weigh as a detour of ``DETOUR`` cells each. Squares are
swept line by line, downwards, upwards and along columns, as in ``planning.distances.sweeping``, until nothing changes.
"""

import functools
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32

from potlp_jax.learning.squares import EAST, NORTH, PASSAGES, SOUTH, WEST
from potlp_jax.native import by_platform, target

DETOUR: float = 600.0
"""A step that is surely closed counts as a detour of so many cells: more than there is to go round in most buildings.
"""

INSIDE: float = 2.0
"""Length in cells of the way from a side of a square to somewhere inside."""

# Lengths in cells of the way through a square, straight and around a corner.
_STRAIGHT, _CORNER = 4.0, 2.8
# Sweeps go on while a way is found that is so much cheaper, in cells: nothing is gained by less.
_GAIN = 2.0


@struct.dataclass(kw_only=True)
class Ways:
    """Cheapest ways to places.

    Attributes:
        cost: length in cells plus ``DETOUR`` times the obstacles; infinite where no way leads.
        obstacles: along the way; 0 where no way leads.
    """

    cost: Float32[Array, "..."]
    obstacles: Float32[Array, "..."]

    @property
    def length(self) -> Float32[Array, "..."]:
        """In cells; 0 where no way leads."""
        return jnp.where(jnp.isfinite(self.cost), self.cost - DETOUR * self.obstacles, 0.0)

    def chance(self, most: float = 1.0) -> Float32[Array, "..."]:
        """1 without obstacles, 0 from ``most`` obstacles on and where no way leads."""
        return jnp.where(jnp.isfinite(self.cost), jnp.maximum(1 - self.obstacles / most, 0.0), 0.0)


@struct.dataclass(kw_only=True)
class SideWays:
    """To the sides of squares; lanes are the last axis."""

    upright: Ways
    """Of shape ``[rows, columns + 1, L]``: to the western sides of squares, and the eastern ones of the last."""
    level: Ways
    """Of shape ``[rows + 1, columns, L]``: to the northern sides of squares, and the southern ones of the last."""

    def of_squares(self) -> tuple[Ways, Ways, Ways, Ways]:
        """To the four sides of each square, in the order of the sides, ``[rows, columns, L]``."""
        west, east = (jax.tree.map(lambda a, cut=cut: a[:, cut], self.upright) for cut in _LESS_ONE)
        north, south = (jax.tree.map(lambda a, cut=cut: a[cut], self.level) for cut in _LESS_ONE)
        return west, east, north, south


# All but the last, and all but the first.
_LESS_ONE = (slice(None, -1), slice(1, None))


def ways_to_sides(cost: Float32[Array, "rows columns L"]) -> SideWays:
    """Ways without obstacles to the sides of squares that cost as much as given for the square; the cheaper one of the
    two that share a side counts."""

    def ways(least: Array) -> Ways:
        return Ways(cost=least, obstacles=jnp.zeros_like(least))

    before, behind = (_padded(cost, 1, first) for first in (False, True))
    above, below = (_padded(cost, 0, first) for first in (False, True))
    return SideWays(upright=ways(jnp.minimum(before, behind)), level=ways(jnp.minimum(above, below)))


def _padded(array: Array, axis: int, first: bool, value: float = jnp.inf) -> Array:
    """One more along an axis, at its beginning or at its end."""
    widths = [(0, 0)] * array.ndim
    widths[axis] = (1, 0) if first else (0, 1)
    return jnp.pad(array, widths, constant_values=value)


def _cheaper(one: Ways, other: Ways) -> Ways:
    less = other.cost < one.cost
    return jax.tree.map(lambda a, b: jnp.where(less, b, a), one, other)


def cheapest_ways(start: SideWays, closed: Sequence[Float32[Array, "rows columns L"]]) -> SideWays:
    """Cheapest ways from where they begin.

    Args:
        start: where ways begin.
        closed: the chance that each of ``PASSAGES`` is closed; infinite where it never is to be taken.

    Returns:
        Ways to all sides, none of which could be cheaper by more than a few cells.
    """
    return by_platform("square_ways", _ways_natively, _ways_by_lines, start, tuple(_steps(closed)))


def _steps(closed: Sequence[Float32[Array, "rows columns L"]]) -> Iterator[Ways]:
    """The way through each of ``PASSAGES``."""
    for number, chance in enumerate(closed):
        yield Ways(cost=(_STRAIGHT if number < 2 else _CORNER) + DETOUR * chance, obstacles=chance)


def _ways_natively(start: SideWays, steps: Sequence[Ways]) -> SideWays:
    """The same sweeps in native code (``native/kernels/square_ways.cc``)."""
    sides, structure = jax.tree.flatten(start)
    results = [jax.ShapeDtypeStruct(side.shape, side.dtype) for side in sides]
    call = jax.ffi.ffi_call(target("cheapest_ways"), results, vmap_method="sequential")
    stacked = (jnp.stack([step.cost for step in steps]), jnp.stack([step.obstacles for step in steps]))
    return jax.tree.unflatten(structure, call(*sides, *stacked, gain=np.float32(_GAIN)))


def _ways_by_lines(start: SideWays, steps: Sequence[Ways]) -> SideWays:
    down = _Lines(steps)
    across = _Lines([jax.tree.map(lambda array: jnp.swapaxes(array, 0, 1), steps[number]) for number in _TRANSPOSED])

    def swept(state: tuple[SideWays, Bool[Array, ""]]) -> tuple[SideWays, Bool[Array, ""]]:
        before, _ = state
        after = _transposed(across.swept(_transposed(down.swept(before))))
        old, new = ((ways.upright.cost, ways.level.cost) for ways in (before, after))
        return after, jnp.any(new[0] < old[0] - _GAIN) | jnp.any(new[1] < old[1] - _GAIN)

    return jax.lax.while_loop(lambda state: state[1], swept, (start, jnp.bool_(True)))[0]


def _transposed(ways: SideWays) -> SideWays:
    turned = jax.tree.map(lambda array: jnp.swapaxes(array, 0, 1), ways)
    return SideWays(upright=turned.level, level=turned.upright)


# What each passage becomes where rows and columns change places.
_TRANSPOSED = tuple(
    PASSAGES.index(pair)
    for pair in ((NORTH, SOUTH), (WEST, EAST), (WEST, NORTH), (WEST, SOUTH), (NORTH, EAST), (SOUTH, EAST))
)


class _Lines:
    """The rows of squares of a map, to be swept in both directions."""

    def __init__(self, steps: Sequence[Ways]) -> None:
        self.steps = tuple(steps)

    def swept(self, ways: SideWays) -> SideWays:
        """Once downwards, once upwards."""
        for near, far in ((NORTH, SOUTH), (SOUTH, NORTH)):
            ways = self._swept_once(ways, near, far)
        return ways

    def _swept_once(self, ways: SideWays, near: int, far: int) -> SideWays:
        """Row by row from the map's ``near`` side to its ``far`` side."""

        def next_row(begin: Ways, row: tuple[Ways, Ways, tuple[Ways, ...]]) -> tuple[Ways, tuple[Ways, Ways]]:
            upright, end, steps = row

            def through(side: Ways, *ends: int) -> Ways:
                return jax.tree.map(jnp.add, side, steps[_passage(*ends)])

            upright = _cheaper(upright, _shifted(through(begin, near, EAST), first=True))
            upright = _cheaper(upright, _shifted(through(begin, near, WEST), first=False))
            west, east = (jax.tree.map(lambda array, cut=cut: array[cut], upright) for cut in _LESS_ONE)
            for arriving in (through(begin, near, far), through(west, WEST, far), through(east, EAST, far)):
                end = _cheaper(end, arriving)
            return end, (upright, end)

        upwards = near == SOUTH
        outermost, ends = (jax.tree.map(lambda array, cut=cut: array[cut], ways.level) for cut in _EDGE[upwards])
        _, (upright, level) = jax.lax.scan(next_row, outermost, (ways.upright, ends, self.steps), reverse=upwards)
        joined = (level, outermost) if upwards else (outermost, level)
        return SideWays(upright=upright, level=jax.tree.map(_stacked, *joined))


def _passage(one: int, other: int) -> int:
    """Which of ``PASSAGES`` joins two sides."""
    return PASSAGES.index((one, other) if (one, other) in PASSAGES else (other, one))


def _stacked(above: Array, below: Array) -> Array:
    """One row and several, or several and one, as one array of rows."""
    most = max(above.ndim, below.ndim)
    return jnp.concatenate([array if array.ndim == most else array[None] for array in (above, below)])


# Of the level sides the outermost row and the others, for sweeps downwards and upwards.
_EDGE = ((0, slice(1, None)), (-1, slice(None, -1)))


def _shifted(ways: Ways, first: bool) -> Ways:
    """Ways to one more side, to which none leads, before or behind the others of a row."""
    return Ways(
        cost=_padded(ways.cost, 0, first),
        obstacles=_padded(ways.obstacles, 0, first, 0.0),
    )


def ways_into_squares(ways: SideWays, closed: Sequence[Float32[Array, "rows columns 1"]] | None = None) -> Ways:
    """Ways into squares, by the side that is cheapest; ``closed``: the obstacles behind each side, none by default."""
    sides = ways.of_squares()
    steps = [jnp.zeros_like(side.cost) for side in sides] if closed is None else closed
    entered = [
        Ways(cost=side.cost + (INSIDE + DETOUR * step), obstacles=side.obstacles + step)
        for side, step in zip(sides, steps, strict=True)
    ]
    return functools.reduce(_cheaper, entered)
