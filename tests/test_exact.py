"""The exact solver against a literal recursion of Eq. 3 over histories, and by hand."""

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from potlp_jax.bench.problems import FAMILIES, family_problem
from potlp_jax.errors import ProblemTooLargeError
from potlp_jax.planning.exact import exploration
from potlp_jax.planning.exact.api import bound_exact, solve_exact
from potlp_jax.types import NO_ACTION, Status
from tests.reference.planning import Recursion, ReferenceProblem
from tests.reference.problems import FORMULAS, problem_of, random_fields, random_problem, task_of


def assert_equals_recursion(problem, remember=True):
    exact, reference = solve_exact(problem), ReferenceProblem(problem)
    recursion = Recursion(reference, remember)
    expected = np.full(problem.action_count, np.inf)
    for action in reference.actions([]):
        expected[reference.index(action)] = recursion.q([], action)
    np.testing.assert_allclose(exact.q_values, expected, rtol=1e-9)
    np.testing.assert_allclose(exact.value, recursion.value(), rtol=1e-9)
    if np.isfinite(expected).any():
        assert exact.action == int(np.argmin(expected))
        assert exact.status == Status.OK
    return exact


@given(
    formula=st.sampled_from(FORMULAS),
    subgoals=st.integers(0, 2),
    seed=st.integers(0, 10**6),
    backward=st.booleans(),
)
@settings(max_examples=20, deadline=None)
def test_equals_the_literal_recursion(formula, subgoals, seed, backward):
    unreachable = 0.5 if subgoals == 2 else 0.2
    assert_equals_recursion(random_problem(formula, subgoals, seed, unreachable=unreachable, backward=backward))


@given(formula=st.sampled_from(FORMULAS), seed=st.integers(0, 10**6))
@settings(max_examples=8, deadline=None)
def test_equals_the_recursion_that_remembers_nothing(formula, seed):
    assert_equals_recursion(random_problem(formula, 1, seed), remember=False)


@pytest.mark.parametrize("formula", ["F g", "F(a & (b | c))", "(!f U e) & F f", "F(a & F(b & F a))"])
def test_equals_the_literal_recursion_on_three_subgoals(formula):
    assert_equals_recursion(random_problem(formula, 3, seed=1, unreachable=0.4))


def reach(subgoals, **changes):
    """``F g`` with every way of length 10 and given estimates."""
    task = task_of("F g")
    fields = random_fields(task, subgoals, 0)
    fields["travel"] = np.full_like(fields["travel"], 10.0)
    fields["finish"] = np.full_like(fields["finish"], np.inf)
    fields["dfa_state"] = task.dfa.initial
    return problem_of(task, fields | {name: np.array(value) for name, value in changes.items()})


def test_one_subgoal_by_hand():
    problem = reach(1, success_probability=[[0.25]], success_cost=[[8.0]], failure_cost=[[20.0]])
    # Afterwards nothing is left to try: the dead end.
    expected = 10.0 + 0.25 * 8.0 + 0.75 * (20.0 + 300.0)
    assert solve_exact(problem).value == pytest.approx(expected)


def test_two_subgoals_by_hand():
    problem = reach(2, success_probability=[[0.5], [0.25]], success_cost=[[4.0], [6.0]], failure_cost=[[12.0], [2.0]])
    second = 0.25 * 6.0 + 0.75 * (2.0 + 300.0)
    # The way back out of the first region costs R_F once more.
    first = 10.0 + 0.5 * 4.0 + 0.5 * (12.0 + (12.0 + 10.0) + second)
    exact = assert_equals_recursion(problem)
    assert exact.q_values[0] == pytest.approx(first)


def test_two_things_behind_one_subgoal():
    """Having found one thing, the robot looks for the other without leaving: D is 0 and nothing is pending."""
    task = task_of("F a & F b")
    fields = random_fields(task, 1, 0)
    travel = np.full((2, 4, 1, 4), np.inf)
    travel[:, range(4), :, range(4)] = 10.0
    fields |= {"travel": travel, "finish": np.full((2, 4), np.inf), "dfa_state": 0}
    chance = np.zeros((1, 5))
    conditions = {tuple(edge): int(m) for edge, m in zip(task.edges.tolist(), task.arrays.edge_condition, strict=True)}
    chance[0, conditions[0, 1]], chance[0, conditions[1, 3]] = 1.0, 1.0
    cost = np.full((1, 5), 7.0)
    exact = assert_equals_recursion(problem_of(task, fields | {"success_probability": chance, "success_cost": cost}))
    assert exact.value == pytest.approx(10.0 + 7.0 + 7.0)


def test_accepting_root():
    problem = reach(1, dfa_state=int(np.flatnonzero(task_of("F g").dfa.accepting)[0]))
    exact = solve_exact(problem)
    assert (exact.value, exact.action, exact.status) == (0.0, NO_ACTION, Status.ACCEPTING_ROOT)
    assert np.isinf(exact.q_values).all()


@pytest.mark.parametrize("subgoals", [0, 2])
def test_boxed_in(subgoals):
    problem = reach(subgoals, travel=np.full((subgoals + 1, 2, subgoals, 2), np.inf))
    exact = assert_equals_recursion(problem)
    assert (exact.value, exact.action, exact.status) == (300.0, NO_ACTION, Status.DEAD_END)


def test_finish_without_subgoals():
    task = task_of("F g")
    finish = np.array([[40.0, np.inf]]) if not task.dfa.accepting[0] else np.array([[np.inf, 40.0]])
    exact = assert_equals_recursion(reach(0, finish=finish))
    assert (exact.value, exact.action) == (40.0, 0)


