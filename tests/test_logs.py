"""Robots' logs: a bag that the simulator wrote gives what the simulator gives; every defect is told and survived."""

import dataclasses
import itertools
import json
import math
import shutil
import sqlite3
import struct
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.map_server import MapError
from potlp_jax.environments.places import Places, load_places
from potlp_jax.environments.toy import Toy, ToyConfig
from potlp_jax.learning.dataset import decode, encode, read_dataset, samples_file, views_file
from potlp_jax.learning.formulas import TaskDistribution
from potlp_jax.learning.sampling import Pose, Recorder, ViewConfig, record_views, settled, survey
from potlp_jax.learning.weights import WeightBounds
from potlp_jax.logs import writing
from potlp_jax.logs.bag import open_bag
from potlp_jax.logs.collecting import LogCollectConfig, collect_drives
from potlp_jax.logs.drive import Eyes, GridConfig, read_drive
from potlp_jax.logs.errors import LogError
from potlp_jax.logs.inspection import inspect
from potlp_jax.logs.log import SECOND, Log, LogConfig, typestore
from potlp_jax.logs.replaying import replay
from potlp_jax.logs.transforms import Transforms, headings, quaternion_of
from potlp_jax.logs.writing import BagFormat, labels_text, write_drive
from potlp_jax.planning.policies import Policy
from potlp_jax.records import NEVER_SEEN, Outcome, RecordError, belief_seen_by, load_trial
from potlp_jax.replay import panorama_at
from potlp_jax.robot import photograph
from potlp_jax.task.task import Task
from potlp_jax.trial import run_trial
from potlp_jax.trial_config import TrialConfig
from potlp_jax.world.grid import BeliefMap, make_world
from potlp_jax.world.panorama import CameraConfig, Disturbance
from potlp_jax.world.sensing import SensorConfig, observe

TOY = Toy(ToyConfig(door_row=4, start=(4, 2), goal=(2, 12), hazard=(6, 9)))
WORLD = TOY.generate(jax.random.key(0))
NEAR = TrialConfig(sensor=SensorConfig(range_cells=3.0))
TASK = Task.shipped("toy-2")
CAMERA = CameraConfig(height=16, width=64, horizon=6.0, fold=2.0)
FORMATS = list(BagFormat)

_look = jax.jit(observe, static_argnames="config")


def _tour() -> list[tuple[int, int]]:
    """Cells from which, with a range of 3, everything but the outermost corners of the rooms is seen."""
    left = [(4, 2), (3, 3), (2, 4), (3, 5), (4, 5), (5, 5), (6, 4), (6, 3), (5, 4), (4, 5), (4, 6), (4, 7), (4, 8)]
    right = [(3, 9), (2, 10), (2, 11), (3, 12), (4, 12), (5, 12), (6, 11), (6, 10)]
    return left + right


def _first_seen(world, path, sensor=NEAR.sensor):
    belief, seen = BeliefMap.unobserved(world), np.full(world.shape, NEVER_SEEN, np.int32)
    for step, cell in enumerate(path):
        belief = _look(belief, world, jnp.asarray(cell, jnp.int32), config=sensor)
        seen[~np.asarray(belief.unknown) & (seen == NEVER_SEEN)] = step
    return seen


def _panorama(step):
    cell = jnp.asarray(_tour()[step], jnp.int32)
    return np.asarray(photograph(WORLD, cell, jax.random.key(0), CAMERA, Disturbance()))


@pytest.fixture(scope="module")
def trial():
    """A trial of the simulator."""
    return run_trial(WORLD, TASK, Policy.BASELINE, jax.random.key(0), NEAR)


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """The tour as a bag of each format, and the labels."""
    folder = tmp_path_factory.mktemp("bags")
    seen = _first_seen(WORLD, _tour())
    for kind in FORMATS:
        write_drive(folder / _name(kind), kind, WORLD, _tour(), seen, _panorama, CAMERA, height=180)
    (folder / "labels.yaml").write_text(labels_text(WORLD, TOY.propositions))
    return folder


def _name(kind):
    return "tour.bag" if kind is BagFormat.ROS1 else f"tour-{kind}"


def _places(bags):
    return load_places(bags / "labels.yaml")


def _drive(path, places, config=None, grid=None):
    return read_drive(Log(path, config or LogConfig()), places, grid or GridConfig())


# What the simulator wrote is what is read.


@pytest.mark.parametrize("kind", FORMATS)
def test_a_bag_gives_back_the_drive(bags, kind):
    drive = _drive(bags / _name(kind), _places(bags))
    assert drive.notes == ()
    assert drive.path == tuple(_tour())
    assert drive.world.shape == WORLD.shape
    np.testing.assert_array_equal(drive.first_seen, _first_seen(WORLD, _tour()))
    known = drive.first_seen != NEVER_SEEN
    np.testing.assert_array_equal(np.asarray(drive.world.letters)[known], np.asarray(WORLD.letters)[known])
    np.testing.assert_array_equal(np.asarray(drive.world.occupied)[known], np.asarray(WORLD.occupied)[known])
    assert sorted(drive.pictures) == list(range(len(_tour())))


