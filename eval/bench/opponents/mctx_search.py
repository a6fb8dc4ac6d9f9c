"""mctx's ``stochastic_muzero_policy`` on our planning problems, a batch at once.

The model is exact where MuZero has networks: a decision node is a history, an action leads to a chance node (the action
is under way), its outcome - failure or success, with logits log(1 - P_S) and log P_S - to the next history. Rewards
are negative costs, paid when the outcome is known; a decision node's value is 0 (the cost so far), a chance node's what
the action costs in expectation. Available actions have equal prior logits. A satisfied task and a dead end absorb.

One of its simulations adds one node, a chance node or a decision node, so two of its simulations are one of ours. It
takes outcomes in proportion to their probability rather than at random, and scales Q to [0, 1] instead of using a C in
units of cost (PUCT). No Dirichlet noise at the root; the answer is the action visited most.

References:
  Antonoglou et al., Planning in Stochastic Environments with a Learned Model, ICLR 2022.
"""

import functools
import importlib
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, PRNGKeyArray

from potlp_jax.planning.history import (
    ActionTables,
    History,
    action_tables,
    distance_of,
    initial_history,
    knowledge_of,
    knowledge_terms,
    step_row,
    terms_of_all,
)
from potlp_jax.planning.problem import PlanningProblem

mctx: Any = importlib.import_module("mctx")
"""By name: an optional package, whose declared types do not admit arrays under trace."""

IMPOSSIBLE = -1e9
"""Logit of what cannot happen; finite, because mctx subtracts logits."""


@struct.dataclass(kw_only=True)
class _Under:
    """An action under way: the history before it, and what failure and success will have cost."""

    history: History
    over: Bool[Array, "*B"]
    action: Int32[Array, "*B"]
    failure_cost: Float32[Array, "*B"]
    success_cost: Float32[Array, "*B"]


@struct.dataclass(kw_only=True)
class _Decision:
    """A history; ``over`` where nothing is left to do."""

    history: History
    over: Bool[Array, "*B"]


@struct.dataclass(kw_only=True)
class MctxPlan:
    """Answer for a batch.

    ``means`` is the mean cost of each action, inf where it was not tried. ``depth`` is the mean number of our actions
    per simulation over the nodes of the tree: how deep the average new node is.
    """

    action: Int32[Array, "B"]
    visits: Int32[Array, "B A"]
    means: Float32[Array, "B A"]
    depth: Float32[Array, "B"]


@functools.partial(jax.jit, static_argnames=("simulations", "max_depth"))
def mctx_plan(
    problems: PlanningProblem, key: PRNGKeyArray, *, simulations: int, max_depth: int | None = None
) -> MctxPlan:
    """Search a batch of problems.

    Args:
      problems: every leaf has the leading axis B.
      key: breaks ties.
      simulations: in mctx's unit.
      max_depth: in mctx's unit, decision and chance nodes; default: no limit.
    """
    tables = jax.vmap(action_tables)(problems)
    params = tables, problems.dead_end_cost
    history = jax.vmap(initial_history)(problems)
    available = jax.vmap(lambda t, h: terms_of_all(t, h).available)(tables, history)
    batch = available.shape[0]
    root = mctx.RootFnOutput(
        prior_logits=jnp.where(available, 0.0, IMPOSSIBLE),
        value=jnp.zeros((batch,), jnp.float32),
        embedding=_Decision(history=history, over=jnp.zeros((batch,), jnp.bool_)),
    )
    output = mctx.stochastic_muzero_policy(
        params,
        key,
        root,
        _begin_action,
        _end_action,
        num_simulations=simulations,
        invalid_actions=(~available).astype(jnp.float32),
        max_depth=max_depth,
        dirichlet_fraction=0.0,
        temperature=0.0,
    )
    tree: Any = output.search_tree
    summary = tree.summary()
    visits = summary.visit_counts.astype(jnp.int32)
    return MctxPlan(
        action=output.action.astype(jnp.int32),
        visits=visits,
        means=jnp.where(visits > 0, -summary.qvalues, jnp.inf),
        depth=_mean_depth(tree.parents) / 2.0,
    )


