"""Robots' logs: a bag that the simulator wrote gives what the simulator gives."""

import dataclasses
import json
import math
import shlex
import zlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from flax import struct
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.ros.places import Places, load_places
from potlp_jax.errors import LogError, MapError, PropositionsError, RecordError
from potlp_jax.learning.dataset import decode, encode, finished_shards, samples_file, views_file
from potlp_jax.learning.dataset_reading import read_dataset
from potlp_jax.learning.questions import TaskDistribution
from potlp_jax.learning.recording import Recorder, RecordingConfig, record_views
from potlp_jax.learning.sample_weights import WeightBounds
from potlp_jax.learning.scenes import Pose, is_answered, survey
from potlp_jax.logs import writing
from potlp_jax.logs.collecting import LogCollectConfig, collect_drives
from potlp_jax.logs.drive import PanoramaReader
from potlp_jax.logs.inspection import inspect
from potlp_jax.logs.log import Log, LogConfig
from potlp_jax.logs.replaying import LoggedRobot, from_first_picture, replay
from potlp_jax.logs.transforms import Transforms, headings, quaternion_of
from potlp_jax.logs.working_grid import GridConfig
from potlp_jax.logs.writing import BagFormat
from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.policies import Policy
from potlp_jax.task.task import Task
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import NEVER_SEEN, Outcome, belief_seen_by, load_trial
from potlp_jax.trials.replay import Views, panorama_at
from potlp_jax.trials.robot import Robot
from potlp_jax.trials.rules import Stop
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import BeliefMap, make_world
from tests.reference.tour import (
    CAMERA,
    FORMATS,
    NEAR,
    TOY,
    WORLD,
    drive_of,
    first_seen_along,
    name_of,
    panorama_of,
    places_of,
    rewrite,
    step_of,
    tour,
    write_tour,
)

TASK = Task.shipped("toy-2")


@struct.dataclass
class Looks:
    """An estimator of one's own that remembers panoramas: P_S is a hundredth of how many it was shown."""

    memory: jax.Array

    def encode(self, panorama):
        return jnp.float32(panorama.shape[0] > 0)

    def remember(self, seen, belief, cell):
        return dataclasses.replace(self, memory=self.memory + seen)

    def __call__(self, belief, subgoals, task):
        shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
        chance = jnp.where(task.class_mask[None, :], self.memory / 100, 0.0)
        cost = jnp.full(shape, 10.0)
        return Estimates(success_probability=jnp.broadcast_to(chance, shape), success_cost=cost, failure_cost=cost)


@pytest.fixture(scope="module")
def trial():
    """A trial of the simulator."""
    return run_trial(WORLD, TASK, Policy.BASELINE, jax.random.key(0), NEAR)


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    return write_tour(tmp_path_factory.mktemp("bags"))


# What the simulator wrote is what is read.


@pytest.mark.parametrize("kind", FORMATS)
def test_a_bag_gives_back_the_drive(bags, kind):
    drive = drive_of(bags / name_of(kind), places_of(bags))
    assert drive.notes == ()
    assert drive.path == tuple(tour())
    assert drive.world.shape == WORLD.shape
    np.testing.assert_array_equal(drive.first_seen, first_seen_along(WORLD, tour()))
    known = drive.first_seen != NEVER_SEEN
    np.testing.assert_array_equal(np.asarray(drive.world.letters)[known], np.asarray(WORLD.letters)[known])
    np.testing.assert_array_equal(np.asarray(drive.world.occupied)[known], np.asarray(WORLD.occupied)[known])
    assert sorted(drive.pictures) == list(range(len(tour())))


@pytest.mark.parametrize("kind", FORMATS)
def test_decisions_along_a_bag_are_those_of_the_simulator(trial, tmp_path, kind):
    bag = tmp_path / name_of(kind)
    writing.write_trial(trial, bag, kind, tmp_path / "labels.yaml", height=64)
    drive = drive_of(bag, places_of(tmp_path))
    found, views = replay(drive, TASK, Policy.BASELINE, jax.random.key(0), NEAR)
    assert trial.outcome is found.outcome is Outcome.SATISFIED
    assert (found.path, found.word, found.states) == (trial.path, trial.word, trial.states)
    assert found.cost == pytest.approx(trial.cost)
    assert found.decisions == trial.decisions
    assert len(found.decisions) > 4
    np.testing.assert_array_equal(found.first_seen, trial.first_seen)
    assert views == Views()


