"""The expansions of best-first search: the outcome that a descent reached gets a node, or finds the one that it has.

Another order of the same events may have led to the same history: then its node is linked instead of a new one. The
numbers of a new node are Eq. 3 with what is guessed to follow the outcomes of its actions (``search.guess``).
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32

from potlp_jax.planning.history import History, terms_of_all
from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.search.arrays import status_of_rows
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.search.context import Context, discounted_guess_in, without_gap_where
from potlp_jax.planning.search.descending import Descent
from potlp_jax.planning.search.graph import Costs, NewNode, NodeValues, Tree, add_node, as_guess, find, guess_in
from potlp_jax.planning.search.guess import guess_outcomes
from potlp_jax.planning.search.model import FAILURE, SUCCESS
from potlp_jax.planning.search.successes import value_successes_anew
from potlp_jax.types import Status

LEAST_GUESS: float = 1e-4
"""Guesses at outcomes that do not satisfy the task are at least this share of the dead-end cost, so that an outcome
without a node leaves a gap that 24 bits can hold: one that rounding hides changes the value by less than 0.06 %."""


@struct.dataclass(kw_only=True)
class Leaf:
    """What a descent ended at, from which to back up.

    Attributes:
      child: node of the last action's outcome, ``Tree.UNVISITED`` where it has none.
      costs: expected cost after the descent's last outcome.
    """

    child: Int32[Array, "B"]
    costs: Costs


def expand(context: Context, tree: Tree, descent: Descent, config: BestFirstConfig) -> tuple[Tree, Leaf]:
    """Add the node that the descent reached, unless another order of the same events has led there before.

    Args:
      context: of the problems.
      tree: the graphs.
      descent: of all rows.
      config: ``guess_failures`` matters.

    Returns:
      The graphs with at most one more node each, not yet linked to its parent; and from where to back up. Where a graph
      is full, or a descent was cut, a bit of ``status`` is set.
    """
    model = context.model
    # Rows that do not expand compute a history too; nothing of it is kept.
    parent = tree.history(model.rows, descent.node, descent.pending_cost)
    history = model.step(parent, descent.action, descent.success)
    # Computed for all rows in lockstep, also for those that find an existing node.
    node = new_node(context, history, config)
    lookup = find(tree, history, context.relevant)
    is_new = descent.expands & (lookup.node == Tree.UNVISITED)
    # Where a row ends without a new node: the node that it found, or the last one of a descent that was cut.
    end = jnp.where(descent.expands, jnp.maximum(lookup.node, 0), descent.node)
    # Read before the new node is written: all reads come before all writes.
    existing = tree.values[model.rows, end]
    tree, values, added = add_node(tree, model, node, history, lookup, is_new)
    values = NodeValues.unpack(jnp.where(is_new[:, None], values.pack(), existing))
    costs = without_gap_where(descent.active, values.on_arrival(descent.pending_cost, model.dead_end_cost))
    child = jnp.where(added, tree.size - 1, jnp.where(descent.expands, lookup.node, Tree.UNVISITED))
    overflow = status_of_rows(is_new & ~added, Status.TREE_OVERFLOW)
    # Rows that are still active when the descent is over have reached the depth limit.
    overflow |= status_of_rows(descent.active, Status.DEPTH_OVERFLOW)
    leaf = Leaf(child=child, costs=jax.tree.map(lambda own: jnp.where(descent.accepted, 0.0, own), costs))
    return dataclasses.replace(tree, status=tree.status | overflow), leaf


def new_node(context: Context, history: History, config: BestFirstConfig) -> NewNode:
    """The numbers of one node per row when nothing below it has been seen.

    Args:
      context: of the problems.
      history: of the node; the numbers are without its pending cost, which only the guesses take into account.
      config: ``guess_failures`` matters.

    Returns:
      Eq. 3 of each action with guessed values of its outcomes, and the guesses.
    """
    # The pending cost is left out of a node's numbers; the guess needs it, to know what the next action pays.
    free = dataclasses.replace(history, pending_cost=jnp.zeros_like(history.pending_cost))
    terms = jax.vmap(terms_of_all)(context.model.tables, free)
    chance, available = terms.success_probability, terms.available
    rule = value_successes_anew(context.rule, context.model.tables, chance, terms.success_cost, config.guess_failures)
    failure, success = guess_outcomes(
        rule,
        context.model.product_state(history.location, history.state),
        history.pending_cost,
        available,
        chance,
        terms.success_cost,
        config.guess_failures,
    )
    least = LEAST_GUESS * context.model.dead_end_cost[:, None]
    after_failure = jnp.maximum(failure.cost, least)
    after_success = jnp.where(context.model.accepts, 0.0, jnp.maximum(success.cost, least))
    dead_ends = jnp.stack([failure.dead_end, success.dead_end], axis=-1) * context.model.dead_end_cost[:, None, None]
    children = as_guess(jnp.stack([after_failure, after_success], axis=-1), dead_ends)
    # Eq. 3 with guessed values, the same with the guesses reduced by the optimism, and without them.
    known = terms.distance + rounded_product(chance, terms.success_cost)
    known += rounded_product(1.0 - chance, terms.failure_cost)

    def expected(after: Float32[Array, "B A 2"]) -> Float32[Array, "B A"]:
        guessed = rounded_product(chance, after[..., SUCCESS]) + rounded_product(1.0 - chance, after[..., FAILURE])
        return jnp.where(available, known + guessed, jnp.inf)

    return NewNode(
        q_values=expected(guess_in(children)),
        bounds=expected(discounted_guess_in(children, context.optimism[:, None, None])),
        floors=jnp.where(available, known, jnp.inf),
        chances=chance,
        success_costs=terms.success_cost,
        children=children,
    )
