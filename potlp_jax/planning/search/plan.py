"""The answer of a search to one planning problem."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, UInt32

from potlp_jax.planning.search.arrays import status_of_rows
from potlp_jax.planning.search.model import Model
from potlp_jax.types import NO_ACTION, NO_STATE, NO_SUBGOAL, Status


@struct.dataclass(kw_only=True)
class Plan:
    """Answer to one planning problem.

    Attributes:
      action: ``s * E + e``, ``S * E`` for finish, or ``NO_ACTION`` (``status`` tells why).
      subgoal: the action's subgoal, ``NO_SUBGOAL`` for finish and for none.
      from_state: state z' in which to reach the subgoal, ``NO_STATE`` for finish and for none.
      to_state: state z'' to try for beyond it, ``NO_STATE`` for finish and for none.
      value: expected cost of the action; 0 where the task is satisfied, the dead-end cost at a dead end, inf where the
        problem is invalid.
      q_values: expected cost of each action, inf where it is not available (under ``UctConfig`` also where no rollout
        took it).
      visits: simulations that began with each action.
      optimism_gap: fraction of ``value`` by which it would fall if every guess that it rests on, apart from what dead
        ends cost in it, were too high by the search's optimism (``BestFirstConfig``). Above 0 it is **no bound on the
        error**: it looks down only, a guess may also be too low, and it may be too high by more than the optimism.
        0 says, if the optimism is not 0, that ``value`` rests on no guess: it is what the plan's own policy costs, so
        that the optimum is no higher. inf from ``UctConfig``, which has no bounds.
      lower_bound: certified: the optimum is no lower, up to rounding, unless ``status`` has ``DEPTH_OVERFLOW``. Where
        ``optimism_gap`` is 0 the optimum lies between it and ``value``. Where it equals ``value`` the search has ended,
        and ``value`` is the optimum (proof: ``search.best_first``). -inf from ``UctConfig``. ``planning.exact`` gives
        tighter intervals, on the host.
      status: bits of ``types.Status``.
    """

    action: Int32[Array, "*B"]
    subgoal: Int32[Array, "*B"]
    from_state: Int32[Array, "*B"]
    to_state: Int32[Array, "*B"]
    value: Float32[Array, "*B"]
    q_values: Float32[Array, "*B A"]
    visits: Int32[Array, "*B A"]
    optimism_gap: Float32[Array, "*B"]
    lower_bound: Float32[Array, "*B"]
    status: UInt32[Array, "*B"]


def plan_of_least_score(
    model: Model,
    score: Float32[Array, "B A"],
    q_values: Float32[Array, "B A"],
    visits: Int32[Array, "B A"],
    root_bound: Float32[Array, "B"],
    root_floor: Float32[Array, "B"],
    status: UInt32[Array, "B"],
) -> Plan:
    """The plan that takes the action of least score at the root, ties by lowest index.

    Args:
      model: the problems that were searched.
      score: what to minimise, inf where an action is not available.
      q_values: expected cost of each action at the root, inf where it is not available.
      visits: simulations that began with each action.
      root_bound: optimistic value of the root, -inf where the search has none.
      root_floor: certified lower bound of the root's value, -inf where the search has none.
      status: bits set during the search.

    Returns:
      One plan per row.
    """
    finish = model.finish
    index = jnp.arange(finish + 1, dtype=jnp.int32)[None, :]
    available = jnp.any(jnp.isfinite(q_values), axis=1)
    # The minimum, then the first index that attains it: ties go to the lowest index.
    action = jnp.min(jnp.where(score <= jnp.min(score, axis=1)[:, None], index, finish), axis=1)
    attempts = available & (action != finish)
    row = model.action_rows(action)
    # A satisfied root has no action either, but costs nothing.
    accepted = jnp.take_along_axis(model.tables.accepting, model.root.state[:, None], axis=1)[:, 0]
    rows = jnp.arange(action.shape[0], dtype=jnp.int32)
    value = jnp.where(available, q_values[rows, action], model.dead_end_cost)
    value = jnp.where(accepted, 0.0, value)
    # Relative to the value; where that is 0 nothing is divided. Where it is 0, the action of least Q has a bound of the
    # same size, so that no guess enters either.
    gap = (value - root_bound) / jnp.where(value > 0, value, 1.0)
    ended = status_of_rows(accepted, Status.ACCEPTING_ROOT) | status_of_rows(~available & ~accepted, Status.DEAD_END)
    return Plan(
        action=jnp.where(available, action, NO_ACTION),
        subgoal=jnp.where(attempts, row.subgoal, NO_SUBGOAL),
        from_state=jnp.where(attempts, row.from_state, NO_STATE),
        to_state=jnp.where(attempts, row.to_state, NO_STATE),
        value=value,
        q_values=q_values,
        visits=visits,
        optimism_gap=jnp.where(available, gap, 0.0),
        lower_bound=jnp.where(available, root_floor, value),
        status=status | ended,
    )
