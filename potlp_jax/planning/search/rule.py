"""The simple rule that guesses follow: take the action of least cost per chance of success.

Here is what the rule looks up in a batch of problems; which actions it takes is in ``search.chains``, and what it
expects after their successes in ``search.successes``.

Ordering by cost per chance is optimal for independent tests without path costs between them (Mitten 1960). With path
costs the rule is a policy like any other, so that a guess is seldom too low in problems that are not coupled.

References:
  L. G. Mitten, An analytic solution to the least cost testing sequence problem, J. of Industrial Engineering, 1960.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.planning.history import ActionTables
from potlp_jax.types import NO_STATE


@struct.dataclass(kw_only=True)
class Guess:
    """What is guessed to follow an outcome.

    Attributes:
      cost: expected cost, what dead ends cost included.
      dead_end: probability of ending at a dead end.
    """

    cost: Float32[Array, "..."]
    dead_end: Float32[Array, "..."]


def guess_where(condition: Bool[Array, "..."], guess: Guess, other: Guess) -> Guess:
    """The one guess where the condition holds, the other elsewhere."""
    return jax.tree.map(lambda own, other: jnp.where(condition, own, other), guess, other)


@struct.dataclass(kw_only=True)
class Rule:
    """The rule in a batch of problems; ``R`` is the batch axis, ``P`` numbers product states.

    Attributes:
      path_costs: ``[r, p, a]``, path cost from the product state ``p = location * Z + state`` to action ``a``.
      product_states: where each action is attempted; negative for finish and padding.
      success_states: where its success leads; negative where that satisfies the task, and for finish and padding.
      failure_cost: R_F of each action.
      closes: ``[r, a, b]``: a failure of ``a`` closes the condition of ``b``, so that ``b`` fails too.
      after_success: ``[r, a]``, guess after each action's success, the cost that is then pending included; 0 where the
        success satisfies the task, and for finish.
      dead_end_cost: of each problem.
      reach: ``[r, z, z']``: from z the rollout can get to z'.
      coupled: True where what fails in one state of the automaton closes a condition of a later one.
    """

    path_costs: Float32[Array, "*R P A"]
    product_states: Int32[Array, "*R A"]
    success_states: Int32[Array, "*R A"]
    failure_cost: Float32[Array, "*R A"]
    closes: Bool[Array, "*R A A"]
    after_success: Guess
    dead_end_cost: Float32[Array, "*R"]
    reach: Bool[Array, "*R Z Z"]
    coupled: Bool[Array, "*R"]


def make_rule(
    tables: ActionTables,
    product_states: Int32[Array, "R A"],
    reach: Bool[Array, "R Z Z"],
    dead_end_cost: Float32[Array, "R"],
) -> Rule:
    """The rule before any success is valued (``successes.value_successes``).

    Args:
      tables: of a batch of problems.
      product_states: where each action is attempted, negative for finish and padding.
      reach: ``[r, z, z']``: from z the rollout can get to z'.
      dead_end_cost: of each problem.

    Returns:
      One rule per problem.
    """
    rows = tables.actions
    count, actions = product_states.shape
    # A failure closes all conditions that imply the failed one, at the same subgoal.
    closes = jnp.any(rows.backward[:, :, None, :] & rows.condition_bits[:, None, :, :] != 0, axis=-1)
    closes &= rows.subgoal[:, :, None] == rows.subgoal[:, None, :]
    return Rule(
        path_costs=tables.distance.reshape(count, -1, actions),
        product_states=product_states,
        success_states=_success_states(tables),
        failure_cost=rows.failure_cost,
        closes=closes,
        after_success=unvalued_successes(tables, dead_end_cost),
        dead_end_cost=dead_end_cost,
        reach=reach,
        coupled=_is_coupled(tables, closes, reach),
    )


def _success_states(tables: ActionTables) -> Int32[Array, "R A"]:
    """Product state that each action's success leads to; see ``Rule``."""
    rows, states = tables.actions, tables.accepting.shape[1]
    leads_on = (rows.from_state != NO_STATE) & ~rows.accepts
    return jnp.where(leads_on, rows.subgoal * states + rows.to_state, NO_STATE).astype(jnp.int32)


def unvalued_successes(tables: ActionTables, dead_end_cost: Float32[Array, "R"]) -> Guess:
    """What successes are worth until they are valued: they lead to a dead end, unless they satisfy the task."""
    dead_end = jnp.where(tables.actions.accepts, jnp.float32(0.0), jnp.float32(1.0)).at[:, -1].set(0.0)
    return Guess(cost=jnp.where(dead_end > 0, dead_end_cost[:, None], 0.0), dead_end=dead_end)


def _is_coupled(tables: ActionTables, closes: Bool[Array, "R A A"], reach: Bool[Array, "R Z Z"]) -> Bool[Array, "R"]:
    """Whether a failure can close an action of another state that is reached from the failed one's."""
    rows = tables.actions
    states, problems = jnp.maximum(rows.from_state, 0), jnp.arange(closes.shape[0], dtype=jnp.int32)[:, None, None]
    real = rows.from_state != NO_STATE
    later = reach[problems, states[:, :, None], states[:, None, :]] & (states[:, :, None] != states[:, None, :])
    return jnp.any(closes & later & real[:, :, None] & real[:, None, :], axis=(1, 2))
