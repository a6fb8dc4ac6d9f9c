"""The building network in training: what it is shown is what a trial shows it, mirrored and lit as buildings may be."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.errors import TrainingError
from potlp_jax.learning.augmentation import Augmentation
from potlp_jax.learning.batches import Batches
from potlp_jax.learning.building_estimator import BuildingEstimator
from potlp_jax.learning.building_learner import BuildingInputs, BuildingLearner, BuildingOptions
from potlp_jax.learning.dataset import Samples, encode
from potlp_jax.learning.dataset_metadata import DatasetMetadata
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.loss import DataScale
from potlp_jax.learning.map_images import encode_view, encode_world
from potlp_jax.learning.painting import blank_painting, paint
from potlp_jax.learning.panorama_learner import PanoramaOptions
from potlp_jax.learning.training_options import TrainingConfig
from potlp_jax.learning.training_steps import initial_state, make_train_step
from potlp_jax.recipes.fitting import _tell_of_changes, learner_after
from potlp_jax.recipes.journal import Display
from potlp_jax.task.task import Task
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.frontiers import FrontierConfig, Subgoals, find_subgoals
from potlp_jax.world.grid import BeliefMap, World, make_world, pad_world
from potlp_jax.world.renderer import render
from potlp_jax.world.sensing import SensorConfig, observe

NAMES = ("goal", "hazard")
CAMERA = CameraConfig(height=64, width=128, horizon=24.0, fold=8.0)
SIZES = BuildingOptions(widths=(8, 8, 12), blocks=(0, 1, 1), decoder=8, head=16, condition=8)
EXTENT, SHAPE = (11, 17), (14, 20)
PLAIN = Augmentation(mirror_rows=0.0, brightness=0.0, colour=0.0)


def _world(goal_above: bool) -> World:
    """A hallway with a room above and one below; the goal is in one of them, and its floor is red."""
    occupied = np.ones(EXTENT, bool)
    occupied[5, 1:-1] = occupied[1:4, 8:-1] = occupied[7:-1, 8:-1] = False
    occupied[4, 10] = occupied[6, 10] = False
    letters = np.zeros(EXTENT, np.int32)
    letters[(2, 14) if goal_above else (9, 14)] = 1
    letters[5, 15] = 2
    world = make_world(occupied, letters, (5, 1), propositions=NAMES)
    floor = np.full((*EXTENT, 3), 120, np.uint8)
    rows = slice(0, 5) if goal_above else slice(6, None)
    floor[rows, 8:] = (200, 40, 40)
    appearance = dataclasses.replace(world.appearance, floor_colour=jnp.asarray(floor))
    return pad_world(dataclasses.replace(world, appearance=appearance), *SHAPE)


@jax.jit
def _drive(world: World) -> tuple[BeliefMap, object, Subgoals]:
    """What is known, painted and open after a look from the start and one from before the doors."""
    belief, painting = BeliefMap.unobserved(world), blank_painting(*SHAPE)
    for cell in (jnp.array([5, 1], jnp.int32), jnp.array([5, 10], jnp.int32)):
        belief = observe(belief, world, cell, SensorConfig(range_cells=9.0))
        painting = paint(painting, render(world, cell, CAMERA), belief, cell, CAMERA)
    reach = belief.free
    distances = jnp.where(reach, 1.0, jnp.inf)
    return belief, painting, find_subgoals(belief, reach, distances, FrontierConfig(max_subgoals=4, min_size=1))


def _samples(views: int) -> Samples:
    """Views of both buildings in turn: is the goal beyond a frontier, without touching the hazard?"""
    worlds = [_world(True), _world(False)]
    drives = [_drive(world) for world in worlds]
    rows = []
    for view in range(views):
        subgoals = drives[view % 2][2]
        for cell in np.asarray(subgoals.cells)[np.asarray(subgoals.mask)].tolist():
            above = cell[0] < 5
            rows.append((view, cell, float(above == (view % 2 == 0))))
    success = np.array([row[2] for row in rows], np.float32)
    count = len(rows)
    metadata = DatasetMetadata(
        propositions=NAMES,
        environment="synthetic",
        family="synthetic",
        generator={},
        split="training",
        camera=dataclasses.asdict(CAMERA),
        disturbance={},
        encoding={"format": "png"},
        weights={"low": 1.0, "high": 9.0},
        collection={},
        versions={},
        shape=SHAPE,
    )
    return Samples(
        images=[encode(np.zeros((64, 128, 3), np.uint8), "png")] * views,
        maps=[encode_view(belief, painting) for belief, painting, _ in (drives[view % 2] for view in range(views))],
        worlds=[encode_world(world) for world in worlds],
        world_of=np.arange(views, dtype=np.int32) % 2,
        view_of=np.array([row[0] for row in rows], np.int32),
        cells=np.array([row[1] for row in rows], np.int32),
        in_view=np.zeros(count, bool),
        bearing=np.zeros(count, np.float32),
        distance=np.ones(count, np.float32),
        phi_stay=np.tile(np.array([[0, -1]], np.int8), (count, 1)),
        phi_go=np.tile(np.array([[1, 0]], np.int8), (count, 1)),
        success=success,
        success_cost=np.where(success > 0, 2.0, np.nan).astype(np.float32),
        failure_cost=np.full(count, 1.0, np.float32),
        success_weight=np.ones(count, np.float32),
        failure_weight=np.ones(count, np.float32),
        metadata=metadata,
    )


@pytest.fixture(scope="module")
def samples() -> Samples:
    return _samples(4)


@pytest.fixture(scope="module")
def learner(samples) -> BuildingLearner:
    return SIZES.learner(samples)


def _batch(learner, samples, views=4, per_view=5):
    return Batches(samples, learner.inputs, views, per_view, 0).training_batch(0)


@pytest.fixture(scope="module")
def params(learner):
    """Parameters of which none is 0, so that everything that enters has an effect."""
    leaves, structure = jax.tree.flatten(learner.init(jax.random.key(0)))
    keys = jax.random.split(jax.random.key(1), len(leaves))
    moved = [leaf + 0.05 * jax.random.normal(key, leaf.shape) for key, leaf in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(structure, moved)


@pytest.mark.long
def test_answers_in_training_are_those_of_the_estimator_in_a_trial(learner, params, samples):
    batch = _batch(learner, samples)
    # The class that the samples ask for: the goal, without touching the hazard.
    task = Task.from_formula("!hazard U goal", NAMES)
    asked = [(tuple(stay), tuple(go)) for stay, go in task.classes].index(((-1, -1), (1, 0)))
    batch = dataclasses.replace(batch, phi_stay=jnp.broadcast_to(jnp.array([-1, -1], jnp.int8), batch.phi_stay.shape))
    answers, _ = jax.jit(learner.answers)(params, batch.inputs, batch.phi_stay, batch.phi_go)
    compared = 0
    for row in range(4):
        drives = [_drive(world) for world in _worlds()]
        # The maps of both are alike so far; what the camera saw is not.
        floor = batch.inputs.painting.floor[row]
        ((belief, painting, subgoals),) = [drive for drive in drives if np.array_equal(drive[1].floor, floor)]
        # As the data set keeps it: the distance of what was painted in steps of a 32nd of a cell.
        kept = jax.tree.map(lambda array, row=row: array[row], batch.inputs.painting)
        np.testing.assert_allclose(kept.distance, painting.distance, atol=1 / 64)
        estimator = BuildingEstimator(params=params, memory=kept, config=learner.config)
        found = jax.jit(lambda estimator, *given: estimator(*given))(estimator, belief, subgoals, task.arrays)
        cells = np.asarray(batch.inputs.subgoals)[row][np.asarray(batch.inputs.subgoal_of)[row]]
        real = np.asarray(subgoals.mask)
        for sample in np.flatnonzero(np.asarray(batch.mask)[row]):
            (subgoal,) = np.flatnonzero((np.asarray(subgoals.cells) == cells[sample]).all(1) & real)
            for name in ("success_probability", "failure_cost"):
                one, other = getattr(answers, name)[row, sample], getattr(found, name)[subgoal, asked]
                assert float(one) == pytest.approx(float(other), rel=1e-4)
            compared += 1
    assert compared >= 8
    assert len(np.unique(np.asarray(answers.success_logit))) > 1


@pytest.mark.parametrize("glances", [False, True])
def test_maps_are_painted_in_trials_as_in_the_training_data(samples, params, glances):
    metadata = dataclasses.replace(samples.metadata, collection={"glances": glances})
    painted = dataclasses.replace(samples, metadata=metadata)
    config = SIZES.learner(painted).config
    assert config.glances == glances
    other = dataclasses.replace(config, glances=not glances)
    begin = TrainedEstimator(params, other, metadata.domain, {}, "before", "0")
    assert learner_after(begin, painted, SIZES).config == config
    # And the estimator of a trial does as its configuration says: a door that it looks at from aside.
    world = _world(True)
    cell = jnp.array([5, 7], jnp.int32)
    belief = observe(BeliefMap.unobserved(world), world, cell, SensorConfig(range_cells=9.0))
    estimator = BuildingEstimator(params=params, memory=blank_painting(*SHAPE), config=config)
    seen = estimator.remember(render(world, cell, CAMERA), belief, cell).memory
    assert bool(belief.free[4, 10])
    assert bool(jnp.isfinite(seen.distance[4, 10])) == glances


def test_an_estimator_that_is_gone_on_from_has_the_camera_of_the_data(samples, params):
    """By which its maps are painted in trials: another one would paint floors elsewhere, without a word."""
    expected = SIZES.learner(samples).config
    before = dataclasses.replace(expected, image_shape=(128, 512), horizon=48.0, far=49.0, fold=16.0)
    begin = TrainedEstimator(params, before, samples.metadata.domain, {}, "before", "0")
    learner, lines = learner_after(begin, samples, SIZES), []
    assert learner.config == expected
    _tell_of_changes(begin, learner, Display(say=lines.append))
    assert {line.split()[0] for line in lines} == {"image_shape", "horizon", "far", "fold"}


@pytest.mark.parametrize("what", ["unit", "camera"])
def test_an_estimator_does_not_go_on_where_its_numbers_or_pictures_mean_something_else(samples, params, what):
    domain = samples.metadata.domain
    other = {
        "unit": dataclasses.replace(domain, unit="metres"),
        "camera": dataclasses.replace(domain, camera=dataclasses.replace(domain.camera, far=domain.camera.far + 1)),
    }[what]
    building = TrainedEstimator(params, SIZES.learner(samples).config, other, {}, "before", "0")
    panorama = TrainedEstimator(params, PanoramaOptions().learner(samples).config, other, {}, "before", "0")
    with pytest.raises(TrainingError, match="cannot go on with these data"):
        learner_after(panorama, samples, PanoramaOptions())
    if what == "unit":
        with pytest.raises(TrainingError, match="it counts in metres"):
            learner_after(building, samples, SIZES)
    else:
        assert learner_after(building, samples, SIZES).config == building.config


def test_an_estimator_does_not_go_on_with_labels_of_another_kind(samples, params):
    metadata = {"data": {"collection": {"nearest": True}}}
    begin = TrainedEstimator(params, SIZES.learner(samples).config, samples.metadata.domain, metadata, "before", "0")
    with pytest.raises(TrainingError, match=r"before cannot go on .* collect with --set nearest=true"):
        learner_after(begin, samples, SIZES)
    near = dataclasses.replace(samples.metadata, collection={"nearest": True, "glances": samples.metadata.glances})
    assert learner_after(begin, dataclasses.replace(samples, metadata=near), SIZES).config == begin.config


@pytest.mark.parametrize("own_within", [0, 2])
def test_an_estimator_that_is_gone_on_from_has_the_paths_that_are_asked_for(samples, params, own_within):
    before = dataclasses.replace(SIZES.learner(samples).config, own_within=2 - own_within)
    begin = TrainedEstimator(params, before, samples.metadata.domain, {}, "before", "0")
    asked = dataclasses.replace(SIZES, own_within=own_within)
    learner, lines = learner_after(begin, samples, asked), []
    assert learner.config == asked.learner(samples).config
    _tell_of_changes(begin, learner, Display(say=lines.append))
    assert lines == [f"own_within is {own_within}; before has {2 - own_within}"]
    # Another kind of network has no such paths.
    assert learner_after(begin, samples, PanoramaOptions()).config == before


def _worlds():
    return _world(True), _world(False)


@pytest.mark.parametrize(("rows", "columns"), [(True, False), (False, True), (True, True)])
def test_a_mirrored_view_is_the_view_of_the_mirrored_building(learner, samples, rows, columns):
    inputs = _batch(learner, samples).inputs
    amount = dataclasses.replace(PLAIN, mirror_rows=float(rows), mirror_columns=float(columns))
    found = jax.jit(learner.augmented, static_argnums=2)(inputs, jax.random.key(0), amount)
    height, width = EXTENT

    for name in ("cells", "letters", "true_cells", "true_letters"):
        array = np.array(getattr(inputs, name))
        array[:, :height, :width] = _turned(array[:, :height, :width], rows, columns)
        np.testing.assert_array_equal(getattr(found, name), array, err_msg=name)
    for name in ("floor", "beyond", "distance"):
        array = np.array(getattr(inputs.painting, name))
        array[:, :height, :width] = _turned(array[:, :height, :width], rows, columns)
        np.testing.assert_array_equal(getattr(found.painting, name), array, err_msg=name)
    for row in range(4):
        for before, after in zip(np.asarray(inputs.subgoals)[row], np.asarray(found.subgoals)[row], strict=True):
            if before.any():
                expected = (
                    height - 1 - before[0] if rows else before[0],
                    width - 1 - before[1] if columns else before[1],
                )
                assert tuple(after.tolist()) == expected


def _turned(array, rows, columns):
    array = array[:, ::-1] if rows else array
    return array[:, :, ::-1] if columns else array


def test_gains_change_colours_and_nothing_else(learner, samples):
    inputs = _batch(learner, samples).inputs
    amount = dataclasses.replace(PLAIN, brightness=0.3)
    found = learner.augmented(inputs, jax.random.key(3), amount)
    assert not np.array_equal(found.painting.floor, inputs.painting.floor)
    kept = dataclasses.replace(
        found, painting=dataclasses.replace(found.painting, floor=inputs.painting.floor, beyond=inputs.painting.beyond)
    )
    for one, other in zip(jax.tree.leaves(kept), jax.tree.leaves(inputs), strict=True):
        np.testing.assert_array_equal(one, other)


def test_views_that_fill_a_batch_up_count_nothing(learner, params, samples):
    batches = Batches(samples, learner.inputs, 3, 5, 0)
    *_, last = batches.evaluation_batches()
    assert last.inputs.real.tolist() == [True, False, False]
    _, losses = jax.jit(learner.answers)(params, last.inputs, last.phi_stay, last.phi_go)
    assert float(losses[0]) > 0
    assert losses[1:].tolist() == [0.0, 0.0]


@pytest.mark.long
def test_it_learns_what_only_the_painting_tells(samples, learner):
    config = TrainingConfig(
        steps=150, views_per_batch=4, samples_per_view=5, learning_rate=5e-3, weighting=0.0, patience=0,
        augmentation=PLAIN, average_decay=0.9,
    )  # fmt: skip
    step, batch = make_train_step(learner, config, DataScale.of(samples)), _batch(learner, samples)
    state, first = step(initial_state(learner, config), batch)
    for _ in range(config.steps):
        state, last = step(state, batch)
    assert float(last) < float(first)
    answers, _ = jax.jit(learner.answers)(state.average, batch.inputs, batch.phi_stay, batch.phi_go)
    errors = np.abs(np.asarray(answers.success_probability) - np.asarray(batch.success))[np.asarray(batch.mask)]
    assert errors.max() < 0.2


def test_inputs_are_the_same_from_any_thread(learner, samples):
    one, other = _batch(learner, samples).inputs, _batch(learner, samples).inputs
    assert isinstance(one, BuildingInputs)
    for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(left, right)
