"""Frontiers equal flood fill and fractions; order, sizes, overflow and edges as docs/model.md section 6 has them."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.types import NO_SUBGOAL, Status
from potlp_jax.world.frontiers import FrontierConfig, Subgoals, connected_parts, find_subgoals, frontier_cells
from potlp_jax.world.grid import BeliefMap, belief_from_numpy, make_world, pad_world
from potlp_jax.world.sensing import SensorConfig, observe
from tests.reference import frontiers as reference

find = jax.jit(find_subgoals, static_argnums=3)


def belief_of(cells: np.ndarray) -> BeliefMap:
    return belief_from_numpy(cells, np.zeros(cells.shape, np.int32))


def drawn(text: str) -> np.ndarray:
    """Rows of a drawing: # obstacle, . free, ? not observed; in the upper left corner of a canvas of obstacles."""
    drawing = np.array([list(line) for line in text.split()])
    cells = np.full((7, 24), BeliefMap.OCCUPIED)
    cells[: drawing.shape[0], : drawing.shape[1]] = np.where(drawing == "#", 1, np.where(drawing == ".", 0, -1))
    return cells


def by_column(shape: tuple[int, int]) -> np.ndarray:
    return np.broadcast_to(np.arange(shape[1], dtype=np.float32), shape).copy()


def subgoals_of(cells: np.ndarray, distance=None, reachable=None, **config) -> Subgoals:
    distance = by_column(cells.shape) if distance is None else distance
    reachable = np.ones(cells.shape, bool) if reachable is None else reachable
    config = {"max_subgoals": 4, "min_size": 2} | config
    return find(belief_of(cells), jnp.asarray(reachable), jnp.asarray(distance), FrontierConfig(**config))


def check_against_reference(found: Subgoals, cells, reachable, distance, config: FrontierConfig) -> None:
    expected, overflow = reference.find_subgoals(
        cells.tolist(), reachable.tolist(), distance.tolist(), config.max_subgoals, config.min_size
    )
    count = len(expected)
    assert np.asarray(found.mask).tolist() == [index < count for index in range(config.max_subgoals)]
    component = np.full(cells.shape, NO_SUBGOAL)
    for index, (cell, members, cost) in enumerate(expected):
        assert tuple(found.cells[index].tolist()) == cell
        assert int(found.size[index]) == len(members)
        assert float(found.distance[index]) == cost
        component[tuple(np.array(sorted(members)).T)] = index
    np.testing.assert_array_equal(found.component, component)
    frontier = np.zeros(cells.shape, bool)
    for cell in reference.frontier_cells(cells.tolist(), reachable.tolist()):
        frontier[cell] = True
    np.testing.assert_array_equal(found.frontier, frontier)
    assert np.asarray(found.size)[count:].tolist() == [0] * (config.max_subgoals - count)
    assert np.isinf(np.asarray(found.distance)[count:]).all()
    assert int(found.status) == (Status.SUBGOAL_OVERFLOW if overflow else Status.OK)


SIZES = [
    ((7, 9), FrontierConfig(max_subgoals=4, min_size=3)),
    ((20, 31), FrontierConfig()),
]


@st.composite
def beliefs(draw):
    # Few pairs of shape and configuration: each is compiled.
    shape, config = draw(st.sampled_from(SIZES))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    unknown = draw(st.sampled_from([0.02, 0.1, 0.4, 0.9]))
    cells = np.where(rng.random(shape) < unknown, -1, (rng.random(shape) < 0.2).astype(int))
    reachable = rng.random(shape) < draw(st.sampled_from([0.5, 0.95, 1.0]))
    # Few values, so that ties are frequent; some cells without a distance.
    distance = rng.integers(0, 5, shape).astype(np.float32)
    distance[rng.random(shape) < 0.1] = np.inf
    return cells, reachable, distance, config


@settings(max_examples=150, deadline=None)
@given(beliefs())
def test_equals_the_reference(belief):
    cells, reachable, distance, config = belief
    found = find(belief_of(cells), jnp.asarray(reachable), jnp.asarray(distance), config)
    check_against_reference(found, cells, reachable, distance, config)


@pytest.mark.parametrize("seed", range(4))
def test_parts_equal_those_of_flood_fill(seed):
    cells = np.random.default_rng(seed).random((17, 25)) < 0.1 + 0.2 * seed
    expected = np.zeros(cells.shape, int)
    for part in reference.components(set(map(tuple, np.argwhere(cells).tolist()))):
        row, column = min(part)
        expected[tuple(np.array(sorted(part)).T)] = row * cells.shape[1] + column + 1
    np.testing.assert_array_equal(jax.jit(connected_parts)(jnp.asarray(cells)), expected)