def test_accepting_state_is_not_the_last_or_first():
    task = task_of("(!c U (a | b)) & F(b | (c & a))")
    assert np.flatnonzero(task.dfa.accepting).tolist() == [2]
    assert task.sizes.states == 4
    for seed in range(3):
        assert_equals_recursion(random_problem("(!c U (a | b)) & F(b | (c & a))", 2, seed))


def test_reused_success_is_worth_it():
    """F(a & F(b & F a)): the first a is known to be there when it is needed again."""
    task = task_of("F(a & F(b & F a))")
    fields = random_fields(task, 2, 0, unreachable=0.0, finish_chance=0.0)
    fields["dfa_state"], fields["success_probability"] = 0, np.full((2, 5), 0.5)
    exact = assert_equals_recursion(problem_of(task, fields))
    without_reuse = dict(fields)
    back = int(task.edges[4, 0])
    without_reuse["travel"] = np.array(fields["travel"])
    without_reuse["travel"][:2, back] = np.inf
    assert solve_exact(problem_of(task, without_reuse)).value > exact.value


@given(seed=st.integers(0, 10**6), formula=st.sampled_from(FORMULAS[:3]))
@settings(max_examples=8, deadline=None)
def test_dead_ends_are_never_better_than_success(seed, formula):
    """A dead end costs more than anything else could: raising its cost never lowers the value, and the value of a
    problem with a sure way is that of the sure way at most."""
    task = task_of(formula)
    fields = random_fields(task, 2, seed)
    values = [solve_exact(problem_of(task, fields | {"dead_end_cost": cost})).value for cost in (1.0, 300.0, 3000.0)]
    assert values == sorted(values)
    fields["finish"] = np.full_like(fields["finish"], 50.0)
    assert solve_exact(problem_of(task, fields)).value <= 50.0


def test_too_large():
    with pytest.raises(ProblemTooLargeError, match="more than 5 states or 60 s with 3 subgoals"):
        solve_exact(random_problem("F a & F b", 3, 1, unreachable=0.0), max_states=5)


def choose_from_the_start(monkeypatch):
    """Let no problem be so small that it is searched breadth first."""
    monkeypatch.setattr(exploration, "_BREADTH", 1)
    monkeypatch.setattr(exploration, "_BATCH", 1)


def _optimum(problem):
    """The optimum, where it is found within a second or two; another example is drawn where it is not."""
    try:
        return solve_exact(problem, max_states=10_000)
    except ProblemTooLargeError:
        reject()


@given(formula=st.sampled_from(FORMULAS), subgoals=st.integers(1, 2), seed=st.integers(0, 10**6))
@settings(max_examples=8, deadline=None)
def test_best_first_search_equals_breadth_first_search(formula, subgoals, seed):
    problem = random_problem(formula, subgoals, seed, unreachable=0.2, backward=bool(seed % 2))
    expected = _optimum(problem)
    with pytest.MonkeyPatch.context() as patch:
        choose_from_the_start(patch)
        found = solve_exact(problem)
    np.testing.assert_allclose(found.q_values, expected.q_values, rtol=1e-9)
    np.testing.assert_allclose(found.dead_end_part, expected.dead_end_part, rtol=1e-6, atol=1e-9)


@given(
    formula=st.sampled_from(FORMULAS),
    subgoals=st.integers(0, 3),
    seed=st.integers(0, 10**6),
    max_states=st.sampled_from([1, 20, 100]),
)
@settings(max_examples=20, deadline=None)
def test_bounds_hold_the_optimum(formula, subgoals, seed, max_states):
    problem = random_problem(formula, subgoals, seed, unreachable=0.3, backward=bool(seed % 2))
    expected = _optimum(problem)
    with pytest.MonkeyPatch.context() as patch:
        choose_from_the_start(patch)
        bounds = bound_exact(problem, max_states=max_states, tolerance=0.0)
    slack = 1e-9 * (1.0 + expected.value)
    assert bounds.lower - slack <= expected.value <= bounds.upper + slack
    finite = np.isfinite(expected.q_values)
    np.testing.assert_array_equal(np.isfinite(bounds.q_lower), finite)
    assert (bounds.q_lower[finite] <= expected.q_values[finite] * (1 + 1e-9)).all()
    assert (bounds.q_upper[finite] >= expected.q_values[finite] * (1 - 1e-9)).all()
    if bounds.exact:
        np.testing.assert_allclose([bounds.lower, bounds.upper], expected.value, rtol=1e-9)


@pytest.mark.parametrize("family", FAMILIES)
def test_bounds_meet_within_the_tolerance(family):
    problem = family_problem(family, 2, "tuning", 1)
    bounds, loose = bound_exact(problem, tolerance=0.0), bound_exact(problem, tolerance=0.05)
    assert bounds.exact
    assert bounds.gap == pytest.approx(0.0, abs=1e-12)
    assert loose.gap <= 0.05
    assert loose.lower <= bounds.lower * (1 + 1e-9) <= loose.upper * (1 + 2e-9)


@pytest.mark.parametrize("formula", FORMULAS)
def test_the_dead_end_part_is_the_slope_in_the_dead_end_cost(formula):
    """As long as the best policy stays the same, the value grows with the cost of dead ends as often as one is met."""
    task = task_of(formula)
    fields = random_fields(task, 2, 3)
    solutions = [solve_exact(problem_of(task, fields | {"dead_end_cost": cost})) for cost in (300.0, 300.125)]
    slope = (solutions[1].value - solutions[0].value) / 0.125
    assert solutions[0].dead_end_part / 300.0 == pytest.approx(slope, abs=1e-6)


def test_no_conditions():
    """A task without any edge to attempt: only finish is left."""
    exact = assert_equals_recursion(random_problem("X a", 2, 0, finish_chance=1.0))
    assert np.isinf(exact.q_values[:-1]).all()
    assert exact.action == len(exact.q_values) - 1
