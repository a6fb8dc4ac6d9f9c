"""Only what can still be attempted is asked, and nothing else can matter."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.planning.estimates import Estimates, ask, classes_ahead
from potlp_jax.planning.exact.api import solve_exact
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.world.frontiers import FrontierConfig, find_subgoals
from potlp_jax.world.grid import BeliefMap, make_world
from tests.reference.problems import FORMULAS, SIZES, random_fields, task_of


def states_after(task, state):
    """States that some word leads to without a trap, found word by word."""
    found, new = set(), {state}
    while new:
        found |= new
        new = {int(z) for at in new for z in task.dfa.transitions[at] if not task.dfa.trap[z]} - found
    return found


def classes_after(task, state):
    """Classes of the edges that begin in these states, by the task's own lists."""
    reached, found = states_after(task, state), set()
    for (begin, _), condition in zip(task.edges, task.outcomes.edge_condition, strict=True):
        if int(begin) in reached:
            found |= set(task.outcomes.conditions[condition].classes)
    return found


@pytest.mark.parametrize("formula", [*FORMULAS, "F a & F b & F c"])
def test_classes_ahead_are_those_of_edges_that_can_be_reached(formula):
    task = task_of(formula)
    padded = task.padded(SIZES.union(task.sizes))
    for state in np.flatnonzero(~task.dfa.trap):
        expected = classes_after(task, int(state))
        assert set(np.flatnonzero(classes_ahead(padded, jnp.int32(state)))) == expected


def test_once_something_is_found_it_is_not_asked_for():
    task = task_of("F a & F b & F c")
    letter = 1 << task.propositions.index("a")
    after = int(task.dfa.transitions[task.dfa.initial, letter])
    asked = np.flatnonzero(classes_ahead(task.arrays, jnp.int32(after)))
    # What is left is b, c, or both at one cell; no cube says that a must hold or must not.
    literals = np.asarray(task.arrays.class_phi)[asked][:, 1, task.propositions.index("a")]
    assert 0 < len(asked) < task.sizes.classes
    assert not literals.any()


def test_an_estimator_is_asked_for_what_is_ahead():
    task = task_of("F a & F b & F c")
    empty = np.zeros((4, 5), bool)
    belief = BeliefMap.revealed(make_world(empty, empty.astype(int), (1, 1), propositions=task.propositions))
    subgoals = find_subgoals(belief, belief.free, jnp.zeros(belief.free.shape), FrontierConfig(max_subgoals=1))
    asked = []

    def estimator(belief, subgoals, task):
        asked.append(np.asarray(task.class_mask))
        nothing = jnp.zeros((1, task.class_mask.shape[0]))
        return Estimates(success_probability=nothing, success_cost=nothing + 1.0, failure_cost=nothing)

    for state in np.flatnonzero(~task.dfa.trap):
        ask(estimator, belief, subgoals, task.arrays, jnp.int32(state))
        assert set(np.flatnonzero(asked[-1])) == classes_after(task, int(state))


@pytest.mark.long
@pytest.mark.parametrize("formula", FORMULAS)
def test_what_is_not_asked_changes_no_value(formula):
    task = task_of(formula)
    for seed in range(4):
        fields = random_fields(task, 2, seed)
        for state in np.flatnonzero(~task.dfa.trap & ~task.dfa.accepting):
            problem = PlanningProblem.from_arrays(task.arrays, **(fields | {"dfa_state": int(state)}))
            ahead = classes_ahead(task.arrays, problem.dfa_state)
            narrowed = dataclasses.replace(
                problem, success_probability=jnp.where(ahead[None], problem.success_probability, 0.0)
            )
            np.testing.assert_array_equal(solve_exact(narrowed).q_values, solve_exact(problem).q_values)
