"""Commitment: hysteresis in the choice of the subgoal.

A robot that goes to a subgoal switches to another only if that is cheaper by more than a fraction. Expected costs
change with every observation, by errors that have nothing to do with the world, most of all where a frontier falls into
two. A search that begins anew at every decision pays for each such change with the path back. Errors grow with the cost
that remains to be paid, so the margin is a fraction of it.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32

from potlp_jax.planning.search.plan import Plan
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_ACTION, NO_STATE
from potlp_jax.world.frontiers import Subgoals

SAME_WITHIN: int = 8
"""Cells, in rows and in columns, within which a subgoal may be the one of the decision before: frontiers recede as the
robot nears them, and it decides again after 4 cells. No experiment on it is recorded."""


@struct.dataclass(kw_only=True)
class Intention:
    """What the robot is committed to.

    Attributes:
      cell: the subgoal that it goes to.
      edge: the transition of the automaton that it will try for beyond it.
      state: the automaton's state when that was decided; ``NO_STATE`` where the robot is committed to nothing.
    """

    cell: Int32[Array, "*batch 2"]
    edge: Int32[Array, "*batch"]
    state: Int32[Array, "*batch"]

    @staticmethod
    def none() -> "Intention":
        """Of a robot that has decided nothing yet."""
        return Intention(cell=jnp.zeros(2, jnp.int32), edge=jnp.int32(0), state=jnp.int32(NO_STATE))


def apply_commitment(
    plan: Plan,
    intention: Intention,
    state: Int32[Array, ""],
    subgoals: Subgoals,
    task: TaskArrays,
    commitment: Float32[Array, ""],
) -> Plan:
    """The plan, with the intended action in place of the chosen one where that costs little more.

    The intended action tries for the same transition at the subgoal that is nearest to the former one, within
    ``SAME_WITHIN`` cells. The robot is free again once the automaton's state has changed, and where the plan is to
    finish.

    Args:
      plan: found by the search.
      intention: of the decision before.
      state: the automaton's state now.
      subgoals: of the current belief.
      task: arrays of the task.
      commitment: fraction of the chosen action's expected cost that the intended action may cost more.

    Returns:
      The plan with ``action`` and what belongs to it replaced, or unchanged.
    """
    count, edges = subgoals.mask.shape[0], task.edge_mask.shape[0]
    # Subgoals have no identity from one decision to the next: the nearest one with the same action counts as the same.
    q_values = plan.q_values[: count * edges].reshape(count, edges)[:, intention.edge]
    away = jnp.max(jnp.abs(subgoals.cells - intention.cell[None]), axis=1)
    same = subgoals.mask & jnp.isfinite(q_values) & (away <= SAME_WITHIN)
    subgoal = jnp.argmin(jnp.where(same, away, SAME_WITHIN + 1)).astype(jnp.int32)
    # To finish is never put off: its cost is known and nothing is gained by looking further.
    acts = (plan.action != NO_ACTION) & (plan.action != count * edges)
    cheap_enough = q_values[subgoal] <= (1.0 + commitment) * plan.value
    keeps = acts & (intention.state == state) & jnp.any(same) & cheap_enough
    chosen = dataclasses.replace(
        plan,
        action=subgoal * edges + intention.edge,
        subgoal=subgoal,
        from_state=task.edges[intention.edge, 0],
        to_state=task.edges[intention.edge, 1],
        value=q_values[subgoal],
    )
    # What the search found about all actions stays as it is.
    names = ("action", "subgoal", "from_state", "to_state", "value")
    return dataclasses.replace(
        plan, **{name: jnp.where(keeps, getattr(chosen, name), getattr(plan, name)) for name in names}
    )


def intention_of(plan: Plan, state: Int32[Array, ""], subgoals: Subgoals, task: TaskArrays) -> Intention:
    """What a robot that carries out this plan is committed to.

    Args:
      plan: that is carried out.
      state: the automaton's state.
      subgoals: of the current belief.
      task: arrays of the task.

    Returns:
      The intention for the next decision.
    """
    edges = task.edge_mask.shape[0]
    acts = (plan.action != NO_ACTION) & (plan.action != subgoals.mask.shape[0] * edges)
    return Intention(
        # A cell, not an index: the next decision numbers its subgoals anew.
        cell=subgoals.cells[jnp.maximum(plan.subgoal, 0)],
        edge=jnp.where(acts, plan.action % edges, 0),
        state=jnp.where(acts, state, NO_STATE),
    )