def _begin_action(params: Any, _: PRNGKeyArray, action: Int32[Array, "B"], state: _Decision) -> tuple[Any, _Under]:
    """The chance node of an action. mctx also asks where an outcome was taken: the index is then out of range."""
    tables, _ = params
    action = jnp.minimum(action, tables.distance.shape[-1] - 1)
    probability, distance, success_cost, failure_cost = jax.vmap(_terms_of_one)(tables, state.history, action)
    expected = distance + probability * success_cost + (1.0 - probability) * failure_cost
    output = mctx.DecisionRecurrentFnOutput(
        chance_logits=_log(jnp.stack([1.0 - probability, probability], axis=-1)),
        afterstate_value=jnp.where(state.over, 0.0, -expected),
    )
    return output, _Under(
        history=state.history,
        over=state.over,
        action=action,
        failure_cost=distance + failure_cost,
        success_cost=distance + success_cost,
    )


def _end_action(params: Any, _: PRNGKeyArray, outcome: Int32[Array, "B"], state: _Under) -> tuple[Any, _Decision]:
    """The decision node after an outcome."""
    tables, dead_end_cost = params
    success = outcome == 1
    history = jax.vmap(_step)(tables, state.history, state.action, success)
    available = jax.vmap(lambda t, h: terms_of_all(t, h).available)(tables, history)
    accepted = jnp.take_along_axis(tables.accepting, history.state[:, None], axis=1)[:, 0]
    stuck = ~jnp.any(available, axis=-1) & ~accepted
    cost = jnp.where(success, state.success_cost, state.failure_cost) + jnp.where(stuck, dead_end_cost, 0.0)
    over = state.over | stuck | accepted
    zeros = jnp.zeros_like(cost)
    output = mctx.ChanceRecurrentFnOutput(
        action_logits=jnp.where(available, 0.0, IMPOSSIBLE),
        value=zeros,
        reward=jnp.where(state.over, 0.0, -cost),
        discount=jnp.where(over, 0.0, 1.0),
    )
    return output, _Decision(history=history, over=over)


def _terms_of_one(
    tables: ActionTables, history: History, action: Int32[Array, ""]
) -> tuple[Float32[Array, ""], Float32[Array, ""], Float32[Array, ""], Float32[Array, ""]]:
    """P_S, D, R_S, R_F of one action; D is 0 where it cannot be reached (such an action is never counted)."""
    row = jax.tree.map(lambda leaf: leaf[action], tables.actions)
    probability, success_cost, _ = knowledge_terms(row, *knowledge_of(row.subgoal, history))
    distance = distance_of(row, history, tables.distance[history.location, history.state, action])
    return probability, jnp.where(jnp.isfinite(distance), distance, 0.0), success_cost, row.failure_cost


def _step(tables: ActionTables, history: History, action: Int32[Array, ""], success: Bool[Array, ""]) -> History:
    row = jax.tree.map(lambda leaf: leaf[action], tables.actions)
    return step_row(tables, row, history, success)


def _log(probability: Float32[Array, "*N"]) -> Float32[Array, "*N"]:
    return jnp.where(probability > 0, jnp.log(jnp.maximum(probability, 1e-30)), IMPOSSIBLE)


def _mean_depth(parents: Int32[Array, "B N"]) -> Float32[Array, "B"]:
    """Mean depth of the nodes; a parent always precedes its children."""

    def visit(index, depth):
        parent = parents[:, index]
        here = jnp.take_along_axis(depth, jnp.maximum(parent, 0)[:, None], axis=1)[:, 0] + 1
        return depth.at[:, index].set(jnp.where(parent >= 0, here, 0))

    nodes = parents.shape[1]
    depth = jax.lax.fori_loop(1, nodes, visit, jnp.zeros(parents.shape, jnp.int32))
    return jnp.sum(depth, axis=1).astype(jnp.float32) / max(nodes - 1, 1)
