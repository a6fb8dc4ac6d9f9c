"""Training: the loss against plain NumPy, the order of the data, learning what can be learned, death and resumption."""

import dataclasses
import itertools
import math
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

from potlp_jax.errors import CheckpointError, TrainingError
from potlp_jax.learning.augmentation import Augmentation
from potlp_jax.learning.batches import Batch, Batches, Share
from potlp_jax.learning.checkpoints import checkpoint_steps
from potlp_jax.learning.data_figures import cost_scales
from potlp_jax.learning.dataset import Samples, encode
from potlp_jax.learning.dataset_metadata import DatasetMetadata
from potlp_jax.learning.dataset_reading import joined
from potlp_jax.learning.devices import everywhere, is_first, join_processes, mesh, shared_out
from potlp_jax.learning.estimator import read_estimator
from potlp_jax.learning.loss import DataScale, evaluation_of, loss_sums, total_loss
from potlp_jax.learning.network import Answers
from potlp_jax.learning.panorama_learner import PanoramaLearner, PanoramaOptions
from potlp_jax.learning.predictions import part_of
from potlp_jax.learning.serialization import load_estimator, save_estimator
from potlp_jax.learning.training import batches_of, check_data, scale_of, train
from potlp_jax.learning.training_options import TrainingConfig
from potlp_jax.learning.training_steps import initial_state, learning_rate_schedule, make_train_step, shared_sums
from potlp_jax.recipes.fitting import _tell_of_what_is_shared
from potlp_jax.recipes.journal import Display
from potlp_jax.world.camera import CameraConfig
from tests.reference import data_sets as blank
from tests.reference.data_sets import blank_columns, blank_fields, world_columns

SHAPE = (64, 128)
ROOT = Path(__file__).parents[1]
WIDTHS = {
    "first_widths": (8, 12, 12, 16),
    "second_widths": (12, 12, 12, 12, 16, 16, 16, 16),
    "dense_widths": (24, 16, 16, 16),
}
TINY = {"first_widths": (2, 2, 2, 3), "second_widths": (3,) * 8, "dense_widths": (4, 4, 4, 4)}
METADATA = DatasetMetadata(
    propositions=("red", "green"),
    environment="synthetic",
    family="synthetic",
    generator={},
    split="training",
    camera=dataclasses.asdict(CameraConfig()),
    disturbance={},
    encoding={"format": "png"},
    weights={"low": 1.0, "high": 50.0},
    collection={},
    versions={},
    shape=blank.SHAPE,
)


def synthetic(views: int, per_view: int, seed: int) -> Samples:
    """Grey noise with two patches, one red and one green; a subgoal succeeds where phi asks for its patch's colour.

    The label needs the picture, the bearing and phi together. R_S is larger for green, R_F is half the distance.
    """
    draw = np.random.default_rng(seed)
    images, columns = [], {name: [] for name in ("view_of", "bearing", "distance", "go", "success")}
    for view in range(views):
        image = draw.integers(90, 130, (*SHAPE, 3)).astype(np.uint8)
        places = draw.permutation(8)[:2] * 16 + 8
        for colour, place in enumerate(places):
            patch = (slice(24, 44), (place + np.arange(-9, 9)) % SHAPE[1])
            image[patch[0], patch[1]] = np.array([220, 40, 40] if colour == 0 else [40, 220, 40], np.uint8)
        images.append(encode(image, "png"))
        for _ in range(per_view):
            there, asked = draw.integers(0, 2, 2)
            columns["view_of"].append(view)
            columns["bearing"].append(2 * math.pi * places[there] / SHAPE[1] - math.pi + draw.uniform(-0.1, 0.1))
            columns["distance"].append(draw.uniform(1, 40))
            columns["go"].append([1, -1] if asked == 0 else [-1, 1])
            columns["success"].append(float(there == asked))
    go = np.array(columns["go"], np.int8)
    success, distance = np.array(columns["success"], np.float32), np.array(columns["distance"], np.float32)
    return Samples(
        images=images,
        view_of=np.array(columns["view_of"], np.int32),
        bearing=np.array(columns["bearing"], np.float32),
        distance=distance,
        phi_stay=np.zeros_like(go),
        phi_go=go,
        success=success,
        success_cost=np.where(success > 0, 5 + 20 * (go[:, 1] == 1), np.nan).astype(np.float32),
        failure_cost=distance / np.float32(2),
        success_weight=draw.uniform(1, 50, len(success)).astype(np.float32),
        failure_weight=draw.uniform(1, 50, len(success)).astype(np.float32),
        metadata=METADATA,
        **blank_fields(views, views * per_view),
    )


