"""Collection: what is recorded is what there is to see, and a process that is killed loses and repeats nothing."""

import dataclasses
import itertools
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from flax import struct

from examples.own_environment import Corridor
from potlp_jax.codec import differences
from potlp_jax.engine.engine import Broken, Here
from potlp_jax.engine.opening import open_engine
from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.environments.firefighting_layout import FirefightingConfig
from potlp_jax.environments.posterior import Drawn
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import DatasetError, WorldError
from potlp_jax.learning.dataset import decode, finished_shards, read_metadata, samples_file, views_file
from potlp_jax.learning.dataset_reading import read_dataset
from potlp_jax.learning.questions import TaskDistribution
from potlp_jax.learning.recording import overflow_in_words
from potlp_jax.learning.scenes import survey
from potlp_jax.recipes.collection import CollectConfig, collect, collection_of, dataset_metadata, summary
from potlp_jax.recipes.exploration import Explorer, ExplorerConfig
from potlp_jax.task.task import Task
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.renderer import render
from potlp_jax.world.sensing import SensorConfig
from potlp_jax.world.settings import Settings
from tests.reference.dijkstra import dijkstra, grid_moves
from tests.reference.sensing import visible

GENERATOR = Firefighting.toy()
CONFIG = CollectConfig(
    worlds_per_shard=2,
    views_per_world=5,
    spacing=(1.0, 8.0),
    tasks_per_world=4,
    classes=5,
    staying_sets=2,
    held_out=("F exit",),
    image_format="png",
    camera=CameraConfig(height=16, width=64),
    explorer=ExplorerConfig(sensor=SensorConfig(range_cells=9.0)),
)
WORLDS = 8
REPOSITORY = Path(__file__).parent.parent


def _collect(folder):
    collect(GENERATOR, "firefighting", Split.TRAINING, WORLDS, folder, CONFIG)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A folder that keeps compiled programs, for this process and those that it starts."""
    settings = {
        "jax_compilation_cache_dir": str(tmp_path_factory.mktemp("programs")),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        # As in conftest.py, for the processes that are started.
        "jax_numpy_rank_promotion": "raise",
        "jax_numpy_dtype_promotion": "strict",
    }
    before = {name: jax.config.values[name] for name in settings}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            jax.config.update(name, value)
            patch.setenv(name.upper(), str(value))
        yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture(scope="module")
def dataset(compiled, tmp_path_factory):
    """A small dataset, collected without interruption."""
    folder = tmp_path_factory.mktemp("dataset")
    _collect(folder)
    return folder


def _tables(folder):
    """Views and samples of all shards, as pandas reads them."""
    shards = sorted(finished_shards(folder))
    return tuple(
        pd.concat([pd.read_parquet(file(folder, shard)) for shard in shards]) for file in (views_file, samples_file)
    )


def test_views_show_the_world_from_where_the_robot_stood(dataset):
    views, _ = _tables(dataset)
    assert views["view"].is_unique
    assert set(views["world"]) == set(range(WORLDS))
    assert (views.groupby("world").size() <= CONFIG.views_per_world).all()
    assert views.groupby("world")["step"].apply(lambda steps: steps.is_monotonic_increasing).all()
    look = jax.jit(lambda world, cell: render(world, cell, CONFIG.camera))
    for view in views.itertuples():
        world = GENERATOR.generate(world_key(Split.TRAINING, view.world, GENERATOR.name))
        expected = look(world, jnp.asarray([view.row, view.column], jnp.int32))
        _assert_same_picture(decode(view.image), np.asarray(expected))


def test_samples_are_distinct_classes_of_their_tasks(dataset):
    views, samples = _tables(dataset)
    together = samples.merge(views, on="view", suffixes=("", "_of_robot"))
    assert len(together) == len(samples)
    tasks = {text: Task.from_formula(text, GENERATOR.propositions) for text in set(samples["task"])}
    classes = [(*(tuple(phi) for phi in tasks[row.task].classes[row.outcome_class]),) for row in samples.itertuples()]
    assert classes == [(tuple(row.phi_stay), tuple(row.phi_go)) for row in samples.itertuples()]
    keys = pd.DataFrame({"view": samples["view"].to_numpy(), "class": classes, "row": samples["row"].to_numpy()})
    keys["column"] = samples["column"].to_numpy()
    assert not keys.duplicated().any()
    bearing = np.arctan2(together["row"] - together["row_of_robot"], together["column"] - together["column_of_robot"])
    np.testing.assert_allclose(together["bearing"], bearing, atol=1e-6)


def test_labels_and_weights_are_in_their_ranges(dataset):
    samples = read_dataset(dataset)
    bounds = samples.metadata.weights
    succeeds = samples.success == 1
    assert 0 < succeeds.sum() < len(succeeds)
    assert (samples.success_cost[succeeds] >= 1).all()
    assert np.isnan(samples.success_cost[~succeeds]).all()
    for weights in (samples.success_weight, samples.failure_weight):
        assert (weights >= np.float32(bounds["low"])).all()
        assert (weights <= np.float32(bounds["high"])).all()
    longest = math.dist((0, 0), GENERATOR.config.shape)
    expected = np.clip(2 * samples.failure_cost, bounds["low"], bounds["high"])
    np.testing.assert_allclose(samples.failure_weight, expected, rtol=1e-6)
    assert (samples.distance > 0).all()
    assert (samples.distance < 4 * longest).all()


def test_the_metadata_say_how_it_was_made(dataset):
    metadata = read_metadata(dataset)
    assert metadata.propositions == GENERATOR.propositions
    assert metadata.split == "training"
    assert metadata.generator["hallway_length"] == GENERATOR.config.hallway_length
    assert metadata.camera["width"] == 64
    assert metadata.collection["seed"] == CONFIG.seed
    assert metadata.collection["held_out"] == ["F exit"]
    assert "F exit" not in set(_tables(dataset)[1]["task"])
    words = summary(read_dataset(dataset))
    assert f"{len(_tables(dataset)[0])} views" in words
    assert all(name in words for name in GENERATOR.propositions)


def _times(folder):
    """When each file was written; the writer's lock says who holds it, whatever there is to do."""
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir() if path.name != "writer.lock"}


