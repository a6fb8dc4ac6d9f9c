"""How good an estimator's predictions are: figures of a data set, and of parts of it.

For samples with label y = P_S (0 or 1; real data may lie between) and prediction p:

- Brier score: mean of (p - y)^2. Skill over the constant prior q: 1 - Brier / mean of (q - y)^2: 1 is perfect, 0 no
  better than saying q always. The prior is one number for all groups of samples; ``own_skill`` compares with the
  group's own mean instead, which is harder.
- Log loss: mean of -[y log p + (1 - y) log(1 - p)].
- ROC-AUC: probability that a random success is given a larger p than a random failure, ties counting half.
- Calibration error: mean of |mean p - mean y| over ``BINS`` bins of p of equal width, weighted by their samples.
- Errors of R_S over successes (weight y) and of R_F over failures (weight 1 - y): MAE, RMSE, bias = mean of predicted
  - true, R^2 = 1 - squared error / squared error of the constant mean of these very samples, and the calibration error:
  mean of |mean predicted - mean true| over ``BINS`` bins of the predicted cost with equally many samples each, as far
  as ties allow, weighted by their weight.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64

from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.predictions import Predictions, part_of

# Ten is usual for reliability diagrams.
BINS: int = 10

DISTANCE_BANDS: tuple[float, ...] = (15.0, 30.0, 60.0, 120.0)
"""Bounds between the bands of distance, in sides of a cell."""


@dataclass(frozen=True)
class Prior:
    """The constant answer that the skill compares with.

    Attributes:
        value: a mean of P_S.
        source: ``training``: of the data that the estimator was trained on; ``evaluated``: of the data it is
            evaluated on, where the estimator's metadata do not say the former. The latter is the harder opponent.
    """

    value: float
    source: str


@dataclass(frozen=True)
class CostBin:
    """Costs with low <= predicted <= high; equal predictions share a bin.

    Attributes:
        low, high: the least and the largest prediction.
        samples: how many there are.
        predicted, true: weighted means.
        spread: weighted standard deviation of the true costs.
    """

    low: float
    high: float
    samples: int
    predicted: float
    true: float
    spread: float


@dataclass(frozen=True)
class CostErrors:
    """Errors of R_S or R_F over the samples where it is defined; NaN, and no bins, where there are none."""

    samples: int
    mae: float
    rmse: float
    bias: float
    r2: float
    calibration_error: float
    bins: tuple[CostBin, ...]


@dataclass(frozen=True)
class ReliabilityBin:
    """Predictions p with low <= p < high (the last bin includes 1); means are NaN where there are none."""

    low: float
    high: float
    samples: int
    predicted: float
    observed: float


@dataclass(frozen=True)
class Figures:
    """The figures of some samples, as in this module's docstring; NaN where one is not defined."""

    samples: int
    success_rate: float
    brier: float
    skill: float
    own_skill: float
    log_loss: float
    auc: float
    calibration_error: float
    success_cost: CostErrors
    failure_cost: CostErrors
    bins: tuple[ReliabilityBin, ...]


@dataclass(frozen=True)
class Report:
    """The figures of a data set.

    Attributes:
        overall: of all samples.
        groups: of parts of them: by ``proposition`` asked for (a sample that asks for two is in both), by the number
            of propositions ``avoided`` on the way, by ``distance``. Parts without samples are left out.
    """

    overall: Figures
    groups: Mapping[str, Mapping[str, Figures]]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, NaN where a figure is not defined."""
        groups = {
            name: {part: dataclasses.asdict(figures) for part, figures in parts.items()}
            for name, parts in self.groups.items()
        }
        return {"overall": dataclasses.asdict(self.overall), "groups": groups}


def prior_of(metadata: Mapping[str, Any], samples: Samples) -> Prior:
    """The mean P_S of the training data if the estimator's metadata have it (``prior``), else of these samples."""
    # Metadata are anybody's JSON: a prior that is none is not worth an error, and the report says which one was used.
    stored = metadata.get("prior")
    if isinstance(stored, int | float) and 0 <= stored <= 1:
        return Prior(float(stored), "training")
    return Prior(float(np.mean(samples.success, dtype=np.float64)), "evaluated")


def evaluate(samples: Samples, predictions: Predictions, prior: Prior) -> Report:
    """All figures, of all samples and of each group.

    Args:
        samples: the intact ones, also for the predictions of an ablation: groups are by what was really asked.
        predictions: in the order of the samples.
        prior: the constant answer that skills compare with.

    Returns:
        The report; groups without a sample have no entry.
    """

    def of(chosen: np.ndarray | slice) -> Figures:
        return figures_of(part_of(samples, chosen), part_of(predictions, chosen), prior)

    groups = {
        name: {part: of(chosen) for part, chosen in parts.items() if chosen.any()}
        for name, parts in groups_of(samples).items()
    }
    return Report(of(slice(None)), groups)


def groups_of(samples: Samples) -> dict[str, dict[str, Bool[np.ndarray, "N"]]]:
    """Which samples belong to the parts of each group (see ``Report``)."""
    # +1: the class asks for the proposition; -1 in phi_stay: it must be avoided on the way.
    asked = {name: samples.phi_go[:, p] == 1 for p, name in enumerate(samples.metadata.propositions)}
    avoided = np.sum(samples.phi_stay == -1, axis=1)
    # In cells, so that families with other units have the same bands.
    bounds = (0.0, *(bound * samples.metadata.resolution for bound in DISTANCE_BANDS), np.inf)
    bands = {}
    for low, high in itertools.pairwise(bounds):
        name = f"{low:g} to {high:g}" if np.isfinite(high) else f"over {low:g}"
        bands[name] = (samples.distance >= low) & (samples.distance < high)
    counts = range(len(samples.metadata.propositions) + 1)
    return {"proposition": asked, "avoided": {str(n): avoided == n for n in counts}, "distance": bands}


