"""Best-first search as one call of a kernel in C++ on CPU: the twin of ``search.best_first``, with the same plans.

The kernel (``potlp_jax/native/kernels/search.cc``) searches the rows of a batch one by one. It leaves out what no
rollout can get to, so that padding costs nothing, and settings of the search are attributes of the call: no program is
compiled for them but the call itself, and none at all for another budget.
"""

import dataclasses
from typing import Any

import jax
import jax.ffi
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32

from potlp_jax.native import target
from potlp_jax.planning.history import WORD_BITS
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.search.graph import KEY_WORDS, PROBES, VALUE_COLUMNS, Tree
from potlp_jax.planning.search.plan import Plan
from potlp_jax.planning.sharding import vary_alike

LIBRARY: str = "search"


_TASK_FIELDS = (
    "accepting",
    "state_mask",
    "edges",
    "edge_mask",
    "edge_condition",
    "class_mask",
    "condition_classes",
    "condition_mask",
    "implies",
)
_PROBLEM_FIELDS = (
    "travel",
    "finish",
    "success_probability",
    "success_cost",
    "failure_cost",
    "dfa_state",
    "subgoal_mask",
    "dead_end_cost",
)
"""Arguments of the kernel, in the order of ``ProblemBatch`` in its source: the task's first; then the budgets."""


def fits_kernel(problems: PlanningProblem) -> bool:
    """Whether the kernel takes problems of these shapes: sets of conditions and of states are one word each."""
    task = problems.task
    return max(task.state_mask.shape[-1], task.condition_mask.shape[-1]) <= WORD_BITS


def search_natively(
    problems: PlanningProblem,
    budgets: Int32[Array, "B"],
    trees: Tree | None,
    config: BestFirstConfig,
    with_trees: bool,
) -> tuple[Plan, Tree | None]:
    """The whole search of a batch. For CPU, and only where the library ``LIBRARY`` is usable.

    Args:
      problems: every leaf has the leading axis B; ``fits_kernel``.
      budgets: simulations of each row, at most.
      trees: to go on with, or None.
      config: of the search.
      with_trees: whether trees are wanted; without them, nothing is written but plans.

    Returns:
      Plans, and trees or None. In trees, actions that are not available at a node have costs of inf, and nothing else
      of them is kept.
    """
    arrays = [getattr(problems.task, name) for name in _TASK_FIELDS]
    arrays += [*(getattr(problems, name) for name in _PROBLEM_FIELDS), budgets]
    batch = problems.dfa_state.shape[0]
    results = _plan_shapes(problems) + (_tree_shapes(problems, config) if with_trees else [])
    old = [] if trees is None else [getattr(trees, field.name) for field in dataclasses.fields(Tree)]
    plan_fields = len(dataclasses.fields(Plan))
    # A tree to go on with lies where the new one will: without a copy, if the caller gives it away.
    aliases = {len(arrays) + index: plan_fields + index for index in range(len(old))}
    call = jax.ffi.ffi_call(target("best_first"), results, input_output_aliases=aliases)
    found = call(
        *arrays,
        *old,
        tree=np.int64(0 if not with_trees else 1 if trees is None else 2),
        max_depth=np.int64(config.max_depth),
        capacity=np.int64(config.capacity),
        slots=np.int64(config.slots),
        guess_failures=np.int64(config.guess_failures),
        optimism=np.float32(config.optimism),
        batch=np.int64(batch),
    )
    found = vary_alike(list(found), arrays, old)
    plan = _named(Plan, found[:plan_fields])
    return plan, _named(Tree, found[plan_fields:]) if with_trees else None


def _named(kind: type, arrays: list[Any]) -> Any:
    return kind(**{field.name: array for field, array in zip(dataclasses.fields(kind), arrays, strict=True)})


def _plan_shapes(problems: PlanningProblem) -> list[jax.ShapeDtypeStruct]:
    """Of the fields of ``Plan``, in order."""
    batch, actions = problems.dfa_state.shape, problems.action_count
    integers, floats = jax.ShapeDtypeStruct(batch, jnp.int32), jax.ShapeDtypeStruct(batch, jnp.float32)
    shapes = {
        "action": integers,
        "subgoal": integers,
        "from_state": integers,
        "to_state": integers,
        "value": floats,
        "q_values": jax.ShapeDtypeStruct((*batch, actions), jnp.float32),
        "visits": jax.ShapeDtypeStruct((*batch, actions), jnp.int32),
        "optimism_gap": floats,
        "lower_bound": floats,
        "status": jax.ShapeDtypeStruct(batch, jnp.uint32),
    }
    return [shapes[field.name] for field in dataclasses.fields(Plan)]


def _tree_shapes(problems: PlanningProblem, config: BestFirstConfig) -> list[jax.ShapeDtypeStruct]:
    """Of the fields of ``Tree``, in order."""
    batch, nodes, actions = problems.dfa_state.shape, config.capacity + 1, problems.action_count
    subgoals = problems.subgoal_count

    def of(kind: Any, *shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((*batch, *shape), kind)

    costs, words, count = of(jnp.float32, nodes, actions), of(jnp.uint32, nodes, subgoals, 1), of(jnp.int32)
    shapes = {
        "q_values": costs,
        "bounds": costs,
        "floors": costs,
        "chances": costs,
        "success_costs": costs,
        "children": of(jnp.int32, nodes, actions, 2),
        "values": of(jnp.float32, nodes, VALUE_COLUMNS),
        "location": of(jnp.int32, nodes),
        "state": of(jnp.int32, nodes),
        "holds": words,
        "fails": words,
        "visited": of(jnp.uint32, nodes, subgoals + 1, 1),
        "table": of(jnp.int32, config.slots + PROBES, KEY_WORDS + 1),
        "root_visits": of(jnp.int32, actions),
        "size": count,
        "simulations": count,
        "steps": count,
        "status": of(jnp.uint32),
    }
    return [shapes[field.name] for field in dataclasses.fields(Tree)]
