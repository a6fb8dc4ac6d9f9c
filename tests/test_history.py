"""What a rollout knows: closure, availability, costs; against brute force over assignments."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.planning.exact.rollouts import Rollouts
from potlp_jax.planning.history import action_terms, initial_history, pack_bits, step, unpack_bits
from tests.reference.planning import FINISH, ReferenceProblem
from tests.reference.problems import FORMULAS, SIZES, padded_problem, problem_of, random_fields, task_of

SUBGOALS = 3
terms_jit, step_jit = jax.jit(action_terms), jax.jit(step)


@partial(jax.jit, static_argnames="count")
def unpacked(history, count):
    return unpack_bits(history.holds, count), unpack_bits(history.fails, count)


@given(st.lists(st.booleans(), max_size=70))
@settings(max_examples=30, deadline=None)
def test_packing_is_inverted(flags):
    words = pack_bits(jnp.asarray(np.array(flags, bool)))
    assert words.shape == (max(1, -(-len(flags) // 32)),)
    assert unpack_bits(words, len(flags)).tolist() == flags


@given(formula=st.sampled_from(FORMULAS), seed=st.integers(0, 10**6))
@settings(max_examples=40, deadline=None)
def test_random_rollouts_agree_with_brute_force(formula, seed):
    """Knowledge is exactly what all assignments agree on; availability and terms follow; every rollout ends."""
    task, rng = task_of(formula), np.random.default_rng(seed)
    fields = random_fields(task, SUBGOALS, seed, unreachable=0.1)
    problem = padded_problem(task, fields, SIZES, SUBGOALS)
    reference, rollouts = ReferenceProblem(problem), Rollouts(problem)
    history, position, events = initial_history(problem), rollouts.root(), []
    for _ in range(60):
        terms = terms_jit(problem, history)
        available = np.flatnonzero(terms.available).tolist()
        expected = {reference.index(action): action for action in reference.actions(events)}
        assert available == list(expected) == list(rollouts.available(position))
        check_knowledge(problem, history, position, reference, events)
        check_terms(terms, history, reference, rollouts, position, events, expected)
        choices = [index for index in available if expected[index] != FINISH]
        if not choices:
            return
        index = int(rng.choice(choices))
        probability = float(terms.success_probability[index])
        success = probability == 1 or bool(rng.random() < 0.4)
        history = step_jit(problem, history, jnp.int32(index), jnp.asarray(success))
        position = rollouts.step(position, index, success)
        events.append((expected[index], success))
    pytest.fail(f"the rollout did not end: {events}")


def check_knowledge(problem, history, position, reference, events):
    conditions = problem.task.condition_mask.shape[0]
    holds, fails = (np.asarray(flags) for flags in unpacked(history, conditions))
    assert not np.any(holds & fails)
    for s in range(SUBGOALS):
        known = reference.knowledge(events, s)
        assert {m for m in range(conditions) if holds[s, m]} == {m for m, truth in known.items() if truth}
        assert {m for m in range(conditions) if fails[s, m]} == {m for m, truth in known.items() if not truth}
        known = position.knowledge[s]
        assert known.holds == sum(1 << m for m in range(conditions) if holds[s, m])
        assert known.fails == sum(1 << m for m in range(conditions) if fails[s, m])


def check_terms(terms, history, reference, rollouts, position, events, actions):
    location, state, pending_cost = reference.situation(events)
    assert (int(history.location), int(history.state)) == (location, state) == (position.location, position.state)
    np.testing.assert_allclose(history.pending_cost, pending_cost, rtol=1e-5)
    for index, action in actions.items():
        values = [terms.success_probability, terms.success_cost, terms.failure_cost]
        expected = reference.estimate(events, action)
        np.testing.assert_allclose([value[index] for value in values], expected, rtol=1e-5)
        np.testing.assert_allclose(rollouts.terms(position, index)[:3], expected, rtol=1e-9)
        np.testing.assert_allclose(terms.distance[index], reference.distance(events, action), rtol=1e-5)


@pytest.mark.parametrize(
    ("formula", "words"), [("F a & F b & F c", 1), ("F a & F b & F(c | d)", 2), ("F a & F b & F c & F d", 3)]
)
def test_more_conditions_than_brute_force_can_take(formula, words):
    """19, 37 (some of several cubes) and 65 conditions: bit masks in words against Python integers."""
    task, rng = task_of(formula), np.random.default_rng(0)
    problem = problem_of(task, random_fields(task, 2, 0, unreachable=0.0))
    conditions = problem.task.condition_mask.shape[0]
    assert initial_history(problem).holds.shape[-1] == words
    rollouts = Rollouts(problem)
    for _ in range(3):
        history, position = initial_history(problem), rollouts.root()
        for _ in range(12):
            terms = terms_jit(problem, history)
            available = np.flatnonzero(terms.available)
            assert available.tolist() == list(rollouts.available(position))
            holds, fails = (np.asarray(flags) for flags in unpacked(history, conditions))
            assert not np.any(holds & fails)
            for s, known in enumerate(position.knowledge):
                assert known.holds == sum(1 << int(m) for m in np.flatnonzero(holds[s]))
                assert known.fails == sum(1 << int(m) for m in np.flatnonzero(fails[s]))
            available = available[available < problem.action_count - 1]
            if not len(available):
                break
            index = int(rng.choice(available))
            success = float(terms.success_probability[index]) == 1 or bool(rng.random() < 0.3)
            history = step_jit(problem, history, jnp.int32(index), jnp.asarray(success))
            position = rollouts.step(position, index, success)


def test_several_cubes_leave_the_last_one():
    """a & (b | c): the condition holds beyond the subgoal, one cube does not, so the other does."""
    task = task_of("F(a & (b | c))")
    fields = random_fields(task, 1, 0)
    fields["success_probability"] = np.full((1, 2), 0.5)
    problem = problem_of(task, fields)
    rollouts = Rollouts(problem)
    closure = rollouts.closure
    known = closure.add_outcome(rollouts.root().knowledge[0], 2, True)
    assert known.holds == 0b100
    assert closure.add_outcome(known, 0, False) == (0b110, 0b001)


def after(problem, *events):
    """The history after attempts at the first subgoal, each an edge and its outcome."""
    history = initial_history(problem)
    for edge, success in events:
        history = step_jit(problem, history, jnp.int32(edge), jnp.asarray(success))
    return history


def known(problem, history):
    """Conditions that hold and that fail at the first subgoal."""
    holds, fails = unpacked(history, problem.task.condition_mask.shape[0])
    return set(np.flatnonzero(holds[0]).tolist()), set(np.flatnonzero(fails[0]).tolist())


def even_chances(formula):
    """A problem with one subgoal where everything is within reach and succeeds in half of the cases."""
    task = task_of(formula)
    fields = random_fields(task, 1, 0, unreachable=0.0)
    fields["success_probability"] = np.full((1, len(task.classes)), 0.5)
    return task, problem_of(task, fields)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_condition_fails_with_the_last_of_its_cubes(order):
    """From three states the same letters lead on: from two of them by one of two cubes each, from the third by both."""
    task, problem = even_chances("(a & F(a & b)) | (!b U c)")
    conditions = task.outcomes.edge_condition.tolist()
    either = next(edge for edge, m in enumerate(conditions) if len(task.conditions[m].classes) == 2)
    cubes = task.conditions[conditions[either]].classes
    # The failure of which edge's condition says that a cube fails.
    edges = [next(e for e, m in enumerate(conditions) if task.outcomes.implies[c, m] and e != either) for c in cubes]
    assert not any(task.outcomes.implies[conditions[either], conditions[edge]] for edge in edges)
    once = after(problem, (edges[order[0]], False))
    assert cubes[order[0]] in known(problem, once)[1]
    assert conditions[either] not in known(problem, once)[1]
    assert float(terms_jit(problem, once).success_probability[either]) == 0.5
    twice = after(problem, *((edges[place], False) for place in order))
    assert {*cubes, conditions[either]} <= known(problem, twice)[1]
    assert float(terms_jit(problem, twice).success_probability[either]) == 0.0


def test_a_condition_that_holds_is_certain_before_it_is_known_which_cube():
    task, problem = even_chances("F((a | b) & X F a)")
    conditions = task.outcomes.edge_condition.tolist()
    either = next(edge for edge, m in enumerate(conditions) if len(task.conditions[m].classes) == 2)
    assert float(terms_jit(problem, initial_history(problem)).success_probability[either]) == 0.75
    history = after(problem, (either, True))
    assert not known(problem, history)[0] & set(task.conditions[conditions[either]].classes)
    terms = terms_jit(problem, history)
    assert bool(terms.certain[either])
    assert float(terms.success_probability[either]) == 1.0


def test_where_one_of_two_cubes_must_hold_and_one_fails_the_other_holds():
    task, problem = even_chances("F((a | b) & X F a)")
    conditions = task.outcomes.edge_condition.tolist()
    either = next(edge for edge, m in enumerate(conditions) if len(task.conditions[m].classes) == 2)
    cubes = set(task.conditions[conditions[either]].classes)
    single = next(edge for edge in range(len(conditions)) if edge != either)
    (ruled_out,) = [c for c in cubes if task.outcomes.implies[c, conditions[single]]]
    holds, fails = known(problem, after(problem, (either, True), (single, False)))
    assert ruled_out in fails
    assert cubes - {ruled_out} <= holds


def test_success_is_certain_the_second_time_and_owes_the_way_back():
    task = task_of("F(a & F(b & F a))")
    fields = random_fields(task, 2, 0, unreachable=0.0)
    fields["dfa_state"], fields["success_probability"] = 0, np.full((2, 5), 0.5)
    problem = padded_problem(task, fields, SIZES, SUBGOALS)
    first = edge_of(task, 0, 1)
    start = terms_jit(problem, initial_history(problem))
    assert float(start.success_probability[first]) == 0.5
    assert float(start.distance[first]) == float(problem.travel[SUBGOALS, 0, 0, 0])
    history = step_jit(problem, initial_history(problem), jnp.int32(first), jnp.asarray(True))
    assert (int(history.location), int(history.state)) == (0, 1)
    cost_of_a = float(problem.success_cost[0, int(task.arrays.edge_condition[first])])
    assert float(history.pending_cost) == cost_of_a
    terms = terms_jit(problem, history)
    inside, outside = edge_of(task, 1, 3), edge_of(task, 1, 3) + problem.edge_count
    assert float(terms.distance[inside]) == 0.0
    np.testing.assert_allclose(terms.distance[outside], cost_of_a + problem.travel[0, 1, 1, 1], rtol=1e-6)
    history = step_jit(problem, history, jnp.int32(outside), jnp.asarray(True))
    last = edge_of(task, 3, 2)
    terms = terms_jit(problem, history)
    assert bool(terms.certain[last])
    assert float(terms.success_probability[last]) == 1.0
    assert not bool(terms.certain[last + problem.edge_count])


def test_live_cycle_is_not_walked_twice():
    """F(a & X b): with both edges of the cycle known to hold, neither may lead back."""
    task = task_of("F(a & X b)")
    fields = random_fields(task, 1, 0, unreachable=0.0, finish_chance=0.0)
    fields["dfa_state"], fields["success_probability"] = 0, np.full((1, 3), 0.5)
    problem = padded_problem(task, fields, SIZES, SUBGOALS)
    out, back = edge_of(task, 0, 1), edge_of(task, 1, 0)
    history = initial_history(problem)
    for action in (out, back):
        assert bool(terms_jit(problem, history).available[action])
        history = step_jit(problem, history, jnp.int32(action), jnp.asarray(True))
    terms = terms_jit(problem, history)
    assert bool(terms.certain[out])
    assert bool(terms.available[out])  # certain, but the rollout has learnt something since it was there
    history = step_jit(problem, history, jnp.int32(out), jnp.asarray(True))
    assert not bool(terms_jit(problem, history).available[back])


def test_certain_condition_of_impossible_cubes_costs_its_cheapest():
    """Estimates may contradict an outcome: a & b & !c beyond the subgoal implies a, whatever P_S of a says."""
    task = task_of("F a & F b")
    both, only_a = edge_of(task, 0, 3), edge_of(task, 1, 3)
    fields = random_fields(task, 1, 0, unreachable=0.0)
    fields["dfa_state"], fields["success_probability"] = 0, np.full((1, 5), 0.5)
    condition = int(task.arrays.edge_condition[only_a])
    fields["success_probability"][0, condition] = 0.0
    problem = padded_problem(task, fields, SIZES, SUBGOALS)
    assert bool(task.arrays.implies[int(task.arrays.edge_condition[both]), condition])
    history = step_jit(problem, initial_history(problem), jnp.int32(both), jnp.asarray(True))
    history = history.replace(state=jnp.int32(1))
    terms = terms_jit(problem, history)
    assert float(terms.success_probability[only_a]) == 1.0
    assert float(terms.success_cost[only_a]) == float(problem.success_cost[0, condition])


def edge_of(task, source, target):
    """Index of an edge; also the action at the first subgoal."""
    return task.edges.tolist().index([source, target])
