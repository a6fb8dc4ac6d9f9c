"""The building network: what its answers depend on and what they do not, and its operations as XLA counts them."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.errors import NetworkError, PropositionsError
from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.building_estimator import BuildingEstimator
from potlp_jax.learning.building_network import BuildingNetwork, building_operations, compared
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.imagined_paths import PROSPECTS, outlook, prospects, scenery
from potlp_jax.learning.map_channels import channel_count, map_channels, of_painting
from potlp_jax.learning.observing import ObservingEstimator, looks_on_the_way, observe_panorama
from potlp_jax.learning.painting import blank_painting
from potlp_jax.learning.serialization import load_estimator, save_estimator
from potlp_jax.learning.squares import SQUARE
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.task.task import Task
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.frontiers import FrontierConfig, find_subgoals
from potlp_jax.world.grid import BeliefMap, World, make_world
from potlp_jax.world.renderer import render
from potlp_jax.world.sensing import SensorConfig, observe

NAMES = ("goal", "hazard")
CAMERA = CameraConfig(height=64, width=128, horizon=24.0, fold=8.0)
CONFIG = BuildingConfig(
    propositions=NAMES,
    image_shape=(64, 128),
    horizon=24.0,
    fold=8.0,
    widths=(8, 8, 12),
    blocks=(0, 1, 1),
    decoder=8,
    head=16,
    condition=8,
    contrast=4,
)
NETWORK = BuildingNetwork(CONFIG)
SENSOR = SensorConfig(range_cells=5.0)
TRIAL = TrialConfig(
    sensor=SENSOR,
    camera=CAMERA,
    decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=4), search=BestFirstConfig(simulations=50)),
)


# One program each: operation by operation they would be hundreds of small ones.
_answers = jax.jit(lambda eyes, belief, subgoals, arrays: eyes(belief, subgoals, arrays))
_encode = jax.jit(BuildingNetwork.encode, static_argnums=0)
_places = jax.jit(BuildingNetwork.places, static_argnums=0)
_painted = jax.jit(
    lambda estimator, world, belief: observe_panorama(
        estimator, render(world, world.start, CAMERA), belief, world.start
    )
)


@pytest.fixture(scope="module")
def params():
    """Parameters of which none is 0, so that everything that enters has an effect."""
    initial = jax.jit(NETWORK.init)(jax.random.key(0))
    leaves, structure = jax.tree.flatten(initial)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    moved = [leaf + 0.05 * jax.random.normal(key, leaf.shape) for key, leaf in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(structure, moved)


def _world(far_letter: int = 1, far_wall: bool = False) -> World:
    """Two rooms joined by a door; the goal is in the far one, out of the sensor's range and of the camera's sight."""
    occupied = np.ones((12, 26), bool)
    occupied[1:-1, 1:12] = occupied[1:-1, 13:-1] = False
    occupied[2, 12] = False
    letters = np.zeros(occupied.shape, np.int32)
    letters[9, 22] = far_letter
    if far_wall:
        occupied[6:, 18] = True
    return make_world(occupied, letters, (9, 3), propositions=NAMES)


def _estimator(params, world: World) -> BuildingEstimator:
    return BuildingEstimator(params=params, memory=blank_painting(*world.shape), config=CONFIG)


def _asked(params, world: World, formula: str = "!hazard U goal"):
    task = Task.from_formula(formula, propositions=NAMES)
    belief = observe(BeliefMap.unobserved(world), world, world.start, SENSOR)
    eyes = _painted(_estimator(params, world), world, belief)
    subgoals = find_subgoals(belief, belief.free, jnp.zeros(world.shape), FrontierConfig(max_subgoals=4))
    return eyes, belief, subgoals, task


@pytest.mark.long
def test_worlds_that_look_alike_so_far_get_equal_answers(params):
    answers = []
    for world in (_world(), _world(far_letter=2), _world(far_wall=True)):
        eyes, belief, subgoals, task = _asked(params, world)
        assert int(jnp.sum(subgoals.mask)) > 0
        answers.append(jax.tree.leaves(_answers(eyes, belief, subgoals, task.arrays)))
    for other in answers[1:]:
        for mine, its in zip(answers[0], other, strict=True):
            np.testing.assert_array_equal(mine, its)


@pytest.mark.parametrize("formula", ["!hazard U goal", "(!hazard U goal) & F hazard"])
def test_estimates_are_the_networks_answers_and_padding_cannot_succeed(params, formula):
    eyes, belief, subgoals, task = _asked(params, _world(), formula)
    found = _answers(eyes, belief, subgoals, task.arrays)

    @jax.jit
    def one_by_one(belief, memory, subgoals, phi):
        encoded = NETWORK.encode(params, map_channels(belief, memory))
        places = NETWORK.places(params, encoded, subgoals.cells)
        stay, go = phi[:, 0], phi[:, 1]
        # Each pair by itself, where the estimator solves what pairs share once.
        scene = scenery(belief, jax.tree.map(jax.nn.sigmoid, encoded.squares), CONFIG.own_within)
        beyond = jax.lax.map(
            lambda cell: prospects(outlook(scene, jnp.tile(cell, (len(stay), 1)), stay), go), subgoals.cells
        )
        return NETWORK.answer(params, places[:, None], beyond, NETWORK.modulation(params, stay, go)[None])

    answers = one_by_one(belief, eyes.memory, subgoals, task.arrays.class_phi)
    real = np.asarray(subgoals.mask)[:, None] & np.asarray(task.arrays.class_mask)[None, :]
    np.testing.assert_allclose(
        np.asarray(found.success_probability)[real], np.asarray(answers.success_probability)[real], atol=1e-6
    )
    np.testing.assert_allclose(np.asarray(found.success_cost)[real], np.asarray(answers.success_cost)[real], rtol=1e-5)
    np.testing.assert_allclose(np.asarray(found.failure_cost)[real], np.asarray(answers.failure_cost)[real], rtol=1e-5)
    assert not np.asarray(found.success_probability)[~real].any()
    assert np.all(np.asarray(found.success_cost) >= CONFIG.step)
    assert np.all(np.asarray(found.failure_cost) >= 0)


def test_answers_depend_on_map_paint_place_what_lies_beyond_and_phi(params):
    eyes, belief, subgoals, task = _asked(params, _world())

    def answer(eyes=eyes, belief=belief, cells=subgoals.cells, beyond=0.0, phi=task.arrays.class_phi):
        encoded = _encode(NETWORK, params, map_channels(belief, eyes.memory))
        places = _places(NETWORK, params, encoded, cells)
        modulation = NETWORK.modulation(params, phi[0, 0], phi[0, 1])
        return float(NETWORK.answer(params, places[0], jnp.full(PROSPECTS, beyond), modulation).success_logit)

    darker = dataclasses.replace(eyes.memory, floor=eyes.memory.floor // 2)
    seen = dataclasses.replace(belief, letters=belief.letters.at[8, 4].set(2))
    others = (
        answer(eyes=dataclasses.replace(eyes, memory=darker)),
        answer(belief=seen),
        answer(cells=subgoals.cells + 2),
        answer(beyond=1.0),
        answer(phi=-task.arrays.class_phi),
    )
    assert len({answer(), *others}) == 6


@pytest.mark.parametrize("ablated", ["painting", "paths", "position"])
def test_what_a_network_is_made_without_does_not_enter_its_answers(params, ablated):
    eyes, belief, subgoals, task = _asked(params, _world())
    lacking = BuildingNetwork(dataclasses.replace(CONFIG, without=(ablated,)))
    unpainted = dataclasses.replace(eyes, memory=blank_painting(*belief.cells.shape))

    def answer(network, eyes=eyes, beyond=1.0, moved=0):
        encoded = _encode(network, params, map_channels(belief, eyes.memory))
        # The same squares around another cell.
        features = jax.tree.map(lambda scale: jnp.ones_like(scale), encoded)
        places = _places(network, params, features, subgoals.cells + moved)
        seen = _places(network, params, encoded, subgoals.cells)
        modulation = network.modulation(params, task.arrays.class_phi[0, 0], task.arrays.class_phi[0, 1])
        told = jnp.full(PROSPECTS, beyond)
        return [float(network.answer(params, place[0], told, modulation).success_logit) for place in (places, seen)]

    other = {"painting": {"eyes": unpainted}, "paths": {"beyond": 0.0}, "position": {"moved": 1}}[ablated]
    assert answer(NETWORK) != answer(NETWORK, **other)
    assert answer(lacking) == answer(lacking, **other)
    if ablated != "position":
        assert answer(lacking) == pytest.approx(answer(NETWORK, **other), abs=1e-5)


def test_a_map_is_not_confused_with_its_painting(params):
    """Without the painting, everything known of the map still counts."""
    eyes, belief, _, _ = _asked(params, _world())
    lacking = BuildingNetwork(dataclasses.replace(CONFIG, without=("painting",)))
    channels = map_channels(belief, eyes.memory)
    whole = _encode(lacking, params, channels).whole
    known = 4 + len(NAMES) + 1
    for index in (*range(4), *range(5, known)):
        assert not np.array_equal(whole, _encode(lacking, params, channels.at[:, :, index].add(1.0)).whole)
    for index in (4, *range(known, channels.shape[-1])):
        np.testing.assert_array_equal(whole, _encode(lacking, params, channels.at[:, :, index].add(1.0)).whole)


def test_a_maps_answers_do_not_depend_on_the_others_in_the_batch(params):
    random = np.random.default_rng(0)
    maps = jnp.asarray(random.normal(size=(3, 12, 26, channel_count(CONFIG))), jnp.float32)
    cells = jnp.asarray(random.integers(0, 12, (3, 4, 2)), jnp.int32)
    together = _encode(NETWORK, params, maps)
    # 26 columns are padded to 32, and 12 rows to 16.
    assert together.squares.holds.shape == (3, 16 // SQUARE, 32 // SQUARE, 2)
    places = _places(NETWORK, params, together, cells)
    for index in range(3):
        alone = _places(NETWORK, params, _encode(NETWORK, params, maps[index]), cells[index])
        np.testing.assert_allclose(places[index], alone, rtol=1e-4, atol=1e-5)


def test_a_place_reads_the_squares_around_its_cell(params):
    """A change far from a cell and from its squares, of the first scale's features, changes nothing at this scale."""
    maps = jnp.zeros((32, 32, channel_count(CONFIG)))
    encoded = _encode(NETWORK, params, maps)
    cells = jnp.array([[9, 13]])
    before = _places(NETWORK, params, encoded, cells)

    def after(row: int, column: int):
        close = encoded.close.at[row, column].add(1.0)
        return _places(NETWORK, params, dataclasses.replace(encoded, close=close), cells)

    # Squares of two cells: that of the cell is (4, 6), and two on each side of it are read.
    assert not np.array_equal(before, after(6, 8))
    assert not np.array_equal(before, after(2, 4))
    assert np.array_equal(before, after(7, 6))
    assert np.array_equal(before, after(4, 9))


