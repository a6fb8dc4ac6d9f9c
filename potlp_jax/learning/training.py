"""Training of the estimator: one pure step, and a loop that can be killed at any time.

**Order.** The batch of a step depends on (seed, step) alone: every epoch has its own permutation of the views and its
own choice of samples. Augmentation depends on (key, step). So a training that is resumed from a checkpoint does what it
would have done, bit for bit, on the same machine, devices and versions.

**Devices.** The views of a batch are shared out between all devices of all processes that share the training
(``devices``). With another number of them sums are added in another order, so that losses and parameters differ in
their last bits at first, and nothing else does: a training may be resumed with any number.
"""

import dataclasses
import functools
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
import optax
from flax import struct
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float32, Int32, PRNGKeyArray, UInt32

from potlp_jax.checks import AT_LEAST_ONE, SHARE, require_fields
from potlp_jax.errors import TrainingError
from potlp_jax.learning.augmentation import Augmentation
from potlp_jax.learning.batches import Batch, Batches, Share, prefetched
from potlp_jax.learning.checkpoints import checkpoint_steps, load_checkpoint, save_checkpoint
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.devices import VIEWS, agreed, everywhere, mesh, require_agreement, shared_out
from potlp_jax.learning.estimator import TrainedEstimator, identity_of
from potlp_jax.learning.learner import Learner
from potlp_jax.learning.loss import DataScale, Evaluation, Sums, evaluation_of, loss_sums, total_loss
from potlp_jax.learning.network import Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """How to train, apart from how long.

    Attributes:
        seed: of the parameters, the order of the data and the augmentation.
        views_per_batch, samples_per_view: views in a batch, and samples of each; a view with more samples gives
            a new random choice in every epoch, one with fewer is padded.
        learning_rate: the peak, after a linear rise over ``warmup`` of all steps, then a cosine to 0.
        weight_decay: of AdamW.
        clip_norm: the gradient is scaled down to this norm.
        average_decay: of the moving average of the parameters that is evaluated and kept; 0 for none.
        weighting: 1: the cross-entropy weighted by what mistakes cost; 0: not weighted; between: a mix.
        cost_share: factor of both cost terms.
        view_share: factor of what the network says of a view beside its answers.
        augmentation: how views are varied.
        patience: evaluations without a better validation loss before training stops; 0 for never.
        checkpoint_steps: steps between checkpoints; there is one after every epoch too.
    """

    seed: int = 0
    views_per_batch: int = 16
    samples_per_view: int = 16
    learning_rate: float = 2e-3
    warmup: float = 0.05
    weight_decay: float = 1e-3
    clip_norm: float = 1.0
    average_decay: float = 0.995
    weighting: float = 0.25
    cost_share: float = 0.5
    view_share: float = 1.0
    augmentation: Augmentation = Augmentation()
    patience: int = 6
    checkpoint_steps: int = 200

    def __post_init__(self) -> None:
        names = ("views_per_batch", "samples_per_view", "checkpoint_steps")
        require_fields(self, names, AT_LEAST_ONE, TrainingError)
        require_fields(self, ("weighting", "warmup", "average_decay"), SHARE, TrainingError)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingConfig(TrainingOptions):
    """How to train, and how long.

    Attributes:
        steps: planned optimiser steps; the learning rate ends at 0 there.
    """

    # Apart from the options: a plan for a time knows the number only when the speed has been measured.
    steps: int

    def __post_init__(self) -> None:
        super().__post_init__()
        require_fields(self, ["steps"], AT_LEAST_ONE, TrainingError)


@struct.dataclass(kw_only=True)
class TrainState:
    """Everything that the rest of a training depends on."""

    step: Int32[Array, ""]
    """Steps done."""
    key: UInt32[Array, "2"]
    """Data of the key of the augmentation; folded with the step."""
    params: Params
    optimizer: Any
    average: Params
    """Moving average of the parameters: what is evaluated."""
    best: Params
    """The average that had the lowest validation loss."""
    best_loss: Float32[Array, ""]
    best_step: Int32[Array, ""]
    evaluations_since_best: Int32[Array, ""]
    sums: Sums
    """Of the training batches since the last evaluation."""


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