@pytest.mark.parametrize("kind", FORMATS)
def test_decisions_along_a_bag_are_those_of_the_simulator(trial, tmp_path, kind):
    bag = tmp_path / _name(kind)
    writing.write_trial(trial, bag, kind, tmp_path / "labels.yaml", height=64)
    drive = _drive(bag, _places(tmp_path))
    found, panoramas = replay(drive, TASK, Policy.BASELINE, jax.random.key(0), NEAR)
    assert trial.outcome is found.outcome is Outcome.SATISFIED
    assert (found.path, found.word, found.states) == (trial.path, trial.word, trial.states)
    assert found.cost == pytest.approx(trial.cost)
    assert found.decisions == trial.decisions
    assert len(found.decisions) > 4
    np.testing.assert_array_equal(found.first_seen, trial.first_seen)
    assert panoramas == {}


@pytest.mark.parametrize("kind", FORMATS)
def test_a_dataset_from_a_bag_has_the_rows_of_the_simulator(bags, tmp_path, kind):
    settings = {"spacing": (2.0, 6.0), "tasks_per_world": 2, "image_format": "png"}
    drive = _drive(bags / _name(kind), _places(bags))
    config = LogCollectConfig(camera=CAMERA, **settings)
    (count,) = collect_drives([drive], _places(bags), tmp_path, "toy", "training", config)
    views, samples = pd.read_parquet(views_file(tmp_path, 0)), pd.read_parquet(samples_file(tmp_path, 0))

    recorder = Recorder(0, ViewConfig(views_per_world=200, **settings), WeightBounds.of_map(*WORLD.shape, 1.0))
    rng = np.random.default_rng([0, zlib.crc32(b"training"), 0])
    pool = [TaskDistribution(TOY.propositions).draw(rng) for _ in range(2)]
    record_views(recorder, WORLD, 0, _simulated_poses(), pool, rng, lambda pose: _panorama(pose.step))
    expected = pd.DataFrame(recorder.samples)
    assert count == len(views) == len(recorder.views["view"]) > 2
    assert set(samples["success_probability"]) == {0.0, 1.0}
    for name in samples.columns:
        if samples[name].dtype.kind == "f":
            np.testing.assert_allclose(samples[name], expected[name], rtol=1e-6)
        else:
            assert [_plain(value) for value in samples[name]] == [_plain(value) for value in expected[name]], name
    # Pictures were turned with the robot, resampled twice and encoded.
    for found, made in zip(views["image"], recorder.views["image"], strict=True):
        assert np.abs(decode(found).astype(int) - decode(made)).mean() < 4
    assert read_dataset(tmp_path).metadata.source == "log"


def _simulated_poses():
    seen, travelled = _first_seen(WORLD, _tour()), 0.0
    for step, cell in enumerate(_tour()):
        travelled += math.dist(cell, _tour()[max(step - 1, 0)])
        yield Pose(belief=belief_seen_by(WORLD, seen, step), cell=cell, step=step, travelled=travelled)


def _plain(value):
    return value.tolist() if isinstance(value, np.ndarray) else value


def test_panoramas_are_turned_back_into_the_frame_of_the_map(bags):
    drive = _drive(bags / _name(BagFormat.ROS1), _places(bags))
    eyes = Eyes(drive, CAMERA)
    for step in (0, 5, 12, 3):  # 3: backward, too
        difference = np.abs(eyes.panorama(step).astype(int) - _panorama(step))
        assert difference.mean() < 4
        assert np.abs(np.roll(eyes.panorama(step), 16, axis=1).astype(int) - _panorama(step)).mean() > 6


# Defects, each written into the bag of the tour.


def _rewrite(bags, out, edit, compress=False):
    """Copy the tour, message by message: ``edit(topic, message, time)`` changes it in place; False leaves it out."""
    store = typestore(True)
    with Rosbag1Reader(bags / "tour.bag") as reader, Rosbag1Writer(out) as writer:
        if compress:
            writer.chunk_threshold = 4000
        copies = {
            each.id: writer.add_connection(each.topic, each.msgtype, typestore=store) for each in reader.connections
        }
        for connection, time, data in reader.messages():
            message = store.deserialize_ros1(data, connection.msgtype)
            changed = edit(connection.topic, message, time)
            if changed is not False:
                raw = changed if isinstance(changed, bytes) else store.serialize_ros1(message, connection.msgtype)
                writer.write(copies[connection.id], time, raw)
    return out


def _without(*topics):
    return lambda topic, message, time: topic not in topics


def _step_of(time):
    return round((time - writing.START) / writing.SECONDS_A_CELL / SECOND, 6)


def test_a_bag_without_a_map_names_what_it_has(bags, tmp_path):
    bag = _rewrite(bags, tmp_path / "x.bag", _without("/map"))
    with pytest.raises(LogError, match=r"x\.bag: has no map: record .*OccupancyGrid.*/odom \(nav_msgs/msg/Odometry\)"):
        _drive(bag, _places(bags))
    uses = inspect(Log(bag))["uses"]
    assert all("no map" in use for use in uses.values())


