"""Line of sight equals a reference that follows one line after the other, and what it promises can be seen by hand."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.world.grid import BeliefMap, make_world, pad_world
from potlp_jax.world.sensing import SensorConfig, observe, visible
from tests.reference import sensing as reference

pytestmark = pytest.mark.optimised

see = jax.jit(visible, static_argnums=2)
look = jax.jit(observe, static_argnums=3)


def cell(row: int, column: int) -> jax.Array:
    return jnp.asarray(np.array([row, column], np.int32))


def plan(text: str) -> tuple[np.ndarray, tuple[int, int]]:
    """Rows of a drawing: # obstacle, . free, R the robot."""
    drawing = np.array([list(line) for line in text.split()])
    row, column = np.argwhere(drawing == "R")[0]
    return drawing == "#", (int(row), int(column))


def seen_from(text: str, range_cells: float) -> str:
    """The drawing with ? for what is not seen."""
    occupied, robot = plan(text)
    seen = np.asarray(see(jnp.asarray(occupied), cell(*robot), SensorConfig(range_cells=range_cells)))
    drawing = np.array([list(line) for line in text.split()])
    return "\n".join("".join(line) for line in np.where(seen, drawing, "?"))


def drawn(text: str) -> str:
    return "\n".join(text.split())


SIZES = [
    (1, 1, 2.0),
    (1, 9, 4.0),
    (7, 9, 0.0),
    (9, 13, 1.5),
    (16, 11, 5.0),
    (16, 11, 40.0),
    (24, 24, 7.6),
    (24, 24, 12.0),
]


@st.composite
def maps(draw):
    # Few pairs of shape and range: each is compiled. Both ranges within and beyond the grid, whole and broken.
    height, width, range_cells = draw(st.sampled_from(SIZES))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    occupied = rng.random((height, width)) < draw(st.sampled_from([0.0, 0.05, 0.2, 0.5]))
    robot = (int(rng.integers(height)), int(rng.integers(width)))
    occupied[robot] = draw(st.sampled_from([False, False, False, True]))
    return occupied, robot, range_cells


@settings(max_examples=150, deadline=None)
@given(maps())
def test_equals_the_reference(drawn_map):
    occupied, robot, range_cells = drawn_map
    expected = np.zeros(occupied.shape, bool)
    for at in reference.visible(occupied.tolist(), robot, range_cells):
        expected[at] = True
    found = see(jnp.asarray(occupied), cell(*robot), SensorConfig(range_cells=range_cells))
    np.testing.assert_array_equal(found, expected)


def test_a_pillar_hides_what_is_behind_it():
    room = """
        #########
        #.......#
        #.......#
        #R..#...#
        #.......#
        #.......#
        #########"""
    assert seen_from(room, 20.0) == drawn(room.replace("#...#", "#???#"))


def test_a_grazed_wall_is_seen_whole_and_a_door_is_seen_through():
    rooms = """
        ###########
        #.......#.#
        #.R.......#
        #.......#.#
        ###########"""
    beyond_the_door = """
        #########??
        #.......#?#
        #.R.......#
        #.......#?#
        #########??"""
    assert seen_from(rooms, 20.0) == drawn(beyond_the_door)


def test_sight_does_not_pass_between_obstacles_that_touch_at_corners():
    room = """
        #######
        #R#...#
        ##....#
        #.....#
        #######"""
    only_the_neighbours = """
        ###????
        #R#????
        ##.????
        ???????
        ???????"""
    assert seen_from(room, 20.0) == drawn(only_the_neighbours)


def test_the_range_is_euclidean():
    occupied = np.zeros((21, 21), bool)
    seen = np.asarray(see(jnp.asarray(occupied), cell(10, 10), SensorConfig(range_cells=6.5)))
    rows, columns = np.indices(occupied.shape)
    np.testing.assert_array_equal(seen, np.hypot(rows - 10, columns - 10) <= 6.5)


def test_the_eight_neighbours_are_seen_whatever_the_range():
    occupied = np.zeros((5, 5), bool)
    occupied[1, 2] = occupied[2, 1] = True
    seen = np.asarray(see(jnp.asarray(occupied), cell(2, 2), SensorConfig(range_cells=0.0)))
    assert seen[1:4, 1:4].all()
    assert seen.sum() == 9


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([4.5, 30.0]))
def test_mirrored_maps_look_mirrored(seed, range_cells):
    rng = np.random.default_rng(seed)
    occupied = rng.random((15, 15)) < 0.2
    occupied[4, 6] = False
    config = SensorConfig(range_cells=range_cells)
    seen = np.asarray(see(jnp.asarray(occupied), cell(4, 6), config))
    np.testing.assert_array_equal(see(jnp.asarray(occupied[::-1]), cell(10, 6), config), seen[::-1])
    np.testing.assert_array_equal(see(jnp.asarray(occupied[:, ::-1]), cell(4, 8), config), seen[:, ::-1])
    np.testing.assert_array_equal(see(jnp.asarray(occupied.T), cell(6, 4), config), seen.T)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(20, 17), (13, 30)]), st.sampled_from([4.0, 25.0]))
