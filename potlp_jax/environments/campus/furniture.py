"""Furniture: obstacles that stand in a room so that one can walk around each of them.

Every piece has a ring of free cells around it that belongs to its room, and none stands before a door. So furniture
never divides a room: whatever way it blocks, the ring goes around it.
"""

import enum
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Int32
from scipy import ndimage

from potlp_jax.environments.campus.blocks import Box
from potlp_jax.environments.campus.furnishing import NO_ROOM

_BEFORE_DOORS = 2
"""Cells from a door within which nothing stands."""


class Furniture(enum.StrEnum):
    """How a room is furnished."""

    DESKS = "desks"
    SHELVES = "shelves"
    TABLES = "tables"
    PILLARS = "pillars"


def put_furniture(
    rooms: Int32[np.ndarray, "H W"], doors: Bool[np.ndarray, "H W"], box: Box, how: Furniture, rng: np.random.Generator
) -> int:
    """Furnish a part of a room.

    Args:
        rooms: number of the room of each cell; pieces become ``NO_ROOM`` in it.
        doors: cells of doors.
        box: where furniture may stand; all of one room, but for its walls.
        how: its kind.
        rng: draws it.

    Returns:
        How many pieces there are.
    """
    number = rooms[(box.top + box.bottom) // 2, (box.left + box.right) // 2]
    # Of the whole array, because doors lie in the walls around the box.
    near_door = ndimage.binary_dilation(doors, np.ones((3, 3)), _BEFORE_DOORS)
    placed = 0
    for piece in _PIECES[how](box, rng):
        ring = slice(max(piece.top - 1, 0), piece.bottom + 1), slice(max(piece.left - 1, 0), piece.right + 1)
        if (rooms[ring] == number).all() and not near_door[piece.cells].any():
            rooms[piece.cells] = NO_ROOM
            placed += 1
    return placed


def _desks(box: Box, rng: np.random.Generator) -> Iterator[Box]:
    """Rows of islands along the longer side, some places empty."""
    length, gap = int(rng.integers(3, 7)), int(rng.integers(2, 4))
    yield from _grid(box, (2, length), gap, 0.75, rng)


def _shelves(box: Box, rng: np.random.Generator) -> Iterator[Box]:
    yield from _grid(box, (1, int(rng.integers(6, 11))), 2, 0.9, rng)


def _pillars(box: Box, rng: np.random.Generator) -> Iterator[Box]:
    yield from _grid(box, (1, 1), int(rng.integers(5, 9)), 1.0, rng)


def _tables(box: Box, rng: np.random.Generator) -> Iterator[Box]:
    """One for each 40 cells, anywhere."""
    for _ in range(box.height * box.width // 40):
        rows, columns = (int(side) for side in rng.integers(1, 4, size=2))
        top = int(rng.integers(box.top, max(box.bottom - rows, box.top) + 1))
        left = int(rng.integers(box.left, max(box.right - columns, box.left) + 1))
        yield Box(top, top + rows, left, left + columns)


def _grid(box: Box, piece: tuple[int, int], gap: int, share: float, rng: np.random.Generator) -> Iterator[Box]:
    """Pieces at equal distances, their longer side along that of the box; a share of the places is taken."""
    rows, columns = piece if box.width >= box.height else piece[::-1]
    for top in range(box.top + 1, box.bottom - rows, rows + gap):
        for left in range(box.left + 1, box.right - columns, columns + gap):
            if rng.random() < share:
                yield Box(top, top + rows, left, left + columns)


_PIECES = {
    Furniture.DESKS: _desks,
    Furniture.SHELVES: _shelves,
    Furniture.TABLES: _tables,
    Furniture.PILLARS: _pillars,
}