def test_a_bag_without_a_pose_says_what_to_record(bags, tmp_path):
    bag = _rewrite(bags, tmp_path / "x.bag", _without("/tf", "/odom", "/tf_static"))
    with pytest.raises(LogError, match=r"has no pose: record /tf"):
        _drive(bag, _places(bags))
    odometry_alone = _rewrite(bags, tmp_path / "y.bag", _without("/tf"))
    with pytest.raises(LogError, match=r"nothing says where 'base_link' lies in 'map'.*record /tf"):
        _drive(odometry_alone, _places(bags))
    with pytest.raises(LogError, match=r"nothing says where 'lidar' lies in 'map'"):
        _drive(bags / "tour.bag", _places(bags), LogConfig(base_frame="lidar"))


def test_odometry_in_the_frame_of_the_map_is_a_pose(bags, tmp_path):
    frame = writing.frame_of(WORLD)

    def localised(topic, message, time):
        if topic == "/odom":
            message.header.frame_id = "map"
            steps = np.cumsum([0.0, *(math.dist(a, b) for a, b in itertools.pairwise(_tour()))])
            cell = _tour()[int(np.argmin(np.abs(steps - _step_of(time))))]
            message.pose.pose.position.x, message.pose.pose.position.y = frame.cell_to_metres(*cell)
        return topic != "/tf"

    drive = _drive(_rewrite(bags, tmp_path / "x.bag", localised), _places(bags))
    assert drive.path == tuple(_tour())


def test_without_pictures_the_baseline_is_replayed_and_no_dataset_made(bags, tmp_path):
    bag = _rewrite(bags, tmp_path / "x.bag", _without("/panorama/compressed"))
    drive = _drive(bag, _places(bags))
    assert [note for note in drive.notes if note.startswith("no picture")]
    assert drive.path == tuple(_tour())
    with pytest.raises(LogError, match="no panorama that can be used"):
        collect_drives([drive], _places(bags), tmp_path / "data", "toy", "training", LogCollectConfig())
    assert inspect(Log(bag))["uses"]["to-dataset"].startswith("no picture")
    assert inspect(Log(bag))["uses"]["replay without pictures (baseline, optimistic, oracle)"] == "yes"


def test_pictures_of_other_encodings_are_lost_and_counted(bags, tmp_path):
    def spoil(topic, message, time):
        if topic == "/panorama/compressed" and message.header.seq // 4 % 2:
            message.format, message.data = "h264", np.arange(200, dtype=np.uint8)

    log = Log(_rewrite(bags, tmp_path / "x.bag", spoil))
    spoiled = len(_tour()) - len(log.pictures)
    assert 0 < spoiled < len(_tour())
    assert f"/panorama/compressed: {spoiled} of {len(_tour())} messages are lost: format 'h264' is no JPEG" in str(
        log.problems
    )
    drive = read_drive(log, _places(bags))
    assert len(drive.pictures) == len(log.pictures)
    eyes = Eyes(drive, CAMERA)
    for step in drive.pictures:  # those that are left are the right ones
        assert np.abs(eyes.panorama(step).astype(int) - _panorama(step)).mean() < 4


def test_a_picture_whose_data_end_early_is_passed_over(bags, tmp_path):
    def cut(topic, message, time):
        if topic == "/panorama/compressed":
            message.data = message.data[:60]

    drive = _drive(_rewrite(bags, tmp_path / "x.bag", cut), _places(bags))
    assert drive.pictures  # the header is whole
    assert Eyes(drive, CAMERA).panorama(0) is None


def test_messages_of_another_definition_are_lost_and_counted(bags, tmp_path):
    def spoil(topic, message, time):
        return b"\x01\x02" if topic == "/odom" else None

    log = Log(_rewrite(bags, tmp_path / "x.bag", spoil))
    count = len(_tour())
    assert log.problems == [
        f"/odom: {count} of {count} messages are lost: of another definition than nav_msgs/msg/Odometry"
    ]
    assert read_drive(log, _places(bags)).path == tuple(_tour())


def test_maps_that_make_no_sense_are_lost_and_the_others_kept(bags, tmp_path):
    def spoil(topic, message, time):
        if topic == "/map" and _step_of(time) == 0.0:
            message.data = message.data[:-1]
        elif topic == "/map" and _step_of(time) < 3.0:
            message.data = np.full_like(message.data, -7)

    log = Log(_rewrite(bags, tmp_path / "x.bag", spoil))
    assert any("1 of 21 messages are lost: " in problem and "values for" in problem for problem in log.problems)
    assert any("values from -7 to -7, beyond -1 to 100" in problem for problem in log.problems)
    drive = read_drive(log, _places(bags))
    assert drive.path[0] == _tour()[3]  # a drive begins with the last cell before the first map
    np.testing.assert_array_equal(drive.first_seen != NEVER_SEEN, _first_seen(WORLD, _tour()) != NEVER_SEEN)


