"""How a search runs: in lockstep on all rows of a batch, to which ``jax.vmap`` is routed.

A search is five verbs on a batch of problems (``SearchMethod``). The functions here know nothing of what the verbs do,
so that a test can run them on a search of its own.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int32, UInt32

from potlp_jax.native import by_platform, without_derivative
from potlp_jax.planning.problem import PlanningProblem, screen
from potlp_jax.planning.search.plan import Plan
from potlp_jax.planning.sharding import vary_alike
from potlp_jax.precision import in_32_bits
from potlp_jax.types import Status, status_array


@dataclasses.dataclass(frozen=True)
class SearchMethod:
    """A search as verbs. All arrays have a leading batch axis; every verb is pure.

    Attributes:
      tree: the class of its tree, a flat dataclass of arrays.
      prepare: ``(problems, seeds, config) -> context``: what stays the same during the search.
      plant: ``(context, config) -> tree``: the roots alone.
      is_open: ``(context, tree) -> bool [B]``: whether more simulations can change anything.
      simulate: ``(context, tree, active, config) -> tree``: one descent of every row that is active, bool [B]; others
        stay as they are.
      choose: ``(context, tree) -> plan``.
      kernel: the same search as one call on CPU, where there is one.
    """

    tree: type
    prepare: Callable[..., Any]
    plant: Callable[..., Any]
    is_open: Callable[..., Any]
    simulate: Callable[..., Any]
    choose: Callable[..., Plan]
    kernel: "SearchKernel | None" = None


@dataclasses.dataclass(frozen=True)
class SearchKernel:
    """A search in native code that gives the plans of a ``SearchMethod``.

    Attributes:
      library: that holds it (``potlp_jax.native``).
      fits: ``(problems) -> bool``: whether it takes problems of these shapes.
      run: ``(problems, budgets, trees or None, config, with_trees) -> (plan, trees or None)``.
    """

    library: str
    fits: Callable[[PlanningProblem], bool]
    run: Callable[..., tuple[Plan, Any]]


def run_search(
    search: SearchMethod,
    config: Any,
    problems: PlanningProblem,
    seeds: UInt32[Array, "B 2"],
    trees: Any,
    with_trees: bool = True,
    budgets: Int32[Array, "B"] | None = None,
) -> tuple[Plan, Any]:
    """Search a batch of problems; ``jax.vmap`` of this adds its axis to the batch.

    Args:
      search: which one.
      config: its settings; ``config.simulations`` are run at most.
      problems: every leaf has the leading axis B.
      seeds: two random words per row.
      trees: of an earlier search of the same problems, to go on with; None to begin.
      with_trees: whether the trees are wanted.
      budgets: simulations of each row, 1 to ``config.simulations``, to which others are clipped; None for the most.

    Returns:
      Plans and trees with the leading axis B; None for trees that are not wanted.
    """
    # Not every search has a kernel, and jax would say of a loop no more than that it failed.
    leaves, structure = jax.tree.flatten(jax.tree.map(without_derivative, problems))
    most = jnp.full(seeds.shape[:1], config.simulations, jnp.int32)
    budgets = most if budgets is None else jnp.clip(budgets.astype(jnp.int32), 1, most)
    kernel = _routed_kernel(search, config, structure, len(leaves), with_trees)
    arrays = kernel(seeds, budgets, *leaves, *([] if trees is None else _arrays_of(trees)))
    count = len(dataclasses.fields(Plan))
    return _from_arrays(Plan, arrays[:count]), _from_arrays(search.tree, arrays[count:]) if with_trees else None


@functools.lru_cache(maxsize=64)
def _routed_kernel(
    search: SearchMethod, config: Any, structure: Any, leaf_count: int, with_trees: bool
) -> Callable[..., Any]:
    """The search on flat lists of arrays with a leading batch axis; vmap merges its own axis into that one.

    Flat lists, because the rule of a ``custom_vmap`` receives and returns flags in the structure of its arguments, and
    dataclasses of arrays do not hold flags.
    """

    @jax.custom_batching.custom_vmap
    @in_32_bits
    def kernel(seeds, budgets, *arrays):
        # The problem's leaves, and after them the tree's, where there is one.
        leaves, trees = arrays[:leaf_count], arrays[leaf_count:]
        problems = jax.tree.unflatten(structure, leaves)
        tree = _from_arrays(search.tree, trees) if trees else None
        plan, tree = _search_batch(problems, seeds, budgets, tree, search=search, config=config, with_trees=with_trees)
        return _arrays_of(plan) + (_arrays_of(tree) if with_trees else [])

    # Called where the caller's vmap is traced, which may be outside of the library's own functions.
    @kernel.def_vmap
    @in_32_bits
    def merge_axes(axis_size, in_batched, *arrays):
        # What is not batched is repeated: the kernel has one batch axis for all of its arguments.
        full = [
            array if batched else jnp.broadcast_to(array[None], (axis_size, *array.shape))
            for array, batched in zip(arrays, in_batched, strict=True)
        ]
        # Merged with the axis of an outer vmap, if there is one: nesting ends in one kernel all the same.
        inner = full[0].shape[1]
        results = kernel(*[array.reshape(axis_size * inner, *array.shape[2:]) for array in full])
        split = [result.reshape(axis_size, inner, *result.shape[1:]) for result in results]
        return split, [True] * len(split)

    return kernel


@functools.partial(jax.jit, static_argnames=("search", "config", "with_trees"))
def _search_batch(
    problems: PlanningProblem,
    seeds: UInt32[Array, "B 2"],
    budgets: Int32[Array, "B"],
    tree: Any,
    *,
    search: SearchMethod,
    config: Any,
    with_trees: bool,
) -> tuple[Plan, Any]:
    """By the search's kernel on CPU, where it has one that can be used; otherwise in lockstep."""

    def in_lockstep(problems: PlanningProblem, seeds: Array, budgets: Array, tree: Any) -> tuple[Plan, Any]:
        plan, tree = _search_in_lockstep(problems, seeds, budgets, tree, search=search, config=config)
        return plan, tree if with_trees else None

    kernel = search.kernel
    if kernel is None or not kernel.fits(problems):
        return in_lockstep(problems, seeds, budgets, tree)

    def natively(problems: PlanningProblem, seeds: Array, budgets: Array, tree: Any) -> tuple[Plan, Any]:
        # A search that has a kernel draws nothing.
        del seeds
        return kernel.run(problems, budgets, tree, config, with_trees)

    return by_platform(kernel.library, natively, in_lockstep, problems, seeds, budgets, tree)