def learning_rate_schedule(config: TrainingConfig) -> optax.Schedule:
    """Linear warm-up, then a cosine to 0 at the last planned step."""
    # At least one step each, so that the schedule is defined for the shortest trainings of tests.
    warmup = max(1, round(config.warmup * config.steps))
    return optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, warmup, max(config.steps, warmup + 1))


def make_optimizer(config: TrainingConfig) -> optax.GradientTransformation:
    """AdamW with clipped gradients; biases and positions do not decay."""
    return optax.chain(
        optax.clip_by_global_norm(config.clip_norm),
        optax.adamw(
            learning_rate_schedule(config),
            weight_decay=config.weight_decay,
            mask=lambda params: jax.tree_util.tree_map_with_path(
                lambda path, _: jax.tree_util.keystr(path[-1:], simple=True) == "kernel", params
            ),
        ),
    )


def initial_state(learner: Learner, config: TrainingConfig, params: Any = None) -> TrainState:
    """The state before the first step.

    Args:
        learner: what is trained.
        config: how.
        params: to begin with; new ones by default.
    """
    # Two keys: changing the augmentation leaves the initial parameters as they were.
    of_params, of_augmentation = jax.random.split(jax.random.key(config.seed))
    params = learner.init(of_params) if params is None else params
    return TrainState(
        step=jnp.int32(0),
        key=jax.random.key_data(of_augmentation),
        params=params,
        optimizer=make_optimizer(config).init(params),
        average=params,
        # Until the first evaluation; its infinite loss is beaten by any.
        best=params,
        best_loss=jnp.float32(jnp.inf),
        best_step=jnp.int32(0),
        evaluations_since_best=jnp.int32(0),
        sums=_no_sums(),
    )


def _no_sums() -> Sums:
    return Sums(**{field.name: jnp.float32(0) for field in dataclasses.fields(Sums)})


@functools.lru_cache(8)
def make_train_step(
    learner: Learner, config: TrainingConfig, scale: DataScale
) -> Callable[[TrainState, Batch], tuple[TrainState, Float32[Array, ""]]]:
    """One compiled step.

    Args:
        learner: what is trained.
        config: how; a new configuration compiles again.
        scale: figures of the training data.

    Returns:
        A function of state and batch that gives the next state, and the loss of this batch before the step.
    """
    optimizer = make_optimizer(config)

    def loss(params: Params, batch: Batch, key: PRNGKeyArray) -> tuple[Array, Sums]:
        # All views at once, so that what is drawn does not depend on how they are shared out.
        inputs = learner.augmented(batch.inputs, key, config.augmentation)
        sums = shared_sums(learner, scale, config.weighting, params, dataclasses.replace(batch, inputs=inputs))
        return total_loss(sums, config.cost_share, config.view_share), sums

    # Whole on every device, so that every process can read it.
    @functools.partial(jax.jit, out_shardings=NamedSharding(mesh(), PartitionSpec()))
    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, Float32[Array, ""]]:
        # By the step and not by splitting: a resumed training has the same keys.
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step)
        (value, sums), gradient = jax.value_and_grad(loss, has_aux=True)(state.params, batch, key)
        with jax.numpy_dtype_promotion("standard"):  # Optax mixes integer counters and floats
            update, optimizer_state = optimizer.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, update)
        # Early on the average follows quickly, so that it does not remember the initial parameters.
        done = state.step.astype(jnp.float32)
        decay = jnp.minimum(jnp.float32(config.average_decay), (1 + done) / (10 + done))
        average = jax.tree.map(lambda old, new: decay * old + (1 - decay) * new, state.average, params)
        state = dataclasses.replace(
            state,
            step=state.step + 1,
            params=params,
            optimizer=optimizer_state,
            average=average,
            sums=jax.tree.map(jnp.add, state.sums, sums),
        )
        return state, value

    return train_step


@functools.lru_cache(8)
def make_evaluate_step(learner: Learner, scale: DataScale, weighting: float) -> Callable[[Params, Sums, Batch], Sums]:
    """The compiled sums of batches, not augmented.

    Args:
        learner: what is evaluated.
        scale: figures of the training data, so that losses compare.
        weighting: as in training.

    Returns:
        A function of parameters, the sums so far and the next batch.
    """

    @functools.partial(jax.jit, out_shardings=NamedSharding(mesh(), PartitionSpec()))
    def evaluate_step(params: Params, sums: Sums, batch: Batch) -> Sums:
        return jax.tree.map(jnp.add, sums, shared_sums(learner, scale, weighting, params, batch))

    return evaluate_step