def test_thresholds_say_what_is_free_and_what_is_in_between(bags, tmp_path):
    def fade(topic, message, time):
        if topic == "/map":
            message.data = np.where(message.data == 100, 70, np.where(message.data == 0, 40, -1)).astype(np.int8)

    bag = _rewrite(bags, tmp_path / "x.bag", fade)
    with pytest.raises(LogError, match=r"leave nothing free in the last map, whose values are .*40.*--free PERCENT"):
        _drive(bag, _places(bags))
    with pytest.raises(LogError, match=r"leave no obstacle"):
        _drive(bag, _places(bags), LogConfig(free=40, occupied=71))
    for config in (LogConfig(free=40, occupied=70), LogConfig(free=69, occupied=70)):
        np.testing.assert_array_equal(_drive(bag, _places(bags), config).first_seen, _first_seen(WORLD, _tour()))
    with pytest.raises(LogError, match="0 <= free < occupied"):
        LogConfig(free=60, occupied=50)


def test_gaps_in_the_pose_are_bridged_and_told(bags, tmp_path):
    def lose(topic, message, time):
        return topic == "/tf_static" or topic == "/map" or not 2.0 < _step_of(time) < 9.0

    drive = _drive(_rewrite(bags, tmp_path / "x.bag", lose), _places(bags))
    assert any("pose: 1 gaps of more than 2 s, the longest of" in note for note in drive.notes)
    free = ~np.asarray(WORLD.occupied)
    for before, after in itertools.pairwise(drive.path):
        assert max(abs(before[0] - after[0]), abs(before[1] - after[1])) == 1
        assert free[before[0], after[1]]
        assert free[after[0], before[1]]
    assert drive.path[0] == _tour()[0]
    assert drive.path[-1] == _tour()[-1]
    log = Log(
        _rewrite(bags, tmp_path / "y.bag", lambda topic, _, time: topic != "/odom" or not 2.0 < _step_of(time) < 9.0)
    )
    (odometry,) = [topic for topic in inspect(log)["topics"] if topic["name"] == "/odom"]
    (gap,) = odometry["gaps"]
    assert gap["seconds"] == pytest.approx(7.0 * writing.SECONDS_A_CELL, abs=1.0)


def test_pictures_in_a_gap_of_the_pose_are_passed_over(bags, tmp_path):
    def lose(topic, message, time):
        return topic not in ("/tf", "/odom") or not 2.0 < _step_of(time) < 18.0

    drive = _drive(_rewrite(bags, tmp_path / "x.bag", lose), _places(bags), LogConfig(longest_gap=1.0))
    assert any("pictures are passed over: no pose is near" in note for note in drive.notes)


def test_stamps_of_another_clock_give_way_to_the_recording(bags, tmp_path):
    def shift(topic, message, time):
        if topic == "/panorama/compressed":
            message.header.stamp.sec -= 1_000_000

    drive = _drive(_rewrite(bags, tmp_path / "x.bag", shift), _places(bags))
    assert any("/panorama/compressed: 21 stamps are by another clock" in note for note in drive.notes)
    assert sorted(drive.pictures) == list(range(len(_tour())))


def test_earlier_maps_of_another_resolution_are_laid_on_the_last(bags, tmp_path):
    def refine(topic, message, time):
        if topic == "/map" and _step_of(time) < 8.0:
            info = message.info
            cells = message.data.reshape(info.height, info.width)
            message.data = np.kron(cells, np.ones((2, 2), np.int8)).ravel()
            info.resolution, info.height, info.width = info.resolution / 2, 2 * info.height, 2 * info.width

    drive = _drive(_rewrite(bags, tmp_path / "x.bag", refine), _places(bags))
    np.testing.assert_array_equal(drive.first_seen, _first_seen(WORLD, _tour()))


def test_maps_that_cannot_be_laid_on_each_other_are_refused(bags, tmp_path):
    def turn(topic, message, time):
        if topic == "/map" and _step_of(time) < 3.0:
            _, _, z, w = quaternion_of(0.5)
            message.info.origin.orientation.z, message.info.origin.orientation.w = z, w

    with pytest.raises(LogError, match=r"/map: the maps are turned against each other, by 0.5 and 0 radians"):
        _drive(_rewrite(bags, tmp_path / "x.bag", turn), _places(bags))

    def rename(topic, message, time):
        if topic == "/map" and _step_of(time) < 3.0:
            message.header.frame_id = "submap"

    with pytest.raises(LogError, match=r"several frames, 'submap' and 'map'"):
        _drive(_rewrite(bags, tmp_path / "y.bag", rename), _places(bags))


def test_corrections_of_the_map_are_told(bags, tmp_path):
    def invent(topic, message, time):
        if topic == "/map" and _step_of(time) < 2.0:
            message.data = np.where(message.data == 0, 100, message.data).astype(np.int8)

    notes = _drive(_rewrite(bags, tmp_path / "x.bag", invent), _places(bags)).notes
    assert any("of what a map showed is otherwise in the last one" in note for note in notes)


