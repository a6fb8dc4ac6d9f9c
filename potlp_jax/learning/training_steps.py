"""The state of a training and the compiled steps that change it or judge it: pure functions of arrays."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float32, Int32, UInt32

from potlp_jax.learning.batches import Batch
from potlp_jax.learning.devices import VIEWS, mesh
from potlp_jax.learning.learner import Learner
from potlp_jax.learning.loss import DataScale, Sums, loss_sums, total_loss
from potlp_jax.learning.network import Params
from potlp_jax.learning.training_options import TrainingConfig


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
        # One program: operation by operation there would be one for each shape of a parameter.
        optimizer=jax.jit(make_optimizer(config).init)(params),
        average=params,
        # Until the first evaluation; its infinite loss is beaten by any.
        best=params,
        best_loss=jnp.float32(jnp.inf),
        best_step=jnp.int32(0),
        evaluations_since_best=jnp.int32(0),
        sums=no_sums(),
    )


def no_sums() -> Sums:
    """The sums before the first batch."""
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

    # Whole on every device, so that every process can read it.
    @functools.partial(jax.jit, out_shardings=NamedSharding(mesh(), PartitionSpec()))
    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, Float32[Array, ""]]:
        # By the step and not by splitting: a resumed training has the same keys.
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step)
        # All views at once, so that what is drawn does not depend on how they are shared out.
        inputs = learner.augmented(batch.inputs, key, config.augmentation)
        augmented = dataclasses.replace(batch, inputs=inputs)
        value, sums, gradient = shared_gradient(learner, scale, config, state.params, augmented)
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

    def sums_of(params: Params, part: Batch) -> Sums:
        return _summed(_own_sums(learner, scale, weighting, params, part))

    return _on_devices(sums_of)(params, batch)


def shared_gradient(
    learner: Learner, scale: DataScale, config: TrainingConfig, params: Params, batch: Batch
) -> tuple[Float32[Array, ""], Sums, Params]:
    """Loss, sums and gradient of a batch, of whose views each device takes as many; as ``shared_sums``."""

    def gradient_of(params: Params, part: Batch) -> tuple[Array, Sums, Params]:
        sums, pull_back = jax.vjp(lambda params: _own_sums(learner, scale, config.weighting, params, part), params)
        # The loss is no sum over views: how much those of this device count follows from the sums of all.
        sums = _summed(sums)
        value, weights = jax.value_and_grad(total_loss)(sums, config.cost_share, config.view_share)
        (gradient,) = pull_back(weights)
        return value, sums, _summed(gradient)

    return _on_devices(gradient_of)(params, batch)


def _on_devices(function: Callable[[Params, Batch], Any]) -> Callable[[Params, Batch], Any]:
    """A function of parameters and of a device's part of a batch, whose results are the same on all devices."""
    whole = PartitionSpec()
    # Without the check: loops in the networks begin with constants, which it takes for equal on all devices.
    return jax.shard_map(
        function, mesh=mesh(), in_specs=(whole, PartitionSpec(VIEWS)), out_specs=whole, check_vma=False
    )


def _own_sums(learner: Learner, scale: DataScale, weighting: float, params: Params, part: Batch) -> Sums:
    answers, view_loss = learner.answers(params, part.inputs, part.phi_stay, part.phi_go)
    return loss_sums(answers, view_loss, part, learner.config, scale, weighting)


def _summed(tree: Any) -> Any:
    """Sums over all devices, of one vector: they wait for each other once.

    Sums of single arrays are independent of each other. Each device of a processor begins with another one, and where
    there are as few threads as devices all wait for ever.
    """
    vector, restore = ravel_pytree(tree)
    return restore(jax.lax.psum(vector, VIEWS))
