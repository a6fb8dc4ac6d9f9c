"""True labels against a slow reference, and the pathologies that they were defined for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.learning.labels import TrueMapEstimator, nearest_ways, true_labels
from potlp_jax.planning.decision import subgoals_at
from potlp_jax.planning.distances.product import grid_distances
from potlp_jax.planning.estimates import Estimates
from potlp_jax.task.task import Task, TaskSizes
from potlp_jax.world.frontiers import FrontierConfig, find_subgoals
from potlp_jax.world.grid import BeliefMap, belief_from_numpy, make_world
from tests.reference.labels import true_label

pytestmark = pytest.mark.optimised

FORMULAS = ("F a", "!b U a", "F a & F b", "F(a | b)", "F(a & X b)", "!b U (a & F b)")
SIZES = TaskSizes(states=6, propositions=2, edges=12, classes=12, compound=2, cubes=3)
SHAPE = (10, 13)
FRONTIERS = FrontierConfig(max_subgoals=5, min_size=1)

SIGMA = ("a", "b")
tasks = {text: Task.from_formula(text, SIGMA) for text in FORMULAS}


@jax.jit
def _labels(world, belief, arrays):
    reachable = jnp.isfinite(grid_distances(belief.free, world.start, belief.resolution))
    distance = grid_distances(belief.free, world.start, belief.resolution)
    subgoals = find_subgoals(belief, reachable, distance, FRONTIERS)
    return subgoals, true_labels(world, belief, subgoals, arrays)


def _case(seed, density, known):
    """A random world and a belief that knows a blob of cells around the start."""
    rng = np.random.default_rng(seed)
    occupied = rng.random(SHAPE) < density
    occupied[[0, -1]] = True
    occupied[:, [0, -1]] = True
    start = (int(rng.integers(1, SHAPE[0] - 1)), int(rng.integers(1, SHAPE[1] - 1)))
    occupied[start] = False
    letters = np.where(rng.random(SHAPE) < 0.15, rng.integers(1, 4, SHAPE), 0)
    world = make_world(occupied, letters, start, propositions=SIGMA)
    rows, columns = np.indices(SHAPE)
    seen = np.hypot(rows - start[0], columns - start[1]) < known
    seen |= rng.random(SHAPE) < 0.05
    cells = np.where(seen, np.where(occupied, BeliefMap.OCCUPIED, BeliefMap.FREE), BeliefMap.UNKNOWN)
    return world, belief_from_numpy(cells, np.where(seen, np.asarray(world.letters), 0), propositions=SIGMA)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.3]), st.sampled_from([2.0, 4.0]), st.sampled_from(FORMULAS))
def test_labels_equal_the_reference(seed, density, known, text):
    world, belief = _case(seed, density, known)
    task, arrays = tasks[text], tasks[text].padded(SIZES)
    subgoals, estimates = _labels(world, belief, arrays)
    free, letters = ~np.asarray(world.occupied), np.asarray(world.letters)
    observed = ~np.asarray(belief.unknown)
    around = np.pad(~observed, 1, constant_values=True)
    beside_unobserved = around[:-2, 1:-1] | around[2:, 1:-1] | around[1:-1, :-2] | around[1:-1, 2:]
    frontier = observed & free & beside_unobserved
    for s in range(FRONTIERS.max_subgoals):
        for c in range(SIZES.classes):
            probability = float(estimates.success_probability[s, c])
            if not (subgoals.mask[s] and c < task.sizes.classes):
                assert probability == 0.0
                continue
            stay = set(np.flatnonzero(np.asarray(arrays.class_stay[c])).tolist())
            go = set(np.flatnonzero(np.asarray(arrays.class_go[c])).tolist())
            own = np.asarray(subgoals.component) == s
            expected = true_label(free, letters, observed, frontier, own, np.asarray(subgoals.cells[s]), stay, go)
            assert probability == expected[0]
            if expected[0]:
                assert float(estimates.success_cost[s, c]) == pytest.approx(expected[1], rel=1e-5)
            assert float(estimates.failure_cost[s, c]) == pytest.approx(expected[2], rel=1e-5)


def _picture(rows):
    """World and belief from a drawing: # wall, . free, a goal; upper case or _ (free) and = (wall) are unobserved."""
    art = np.array([list(row) for row in rows])
    occupied = np.isin(art, ["#", "="])
    letters = np.isin(art, ["a", "A"]).astype(np.int32)
    seen = np.isin(art, ["#", ".", "a", "s"])
    start = tuple(int(entry) for entry in np.argwhere(art == "s")[0])
    world = make_world(occupied, letters, start, propositions=SIGMA)
    cells = np.where(seen, np.where(occupied, BeliefMap.OCCUPIED, BeliefMap.FREE), BeliefMap.UNKNOWN)
    return world, belief_from_numpy(cells, np.where(seen, letters, 0), propositions=SIGMA)


