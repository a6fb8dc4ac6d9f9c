"""Weights of the loss: what a wrong answer costs the robot (after Stein et al. 2018).

A success that is missed sends the robot to the next best subgoal for which the class is true: the weight is that
subgoal's D + R_S minus this one's. A failure that is taken for a success costs the fruitless exploration and its way
back: 2 R_F. Both are clipped, so that every sample counts, and none counts for all.

References:
  Stein et al., Learning over Subgoals for Efficient Navigation of Structured, Unknown Environments, CoRL 2018.
"""

import dataclasses
import math

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32

from potlp_jax.planning.estimates import Estimates


@dataclasses.dataclass(frozen=True)
class WeightBounds:
    """Bounds of the weights, in the unit of cost; ``low`` is positive."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not (0 < self.low <= self.high and math.isfinite(self.high)):
            raise ValueError(f"bounds of weights must be finite with 0 < low <= high, found {self}")

    @classmethod
    def of_map(cls, height: int, width: int, resolution: float) -> "WeightBounds":
        """A twentieth of, and the whole of, the sum of the map's sides.

        Args:
            height, width: of the map's array.
            resolution: side of a cell in the unit of cost.

        Returns:
            Bounds in the unit of cost.
        """
        # So that every sample counts, and none counts for all.
        size = (height + width) * resolution
        return cls(low=size / 20, high=size)


@struct.dataclass(kw_only=True)
class Weights:
    """What it costs to miss a success, and to take a failure for one, of every (subgoal, class).

    ``success`` is the least weight where the class is not true; both are 0 where masked.
    """

    success: Float32[Array, "*batch S C"]
    failure: Float32[Array, "*batch S C"]


def loss_weights(
    distance: Float32[Array, " S"], labels: Estimates, mask: Bool[Array, "S C"], bounds: WeightBounds
) -> Weights:
    """Weights of real pairs (``mask`` True), from the true labels of all subgoals of a view.

    Args:
        distance: D, from the robot to each subgoal.
        labels: the true ones of all subgoals of the view, seen or not.
        mask: True for real pairs.
        bounds: what weights are clipped to; static.

    Returns:
        Weights in the unit of cost. Where a class is true beyond no other subgoal, a missed success weighs
        ``bounds.high``.
    """
    count = distance.shape[0]
    holds = (labels.success_probability > 0) & mask
    total = distance[:, None] + labels.success_cost
    # [this subgoal, other subgoal, class]: whether another one would do as well.
    other = holds[None] & ~jnp.eye(count, dtype=bool)[:, :, None]
    best_other = jnp.min(jnp.where(other, total[None], jnp.inf), axis=1)
    # The best other may be better than this one: the clip makes such a miss weigh the least, and infinity the most.
    success = jnp.where(holds, jnp.clip(best_other - total, bounds.low, bounds.high), bounds.low)
    # There and back.
    failure = jnp.clip(2 * labels.failure_cost, bounds.low, bounds.high)
    return Weights(success=jnp.where(mask, success, 0.0), failure=jnp.where(mask, failure, 0.0))