def test_a_map_that_never_changes_is_told(bags, tmp_path):
    def latch(topic, message, time):
        return topic != "/map" or _step_of(time) == _step_of(last)

    last = max(Log(bags / "tour.bag").bag.times["/map"])
    whole = _rewrite(bags, tmp_path / "x.bag", latch)
    notes = _drive(whole, _places(bags)).notes
    assert any("the map is the same all along" in note for note in notes)


def test_topics_are_chosen_by_name_or_asked_for(bags, tmp_path):
    log = Log(bags / "tour.bag", LogConfig(map_topic="/map", image_topic="/panorama/compressed"))
    assert log.problems == []
    with pytest.raises(LogError, match=r"topic /costmap is not in it; topics of type nav_msgs/msg/OccupancyGrid: /map"):
        Log(bags / "tour.bag", LogConfig(map_topic="/costmap"))
    with pytest.raises(LogError, match=r"topic /odom is of type nav_msgs/msg/Odometry"):
        Log(bags / "tour.bag", LogConfig(map_topic="/odom"))
    store = typestore(True)
    with Rosbag1Reader(bags / "tour.bag") as reader, Rosbag1Writer(tmp_path / "x.bag") as writer:
        (source,) = [each for each in reader.connections if each.topic == "/map"]
        for name in ("/local", "/global"):
            copy = writer.add_connection(name, source.msgtype, typestore=store)
            for _, time, data in reader.messages([source]):
                writer.write(copy, time, data)
    with pytest.raises(LogError, match=r"several topics are of type .*: /global, /local; name one with --map-topic"):
        Log(tmp_path / "x.bag")


# Damaged files.


def _storage(bags, kind):
    return bags / "tour.bag" if kind is BagFormat.ROS1 else next((bags / _name(kind)).glob("tour*"))


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("share", [0.9, 0.5])
def test_of_a_bag_that_is_cut_short_the_beginning_is_kept(bags, tmp_path, kind, share):
    whole = _count(bags / _name(kind))
    copy = tmp_path / _name(kind)
    (shutil.copy if kind is BagFormat.ROS1 else shutil.copytree)(bags / _name(kind), copy)
    file = _storage(tmp_path, kind)
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    log = Log(copy)
    kept = _count(copy)
    assert 0.3 * whole < kept < whole
    (problem,) = [problem for problem in log.problems if "damaged or cut short" in problem]
    assert f"{kept} messages could be read" in problem
    if kind is BagFormat.ROS1:
        assert "how many are lost is not known" in problem
    else:
        assert f"{whole - kept} of {whole} are lost" in problem
    drive = read_drive(log, _places(bags))
    # The last map may be smaller than the building, and lie elsewhere on the grid.
    driven = _tour()[: len(drive.path)]
    frame = writing.frame_of(WORLD)
    found = np.array([drive.frame.cell_to_metres(*cell) for cell in drive.path])
    np.testing.assert_allclose(found, [frame.cell_to_metres(*cell) for cell in driven], atol=1e-6)
    assert len(drive.path) > 5
    seen = _first_seen(WORLD, driven)
    assert np.count_nonzero(drive.first_seen != NEVER_SEEN) == np.count_nonzero(seen != NEVER_SEEN)


def _count(path):
    return sum(len(times) for times in open_bag(path).times.values())


@pytest.mark.parametrize("kind", FORMATS)
def test_a_recording_that_was_killed_is_read(bags, tmp_path, kind):
    copy = tmp_path / _name(kind)
    if kind is BagFormat.ROS1:  # no index was written
        data = bytearray((bags / "tour.bag").read_bytes())
        place = data.index(b"index_pos=") + len(b"index_pos=")
        data[place : place + 8] = bytes(8)
        copy.write_bytes(data)
    else:
        shutil.copytree(bags / _name(kind), copy)
        (copy / "metadata.yaml").unlink()
    assert _count(copy) == _count(bags / _name(kind))
    assert _drive(copy, _places(bags)).path == tuple(_tour())
    if kind is not BagFormat.ROS1:
        assert _drive(_storage(tmp_path, kind), _places(bags)).path == tuple(_tour())


def test_blocks_after_a_damaged_one_are_kept(bags, tmp_path):
    bag = _rewrite(bags, tmp_path / "x.bag", lambda *_: None, compress=True)
    data = bytearray(bag.read_bytes())
    chunks = [place for place in range(len(data)) if data.startswith(b"compression=none", place)]
    assert len(chunks) > 8
    # A length that leads out of the block, in the middle of the file.
    place = data.index(b"op=\x02", chunks[4])
    data[place - 4 : place] = struct.pack("<L", 2**31)
    bag.write_bytes(data)
    kept, whole = _count(bag), _count(bags / "tour.bag")
    assert whole - 20 < kept < whole
    assert f"{whole - kept} of {whole} are lost" in Log(bag).problems[0]


