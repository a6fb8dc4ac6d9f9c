"""The loss of the estimator (Stein, Bradley and Roy 2018, as Bradley et al. 2021 use it).

For a sample with label y = P_S, predicted p, and weights w_S (what it costs to miss the success) and w_F (what a
failure taken costs),

    cross-entropy  -[y w_S log p + (1 - y) w_F log(1 - p)]
    success cost   y (R_S - predicted R_S)^2 / success_cost_scale^2
    failure cost   (1 - y) (R_F - predicted R_F)^2 / failure_cost_scale^2

averaged over samples and summed, the last two times ``cost_share``. The scales are the standard deviations over the
training data and stay in ``NetworkConfig``. The weights are divided by their mean over the training data. Weights that
differ between successes and failures move p away from the frequency of success: p / (1 - p) is multiplied by w_S / w_F.
``TrainingConfig.weighting`` mixes them with 1: at 1 the loss is the paper's, at 0 p is calibrated.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float32

from potlp_jax.errors import TrainingError
from potlp_jax.learning.batches import Batch
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.network import Answers, NetworkConfig


@struct.dataclass(kw_only=True)
class Sums:
    """Sums over samples, from which losses and scores follow; sums of several batches add up."""

    count: Float32[Array, ""]
    cross_entropy: Float32[Array, ""]
    """Weighted."""
    success_error: Float32[Array, ""]
    """Squared, in squared scales."""
    failure_error: Float32[Array, ""]
    successes: Float32[Array, ""]
    failures: Float32[Array, ""]
    brier: Float32[Array, ""]
    prior_brier: Float32[Array, ""]
    """Of the constant answer: the mean P_S of the training data."""


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
    def of(cls, samples: Samples) -> "DataScale":
        """The figures of these samples. Raises TrainingError where there are none."""
        if not len(samples.success):
            raise TrainingError("the data set has no samples")
        # The weight of what happened; a label between 0 and 1 is that share of a success.
        weight = samples.success * samples.success_weight + (1 - samples.success) * samples.failure_weight
        return cls(float(np.mean(weight, dtype=np.float64)), float(np.mean(samples.success, dtype=np.float64)))


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
    brier: float
    skill: float
    success_rmse: float
    failure_rmse: float


def network_config(
    samples: Samples,
    image_shape: tuple[int, int],
    exclusive_within: float = NetworkConfig.exclusive_within,
    fovea: int = NetworkConfig.fovea,
    second_widths: tuple[int, ...] = NetworkConfig.second_widths,
) -> NetworkConfig:
    """A network for these samples: their propositions and camera, and normalisers from their distances and costs.

    Args:
        samples: the training data.
        image_shape: rows and columns of their panoramas.
        exclusive_within, fovea, second_widths: as in ``NetworkConfig``; training does not depend on the first.

    Returns:
        The configuration, in which everything that was measured on the data is a number.

    Raises:
        TrainingError: a fovea is asked for, and the data do not say how their camera sees the floor.
    """
    step = float(samples.metadata.resolution)
    # Each cost is scaled by its spread where it counts in the loss.
    succeeded, failed = samples.success > 0, (samples.success < 1) & np.isfinite(samples.failure_cost)
    # Scales are rounded nowhere: they are part of what the network answers and stored with it.
    return NetworkConfig(
        propositions=tuple(samples.metadata.propositions),
        image_shape=image_shape,
        distance_scale=_spread(samples.distance, step),
        success_cost_scale=_spread(samples.success_cost[succeeded], step),
        failure_cost_scale=_spread(samples.failure_cost[failed], step),
        step=step,
        exclusive_within=exclusive_within,
        fovea=fovea,
        second_widths=second_widths,
        **(_geometry(samples) if fovea else {}),
    )


def _geometry(samples: Samples) -> dict[str, Any]:
    # Real data need not have these: a fovea is then refused, and everything else works.
    names, camera = ("horizon", "far", "fold"), samples.metadata.camera
    missing = [name for name in names if name not in camera]
    if missing:
        raise TrainingError(
            f"a fovea needs {', '.join(missing)} of the data set's camera (docs/camera.md): collect it again, or train "
            "without a fovea"
        )
    return {name: float(camera[name]) for name in names}


def _spread(values: np.ndarray, least: float) -> float:
    """Standard deviation, at least ``least``."""
    # In float64: a sum of a million squares in float32 loses digits. At least a cell, should all values be equal.
    return max(float(np.std(values, dtype=np.float64)), least) if len(values) else least


def loss_sums(answers: Answers, batch: Batch, config: NetworkConfig, scale: DataScale, weighting: float) -> Sums:
    """The sums over a batch; padding and costs that are not known count nothing.

    Args:
        answers: the network's, of the batch's shape.
        batch: labels, weights and mask (True: a real sample).
        config: of the network, for the scales of costs.
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
    )


def _squared_errors(predicted: Array, true: Array, known: Array, share: Array, scale: float) -> Array:
    # The label is replaced before the subtraction: a NaN behind `where` would still make the gradient NaN.
    error = (predicted - jnp.where(known, true, jnp.float32(0))) / jnp.float32(scale)
    return jnp.sum(jnp.where(known, share * error**2, jnp.float32(0)))


def total_loss(sums: Sums, cost_share: float) -> Float32[Array, ""]:
    """The loss that is minimised: all terms per sample."""
    return (sums.cross_entropy + cost_share * (sums.success_error + sums.failure_error)) / jnp.maximum(
        sums.count, jnp.float32(1)
    )


def evaluation_of(sums: Sums, config: NetworkConfig, cost_share: float) -> Evaluation:
    """The scores that follow from sums.

    Args:
        sums: over all samples that are scored.
        config: of the network, for the scales of costs.
        cost_share: factor of both cost terms in the loss.

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
        loss=float(total_loss(sums, cost_share)),
        cross_entropy=figures["cross_entropy"] / count,
        success_loss=figures["success_error"] / count,
        failure_loss=figures["failure_error"] / count,
        brier=figures["brier"] / count,
        skill=1 - figures["brier"] / figures["prior_brier"] if figures["prior_brier"] > 0 else float("nan"),
        success_rmse=rmse(figures["success_error"], figures["successes"], config.success_cost_scale),
        failure_rmse=rmse(figures["failure_error"], figures["failures"], config.failure_cost_scale),
    )