@pytest.mark.long
def test_a_killed_collection_continues_and_nothing_is_there_twice(dataset, tmp_path):
    # Types are checked in there as in here: the programs are then the same, and compiled already.
    start = (
        "from jaxtyping import install_import_hook; install_import_hook('potlp_jax', 'beartype.beartype'); "
        f"from tests.test_collect import _collect; from pathlib import Path; _collect(Path({str(tmp_path)!r}))"
    )
    process = subprocess.Popen([sys.executable, "-c", start], cwd=REPOSITORY, stderr=subprocess.DEVNULL)
    while process.poll() is None and not finished_shards(tmp_path):
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    first = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("samples-*.parquet")}
    assert 0 < len(first) < WORLDS // CONFIG.worlds_per_shard
    # What a process that dies while it writes leaves behind.
    last = WORLDS // CONFIG.worlds_per_shard - 1
    (tmp_path / f"views-{last:05d}.parquet.1.tmp").write_bytes(b"PAR1")
    if last not in finished_shards(tmp_path):
        views_file(tmp_path, last).write_bytes(b"PAR1")
    _collect(tmp_path)
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in first} == first
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in dataset.iterdir())
    for found, expected in zip(_tables(tmp_path), _tables(dataset), strict=True):
        pd.testing.assert_frame_equal(
            found.drop(columns="image", errors="ignore"), expected.drop(columns="image", errors="ignore")
        )
    for found, expected in zip(_tables(tmp_path)[0]["image"], _tables(dataset)[0]["image"], strict=True):
        _assert_same_picture(decode(found), decode(expected))
    before = _times(tmp_path)
    _collect(tmp_path)
    assert _times(tmp_path) == before


