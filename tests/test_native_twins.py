"""Every native kernel gives the same bits as its twin in JAX."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax import Task
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.labels import true_labels
from potlp_jax.learning.painting import blank_painting, paint
from potlp_jax.learning.square_ways import cheapest_ways, ways_to_sides
from potlp_jax.native import is_usable, twin_only
from potlp_jax.planning.distances.paths import shortest_path
from potlp_jax.planning.distances.product import (
    distance_table,
    one_letter_successors,
    product_distances,
    product_transitions,
)
from potlp_jax.planning.distances.sweeping import Wildcard
from potlp_jax.planning.situation import assess
from potlp_jax.task.task import TaskSizes
from potlp_jax.trials.config import trial_config_for
from potlp_jax.types import NO_STATE
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.frontiers import FrontierConfig, connected_parts, find_subgoals
from potlp_jax.world.grid import BeliefMap, belief_from_numpy
from potlp_jax.world.renderer import obstacle_distances
from potlp_jax.world.sensing import SensorConfig, observe, visible

SHAPE = (19, 26)
SOURCES = 11
SIZES = TaskSizes(states=8, propositions=2, edges=24, classes=24, compound=4, cubes=4)
FORMULAS = ("F a & F b", "!b U (a & F b)", "F(a & F(b & F a))", "(!a U b) & F(a & X X a)", "F a")


def _needs(library):
    if not is_usable(library):
        pytest.skip(f"no native {library} here")


def _both(function, *arguments):
    """What a function gives natively and by its twin; each compiled by itself."""
    native = jax.jit(function)(*arguments)
    with twin_only():
        twin = jax.jit(function)(*arguments)
    return native, twin


def _same(function, *arguments):
    native, twin = _both(function, *arguments)
    for mine, its in zip(jax.tree.leaves(native), jax.tree.leaves(twin), strict=True):
        np.testing.assert_array_equal(np.asarray(mine), np.asarray(its))
    return native


def _problem(seed, labelled):
    """A map with letters of two propositions, a task and sources, the first of them free and in the initial state."""
    rng = np.random.default_rng(seed)
    free = rng.random(SHAPE) > (0.1, 0.3, 0.42)[seed % 3]
    letters = np.where(free & (rng.random(SHAPE) < labelled), rng.integers(0, 4, SHAPE), 0)
    task = Task.from_formula(FORMULAS[seed % len(FORMULAS)], propositions=("a", "b")).padded(SIZES)
    transitions = product_transitions(task, jnp.asarray(letters, jnp.int32), jnp.asarray(free))
    transitions = jnp.where(task.accepting, NO_STATE, transitions)
    cells = rng.integers(0, SHAPE, (SOURCES, 2))
    cells[0] = rng.choice(np.argwhere(free))
    states = rng.integers(-1, SIZES.states, SOURCES)
    states[0] = int(task.initial)
    arrays = (jnp.asarray(free), transitions, jnp.asarray(cells, jnp.int32), jnp.asarray(states, jnp.int32))
    return rng, task, *arrays


@pytest.mark.parametrize("labelled", [0.02, 0.4])
@pytest.mark.parametrize("seed", range(5))
def test_distances_equal_the_sweeps(seed, labelled):
    _needs("distances")
    _, _, free, transitions, cells, states = _problem(seed, labelled)
    for resolution in (1.0, 0.05):
        _same(product_distances, transitions, free, cells, states, jnp.float32(resolution))


@pytest.mark.parametrize("seed", range(3))
def test_optimistic_distances_equal_the_sweeps(seed):
    _needs("distances")
    rng, task, free, transitions, cells, states = _problem(seed, 0.1)
    unknown = jnp.asarray(rng.random(free.shape) < 0.4)
    transitions = jnp.where(unknown[:, :, None], NO_STATE, transitions)
    wildcard = Wildcard(cells=unknown, successors=one_letter_successors(task))
    _same(product_distances, transitions, free | unknown, cells, states, jnp.float32(1), wildcard)


@pytest.mark.parametrize("labelled", [0.0, 0.02, 0.4])
@pytest.mark.parametrize("seed", range(5))
def test_tables_equal_those_of_portals_and_sweeps(seed, labelled):
    _needs("distances")
    rng, task, free, transitions, cells, states = _problem(seed, labelled)
    targets = jnp.asarray(rng.integers(0, free.shape, (6, 2)), jnp.int32)
    # Some sources are their own targets, and some share a cell.
    cells = cells.at[0].set(targets[0]).at[-1].set(cells[0])
    _same(distance_table, transitions, free, task.accepting, cells, states, targets, jnp.float32(0.3))


def test_the_only_way_leads_through_a_letter():
    """A hallway one cell wide: beyond the letter no state is as it was before."""
    _needs("distances")
    task = Task.from_formula("F a & F b", propositions=("a", "b")).padded(SIZES)
    letters = jnp.zeros((3, 9), jnp.int32).at[1, 4].set(1)
    free = jnp.zeros((3, 9), bool).at[1].set(True)
    transitions = jnp.where(task.accepting, NO_STATE, product_transitions(task, letters, free))
    ends = jnp.asarray([[1, 0], [1, 8]], jnp.int32)
    states = jnp.full(2, int(task.initial), jnp.int32)
    travel, _ = _same(distance_table, transitions, free, task.accepting, ends, states, ends, jnp.float32(1))
    np.testing.assert_array_equal(travel[0, 1, int(task.initial)], np.inf)
    assert np.any(np.asarray(travel[0, 1]) == 8)


def test_where_nothing_is_free_or_nothing_is_asked():
    _needs("distances")
    free = jnp.zeros((4, 5), bool)
    transitions = jnp.full((4, 5, 3), NO_STATE, jnp.int32)
    cells, states = jnp.asarray([[1, 1], [3, 4]], jnp.int32), jnp.asarray([0, NO_STATE], jnp.int32)
    _same(product_distances, transitions, free, cells, states, jnp.float32(1))
    accepting = jnp.asarray([True, False, False])
    _same(distance_table, transitions, free, accepting, cells, states, cells, jnp.float32(1))
    _same(distance_table, transitions, free, accepting, cells, jnp.full(2, NO_STATE), cells, jnp.float32(1))


def test_sources_off_the_map_reach_nothing():
    _needs("distances")
    transitions, free = jnp.zeros((4, 5, 1), jnp.int32), jnp.ones((4, 5), bool)
    cells = jnp.asarray([[-1, 0], [4, 0], [0, 5], [2**30, -(2**30)]], jnp.int32)
    found = jax.jit(product_distances)(transitions, free, cells, jnp.zeros(4, jnp.int32), jnp.float32(1))
    assert np.isinf(np.asarray(found)).all()


@pytest.mark.long
@pytest.mark.parametrize("range_cells", [0.0, 1.0, 3.5, 9.0, 104.0])
def test_sight_equals_the_tables(range_cells):
    _needs("sensing")
    rng = np.random.default_rng(int(range_cells))
    for shape in ((1, 1), (7, 5), (23, 40)):
        see = functools.partial(visible, config=SensorConfig(range_cells=range_cells))
        cells = jnp.asarray(rng.integers(0, shape, (12, 2)), jnp.int32)
        maps = jnp.asarray(rng.random((12, *shape)) < rng.choice([0.05, 0.2, 0.5]))
        _same(jax.vmap(see), maps, cells)


@pytest.mark.long
@pytest.mark.parametrize("glances", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.3])
def test_looks_and_paintings_equal_those_of_their_tables(share, glances):
    _needs("camera")
    camera = CameraConfig(height=16, width=64, horizon=6.0, fold=3.0)
    rng = np.random.default_rng(round(100 * share))
    for shape in ((1, 1), (9, 31), (24, 17)):
        cells = jnp.asarray(rng.integers(0, shape, (8, 2)), jnp.int32)
        maps = rng.choice([-1, 0, 1], (8, *shape), p=[(1 - share) / 2, (1 - share) / 2, share])
        each = [belief_from_numpy(cells, np.zeros(shape, np.int32)) for cells in maps]
        beliefs = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
        # Of a building smaller than its array: beyond the extent nothing is painted.
        extent = jnp.asarray(rng.integers(1, np.add(shape, 1), (8, 2)), jnp.int32)
        beliefs = dataclasses.replace(beliefs, extent=extent)
        far = _same(jax.vmap(functools.partial(obstacle_distances, config=camera)), beliefs.occupied, cells)
        assert far.shape == (8, 64)
        # Two looks from different places, so that nearer ones meet what was seen from afar.
        paintings = jax.tree.map(lambda layer: jnp.repeat(layer[None], 8, axis=0), blank_painting(*shape))
        for at in (cells, cells[::-1]):
            pictures = jnp.asarray(rng.integers(0, 256, (8, 16, 64, 3)), jnp.uint8)
            look = jax.vmap(functools.partial(paint, camera=camera, glances=glances))
            paintings = _same(look, paintings, pictures, beliefs, at)
        assert np.isfinite(np.asarray(paintings.distance)).any()

        # Layers that begin as one constant stay apart.
        def first(picture, belief, at, shape=shape):
            return paint(blank_painting(*shape), picture, belief, at, camera, glances=glances)

        alone = [_same(first, pictures[row], each[row], cells[row]) for row in range(8)]
        assert any((np.asarray(one.floor) != np.asarray(one.beyond)).any() for one in alone)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_paths_equal_those_walked_in_jax(seed):
    _needs("paths")
    rng, task, free, transitions, cells, states = _problem(seed, 0.1)
    unknown = jnp.asarray(rng.random(free.shape) < 0.2)
    wildcard = Wildcard(cells=unknown, successors=one_letter_successors(task))
    resolution = jnp.float32(0.3)
    for wild, open_cells in ((None, free), (wildcard, free | unknown)):
        distances = product_distances(transitions, open_cells, cells, states, resolution, wild)[0]
        targets = jnp.asarray(rng.integers(0, (*free.shape, transitions.shape[2]), (30, 3)), jnp.int32)

        def walk(distances, target, horizon, wild=wild, open_cells=open_cells):
            ends = (cells[0], states[0], target[:2], target[2])
            options = {"horizon": horizon, "resolution": resolution, "wildcard": wild}
            return shortest_path(distances, transitions, open_cells, *ends, **options)

        for horizon in (3, 60):
            found = _same(jax.vmap(functools.partial(walk, horizon=horizon), (None, 0)), distances, targets)
            assert np.isfinite(np.asarray(found.cost)).any()


@pytest.mark.parametrize("min_size", [1, 3])
def test_components_equal_those_grown_in_rounds(min_size):
    _needs("frontiers")
    rng = np.random.default_rng(min_size)
    for shape in ((1, 1), (13, 29)):
        shares = rng.choice([0.0, 0.1, 0.4, 0.9], (16, 1, 1))
        cells = rng.choice([-1, 0, 1], (16, *shape), p=[0.4, 0.4, 0.2]).astype(np.int8)
        distances = np.where(rng.random(cells.shape) < 0.2, np.inf, np.floor(rng.random(cells.shape) * 9))
        find = functools.partial(_components, config=FrontierConfig(max_subgoals=5, min_size=min_size))
        reachable = jnp.asarray(rng.random(cells.shape) < shares)
        _same(jax.vmap(find), jnp.asarray(cells), reachable, jnp.asarray(distances, jnp.float32))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 1.0])
def test_parts_equal_those_grown_in_rounds(share):
    _needs("frontiers")
    rng = np.random.default_rng(int(share * 10))
    for shape in ((1, 1), (13, 29)):
        cells = rng.random((8, *shape)) < share
        _same(jax.vmap(connected_parts), jnp.asarray(cells))


def _components(cells, reachable, distances, config):
    blank = belief_from_numpy(np.zeros(cells.shape, np.int8), np.zeros(cells.shape, np.int32))
    return find_subgoals(dataclasses.replace(blank, cells=cells), reachable, distances, config)


@pytest.mark.parametrize("lanes", [3, 16])
def test_ways_through_squares_equal_those_by_lines(lanes):
    _needs("square_ways")
    rng = np.random.default_rng(lanes)
    shape = (17, 23, lanes)
    for seen in (0.0, 0.3, 0.7):
        begins = jnp.asarray(np.where(rng.random(shape) < 0.02, rng.random(shape) * 9, np.inf), jnp.float32)
        # Chances of few values, so that ways tie.
        chances = np.where(
            rng.random((6, *shape)) < 0.5, rng.choice([0.0, 0.25, 1.0], (6, *shape)), rng.random((6, *shape))
        )
        closed = [
            jnp.asarray(np.where(rng.random(shape[:2])[..., None] < seen, np.inf, one), jnp.float32) for one in chances
        ]
        _same(lambda begins, closed: cheapest_ways(ways_to_sides(begins), closed), begins, closed)


@pytest.mark.long
@pytest.mark.parametrize("name", ["firefighting", "rooms"])
def test_labels_equal_the_sweeps(name):
    _needs("labels")
    generator = make(name)
    asked = 0
    for number in range(2):
        world = generator.generate(world_key(Split.VALIDATION, number, generator.name))
        world = dataclasses.replace(world, resolution=jnp.float32(0.7))
        config = trial_config_for(world)
        belief = observe(BeliefMap.unobserved(world), world, world.start, config.sensor)
        for formula in list(generator.tasks.values())[:2]:
            task = generator.task(formula).arrays
            situation = assess(belief, world.start, task.initial, task, config.decision.frontiers)
            estimates = _same(true_labels, world, belief, situation.subgoals, task)
            asked += int(np.sum(np.asarray(estimates.failure_cost) > 0))
    assert asked > 0
