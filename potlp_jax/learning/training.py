"""Training of the estimator: a loop over the steps of ``training_steps`` that can be killed at any time.

**Order.** The batch of a step depends on (seed, step) alone: every epoch has its own permutation of the views and its
own choice of samples. Augmentation depends on (key, step). So a training that is resumed from a checkpoint does what it
would have done, bit for bit, on the same machine, devices and versions.

**Devices.** The views of a batch are shared out between all devices of all processes that share the training
(``devices``). With another number of them sums are added in another order, so that losses and parameters differ in
their last bits at first, and nothing else does: a training may be resumed with any number.
"""

import dataclasses
import json
import time
import zlib
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.errors import TrainingError
from potlp_jax.learning.batches import Batch, Batches, Share, prefetched
from potlp_jax.learning.checkpoints import checkpoint_steps, load_checkpoint, save_checkpoint
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.devices import agreed, everywhere, require_agreement, shared_out
from potlp_jax.learning.estimator import TrainedEstimator, identity_of
from potlp_jax.learning.learner import Learner
from potlp_jax.learning.loss import DataScale, Evaluation, evaluation_of
from potlp_jax.learning.network import Params
from potlp_jax.learning.training_options import TrainingConfig
from potlp_jax.learning.training_steps import (
    TrainState,
    initial_state,
    learning_rate_schedule,
    make_evaluate_step,
    make_train_step,
    no_sums,
)


@dataclasses.dataclass(frozen=True)
class Progress:
    """What the observer of a training is told after every evaluation."""

    step: int
    epoch: float
    seconds: float
    """Since the start, over all resumptions."""
    learning_rate: float
    training: Evaluation
    """Mean over the batches since the last evaluation, augmented, at the parameters of each step."""
    validation: Evaluation
    best_step: int


@dataclasses.dataclass(frozen=True)
class Trained:
    """The end of a training: the best parameters, and why it ended (``planned``, ``patience`` or ``time``)."""

    params: Params
    best_step: int
    best_loss: float
    steps: int
    reason: str
    seconds: float


def check_data(training: Samples, validation: Samples) -> None:
    """Raises TrainingError where the two data sets do not belong together."""
    # The split may differ, and should: everything that decides what a row means may not.
    for name in ("propositions", "environment", "camera", "unit", "resolution", "glances", "nearest"):
        one, other = getattr(training.metadata, name), getattr(validation.metadata, name)
        if one != other:
            # A log's environment is a name that is given; those of simulated worlds are not to be renamed.
            logs = "log" in (training.metadata.source, validation.metadata.source)
            hint = "; logs of one kind of building get one name: potlp log to-dataset ... --environment NAME"
            raise TrainingError(
                f"the data sets differ in {name}: {one} for training, {other} for validation"
                + (hint if logs and name == "environment" else "")
            )


def batches_of(learner: Learner, samples: Samples, config: TrainingConfig) -> Batches:
    """The batches of a data set as a learner is shown them: this process's rows of them.

    Args:
        learner: chooses the samples that it can answer.
        samples: of the data set.
        config: of the training, with the sizes of a batch and the seed of the order.

    Returns:
        The batches, each a function of its number.
    """
    return Batches(
        samples,
        learner.inputs,
        config.views_per_batch,
        config.samples_per_view,
        config.seed,
        learner.usable(samples),
        Share(jax.process_index(), jax.process_count(), jax.device_count()),
    )


def scale_of(learner: Learner, training: Samples) -> DataScale:
    """The figures of what is learned from: a panorama network never sees the samples out of view."""
    return DataScale.of(training, learner.usable(training))


def seconds_per_step(learner: Learner, training: Samples, config: TrainingConfig, steps: int = 8) -> float:
    """Measured time of a step with its share of decoding, after compilation; nothing is kept of these steps.

    Args:
        learner, training, config: as for ``train``.
        steps: how many are timed.

    Returns:
        Seconds.
    """
    batches = batches_of(learner, training, config)
    train_step = make_train_step(learner, config, scale_of(learner, training))
    state = everywhere(initial_state(learner, config))
    started = 0.0
    for number, batch in enumerate(prefetched(batches.training_batch, 0, steps + 2)):
        # Two steps first: the one that compiles, and one that finds what was decoded during that.
        if number == 2:
            started = time.perf_counter()
        state, value = train_step(state, shared_out(batch))
        value.block_until_ready()
    return (time.perf_counter() - started) / steps


def steps_per_epoch(learner: Learner, training: Samples, config: TrainingConfig) -> int:
    """Batches in an epoch."""
    return batches_of(learner, training, config).per_epoch