def test_rows_around_a_damaged_page_are_kept(bags, tmp_path):
    copy = tmp_path / _name(BagFormat.ROS2)
    shutil.copytree(bags / copy.name, copy)
    file = _storage(tmp_path, BagFormat.ROS2)
    with sqlite3.connect(file) as connection:
        (size,) = connection.execute("PRAGMA page_size").fetchone()
    data = bytearray(file.read_bytes())
    # A leaf of the table of messages in the middle of the file: type 13, several cells.
    leaves = [at for at in range(0, len(data), size) if data[at] == 13 and data[at + 3 : at + 5] > b"\0\2"]
    data[leaves[len(leaves) // 2]] = 0xFF
    file.write_bytes(data)
    kept, whole = _count(copy), _count(bags / copy.name)
    assert whole / 2 < kept < whole
    assert f"{whole - kept} of {whole} are lost" in Log(copy).problems[0]


def test_what_is_no_bag_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty.bag").write_bytes(b"")
    (tmp_path / "other.mcap").write_bytes(b"hello, this is no MCAP file at all, but something else")
    (tmp_path / "folder").mkdir()
    for name, message in {
        "missing.bag": "there is no such file",
        "notes.txt": ".txt is no format of logs",
        "empty.bag": "is no ROS 1 bag",
        "other.mcap": "is no MCAP file",
        "folder": "is no ROS 2 bag",
    }.items():
        with pytest.raises(LogError, match=message):
            open_bag(tmp_path / name)
    with Rosbag1Writer(tmp_path / "silent.bag") as writer:
        writer.add_connection("/map", "nav_msgs/msg/OccupancyGrid", typestore=typestore(True))
    with pytest.raises(LogError, match="holds no message"):
        open_bag(tmp_path / "silent.bag")


# What the labels say, where the robot looks, and the grid.


def test_regions_that_the_log_never_saw_are_nowhere_and_told(bags, tmp_path):
    labels = tmp_path / "labels.yaml"
    labels.write_text((bags / "labels.yaml").read_text() + "  far:\n  - {point: [500, 500], radius: 1}\n")
    drive = _drive(bags / "tour.bag", load_places(labels))
    assert any("far: 1 of 1 regions lie in what the log never saw" in note for note in drive.notes)
    assert drive.propositions == ("goal", "hazard", "far")
    assert set(np.unique(drive.world.letters).tolist()) == {0, 1, 2}
    frame = writing.frame_of(WORLD)
    x, y = frame.cell_to_metres(0, 3)
    labels.write_text(f"propositions:\n  wall:\n  - {{point: [{x}, {y}], radius: 0}}\n")
    with pytest.raises(MapError, match=r"wall: point .* covers no cell"):
        _drive(bags / "tour.bag", load_places(labels))


def test_transforms_chain_both_ways_and_are_interpolated_along_the_shorter_turn():
    transforms = Transforms()
    transforms.add("map", "odom", 0, (1.0, 2.0, 0.0, *quaternion_of(math.pi / 2)))
    for time, yaw in ((0, math.radians(170)), (10, math.radians(-170))):
        transforms.add("/odom", "base_link", time, (float(time), 0.0, 0.0, *quaternion_of(yaw)))
    transforms.add("base_link", "camera_optical_frame", None, (0.0, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5))
    moments = np.array([0, 5, 10, 99])
    poses = transforms.poses("map", "base_link", moments)
    np.testing.assert_allclose(poses[:, :2, 3], [[1, 2], [1, 7], [1, 12], [1, 12]], atol=1e-9)
    turns = np.unwrap(headings(poses, optical=False))
    np.testing.assert_allclose(turns - turns[0], np.radians([0, 10, 20, 20]), atol=1e-6)
    np.testing.assert_allclose(
        transforms.poses("base_link", "map", moments) @ poses, np.tile(np.eye(4), (4, 1, 1)), atol=1e-9
    )
    # The axes of an optical frame: z ahead. This one looks where the body does.
    camera = transforms.poses("map", "camera_optical_frame", moments)
    np.testing.assert_allclose(np.cos(headings(camera, optical=True) - headings(poses, optical=False)), 1, atol=1e-9)
    assert transforms.chain("map", "elsewhere") is None
    np.testing.assert_array_equal(transforms.times("map", "base_link"), [0, 10])


@pytest.mark.parametrize("source", ["transforms", "option"])
def test_a_camera_that_looks_aside_is_turned_back(bags, tmp_path, source):
    aside = math.pi / 2

    def turn(topic, message, time):
        if topic == "/tf_static":
            rotation = message.transforms[0].transform.rotation
            _, _, rotation.z, rotation.w = quaternion_of(aside)
        if topic == "/panorama/compressed":
            picture = decode(bytes(message.data))
            # The middle looks to the left of the robot: what was on the left is now in the middle.
            message.data = np.frombuffer(encode(np.roll(picture, picture.shape[1] // 4, axis=1), "png"), np.uint8)
            message.header.frame_id = "panorama" if source == "transforms" else ""

    bag = _rewrite(bags, tmp_path / "x.bag", turn)
    config = LogConfig(camera_yaw=None if source == "transforms" else math.degrees(aside))
    eyes = Eyes(_drive(bag, _places(bags), config), CAMERA)
    assert np.abs(eyes.panorama(4).astype(int) - _panorama(4)).mean() < 4


def test_a_picture_that_is_not_a_sphere_needs_its_field(bags, tmp_path):
    def square(topic, message, time):
        if topic == "/panorama/compressed":
            message.data = np.frombuffer(encode(np.zeros((40, 60, 3), np.uint8), "png"), np.uint8)

    bag = _rewrite(bags, tmp_path / "x.bag", square)
    with pytest.raises(LogError, match=r"60 x 40 pixels is not equirectangular.*--vertical-field DEGREES"):
        Eyes(_drive(bag, _places(bags)), CAMERA).panorama(0)
    assert "--vertical-field" in inspect(Log(bag))["uses"]["to-dataset"]
    shown = Eyes(_drive(bag, _places(bags), LogConfig(vertical_field=120.0)), CAMERA).panorama(0)
    assert shown.shape == (16, 64, 3)


@pytest.mark.parametrize(("resolution", "radius"), [(0.2, 0.1), (0.15, 0.0), (0.05, 0.05)])
def test_fine_maps_become_working_cells_as_defined(bags, tmp_path, resolution, radius):
    rng = np.random.default_rng(4)
    scale, pixel = 21, 0.05

    def fine(topic, message, time):
        if topic == "/map":
            info = message.info
            cells = message.data.reshape(info.height, info.width)
            grown = np.kron(cells, np.ones((scale, scale), np.int8))
            grown[rng.random(grown.shape) < 0.002] = 100
            grown[rng.random(grown.shape) < 0.002] = -1
            message.data = grown.ravel()
            info.resolution, info.height, info.width = pixel, *grown.shape
            info.origin.position.x, info.origin.position.y = (
                info.origin.position.x * scale * pixel,
                info.origin.position.y * scale * pixel,
            )
        for transform in message.transforms if topic == "/tf" else ():
            for axis in "xy":
                place = transform.transform.translation
                setattr(place, axis, getattr(place, axis) * scale * pixel)

    drive = _drive(_rewrite(bags, tmp_path / "x.bag", fine), Places(()), grid=GridConfig(resolution, radius))
    log = drive.log
    final = log.last_map
    free, obstacle, unknown = (np.asarray(final.occupancy) == value for value in (0, 100, -1))
    ratio, reach = resolution / pixel, radius / pixel
    ring = drive.frame.height - math.ceil(final.frame.height / ratio - 1e-9) == 2
    rows, columns = free.shape

    def near(mask, row, column):
        """Whether a pixel of the mask, grown, covers this pixel; rows are from below."""
        span = range(-int(reach + 1e-9), int(reach + 1e-9) + 1)
        return any(mask(row + i, column + j) for i in span for j in span if math.hypot(i, j) <= reach + 1e-9)

    def at(mask, beyond):
        return lambda row, column: (
            bool(mask[rows - 1 - row, column]) if 0 <= row < rows and 0 <= column < columns else beyond
        )

    for _ in range(300):
        up, across = rng.integers(math.ceil(rows / ratio - 1e-9)), rng.integers(math.ceil(columns / ratio - 1e-9))
        pixels = [
            (row, column)
            for row in range(math.floor(up * ratio + 1e-9), math.ceil((up + 1) * ratio - 1e-9))
            for column in range(math.floor(across * ratio + 1e-9), math.ceil((across + 1) * ratio - 1e-9))
        ]
        expected_free = not any(near(at(~free, True), *each) for each in pixels)
        expected_obstacle = not expected_free and any(near(at(obstacle, False), *each) for each in pixels)
        cell = drive.frame.height - 1 - ring - up, across + ring
        assert bool(drive.world.occupied[cell]) == (not expected_free)
        assert bool(drive.seen[cell]) == (expected_free or expected_obstacle)
    assert unknown.any()
    # What was known is in the final map, and grew.
    known = [np.count_nonzero((drive.first_seen != NEVER_SEEN) & (drive.first_seen <= step)) for step in (0, 10_000)]
    assert 0 < known[0] < known[1] <= np.count_nonzero(drive.seen)


def test_cells_finer_than_the_map_and_robots_too_large_are_refused(bags):
    with pytest.raises(LogError, match=r"cells of 0.5 m are finer than the map's, 1 m"):
        _drive(bags / "tour.bag", _places(bags), grid=GridConfig(resolution=0.5))
    with pytest.raises(LogError, match=r"nothing is left free"):
        _drive(bags / "tour.bag", _places(bags), grid=GridConfig(radius=9.0))
    with pytest.raises(LogError, match="above 0"):
        GridConfig(resolution=0.0)


def test_subgoals_are_settled_where_the_final_map_is_closed_behind_them():
    # Two rooms behind two doors of a hall: the left one was mapped to its end, the right one was not.
    rows = [row.ljust(15, "#") for row in ("", "#..#.####", "#..#...u#", "##.##.###", "#.......#", "", "", "", "")]
    occupied = np.array([[sign in "#u" for sign in row] for row in rows])
    world = make_world(occupied, np.zeros(occupied.shape, np.int32), (4, 4))
    hidden = np.zeros(occupied.shape, bool)
    hidden[:3] = True
    belief = BeliefMap.revealed(world)
    belief = dataclasses.replace(
        belief, cells=jnp.where(jnp.asarray(hidden), jnp.int8(BeliefMap.UNKNOWN), belief.cells)
    )
    scene = survey(world, belief, jnp.asarray([4, 4], jnp.int32))
    cells = np.asarray(scene.subgoals.cells)[np.asarray(scene.subgoals.mask)].tolist()
    assert sorted(cells) == [[3, 2], [3, 5]]
    unexplored = np.zeros(occupied.shape, bool)
    unexplored[2, 6] = True  # beside the cell u
    answers = settled(world, belief, scene.subgoals, unexplored)
    assert {tuple(cell): bool(answer) for cell, answer in zip(cells, answers, strict=False)} == {
        (3, 2): True,
        (3, 5): False,
    }
    assert not answers[len(cells) :].any()


def test_what_a_drive_did_not_explore_is_left_out(bags, tmp_path):
    """A drive that ends at the door: all that lies behind is unsettled."""
    bag = _rewrite(bags, tmp_path / "x.bag", lambda topic, _, time: topic == "/tf_static" or _step_of(time) < 6.0)
    places = _places(bags)
    drive = _drive(bag, places)
    assert drive.unexplored().any()
    assert not _drive(bags / "tour.bag", places).unexplored().any()


# The command line.


def _potlp(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments)])


def test_inspect_shows_topics_and_uses(bags, tmp_path):
    shown = _potlp("log", "inspect", bags / "tour.bag")
    assert shown.exit_code == 0, shown.output
    for part in (
        "ROS 1 bag",
        "/panorama/compressed",
        "nav_msgs/OccupancyGrid",
        "9 x 15 cells of 1 m",
        "to-dataset: yes",
    ):
        assert part in shown.stdout
    data = json.loads(_potlp("log", "inspect", bags / _name(BagFormat.MCAP), "--json").stdout)
    assert data["format"] == "ROS 2 bag (MCAP)"
    assert {topic["name"]: topic["count"] for topic in data["topics"]} == {
        **dict.fromkeys(("/map", "/odom", "/panorama/compressed", "/tf"), len(_tour())),
        "/tf_static": 1,
    }
    broken = tmp_path / "cut.bag"
    broken.write_bytes((bags / "tour.bag").read_bytes()[:200_000])
    result = _potlp("log", "inspect", broken)
    assert result.exit_code == 1
    assert "problem: damaged or cut short" in result.stdout
    missing = _potlp("log", "inspect", tmp_path / "none.bag")
    assert missing.exit_code == 2
    assert "there is no such file" in missing.stderr


def test_a_trial_is_written_replayed_and_viewed(trial, tmp_path):
    trial.save(tmp_path / "trial.json")
    written = _potlp("log", "write", tmp_path, "--out", tmp_path / "drive", "--format", "mcap", "--height", 64)
    assert written.exit_code == 0, written.output
    again = _potlp("log", "write", tmp_path, "--out", tmp_path / "drive", "--format", "mcap")
    assert again.exit_code == 2
    assert "exists already" in again.stderr
    labels, out = tmp_path / "drive.labels.yaml", tmp_path / "replay"
    result = _potlp("log", "replay", tmp_path / "drive", "--labels", labels, "--task", "!hazard U goal", "--out", out)
    assert result.exit_code == 0, result.output
    assert "no estimator is shipped for goal, hazard: the policy is baseline" in result.stderr
    found = load_trial(out / "trial.json")
    assert found.environment == "log:drive"
    assert [decision.target for decision in found.decisions] == [decision.target for decision in trial.decisions]
    assert "mountReplay" in (out / "replay.html").read_text()
    assert (out / "trial.png").stat().st_size > 0
    with pytest.raises(RecordError, match="its panoramas are in the log"):
        panorama_at(found, found.decisions[0])
    refused = _potlp("log", "replay", tmp_path / "drive", "-l", labels, "-t", "F goal", "-p", "known-map", "-o", out)
    assert refused.exit_code == 2
    assert "choose baseline" in refused.stderr


def test_bags_become_one_dataset(bags, tmp_path):
    command = ["log", "to-dataset", bags / "tour.bag", bags / _name(BagFormat.ROS2), "-l", bags / "labels.yaml"]
    result = _potlp(*command, "--out", tmp_path, "--views", 2, "--environment", "office", "--json")
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert list(data["views"].values()) == [2, 2]
    samples = read_dataset(tmp_path)
    assert len(samples.success) == data["samples"]
    assert (samples.metadata.environment, samples.metadata.unit) == ("office", "metres")
    assert len(decode(samples.images[0])) == CameraConfig().height
    again = _potlp(*command, "--out", tmp_path)
    assert again.exit_code == 2
    assert "choose an empty folder" in again.stderr
