"""PlanningProblem: types, validation, enumeration of actions."""

import dataclasses
import subprocess
import sys

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.errors import ProblemError
from potlp_jax.planning.history import action_terms, initial_history
from potlp_jax.planning.problem import PlanningProblem, enumerate_actions
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.types import NO_ACTION
from tests.reference.problems import FORMULAS, SIZES, padded_problem, problem_of, random_fields, random_problem, task_of

TASK = "F a & F b"


def broken(name, index=(), value=None, formula=TASK, subgoals=2):
    """A valid problem but for one value."""
    fields = random_fields(task_of(formula), subgoals, seed=0)
    fields[name] = np.array(fields[name], dtype=float if name != "dfa_state" else int)
    fields[name][index] = value
    return problem_of(task_of(formula), fields)


def test_random_problems_are_valid():
    for seed, formula in enumerate(FORMULAS):
        random_problem(formula, seed % 3, seed).check()


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("travel", (0, 1, 1, 2), -1.0),
        ("travel", (2, 0, 0, 0), np.nan),
        ("finish", (1, 1), -0.5),
        ("finish", (2, 0), np.nan),
        ("success_probability", (1, 2), 1.5),
        ("success_probability", (0, 0), -0.1),
        ("success_probability", (0, 3), np.nan),
        ("success_cost", (1, 0), 0.0),
        ("success_cost", (1, 1), -2.0),
        ("success_cost", (0, 1), np.inf),
        ("success_cost", (0, 1), np.nan),
        ("failure_cost", (0, 0), -1.0),
        ("failure_cost", (1, 4), np.nan),
        ("failure_cost", (1, 4), np.inf),
        ("dead_end_cost", (), 0.0),
        ("dead_end_cost", (), -1.0),
        ("dead_end_cost", (), np.inf),
        ("dfa_state", (), 4),
        ("dfa_state", (), -1),
    ],
)
def test_check_names_field_index_and_value(name, index, value):
    with pytest.raises(ProblemError) as error:
        broken(name, index, value).check()
    message = str(error.value)
    assert (f"{name}[{', '.join(map(str, index))}]" if index else name) in message
    assert str(value) in message


def test_check_ignores_padding():
    fields = random_fields(task_of(TASK), 2, seed=0)
    fields["subgoal_mask"] = np.array([True, False])
    fields["success_cost"][1] = -1.0
    fields["success_probability"][1] = np.nan
    problem_of(task_of(TASK), fields).check()


def test_check_names_the_field_whose_shape_is_wrong():
    wrong = dict.fromkeys(("success_probability", "success_cost", "failure_cost"), jnp.ones((2, 4)))
    with pytest.raises(ProblemError, match=r"success_probability has shape \(2, 4\), expected \(2, 5\)"):
        dataclasses.replace(random_problem(TASK, 2, 0), **wrong).check()


OF_64_BITS = """
import dataclasses
import sys
import jax
import numpy as np
from potlp_jax import BestFirstConfig, PlanningProblem, Task, plan_actions
jax.config.update("jax_enable_x64", sys.argv[1] == "on")
task = Task.shipped("toy-2")
values = np.random.default_rng(0)
sizes = S, Z, C = 2, task.dfa.num_states, len(task.classes)
problem = PlanningProblem.from_arrays(
    task.arrays, travel=values.uniform(1, 9, (S + 1, Z, S, Z)), finish=np.full((S + 1, Z), np.inf),
    success_probability=values.random((S, C)), success_cost=values.uniform(1, 9, (S, C)),
    failure_cost=values.random((S, C)), dfa_state=task.dfa.initial, subgoal_mask=np.ones(S, bool), dead_end_cost=100.0,
)
names = ("travel", "success_probability", "dfa_state")
found = []
for kind in (np.asarray, jax.numpy.asarray):
    wide = {name: np.asarray(getattr(problem, name)) for name in names}
    wide = {name: kind(array.astype(array.dtype.str.replace("4", "8"))) for name, array in wide.items()}
    given = dataclasses.replace(problem, **wide)
    given.check()
    found.append(plan_actions(given, jax.random.key(0), BestFirstConfig(simulations=20)).q_values)
own = plan_actions(problem, jax.random.key(0), BestFirstConfig(simulations=20)).q_values
print(given.travel.dtype, all(np.array_equal(own, q_values) for q_values in found))
"""


@pytest.mark.parametrize(("switch", "kind"), [("on", "float64"), ("off", "float32")])
def test_arrays_of_64_bits_are_rounded(switch, kind):
    """In a program of its own: here annotations are checked."""
    command = [sys.executable, "-c", OF_64_BITS, switch]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert told.split() == [kind, "True"]