def test_more_frontier_than_fits_one_block():
    rng = np.random.default_rng(3)
    shape = (60, 61)
    cells = rng.choice([-1, 0, 0, 0, 1, 1], size=shape)
    reachable = np.ones(shape, bool)
    distance = rng.integers(0, 50, shape).astype(np.float32)
    config = FrontierConfig(max_subgoals=20, min_size=2)
    found = subgoals_of(cells, distance, max_subgoals=20)
    assert int(found.frontier.sum()) > 600
    check_against_reference(found, cells, reachable, distance, config)


def spiral(size: int) -> np.ndarray:
    """A free path one cell wide that winds inwards, all else not observed."""
    cells = np.full((size, size), -1)
    row, column, row_step, column_step = 0, 0, 0, 1
    cells[0, 0] = 0
    turns = 0
    while turns < 2:
        ahead = (row + row_step, column + column_step)
        beyond = (row + 2 * row_step, column + 2 * column_step)
        inside = all(0 <= entry < size for entry in ahead)
        clear = not all(0 <= entry < size for entry in beyond) or cells[beyond] == -1
        if inside and clear:
            (row, column), turns = ahead, 0
            cells[row, column] = 0
        else:
            row_step, column_step, turns = column_step, -row_step, turns + 1
    return cells


@pytest.mark.parametrize("turn", range(4))
def test_a_long_winding_component_is_one(turn):
    cells = np.rot90(spiral(41), turn)
    found = subgoals_of(cells)
    assert int(found.mask.sum()) == 1
    assert int(found.size[0]) == int((cells == 0).sum()) > 800
    config = FrontierConfig(max_subgoals=4)
    check_against_reference(found, cells, np.ones(cells.shape, bool), by_column(cells.shape), config)


@pytest.mark.parametrize("turn", range(4))
def test_many_arms_that_meet_late_are_one(turn):
    cells = np.full((41, 41), -1)
    cells[:, ::2] = 0
    cells[-1] = 0
    found = subgoals_of(np.rot90(cells, turn).copy())
    assert int(found.mask.sum()) == 1


def test_the_subgoal_is_the_cell_nearest_the_centroid():
    # Frontier: (3, 1) to (3, 5), (2, 6) and (1, 6), joined at a corner; its centroid is (18/7, 27/7).
    cells = drawn("""
        ##########
        #......?##
        #......?##
        #......###
        #?????####
        ##########""")
    found = subgoals_of(cells)
    assert found.size.tolist()[:2] == [7, 0]
    assert found.cells[0].tolist() == [3, 4]
    assert int(found.component[3, 4]) == int(found.component[1, 6]) == 0


def test_equally_near_cells_give_the_first_in_reading_order():
    cells = drawn("""
        ######
        #..?##
        #..?##
        ######""")
    found = subgoals_of(cells)
    assert found.cells[0].tolist() == [1, 2]


def test_order_is_by_distance_then_reading_order():
    cells = drawn("?..?##?..?##?..? ?..?##?..?##?..?")
    distance = np.zeros(cells.shape, np.float32)
    distance[:, :4], distance[:, 6:10], distance[:, 12:] = 3.0, 3.0, 1.0
    found = subgoals_of(cells, distance)
    assert found.cells[:3].tolist() == [[0, 13], [0, 1], [0, 7]]
    assert found.distance.tolist() == [1.0, 3.0, 3.0, np.inf]
    assert int(found.status) == Status.OK


def test_the_nearest_are_kept_and_the_rest_flagged_but_still_frontier():
    cells = drawn("?..##?..##?..##?..")
    found = subgoals_of(cells, -by_column(cells.shape), max_subgoals=2)
    assert found.mask.tolist() == [True, True]
    assert [cell[1] for cell in found.cells.tolist()] == [16, 11]
    assert int(found.status) == Status.SUBGOAL_OVERFLOW
    np.testing.assert_array_equal(found.frontier, cells == 0)
    assert int((np.asarray(found.component) == NO_SUBGOAL)[cells == 0].sum()) == 4
    assert int(subgoals_of(cells).status) == Status.OK


def test_small_components_are_dropped_while_larger_ones_remain():
    cells = drawn("?.##?..##?.")
    both = subgoals_of(cells)
    assert both.size.tolist()[:2] == [2, 0]
    assert int(both.frontier.sum()) == 4
    assert int(both.status) == Status.OK
    small_only = subgoals_of(cells, min_size=3)
    assert small_only.size.tolist()[:4] == [1, 2, 1, 0]
    assert subgoals_of(cells, min_size=1).size.tolist()[:4] == [1, 2, 1, 0]