def figures_of(samples: Samples, predictions: Predictions, prior: Prior) -> Figures:
    """The figures of some samples.

    Args:
        samples: at least one.
        predictions: in the order of the samples.
        prior: the constant answer that ``skill`` compares with.

    Returns:
        The figures; NaN where one is not defined.
    """
    true, said = samples.success.astype(np.float64), predictions.success
    logit = predictions.success_logit.astype(np.float64)
    rate, brier = float(true.mean()), float(np.mean((said - true) ** 2))
    bins = reliability(true, said)
    # Empty bins have no mean, and weigh nothing.
    gaps = [bin.samples * abs(bin.predicted - bin.observed) for bin in bins if bin.samples]
    return Figures(
        samples=len(true),
        success_rate=rate,
        brier=brier,
        skill=_gain(brier, float(np.mean((prior.value - true) ** 2))),
        own_skill=_gain(brier, float(np.mean((rate - true) ** 2))),
        # From the log odds: the logarithm of a probability that was rounded to 0 or 1 would be infinite.
        log_loss=float(np.mean(true * np.logaddexp(0, -logit) + (1 - true) * np.logaddexp(0, logit))),
        auc=roc_auc(true, logit),
        calibration_error=sum(gaps) / len(true),
        success_cost=cost_errors(samples.success_cost, predictions.success_cost, true),
        failure_cost=cost_errors(samples.failure_cost, predictions.failure_cost, 1 - true),
        bins=bins,
    )


def reliability(true: Float64[np.ndarray, "N"], said: Float64[np.ndarray, "N"]) -> tuple[ReliabilityBin, ...]:
    """The bins of a reliability diagram."""
    # p = 1 belongs to the last bin.
    index = np.minimum((said * BINS).astype(np.int64), BINS - 1)
    counts = np.bincount(index, minlength=BINS)
    # 0 / 0 in an empty bin is the NaN that says so.
    with np.errstate(invalid="ignore"):
        predicted, observed = (np.bincount(index, values, BINS) / counts for values in (said, true))
    return tuple(
        ReliabilityBin(b / BINS, (b + 1) / BINS, int(counts[b]), float(predicted[b]), float(observed[b]))
        for b in range(BINS)
    )


def roc_auc(true: Float64[np.ndarray, "N"], score: Float64[np.ndarray, "N"]) -> float:
    """The area under the ROC curve; a label between 0 and 1 is that share of a success. NaN where one kind is missing.

    By ranks: a success beats the failures with lower scores, and half of those with its own.
    """
    _, rank = np.unique(score, return_inverse=True)
    successes, failures = np.bincount(rank, true), np.bincount(rank, 1 - true)
    pairs = successes.sum() * failures.sum()
    # Equal scores share a rank, so a constant answer has an area of one half.
    below = np.cumsum(failures) - failures
    return float(np.sum(successes * (below + failures / 2)) / pairs) if pairs > 0 else float("nan")


def cost_errors(
    true: Float32[np.ndarray, "N"], said: Float32[np.ndarray, "N"], share: Float64[np.ndarray, "N"]
) -> CostErrors:
    """Errors over samples with a positive share and a known cost, weighted by the share.

    Args:
        true: the costs, NaN where they are not known.
        said: the estimator's.
        share: to which part each sample is of the kind whose cost this is: P_S for R_S, 1 - P_S for R_F.

    Returns:
        The errors in the unit of the costs; NaN where no sample counts.
    """
    known = (share > 0) & np.isfinite(true)
    if not known.any():
        return CostErrors(0, *[float("nan")] * 5, bins=())
    weight, target, answer = share[known], true[known].astype(np.float64), said[known].astype(np.float64)
    error = answer - target
    bins, weights = cost_bins(target, answer, weight)
    squared = float(np.average(error**2, weights=weight))
    variance = float(np.average((target - np.average(target, weights=weight)) ** 2, weights=weight))
    return CostErrors(
        samples=int(known.sum()),
        mae=float(np.average(np.abs(error), weights=weight)),
        rmse=squared**0.5,
        bias=float(np.average(error, weights=weight)),
        r2=_gain(squared, variance),
        calibration_error=float(np.average([abs(bin.predicted - bin.true) for bin in bins], weights=weights)),
        bins=bins,
    )


def cost_bins(
    true: Float64[np.ndarray, "N"], said: Float64[np.ndarray, "N"], weight: Float64[np.ndarray, "N"]
) -> tuple[tuple[CostBin, ...], Float64[np.ndarray, " k"]]:
    """Up to ``BINS`` bins of the predicted cost with equally many samples each, as far as ties allow.

    Args:
        true, said: at least one of each.
        weight: of each sample, positive.

    Returns:
        The bins by increasing cost, and the weight in each.
    """
    # Costs have long tails: of bins of equal width the last ones would be empty.
    bounds = np.quantile(said, np.arange(1, BINS) / BINS, method="lower")
    index = np.searchsorted(np.unique(bounds), said, side="left")
    bins, weights = [], []
    for number in np.unique(index):
        inside = index == number
        mean = np.average(true[inside], weights=weight[inside])
        variance = np.average((true[inside] - mean) ** 2, weights=weight[inside])
        bins.append(
            CostBin(
                low=float(said[inside].min()),
                high=float(said[inside].max()),
                samples=int(inside.sum()),
                predicted=float(np.average(said[inside], weights=weight[inside])),
                true=float(mean),
                spread=float(variance**0.5),
            )
        )
        weights.append(weight[inside].sum())
    return tuple(bins), np.array(weights)


def _gain(error: float, reference: float) -> float:
    return 1 - error / reference if reference > 0 else float("nan")