def test_from_arrays_is_traceable_and_sets_types():
    fields = random_fields(task_of(TASK), 2, seed=3)
    problem = jax.jit(lambda fields: PlanningProblem.from_arrays(task_of(TASK).arrays, **fields))(fields)
    assert problem.travel.dtype == jnp.float32
    assert problem.dfa_state.dtype == jnp.int32
    assert problem.subgoal_mask.dtype == jnp.bool_
    assert (problem.subgoal_count, problem.edge_count, problem.action_count) == (2, 5, 11)
    problem.check()


def test_enumerated_actions_are_those_available_at_the_root():
    at_root = jax.jit(lambda problem: action_terms(problem, initial_history(problem)).available[:-1])
    enumerated = jax.jit(enumerate_actions)
    counts = set()
    for seed in range(40):
        task = task_of(FORMULAS[seed % len(FORMULAS)])
        problem = padded_problem(task, random_fields(task, 1 + seed % 3, seed), SIZES, 3)
        found = enumerated(problem)
        np.testing.assert_array_equal(found.reshape(-1), at_root(problem))
        counts.add(int(found.sum()))
    assert len(counts) > 3


def test_enumerated_actions_by_hand():
    # Edges of F a & F b: 0->1 (b), 0->2 (a), 0->3 (both), 1->3, 2->3.
    fields = random_fields(task_of(TASK), 2, seed=0)
    fields["dfa_state"] = 0
    fields["travel"] = np.full_like(fields["travel"], np.inf)
    fields["travel"][2, 0, 0, 0] = 5.0  # the first subgoal with nothing done
    fields["travel"][2, 0, 1, 1] = 7.0  # the second after b, which is on the way
    fields["success_probability"] = np.full((2, 5), 0.5)
    edges = task_of(TASK).edges.tolist()
    found = np.asarray(enumerate_actions(problem_of(task_of(TASK), fields)))
    expected = [[z in (0,) for z, _ in edges], [z in (1,) for z, _ in edges]]
    np.testing.assert_array_equal(found, expected)


def test_a_satisfied_task_leaves_nothing_to_enumerate():
    """Whatever could be reached, as long as a caller's table says so."""
    fields = random_fields(task_of(TASK), 2, seed=0, unreachable=0.0)
    fields["travel"] = np.full_like(fields["travel"], 5.0)
    fields["success_probability"] = np.full((2, 5), 0.5)
    found = {}
    for fields["dfa_state"] in range(4):
        problem = problem_of(task_of(TASK), fields)
        found[fields["dfa_state"]] = bool(np.any(enumerate_actions(problem)))
    assert found == {state: not task_of(TASK).dfa.accepting[state] for state in range(4)}


@pytest.mark.parametrize(("formula", "subgoals"), [("F a & F b", 0), ("X a", 2), ("X a", 0)])
def test_nothing_to_enumerate(formula, subgoals):
    problem = random_problem(formula, subgoals, 0)
    assert enumerate_actions(problem).shape == (subgoals, problem.edge_count)
    assert not np.any(enumerate_actions(problem))


def test_a_padded_problem_is_planned_as_it_is_and_shares_a_program_with_others():
    chex.clear_trace_counter()
    plan = jax.jit(chex.assert_max_traces(plan_actions, n=1), static_argnames="config")
    config, key, size = BestFirstConfig(simulations=60), jax.random.key(0), 5
    for subgoals in (1, 2, 4, size):
        problem = random_problem("(!f U e) & F f", subgoals, seed=subgoals)
        mine, its = plan(problem.padded(size), key, config=config), plan_actions(problem, key, config)
        own = subgoals * problem.edge_count
        real = [*range(own), size * problem.edge_count]
        np.testing.assert_array_equal(np.asarray(mine.q_values)[real], its.q_values)
        assert np.isinf(np.delete(np.asarray(mine.q_values), real)).all()
        assert (float(mine.value), float(mine.lower_bound)) == (float(its.value), float(its.lower_bound))
        assert int(mine.action) == (NO_ACTION if its.action == NO_ACTION else real[int(its.action)])


def test_a_batch_is_padded_row_by_row_and_nothing_is_cut_off():
    problems = [random_problem("F a & F b", 2, seed) for seed in range(3)]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems).padded(4)
    for row, problem in enumerate(problems):
        alone = problem.padded(4)
        alone.check()
        for mine, its in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_array_equal(mine[row], its)
    with pytest.raises(ProblemError, match="has 2 subgoals and cannot be padded to 1"):
        problems[0].padded(1)
