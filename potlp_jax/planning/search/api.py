"""Search of a planning problem for the action of least expected cost (paper section III-C): what callers use.

The type of the configuration chooses the search:

* ``BestFirstConfig``, the default: **best-first search on bounds** over a graph of histories
  (``search.best_first``), of the family of AO*. It is not the paper's search. Deterministic: the key changes nothing.
* ``UctConfig``: **PO-UCT**, the paper's search (``search.uct``), which samples with the caller's key.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, III-C.
  Nilsson, Principles of Artificial Intelligence, 1980 (AO*).
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int32, Key, PRNGKeyArray, UInt32

from potlp_jax.errors import ProblemError
from potlp_jax.planning.problem import PlanningProblem, check_shapes
from potlp_jax.planning.search.best_first import BEST_FIRST
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.planning.search.graph import Tree
from potlp_jax.planning.search.lockstep import SearchMethod, run_search
from potlp_jax.planning.search.plan import Plan
from potlp_jax.planning.search.uct import UCT, UctTree
from potlp_jax.planning.shapes import require_shapes
from potlp_jax.precision import in_32_bits, whole_numbers


@in_32_bits
def plan_actions(
    problem: PlanningProblem,
    key: PRNGKeyArray,
    config: BestFirstConfig | UctConfig = BestFirstConfig(),
    simulations: Int32[Array, ""] | int | None = None,
) -> Plan:
    """Search one problem for the action of least expected cost.

    Pure; jit with ``config`` static. ``jax.vmap`` over ``problem``, ``key`` or both searches all rows in one call. The
    result depends, to the last bit, neither on padding nor on the size of the batch nor on its other rows. Ties go to
    the lowest index. A root without available action, or satisfied, is flagged in ``status``, and so is a problem with
    a value that is not allowed (``problem.screen``): nothing is chosen then. The exact solution (``planning.exact``)
    runs on the host and is the yardstick of both searches.

    Args:
      problem: unbatched.
      key: consumed under ``UctConfig``. Under ``BestFirstConfig`` nothing is drawn and any key gives the same plan; the
        argument is there so that one call serves both.
      config: which search, and its settings. Best-first search ends by itself on a small problem, on a large one after
        ``config.simulations``; ``Plan.lower_bound`` is ``Plan.value`` in the first case. PO-UCT always runs all
        simulations.
      simulations: run so many at most, instead of ``config.simulations``, which still bounds them and fixes the memory;
        less than 1 counts as 1. It may be traced: for another number nothing is compiled, and rows of a ``vmap`` may
        have each its own.

    Returns:
      The plan.

    Raises:
      ProblemError: shapes or types of the problem's arrays do not agree, or ``simulations`` is no whole number.
    """
    return _search_one(problem, key, config, None, simulations, with_trees=False)[0]


@in_32_bits
def search_tree(
    problem: PlanningProblem,
    key: PRNGKeyArray,
    config: BestFirstConfig | UctConfig = BestFirstConfig(),
    tree: Tree | UctTree | None = None,
    simulations: Int32[Array, ""] | int | None = None,
) -> tuple[Plan, Any]:
    """``plan_actions`` together with the searched tree.

    Args:
      problem: unbatched.
      key: as in ``plan_actions``.
      config: as in ``plan_actions``.
      tree: of an earlier search of the same problem with the same kind of configuration, key and tree capacity. The
        search goes on with it for ``config.simulations`` more, and ends where one search of all of them would.
      simulations: as in ``plan_actions``; of this call, not of the tree's earlier ones.

    Returns:
      The plan and the tree: ``Tree`` under ``BestFirstConfig``, ``UctTree`` under ``UctConfig``.

    Raises:
      ProblemError: shapes or types of the problem's arrays do not agree, ``simulations`` is no whole number, or the
        tree is of another search, capacity or size of problem.
    """
    return _search_one(problem, key, config, tree, simulations, with_trees=True)


@in_32_bits
def search(
    problems: PlanningProblem,
    keys: Key[Array, "B"],
    config: BestFirstConfig | UctConfig = BestFirstConfig(),
    trees: Tree | UctTree | None = None,
    simulations: Int32[Array, "B"] | None = None,
) -> tuple[Plan, Any]:
    """``search_tree`` for a batch.

    Args:
      problems: every leaf has the leading axis B.
      keys: one per problem.
      config: as in ``plan_actions``, the same for all rows.
      trees: as in ``search_tree``, every leaf with the leading axis B.
      simulations: as in ``plan_actions``, one number a row.

    Returns:
      Plans and trees with the leading axis B.

    Raises:
      ProblemError: as in ``search_tree``.
    """
    check_shapes(problems, keys.shape)
    _check_tree(trees, problems, config, keys.shape)
    budgets = _budgets(simulations, keys.shape)
    seeds = jax.vmap(_seed)(keys)
    return run_search(_search_for(config), config, problems, seeds, trees, budgets=budgets)


def _search_one(
    problem: PlanningProblem,
    key: PRNGKeyArray,
    config: BestFirstConfig | UctConfig,
    tree: Tree | UctTree | None,
    simulations: Int32[Array, ""] | int | None,
    with_trees: bool,
) -> tuple[Plan, Any]:
    check_shapes(problem)
    _check_tree(tree, problem, config, ())
    budget = _budgets(simulations, ())
    # One problem is a batch of one: there is one kernel.
    problems, seeds, trees, budgets = jax.tree.map(lambda leaf: leaf[None], (problem, _seed(key), tree, budget))
    found = run_search(_search_for(config), config, problems, seeds, trees, with_trees, budgets)
    return jax.tree.map(lambda leaf: leaf[0], found)


def _budgets(simulations: Int32[Array, "*B"] | int | None, batch: tuple[int, ...]) -> Int32[Array, "*B"] | None:
    """The simulations that were asked for; raises ProblemError for what is no whole number for each problem."""
    if simulations is None:
        return None
    budgets = whole_numbers(simulations, "simulations", ProblemError)
    require_shapes({"simulations": (budgets, batch)}, "one number for each problem")
    return budgets


def _check_tree(
    tree: Tree | UctTree | None, problem: PlanningProblem, config: BestFirstConfig | UctConfig, batch: tuple[int, ...]
) -> None:
    """Raise ProblemError, while tracing, for a tree that this search cannot go on with."""
    if tree is None:
        return
    wanted, settings = _search_for(config).tree, type(config).__name__
    if not isinstance(tree, wanted):
        raise ProblemError(f"the tree is of type {type(tree).__name__}; {settings} goes on with {wanted.__name__}")
    # Behind the nodes lies one spare node.
    shape = (*batch, config.capacity + 1, problem.action_count)
    why = f"a tree of {config.capacity} nodes (the capacity of {settings}) and {problem.action_count} actions"
    require_shapes({"tree.q_values": (tree.q_values, shape)}, why)


def plan_within(
    problem: PlanningProblem, key: PRNGKeyArray, seconds: float, config: BestFirstConfig | UctConfig = BestFirstConfig()
) -> tuple[Plan, Any]:
    """Search one problem until the time is up, the tree is full, or more simulations change nothing.

    Host only. Runs ``config.simulations`` at a time, at least once. The time to compile does not count.

    Args:
      problem: unbatched.
      key: as in ``plan_actions``.
      seconds: wall time for the search, positive.
      config: static. ``tree_capacity`` must be set: it bounds the nodes of all rounds together.

    Returns:
      Plan and tree of the last round.

    Raises:
      ValueError: ``seconds`` is not positive, or ``tree_capacity`` is None.
    """
    if not seconds > 0:
        raise ValueError(f"seconds is {seconds}, must be positive")
    if config.tree_capacity is None:
        raise ValueError(
            f"plan_within needs {type(config).__name__}.tree_capacity: memory is fixed before the search begins"
        )
    # Each function is run once before the clock starts, so that it is compiled.
    _, warm = _first(problem, key, config=config)
    jax.block_until_ready(_more(problem, key, warm, config=config))
    spent, plan, tree = _timed(_first, problem, key, config=config)
    # A round begins as long as time is left, so the last one may end late by its own length.
    while spent < seconds and float(plan.value) > float(plan.lower_bound) and int(tree.size) < config.tree_capacity:
        simulations = int(tree.simulations)
        step, plan, tree = _timed(_more, problem, key, tree, config=config)
        spent += step
        # Where nothing can be done there is nothing to simulate.
        if int(tree.simulations) == simulations:
            break
    return plan, tree


def _timed(function: Any, *arguments: Any, config: BestFirstConfig | UctConfig) -> tuple[float, Plan, Any]:
    began = time.perf_counter()
    plan, tree = jax.block_until_ready(function(*arguments, config=config))
    return time.perf_counter() - began, plan, tree


def _search_for(config: BestFirstConfig | UctConfig) -> SearchMethod:
    return UCT if isinstance(config, UctConfig) else BEST_FIRST


def _seed(key: PRNGKeyArray) -> UInt32[Array, "2"]:
    """What the searches' own counter-based generator starts from (``arrays.uniform``)."""
    return jax.random.bits(key, (2,), jnp.uint32)


_first = jax.jit(search_tree, static_argnames="config")
# The tree is donated: a round updates it in place instead of copying it.
_more = jax.jit(
    lambda problem, key, tree, config: search_tree(problem, key, config, tree),
    static_argnames="config",
    donate_argnames="tree",
)
