"""An estimator's answers to the samples of a data set: whether they mean anything, all of them, the most confident."""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from potlp_jax.errors import EvaluationError
from potlp_jax.learning.architectures import EstimatorConfig
from potlp_jax.learning.batches import Batch, Batches
from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.dataset import Samples, decode
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.learner import Learner
from potlp_jax.learning.made_from import nearest_misfit
from potlp_jax.learning.network import Answers, Params, require_propositions

# As in training by default: the answers do not depend on it, only the memory and the time.
_VIEWS_PER_BATCH = 16
_SAMPLES_PER_VIEW = 16


@dataclass(frozen=True)
class Predictions:
    """What an estimator says of each sample of a data set, in the data set's order."""

    success_logit: Float32[np.ndarray, "N"]
    """Log odds of P_S."""
    success_cost: Float32[np.ndarray, "N"]
    """R_S, in the unit of cost."""
    failure_cost: Float32[np.ndarray, "N"]
    """R_F, in the unit of cost."""

    @property
    def success(self) -> Float64[np.ndarray, "N"]:
        """P_S."""
        # In float64 and without overflow on either side.
        return np.exp(-np.logaddexp(0.0, -self.success_logit.astype(np.float64)))


Columns = TypeVar("Columns", Samples, Predictions)


def check_fit(
    config: EstimatorConfig,
    domain: Domain,
    samples: Samples,
    estimator: str,
    dataset: str,
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Whether the estimator's answers mean the same as the data set's labels.

    Args:
        config: the estimator's network.
        domain: of the worlds that the estimator learned from.
        samples: the data set.
        estimator, dataset: their names in messages.
        metadata: of the estimator's file, which say how its labels were made.

    Raises:
        PropositionsError: other propositions.
        EvaluationError: another size of panorama, another camera, another unit of cost, labels of another kind, or maps
            with other cells or painted in another way than those it learned from.
    """
    require_propositions(config.propositions, tuple(samples.metadata.propositions), estimator, asker=dataset)
    if not samples.images:
        raise EvaluationError(f"{dataset} has no panoramas")
    size = decode(samples.images[0]).shape[:2]
    if size != config.image_shape:
        raise EvaluationError(
            f"{dataset} has panoramas of {size} pixels; {estimator} was made for {config.image_shape}"
        )
    # The unit and the camera decide what the numbers and pictures mean; another split or family is fair to ask about.
    misfits = domain.measure_misfits(samples.metadata.domain)
    if misfits:
        raise EvaluationError(
            f"{dataset} is not what {estimator} learned from: {'; '.join(misfits)}. Collect a data set with the same, "
            "or train an estimator for this one"
        )
    misfit = nearest_misfit(metadata or {}, samples.metadata.nearest)
    if misfit is not None:
        raise EvaluationError(f"{dataset} does not ask what {estimator} answers: {misfit}")
    # In a trial it looks at cells of its own (``learning.resampling``); maps of data sets are read as they are.
    if isinstance(config, BuildingConfig) and not math.isclose(config.step, samples.metadata.resolution, rel_tol=1e-4):
        raise EvaluationError(
            f"{dataset} has maps with cells of {samples.metadata.resolution:g}, {estimator} learned from cells of "
            f"{config.step:g}; collect a data set on such maps, or train an estimator for this one"
        )
    if isinstance(config, BuildingConfig) and config.glances != samples.metadata.glances:
        painted = {True: "with", False: "without"}
        raise EvaluationError(
            f"{dataset} was painted {painted[samples.metadata.glances]} glances, the maps that {estimator} learned "
            f"from {painted[config.glances]}; collect it again with --set glances={str(config.glances).lower()}"
        )


def answerable(learner: Learner, samples: Samples) -> Samples:
    """The samples that an estimator can answer: a panorama network those in view, a building network all."""
    return part_of(samples, learner.usable(samples))


def predict(
    learner: Learner, params: Params, samples: Samples, on_progress: Callable[[int], None] = lambda done: None
) -> Predictions:
    """The estimator's answers to all samples.

    Args:
        learner, params: the estimator.
        samples: what is asked; all must be such as the estimator can answer (``answerable``).
        on_progress: told the number of answers so far, after every batch.

    Returns:
        Answers in the order of the samples.

    Raises:
        TrainingError: there are no samples.
    """
    step = _make_answer_step(learner)
    names = tuple(Answers.__dataclass_fields__)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    done = 0
    batches = Batches(samples, learner.inputs, _VIEWS_PER_BATCH, _SAMPLES_PER_VIEW, seed=0)
    for batch in batches.evaluation_batches():
        answers, mask = step(params, batch), np.asarray(batch.mask)
        for name in names:
            rows[name].append(np.asarray(getattr(answers, name))[mask])
        done += int(mask.sum())
        on_progress(done)
    # Batches give the samples view by view.
    columns = {name: np.empty(len(samples.success), np.float32) for name in names}
    for name in names:
        columns[name][batches.order] = np.concatenate(rows[name])
    return Predictions(**columns)


def most_confident(samples: Samples, predictions: Predictions, count: int) -> dict[str, Int64[np.ndarray, " k"]]:
    """Up to ``count`` samples each of the most confident answers that are right or wrong, one per panorama.

    Args:
        samples: the data set.
        predictions: in the order of the samples.
        count: of each kind, at most.

    Returns:
        Indices by kind: ``true positives``, ``true negatives``, ``false positives``, ``false negatives``. A label
        counts as a success from one half on.
    """
    happened, logit = samples.success >= 0.5, predictions.success_logit
    kinds = {
        "true positives": (happened & (logit >= 0), -logit),
        "true negatives": (~happened & (logit < 0), logit),
        "false positives": (~happened & (logit >= 0), -logit),
        "false negatives": (happened & (logit < 0), logit),
    }
    chosen = {}
    for name, (belongs, doubt) in kinds.items():
        order = np.argsort(doubt, kind="stable")
        order = order[belongs[order]]
        # The first of each panorama in this order is its most confident one.
        _, first = np.unique(samples.view_of[order], return_index=True)
        chosen[name] = order[np.sort(first)[:count]]
    return chosen


def part_of(columns: Columns, chosen: Bool[np.ndarray, "N"] | slice) -> Columns:
    """Some of the samples, or of the predictions; images and maps are not touched."""
    arrays = {field.name: getattr(columns, field.name) for field in dataclasses.fields(columns)}
    # One entry a view, not a sample.
    of_views = {"world_of"}
    return dataclasses.replace(
        columns,
        **{
            name: array[chosen]
            for name, array in arrays.items()
            if isinstance(array, np.ndarray) and name not in of_views
        },
    )


@functools.lru_cache(8)
def _make_answer_step(learner: Learner) -> Callable[[Params, Batch], Answers]:
    """The compiled answers to one batch, not augmented."""

    @jax.jit
    def answer_step(params: Params, batch: Batch) -> Answers:
        answers, _ = learner.answers(params, batch.inputs, batch.phi_stay, batch.phi_go)
        return answers

    return answer_step
