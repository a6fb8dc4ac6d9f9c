"""The memory of panoramas: against a list of all observations, and what happens when it is full."""

import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.learning.memory import (
    NO_OBSERVATION,
    empty_memory,
    moved_memory,
    observation_of_subgoals,
    remember,
    slots_of_observations,
)
from potlp_jax.types import Status
from potlp_jax.world.frontiers import FrontierConfig, find_subgoals
from potlp_jax.world.grid import BeliefMap, belief_from_numpy
from potlp_jax.world.sensing import SensorConfig, visible
from tests.reference.sensing import visible as reference_visible

FEATURES = (1, 2, 3)
remember_jit = jax.jit(remember)
visible_jit = jax.jit(visible, static_argnames="config")


def some_belief(rng: np.random.Generator, shape: tuple[int, int] = (12, 16)) -> BeliefMap:
    cells = rng.choice([BeliefMap.UNKNOWN, BeliefMap.FREE, BeliefMap.OCCUPIED], shape, p=[0.2, 0.65, 0.15])
    return belief_from_numpy(cells.astype(np.int8), np.zeros(shape, np.int32))


def free_cell(rng: np.random.Generator, belief: BeliefMap) -> np.ndarray:
    cells = np.argwhere(np.asarray(belief.free))
    return cells[rng.integers(len(cells))].astype(np.int32)


@jax.jit
def subgoals_of(belief: BeliefMap):
    everywhere = jnp.ones(belief.cells.shape, bool)
    return find_subgoals(belief, everywhere, jnp.zeros(belief.cells.shape), FrontierConfig(max_subgoals=8, min_size=1))


def test_line_of_sight_runs_through_known_free_cells():
    rng = np.random.default_rng(0)
    belief = some_belief(rng)
    cell = free_cell(rng, belief)
    memory = remember_jit(empty_memory(4, FEATURES, 12, 16), jnp.zeros(FEATURES), belief, jnp.asarray(cell))
    opaque = ~np.asarray(belief.free)
    seen = np.zeros(opaque.shape, bool)
    for at in reference_visible(opaque.tolist(), (int(cell[0]), int(cell[1])), 28.0):
        seen[at] = True
    np.testing.assert_array_equal(np.asarray(memory.observation_of_cell) == 0, seen & ~opaque)


def test_every_subgoal_is_shown_by_the_last_look_at_its_frontier():
    """Against a list that forgets nothing."""
    rng = np.random.default_rng(1)
    memory, observations = empty_memory(32, FEATURES, 12, 16), []
    belief = some_belief(rng)
    for number in range(12):
        cell = free_cell(rng, belief)
        features = jnp.full(FEATURES, number, jnp.float32)
        memory = remember_jit(memory, features, belief, jnp.asarray(cell))
        seen = visible_jit(~belief.free, jnp.asarray(cell), config=SensorConfig(range_cells=28.0))
        observations.append((cell, np.asarray(seen)))
        subgoals = subgoals_of(belief)
        found = observation_of_subgoals(memory, subgoals)
        for s in range(int(subgoals.mask.sum())):
            component = np.asarray(subgoals.component) == s
            showing = [n for n, (_, sight) in enumerate(observations) if np.any(sight & component)]
            expected = showing[-1] if showing else number
            assert int(found[s]) == expected
            place = int(slots_of_observations(memory, found)[s])
            np.testing.assert_array_equal(memory.cells[place], observations[expected][0])
            assert float(memory.features[place].min()) == float(memory.features[place].max()) == expected
        assert np.all(np.asarray(found)[~np.asarray(subgoals.mask)] == NO_OBSERVATION)
    assert int(memory.status) == 0


def corridor(known: int) -> BeliefMap:
    """A corridor of 12 cells, free up to ``known`` from the left, the rest unobserved; walls above and below."""
    cells = np.full((3, 14), BeliefMap.OCCUPIED, np.int8)
    cells[1, 1:13] = BeliefMap.UNKNOWN
    cells[1, 1 : known + 1] = BeliefMap.FREE
    return belief_from_numpy(cells, np.zeros(cells.shape, np.int32))


def test_what_no_frontier_refers_to_makes_room():
    """Three places, eight observations along a corridor whose end was seen from each: only the last is needed."""
    memory = empty_memory(3, FEATURES, 3, 14)
    for number in range(8):
        belief = corridor(number + 2)
        memory = remember_jit(memory, jnp.full(FEATURES, number, jnp.float32), belief, jnp.array([1, number + 1]))
        subgoals = subgoals_of(belief)
        assert int(observation_of_subgoals(memory, subgoals)[0]) == number
    assert int(memory.status) == 0
    assert sorted(np.asarray(memory.observation).tolist()) == [5, 6, 7]


def test_a_full_memory_is_flagged():
    """Frontiers in three niches, each seen from inside its niche alone; there is room for two panoramas."""
    cells = np.full((5, 13), BeliefMap.OCCUPIED, np.int8)
    niches = (1, 6, 11)
    for column in niches:
        cells[1, column], cells[2, column] = BeliefMap.UNKNOWN, BeliefMap.FREE
    belief = belief_from_numpy(cells, np.zeros(cells.shape, np.int32))
    memory = empty_memory(2, FEATURES, 5, 13)
    flags = []
    for column in niches:
        memory = remember_jit(memory, jnp.zeros(FEATURES), belief, jnp.array([2, column]))
        flags.append(int(memory.status))
    assert flags == [0, 0, Status.VIEW_OVERFLOW]
    # The subgoal whose panorama is gone is estimated from the last one.
    subgoals = subgoals_of(belief)
    order = np.asarray(subgoals.cells)[:3, 1]
    found = np.asarray(observation_of_subgoals(memory, subgoals))[:3]
    assert {int(c): int(n) for c, n in zip(order, found, strict=True)} == {1: 2, 6: 1, 11: 2}
    # Once more from the last niche, in the place of what was seen there: nothing more is lost, and the bit stays.
    memory = remember_jit(memory, jnp.zeros(FEATURES), belief, jnp.array([2, niches[-1]]))
    assert sorted(np.asarray(memory.observation).tolist()) == [1, 3]
    assert int(memory.status) == Status.VIEW_OVERFLOW


def test_a_map_that_outgrows_its_array_keeps_what_was_seen_on_it():
    """Against a memory that had the larger array from the start."""
    rng = np.random.default_rng(3)
    small, (top, left) = some_belief(rng), (3, 5)
    pad = ((top, 4), (left, 2))
    large = belief_from_numpy(
        np.pad(np.asarray(small.cells), pad, constant_values=BeliefMap.UNKNOWN), np.pad(np.asarray(small.letters), pad)
    )
    found, wanted = empty_memory(4, FEATURES, 12, 16), empty_memory(4, FEATURES, 19, 23)
    for number in range(8):
        cell, features = jnp.asarray(free_cell(rng, small)), jnp.full(FEATURES, number, jnp.float32)
        there = cell + jnp.array([top, left], jnp.int32)
        wanted = remember_jit(wanted, features, large, there)
        if number == 5:
            found = moved_memory(found, (19, 23), top, left)
        found = (
            remember_jit(found, features, large, there) if number >= 5 else remember_jit(found, features, small, cell)
        )
    # Cells beyond the small array are known to be free in neither.
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(one, other)
    assert (np.asarray(found.observation_of_cell) >= 0).any()