@pytest.mark.long
def test_trials_with_the_network_are_the_same_alone_and_in_a_batch(params):
    world = _world()
    assert isinstance(_estimator(params, world), ObservingEstimator)
    assert looks_on_the_way(_estimator(params, world))
    task = Task.from_formula("!hazard U goal", propositions=NAMES)
    estimator = _estimator(params, world)
    trials = list(
        run_batch(
            [Start(world, task.arrays, jax.random.key(n), name=n) for n in range(3)],
            Policy.POTLP,
            TRIAL,
            slots=2,
            estimator=estimator,
        )
    )
    alone = run_trial(world, task, Policy.POTLP, jax.random.key(0), TRIAL, estimator=estimator)
    assert [trial.outcome for trial in trials] == [alone.outcome] * 3
    for trial in trials:
        np.testing.assert_array_equal(trial.path, np.asarray(alone.path))


@pytest.mark.long
def test_subgoals_in_one_square_are_told_apart_by_the_cells_around_them(params):
    """Nothing but the cells themselves, as they are, tells two corners of a square of two by two from each other."""
    rng = np.random.default_rng(5)
    channels = jnp.asarray(rng.normal(size=(12, 26, 14)).astype(np.float32))
    cells = jnp.array([[4, 6], [5, 7]], jnp.int32)
    blind = dataclasses.replace(CONFIG, raw=0, without=("position",))
    for config in (blind, dataclasses.replace(blind, raw=3)):
        network = BuildingNetwork(config)
        found = network.init(jax.random.key(2))
        one, other = np.asarray(network.places(found, network.encode(found, channels), cells))
        assert np.array_equal(one, other) == (config.raw == 0)


