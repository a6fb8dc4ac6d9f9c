"""The loss of the estimator (Stein, Bradley and Roy 2018, as Bradley et al. 2021 use it).

For a sample with label y = P_S, predicted p, and weights w_S (what it costs to miss the success) and w_F (what a
failure taken costs),

    cross-entropy  -[y w_S log p + (1 - y) w_F log(1 - p)]
    success cost   y (R_S - predicted R_S)^2 / success_cost_scale^2
    failure cost   (1 - y) (R_F - predicted R_F)^2 / failure_cost_scale^2

averaged over samples and summed, the last two times ``cost_share``. What a network says of the views themselves
(``building_learner``: the cross-entropy of its squares), averaged over views, is added times ``view_share``.

The scales are the standard deviations over the training data and stay in the network's configuration. The weights are
divided by their mean over the training data. Weights that differ between successes and failures move p away from the
frequency of success: p / (1 - p) is multiplied by w_S / w_F. ``TrainingConfig.weighting`` mixes them with 1: at 1 the
loss is the paper's, at 0 p is calibrated.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32

from potlp_jax.errors import TrainingError
from potlp_jax.learning.batches import Batch
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.network import Answers


@struct.dataclass(kw_only=True)
class Sums:
    """Sums over samples, from which losses and scores follow; sums of several batches, and of devices, add up."""

    count: Float32[Array, "*B"]
    cross_entropy: Float32[Array, "*B"]
    """Weighted."""
    success_error: Float32[Array, "*B"]
    """Squared, in squared scales."""
    failure_error: Float32[Array, "*B"]
    successes: Float32[Array, "*B"]
    failures: Float32[Array, "*B"]
    brier: Float32[Array, "*B"]
    prior_brier: Float32[Array, "*B"]
    """Of the constant answer: the mean P_S of the training data."""
    views: Float32[Array, "*B"]
    view_loss: Float32[Array, "*B"]
    """Of what the network says of a view beside its answers."""


@dataclasses.dataclass(frozen=True)
class DataScale:
    """Figures of the training data that the loss and the scores use.

    Attributes:
        mean_weight: mean over samples of the weight of what happened.
        prior: mean P_S, the constant answer that the Brier skill compares with.
    """

    mean_weight: float
    prior: float

    @classmethod
    def of(cls, samples: Samples, usable: Bool[np.ndarray, "N"] | None = None) -> "DataScale":
        """The figures of these samples.

        Args:
            samples: the training data.
            usable: those that are learned from (``Learner.usable``); all by default.

        Raises:
            TrainingError: there are none.
        """
        # A slice of all of them is no copy.
        chosen = slice(None) if usable is None or usable.all() else usable
        success = samples.success[chosen]
        if not len(success):
            raise TrainingError("the data set has no samples")
        # The weight of what happened; a label between 0 and 1 is that share of a success.
        weight = success * samples.success_weight[chosen] + (1 - success) * samples.failure_weight[chosen]
        return cls(float(np.mean(weight, dtype=np.float64)), float(np.mean(success, dtype=np.float64)))


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Scores over samples; losses as in this module's docstring, costs' errors in the unit of cost.

    ``skill`` is ``1 - brier / brier of the constant prior``. Errors of a label that does not occur are NaN.
    """

    samples: int
    loss: float
    cross_entropy: float
    success_loss: float
    failure_loss: float
    view_loss: float
    brier: float
    skill: float
    success_rmse: float
    failure_rmse: float