def _picture_labels(rows):
    world, belief = _picture(rows)
    subgoals, estimates = _labels(world, belief, tasks["F a"].padded(SIZES))
    return np.asarray(subgoals.cells)[np.asarray(subgoals.mask)].tolist(), estimates


def test_a_known_goal_behind_an_unknown_shortcut_counts():
    # The goal has been seen across a gap, the way to it has not: through the unobserved cells and out again.
    rows = [
        "#########",
        "#s.#.a#.#",
        "#..#..#.#",
        "#..___.##",
        "#########",
    ]
    cells, estimates = _picture_labels(rows)
    subgoal = cells.index([3, 2])
    assert float(estimates.success_probability[subgoal, 0]) == 1.0
    # (3,3), (3,4), diagonally to (2,5), up to (1,5).
    assert float(estimates.success_cost[subgoal, 0]) == pytest.approx(2 + np.sqrt(2) + 1)


def test_the_own_frontier_is_no_way_back():
    # The only goal is known and on the robot's side: what lies beyond the subgoal does not satisfy anything.
    rows = [
        "######",
        "#sa._=",
        "#..._=",
        "######",
    ]
    cells, estimates = _picture_labels(rows)
    assert len(cells) == 1
    assert float(estimates.success_probability[0, 0]) == 0.0
    assert float(estimates.failure_cost[0, 0]) == pytest.approx(np.sqrt(2))


def test_nothing_behind_a_frontier_costs_nothing_to_fail():
    rows = [
        "#####",
        "#s.==",
        "#####",
    ]
    cells, estimates = _picture_labels(rows)
    assert cells == [[1, 2]]
    assert float(estimates.failure_cost[0, 0]) == 0.0
    assert float(estimates.success_cost[0, 0]) > 0.0


def test_only_the_nearest_ways_to_a_class_are_left():
    rng = np.random.default_rng(8)
    cells, mask = jnp.asarray(rng.integers(0, 5, (6, 2)), jnp.int32), jnp.asarray([True] * 5 + [False])
    subgoals = subgoals_at(cells, mask, 5, 5)
    success = jnp.asarray(rng.random((6, 40)) < 0.5, jnp.float32)
    costs = jnp.asarray(rng.uniform(0.5, 20.0, (6, 40)), jnp.float32)
    labels = Estimates(success_probability=success, success_cost=costs, failure_cost=costs[::-1])
    found = jax.jit(nearest_ways)(labels, subgoals, jnp.float32(0.5))
    left_out = 0
    for column in range(40):
        ways = [row for row in range(5) if success[row, column] > 0]
        least = min((float(costs[row, column]) for row in ways), default=0.0)
        for row in range(6):
            # A quarter, and four cells of half a metre.
            kept = row in ways and float(costs[row, column]) <= 1.25 * least + 2.0
            assert float(found.success_probability[row, column]) == float(kept)
            assert float(found.success_cost[row, column]) == (float(costs[row, column]) if kept else 0.5)
            left_out += row in ways and not kept
    assert left_out > 10
    np.testing.assert_array_equal(found.failure_cost, labels.failure_cost)


def test_the_oracle_of_the_nearest_ways_leaves_out_the_detour_through_a_second_door():
    """A hallway whose far part is not seen, and beside the robot a room with a second door to that part."""
    occupied = np.ones((9, 30), bool)
    occupied[1:3, 1:-1] = occupied[4:8, 3:20] = occupied[3, [4, 18]] = False
    letters = np.zeros(occupied.shape, np.int32)
    letters[1, 28] = 1
    world = make_world(occupied, letters, (1, 4), propositions=("goal",))
    cells = np.where(occupied, BeliefMap.OCCUPIED, BeliefMap.FREE)
    cells[:, 16:] = cells[4:] = BeliefMap.UNKNOWN
    belief = belief_from_numpy(cells, np.zeros(cells.shape, np.int32), propositions=("goal",))
    task = Task.from_formula("F goal", ("goal",))
    subgoals = find_subgoals(belief, belief.free, jnp.ones(cells.shape), FrontierConfig(max_subgoals=4, min_size=1))
    found = {}
    for nearest in (False, True):
        by = TrueMapEstimator(world=world, nearest=nearest)
        labels = jax.jit(lambda by, *asked: by(*asked))(by, belief, subgoals, task.arrays)
        best = np.asarray(labels.success_probability).max(axis=1)
        places = np.asarray(subgoals.cells)[np.asarray(subgoals.mask)]
        found[nearest] = {tuple(cell): float(best[row]) for row, cell in enumerate(places.tolist())}
    (door,) = [cell for cell in found[False] if cell[0] == 3]
    (hallway,) = [cell for cell in found[False] if cell[0] < 3]
    assert found[False] == {door: 1.0, hallway: 1.0}
    assert found[True] == {door: 0.0, hallway: 1.0}
