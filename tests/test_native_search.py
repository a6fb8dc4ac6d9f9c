"""The kernel of best-first search gives the plans and trees of its twin in JAX, bit for bit."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.bench import problems as problems_module
from potlp_jax.bench.problems import FAMILIES, family_problem
from potlp_jax.native import is_usable, status, twin_only
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import plan_actions, search
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.search.graph import Tree
from potlp_jax.planning.search.plan import Plan
from potlp_jax.task.task import TaskSizes
from potlp_jax.types import Status

_search = jax.jit(search, static_argnames="config")
_plan = jax.jit(plan_actions, static_argnames="config")


@pytest.fixture(autouse=True)
def kernel() -> None:
    if not is_usable("search"):
        pytest.skip(status()[0].reason)


def _problems(family: str, subgoals: int, count: int) -> PlanningProblem:
    problems = [family_problem(family, subgoals, "tuning", index) for index in range(count)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)


def _keys(count: int) -> jax.Array:
    return jax.random.split(jax.random.key(0), count)


def _assert_equal_plans(found: Plan, expected: Plan) -> None:
    for field in dataclasses.fields(Plan):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name), err_msg=field.name)


def _assert_equal_trees(found: Tree, expected: Tree) -> None:
    """In all that means something: without the spare node, and without terms of actions that are not available."""
    available = np.isfinite(np.asarray(expected.q_values))
    for field in dataclasses.fields(Tree):
        name, arrays = field.name, [np.asarray(getattr(tree, field.name)) for tree in (found, expected)]
        if name in ("chances", "success_costs"):
            arrays = [np.where(available, array, 0) for array in arrays]
        if name == "children":
            arrays = [np.where(available[..., None], array, 0) for array in arrays]
        if name not in ("table", "root_visits", "size", "simulations", "steps", "status"):
            arrays = [array[:, :-1] for array in arrays]
        np.testing.assert_array_equal(*arrays, err_msg=name)


# One program of the twin serves all families of at most these sizes: it takes seconds to compile. Tests below have
# shapes of their own.
OF_ONE_SHAPE = [name for name in FAMILIES if name != "four" and not name.startswith("shared")]
COMMON = functools.reduce(TaskSizes.union, (FAMILIES[name].sizes for name in OF_ONE_SHAPE))


@pytest.mark.long
@pytest.mark.parametrize("family", FAMILIES)
def test_plans_and_trees_of_both_are_equal_to_the_bit(family, monkeypatch):
    if family in OF_ONE_SHAPE:
        larger = dataclasses.replace(FAMILIES[family], sizes=COMMON)
        monkeypatch.setattr(problems_module, "FAMILIES", {**FAMILIES, family: larger})
    # The twin takes long where many actions are coupled.
    problems, config = _problems(family, 3 if family == "shared-joint" else 4, 6), BestFirstConfig(simulations=60)
    plans, trees = _search(problems, _keys(6), config)
    with twin_only():
        expected_plans, expected_trees = _search(problems, _keys(6), config)
    _assert_equal_plans(plans, expected_plans)
    _assert_equal_trees(trees, expected_trees)


@pytest.mark.long
@pytest.mark.parametrize("settings", [{"tree_capacity": 9}, {"max_depth": 3}, {"optimism": 1.0, "guess_failures": 2}])
def test_both_run_into_the_same_limits_on_twelve_subgoals(settings):
    problems, config = _problems("cubes", 12, 3), BestFirstConfig(simulations=40, **settings)
    plans, trees = _search(problems, _keys(3), config)
    with twin_only():
        expected_plans, expected_trees = _search(problems, _keys(3), config)
    _assert_equal_plans(plans, expected_plans)
    _assert_equal_trees(trees, expected_trees)
    if "optimism" not in settings:
        assert np.any(np.asarray(plans.status) & (Status.TREE_OVERFLOW | Status.DEPTH_OVERFLOW))


@pytest.mark.long
def test_invalid_rows_padded_rows_and_satisfied_rows_are_alike():
    problems = _problems("firefighting", 3, 4)
    problems = dataclasses.replace(
        problems,
        travel=problems.travel.at[0, 3, 0, 0].set(jnp.nan),
        # What the mask takes away may hold anything.
        success_cost=problems.success_cost.at[1, 2].set(jnp.nan),
        subgoal_mask=problems.subgoal_mask.at[1, 2].set(False),
        dfa_state=problems.dfa_state.at[2].set(jnp.argmax(problems.task.accepting[2]).astype(jnp.int32)),
    )
    plans, _ = _search(problems, _keys(4), BestFirstConfig(simulations=30))
    with twin_only():
        expected, _ = _search(problems, _keys(4), BestFirstConfig(simulations=30))
    _assert_equal_plans(plans, expected)
    assert plans.status[0] == Status.INVALID
    assert plans.status[2] == Status.ACCEPTING_ROOT


@pytest.mark.long
def test_either_goes_on_with_the_tree_of_the_other():
    problems, keys = _problems("reuse", 3, 2), _keys(2)
    config = BestFirstConfig(simulations=20, tree_capacity=60)
    with twin_only():
        _, twins_tree = _search(problems, keys, config)
        expected_plans, expected_trees = _search(problems, keys, config, twins_tree)
    plans, trees = _search(problems, keys, config, twins_tree)
    _assert_equal_plans(plans, expected_plans)
    _assert_equal_trees(trees, expected_trees)
    _, own_tree = _search(problems, keys, config)
    with twin_only():
        plans, trees = _search(problems, keys, config, own_tree)
    _assert_equal_plans(plans, expected_plans)


def test_plans_are_the_same_alone_in_vmap_and_in_scan():
    problems, config, key = _problems("shared", 3, 4), BestFirstConfig(simulations=40), jax.random.key(0)
    expected, _ = _search(problems, _keys(4), config)

    def plan(problem: PlanningProblem) -> Plan:
        return _plan(problem, key, config)

    pairs = jax.tree.map(lambda leaf: leaf.reshape(2, 2, *leaf.shape[1:]), problems)
    nested = jax.jit(jax.vmap(jax.vmap(plan)))(pairs)
    _assert_equal_plans(jax.tree.map(lambda leaf: leaf.reshape(4, *leaf.shape[2:]), nested), expected)
    scanned = jax.lax.scan(lambda carry, problem: (carry, plan(problem)), 0, problems)[1]
    _assert_equal_plans(scanned, expected)
    alone = plan(jax.tree.map(lambda leaf: leaf[1], problems))
    _assert_equal_plans(alone, jax.tree.map(lambda leaf: leaf[1], expected))


@pytest.mark.long
def test_a_budget_is_an_argument_of_the_compiled_program():
    """What another configuration would give, row by row, in one program of the kernel and one of the twin."""
    problems, config, most = _problems("two", 4, 5), BestFirstConfig(simulations=60), 60
    budgets = jnp.asarray([0, 1, 20, most, most + 40])
    traced = []

    @jax.jit
    def plan(problems, budgets):
        traced.append(1)
        return jax.vmap(lambda problem, budget: plan_actions(problem, jax.random.key(0), config, budget))(
            problems, budgets
        )

    plans = plan(problems, budgets)
    plan(problems, budgets + 1)
    assert len(traced) == 1
    with twin_only():
        _assert_equal_plans(plan(problems, budgets), plans)
    for row, budget in enumerate([1, 1, 20, most, most]):
        alone = _plan(jax.tree.map(lambda leaf, row=row: leaf[row], problems), jax.random.key(0), _of(budget))
        _assert_equal_plans(jax.tree.map(lambda leaf, row=row: leaf[row], plans), alone)


def _of(budget: int) -> BestFirstConfig:
    return BestFirstConfig(simulations=budget)


def test_no_twin_is_compiled_into_a_program_for_the_cpu():
    leaves, structure = jax.tree.flatten(_problems("find", 2, 2))

    def values(*leaves: jax.Array) -> jax.Array:
        return _search(jax.tree.unflatten(structure, leaves), _keys(2), BestFirstConfig())[0].value

    text = jax.jit(values).lower(*leaves).as_text()
    assert "potlp_best_first" in text
    assert "stablehlo.while" not in text.partition("potlp_best_first")[2]
    with twin_only():
        assert "potlp_best_first" not in jax.jit(values).lower(*leaves).as_text()