def test_what_is_painted_enters_nowhere_where_it_is_left_out(params):
    config = dataclasses.replace(CONFIG, without=("painting",))
    network = BuildingNetwork(config)
    rng = np.random.default_rng(6)
    channels = rng.normal(size=(12, 26, 14)).astype(np.float32)
    other = channels.copy()
    other[..., of_painting(14)] += 1
    cells = jnp.array([[4, 6]], jnp.int32)
    one, same = (
        network.places(params, network.encode(params, jnp.asarray(shown)), cells) for shown in (channels, other)
    )
    np.testing.assert_array_equal(one, same)


def test_a_file_from_before_colours_were_compared_is_read(tmp_path):
    config = dataclasses.replace(CONFIG, contrast=0, raw=0, glances=False)
    params = BuildingNetwork(config).init(jax.random.key(0))
    save_estimator(tmp_path / "now.npz", params, config, Domain("toy", CAMERA, "cells"), {})
    arrays = dict(np.load(tmp_path / "now.npz"))
    header = json.loads(arrays.pop("header").tobytes())
    assert [header["network"].pop(name) for name in ("contrast", "raw", "glances")] == [0, 0, False]
    np.savez(tmp_path / "before.npz", header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
    assert load_estimator(tmp_path / "before.npz")[1] == config


def test_a_network_cannot_be_made_without_what_is_not_known():
    with pytest.raises(NetworkError, match="without has doors; known: painting, paths, position"):
        dataclasses.replace(CONFIG, without=("doors",))


def test_squares_are_compared_with_the_mean_of_their_kind():
    rng = np.random.default_rng(3)
    value, weight = rng.normal(size=(2, 5, 7, 3)).astype(np.float32), rng.random((2, 5, 7, 3)).astype(np.float32)
    weight[:, 2] = 0  # never painted
    slow = np.zeros_like(value)
    for building, channel in np.ndindex(2, 3):
        cells = list(np.ndindex(5, 7))
        total = sum(weight[building, *cell, channel] for cell in cells)
        mean = sum(weight[building, *cell, channel] * value[building, *cell, channel] for cell in cells) / (total + 1)
        for cell in cells:
            slow[building, *cell, channel] = (value[building, *cell, channel] - mean) * weight[building, *cell, channel]
    np.testing.assert_allclose(compared(jnp.asarray(value), jnp.asarray(weight)), slow, rtol=1e-5, atol=1e-6)


def test_a_shade_in_one_corner_changes_what_is_said_of_another(params):
    # Farther apart than any convolution of the first scale sees, and never painted cells take no part.
    channels = np.zeros((64, 64, channel_count(CONFIG)), np.float32)
    channels[:8, :8, 4] = channels[56:, 56:, 4] = 1
    close = _encode(NETWORK, params, jnp.asarray(channels)).close
    channels[56:, 56:, -1] = 1
    other = _encode(NETWORK, params, jnp.asarray(channels)).close
    assert np.abs(np.asarray(close - other))[:4, :4].max() > 1e-4
    np.testing.assert_array_equal(np.asarray(close)[10:20, 10:20], np.asarray(other)[10:20, 10:20])


def test_operations_are_about_those_that_xla_counts(params):
    maps = jnp.zeros((62, 182, channel_count(CONFIG)))
    analysis = jax.jit(NETWORK.encode).lower(params, maps).compile().cost_analysis()
    first, place, pair = building_operations(CONFIG, 62, 182)
    # XLA counts activations too, and leaves out what convolutions would do on their padding.
    assert first == pytest.approx(analysis["flops"], rel=0.2)
    assert pair == 2 * (PROSPECTS * 16 + 3 * 16 * 16 + 16 * 3)
    # 25 squares of 8 features, 9 of 8 of the one scale of the decoder, 12 of the whole, 2 coordinates.
    assert place == 2 * ((25 * 14 + 25 * 8 + 9 * 8 + 12 + 2) * 16 + 16 * 16)


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("propositions", (), "propositions"),
        ("widths", (8, 8), "widths"),
        ("blocks", (1,), "blocks"),
        ("head", 0, "head"),
        ("contrast", -1, "contrast"),
        ("raw", 4, "raw"),
        ("raw", -1, "raw"),
        ("far", float("nan"), "far"),
        ("exclusive_within", -1.0, "exclusive_within"),
    ],
)
def test_what_is_no_network_is_named(field, value, named):
    with pytest.raises(NetworkError, match=named):
        dataclasses.replace(CONFIG, **{field: value})


def test_other_propositions_are_refused(params):
    eyes, belief, subgoals, _ = _asked(params, _world())
    other = Task.from_formula("F hazard", propositions=("hazard", "goal"))
    with pytest.raises(PropositionsError, match="goal"):
        eyes(belief, subgoals, other.arrays)
    with pytest.raises(NetworkError, match="lengths 3 and 3"):
        NETWORK.modulation(params, jnp.zeros((1, 3), jnp.int8), jnp.zeros((1, 3), jnp.int8))
