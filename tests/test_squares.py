"""What squares of a building hold and how they are passed through, against a walk on their cells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.learning.squares import (
    EAST,
    NORTH,
    PASSAGES,
    SIDES,
    SOUTH,
    SQUARE,
    WEST,
    numbers_per_square,
    split,
    true_squares,
)
from potlp_jax.world.grid import BeliefMap

PROPOSITIONS = 3
# Where a robot that leaves a cell of a square over each side comes to.
OVER = {WEST: (0, -1), EAST: (0, 1), NORTH: (-1, 0), SOUTH: (1, 0)}


def buildings() -> list[tuple[np.ndarray, np.ndarray]]:
    """Cells and letters: random ones of sizes that are and are not whole squares, and a wall of one cell."""
    random = np.random.default_rng(3)
    found = []
    for shape in ((8, 12), (9, 14), (4, 4), (3, 2)):
        for free in (0.4, 0.7, 0.9):
            cells = np.where(random.random(shape) < free, BeliefMap.FREE, BeliefMap.OCCUPIED).astype(np.int8)
            cells[random.random(shape) < 0.05] = BeliefMap.UNKNOWN
            found.append((cells, random.integers(0, 2**PROPOSITIONS, shape).astype(np.int32)))
    walled = np.full((4, 12), BeliefMap.FREE, np.int8)
    walled[:, 6] = BeliefMap.OCCUPIED
    return [*found, (walled, np.zeros(walled.shape, np.int32))]


def opening(cells: np.ndarray, row: int, column: int, side: int) -> set[tuple[int, int]]:
    """The longest run of cells by which a robot crosses a side of a square, the first of several."""
    along = [
        (row * SQUARE + (number if side in (WEST, EAST) else (SQUARE - 1) * (side == SOUTH)),
         column * SQUARE + (number if side in (NORTH, SOUTH) else (SQUARE - 1) * (side == EAST)))
        for number in range(SQUARE)
    ]  # fmt: skip
    runs: list[list[tuple[int, int]]] = [[]]
    for place in along:
        over = (place[0] + OVER[side][0], place[1] + OVER[side][1])
        if _free(cells, place) and _free(cells, over):
            runs[-1].append(place)
        else:
            runs.append([])
    return set(max(runs, key=len))


def _free(cells: np.ndarray, place: tuple[int, int]) -> bool:
    inside = 0 <= place[0] < cells.shape[0] and 0 <= place[1] < cells.shape[1]
    return bool(inside and cells[place] == BeliefMap.FREE)


def reached_from(cells: np.ndarray, row: int, column: int, side: int) -> set[tuple[int, int]]:
    """The cells of a square that a robot reaches which entered it over a side, by a walk."""

    def within(place: tuple[int, int]) -> bool:
        return (place[0] // SQUARE, place[1] // SQUARE) == (row, column)

    stack = list(opening(cells, row, column, side))
    found = set(stack)
    while stack:
        place = stack.pop()
        for step in OVER.values():
            following = (place[0] + step[0], place[1] + step[1])
            if within(following) and _free(cells, following) and following not in found:
                found.add(following)
                stack.append(following)
    return found


@pytest.mark.parametrize("number", range(len(buildings())))
def test_squares_are_as_a_walk_on_their_cells_finds_them(number: int) -> None:
    cells, letters = buildings()[number]
    known, squares = jax.jit(true_squares, static_argnums=2)(jnp.asarray(cells), jnp.asarray(letters), PROPOSITIONS)
    free_share, holds, passages, approach = (np.asarray(array) for array in jax.tree.leaves(squares))
    known = np.asarray(known)
    for row, column in np.ndindex(*known.shape):
        part = np.s_[row * SQUARE : (row + 1) * SQUARE, column * SQUARE : (column + 1) * SQUARE]
        free, here = cells[part] == BeliefMap.FREE, cells[part] != BeliefMap.UNKNOWN
        assert known[row, column] == here.any()
        assert free_share[row, column] == pytest.approx(free.sum() / max(here.sum(), 1))
        reached = [reached_from(cells, row, column, side) for side in range(SIDES)]
        for bit in range(PROPOSITIONS):
            holding = (letters[part] >> bit & 1 > 0) & free
            assert holds[row, column, bit] == holding.any()
            for side in range(SIDES):
                found = any(letters[place] >> bit & 1 for place in reached[side])
                assert approach[row, column, bit, side] == found
        for passage, (one, other) in enumerate(PASSAGES):
            there, back = (
                bool(reached[begin] & opening(cells, row, column, end)) for begin, end in ((one, other), (other, one))
            )
            assert passages[row, column, passage] == there == back


def test_a_wall_of_one_cell_closes_a_square() -> None:
    cells = np.full((4, 12), BeliefMap.FREE, np.int8)
    open_, _ = true_squares(jnp.asarray(cells), jnp.zeros(cells.shape, jnp.int32), 1)
    cells[:, 6] = BeliefMap.OCCUPIED
    _, closed = true_squares(jnp.asarray(cells), jnp.zeros(cells.shape, jnp.int32), 1)
    across = PASSAGES.index((WEST, EAST))
    assert open_.all()
    assert closed.passages[0, 1, across] == 0
    assert closed.free[0, 1] == 0.75


def test_a_wall_that_divides_a_side_is_not_walked_around() -> None:
    # Two squares above each other in a hallway of eight cells' width, closed by a wall of one cell.
    cells = np.full((8, 12), BeliefMap.FREE, np.int8)
    cells[:, 6] = BeliefMap.OCCUPIED
    _, squares = true_squares(jnp.asarray(cells), jnp.zeros(cells.shape, jnp.int32), 1)
    middle = dict(zip(PASSAGES, np.asarray(squares.passages[0, 1]).tolist(), strict=True))
    assert middle[WEST, SOUTH] == 1
    assert middle[SOUTH, EAST] == 0


def test_numbers_are_split_without_a_rest() -> None:
    numbers = jnp.arange(2 * 3 * numbers_per_square(PROPOSITIONS), dtype=jnp.float32).reshape(2, 3, -1)
    parts = split(numbers, PROPOSITIONS)
    sizes = [np.asarray(part).reshape(2, 3, -1) for part in (parts.free, parts.holds, parts.passages, parts.approach)]
    np.testing.assert_array_equal(np.concatenate(sizes, axis=2), numbers)