def test_no_budget_ends_a_log(bags):
    drive = drive_of(bags / name_of(FORMATS[0]), places_of(bags))
    short = dataclasses.replace(NEAR, budget_factor=0.01)
    found, expected = (replay(drive, TASK, Policy.BASELINE, jax.random.key(0), each)[0] for each in (short, NEAR))
    assert (found.path, found.decisions) == (expected.path, expected.decisions)
    assert found.config["budget_factor"] == 0.01
    assert found.outcome is expected.outcome is not Outcome.BUDGET


@pytest.mark.parametrize("kind", FORMATS)
def test_a_dataset_from_a_bag_has_the_rows_of_the_simulator(bags, tmp_path, kind):
    settings = {"spacing": (2.0, 6.0), "tasks_per_world": 2, "image_format": "png"}
    drive = drive_of(bags / name_of(kind), places_of(bags))
    config = LogCollectConfig(camera=CAMERA, **settings)
    (count,) = collect_drives([drive], places_of(bags), tmp_path, "toy", "training", config)
    views, samples = pd.read_parquet(views_file(tmp_path, 0)), pd.read_parquet(samples_file(tmp_path, 0))

    seen_as = RecordingConfig(views_per_world=200, camera=CAMERA, **settings)
    recorder = Recorder(0, seen_as, WeightBounds.of_map(*WORLD.shape, 1.0))
    recorder.add_world(WORLD, 0)
    rng = np.random.default_rng([0, zlib.crc32(b"training"), 0])
    pool = [TaskDistribution(TOY.propositions).draw(rng) for _ in range(2)]
    record_views(recorder, WORLD, _simulated_poses(), pool, rng, lambda _, step: panorama_of(step), most=200)
    expected = pd.DataFrame(recorder.samples)
    assert count.views == len(views) == len(recorder.views["view"]) > 2
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
    seen, travelled = first_seen_along(WORLD, tour()), 0.0
    for step, cell in enumerate(tour()):
        travelled += math.dist(cell, tour()[max(step - 1, 0)])
        yield Pose(belief=belief_seen_by(WORLD, seen, step), cell=cell, step=step, travelled=travelled)


def _plain(value):
    return value.tolist() if isinstance(value, np.ndarray) else value


def test_panoramas_are_turned_back_into_the_frame_of_the_map(bags):
    drive = drive_of(bags / name_of(BagFormat.ROS1), places_of(bags))
    reader = PanoramaReader(drive, CAMERA)
    for step in (0, 5, 12, 3):  # 3: backward, too
        difference = np.abs(reader.panorama(step).astype(int) - panorama_of(step))
        assert difference.mean() < 4
        assert np.abs(np.roll(reader.panorama(step), 16, axis=1).astype(int) - panorama_of(step)).mean() > 6


# What the labels say, where the robot looks, and the grid.


def test_regions_that_the_log_never_saw_are_nowhere_and_told(bags, tmp_path):
    labels = tmp_path / "labels.yaml"
    labels.write_text((bags / "labels.yaml").read_text() + "  far:\n  - {point: [500, 500], radius: 1}\n")
    drive = drive_of(bags / "tour.bag", load_places(labels))
    assert any("far: 1 of 1 regions lie in what the log never saw" in note for note in drive.notes)
    assert drive.propositions == ("goal", "hazard", "far")
    assert set(np.unique(drive.world.letters).tolist()) == {0, 1, 2}
    frame = writing.frame_of(WORLD)
    x, y = frame.cell_to_metres(0, 3)
    labels.write_text(f"propositions:\n  wall:\n  - {{point: [{x}, {y}], radius: 0}}\n")
    with pytest.raises(MapError, match=r"wall: point .* covers no cell"):
        drive_of(bags / "tour.bag", load_places(labels))


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

    bag = rewrite(bags, tmp_path / "x.bag", turn)
    config = LogConfig(camera_yaw=None if source == "transforms" else math.degrees(aside))
    reader = PanoramaReader(drive_of(bag, places_of(bags), config), CAMERA)
    assert np.abs(reader.panorama(4).astype(int) - panorama_of(4)).mean() < 4