def loss_sums(
    answers: Answers, view_loss: Float32[Array, " G"], batch: Batch, config: Any, scale: DataScale, weighting: float
) -> Sums:
    """The sums over a batch; padding and costs that are not known count nothing.

    Args:
        answers: the network's, of the batch's shape.
        view_loss: of what the network says of the views.
        batch: labels, weights and mask (True: a real sample).
        config: of the network, for the scales of costs; of any architecture.
        scale: figures of the training data, also when validation data are summed.
        weighting: 1: weights as they are; 0: none; between: a mix.

    Returns:
        Sums in float32.
    """
    real = batch.mask.astype(jnp.float32)
    # Padding is replaced before anything is computed with it: 0 * NaN would still be NaN.
    success = jnp.where(batch.mask, batch.success, jnp.float32(0))
    mean = jnp.float32(scale.mean_weight)
    of_success = weighting * jnp.where(batch.mask, batch.success_weight, jnp.float32(0)) / mean + (1 - weighting)
    of_failure = weighting * jnp.where(batch.mask, batch.failure_weight, jnp.float32(0)) / mean + (1 - weighting)
    # softplus(-x) = -log sigmoid(x) and softplus(x) = -log(1 - sigmoid(x)), without overflow.
    missed = success * of_success * jax.nn.softplus(-answers.success_logit)
    taken = (1 - success) * of_failure * jax.nn.softplus(answers.success_logit)
    probability = answers.success_probability
    # Each cost counts by the share of its outcome: of a label of 0 < P_S < 1, as real data may have, both do.
    known_success = batch.mask & jnp.isfinite(batch.success_cost)
    known_failure = batch.mask & jnp.isfinite(batch.failure_cost)
    return Sums(
        count=jnp.sum(real),
        cross_entropy=jnp.sum(real * (missed + taken)),
        success_error=_squared_errors(
            answers.success_cost, batch.success_cost, known_success, success, config.success_cost_scale
        ),
        failure_error=_squared_errors(
            answers.failure_cost, batch.failure_cost, known_failure, 1 - success, config.failure_cost_scale
        ),
        successes=jnp.sum(jnp.where(known_success, success, jnp.float32(0))),
        failures=jnp.sum(jnp.where(known_failure, 1 - success, jnp.float32(0))),
        brier=jnp.sum(real * (probability - success) ** 2),
        prior_brier=jnp.sum(real * (jnp.float32(scale.prior) - success) ** 2),
        views=jnp.sum(jnp.any(batch.mask, axis=1), dtype=jnp.float32),
        view_loss=jnp.sum(view_loss),
    )


def _squared_errors(predicted: Array, true: Array, known: Array, share: Array, scale: float) -> Array:
    # The label is replaced before the subtraction: a NaN behind `where` would still make the gradient NaN.
    error = (predicted - jnp.where(known, true, jnp.float32(0))) / jnp.float32(scale)
    return jnp.sum(jnp.where(known, share * error**2, jnp.float32(0)))


def total_loss(sums: Sums, cost_share: float, view_share: float) -> Float32[Array, ""]:
    """The loss that is minimised: terms per sample, and that of the views.

    Args:
        sums: over a batch.
        cost_share, view_share: factors of both cost terms, and of the views' term.

    Returns:
        A number to be made small; 0 of an empty batch.
    """
    of_samples = sums.cross_entropy + cost_share * (sums.success_error + sums.failure_error)
    of_views = view_share * sums.view_loss / jnp.maximum(sums.views, jnp.float32(1))
    return of_samples / jnp.maximum(sums.count, jnp.float32(1)) + of_views


def evaluation_of(sums: Sums, config: Any, cost_share: float, view_share: float) -> Evaluation:
    """The scores that follow from sums.

    Args:
        sums: over all samples that are scored.
        config: of the network, for the scales of costs.
        cost_share, view_share: factors of both cost terms, and of the views' term, in the loss.

    Returns:
        Scores; NaN where nothing of a kind happened.
    """
    # On the host, in float64, where a quotient of sums loses nothing more.
    figures = {field.name: float(getattr(sums, field.name)) for field in dataclasses.fields(sums)}
    # The sums of no samples are 0, and so are their means.
    count = max(figures["count"], 1.0)

    def rmse(error: float, number: float, scale: float) -> float:
        return scale * (error / number) ** 0.5 if number > 0 else float("nan")

    return Evaluation(
        samples=int(figures["count"]),
        loss=float(total_loss(sums, cost_share, view_share)),
        cross_entropy=figures["cross_entropy"] / count,
        success_loss=figures["success_error"] / count,
        failure_loss=figures["failure_error"] / count,
        view_loss=figures["view_loss"] / max(figures["views"], 1.0),
        brier=figures["brier"] / count,
        skill=1 - figures["brier"] / figures["prior_brier"] if figures["prior_brier"] > 0 else float("nan"),
        success_rmse=rmse(figures["success_error"], figures["successes"], config.success_cost_scale),
        failure_rmse=rmse(figures["failure_error"], figures["failures"], config.failure_cost_scale),
    )
