"""Moves on the grid: which there are, how long they are, and what lies next to what (docs/model.md section 2).

A robot moves to one of the eight neighbours of its cell. A diagonal move needs both cells beside it free: it cuts no
corner. Lengths are in cells; whoever needs metres multiplies by the resolution.

The rule about corners is needed in three forms, which stand together here so that they cannot drift apart: around one
cell on the host (``legal_moves``), around one cell on the device (``sides_free``), and for a whole grid
(``cut_corners``). ``potlp_jax.verify`` has a fourth of its own on purpose: it checks the planner and shares no code.
"""

import math
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, Float64, Int32

Cell = tuple[int, int]
"""Row and column."""

Path = Sequence[Cell] | Int32[np.ndarray, "steps 2"]
"""Cells entered in order, the start first."""

DIAGONAL: float = math.sqrt(2.0)
"""Length of a diagonal move in cells."""

SIDES: tuple[Cell, ...] = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""The four straight moves as (row, column) offsets."""

# Paths break ties in this order and stored paths number their moves by it: another order gives other trials.
NEIGHBOURS: tuple[Cell, ...] = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
"""The eight moves as (row, column) offsets, in row-major order."""

LENGTHS: tuple[float, ...] = tuple(1.0 if 0 in offset else DIAGONAL for offset in NEIGHBOURS)
"""Length of each of the ``NEIGHBOURS``."""


def legal_moves(free: Bool[np.ndarray, "H W"], cell: Cell) -> Iterator[tuple[Cell, float]]:
    """Cells that one move from ``cell`` enters, and the length of the move; in the order of ``NEIGHBOURS``."""
    height, width = free.shape
    row, column = cell
    for (down, right), length in zip(NEIGHBOURS, LENGTHS, strict=True):
        there = row + down, column + right
        if not (0 <= there[0] < height and 0 <= there[1] < width):
            continue
        # For a straight move one of the two sides is the cell entered and the other the cell left.
        if free[there] and free[there[0], column] and free[row, there[1]]:
            yield there, length


def sides_free(padded: Bool[Array, "H2 W2"], cell: Int32[Array, "2"]) -> Bool[Array, "8"]:
    """Whether the cells beside each of the eight moves from ``cell`` are free, so that it cuts no corner.

    Says nothing of the cell that a diagonal move enters.

    Args:
        padded: True where a cell is free, with one ring of False around the grid.
        cell: row and column on the grid without the ring.

    Returns:
        One entry per move, in the order of ``NEIGHBOURS``.
    """
    there = cell[None, :] + jnp.asarray(NEIGHBOURS, jnp.int32) + 1
    # For a straight move one of the two is the neighbour itself and the other the robot's own cell.
    return padded[there[:, 0], cell[1] + 1] & padded[cell[0] + 1, there[:, 1]]


def cut_corners(free: Bool[Array, "H W"]) -> tuple[Bool[Array, "H W"], Bool[Array, "H W"]]:
    """Diagonal moves that would cut a corner, by the 2x2 square in which they lie.

    Returns:
        Two masks at the lower right cell ``[i, j]`` of each square. The first is of the falling diagonal between
        (i-1, j-1) and (i, j), the second of the rising one between (i-1, j) and (i, j-1). Beyond the grid is no space.
    """
    blocked = ~free
    falling = shift(blocked, 1, 0, True) | shift(blocked, 0, 1, True)
    rising = shift(blocked, 1, 1, True) | blocked
    return falling, rising


def shift(array: Array, rows: int, columns: int, fill: float | bool) -> Array:
    """``result[i, j] = array[i - rows, j - columns]``, ``fill`` where that lies outside.

    Args:
        array: [H, W, ...].
        rows, columns: -1, 0 or 1.
        fill: what lies beyond the grid.

    Returns:
        An array of the same shape.
    """
    height, width = array.shape[:2]
    # A pad and a slice instead of a roll: XLA fuses them, and nothing wraps round.
    padded = jnp.pad(array, ((1, 1), (1, 1)) + ((0, 0),) * (array.ndim - 2), constant_values=fill)
    return padded[1 - rows : 1 - rows + height, 1 - columns : 1 - columns + width]


def beside(cells: Bool[Array, "H W"], beyond: bool) -> Bool[Array, "H W"]:
    """Cells that touch a marked one with a side. ``beyond`` says whether what lies outside of the grid is marked."""
    height, width = cells.shape
    padded = jnp.pad(cells, 1, constant_values=beyond)
    return padded[:height, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :width] | padded[1:-1, 2:]


def is_beside(cells: Bool[Array, "H W"], cell: Int32[Array, "2"], beyond: bool) -> Bool[Array, ""]:
    """``beside`` at one cell, without the work for all the others.

    Args:
        cells: the marked cells.
        cell: row and column.
        beyond: whether what lies outside of the grid is marked.

    Returns:
        Whether one of the four cells beside ``cell`` is marked.
    """
    padded = jnp.pad(cells, 1, constant_values=beyond)
    around = cell[None, :] + jnp.asarray(SIDES, jnp.int32) + 1
    return jnp.any(padded[around[:, 0], around[:, 1]])


def dilate(cells: Bool[Array, "H W *rest"]) -> Bool[Array, "H W *rest"]:
    """The marked cells and their eight neighbours."""
    height, width = cells.shape[:2]
    rest = ((0, 0),) * (cells.ndim - 2)
    # A square is a column of rows: two passes of three cells instead of one of nine.
    tall = jnp.pad(cells, ((1, 1), (0, 0), *rest))
    tall = tall[:height] | tall[1 : height + 1] | tall[2:]
    wide = jnp.pad(tall, ((0, 0), (1, 1), *rest))
    return wide[:, :width] | wide[:, 1 : width + 1] | wide[:, 2:]


def step_length(before: Int32[Array, "*batch 2"], after: Int32[Array, "*batch 2"]) -> Float32[Array, "*batch"]:
    """Length of the move between two neighbouring cells, on the device."""
    return jnp.where(jnp.all(before != after, axis=-1), DIAGONAL, 1.0).astype(jnp.float32)


def step_lengths(path: Path) -> Float64[np.ndarray, " steps"]:
    """Length of each move of a path; empty for a path of one cell."""
    cells = np.asarray(path)
    return np.where(np.all(cells[1:] != cells[:-1], axis=1), DIAGONAL, 1.0)


def path_length(path: Path) -> float:
    """Length of all moves of a path."""
    return length_of(*count_moves(path))


def count_moves(path: Path) -> tuple[int, int]:
    """Number of straight and of diagonal moves of a path."""
    lengths = step_lengths(path)
    diagonal = int(np.count_nonzero(lengths == DIAGONAL))
    return len(lengths) - diagonal, diagonal


def length_of(straight: int, diagonal: int) -> float:
    """Length of so many moves. From counts, so that it does not depend on the order of the moves."""
    return straight + diagonal * DIAGONAL


def as_cell(cell: Int32[Array, "2"] | Int32[np.ndarray, "2"]) -> Cell:
    """Row and column of an array as Python numbers."""
    return int(cell[0]), int(cell[1])
