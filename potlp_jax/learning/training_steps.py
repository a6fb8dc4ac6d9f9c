"""The state of a training and the compiled steps that change it or judge it: pure functions of arrays."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float32, Int32, PRNGKeyArray, UInt32

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

    Returns:
        Parameters, their average, and the optimiser's state, with nothing done yet.
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