def _learner(samples: Samples, widths) -> PanoramaLearner:
    return PanoramaLearner(dataclasses.replace(PanoramaOptions().learner(samples).config, **widths))


def _batches(samples: Samples, views: int, per_view: int, seed: int = 0) -> Batches:
    return Batches(samples, PanoramaOptions().learner(samples).inputs, views, per_view, seed)


def _batch(samples: Samples, views: int, per_view: int, step: int = 0) -> Batch:
    return _batches(samples, views, per_view).training_batch(step)


PLAIN = Augmentation(mirror_rows=0.0, brightness=0.0, colour=0.0)


def _config(steps: int, **changes) -> TrainingConfig:
    plain = {"views_per_batch": 4, "samples_per_view": 4, "augmentation": PLAIN, "patience": 0}
    return TrainingConfig(steps=steps, **{**plain, **changes})


@pytest.mark.parametrize("weighting", [0.0, 0.4, 1.0])
def test_the_loss_equals_the_formula_written_out(weighting):
    samples = synthetic(3, 5, 1)
    batch = _batch(samples, 3, 7)
    network, scale = _learner(samples, TINY), DataScale.of(samples)
    draw = np.random.default_rng(0)
    logit, success_cost, failure_cost = (draw.normal(2, 3, (3, 7)).astype(np.float32) for _ in range(3))
    answers = Answers(
        success_logit=jnp.asarray(logit), success_cost=jnp.asarray(success_cost), failure_cost=jnp.asarray(failure_cost)
    )
    sums = loss_sums(answers, jnp.array([0.5, 1.0, 3.0]), batch, network.config, scale, weighting)
    weights = np.where(samples.success == 1, samples.success_weight, samples.failure_weight).tolist()
    mean, entropy, errors, brier, count = sum(weights) / len(weights), 0.0, 0.0, 0.0, 0
    for i, k in itertools.product(range(3), range(7)):
        if not bool(batch.mask[i, k]):
            continue
        p, count = 1 / (1 + math.exp(-float(logit[i, k]))), count + 1
        happened = float(batch.success[i, k]) == 1
        weight = float((batch.success_weight if happened else batch.failure_weight)[i, k]) / mean
        entropy -= (weighting * weight + 1 - weighting) * math.log(p if happened else 1 - p)
        brier += (p - float(happened)) ** 2
        if happened:
            errors += (float(success_cost[i, k] - batch.success_cost[i, k]) / network.config.success_cost_scale) ** 2
        else:
            errors += (float(failure_cost[i, k] - batch.failure_cost[i, k]) / network.config.failure_cost_scale) ** 2
    assert count == 15
    assert float(total_loss(sums, 0.3, 0.2)) == pytest.approx((entropy + 0.3 * errors) / count + 0.2 * 1.5, rel=1e-4)
    evaluation = evaluation_of(sums, network.config, 0.3, 0.2)
    assert evaluation.brier == pytest.approx(brier / count, rel=1e-4)
    prior = float(np.mean(samples.success))
    assert evaluation.skill == pytest.approx(1 - brier / count / (prior * (1 - prior)), rel=1e-4)


def test_scales_are_those_of_the_labels_that_count():
    samples = synthetic(6, 8, 2)
    config = PanoramaOptions().learner(samples).config
    won = samples.success == 1
    assert config.success_cost_scale == pytest.approx(np.std(samples.success_cost[won]), rel=1e-5)
    assert config.failure_cost_scale == pytest.approx(np.std(samples.failure_cost[~won]), rel=1e-5)
    assert config.propositions == ("red", "green")
    nothing = dataclasses.replace(samples, success=np.zeros_like(samples.success))
    assert PanoramaOptions().learner(nothing).config.success_cost_scale == 1.0


def test_a_fovea_looks_through_the_data_sets_camera():
    samples = synthetic(6, 8, 2)
    bare = dataclasses.replace(samples, metadata=dataclasses.replace(samples.metadata, camera={"width": 128}))
    with pytest.raises(TrainingError, match="horizon, far, fold"):
        PanoramaOptions(fovea=3).learner(bare)
    camera = {"horizon": 20.0, "far": 40.0, "fold": 8.0}
    seen = dataclasses.replace(samples, metadata=dataclasses.replace(samples.metadata, camera=camera))
    config = PanoramaOptions(fovea=3).learner(seen).config
    assert (config.fovea, config.horizon, config.far, config.fold) == (3, 20.0, 40.0, 8.0)