def test_components_join_at_corners_but_only_sides_border_the_unknown():
    joined = drawn("""
        ######
        #?.###
        ###.?#
        ######""")
    assert subgoals_of(joined).size.tolist()[:2] == [2, 0]
    corner_only = drawn("""
        ######
        #.####
        ##?###
        ######""")
    assert not np.asarray(subgoals_of(corner_only).frontier).any()


def test_a_free_cell_at_the_edge_of_the_map_is_frontier():
    cells = drawn("""
        #####
        ....#
        #####""")
    found = subgoals_of(cells)
    assert found.cells[0].tolist() == [1, 0]
    assert int(found.frontier.sum()) == 1


def test_a_revealed_world_has_no_frontier():
    rng = np.random.default_rng(1)
    for _ in range(5):
        occupied = rng.random((5, 22)) < 0.3
        occupied[2, 4] = False
        world = make_world(occupied, np.zeros((5, 22), int), (2, 4))
        belief = BeliefMap.revealed(world)
        assert not bool(frontier_cells(belief, belief.free).any())
        found = find(belief, belief.free, jnp.zeros(world.shape), FrontierConfig(max_subgoals=4))
        assert not bool(found.mask.any())
        assert int(found.status) == Status.OK
        assert (np.asarray(found.component) == NO_SUBGOAL).all()


def test_only_cells_that_can_be_reached_count():
    cells = drawn("?..##..?")
    reachable = np.broadcast_to(np.arange(cells.shape[1]) < 2, cells.shape)
    found = subgoals_of(cells, reachable=reachable, min_size=1)
    assert np.argwhere(np.asarray(found.frontier)).tolist() == [[0, 1]]
    assert found.cells[0].tolist() == [0, 1]


def partly_seen(padding: tuple[int, int] = (0, 0)):
    rng = np.random.default_rng(7)
    occupied = rng.random((18, 23)) < 0.12
    occupied[9, 11] = False
    world = make_world(occupied, np.zeros(occupied.shape, int), (9, 11))
    world = pad_world(world, world.shape[0] + padding[0], world.shape[1] + padding[1])
    belief = jax.jit(observe, static_argnums=3)(
        BeliefMap.unobserved(world), world, world.start, SensorConfig(range_cells=7.0)
    )
    rows, columns = jnp.indices(world.shape)
    distance = jnp.abs(rows - world.start[0]) + jnp.abs(columns - world.start[1])
    return belief, belief.free, distance.astype(jnp.float32)


def test_padding_changes_nothing():
    config = FrontierConfig(max_subgoals=5)
    plain, padded = find(*partly_seen(), config), find(*partly_seen((6, 3)), config)
    assert int(plain.mask.sum()) > 2
    height, width = plain.frontier.shape
    for name in ("cells", "mask", "size", "distance", "status"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(padded, name))
    np.testing.assert_array_equal(plain.component, padded.component[:height, :width])
    np.testing.assert_array_equal(plain.frontier, padded.frontier[:height, :width])


def test_vmap_equals_a_loop():
    rng = np.random.default_rng(11)
    cells = rng.choice([-1, 0, 0, 1], size=(3, 12, 17))
    # One element with a long frontier, one without any: rounds and blocks differ between them.
    cells[1] = 0
    cells[1, ::2, 1:] = -1
    cells[2] = 1
    distance = jnp.asarray(rng.integers(0, 9, cells.shape).astype(np.float32))
    reachable = jnp.ones(cells.shape, bool)
    beliefs = [belief_of(entry) for entry in cells]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *beliefs)
    config = FrontierConfig(max_subgoals=4)
    together = jax.jit(jax.vmap(functools.partial(find_subgoals, config=config)))(stack, reachable, distance)
    for index, belief in enumerate(beliefs):
        alone = find(belief, reachable[index], distance[index], config)
        chex.assert_trees_all_equal(jax.tree.leaves(alone), [leaf[index] for leaf in jax.tree.leaves(together)])


def test_one_trace_for_all_maps():
    traced = jax.jit(chex.assert_max_traces(find_subgoals, n=1), static_argnums=3)
    rng = np.random.default_rng(0)
    for unknown in (0.0, 0.3, 1.0):
        cells = np.where(rng.random((9, 9)) < unknown, -1, 0)
        traced(belief_of(cells), jnp.ones((9, 9), bool), jnp.zeros((9, 9)), FrontierConfig())


@pytest.mark.parametrize("config", [{"max_subgoals": 0}, {"min_size": 0}, {"most_subgoals": 0}])
def test_bad_configurations_are_refused(config):
    with pytest.raises(ValueError, match="at least 1"):
        FrontierConfig(**config)
