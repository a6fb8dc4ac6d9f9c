"""Moves on the grid: the forms of the rule about corners agree with each other and with the reference."""

import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.world import moves
from tests.reference.dijkstra import grid_moves

pytestmark = pytest.mark.optimised


@pytest.fixture(scope="module")
def free():
    return np.random.default_rng(0).random((9, 11)) < 0.6


def _cells(mask):
    return [tuple(cell) for cell in np.argwhere(mask).tolist()]


def test_legal_moves_are_those_of_the_reference(free):
    for cell in _cells(free):
        expected = {there: length for there, length in grid_moves(free, cell) if free[there]}
        assert dict(moves.legal_moves(free, cell)) == expected


def test_the_device_cuts_the_same_corners_around_a_cell_and_on_a_whole_grid(free):
    padded = jnp.pad(jnp.asarray(free), 1)
    falling, rising = (np.asarray(cut) for cut in moves.cut_corners(jnp.asarray(free)))
    for row, column in _cells(free):
        around = np.asarray(moves.sides_free(padded, jnp.asarray([row, column], jnp.int32)))
        legal = dict(moves.legal_moves(free, (row, column)))
        for (down, right), sides in zip(moves.NEIGHBOURS, around, strict=True):
            there = (row + down, column + right)
            if not (0 <= there[0] < free.shape[0] and 0 <= there[1] < free.shape[1] and free[there]):
                continue
            assert sides == (there in legal)
            if down and right:
                cut = falling if down == right else rising
                assert cut[max(row, there[0]), max(column, there[1])] == (there not in legal)


@pytest.mark.parametrize("beyond", [False, True])
def test_what_is_beside_and_around_marked_cells(free, beyond):
    marked = ~free
    beside, dilated = np.zeros_like(marked), marked.copy()
    for row, column in np.ndindex(*free.shape):
        for down, right in moves.NEIGHBOURS:
            i, j = row + down, column + right
            inside = 0 <= i < free.shape[0] and 0 <= j < free.shape[1]
            dilated[row, column] |= inside and marked[i, j]
            if 0 in (down, right):
                beside[row, column] |= marked[i, j] if inside else beyond
    np.testing.assert_array_equal(moves.beside(jnp.asarray(marked), beyond), beside)
    np.testing.assert_array_equal(moves.dilate(jnp.asarray(marked)), dilated)
    np.testing.assert_array_equal(moves.dilate(jnp.asarray(marked)[:, :, None])[:, :, 0], dilated)
    for cell in [(0, 0), (4, 5), (8, 10)]:
        assert moves.is_beside(jnp.asarray(marked), jnp.asarray(cell, jnp.int32), beyond) == beside[cell]


def test_lengths_of_paths():
    path = [(0, 0), (0, 1), (1, 2), (2, 2)]
    np.testing.assert_allclose(moves.step_lengths(path), [1.0, np.sqrt(2.0), 1.0])
    assert moves.path_length(path) == 2.0 + np.sqrt(2.0)
    assert moves.count_moves(path) == (2, 1)
    assert moves.path_length([(3, 3)]) == 0.0
    cells = jnp.asarray(path, jnp.int32)
    np.testing.assert_allclose(moves.step_length(cells[:-1], cells[1:]), moves.step_lengths(path), rtol=1e-6)
