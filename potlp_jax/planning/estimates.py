"""What an estimator answers: P_S, R_S and R_F of each outcome class beyond each subgoal."""

import dataclasses
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.planning.distances.product import reachable_states
from potlp_jax.task.task import TaskArrays
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap


@struct.dataclass(kw_only=True)
class Estimates:
    """P_S, R_S and R_F of Bradley et al. 2021, Eq. 3, once per (subgoal, outcome class).

    Costs are in the unit of the map's resolution.

    Attributes:
      success_probability: P_S, in [0, 1].
      success_cost: R_S; positive everywhere, also where P_S is 0 and it means nothing.
      failure_cost: R_F, not negative.
    """

    success_probability: Float32[Array, "*batch S C"]
    success_cost: Float32[Array, "*batch S C"]
    failure_cost: Float32[Array, "*batch S C"]


@runtime_checkable
class Estimator(Protocol):
    """A pytree that can be called inside jit: the true map, or a network with its parameters.

    Args of a call:
      belief: what is known of the map.
      subgoals: where estimates are wanted; masked ones may get any.
      task: arrays of the task. ``task.class_mask`` is True for the classes that are asked for: a decision asks for
        what can still be attempted alone (``ask``), and reads nothing of the others.
    """

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates: ...


def ask(
    estimator: Estimator, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays, state: Int32[Array, ""]
) -> Estimates:
    """The estimates of all that can still be attempted; of the rest P_S is 0.

    Args:
      estimator: that answers.
      belief: what is known of the map.
      subgoals: where estimates are wanted.
      task: arrays of the task.
      state: the automaton's state.

    Returns:
      Estimates of every subgoal and class.
    """
    # Once the professor is found nobody asks where the professor is: those questions would be most of the work.
    ahead = dataclasses.replace(task, class_mask=classes_ahead(task, state))
    return estimator(belief, subgoals, ahead)


def classes_ahead(task: TaskArrays, state: Int32[Array, ""]) -> Bool[Array, " C"]:
    """The outcome classes of the edges that begin in a state that ``state`` can lead to."""
    # An edge that begins where the automaton can no longer get is never attempted.
    edges = task.edge_mask & reachable_states(task, state)[task.edges[:, 0]]
    conditions = jnp.zeros(task.condition_mask.shape, bool).at[task.edge_condition].max(edges)
    # A class is asked for if it is a cube of a condition of such an edge.
    own = jnp.arange(task.class_mask.shape[0], dtype=jnp.int32)
    members = task.condition_classes[:, :, None] == own[None, None, :]
    return task.class_mask & jnp.any(members & conditions[:, None, None], axis=(0, 1))