def _search_in_lockstep(
    problems: PlanningProblem,
    seeds: UInt32[Array, "B 2"],
    budgets: Int32[Array, "B"],
    tree: Any,
    *,
    search: SearchMethod,
    config: Any,
) -> tuple[Plan, Any]:
    """Simulate until no row is open or the simulations are spent, then choose."""
    problems, seeds, budgets, tree = vary_alike((problems, seeds, budgets, tree))
    # A row with an invalid input becomes a dead end: nothing is planned with it, and no other row waits for it.
    problems, invalid = jax.vmap(screen)(problems)
    # Not part of the tree: a search that goes on prepares again, which costs a fraction of a search.
    context = search.prepare(problems, seeds, config)
    tree = search.plant(context, config) if tree is None else tree

    def active(count: Array, tree: Any) -> Array:
        return (count < budgets) & search.is_open(context, tree)

    # The loop ends with its slowest row; rows that have ended do nothing in between, so that a row ends alike in any
    # batch.
    def advance(carry: tuple[Array, Array, Any]) -> tuple[Array, Array, Any]:
        count, rows, tree = carry
        tree = search.simulate(context, tree, rows, config)
        return count + 1, active(count + 1, tree), tree

    start = (jnp.int32(0), active(jnp.int32(0), tree), tree)
    tree = jax.lax.while_loop(lambda carry: jnp.any(carry[1]), advance, vary_alike(start))[2]
    plan = search.choose(context, tree)
    status = jnp.where(invalid, status_array(Status.INVALID), plan.status)
    return dataclasses.replace(plan, status=status), tree


def _arrays_of(value: Any) -> list[Array]:
    return [getattr(value, field.name) for field in dataclasses.fields(value)]


def _from_arrays(kind: type, arrays: Sequence[Array]) -> Any:
    names = [field.name for field in dataclasses.fields(kind)]
    return kind(**dict(zip(names, arrays, strict=True)))