def provenance(training: Samples, validation: Samples, initial: TrainedEstimator | None) -> dict[str, Any]:
    """What a training is made from; JSON-able.

    Args:
        training, validation: its data.
        initial: the estimator that it goes on from.

    Returns:
        The sources of both data sets, by number, and the estimator's identity.
    """

    # By number and not as a list, so that what differs is named by itself.
    def data(samples: Samples) -> dict[str, Any]:
        return {str(number): dataclasses.asdict(source) for number, source in enumerate(samples.sources)}

    return {
        "training_data": data(training),
        "validation_data": data(validation),
        "initial": None if initial is None else identity_of(initial),
    }


def training_identity(
    learner: Learner,
    training: Samples,
    validation: Samples,
    config: TrainingConfig,
    initial: TrainedEstimator | None = None,
) -> dict[str, Any]:
    """What must be equal for a training to be resumed.

    Args:
        learner: what is trained.
        training, validation: the data.
        config: how.
        initial: what it goes on from.

    Returns:
        JSON-able; differences are named on loading. Versions are part of it; the number of devices is not.
    """
    return {
        "network": dataclasses.asdict(learner.config),
        "training": dataclasses.asdict(config),
        **provenance(training, validation, initial),
        "versions": {name: version(name) for name in ("jax", "jaxlib", "flax", "optax", "numpy")},
    }


def train(
    learner: Learner,
    training: Samples,
    validation: Samples,
    config: TrainingConfig,
    *,
    initial: TrainedEstimator | None = None,
    folder: Path | None = None,
    budget_seconds: float = float("inf"),
    on_start: Callable[[int], None] = lambda step: None,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
    on_evaluation: Callable[[Progress], None] = lambda progress: None,
) -> Trained:
    """Train, from the newest checkpoint in ``folder`` if there is one, and give the best parameters.

    Args:
        learner: what is trained.
        training: what is learned from.
        validation: of other worlds; decides which parameters are the best.
        config: how, and for how many steps.
        initial: its parameters are begun with; new ones by default.
        folder: where checkpoints go, one that all processes of the training see; None for none.
        budget_seconds: training stops after this time, over all resumptions, also where steps are left.
        on_start: told the number of steps already done.
        on_step: told the number of steps done and the last batch's loss.
        on_evaluation: told the scores after every epoch and at the end.

    Returns:
        The best parameters by validation loss, and why training ended.

    Raises:
        TrainingError: the data do not fit, the loss is not finite, or processes that share the training were given
            different things.
        CheckpointError: the newest checkpoint is damaged or of another training.
    """
    # Everything that a checkpoint must hold is in the loop's state: what stands here may be killed at any line.
    check_data(training, validation)
    loop = _Loop(learner, training, validation, config, folder, initial, budget_seconds)
    on_start(loop.steps_done)
    # Decoding of the next batches goes on while the device is busy with this one.
    remaining = prefetched(loop.batches.training_batch, loop.steps_done, config.steps)
    # A training that was over already, as after a second start, makes no step.
    for batch in remaining if loop.reason is None else ():
        on_step(loop.steps_done + 1, loop.advance(batch))
        # The parameters at the end are worth evaluating whatever ended the training.
        if loop.steps_done % loop.batches.per_epoch == 0 or loop.steps_done == config.steps or loop.out_of_time:
            on_evaluation(loop.evaluate())
            loop.save()
        elif loop.steps_done % config.checkpoint_steps == 0:
            loop.save()
        if loop.reason is not None:
            break
    return loop.result()