def test_a_picture_that_is_not_a_sphere_needs_its_field(bags, tmp_path):
    def square(topic, message, time):
        if topic == "/panorama/compressed":
            message.data = np.frombuffer(encode(np.zeros((40, 60, 3), np.uint8), "png"), np.uint8)

    bag = rewrite(bags, tmp_path / "x.bag", square)
    with pytest.raises(LogError, match=r"60 x 40 pixels is not equirectangular.*--vertical-field DEGREES"):
        PanoramaReader(drive_of(bag, places_of(bags)), CAMERA).panorama(0)
    assert "--vertical-field" in inspect(Log(bag))["uses"]["to-dataset"]
    shown = PanoramaReader(drive_of(bag, places_of(bags), LogConfig(vertical_field=120.0)), CAMERA).panorama(0)
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

    drive = drive_of(rewrite(bags, tmp_path / "x.bag", fine), Places(()), grid=GridConfig(resolution, radius))
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
        drive_of(bags / "tour.bag", places_of(bags), grid=GridConfig(resolution=0.5))
    with pytest.raises(LogError, match=r"nothing is left free"):
        drive_of(bags / "tour.bag", places_of(bags), grid=GridConfig(radius=9.0))
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
    answers = is_answered(world, belief, scene.subgoals, unexplored)
    assert {tuple(cell): bool(answer) for cell, answer in zip(cells, answers, strict=False)} == {
        (3, 2): True,
        (3, 5): False,
    }
    assert not answers[len(cells) :].any()