def shared_sums(learner: Learner, scale: DataScale, weighting: float, params: Params, batch: Batch) -> Sums:
    """The sums of a batch, of whose views each device takes as many.

    Args:
        learner: whose answers are judged.
        scale, weighting: as for ``loss_sums``.
        params: of its network.
        batch: of a number of views that the number of devices divides (``batches.Share``).

    Returns:
        Sums of the whole batch.
    """
    shared, whole = PartitionSpec(VIEWS), PartitionSpec()

    def sums_of(params: Params, part: Batch) -> Sums:
        answers, view_loss = learner.answers(params, part.inputs, part.phi_stay, part.phi_go)
        sums = loss_sums(answers, view_loss, part, learner.config, scale, weighting)
        return jax.tree.map(lambda value: value[None], sums)

    # Without the check: loops in the networks begin with constants, which it takes for equal on all devices.
    parts = jax.shard_map(sums_of, mesh=mesh(), in_specs=(whole, shared), out_specs=shared, check_vma=False)
    return jax.tree.map(jnp.sum, parts(params, batch))


def check_data(training: Samples, validation: Samples) -> None:
    """Raises TrainingError where the two data sets do not belong together."""
    # The split may differ, and should: everything that decides what a row means may not.
    for name in ("propositions", "environment", "camera", "unit", "resolution"):
        one, other = getattr(training.metadata, name), getattr(validation.metadata, name)
        if one != other:
            raise TrainingError(f"the data sets differ in {name}: {one} for training, {other} for validation")


def batches_of(learner: Learner, samples: Samples, config: TrainingConfig) -> Batches:
    """The batches of a data set as a learner is shown them: this process's rows of them."""
    return Batches(
        samples,
        learner.inputs,
        config.views_per_batch,
        config.samples_per_view,
        config.seed,
        learner.usable(samples),
        Share(jax.process_index(), jax.process_count(), jax.device_count()),
    )


def seconds_per_step(learner: Learner, training: Samples, config: TrainingConfig, steps: int = 8) -> float:
    """Measured time of a step with its share of decoding, after compilation; nothing is kept of these steps.

    Args:
        learner, training, config: as for ``train``.
        steps: how many are timed.

    Returns:
        Seconds.
    """
    batches = batches_of(learner, training, config)
    train_step = make_train_step(learner, config, DataScale.of(training))
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
    """What a training is made from: every data set, and the estimator that it goes on from; JSON-able."""

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
        scale = DataScale.of(training)
        self.batches = batches_of(learner, training, config)
        self._validation = batches_of(learner, validation, config)
        self._identity = training_identity(learner, training, validation, config, initial)
        require_agreement(zlib.crc32(json.dumps(self._identity, sort_keys=True).encode()), "data, settings or versions")
        self._train_step = make_train_step(learner, config, scale)
        self._evaluate_step = make_evaluate_step(learner, scale, config.weighting)
        self._schedule = learning_rate_schedule(config)
        self._state, before = self._begun(None if initial is None else initial.params)
        # Time counts over all starts, so that a budget is kept.
        self._started = time.perf_counter() - before
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
        sums = everywhere(_no_sums())
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
        changes: dict[str, Any] = {"sums": _no_sums(), "evaluations_since_best": jnp.int32(since)}
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
        if self._folder is not None:
            save_checkpoint(self._folder, self.steps_done, self._state, self._identity, {"seconds": self.seconds})

    @property
    def reason(self) -> str | None:
        """Why training is over, or None."""
        if self.steps_done >= self._config.steps:
            return "planned"
        # After the plan, which is the usual end: its name says that the schedule was completed.
        if self._config.patience and int(self._state.evaluations_since_best) >= self._config.patience:
            return "patience"
        return "time" if self.out_of_time else None

    def result(self) -> Trained:
        """The best parameters so far."""
        return Trained(
            params=self._state.best,
            best_step=int(self._state.best_step),
            best_loss=float(self._state.best_loss),
            steps=self.steps_done,
            reason=self.reason or "planned",
            seconds=self.seconds,
        )