def test_padding_changes_nothing_that_is_seen(seed, size, range_cells):
    rng = np.random.default_rng(seed)
    occupied = rng.random((12, 17)) < 0.2
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    robot = (int(rng.integers(1, 11)), int(rng.integers(1, 16)))
    occupied[robot] = False
    world = make_world(occupied, rng.integers(0, 4, occupied.shape), robot, propositions=("a", "b"))
    padded = pad_world(world, *size)
    config = SensorConfig(range_cells=range_cells)
    belief = look(BeliefMap.unobserved(world), world, world.start, config)
    padded_belief = look(BeliefMap.unobserved(padded), padded, padded.start, config)
    np.testing.assert_array_equal(padded_belief.cells[:12, :17], belief.cells)
    np.testing.assert_array_equal(padded_belief.letters[:12, :17], belief.letters)
    outside = np.asarray(padded_belief.cells).copy()
    outside[:12, :17] = BeliefMap.UNKNOWN
    assert (outside == BeliefMap.UNKNOWN).all()


def labelled_room() -> tuple[np.ndarray, np.ndarray]:
    occupied = np.ones((9, 20), bool)
    occupied[1:-1, 1:-1] = False
    occupied[2:7, 12] = True
    letters = np.zeros((9, 20), np.int32)
    letters[:, 6] = 1
    letters[4, 15] = 2
    return occupied, letters


def test_labelled_cells_are_transparent():
    occupied, letters = labelled_room()
    world = make_world(occupied, letters, (4, 2), propositions=("a", "b"))
    blank = make_world(occupied, np.zeros_like(letters), (4, 2), propositions=("a", "b"))
    config = SensorConfig(range_cells=30.0)
    belief = look(BeliefMap.unobserved(world), world, world.start, config)
    np.testing.assert_array_equal(belief.cells, look(BeliefMap.unobserved(blank), blank, blank.start, config).cells)
    assert int(belief.letters[4, 6]) == 1
    assert int(belief.cells[4, 9]) == BeliefMap.FREE
    assert int(belief.cells[4, 12]) == BeliefMap.OCCUPIED


def test_what_is_not_seen_has_no_letter_and_what_was_seen_is_kept():
    occupied, letters = labelled_room()
    world = make_world(occupied, letters, (4, 2), propositions=("a", "b"))
    config = SensorConfig(range_cells=30.0)
    first = look(BeliefMap.unobserved(world), world, world.start, config)
    assert int(first.cells[4, 15]) == BeliefMap.UNKNOWN
    assert int(first.letters[4, 15]) == 0
    second = look(first, world, cell(4, 18), config)
    assert int(second.letters[4, 15]) == 2
    assert bool(((second.cells == first.cells) | first.unknown).all())
    assert bool(second.cells[4, 2] == BeliefMap.FREE)
    known = ~np.asarray(second.unknown)
    np.testing.assert_array_equal(np.asarray(second.occupied)[known], occupied[known])
    np.testing.assert_array_equal(np.asarray(second.letters)[known], np.asarray(world.letters)[known])


def test_vmap_equals_a_loop():
    rng = np.random.default_rng(5)
    occupied = rng.random((4, 14, 19)) < 0.15
    cells = np.stack([rng.integers(1, 13, 4), rng.integers(1, 18, 4)], axis=1).astype(np.int32)
    config = SensorConfig(range_cells=8.0)
    together = jax.jit(jax.vmap(functools.partial(visible, config=config)))(jnp.asarray(occupied), jnp.asarray(cells))
    for index in range(4):
        arguments = (jnp.asarray(occupied[index]), jnp.asarray(cells[index]), config)
        np.testing.assert_array_equal(together[index], see(*arguments))


def test_one_trace_for_all_maps_and_cells():
    traced = jax.jit(chex.assert_max_traces(observe, n=1), static_argnums=3)
    occupied, letters = labelled_room()
    for robot in ((1, 1), (4, 4), (7, 18)):
        world = make_world(occupied, letters, robot, propositions=("a", "b"))
        traced(BeliefMap.unobserved(world), world, world.start, SensorConfig(range_cells=12.0))


@pytest.mark.parametrize("range_cells", [-1.0, float("inf"), float("nan")])
def test_bad_ranges_are_refused(range_cells):
    with pytest.raises(ValueError, match="range_cells"):
        SensorConfig(range_cells=range_cells)