def test_what_a_drive_did_not_explore_is_left_out(bags, tmp_path):
    """A drive that ends at the door: all that lies behind has no answer."""
    bag = rewrite(bags, tmp_path / "x.bag", lambda topic, _, time: topic == "/tf_static" or step_of(time) < 6.0)
    places = places_of(bags)
    drive = drive_of(bag, places)
    assert drive.unexplored().any()
    assert not drive_of(bags / "tour.bag", places).unexplored().any()


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
    data = json.loads(_potlp("log", "inspect", bags / name_of(BagFormat.MCAP), "--json").stdout)
    assert data["format"] == "ROS 2 bag (MCAP)"
    assert {topic["name"]: topic["count"] for topic in data["topics"]} == {
        **dict.fromkeys(("/map", "/odom", "/panorama/compressed", "/tf"), len(tour())),
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
    labels, out = tmp_path / "drive.labels.yaml", tmp_path / "replay"
    text = labels.read_text()
    labels.write_text(f"# mine\n{text}")
    # Nor over the labels of another bag, or those that were written by hand.
    mine = tmp_path / "office.labels.yaml"
    mine.write_text("mine")
    refused = _potlp("log", "write", tmp_path, "--out", tmp_path / "office.bag")
    assert (refused.exit_code, mine.read_text()) == (2, "mine")
    assert not (tmp_path / "office.bag").exists()
    twice = _potlp("log", "to-dataset", tmp_path / "drive", tmp_path / "drive", "-l", labels, "-o", tmp_path / "data")
    assert (twice.exit_code, "given twice" in twice.stderr) == (2, True)
    with pytest.raises(LogError, match="the camera's yaw must be a number"):
        LogConfig(camera_yaw=math.nan)
    again = _potlp("log", "write", tmp_path, "--out", tmp_path / "drive", "--format", "mcap")
    assert again.exit_code == 2
    assert "exists already" in again.stderr
    assert labels.read_text() == f"# mine\n{text}"
    result = _potlp("log", "replay", tmp_path / "drive", "--labels", labels, "--task", "!hazard U goal", "--out", out)
    assert result.exit_code == 0, result.output
    assert "no estimator is shipped for logs: the policy is baseline" in result.stderr
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


@pytest.mark.long
def test_the_page_shows_what_the_commands_print(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[1] / "docs" / "logs.md").read_text("utf-8")
    (transcript,) = (text for text in page.split("```") if "\n$ potlp run" in text)
    for command, *shown in (part.splitlines() for part in transcript.split("\n$ potlp ")[1:]):
        result = _potlp(*shlex.split(command))
        assert result.exit_code == 0, result.output
        printed = {line.rstrip() for line in result.output.splitlines()}
        for line in filter(None, shown):
            # How wide a table's line is goes by the terminal.
            assert line.startswith(" ───") or line.rstrip() in printed, f"{command}: {line}"


def test_bags_become_one_dataset(bags, tmp_path):
    command = ["log", "to-dataset", bags / "tour.bag", bags / name_of(BagFormat.ROS2), "-l", bags / "labels.yaml"]
    result = _potlp(*command, "--out", tmp_path, "--views", 2, "--environment", "office", "--json")
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert all(0 < count <= 2 for count in data["views"].values())
    assert len(data["views"]) == len(finished_shards(tmp_path)) == 2
    samples = read_dataset(tmp_path)
    assert len(samples.success) == data["samples"]
    assert (samples.metadata.environment, samples.metadata.unit) == ("office", "metres")
    assert len(decode(samples.images[0])) == CameraConfig().height
    assert set(data["overflowed"].values()) == {0}
    again = _potlp(*command, "--out", tmp_path)
    assert again.exit_code == 2
    assert "choose an empty folder" in again.stderr


def test_a_robot_that_looks_stops_where_there_is_a_picture(bags):
    drive = drive_of(bags / "tour.bag", places_of(bags))
    blind = {step: picture for step, picture in drive.pictures.items() if step in (2, 9, 17)}
    drive = from_first_picture(dataclasses.replace(drive, pictures=blind), CAMERA)
    assert drive.path == tuple(tour()[2:])
    assert sorted(drive.pictures) == [0, 7, 15]
    seen = first_seen_along(WORLD, tour())
    np.testing.assert_array_equal(drive.first_seen, np.where(seen == NEVER_SEEN, seen, np.maximum(seen - 2, 0)))
    robot = LoggedRobot(drive, PanoramaReader(drive, CAMERA))
    assert isinstance(robot, Robot)
    path = KnownPath(
        cells=jnp.asarray([tour()[2], tour()[2]], jnp.int32),
        states=jnp.zeros(2, jnp.int32),
        length=jnp.int32(0),
        cost=jnp.float32(0.0),
    )
    stop = Stop(replan_distance=jnp.float32(1.0), budget=jnp.float32(0.0), is_frontier=jnp.bool_(False))
    legs = []
    while not robot.ended:
        assert np.abs(np.asarray(robot.panorama()).astype(int) - panorama_of(tour_step(robot))).mean() < 4
        legs.append(len(robot.advance(path, stop).cells))
        # Only where it stops there is a picture, but for the end of the log.
        pictures = [robot.panorama_before(back) is not None for back in range(legs[-1])]
        assert pictures == [not robot.ended, *[False] * (legs[-1] - 1)]
    assert legs == [7, 8, 3]
    with pytest.raises(LogError, match="there is no picture of cell number 18"):
        robot.panorama()


def tour_step(robot):
    """Number of the tour's cell on which the robot stands; its belief tells which of two visits it is."""
    belief, cell = robot.observe()
    known = np.count_nonzero(~np.asarray(belief.unknown))
    seen = first_seen_along(WORLD, tour())
    visits = [step for step, entered in enumerate(tour()) if entered == cell]
    return next(step for step in visits if np.count_nonzero((seen != NEVER_SEEN) & (seen <= step)) == known)


def test_an_estimator_of_ones_own_is_shown_the_pictures_of_the_log(bags, tmp_path):
    drive = drive_of(bags / "tour.bag", places_of(bags))
    found, _ = replay(drive, TASK, Policy.POTLP, jax.random.key(0), NEAR, Looks(memory=jnp.float32(0)))
    shown = [[one.success_probability for one in each.actions if one.subgoal is not None] for each in found.decisions]
    assert sum(map(bool, shown)) > 2
    # One picture more at every decision.
    assert all(chances == pytest.approx([number / 100] * len(chances)) for number, chances in enumerate(shown, start=1))
    blind = dataclasses.replace(drive, pictures={})
    with pytest.raises(LogError, match="has no panorama"):
        replay(blind, TASK, Policy.POTLP, jax.random.key(0), NEAR, Looks(memory=jnp.float32(0)))


def test_a_task_over_other_names_than_the_labels_is_refused(bags):
    drive = drive_of(bags / name_of(FORMATS[0]), places_of(bags))
    swapped = Task.from_formula(TASK.text, TASK.propositions[::-1])
    with pytest.raises(PropositionsError, match=r"the labels of the log \(goal, hazard\): they differ in order"):
        replay(drive, swapped, Policy.BASELINE, jax.random.key(0), NEAR)