@pytest.mark.long
def test_several_processes_take_whole_shards(tmp_path):
    # What counts is that the shards that are missing come from other processes.
    config = dataclasses.replace(CONFIG, views_per_world=1)
    collect(GENERATOR, "firefighting", Split.TRAINING, 2, tmp_path, config)
    first = samples_file(tmp_path, 0).stat().st_mtime_ns
    with open_engine(2) as engine:
        collect(GENERATOR, "firefighting", Split.TRAINING, WORLDS, tmp_path, config, engine)
    assert finished_shards(tmp_path) == set(range(WORLDS // config.worlds_per_shard))
    assert samples_file(tmp_path, 0).stat().st_mtime_ns == first
    assert len(read_dataset(tmp_path).images) == WORLDS


def _assert_same_picture(found, expected):
    """Programs compiled apart may round differently: by one step of brightness, here and there."""
    difference = np.abs(found.astype(int) - expected)
    assert difference.max() <= 1
    assert (difference > 0).mean() < 0.01


def test_a_folder_with_other_settings_is_not_continued(dataset):
    other = dataclasses.replace(CONFIG, seed=5)
    with pytest.raises(DatasetError, match=r"collection.seed was 0, is 5"):
        collect(GENERATOR, "firefighting", Split.TRAINING, WORLDS, dataset, other)
    with pytest.raises(DatasetError, match=r'split was "training", is "validation"'):
        collect(GENERATOR, "firefighting", Split.VALIDATION, WORLDS, dataset, CONFIG)


def test_an_environment_of_ones_own_is_collected(tmp_path):
    """It has no configuration, and its trials have another camera: views are taken by that."""

    class Dim(Corridor):
        settings = Settings(
            {"camera": {"height": 64, "width": 128, "far": 25.0}, "look_every": 3, "disturbance": {"noise": 2.0}}
        )

    config = dataclasses.replace(collection_of(Dim()), worlds_per_shard=1, views_per_world=2)
    assert (config.camera.far, config.look_every, config.disturbance.noise) == (25.0, 3, 2.0)
    collect(Dim(), "dim", Split.VALIDATION, 1, tmp_path, config)
    metadata, samples = read_metadata(tmp_path), read_dataset(tmp_path)
    assert set(metadata.generator) == {"source", "first_world"}
    assert metadata.camera["far"] == 25.0
    assert decode(samples.images[0]).shape == (64, 128, 3)


def test_the_wandering_robot_senses_as_in_trials():
    class NearSighted(Corridor):
        settings = Settings({"sensor": {"range_cells": 7.0}})

    assert collection_of(NearSighted()).explorer.sensor == SensorConfig(range_cells=7.0)
    # As it was recorded for the shipped estimators, whose families name no sensor.
    for name in ("firefighting", "delivery", "parcels", "campus-small", "campus-medium-parcels", "toy"):
        assert collection_of(make(name)).explorer.sensor == ExplorerConfig().sensor


def test_a_collection_does_not_go_on_after_its_environment_has_changed(tmp_path, monkeypatch):
    class Mine(Corridor):
        pass

    config = dataclasses.replace(collection_of(Mine()), worlds_per_shard=1, views_per_world=2)
    collect(Mine(), "mine", Split.VALIDATION, 1, tmp_path, config)
    monkeypatch.setattr("potlp_jax.plugins.source_digest", lambda found: "another")
    with pytest.raises(DatasetError, match=r"collected otherwise .*source"):
        collect(Mine(), "mine", Split.VALIDATION, 2, tmp_path, config)


def test_a_collection_does_not_go_on_with_another_world_of_the_same_name(tmp_path, monkeypatch):
    """As a map or labels that were edited are."""
    config = dataclasses.replace(collection_of(Corridor()), worlds_per_shard=1, views_per_world=2)
    collect(Corridor(), "mine", Split.VALIDATION, 1, tmp_path, config)
    generate = Corridor.generate

    def edited(self, key):
        world = generate(self, key)
        return world.replace(letters=world.letters.at[tuple(world.start.tolist())].set(1))

    monkeypatch.setattr(Corridor, "generate", edited)
    with pytest.raises(DatasetError, match=r"collected otherwise .*first_world"):
        collect(Corridor(), "mine", Split.VALIDATION, 2, tmp_path, config)


def test_a_collection_does_not_go_on_with_another_camera_of_the_same_name(tmp_path, monkeypatch):
    (tmp_path / "lens.py").write_text("from potlp_jax.world.renderer import *\ndef look(world, cell, config): pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    camera = CameraConfig(renderer="lens:look")
    config = dataclasses.replace(collection_of(Corridor()), camera=camera)
    before = dataset_metadata(Corridor(), "mine", Split.VALIDATION, config)
    (tmp_path / "lens.py").write_text("def look(world, cell, config): return None\n")
    after = dataset_metadata(Corridor(), "mine", Split.VALIDATION, config)
    found = differences(before.generator, after.generator)
    assert [text.partition(" was ")[0] for text in found] == ["renderer_source"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"travel_factor": math.nan}, "travel_factor is nan; give a positive number"),
        ({"travel_factor": -1.0}, "travel_factor is -1.0"),
        ({"random_frontier": 5.0}, "random_frontier is 5.0; give a number from 0 to 1"),
        ({"replan_distance": math.nan}, "replan_distance is nan"),
    ],
)
def test_explorers_that_mean_nothing_are_refused(changes, message):
    with pytest.raises(DatasetError, match=message):
        ExplorerConfig(**changes)


