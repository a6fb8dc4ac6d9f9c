"""What an estimator answers: P_S, R_S and R_F of each outcome class beyond each subgoal."""

import dataclasses
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.errors import EstimatesError
from potlp_jax.planning.distances.product import reachable_states
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import TaskArrays
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap


@struct.dataclass(kw_only=True)
class Estimates:
    """P_S, R_S and R_F of Bradley et al. 2021, Eq. 3, once per (subgoal, outcome class).

    Costs are in the unit of the map's resolution. Entries of masked subgoals and of classes that are not asked for may
    hold anything; one value among the others that is not allowed, and the decision is flagged ``Status.INVALID`` and
    plans with none of them.

    Attributes:
      success_probability: P_S, in [0, 1].
      success_cost: R_S; positive and finite everywhere, also where P_S is 0 and it means nothing.
      failure_cost: R_F, finite and not negative.
      status: bits of ``types.Status`` that the estimator reports to the trial; None: it has none.
    """

    success_probability: Float32[Array, "*batch S C"]
    success_cost: Float32[Array, "*batch S C"]
    failure_cost: Float32[Array, "*batch S C"]
    # None, not zero: estimates of a caller's own are batched by vmap, which takes no scalar among arrays.
    status: UInt32[Array, "*batch"] | None = None


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

    Raises:
      EstimatesError: the estimator's answer is not ``Estimates``, or an array of it has another shape than
        ``[subgoals, classes]``.
      PropositionsError: belief and task are not over the same propositions.
    """
    require_same_propositions(task.propositions, belief.propositions, knower="the belief")
    # Once the professor is found nobody asks where the professor is: those questions would be most of the work.
    ahead = dataclasses.replace(task, class_mask=classes_ahead(task, state))
    found = estimator(belief, subgoals, ahead)
    check_shapes(found, subgoals.mask.shape[0], task.class_mask.shape[0])
    # What was not asked for may hold anything; from here on it is as if it could not succeed.
    asked = ahead.class_mask[None, :]
    return Estimates(
        success_probability=jnp.where(asked, found.success_probability, 0.0),
        success_cost=jnp.where(asked, found.success_cost, 1.0),
        failure_cost=jnp.where(asked, found.failure_cost, 0.0),
        status=found.status,
    )


def check_shapes(estimates: Estimates, subgoals: int, classes: int) -> None:
    """Check the shapes of unbatched estimates; also while tracing, when shapes are all that is known.

    Args:
      estimates: from an estimator, or a caller's own.
      subgoals: S, padding included.
      classes: C of the task, padding included.

    Raises:
      EstimatesError: the estimates are something else, or an array has another shape than ``[subgoals, classes]``; the
        message names it, its shape and the one expected.
    """
    if not isinstance(estimates, Estimates):
        raise EstimatesError(f"the estimator answered {type(estimates).__name__}, expected Estimates")
    # Not left to broadcasting: [S, 1] would pass for the same answer to every class.
    for name in ("success_probability", "success_cost", "failure_cost"):
        found = jnp.shape(getattr(estimates, name))
        if found != (subgoals, classes):
            raise EstimatesError(
                f"the estimates' {name} has shape {found}, expected {(subgoals, classes)}: {subgoals} subgoals and "
                f"{classes} outcome classes"
            )


def classes_ahead(task: TaskArrays, state: Int32[Array, ""]) -> Bool[Array, " C"]:
    """The outcome classes of the edges that begin in a state that ``state`` can lead to."""
    # An edge that begins where the automaton can no longer get is never attempted.
    edges = task.edge_mask & reachable_states(task, state)[task.edges[:, 0]]
    conditions = jnp.zeros(task.condition_mask.shape, bool).at[task.edge_condition].max(edges)
    # A class is asked for if it is a cube of a condition of such an edge.
    own = jnp.arange(task.class_mask.shape[0], dtype=jnp.int32)
    members = task.condition_classes[:, :, None] == own[None, None, :]
    return task.class_mask & jnp.any(members & conditions[:, None, None], axis=(0, 1))