def test_costs_that_are_not_known_give_no_nan_gradient_and_padding_gives_none():
    samples = synthetic(4, 3, 3)
    samples = dataclasses.replace(samples, failure_cost=np.full_like(samples.failure_cost, np.nan))
    network, scale = _learner(samples, TINY), DataScale.of(samples)
    params = network.init(jax.random.key(0))
    batch = _batch(samples, 4, 5)
    assert bool(jnp.any(jnp.isnan(batch.success_cost)))
    assert not bool(jnp.all(batch.mask))

    @jax.jit
    def gradient(batch):
        def loss(params):
            answers, of_views = network.answers(params, batch.inputs, batch.phi_stay, batch.phi_go)
            return total_loss(loss_sums(answers, of_views, batch, network.config, scale, 1.0), 1.0, 1.0)

        return jax.grad(loss)(params)

    found = gradient(batch)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
    padded = {
        name: jnp.where(batch.mask, getattr(batch, name), jnp.float32(jnp.nan))
        for name in ("success", "success_weight", "failure_weight", "success_cost")
    }
    other = gradient(dataclasses.replace(batch, **padded))
    for one, two in zip(jax.tree.leaves(found), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(one, two)


def _augmented(inputs, seed=0, **amount):
    learner = PanoramaLearner(PanoramaOptions().learner(synthetic(1, 1, 0)).config)
    return learner.augmented(inputs, jax.random.key(seed), dataclasses.replace(PLAIN, **amount))


@pytest.mark.parametrize("amount", [{"mirror_rows": 1.0}, {"mirror_columns": 1.0}])
def test_mirroring_mirrors_the_image_and_the_bearing_together(amount):
    batch = _batch(synthetic(4, 4, 4), 4, 4)
    inputs, mirrored = batch.inputs, _augmented(batch.inputs, **amount)
    # XLA divides by 255 as it multiplies by its reciprocal: the last bit may differ from NumPy's.
    clean = np.asarray(inputs.pixels).astype(np.float32) / np.float32(255)
    assert not np.allclose(mirrored.pixels, clean)
    # A direction keeps its row's part and changes its column's part, or the other way round.
    sign = -1 if "mirror_rows" in amount else 1
    np.testing.assert_allclose(np.sin(mirrored.bearing), sign * np.sin(inputs.bearing), atol=1e-6)
    np.testing.assert_allclose(np.cos(mirrored.bearing), -sign * np.cos(inputs.bearing), atol=1e-6)
    # The colour that a subgoal's bearing points at stays the same: looked up by the definition of the bearing.
    for image, angles in ((clean, inputs.bearing), (mirrored.pixels, mirrored.bearing)):
        columns = np.floor((np.asarray(angles) + math.pi) / (2 * math.pi) * SHAPE[1]).astype(int) % SHAPE[1]
        red = np.asarray(image)[np.arange(4)[:, None], 34, columns, 0] > 0.5
        np.testing.assert_array_equal(red, (np.asarray(batch.phi_go)[..., 0] == 1) == (np.asarray(batch.success) == 1))
    same = _augmented(inputs)
    np.testing.assert_array_equal(same.bearing, inputs.bearing)
    np.testing.assert_allclose(same.pixels, clean, rtol=3e-7)


def test_gains_change_pixels_within_their_range_and_per_panorama():
    inputs = _batch(synthetic(4, 4, 4), 4, 4).inputs
    clean = np.asarray(inputs.pixels).astype(np.float32) / 255
    pixels = _augmented(inputs, seed=1, brightness=0.2).pixels
    assert float(jnp.min(pixels)) >= 0
    assert float(jnp.max(pixels)) <= 1
    gains = (np.asarray(pixels) / np.maximum(clean, 1e-3))[:, 0, 0]
    assert len(np.unique(gains[:, 0].round(4))) == 4
    np.testing.assert_allclose(gains[:, 0], gains[:, 1], rtol=1e-4)


def test_a_panorama_network_learns_from_the_subgoals_in_view_alone():
    samples = synthetic(3, 6, 5)
    samples.in_view[::2] = False
    samples = dataclasses.replace(samples, distance=np.arange(18, dtype=np.float32))  # names every sample
    learner = PanoramaOptions().learner(samples)
    batches = batches_of(learner, samples, TrainingConfig(steps=1, views_per_batch=3, samples_per_view=6))
    batch = batches.training_batch(0)
    asked = np.asarray(batch.inputs.distance)[np.asarray(batch.mask)]
    assert sorted(asked.tolist()) == list(range(1, 18, 2))
    # And so are the figures of the loss, and the scales of costs.
    seen = part_of(samples, samples.in_view)
    assert scale_of(learner, samples) == DataScale.of(seen) != DataScale.of(samples)
    assert learner.config == PanoramaOptions().learner(seen).config
    assert cost_scales(seen) != cost_scales(samples)


def test_the_order_is_a_function_of_seed_and_step_and_covers_an_epoch():
    samples = synthetic(11, 6, 5)
    samples = dataclasses.replace(samples, distance=np.arange(66, dtype=np.float32))  # names every sample
    batches, again = _batches(samples, 3, 4, 7), _batches(samples, 3, 4, 7)
    assert batches.per_epoch == 3
    epochs = []
    for epoch in range(2):
        seen = [np.asarray(batches.training_batch(3 * epoch + step).inputs.distance).astype(int) for step in range(3)]
        views = [set((rows // 6).tolist()) for block in seen for rows in block]
        assert all(len(view) == 1 for view in views)
        assert len(set.union(*views)) == 9
        assert all(len(set(rows.tolist())) == 4 for block in seen for rows in block)
        epochs.append(np.concatenate(seen))
    assert not np.array_equal(*epochs)
    for step in (5, 0, 3):
        one, other = batches.training_batch(step), again.training_batch(step)
        pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
    other = _batches(samples, 3, 4, 8).training_batch(0)
    assert not np.array_equal(other.inputs.distance, batches.training_batch(0).inputs.distance)


def test_evaluation_sees_every_sample_once():
    samples = synthetic(5, 7, 6)
    samples = dataclasses.replace(samples, distance=np.arange(35, dtype=np.float32))
    seen = [np.asarray(b.inputs.distance)[np.asarray(b.mask)] for b in _batches(samples, 2, 3, 0).evaluation_batches()]
    assert sorted(np.concatenate(seen).tolist()) == list(range(35))


def test_the_learning_rate_rises_and_ends_at_zero():
    schedule = learning_rate_schedule(_config(100, learning_rate=0.5, warmup=0.1))
    rates = [float(jnp.asarray(schedule(step))) for step in range(101)]
    assert rates[0] == 0
    assert max(rates) == rates[10] == pytest.approx(0.5)
    assert rates[100] == pytest.approx(0, abs=1e-6)
    assert all(a < b for a, b in itertools.pairwise(rates[:11]))
    assert all(a > b for a, b in itertools.pairwise(rates[10:]))


@pytest.mark.long
def test_it_learns_64_samples_whose_label_needs_picture_bearing_and_phi():
    samples = synthetic(16, 4, 8)
    network = _learner(samples, WIDTHS)
    config = TrainingConfig(
        steps=120, views_per_batch=16, samples_per_view=4, learning_rate=6e-3, weighting=0.5, patience=0,
        augmentation=PLAIN, average_decay=0.88,
    )  # fmt: skip
    step = make_train_step(network, config, DataScale.of(samples))
    state, batch = initial_state(network, config), _batch(samples, 16, 4)
    for _ in range(config.steps):
        state, _ = step(state, batch)
    answers, of_views = jax.jit(network.answers)(state.average, batch.inputs, batch.phi_stay, batch.phi_go)
    sums = loss_sums(answers, of_views, batch, network.config, DataScale.of(samples), 1.0)
    evaluation = evaluation_of(sums, network.config, config.cost_share, config.view_share)
    assert evaluation.skill > 0.95
    assert evaluation.success_rmse < 0.3 * network.config.success_cost_scale
    assert evaluation.failure_rmse < 0.3 * network.config.failure_cost_scale


def test_a_loss_that_is_not_finite_stops_with_the_step():
    samples = synthetic(4, 4, 9)
    samples.distance[:] = np.inf
    network = _learner(synthetic(4, 4, 9), TINY)
    with pytest.raises(TrainingError, match="loss of step 1 is nan"):
        train(network, samples, samples, _config(2))


def test_data_that_do_not_belong_together_are_refused():
    samples = synthetic(4, 4, 9)
    metadata = dataclasses.replace(METADATA, propositions=("red", "blue"))
    with pytest.raises(TrainingError, match=r"propositions.*blue"):
        train(_learner(samples, TINY), samples, dataclasses.replace(samples, metadata=metadata), _config(2))


def test_logs_of_buildings_by_other_names_are_told_how_to_get_one():
    samples = synthetic(2, 2, 9)
    metadata = [dataclasses.replace(METADATA, environment=name, source="log") for name in ("monday", "friday")]
    one, other = (dataclasses.replace(samples, metadata=each) for each in metadata)
    with pytest.raises(TrainingError, match=r"monday for training, friday for validation; .* --environment NAME"):
        check_data(one, other)


def test_patience_ends_training_and_the_best_is_kept():
    samples = synthetic(4, 4, 9)
    # A learning rate of nearly nothing: the first evaluation stays the best to within the improvement of rounding.
    config = _config(50, learning_rate=1e-30, patience=3)
    losses = []
    done = train(
        _learner(samples, TINY), samples, samples, config, on_evaluation=lambda p: losses.append(p.validation.loss)
    )
    assert (done.reason, done.best_step, done.steps, len(losses)) == ("patience", 1, 4, 4)
    assert done.best_loss == pytest.approx(losses[0])


def test_a_time_budget_ends_training_with_an_evaluation():
    samples = synthetic(4, 4, 9)
    seen = []
    done = train(_learner(samples, TINY), samples, samples, _config(2), budget_seconds=0.001, on_evaluation=seen.append)
    # The budget is over before the first step, which is made all the same: what learned nothing is no estimator.
    assert (done.reason, done.steps) == ("time", 1)
    assert [progress.step for progress in seen] == [1]
    assert np.isfinite(done.best_loss)


def test_a_training_whose_time_is_over_before_its_first_evaluation_goes_on_to_one(tmp_path):
    class KilledError(Exception):
        pass

    def kill(step, loss):
        if step == 3:
            raise KilledError

    samples = synthetic(16, 4, 9)
    network, config = _learner(samples, TINY), _config(8, checkpoint_steps=2)
    with pytest.raises(KilledError):
        train(network, samples, samples, config, folder=tmp_path, on_step=kill)
    assert checkpoint_steps(tmp_path) == [2]
    # What the checkpoint has as the best are parameters that learned nothing.
    done = train(network, samples, samples, config, folder=tmp_path, budget_seconds=0.001)
    assert (done.reason, done.steps, done.best_step) == ("time", 3, 3)
    assert np.isfinite(done.best_loss)
    first = initial_state(network, config).params
    assert not all(map(np.array_equal, jax.tree.leaves(done.params), jax.tree.leaves(first)))


@pytest.mark.parametrize(
    "changes",
    [
        {"learning_rate": -1e-3},
        {"clip_norm": 0.0},
        {"cost_share": -5.0},
        {"patience": -1},
        {"seed": -1},
        {"weight_decay": -1.0},
    ],
)
def test_options_that_make_no_sense_are_named(changes):
    (name,) = changes
    with pytest.raises(TrainingError, match=f"{name} is "):
        _config(1, **changes)
    with pytest.raises(TrainingError, match="brightness is "):
        Augmentation(brightness=-0.1)


def test_validation_data_that_are_learned_from_are_said():
    samples, others, lines = synthetic(4, 4, 9), synthetic(4, 4, 10), []
    _tell_of_what_is_shared(samples, others, Display(say=lines.append))
    assert not lines
    _tell_of_what_is_shared(joined([samples, others]), others, Display(say=lines.append))
    assert "the validation data are among the training data" in lines[0]


def _trial(folder: str) -> None:
    """The training of the test below, in a process of its own: prints a line per step, writes the parameters."""
    samples, validation = synthetic(9, 5, 10), synthetic(3, 5, 11)

    def tell(step: int, loss: float) -> None:
        print(f"step {step} {loss!r}", flush=True)
        time.sleep(0.02)  # so that the kill comes in the middle

    config = _config(40, augmentation=Augmentation(brightness=0.1, colour=0.1), average_decay=0.9, checkpoint_steps=3)
    done = train(
        _learner(samples, TINY),
        samples,
        validation,
        config,
        folder=Path(folder) / "checkpoints",
        on_start=lambda step: print(f"start {step}", flush=True),
        on_step=tell,
    )
    np.savez(f"{folder}/done.npz", *(np.asarray(leaf) for leaf in jax.tree.leaves(done.params)), str(done.best_step))


def _environment(folder: Path) -> dict[str, str]:
    """Variables with which the processes of one test share what they compile."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return {**os.environ, **cache}


def _start(folder: Path) -> subprocess.Popen[str]:
    code = f"from tests.test_training import _trial; _trial({str(folder)!r})"
    folder.mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT, env=_environment(folder.parent)
    )


@pytest.mark.long
def test_killed_and_resumed_it_reaches_the_same_parameters_bit_for_bit(tmp_path):
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    output, _ = _start(straight).communicate(timeout=400)
    assert output.startswith("start 0")
    process = _start(broken)
    assert process.stdout is not None
    for _ in range(random.Random().randint(8, 30)):
        process.stdout.readline()
    time.sleep(random.random() * 0.05)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert not (broken / "done.npz").exists()
    saved = checkpoint_steps(broken / "checkpoints")
    output_again, _ = _start(broken).communicate(timeout=400)
    assert output_again.startswith(f"start {saved[-1]}\n")
    assert 0 < saved[-1] < 40
    # Every later step had the same loss, and the end is the same.
    assert output_again.splitlines()[1:] == output.splitlines()[saved[-1] + 1 :]
    with np.load(straight / "done.npz") as one, np.load(broken / "done.npz") as other:
        assert one.files == other.files
        assert len(one.files) > 20
        for name in one.files:
            np.testing.assert_array_equal(one[name], other[name])


SHARED = {"views_per_batch": 3, "augmentation": Augmentation(brightness=0.1, colour=0.1)}


def _shared(folder: str, address: str) -> None:
    """The training of the test below, in one of two processes with two devices each."""
    jax.config.update("jax_num_cpu_devices", 2)
    join_processes(address)
    samples, validation = synthetic(8, 5, 10), synthetic(5, 5, 11)
    # Three views for four devices: one of them gets a row that counts nothing.
    assert (jax.process_count(), jax.local_device_count(), jax.device_count()) == (2, 2, 4)
    learner = _learner(samples, TINY)
    losses = []
    done = train(
        learner,
        samples,
        validation,
        _config(6, **SHARED),
        folder=Path(folder) / "checkpoints",
        budget_seconds=1e6,
        on_evaluation=lambda progress: losses.append(progress.validation.loss),
    )
    if is_first():
        np.savez(f"{folder}/done.npz", *(np.asarray(leaf) for leaf in jax.tree.leaves(done.params)), losses)
    gradient = _gradient(learner, samples)
    if is_first():
        np.savez(f"{folder}/gradient.npz", *(np.asarray(leaf) for leaf in jax.tree.leaves(gradient)))
    # Of what differs between processes all of them are told.
    with pytest.raises(TrainingError, match="process 1 of the fit has other data, settings or versions"):
        train(learner, samples, validation, _config(6, seed=jax.process_index()))


def _gradient(learner: PanoramaLearner, samples: Samples):
    """Of the loss; a training alone would not tell it from its double, which Adam scales away."""
    batch = shared_out(batches_of(learner, samples, _config(1, views_per_batch=7)).training_batch(0))
    scale = DataScale.of(samples)

    def loss(params, batch):
        return total_loss(shared_sums(learner, scale, 0.4, params, batch), 0.5, 1.0)

    whole = NamedSharding(mesh(), PartitionSpec())
    return jax.jit(jax.grad(loss), out_shardings=whole)(everywhere(learner.init(jax.random.key(3))), batch)


def _joined(folder: Path, processes: int = 2) -> None:
    """Run ``_shared`` in processes that join each other; none outlives another one's failure."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    started = [
        subprocess.Popen(
            [sys.executable, "-c", f"from tests.test_training import _shared; _shared({str(folder)!r}, {address!r})"],
            cwd=ROOT,
            env=_environment(folder),
            stderr=subprocess.PIPE,
            text=True,
        )
        for address in (f"127.0.0.1:{port},{index},{processes}" for index in range(processes))
    ]
    try:
        for process in started:
            _, told = process.communicate(timeout=300)
            assert process.returncode == 0, told
    finally:
        for process in started:
            process.kill()


@pytest.mark.long
def test_processes_and_devices_share_a_training_that_another_number_goes_on_with(tmp_path):
    _joined(tmp_path)
    samples, validation = synthetic(8, 5, 10), synthetic(5, 5, 11)
    learner, config, losses = _learner(samples, TINY), _config(6, **SHARED), []
    alone = train(learner, samples, validation, config, on_evaluation=lambda p: losses.append(p.validation.loss))
    with np.load(tmp_path / "done.npz") as shared:
        *params, told = (shared[name] for name in shared.files)
    np.testing.assert_allclose(losses, told, rtol=1e-5)
    for one, other in zip(jax.tree.leaves(alone.params), params, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)
    with np.load(tmp_path / "gradient.npz") as shared:
        for one, name in zip(jax.tree.leaves(_gradient(learner, samples)), shared.files, strict=True):
            np.testing.assert_allclose(one, shared[name], rtol=1e-3, atol=1e-5)
    # One process with one device goes on with what two with four had left.
    checkpoints = tmp_path / "checkpoints"
    assert checkpoint_steps(checkpoints) == [4, 6]
    shutil.rmtree(checkpoints / "6")
    begun = []
    resumed = train(learner, samples, validation, config, folder=checkpoints, on_start=begun.append)
    assert begun == [4]
    for one, other in zip(jax.tree.leaves(alone.params), jax.tree.leaves(resumed.params), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("address", ["somewhere", "host:1,0", "host:1,a,2", "host:1,2,2"])
def test_an_address_of_processes_is_checked(address):
    with pytest.raises(TrainingError, match=address):
        join_processes(address)


@pytest.mark.parametrize("size", ["", "1", "none"])
def test_variables_that_name_no_other_process_leave_a_fit_alone(monkeypatch, size):
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", size)
    monkeypatch.setattr(jax.distributed, "initialize", lambda **_: pytest.fail("it waits for others"))
    join_processes()


def test_rows_of_processes_together_are_the_batch_of_one():
    samples = synthetic(7, 6, 5)
    learner = PanoramaOptions().learner(samples)
    whole = Batches(samples, learner.inputs, 5, 4, 0)
    parts = [Batches(samples, learner.inputs, 5, 4, 0, share=Share(index, 2, 6)) for index in range(2)]
    blocks = [
        [whole.training_batch(1), *(part.training_batch(1) for part in parts)],
        *zip(whole.evaluation_batches(), *(part.evaluation_batches() for part in parts), strict=True),
    ]
    for one, *pieces in blocks:
        assert [piece.mask.shape[0] for piece in pieces] == [3, 3]
        for leaf, *rows in zip(*map(jax.tree.leaves, (one, *pieces)), strict=True):
            np.testing.assert_array_equal(np.concatenate(rows)[:5], leaf)
        assert not pieces[1].mask[2:].any()


def test_resuming_with_other_options_or_data_names_the_difference(tmp_path):
    samples = synthetic(4, 4, 9)
    network = _learner(samples, TINY)
    train(network, samples, samples, _config(2), folder=tmp_path)
    with pytest.raises(CheckpointError, match=r"training\.learning_rate was 0\.002, is 0\.1"):
        train(network, samples, samples, _config(2, learning_rate=0.1), folder=tmp_path)
    renamed = dataclasses.replace(network.config, propositions=("red", "blue"))
    with pytest.raises(CheckpointError, match=r"network\.propositions .*green.*blue"):
        train(PanoramaLearner(renamed), samples, samples, _config(2), folder=tmp_path)
    # Of the same size, environment and split: what was recorded differs.
    for training, validation, what in (
        (synthetic(4, 4, 8), samples, "training"),
        (samples, synthetic(4, 4, 8), "validation"),
    ):
        with pytest.raises(CheckpointError, match=rf"{what}_data\.0\.digest was"):
            train(network, training, validation, _config(2), folder=tmp_path)


@pytest.mark.long
def test_a_fit_of_several_data_sets_resumes_with_the_same_ones_alone(tmp_path):
    validation = synthetic(4, 4, 9)
    network = _learner(validation, TINY)
    first, *others = (synthetic(4, 4, seed) for seed in (9, 10, 11))
    metadata = dataclasses.replace(METADATA, collection={"first_world": 40, "driver": "potlp", "estimator": "mine 1a"})
    driven = [dataclasses.replace(other, metadata=metadata) for other in others]
    train(network, joined([first, driven[0]]), validation, _config(2), folder=tmp_path)
    with pytest.raises(CheckpointError, match=r"another folder. training_data\.1\.digest was"):
        train(network, joined([first, driven[1]]), validation, _config(2), folder=tmp_path)
    assert train(network, joined([first, driven[0]]), validation, _config(2), folder=tmp_path).steps == 2
    source = joined([first, driven[0]]).sources[1]
    assert (source.first_world, source.driver, source.estimator) == (40, "potlp", "mine 1a")
    assert (source.worlds, source.views, source.samples) == (1, 4, 16)
    # What was joined before stays apart.
    assert joined([joined([first, driven[0]]), driven[1]]).sources == tuple(
        source for samples in (first, *driven) for source in samples.sources
    )


def test_a_fit_resumes_with_the_estimator_that_it_went_on_from_alone(tmp_path):
    samples = synthetic(4, 4, 9)
    network = _learner(samples, TINY)
    for seed, name in enumerate(("one", "other")):
        save_estimator(
            tmp_path / f"{name}.npz", network.init(jax.random.key(seed)), network.config, METADATA.domain, {}
        )
    one, other = (read_estimator(tmp_path / f"{name}.npz") for name in ("one", "other"))
    folder = tmp_path / "checkpoints"
    train(network, samples, samples, _config(2), initial=one, folder=folder)
    for changed, said in ((other, f'"{other.identity}"'), (None, "null")):
        with pytest.raises(CheckpointError, match=f'initial was "{one.identity}", is {said}'):
            train(network, samples, samples, _config(2), initial=changed, folder=folder)


@pytest.mark.long
def test_the_command_writes_an_estimator_and_resumes(tmp_path):
    from potlp_jax.learning.dataset import write_shard

    recorded = dataclasses.replace(METADATA, camera={**METADATA.camera, "horizon": 24.0, "fold": 8.0})
    for name, seed in (("training", 12), ("validation", 13)):
        samples = synthetic(4, 5, seed)
        views = {key: [0] * 4 for key in ("world", "step", "row", "column")}
        views |= {"view": list(range(4)), "format": ["png"] * 4, "image": samples.images, **blank_columns(4)}
        plain = ("bearing", "distance", "success_cost", "failure_cost", "success_weight", "failure_weight")
        columns = {key: getattr(samples, key).tolist() for key in plain}
        columns |= {key: getattr(samples, key).tolist() for key in ("phi_stay", "phi_go")}
        columns |= {key: [0] * 20 for key in ("outcome_class", "row", "column")}
        columns |= {"view": samples.view_of.tolist(), "task": ["F red"] * 20}
        columns |= {"success_probability": samples.success.tolist(), "in_view": samples.in_view.tolist()}
        write_shard(tmp_path / name, 0, world_columns(0), views, columns, recorded)
    command = [sys.executable, "-c", "from potlp_jax.cli import main; main()", "fit", str(tmp_path / "training")]
    command += ["--validation", str(tmp_path / "validation"), "--out", str(tmp_path / "out"), "--epochs", "2"]
    command += ["--set", "training.views_per_batch=2", "--set", "training.samples_per_view=2"]
    command += ["--set", "network.kind=panorama", "--set", "network.fovea=3"]
    command += ["--set", "network.second_widths=[3, 4, 5, 6, 7, 8, 9, 9]"]
    for expected in ("epoch   2.0", "resumed at step"):
        done = subprocess.run(
            command, capture_output=True, text=True, cwd=ROOT, timeout=400, env=_environment(tmp_path)
        )
        assert done.returncode == 0, done.stderr
        assert expected in done.stderr
        assert "ended by planned" in done.stdout
    params, config, domain, metadata = load_estimator(tmp_path / "out" / "estimator.npz")
    assert config.propositions == ("red", "green")
    assert domain == recorded.domain
    assert (config.fovea, config.horizon, config.second_widths) == (3, 24.0, (3, 4, 5, 6, 7, 8, 9, 9))
    assert metadata["figures"]["step"] == metadata["best_step"]
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(params))
    assert (tmp_path / "out" / "log.csv").read_text().count("\n") == 3
    assert (tmp_path / "out" / "curves.png").stat().st_size > 1000
    assert list((tmp_path / "out" / "tensorboard").iterdir())
    refused = subprocess.run([*command, "--seed", "1"], capture_output=True, text=True, cwd=ROOT)
    assert refused.returncode == 2
    assert "seed was 0, is 1" in refused.stderr
