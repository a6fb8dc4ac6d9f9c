"""PO-UCT, the paper's search: against a literal Python version and the exact solver; batching, padding, keys."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.bench.problems import family_problem
from potlp_jax.planning.exact.api import solve_exact
from potlp_jax.planning.search.api import plan_actions, plan_within, search, search_tree
from potlp_jax.planning.search.arrays import uniform
from potlp_jax.planning.search.config import UctConfig
from potlp_jax.planning.search.inspect import tree_top
from potlp_jax.task.task import TaskSizes
from potlp_jax.types import NO_ACTION, Status
from tests.reference.planning import ReferenceProblem, literal_pouct
from tests.reference.problems import FORMULAS, SIZES, padded_problem, plan_many, problem_of, random_fields, task_of

pytestmark = pytest.mark.numbers

SUBGOALS = 2
QUICK = UctConfig(simulations=300)
tree_jit = jax.jit(search_tree, static_argnames="config")


def shared_shape(formula, seed, **options):
    """A random problem in the shape that all tests of this file share, so that they share compilations."""
    task = task_of(formula)
    return padded_problem(task, random_fields(task, SUBGOALS, seed, **options), SIZES, SUBGOALS)


def keys(count):
    return jax.random.split(jax.random.key(0), count)


def assert_same(first, second):
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.fixture(scope="module")
def problems():
    return [shared_shape(FORMULAS[i % len(FORMULAS)], i, unreachable=0.5) for i in range(2 * len(FORMULAS))]


@pytest.fixture(scope="module")
def plans(problems):
    return plan_many(problems, keys(len(problems)), QUICK)


def uniforms(key, simulations, levels):
    """The random numbers of a search with this key, ``[simulation, level]``."""
    seeds = jnp.broadcast_to(jax.random.bits(key, (1, 2), jnp.uint32), (simulations, 2))
    draw = jax.vmap(uniform, in_axes=(None, None, 0), out_axes=1)
    steps = jnp.arange(simulations, dtype=jnp.int32), jnp.arange(levels, dtype=jnp.int32)
    return np.asarray(draw(seeds, *steps), np.float64)


@pytest.mark.parametrize(("formula", "seed"), [("F g", 0), ("F a & F b", 1), ("F(a & X b)", 2), ("F(a & (b | c))", 3)])
def test_equals_a_literal_version(formula, seed):
    """Same random numbers, same visits and means at the root, action by action."""
    problem, key = shared_shape(formula, seed, unreachable=0.1), jax.random.key(seed)
    plan, tree = tree_jit(problem, key, config=QUICK)
    numbers = uniforms(key, QUICK.simulations, 12)
    reference = ReferenceProblem(problem)
    visits, means = literal_pouct(
        reference, QUICK.simulations, QUICK.exploration, lambda simulation, level: numbers[simulation, level]
    )
    for action, count in visits.items():
        assert int(plan.visits[reference.index(action)]) == count
        np.testing.assert_allclose(plan.q_values[reference.index(action)], means[action], rtol=1e-4)
    most = max(visits.values())
    assert int(plan.action) == min(reference.index(a) for a, count in visits.items() if count == most)
    assert float(plan.value) == float(plan.q_values[plan.action])
    assert np.isinf(plan.optimism_gap)
    assert int(tree.steps) > QUICK.simulations


@pytest.mark.long
@pytest.mark.parametrize(("formula", "seed"), [("F g", 0), ("F a & F b", 1), ("F(a & X b)", 2)])
def test_converges_to_the_exact_solution(formula, seed):
    """With exploration in proportion to the costs, of which the largest is a dead end (300), as the theory asks."""
    problem = shared_shape(formula, seed, unreachable=0.1)
    exact = solve_exact(problem)
    few, many = (
        jax.jit(jax.vmap(lambda key, config=config: plan_actions(problem, key, config)))(keys(8))
        for config in (
            UctConfig(simulations=30, exploration=200.0),
            UctConfig(simulations=20_000, exploration=200.0, tree_capacity=2000),
        )
    )
    error_of_few, error_of_many = (np.abs(np.asarray(plan.value) / exact.value - 1.0).mean() for plan in (few, many))
    assert error_of_many < 0.02 < error_of_few
    np.testing.assert_array_equal(many.action, exact.action)


@pytest.mark.long
def test_regret_falls_with_simulations():
    """On tuning problems of the benchmark, in one batch that goes on with its trees."""
    problems = [family_problem("two", 2, "tuning", index) for index in range(12)]
    truths = [solve_exact(problem).q_values for problem in problems]
    batch, config = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems), UctConfig(20, tree_capacity=2001)
    run = jax.jit(search, static_argnames="config")
    plans, trees = run(batch, keys(12), config=config)

    def regret(plans):
        return np.mean([q[int(action)] / q.min() - 1.0 for q, action in zip(truths, plans.action, strict=True)])

    first = regret(plans)
    for _ in range(99):
        plans, trees = run(batch, keys(12), config=config, trees=trees)
    np.testing.assert_array_equal(trees.simulations, 2000)
    assert regret(plans) < 0.5 * first


def test_the_key_drives_the_samples():
    problem = shared_shape("F((a | b) & X(b | c))", 0, unreachable=0.0)
    first, again, other = (tree_jit(problem, jax.random.key(seed), config=QUICK) for seed in (1, 1, 2))
    assert_same(first, again)
    assert not np.array_equal(first[1].children, other[1].children)


@pytest.mark.long
def test_a_search_goes_on_where_it_stopped():
    problem = shared_shape("F a & F b", 3, unreachable=0.1)
    half = UctConfig(simulations=40, tree_capacity=90)
    one = tree_jit(problem, jax.random.key(0), config=dataclasses.replace(half, simulations=80))
    _, tree = tree_jit(problem, jax.random.key(0), config=half)
    assert_same(one, tree_jit(problem, jax.random.key(0), config=half, tree=tree))
    assert int(one[1].simulations) == 80


@pytest.mark.parametrize("exploration", [float("inf"), float("nan"), -1.0])
def test_the_weight_of_exploration_is_finite(exploration):
    """With infinity the first action would be taken again and again."""
    with pytest.raises(ValueError, match=r"UctConfig.exploration is .*, must be finite and not negative"):
        UctConfig(exploration=exploration)


def test_seconds_as_the_budget():
    problem = shared_shape("F a & F b", 3, unreachable=0.1)
    plan, tree = plan_within(problem, jax.random.key(0), 600.0, UctConfig(simulations=50, tree_capacity=60))
    assert int(tree.size) == 60
    assert int(plan.visits.sum()) % 50 == 0
    with pytest.raises(ValueError, match=r"UctConfig\.tree_capacity"):
        plan_within(problem, jax.random.key(0), 1.0, UctConfig())


def test_vmap_equals_loop(problems, plans):
    """Rows differ in task, actions, depth and sample: what one does must not show in another."""
    for i, key in enumerate(keys(len(problems))):
        assert_same(tree_jit(problems[i], key, config=QUICK)[0], jax.tree.map(lambda leaf, i=i: leaf[i], plans))


def test_batched_search_equals_vmap(problems, plans):
    batch, _ = search(jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems), keys(len(problems)), QUICK)
    assert_same(batch, plans)


@pytest.mark.long
def test_nested_vmap_equals_loop():
    problem = shared_shape("F a & F b", 3)
    grid = keys(6).reshape(2, 3)
    nested = jax.jit(jax.vmap(jax.vmap(lambda key: plan_actions(problem, key, QUICK))))(grid)
    for i in range(2):
        for j in range(3):
            alone = tree_jit(problem, grid[i, j], config=QUICK)[0]
            assert_same(alone, jax.tree.map(lambda leaf, i=i, j=j: leaf[i, j], nested))


@pytest.mark.parametrize("formula", ["F(a & X b)", "F((a | b) & X(b | c))"])
def test_padding_changes_nothing(formula):
    """States, edges, classes, conditions, cubes and subgoals: same samples, same choice, same bits."""
    task = task_of(formula)
    fields = random_fields(task, 2, 5, unreachable=0.1)
    plain = plan_actions(problem_of(task, fields), jax.random.key(3), QUICK)
    sizes = TaskSizes(states=7, propositions=4, edges=9, classes=40, compound=3, cubes=3)
    padded = plan_actions(padded_problem(task, fields, sizes, 4), jax.random.key(3), QUICK)
    real = [9 * s + e for s in range(2) for e in range(len(task.edges))] + [4 * 9]
    assert float(plain.value) == float(padded.value)
    np.testing.assert_array_equal(plain.q_values, padded.q_values[jnp.array(real)])
    np.testing.assert_array_equal(plain.visits, padded.visits[jnp.array(real)])
    assert real[int(plain.action)] == int(padded.action)
    assert np.isinf(np.delete(np.asarray(padded.q_values), real)).all()


@pytest.mark.long
def test_each_action_is_tried_once_first():
    """An action without a rollout has no mean, and is never chosen."""
    problem = shared_shape("F a & F b", 3, unreachable=0.0)
    available = int((plan_actions(problem, jax.random.key(0), QUICK).visits > 0).sum())
    one_each = plan_actions(problem, jax.random.key(0), UctConfig(simulations=available))
    assert int(one_each.visits.max()) == 1
    assert int(one_each.visits.sum()) == available
    fewer = plan_actions(problem, jax.random.key(0), UctConfig(simulations=2))
    assert int(np.isfinite(fewer.q_values).sum()) == 2
    assert np.isfinite(fewer.q_values[fewer.action])


@pytest.mark.long
def test_each_row_has_its_own_budget():
    problem, budgets = shared_shape("F a & F b", 3, unreachable=0.0), [1, 7, 40]
    plan = jax.jit(jax.vmap(lambda budget: plan_actions(problem, jax.random.key(0), QUICK, budget)))
    for row, budget in enumerate(budgets):
        alone = plan_actions(problem, jax.random.key(0), UctConfig(simulations=budget))
        np.testing.assert_array_equal(plan(jnp.asarray(budgets)).q_values[row], alone.q_values)


def test_satisfied_and_boxed_in():
    task = task_of("F a & F b")
    fields = random_fields(task, 2, 0)
    fields["travel"][-1], fields["finish"][-1] = np.inf, np.inf
    dead = tree_jit(padded_problem(task, fields, SIZES, SUBGOALS), jax.random.key(0), config=QUICK)[0]
    assert (int(dead.action), float(dead.value), int(dead.status)) == (NO_ACTION, 300.0, Status.DEAD_END)
    fields["dfa_state"] = int(np.flatnonzero(task.dfa.accepting)[0])
    done = tree_jit(padded_problem(task, fields, SIZES, SUBGOALS), jax.random.key(0), config=QUICK)[0]
    assert (int(done.action), float(done.value), int(done.status)) == (NO_ACTION, 0.0, Status.ACCEPTING_ROOT)


def test_full_tree_and_deep_rollout_are_flagged():
    task = task_of("F a & F b")
    fields = random_fields(task, 2, 0, unreachable=0.0, finish_chance=0.0)
    fields |= {"dfa_state": 0, "success_probability": np.full((2, 5), 0.5)}
    problem = padded_problem(task, fields, SIZES, SUBGOALS)
    plan, tree = tree_jit(problem, jax.random.key(0), config=UctConfig(simulations=64, tree_capacity=2))
    assert int(plan.status) == Status.TREE_OVERFLOW
    assert int(tree.size) == 2
    plan, _ = tree_jit(problem, jax.random.key(0), config=UctConfig(simulations=64, max_depth=1))
    assert int(plan.status) == Status.DEPTH_OVERFLOW
    plan, _ = tree_jit(problem, jax.random.key(0), config=QUICK)
    assert int(plan.status) == Status.OK


def test_tree_top_shows_the_means():
    problem = shared_shape("F a & F b", 3, unreachable=0.1)
    plan, tree = tree_jit(problem, jax.random.key(0), config=QUICK)
    top = tree_top(problem, tree, depth=2, width=100)
    assert sum(action["visits"] for action in top["actions"]) == QUICK.simulations
    for action in top["actions"]:
        assert action["q_value"] == pytest.approx(float(plan.q_values[action["index"]]))
        assert action["visits"] == int(plan.visits[action["index"]])


def test_exploration_is_checked():
    with pytest.raises(ValueError, match=r"UctConfig\.exploration is -1"):
        UctConfig(exploration=-1.0)