class _Loop:
    """The state of a running training, on the host."""

    def __init__(
        self,
        learner: Learner,
        training: Samples,
        validation: Samples,
        config: TrainingConfig,
        folder: Path | None,
        initial: TrainedEstimator | None,
        budget_seconds: float,
    ) -> None:
        self._learner, self._config, self._folder = learner, config, folder
        self._budget = budget_seconds
        # Figures of the training data also scale the validation loss: they belong to the loss, not to the data.
        scale = scale_of(learner, training)
        self.batches = batches_of(learner, training, config)
        self._validation = batches_of(learner, validation, config)
        self._identity = training_identity(learner, training, validation, config, initial)
        require_agreement(zlib.crc32(json.dumps(self._identity, sort_keys=True).encode()), "data, settings or versions")
        self._train_step = make_train_step(learner, config, scale)
        self._evaluate_step = make_evaluate_step(learner, scale, config.weighting)
        self._schedule = learning_rate_schedule(config)
        self._state, before = self._begun(None if initial is None else initial.params)
        # Time counts over all starts, so that a budget is kept.
        self._started, self._spent = time.perf_counter() - before, before
        self.steps_done = int(self._state.step)
        self.out_of_time = self._is_out_of_time()
        """Whether the budget was spent when the last step ended."""

    def _begun(self, params: Any) -> tuple[TrainState, float]:
        """The state to go on from, on all devices, and the seconds that were spent on it."""
        state, before = initial_state(self._learner, self._config, params), 0.0
        if self._folder is not None:
            # The first process's list counts: another one may see a file later.
            newest = int(agreed(np.int32(max(checkpoint_steps(self._folder), default=-1))))
            if newest >= 0:
                state, progress = load_checkpoint(self._folder, newest, state, self._identity)
                before = progress["seconds"]
        # Also a state that no process has read: processors of different kinds may draw other last bits.
        return everywhere(agreed(state)), float(agreed(np.float32(before)))

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._started

    def _is_out_of_time(self) -> bool:
        # Without a budget processes need not wait for each other to know.
        return bool(np.isfinite(self._budget)) and bool(agreed(np.bool_(self.seconds >= self._budget)))

    def advance(self, batch: Batch) -> float:
        """One step; its loss."""
        self._state, value = self._train_step(self._state, shared_out(batch))
        # Waits for the step: without it many steps would be queued, and a NaN be found long after its batch.
        loss = float(value)
        if not np.isfinite(loss):
            raise TrainingError(
                f"the loss of step {self.steps_done + 1} is {loss}: lower the learning rate "
                f"({self._config.learning_rate}) or look for values out of range in the data; the checkpoint before "
                "it is kept"
            )
        self.steps_done += 1
        self.out_of_time = self._is_out_of_time()
        return loss

    def evaluate(self) -> Progress:
        """Scores on the validation data; remembers the best parameters and starts new sums."""
        sums = everywhere(no_sums())
        # The moving average is what is evaluated and kept: it is less noisy than the parameters of any step.
        for batch in self._validation.evaluation_batches():
            sums = self._evaluate_step(self._state.average, sums, shared_out(batch))
        config, network = self._config, self._learner.config
        validation = evaluation_of(sums, network, config.cost_share, config.view_share)
        trained = evaluation_of(self._state.sums, network, config.cost_share, config.view_share)
        # NaN compares as worse than any best loss, so that training would go on in vain.
        if not np.isfinite(validation.loss):
            raise TrainingError(f"the validation loss after step {self.steps_done} is {validation.loss}")
        # Strictly: of equal losses the first counts, so that patience ends a training that stands still.
        better = validation.loss < float(self._state.best_loss)
        since = 0 if better else int(self._state.evaluations_since_best) + 1
        changes: dict[str, Any] = {"sums": no_sums(), "evaluations_since_best": jnp.int32(since)}
        if better:
            changes |= {"best_loss": jnp.float32(validation.loss), "best_step": jnp.int32(self.steps_done)}
        self._state = dataclasses.replace(
            self._state, best=self._state.average if better else self._state.best, **everywhere(changes)
        )
        return Progress(
            step=self.steps_done,
            epoch=self.steps_done / self.batches.per_epoch,
            seconds=self.seconds,
            learning_rate=float(np.asarray(self._schedule(self.steps_done))),
            training=trained,
            validation=validation,
            best_step=int(self._state.best_step),
        )

    def save(self) -> None:
        """Write a checkpoint, if there is a folder for it."""
        # In the precision in which who resumes learns it.
        self._spent = float(np.float32(self.seconds))
        if self._folder is not None:
            save_checkpoint(self._folder, self.steps_done, self._state, self._identity, {"seconds": self._spent})

    @property
    def reason(self) -> str | None:
        """Why training is over, or None."""
        if self.steps_done >= self._config.steps:
            return "planned"
        # After the plan, which is the usual end: its name says that the schedule was completed.
        if self._config.patience and int(self._state.evaluations_since_best) >= self._config.patience:
            return "patience"
        # However short the time: until the first evaluation the best parameters are those that learned nothing. A
        # training that was killed before it goes on to one.
        return "time" if self.out_of_time and np.isfinite(float(self._state.best_loss)) else None

    def result(self) -> Trained:
        """The best parameters so far."""
        # The time of the last checkpoint: a training that was over gives the same result when it is asked for again,
        # and whoever drove with the estimator finds the same file.
        return Trained(
            params=self._state.best,
            best_step=int(self._state.best_step),
            best_loss=float(self._state.best_loss),
            steps=self.steps_done,
            reason=self.reason or "planned",
            seconds=self._spent,
        )