def test_fewer_worlds_than_there_are_is_said(tmp_path):
    config = dataclasses.replace(collection_of(make("toy")), worlds_per_shard=1, views_per_world=2)
    collect(make("toy"), "toy", Split.VALIDATION, 2, tmp_path, config)
    with pytest.raises(DatasetError, match="holds 2 worlds, more than the 1 that are asked for"):
        collect(make("toy"), "toy", Split.VALIDATION, 1, tmp_path, config)


def test_views_with_more_subgoals_than_are_recorded_are_counted(tmp_path):
    told = []
    # A room with mouths of hallways: two of its subgoals are never in sight of each other.
    few = dataclasses.replace(CONFIG, frontiers=dataclasses.replace(CONFIG.frontiers, max_subgoals=1), held_out=())
    collect(GENERATOR, "firefighting", Split.TRAINING, 2, tmp_path / "few", few, tell=told.append)
    collected = told[-1]
    assert 0 < collected.overflowed <= collected.views == len(read_dataset(tmp_path / "few").images)
    words = overflow_in_words(collected.views, collected.overflowed, 1, "--set frontiers.max_subgoals=")
    assert words.startswith(f"{collected.overflowed} of the {collected.views} views recorded now have more than 1")
    assert "--set frontiers.max_subgoals=2" in words
    # What is there already is not looked at again.
    collect(GENERATOR, "firefighting", Split.TRAINING, 2, tmp_path / "few", few, tell=told.append)
    assert (told[-1].views, told[-1].overflowed) == (0, 0)
    assert overflow_in_words(0, 0, 1, "") == ""
    collect(GENERATOR, "firefighting", Split.TRAINING, 2, tmp_path / "all", CONFIG, tell=told.append)
    assert told[-1].overflowed == 0 < told[-1].views


def test_a_summary_has_the_mean_of_labels_that_are_shares(dataset):
    samples = read_dataset(dataset)
    shares = dataclasses.replace(samples, success=np.full_like(samples.success, 1 / 16))
    words = summary(shares)
    assert words.count("mean P_S 0.062") >= 2
    assert "100.0%" not in words


def test_worlds_fill_whole_shards(tmp_path):
    with pytest.raises(DatasetError, match="ask for 4 worlds"):
        collect(GENERATOR, "firefighting", Split.TRAINING, 5, tmp_path, CONFIG)
    assert not list(tmp_path.iterdir())


def test_a_shard_that_kills_its_workers_is_named(tmp_path):
    class Dying(Here):
        def run(self, work, shared, units):
            yield 1, Broken("3 workers that began it died")

    with pytest.raises(DatasetError, match=r"shard 1 of .* cannot be collected: 3 workers that began it died"):
        collect(GENERATOR, "firefighting", Split.TRAINING, 4, tmp_path, CONFIG, Dying())


