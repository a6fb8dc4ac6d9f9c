"""What a building network says of squares of the map: how free they are, what they hold, how one gets through them.

A square has four sides, each with one opening: the longest run of cells by which one crosses it. A **passage** joins
two of them: a robot that enters the square by one opening can leave it by the other without entering another square in
between. So paths on squares that follow passages are paths on cells, also where a wall of one cell divides a square and
its sides; what they miss is a second, smaller opening of a side.
"""

import itertools

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, Int32

from potlp_jax.world.grid import BeliefMap

SQUARE: int = 4
"""Side in cells of the squares."""

WEST, EAST, NORTH, SOUTH = range(4)
SIDES: int = 4

PASSAGES: tuple[tuple[int, int], ...] = (
    (WEST, EAST),
    (NORTH, SOUTH),
    (WEST, NORTH),
    (NORTH, EAST),
    (WEST, SOUTH),
    (SOUTH, EAST),
)
"""The pairs of sides that a passage can join."""


@struct.dataclass(kw_only=True)
class Squares:
    """What is said of each square, or what is true of it; any leading dimensions, then rows and columns of squares.

    Attributes:
        free: share of the cells that are free.
        holds: whether a cell with each proposition lies in it.
        passages: whether each of ``PASSAGES`` is open.
        approach: for each proposition and side, whether a cell with it can be reached from that side's opening without
            leaving the square; says nothing where the proposition does not hold in the square.
    """

    free: Float32[Array, "*B rows columns"]
    holds: Float32[Array, "*B rows columns P"]
    passages: Float32[Array, "*B rows columns 6"]
    approach: Float32[Array, "*B rows columns P 4"]


def numbers_per_square(propositions: int) -> int:
    """How many numbers ``Squares`` has for each square."""
    return 1 + propositions + len(PASSAGES) + propositions * SIDES


def split(numbers: Float32[Array, "*B rows columns N"], propositions: int) -> Squares:
    """``Squares`` of an array with ``numbers_per_square`` numbers for each square."""
    holds = 1 + propositions
    approach = holds + len(PASSAGES)
    return Squares(
        free=numbers[..., 0],
        holds=numbers[..., 1:holds],
        passages=numbers[..., holds:approach],
        approach=numbers[..., approach:].reshape(*numbers.shape[:-1], propositions, SIDES),
    )


def in_squares(array: Array) -> Array:
    """``[H, W, ...]`` to ``[rows, columns, SQUARE, SQUARE, ...]``; what is missing of a square is 0 or False."""
    height, width, *rest = array.shape
    array = jnp.pad(array, ((0, -height % SQUARE), (0, -width % SQUARE), *((0, 0),) * len(rest)))
    rows, columns = array.shape[0] // SQUARE, array.shape[1] // SQUARE
    return jnp.moveaxis(array.reshape(rows, SQUARE, columns, SQUARE, *rest), 2, 1)


def true_squares(
    cells: Int8[Array, "H W"], letters: Int32[Array, "H W"], propositions: int
) -> tuple[Bool[Array, "rows columns"], Squares]:
    """What is true of the squares of a building.

    Args:
        cells, letters: of the building; ``UNKNOWN`` where nobody knows, which counts as occupied in passages.
        propositions: their number.

    Returns:
        Which squares have a cell that is known; and what is true of them, as 0 and 1 but for ``free``.
    """
    known, free = cells != BeliefMap.UNKNOWN, cells == BeliefMap.FREE
    number = in_squares(known).sum(axis=(2, 3))
    share = in_squares(free).sum(axis=(2, 3)) / jnp.maximum(number, 1)
    labelled = jnp.stack([(letters >> bit) & 1 for bit in range(propositions)], axis=-1) > 0
    # [rows, columns, SQUARE, SQUARE, P]
    holding = in_squares(labelled & free[:, :, None])
    openings = _openings(free)
    reached = _reached(in_squares(free), openings)
    passages = [jnp.any(reached[:, :, one] & openings[:, :, other], axis=(-2, -1)) for one, other in PASSAGES]
    approach = jnp.any(reached[..., None] & holding[:, :, None], axis=(3, 4))
    return number > 0, Squares(
        free=share.astype(jnp.float32),
        holds=jnp.any(holding, axis=(2, 3)).astype(jnp.float32),
        passages=jnp.stack(passages, axis=-1).astype(jnp.float32),
        approach=jnp.swapaxes(approach, -1, -2).astype(jnp.float32),
    )


def _openings(free: Bool[Array, "H W"]) -> Bool[Array, "rows columns 4 side side"]:
    """The opening of each side of each square: cells with a free one on the other side, the longest run of them."""
    around = jnp.pad(free, 1)
    height, width = free.shape
    found = []
    # In the order of the sides.
    for axis, step in ((1, -1), (1, 1), (0, -1), (0, 1)):
        rows, columns = (1 + (step if axis == number else 0) for number in (0, 1))
        crossing = in_squares(free & around[rows : rows + height, columns : columns + width])
        edge = 0 if step < 0 else SQUARE - 1
        along = jnp.take(crossing, edge, axis=2 + axis)
        at_edge = jnp.arange(SQUARE) == edge
        at_edge = at_edge[None, :] if axis == 1 else at_edge[:, None]
        opening = _longest_run(along)
        opening = opening[:, :, :, None] if axis == 1 else opening[:, :, None, :]
        found.append(opening & at_edge[None, None])
    return jnp.stack(found, axis=2)


def _longest_run(along: Bool[Array, "rows columns side"]) -> Bool[Array, "rows columns side"]:
    """The longest run of True, of several the first."""
    runs = [
        jnp.zeros(SQUARE, bool).at[first : first + length].set(True)
        for length in range(SQUARE, 0, -1)
        for first in range(SQUARE - length + 1)
    ]
    # Longest first: the first that fits is the longest.
    fits = [jnp.all(along | ~run[None, None], axis=-1, keepdims=True) for run in runs]
    return jnp.select(fits, [run[None, None] & along for run in runs], False)


def _reached(
    free: Bool[Array, "rows columns side side"], openings: Bool[Array, "rows columns 4 side side"]
) -> Bool[Array, "rows columns 4 side side"]:
    """The cells of a square that are reached from each of its sides without leaving it.

    Straight moves reach whatever moves that cut no corner reach.
    """
    reached = openings
    # No path without loops in a square is longer.
    for _ in itertools.repeat(None, SQUARE * SQUARE // 2 + 1):
        around = jnp.pad(reached, ((0, 0),) * 3 + ((1, 1), (1, 1)))
        beside = around[..., :-2, 1:-1] | around[..., 2:, 1:-1] | around[..., 1:-1, :-2] | around[..., 1:-1, 2:]
        reached = free[:, :, None] & (reached | beside)
    return reached
