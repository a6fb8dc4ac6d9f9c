"""PO-UCT over the histories of a planning problem (paper section III-C): what callers see of it.

What differs from PO-UCT as published, in the default mode:

* P_S is known, so values are expectations over both outcomes and minima over actions (Eq. 3 itself) instead of means
  of samples; outcomes not yet seen have a guessed value (``heuristic``).
* Orders of the same events lead to the same node.
* Instead of sampling, a descent takes the action that is best if every guess is too high by a fraction ``optimism``,
  and of its outcomes the one that contributes most to this gap. Once no gap is left at the root the search ends: every
  outcome of every choice that could be best has been seen.

``SearchMode.AUTHORS_CODE`` searches as the authors' code does. ``jax.vmap`` of the unbatched functions is routed to the
kernel (``search_kernel``), also nested.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, III-C.
  Silver and Veness, Monte-Carlo Planning in Large POMDPs, NIPS 2010.
  Childs, Brodeur and Kocsis, Transpositions and Move Groups in Monte Carlo Tree Search, CIG 2008.
  McMahan, Likhachev and Gordon, Bounded Real-Time Dynamic Programming, ICML 2005: outcomes chosen by their gap.
"""

import dataclasses
import functools
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, Key, PRNGKeyArray, UInt32

from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.best_first import choose, is_open, simulate
from potlp_jax.planning.search.graph import SearchConfig, Tree, new_search, prepare


@struct.dataclass(kw_only=True)
class Plan:
    """Answer to one planning problem.

    Attributes:
      action: ``s * E + e``, ``S * E`` for finish, or ``NO_ACTION`` (``status`` tells why).
      subgoal: the action's subgoal, ``NO_SUBGOAL`` for finish and for none.
      from_state: state z' in which to reach the subgoal, ``NO_STATE`` for finish and for none.
      to_state: state z'' to try for beyond it, ``NO_STATE`` for finish and for none.
      value: expected cost of the action; 0 where the task is satisfied, the dead-end cost at a dead end.
      q_values: expected cost of each action, inf where it is not available.
      visits: simulations that began with each action.
      gap: convergence: the part of ``value`` by which it might still fall if all that was guessed on the way to it were
        too high by the search's optimism (``SearchConfig``). 0: nothing is left to look at. inf in the mode
        ``AUTHORS_CODE``.
      status: bits of ``types.Status``.
    """

    action: Int32[Array, "*B"]
    subgoal: Int32[Array, "*B"]
    from_state: Int32[Array, "*B"]
    to_state: Int32[Array, "*B"]
    value: Float32[Array, "*B"]
    q_values: Float32[Array, "*B A"]
    visits: Int32[Array, "*B A"]
    gap: Float32[Array, "*B"]
    status: UInt32[Array, "*B"]


def plan_actions(problem: PlanningProblem, key: PRNGKeyArray, config: SearchConfig = SearchConfig()) -> Plan:
    """Search one problem for the action of least expected cost (paper section III-C).

    One method serves problems of every size: a small one ends by itself once nothing is left to look at, a large one
    after ``config.simulations``; ``Plan.gap`` tells which. The exact solution (``exact``) runs on the host and is the
    yardstick of both.

    Pure; jit with ``config`` static. ``jax.vmap`` over ``problem``, ``key`` or both runs the rows in lockstep. The
    result depends on the problem and the configuration alone (in the mode ``AUTHORS_CODE`` on the key too), not on
    padding or on other rows of a batch. Ties go to the lowest index. A root without available action, or satisfied,
    is flagged in ``status``.
    """
    return search_tree(problem, key, config)[0]


def search_tree(
    problem: PlanningProblem, key: PRNGKeyArray, config: SearchConfig = SearchConfig(), tree: Tree | None = None
) -> tuple[Plan, Tree]:
    """``plan_actions`` together with the searched tree.

    With the ``tree`` of an earlier search of the same problem with the same key and tree capacity, that search goes on
    for ``config.simulations`` more, and ends where one search of all of them would.
    """
    alone = None if tree is None else jax.tree.map(lambda leaf: leaf[None], tree)
    leaves, structure = jax.tree.flatten(problem)
    arrays = _run(structure, config, _seed(key)[None], [leaf[None] for leaf in leaves], alone)
    return _as_result([array[0] for array in arrays])


def search(
    problems: PlanningProblem,
    keys: Key[Array, "B"],
    config: SearchConfig = SearchConfig(),
    trees: Tree | None = None,
) -> tuple[Plan, Tree]:
    """``search_tree`` for a batch: every leaf of ``problems``, ``keys`` and ``trees`` has the same leading axis B."""
    leaves, structure = jax.tree.flatten(problems)
    return _as_result(_run(structure, config, jax.vmap(_seed)(keys), leaves, trees))


