"""What the steps of best-first search share: the problems with their tables, and what histories are taken to cost.

A history that has a node costs what its node passes up. An outcome without a node costs what is guessed of it; its
bound is that guess discounted by the search's optimism, and its floor is 0 (``search.best_first``).
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.planning.history import ActionTables
from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.search.graph import Costs, NodeValues, Tree, dead_ends_in, guess_in
from potlp_jax.planning.search.model import Model
from potlp_jax.planning.search.rule import Rule
from potlp_jax.task.relations import transitive_closure

ALL_CONDITIONS = 0xFFFFFFFF
"""A word of a mask over conditions in which every bit is set."""


@struct.dataclass(kw_only=True)
class Context:
    """What stays the same during a search.

    Attributes:
      model: the problems.
      rule: guesses the value of outcomes without a node.
      relevant: per state of the automaton, mask over the conditions that later choices can depend on.
      optimism: ``BestFirstConfig.optimism``, of each problem.
    """

    model: Model
    rule: Rule
    relevant: UInt32[Array, "*B Z W"]
    optimism: Float32[Array, "*B"]


def root_costs(context: Context, tree: Tree) -> Costs:
    """Value, bound and floor of the problems."""
    values = NodeValues.unpack(tree.values[:, Tree.ROOT])
    return values.on_arrival(context.model.root.pending_cost, context.model.dead_end_cost)


def outcome_costs(
    context: Context,
    tree: Tree,
    child: Int32[Array, "B"],
    pending_cost: Float32[Array, "B"],
    is_last: Bool[Array, ""],
) -> Costs:
    """Costs after an outcome: those of its node, or by the guess where there is none.

    Args:
      context: of the problems.
      tree: the graphs.
      child: the outcome's entry of ``Tree.children``.
      pending_cost: after the outcome.
      is_last: True at the last level of a descent: what has a node is taken as it is, without a gap.

    Returns:
      Of one outcome per row, the pending cost included.
    """
    # Index 0 where there is no child: read, and not used.
    node = tree.values_at(context.model.rows, jnp.maximum(child, 0))
    visited = node.on_arrival(pending_cost, context.model.dead_end_cost)
    visited = without_gap_where(is_last, visited)
    guess = guess_in(child)
    unvisited = Costs(value=guess, bound=discounted_guess_in(child, context.optimism), floor=jnp.zeros_like(guess))
    return jax.tree.map(lambda new, old: jnp.where(child < 0, new, old), unvisited, visited)


def discounted_guess_in(child: Int32[Array, "*B"], optimism: Array) -> Float32[Array, "*B"]:
    """Guesses of which all but what dead ends cost in them is reduced by the optimism; never above the guesses."""
    guess = guess_in(child)
    return jnp.minimum(rounded_product(1.0 - optimism, guess) + rounded_product(optimism, dead_ends_in(child)), guess)


def without_gap_where(cut: Bool[Array, "*B"], costs: Costs) -> Costs:
    """Without a gap where a descent is cut by ``max_depth``: it would lead to the same place again and again."""
    return jax.tree.map(lambda own: jnp.where(cut, costs.value, own), costs)


def reachable_states(tables: ActionTables) -> Bool[Array, "Z Z"]:
    """``[z, z']``: travel and attempts can lead from z to z'."""
    rows, states = tables.actions, tables.accepting.shape[0]
    own = jnp.arange(states, dtype=jnp.int32)
    attempts = rows.from_state[:, None] == own[None, :]
    # A path that ends where an action is attempted in z' leads from z to z', from whichever node it starts.
    travels = jnp.any(jnp.any(jnp.isfinite(tables.distance), axis=0)[:, :, None] & attempts[None, :, :], axis=1)
    succeeds = jnp.any(attempts[:, :, None] & (rows.to_state[:, None] == own[None, :])[:, None, :], axis=0)
    return transitive_closure(travels | succeeds | (own[:, None] == own[None, :]))


def relevant_conditions(tables: ActionTables, reach: Bool[Array, "Z Z"]) -> UInt32[Array, "Z W"]:
    """Per state, the conditions of actions that can still be attempted.

    All of them where conditions of several cubes exist: what is known of one may then close another.
    """
    rows = tables.actions
    attempts = rows.from_state[:, None] == jnp.arange(reach.shape[0], dtype=jnp.int32)[None, :]
    # A condition matters in a state if an action that tries it can still be reached from there.
    useful = jnp.any(reach[:, None, :] & attempts[None, :, :], axis=2)
    bits = jnp.where(useful[:, :, None], rows.condition_bits[None], jnp.uint32(0))
    combined = jax.lax.reduce(bits, jnp.uint32(0), jax.lax.bitwise_or, (1,))
    return jnp.where(jnp.any(tables.compound_mask), jnp.uint32(ALL_CONDITIONS), combined)
