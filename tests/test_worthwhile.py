"""Subgoals that are hardly a way to a class, while there are far better ones, are left out of a decision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import potlp_jax
from potlp_jax.planning.decision import decide_from_estimates, subgoals_at
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.move import MoveKind
from potlp_jax.planning.situation import DecisionConfig, worthwhile
from potlp_jax.task.task import Task
from potlp_jax.trials.config import trial_config_for
from potlp_jax.types import NO_ACTION, Status
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap, belief_from_numpy

NAMES = ("goal",)
TASK = Task.from_formula("F goal", NAMES)


def _estimates(chances) -> Estimates:
    chance = jnp.asarray(chances, jnp.float32)
    return Estimates(
        success_probability=chance, success_cost=jnp.full_like(chance, 2.0), failure_cost=jnp.full_like(chance, 1.0)
    )


def _subgoals(columns, real):
    cells = jnp.asarray([[1, column] for column in columns], jnp.int32)
    return subgoals_at(cells, jnp.asarray(real), 3, 42)


def test_chances_below_a_share_of_the_best_of_their_class_count_as_none():
    in_reach = jnp.array([True, True, True, False])
    # What is masked, or out of reach, may hold anything, and is no measure of others.
    estimates = _estimates([[0.5, 0.04], [0.049, 0.0], [0.05, 0.004], [np.nan, 1.0]])
    found = worthwhile(estimates, in_reach, 0.1)
    expected = np.array([[0.5, 0.04], [0.0, 0.0], [0.05, 0.004]], np.float32)
    np.testing.assert_array_equal(found.success_probability[:3], expected)
    np.testing.assert_array_equal(found.success_cost, estimates.success_cost)
    np.testing.assert_array_equal(found.failure_cost, estimates.failure_cost)
    none = _estimates(np.zeros((4, 2)))
    np.testing.assert_array_equal(worthwhile(none, in_reach, 0.5).success_probability, none.success_probability)
    assert worthwhile(estimates, in_reach, 0.0) is estimates


def test_a_chance_that_is_none_is_still_reported_as_wrong():
    belief, subgoals = _hallway(), _subgoals([2, 40], [True, True])
    move = _decide(belief, subgoals, [[0.5], [np.nan]], 0.1)
    assert int(move.status) & int(Status.INVALID)


_compiled = jax.jit(decide_from_estimates, static_argnames="config")


def _hallway() -> BeliefMap:
    cells = np.full((3, 42), BeliefMap.OCCUPIED, np.int8)
    cells[1, 1:-1] = BeliefMap.FREE
    # A door beside the robot, and one far away.
    cells[0, [2, 40]] = BeliefMap.UNKNOWN
    return belief_from_numpy(cells, np.zeros(cells.shape, np.int32), propositions=NAMES)


def _decide(belief, subgoals, chances, least_chance):
    # Nothing but the goal is asked for; what other classes there are gets the same answers.
    classes = TASK.arrays.class_mask.shape[0]
    estimates = _estimates(np.repeat(np.asarray(chances, np.float32), classes, axis=1))
    config = DecisionConfig(frontiers=FrontierConfig(max_subgoals=2), least_chance=least_chance)
    at, state = jnp.array([1, 3], jnp.int32), TASK.arrays.initial
    given = (belief, subgoals, estimates, TASK.arrays, at, state, jax.random.key(0))
    return _compiled(*given, config=config)


@pytest.mark.parametrize(("least_chance", "chosen"), [(0.0, 2), (0.02, 2), (0.1, 40)])
def test_a_door_nearby_that_leads_hardly_anywhere_is_passed(least_chance, chosen):
    """One in thirty beside the robot costs less a chance than a half far away; it is tried first, unless left out."""
    belief, subgoals = _hallway(), _subgoals([2, 40], [True, True])
    move = _decide(belief, subgoals, [[0.5 / 15], [0.5]], least_chance)
    assert int(move.action) != NO_ACTION
    assert int(move.search.plan.subgoal) == [2, 40].index(chosen)
    assert np.asarray(subgoals.cells)[int(move.search.plan.subgoal), 1] == chosen


def test_where_all_chances_are_small_none_is_left_out():
    belief, subgoals = _hallway(), _subgoals([2, 40], [True, True])
    move = _decide(belief, subgoals, [[0.003], [0.003]], 0.1)
    assert int(move.search.plan.subgoal) == 0
    assert int(jnp.sum(move.search.terms.success_probability > 0)) >= 2


def test_a_subgoal_that_is_barred_is_no_measure_of_others():
    """It is never tried, so that the robot would fall back on the nearest frontier for good."""
    task = Task.from_formula("!hazard U goal", ("goal", "hazard"))
    cells = np.full((5, 10), BeliefMap.OCCUPIED, np.int8)
    # The robot's hallway is open in the west; the way to the east goes over the hazard.
    cells[1, 1:9] = cells[2, 5] = cells[3, 1:8] = BeliefMap.FREE
    cells[1, 0] = cells[3, 8] = BeliefMap.UNKNOWN
    letters = np.zeros(cells.shape, np.int32)
    letters[2, 5] = 0b10
    belief = belief_from_numpy(cells, letters, propositions=("goal", "hazard"))
    near, barred = (1, 1), (3, 7)
    chances = np.array([[0.3], [0.9]], np.float32).repeat(task.arrays.class_mask.shape[0], axis=1)
    given = subgoals_at(jnp.array([near, barred]), jnp.array([True, True]), *cells.shape)
    config = DecisionConfig(frontiers=FrontierConfig(max_subgoals=2), least_chance=0.5)
    at = jnp.array([1, 4], jnp.int32), task.arrays.initial
    move = _compiled(belief, given, _estimates(chances), task.arrays, *at, jax.random.key(0), config=config)
    assert int(move.kind) == MoveKind.ACTION
    assert tuple(np.asarray(move.target_cell)) == near


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_what_is_no_share_is_named(share):
    with pytest.raises(ValueError, match=r"least_chance is .*; give a number from 0 to 1"):
        DecisionConfig(least_chance=share)


@pytest.mark.parametrize(
    ("family", "share", "factor"),
    [("delivery", 0.1, 0.5), ("parcels", 0.1, 0.5), ("campus-small", 0.1, 0.5), ("firefighting", 0.0, 4.0)],
)
def test_families_with_many_doors_leave_small_chances_out(family, share, factor):
    decision = trial_config_for(potlp_jax.make(family)).decision
    assert (decision.least_chance, decision.dead_end_factor) == (share, factor)