def _wander(index, seed=0):
    world = GENERATOR.generate(world_key(Split.TRAINING, index, GENERATOR.name))
    rng = np.random.default_rng(seed)
    tasks = [TaskDistribution(GENERATOR.propositions).draw(rng) for _ in range(4)]
    return world, list(Explorer(world, tasks, rng, CONFIG.explorer).poses())


def test_subgoals_in_view_and_their_distances_equal_the_reference(compiled):
    world, poses = _wander(1)
    occupied = np.asarray(world.occupied).tolist()
    hidden, several = 0, 0
    for pose in poses[:: max(1, len(poses) // 8)]:
        scene = survey(world, pose.belief, jnp.asarray(pose.cell, jnp.int32))
        free = np.asarray(pose.belief.free).tolist()

        def moves(cell, free=free):
            return ((there, step) for there, step in grid_moves(free, cell) if free[there[0]][there[1]])

        distances = dijkstra(pose.cell, moves)
        seen = visible(occupied, pose.cell, float(sum(world.shape)))
        component = np.asarray(scene.subgoals.component)
        for s in np.flatnonzero(scene.subgoals.mask):
            cell = tuple(np.asarray(scene.subgoals.cells[s]).tolist())
            assert float(scene.distance[s]) == pytest.approx(distances[cell], rel=1e-5)
            in_view = any(tuple(at) in seen for at in np.argwhere(component == s).tolist())
            assert bool(scene.in_view[s]) == in_view
            hidden += not in_view
        assert not np.any(np.asarray(scene.in_view) & ~np.asarray(scene.subgoals.mask))
        several += int(scene.in_view.sum()) > 1
    assert hidden > 0
    assert several > 0


def test_the_explorer_sees_much_of_the_building_and_walks_through_known_cells(compiled):
    for index in (0, 1):
        world, poses = _wander(index)
        free = int((~world.occupied).sum())
        known = [int(pose.belief.free.sum()) for pose in poses]
        assert known == sorted(known)
        assert known[-1] > 0.8 * free
        limit = CONFIG.explorer.travel_factor * sum(world.shape)
        assert poses[0].cell == tuple(world.start.tolist())
        for before, after in itertools.pairwise(poses):
            assert after.step > before.step
            assert after.travelled - before.travelled >= math.dist(before.cell, after.cell) - 1e-6
            assert after.travelled <= limit + math.sqrt(2)
            # The robot entered the cell knowing that it is free.
            assert bool(after.belief.free[after.cell])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pursued": 0}, "pursued is 0; give at least 1"),
        ({"drives": 0}, "drives is 0"),
        ({"first_world": -4}, "numbered from 0"),
        ({"views_per_world": 0}, "views_per_world is 0; give at least 1"),
        ({"spacing": (9.0, 2.0)}, "give the least and the most"),
        ({"spacing": (0.0, math.inf)}, "give the least and the most"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": 2**32}, "seed is 4294967296; give a whole number from 0 to 4294967295"),
        ({"staying_sets": 1}, "staying_sets is 1; give at least 2"),
        ({"image_format": "bmp"}, "image_format is 'bmp'; choose jpeg or png"),
        ({"quality": 200}, "quality is 200; give a number from 0 to 100"),
        ({"estimator": "firefighting"}, "the driver explorer asks no estimator"),
    ],
)
def test_settings_that_mean_nothing_are_refused(changes, message):
    with pytest.raises(DatasetError, match=message):
        CollectConfig(**changes)


@struct.dataclass(kw_only=True)
class Certain:
    """A posterior that knows the building; its evidence counts the panoramas."""

    evidence: jax.Array
    occupied: jax.Array
    letters: jax.Array

    def after(self, cell):
        return dataclasses.replace(self, evidence=self.evidence + 1)

    def draw(self, belief):
        return Drawn(occupied=self.occupied[None], letters=self.letters[None], agrees=self.evidence > 0)


class CertainFirefighting(Firefighting):
    """Whose posterior has no doubt."""

    def posterior(self, key, noise, count):
        world = self.generate(key)
        return Certain(evidence=jnp.int32(0), occupied=world.occupied, letters=world.letters)


class Contradicting(Firefighting):
    """Whose posterior agrees with nothing."""

    def posterior(self, key, noise, count):
        return dataclasses.replace(CertainFirefighting(self.config).posterior(key, noise, count), evidence=-1000)


def test_labels_by_a_posterior_without_doubt_are_those_of_the_true_map(dataset, tmp_path):
    config = dataclasses.replace(CONFIG, posterior=1)
    collect(CertainFirefighting(GENERATOR.config), "firefighting", Split.TRAINING, 2, tmp_path / "one", config)
    mine, its = (pd.read_parquet(samples_file(folder, 0)) for folder in (tmp_path / "one", dataset))
    pd.testing.assert_frame_equal(mine, its)


@pytest.mark.long
def test_labels_by_a_posterior_are_means_that_are_right_on_average(compiled, tmp_path):
    # Narrow hallways with thin smoke: from the room nobody sees which of them burns.
    family = Firefighting(
        FirefightingConfig(
            room_width=6, room_height=15, hallway_length=16, hallway_width=1, hallway_spacing=5, smoke_reach=0.5
        )
    )
    folders = []
    for buildings in (0, 12):
        folders.append(tmp_path / str(buildings))
        config = dataclasses.replace(CONFIG, posterior=buildings)
        collect(family, "firefighting", Split.TRAINING, WORLDS, folders[-1], config)
    (views, hard), (mine, means) = map(_tables, folders)
    # The same views and questions: only the answers differ.
    pd.testing.assert_frame_equal(mine, views)
    asked = ["view", "task", "outcome_class", "row", "column"]
    pd.testing.assert_frame_equal(means[asked], hard[asked])
    doubt = (means["success_probability"] > 0) & (means["success_probability"] < 1)
    assert doubt.mean() > 0.05
    np.testing.assert_array_equal(means["success_cost"].isna(), means["success_probability"] == 0)
    # Whatever the doubt is, the answers of the buildings themselves are right that often.
    assert abs((means["success_probability"] - hard["success_probability"])[doubt].mean()) < 0.15
    assert (means["success_probability"] == hard["success_probability"])[~doubt].mean() > 0.9


def test_families_that_do_not_say_what_they_can_be_give_no_such_labels(tmp_path):
    config = dataclasses.replace(CONFIG, posterior=12, held_out=())
    with pytest.raises(WorldError, match="does not say what its worlds can be"):
        collect(make("toy"), "toy", Split.TRAINING, 2, tmp_path / "toy", config)
    with pytest.raises(DatasetError, match="no building of its family agrees"):
        collect(Contradicting(GENERATOR.config), "firefighting", Split.TRAINING, 2, tmp_path / "wrong", config)
    with pytest.raises(DatasetError, match="posterior is -1"):
        dataclasses.replace(CONFIG, posterior=-1)


def test_drives_sense_and_choose_as_what_is_recorded(tmp_path, monkeypatch):
    asked = []

    def drives(world, tasks, policy, estimator, settings, key):
        asked.append(settings)
        return [Explorer(world, tasks, np.random.default_rng(0), CONFIG.explorer).poses() for _ in tasks]

    monkeypatch.setattr("potlp_jax.recipes.collection.policy_drives", drives)
    frontiers = dataclasses.replace(CONFIG.frontiers, min_size=1)
    config = dataclasses.replace(CONFIG, driver="baseline", drives=1, frontiers=frontiers)
    collect(GENERATOR, "firefighting", Split.TRAINING, 2, tmp_path, config)
    settings, _ = asked
    assert settings.sensor == CONFIG.explorer.sensor != SensorConfig()
    assert settings.decision.frontiers == frontiers != CollectConfig().frontiers