def plan_within(
    problem: PlanningProblem, key: PRNGKeyArray, seconds: float, config: SearchConfig = SearchConfig()
) -> tuple[Plan, Tree]:
    """Search one problem until the time is up, the tree is full, or nothing is left to look at.

    Host only. Runs ``config.simulations`` at a time, at least once; ``config.tree_capacity`` bounds them all. What it
    takes to compile does not count.

    Args:
      problem: unbatched.
      key: as in ``plan_actions``.
      seconds: wall time for the search, positive.
      config: static; ``tree_capacity`` must be set.

    Raises:
      ValueError: ``seconds`` is not positive, or ``tree_capacity`` is None.
    """
    if not seconds > 0:
        raise ValueError(f"seconds is {seconds}, must be positive")
    if config.tree_capacity is None:
        raise ValueError("plan_within needs SearchConfig.tree_capacity: memory is fixed before the search begins")
    # Compile first, by running each function once.
    _, warm = _first(problem, key, config=config)
    jax.block_until_ready(_more(problem, key, warm, config=config))
    spent, plan, tree = _timed(_first, problem, key, config=config)
    while spent < seconds and float(plan.gap) > 0 and int(tree.size) < config.tree_capacity:
        step, plan, tree = _timed(_more, problem, key, tree, config=config)
        spent += step
    return plan, tree


def _timed(search: Any, *arguments: Any, config: SearchConfig) -> tuple[float, Plan, Tree]:
    began = time.perf_counter()
    plan, tree = jax.block_until_ready(search(*arguments, config=config))
    return time.perf_counter() - began, plan, tree


_PLAN_FIELDS = tuple(field.name for field in dataclasses.fields(Plan))
_TREE_FIELDS = tuple(field.name for field in dataclasses.fields(Tree))


def _as_result(arrays: Sequence[Array]) -> tuple[Plan, Tree]:
    plan, tree = arrays[: len(_PLAN_FIELDS)], arrays[len(_PLAN_FIELDS) :]
    return Plan(**dict(zip(_PLAN_FIELDS, plan, strict=True))), _as_tree(tree)


def _as_tree(arrays: Sequence[Array]) -> Tree:
    return Tree(**dict(zip(_TREE_FIELDS, arrays, strict=True)))


def _as_list(value: Plan | Tree) -> list[Array]:
    return [getattr(value, field.name) for field in dataclasses.fields(value)]


def _seed(key: PRNGKeyArray) -> UInt32[Array, "2"]:
    """What the search's own counter-based generator starts from."""
    return jax.random.bits(key, (2,), jnp.uint32)


def _run(
    structure: Any, config: SearchConfig, seeds: UInt32[Array, "B 2"], leaves: Sequence[Array], trees: Tree | None
) -> Sequence[Array]:
    kernel = _lockstep(structure, config, len(leaves))
    return kernel(seeds, *leaves, *([] if trees is None else _as_list(trees)))


@functools.lru_cache(maxsize=64)
def _lockstep(structure: Any, config: SearchConfig, leaf_count: int) -> Any:
    """The kernel on flat lists of arrays with a leading batch axis; vmap merges its own axis into that one."""

    @jax.custom_batching.custom_vmap
    def kernel(seeds, *arrays):
        leaves, trees = arrays[:leaf_count], arrays[leaf_count:]
        plan, tree = _search_batch(structure, leaves, seeds, _as_tree(trees) if trees else None, config)
        return _as_list(plan) + _as_list(tree)

    @kernel.def_vmap
    def merge_axes(axis_size, in_batched, *arrays):
        full = [
            array if batched else jnp.broadcast_to(array[None], (axis_size, *array.shape))
            for array, batched in zip(arrays, in_batched, strict=True)
        ]
        rows = full[0].shape[0] * full[0].shape[1]
        results = kernel(*[array.reshape(rows, *array.shape[2:]) for array in full])
        split = [result.reshape(axis_size, rows // max(axis_size, 1), *result.shape[1:]) for result in results]
        return split, [True] * len(split)

    return kernel


@functools.partial(jax.jit, static_argnames=("structure", "config"))
def _search_batch(
    structure: Any, leaves: Sequence[Array], seeds: UInt32[Array, "B 2"], tree: Tree | None, config: SearchConfig
) -> tuple[Plan, Tree]:
    """The search; ``leaves`` are those of a problem, with a leading batch axis."""
    if tree is None:
        context, tree = new_search(structure, leaves, seeds, config)
    else:
        context = prepare(structure, leaves, seeds, config)

    def unfinished(carry: tuple[Array, Tree]) -> Array:
        count, tree = carry
        return (count < config.simulations) & jnp.any(is_open(context, tree, config))

    def advance(carry: tuple[Array, Tree]) -> tuple[Array, Tree]:
        count, tree = carry
        return count + 1, simulate(context, tree, config)

    _, tree = jax.lax.while_loop(unfinished, advance, (jnp.int32(0), tree))
    choice = choose(context, tree, config)
    plan = Plan(
        action=choice.action,
        subgoal=choice.subgoal,
        from_state=choice.from_state,
        to_state=choice.to_state,
        value=choice.value,
        q_values=tree.q_values[:, Tree.ROOT],
        visits=tree.root_visits,
        gap=choice.gap,
        status=tree.status | choice.status,
    )
    return plan, tree


_first = jax.jit(search_tree, static_argnames="config")
_more = jax.jit(
    lambda problem, key, tree, config: search_tree(problem, key, config, tree),
    static_argnames="config",
    donate_argnames="tree",
)
