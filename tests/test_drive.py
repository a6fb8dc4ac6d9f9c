"""A robot behind rosbridge: maps on one lattice, messages in any order, advice, navigation, silence, another task."""

import base64
import contextlib
import dataclasses
import json
import math
import signal
import socket
import threading
import time

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner
from websockets.sync.server import serve

from eval.live.__main__ import run_stream
from eval.live.perturbation import Network, Perturbation
from eval.live.server import RosbridgeServer
from eval.live.simulator import FLOOR, STEP, Behaviour, SimulatedLink, SteppedInbox
from potlp_jax.cli import app
from potlp_jax.cli.drive import _interruption, _write
from potlp_jax.cli.inputs import RECORD
from potlp_jax.cli.output import FAILED
from potlp_jax.cli.view import PAGE
from potlp_jax.drive.config import DriveConfig, Mode, Topics
from potlp_jax.drive.driving import drive_robot
from potlp_jax.drive.inbox import Inbox
from potlp_jax.drive.lattice import Lattice, LatticeConfig, Scan, bucket
from potlp_jax.drive.messages import make_path, make_pose, picture_of, pose_of, regions_of, scan_of, stamp_of
from potlp_jax.drive.movers import Adviser, Navigator, mover_of
from potlp_jax.drive.robot import REASONS, RemoteRobot
from potlp_jax.drive.rosbridge import RosbridgeLink, parse_url
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.places import Disc, Places, Polygon
from potlp_jax.errors import RobotError
from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import load_trial
from potlp_jax.trials.rules import Stop
from potlp_jax.world.grid import BeliefMap

TASK = Task.from_formula("!fire U exit", FLOOR.propositions)
CONFIG = DriveConfig(resolution=FLOOR.resolution, radius=0.05)


# Maps on one lattice.


def rough_lay(scan, anchor, config, window):
    """Each cell by a search through all pixels: the slow twin of ``Lattice.lay`` where pixels are not larger."""
    reach = config.radius / scan.frame.resolution
    height, width = scan.occupancy.shape

    def value(row, column):
        if not (0 <= row < height and 0 <= column < width):
            return -1
        return int(scan.occupancy[row, column])

    def around(row, column):
        span = range(-math.floor(reach), math.floor(reach) + 1)
        return [value(row + r, column + c) for r in span for c in span if math.hypot(r, c) <= reach]

    found = np.full((window.height, window.width), BeliefMap.UNKNOWN)
    pixels = {}
    for row in range(height):
        for column in range(width):
            cell = anchor.metres_to_cell(*scan.frame.cell_to_metres(row, column))
            pixels.setdefault((cell[0] - window.top, cell[1] - window.left), []).append((row, column))
    for cell, inside in pixels.items():
        near = [entry for pixel in inside for entry in around(*pixel)]
        if all(0 <= entry <= config.free for entry in near):
            found[cell] = BeliefMap.FREE
        elif any(entry >= config.occupied for entry in near):
            found[cell] = BeliefMap.OCCUPIED
    return found


@pytest.mark.parametrize("seed", range(12))
def test_a_map_is_laid_as_a_search_through_its_pixels_says(seed):
    random = np.random.default_rng(seed)
    config = LatticeConfig(0.2, float(random.choice([0.0, 0.05, 0.11])), 25, 65)
    first = GridFrame(9, 9, 0.05, 1.0, -2.0, float(random.uniform(-3, 3)))
    lattice = Lattice(first, config)
    yaw = first.yaw + float(random.choice([0.0, 0.02, -0.3]))
    # Of half a cell at most, so that every cell within has a pixel's centre.
    frame = GridFrame(24, 20, float(random.choice([0.05, 0.1])), *random.uniform(-3, 3, 2).tolist(), yaw)
    values = random.choice(np.array([-1, 0, 0, 0, 0, 0, 0, 0, 0, 10, 50, 100], np.int8), (24, 20))
    scan = Scan(frame, values)
    found = lattice.lay(scan)
    anchor = GridFrame(0, 0, 0.2, first.x, first.y, first.yaw)
    assert np.array_equal(found, rough_lay(scan, anchor, config, lattice.window))


def test_large_pixels_leave_no_holes():
    lattice = Lattice(GridFrame(4, 4, 0.2, 0.0, 0.0), LatticeConfig(0.2, 0.0, 25, 65))
    found = lattice.lay(Scan(GridFrame(3, 3, 1.0, 0.0, 0.0), np.zeros((3, 3), np.int8)))
    assert int((found == BeliefMap.FREE).sum()) == 15 * 15


def test_what_is_known_keeps_its_place_when_the_map_grows_and_the_shape_is_one_of_few():
    config = LatticeConfig(0.2, 0.0, 25, 65)
    lattice = Lattice(GridFrame(10, 10, 0.2, 0.0, 0.0), config)
    shapes, seen = set(), []
    for size in range(10, 60, 2):
        # Grows to all sides; one pixel in the middle of the first map is an obstacle throughout.
        shift = (size - 10) // 2
        occupancy = np.zeros((size, size), np.int8)
        occupancy[size - 1 - (shift + 4), shift + 4] = 100
        origin = -0.2 * shift
        found = lattice.lay(Scan(GridFrame(size, size, 0.2, origin, origin), occupancy))
        shapes.add(found.shape)
        rows, columns = np.nonzero(found == BeliefMap.OCCUPIED)
        seen.append((int(rows[0]) + lattice.origin[0], int(columns[0]) + lattice.origin[1]))
        assert int((found == BeliefMap.FREE).sum()) == size * size - 1
    assert set(seen) == {(-5, 4)}
    assert lattice.cell_of(0.9, 0.9) == (-5, 4)
    assert shapes <= {(32, 32), (48, 48), (64, 64), (96, 96)}
    assert len(shapes) <= 4


def test_buckets_grow_by_half_at_most():
    sizes = sorted({bucket(size) for size in range(1, 1000)})
    assert sizes == [32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024]
    assert all(bucket(size) >= size for size in range(1, 1000))
    with pytest.raises(RobotError, match="cells larger"):
        bucket(5000)


def test_cells_finer_than_pixels_are_refused():
    with pytest.raises(RobotError, match="finer"):
        Lattice(GridFrame(4, 4, 0.5, 0.0, 0.0), LatticeConfig(0.2, 0.0, 25, 65))


# Messages.


def header(seconds, ros1=False):
    whole, parts = int(seconds), round((seconds - int(seconds)) * 1e9)
    stamp = {"secs": whole, "nsecs": parts} if ros1 else {"sec": whole, "nanosec": parts}
    return {"stamp": stamp, "frame_id": "map"}


def grid(seconds, values, x=0.0, y=0.0):
    values = np.asarray(values)
    info = {"height": values.shape[0], "width": values.shape[1], "resolution": 0.4, "origin": make_pose(x, y, 0.0)}
    return {"header": header(seconds), "info": info, "data": values[::-1].ravel().tolist()}


def test_stamps_of_both_ros():
    assert stamp_of({"header": header(3.5)}) == stamp_of({"header": header(3.5, ros1=True)}) == 3_500_000_000


def test_the_first_row_of_a_map_is_the_lowest():
    scan = scan_of(grid(0, [[100, 0], [0, -1]]))
    assert scan.occupancy.tolist() == [[100, 0], [0, -1]]
    packed = {**grid(0, [[0, 0]]), "data": base64.b64encode(np.array([-1, 100], np.int8).tobytes()).decode()}
    assert scan_of(packed).occupancy.tolist() == [[-1, 100]]


@pytest.mark.parametrize(
    "damage",
    [{"data": [0]}, {"data": None}, {"data": [0, 0, 0, 101]}, {"info": {}}, {"data": [0.5] * 4}, {"data": "%"}],
)
def test_a_damaged_map_is_refused(damage):
    with pytest.raises(RobotError):
        scan_of({**grid(0, [[0, 0], [0, 0]]), **damage})


def test_poses_alone_stamped_and_with_covariance():
    pose = make_pose(1.0, 2.0, 0.5)
    for message in (pose, {"pose": pose}, {"pose": {"pose": pose, "covariance": []}}):
        assert pose_of(message) == pytest.approx((1.0, 2.0, 0.5))
    with pytest.raises(RobotError, match="not finite"):
        pose_of(make_pose(math.nan, 0.0, 0.0))


def test_a_path_looks_to_its_next_point():
    poses = make_path([(0.0, 0.0), (0.0, 1.0), (-1.0, 1.0)], "map")["poses"]
    assert [pose_of(pose)[2] for pose in poses] == pytest.approx([math.pi / 2, math.pi, math.pi])


def test_pictures_raw_and_compressed():
    image = np.zeros((4, 8, 3), np.uint8)
    image[:, :4] = (255, 0, 0)
    data = base64.b64encode(cv2.imencode(".png", image[..., ::-1])[1].tobytes()).decode()
    assert np.array_equal(picture_of({"data": data, "format": "png"}), image)
    padded = np.pad(image[..., ::-1].reshape(4, 24), ((0, 0), (0, 3)))
    raw = {"encoding": "bgr8", "height": 4, "width": 8, "step": 27}
    assert np.array_equal(picture_of({**raw, "data": base64.b64encode(padded.tobytes()).decode()}), image)
    with pytest.raises(RobotError, match="encoding"):
        picture_of({**raw, "encoding": "yuv", "data": ""})


def test_a_picture_of_more_than_a_half_circle_is_refused():
    topic = "/panorama/compressed"
    inbox = Inbox(dataclasses.replace(CONFIG, topics=Topics(image=topic)), FLOOR.propositions)

    def show(seconds, height):
        data = base64.b64encode(cv2.imencode(".png", np.zeros((height, 8, 3), np.uint8))[1].tobytes()).decode()
        inbox.handle(topic, {"header": header(seconds), "data": data, "format": "png"})

    show(1, 4)
    show(2, 5)
    assert inbox.heard.picture.shape == (4, 8, 3)
    (refused,) = inbox.refused
    assert refused.startswith(f"{topic}: a picture of 8 x 5 pixels")


@pytest.mark.parametrize("suffix", [".png", ".webp", ".bmp", ".jpg", ".tiff"])
def test_damaged_pictures_are_refused(suffix):
    topic = "/panorama/compressed"
    inbox = Inbox(dataclasses.replace(CONFIG, topics=Topics(image=topic)), FLOOR.propositions)
    pixels = np.random.default_rng(0).integers(0, 256, (32, 64, 3), dtype=np.uint8)
    whole = cv2.imencode(suffix, pixels)[1].tobytes()
    damaged = [whole[: len(whole) // 2], whole[:30], b""]
    # A checksum of PNG that does not fit.
    damaged += [whole[:100] + bytes([whole[100] ^ 1]) + whole[101:]] if suffix == ".png" else []
    for number, contents in enumerate(damaged):
        data = base64.b64encode(contents).decode()
        inbox.handle(topic, {"header": header(number), "data": data, "format": suffix[1:]})
        assert sum(inbox.refused.values()) + (inbox.heard.picture is not None) == number + 1
    # Half of a JPEG shows grey for what is missing, and half of a BMP or TIFF black.
    assert inbox.heard.picture is None or suffix in (".jpg", ".bmp", ".tiff")


@pytest.mark.parametrize(
    "setting", [{"radius": math.inf}, {"radius": math.nan}, {"radius": -0.1}, {"camera_yaw": math.nan}]
)
def test_settings_that_are_no_numbers_are_refused(setting):
    (name,) = setting
    with pytest.raises(RobotError, match=f"{name} is .*; give a"):
        DriveConfig(**setting)


def test_places_are_regions_of_known_propositions():
    text = {"exit": [{"point": [1, 2], "radius": 0.5}, {"polygon": [[0, 0], [1, 0], [1, 1]]}]}
    found = regions_of({"data": json.dumps(text)}, ("fire", "exit"))
    assert found == (("exit", Disc((1.0, 2.0), 0.5)), ("exit", Polygon(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)))))
    with pytest.raises(RobotError, match="'smoke'"):
        regions_of({"data": '{"smoke": []}'}, ("fire",))


@pytest.mark.parametrize("url", ["http://robot", "robot:x", "", "ws://"])
def test_what_is_no_address_is_refused(url):
    with pytest.raises(RobotError, match="no address"):
        parse_url(url)
    assert parse_url("robot") == ("robot", 9090, False)
    assert parse_url("wss://robot:1") == ("robot", 1, True)


# What was heard.


def transform(seconds, parent, child, x):
    moved = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    return {**{"header": {**header(seconds), "frame_id": parent}}, "child_frame_id": child, "transform": moved}


def messages():
    """Maps, updates and transforms of a drive, with stamps that tell their order."""
    random, found = np.random.default_rng(5), []
    for number in range(6):
        values = random.choice([-1, 0, 100], (5, 6))
        found.append(("/map", grid(10 + 2 * number, values)))
        update = {"header": header(11 + 2 * number), "x": 1, "y": 2, "width": 3, "height": 2, "data": [number] * 6}
        found.append(("/map_updates", update))
        found.append(("/tf", {"transforms": [transform(10 + number, "odom", "base_link", number)]}))
        found.append(("/tf", {"transforms": [transform(10 + number, "map", "odom", 10 * number)]}))
    return found


def state_of(inbox):
    heard = inbox.heard
    return heard.scan.occupancy.tolist(), heard.pose


@pytest.mark.parametrize("seed", range(20))
def test_order_and_repetition_do_not_matter(seed):
    # An update that is alone says nothing, so a map comes first; within five seconds any order will do.
    wanted = Inbox(CONFIG, FLOOR.propositions)
    for topic, message in messages():
        wanted.handle(topic, message)
    assert wanted.heard.pose == (55.0, 0.0, 0.0)
    random = np.random.default_rng(seed)
    sent = messages()
    order = np.argsort(np.arange(len(sent)) + random.uniform(0, 8, len(sent)))
    inbox = Inbox(CONFIG, FLOOR.propositions)
    inbox.handle(*sent[0])
    for index in order:
        for _ in range(int(random.integers(1, 3))):
            inbox.handle(*sent[index])
    assert state_of(inbox) == state_of(wanted)
    assert not inbox.refused


def test_a_clock_that_begins_anew_is_followed():
    inbox = Inbox(CONFIG, FLOOR.propositions)
    inbox.handle("/map", grid(1000, [[0, 0]]))
    inbox.handle("/map", grid(998, [[100, 100]]))
    assert inbox.heard.scan.occupancy.tolist() == [[0, 0]]
    inbox.handle("/map", grid(3, [[100, 100]]))
    assert inbox.heard.scan.occupancy.tolist() == [[100, 100]]


def test_an_update_after_the_clock_began_anew_is_no_old_one():
    inbox = Inbox(CONFIG, FLOOR.propositions)
    inbox.handle("/map", grid(1000, [[0, 0]]))
    inbox.handle("/map_updates", {"header": header(998), "x": 0, "y": 0, "width": 1, "height": 1, "data": [100]})
    assert inbox.heard.scan.occupancy.tolist() == [[0, 0]]
    inbox.handle("/map_updates", {"header": header(3), "x": 0, "y": 0, "width": 1, "height": 1, "data": [100]})
    assert inbox.heard.scan.occupancy.tolist() == [[100, 0]]


@pytest.mark.parametrize("topic", ["/tf", "/tf_static"])
def test_a_pose_that_was_heard_before_the_map_is_known_with_it(topic):
    inbox = Inbox(CONFIG, FLOOR.propositions)
    placed = {"transforms": [transform(1, "map", "base_link", 2.0)]}
    inbox.handle(topic, placed)
    assert inbox.heard.pose is None
    inbox.handle("/map", grid(1, [[0]]))
    assert inbox.heard.pose == (2.0, 0.0, 0.0)
    assert inbox.take_poses() == ((2.0, 0.0, 0.0),)
    # Another map is no other pose.
    inbox.handle("/map", grid(2, [[100]]))
    assert inbox.heard.maps == 2
    assert not inbox.heard.poses


def test_a_map_in_another_frame_is_another_map():
    inbox = Inbox(CONFIG, FLOOR.propositions)
    inbox.handle("/tf_static", {"transforms": [transform(1, "map", "base_link", 2.0)]})
    inbox.handle("/map", grid(1, [[0]]))
    inbox.handle("/tf_static", {"transforms": [transform(2, "world", "map", 10.0)]})
    renamed = grid(3, [[0]])
    renamed["header"]["frame_id"] = "world"
    inbox.handle("/map", renamed)
    assert inbox.heard.frame_id == "world"
    assert inbox.heard.pose == (12.0, 0.0, 0.0)
    # Where the robot was in the frame of before is nowhere in this one.
    assert inbox.heard.poses == ((12.0, 0.0, 0.0),)
    assert inbox.heard.maps == 2
    lost = grid(4, [[0]])
    lost["header"]["frame_id"] = "nowhere"
    inbox.handle("/map", lost)
    assert inbox.heard.pose is None
    assert not inbox.heard.poses


def test_poses_of_a_topic_are_in_the_frame_of_the_map_whatever_it_is_called():
    inbox = Inbox(dataclasses.replace(CONFIG, topics=Topics(pose="/pose")), FLOOR.propositions)
    inbox.handle("/map", grid(1, [[0]]))
    inbox.handle("/pose", {"header": header(1), "pose": make_pose(2.0, 0.0, 0.0)})
    renamed = grid(3, [[0]])
    renamed["header"]["frame_id"] = "world"
    inbox.handle("/map", renamed)
    assert inbox.heard.pose == (2.0, 0.0, 0.0)


def test_a_wheel_that_turns_is_no_pose():
    inbox = Inbox(CONFIG, FLOOR.propositions)
    inbox.handle("/map", grid(1, [[0]]))
    inbox.handle("/tf_static", {"transforms": [transform(0, "map", "odom", 0.0)]})
    inbox.handle("/tf", {"transforms": [transform(1, "odom", "base_link", 1.0)]})
    poses = len(inbox.heard.poses)
    inbox.handle("/tf", {"transforms": [transform(2, "base_link", "wheel", 1.0)]})
    assert len(inbox.heard.poses) == poses == 1


def test_a_silent_odometry_is_silent_whatever_slam_repeats():
    now = [100.0]
    inbox = Inbox(CONFIG, FLOOR.propositions, clock=lambda: now[0])
    inbox.handle("/map", grid(1, [[0]]))
    # Where it is on the robot does not change, and may be repeated, too.
    inbox.handle("/tf_static", {"transforms": [transform(0, "base_footprint", "base_link", 0.0)]})
    inbox.handle("/tf", {"transforms": [transform(1, "odom", "base_footprint", 1.0)]})
    for second in range(1, 30):
        now[0] = 100.0 + second
        inbox.handle("/tf", {"transforms": [transform(1 + second, "map", "odom", 0.1 * second)]})
        inbox.handle("/tf_static", {"transforms": [transform(1 + second, "base_footprint", "base_link", 0.0)]})
        # The correction itself is not lost.
        assert inbox.heard.pose[0] == pytest.approx(1.0 + 0.1 * second)
    assert now[0] - inbox.heard.heard == 29
    inbox.handle("/tf", {"transforms": [transform(31, "odom", "base_footprint", 2.0)]})
    assert now[0] == inbox.heard.heard


def test_what_cannot_be_read_is_counted_and_changes_nothing():
    inbox = Inbox(CONFIG, FLOOR.propositions)
    before = inbox.heard
    for topic in inbox.handlers:
        for message in ({}, {"header": None}, {"data": 3}, {"transforms": 1}):
            inbox.handle(topic, message)
    assert inbox.heard is before
    assert sum(inbox.refused.values()) == 4 * len(inbox.handlers)


# Where places are.


def robot_on(rows, seen, **options):
    """A robot on a map of ``#`` walls, ``.`` floor and ``?`` unseen cells, which has seen places."""
    inbox = Inbox(CONFIG, FLOOR.propositions)
    inbox.handle("/map", grid(1, [[{"#": 100, ".": 0, "?": -1}[cell] for cell in row] for row in rows]))
    inbox.handle("/tf", {"transforms": [transform(1, "map", "base_link", 0.6)]})
    inbox.handle("/potlp/places", {"data": json.dumps(seen)})
    return RemoteRobot(inbox, Adviser(), CONFIG, FLOOR.propositions, **options)


def letters_of(rows, exit_at):
    """Where a robot takes the exit to be, in text, and what it said."""
    said = []
    robot = robot_on(rows, {"exit": [{"point": list(exit_at), "radius": 0.1}]}, say=said.append)
    belief, _ = robot.observe()
    belief, _ = robot.observe()
    assert list(robot.noticed) == said
    row, column = np.argwhere(np.asarray(belief.cells) != BeliefMap.UNKNOWN).min(axis=0)
    shown = np.asarray(belief.letters)[row : row + len(rows), column : column + len(rows[0])]
    return ["".join("e" if letter else "." for letter in line) for line in shown], said


def test_a_place_in_a_wall_is_beside_it_and_that_is_said_once():
    rows = ["......", "......", ".#####", "......"]
    # In the wall's third cell, nearer to its upper edge.
    found, said = letters_of(rows, (1.4, 0.65))
    assert found == ["......", "...e..", "......", "......"]
    assert said == [
        "exit: point [1.40, 0.65] with radius 0.1 lies in an obstacle of the map; it is taken to be at [1.40, 1.00]"
    ]


def test_a_place_in_what_is_unseen_is_nowhere_yet():
    found, said = letters_of(["......", "......", ".##?##", "......"], (1.4, 0.65))
    assert not any("e" in line for line in found)
    assert not said


def test_a_place_deep_in_a_wall_is_nowhere_and_that_is_said_once():
    found, said = letters_of(["####", "####", "####", "...."], (1.0, 1.4))
    assert not any("e" in line for line in found)
    assert said == [
        "exit: point [1.00, 1.40] with radius 0.1 lies in obstacles of the map, no free cell touches it: it is nowhere"
    ]


def test_a_region_without_the_centre_of_a_cell_is_told():
    # Between the centres of two cells of 0.4 m; a larger one beside it, and one that is not on the map yet.
    between, beside = [[0.25, 0.25], [0.55, 0.25], [0.55, 0.35]], [[0.25, 0.25], [0.95, 0.25], [0.95, 0.95]]
    far = [[90.1, 90.1], [93.1, 90.1], [93.1, 93.1]]
    told = []
    for polygon in (between, beside, far):
        place = {"exit": [{"polygon": polygon}]}
        robot = robot_on(["......"] * 4, place)
        robot.observe()
        robot.observe()
        told.append(robot.noticed)
    assert told[0] == (
        "exit: polygon [0.25, 0.25], [0.55, 0.25], [0.55, 0.35] holds the centre of no cell of 0.4 m, and is nowhere: "
        "make it larger",
    )
    assert told[1:] == [(), ()]


def test_labels_of_what_the_task_lacks_are_told():
    region = Disc((0.6, 0.6), 0.1)
    places = Places((("fir", (region,)), ("exit", (region,)), ("door", (region,))), source="office.yaml")
    robot = robot_on(["......"] * 4, {}, places=places)
    assert robot.noticed == ("office.yaml: not used are the places of fir, door: the propositions are fire, exit",)
    assert np.asarray(robot.observe()[0].letters).max() == 2


def test_a_place_that_a_turned_map_walls_in_is_reached():
    # The exit is in a corner of the last room, and the map turns by up to 0.03 radians.
    assert run_stream(749, {})["end"] == "satisfied"


@pytest.mark.parametrize("seed", [341, 603])
def test_a_map_that_says_the_same_is_no_reason_to_give_up(seed):
    # All is seen, the map turns on, and the message that says where the exit is was lost or is late.
    assert run_stream(seed, {})["end"] == "satisfied"


# Goals of Nav2.


ORDINARY = Behaviour()


class Lossy(SimulatedLink):
    """Knows which goals were sent and taken back, and loses both while it is not connected."""

    def __init__(self):
        super().__init__(FLOOR, ORDINARY, Network(Perturbation(), np.random.default_rng(0)))
        self.ends = {}

    def send_goal(self, action, kind, goal, done):
        if not self.is_connected:
            done(False, "not asked: the connection is lost")
            return ""
        self.ends[f"goal {len(self.ends)}"] = done
        return f"goal {len(self.ends) - 1}"

    def cancel(self, action, goal):
        if self.is_connected:
            self.cancelled.append(goal)


def navigator():
    link = Lossy()
    mover = Navigator(link, Mode.NAVIGATE)
    mover.begin([(1.0, 0.0)], "map")
    return link, mover


def test_a_goal_that_was_not_sent_leaves_the_one_before_to_be_taken_back():
    link, mover = navigator()
    link.is_connected = False
    mover.begin([(2.0, 0.0)], "map")
    assert not mover.ended().succeeded
    link.is_connected = True
    mover.stop()
    assert link.cancelled == ["goal 0"]


def test_a_goal_that_could_not_be_taken_back_is_taken_back_later():
    link, mover = navigator()
    link.is_connected = False
    mover.stop()
    assert not link.cancelled
    link.is_connected = True
    mover.stop()
    assert link.cancelled == ["goal 0"]


def test_all_goals_whose_end_was_not_heard_are_taken_back_and_no_other():
    link, mover = navigator()
    for _ in range(3):
        mover.begin([(2.0, 0.0)], "map")
    link.ends["goal 1"](False, "preempted")
    assert mover.ended() is None
    mover.stop()
    assert link.cancelled == ["goal 0", "goal 2", "goal 3"]
    for name in link.cancelled:
        link.ends[name](False, "canceled")
    # Of what was taken back, the end concerns nobody.
    assert mover.ended() is None
    mover.stop()
    assert len(link.cancelled) == 3


# Drives, in the simulation's time.


def begun(mode, behaviour=ORDINARY, *, before=lambda _link: None, options=None, **settings):
    """A drive, and the link."""
    config = dataclasses.replace(CONFIG, mode=mode, **settings)
    link = SimulatedLink(FLOOR, behaviour, Network(Perturbation(), np.random.default_rng(0)))
    before(link)
    inbox = SteppedInbox(link, config, TASK.propositions)
    key = jax.random.key(0)
    drive = drive_robot(link, TASK, "baseline", key, config, inbox=inbox, clock=link.clock, **(options or {}))
    return drive, link


def driven(mode, behaviour=ORDINARY, *, before=lambda _link: None, tasks=1, **settings):
    """Trials of a drive, and the link."""
    drive, link = begun(mode, behaviour, before=before, **settings)
    trials = [trial for trial, _ in zip(drive, range(tasks), strict=False)]
    drive.close()
    return trials, link


def published(link, topic):
    return [message for name, _, message in link.published if name == topic]


def test_advice_is_published_and_nothing_is_commanded():
    (trial,), link = driven(Mode.ADVISE)
    assert trial.outcome == "satisfied"
    assert not link.goals
    decisions = [json.loads(message["data"]) for message in published(link, "/potlp/decision")]
    assert [decision["index"] for decision in decisions] == list(range(len(trial.decisions)))
    assert decisions[0]["task"] == TASK.text
    # In metres of the map: the first path begins where the robot is.
    x, y, _ = pose_of(published(link, "/potlp/path")[0]["poses"][0])
    assert (x, y) == pytest.approx(FLOOR.frame.cell_to_metres(*FLOOR.start))
    markers = published(link, "/potlp/markers")[-1]["markers"]
    assert {"path", "exit", "target"} <= {marker["ns"] for marker in markers[1:]}
    exits = next(marker for marker in markers if marker.get("ns") == "exit")["points"]
    assert [(point["x"], point["y"]) for point in exits] == [pytest.approx(FLOOR.frame.cell_to_metres(5, 13))]


def test_a_message_that_is_refused_is_told_once_and_counted():
    def misspell(link):
        for seconds in (0.0, 5.0):
            link._network.send(seconds, "/potlp/places", {"data": json.dumps({"fir": [], "exit": []})})

    (trial,), link = driven(Mode.ADVISE, before=misspell)
    wrong = "/potlp/places: places of 'fir', which is none of fire, exit"
    assert trial.outcome == "satisfied"
    assert trial.notes == (f"refused: {wrong} (2 times)",)
    states = [json.loads(message["data"])["text"] for message in published(link, "/potlp/state")]
    assert states == [f"refused: {wrong}"]


def test_of_many_reasons_for_refusal_some_are_told():
    robot, _, link, said = on_the_floor(Mode.ADVISE)
    for number in range(50):
        link._network.send(link.time, "/potlp/places", {"data": json.dumps({f"fir{number}": []})})
    link.step(1.0)
    robot.observe()
    assert len(said) == len(robot.noticed) == REASONS


@pytest.mark.parametrize("mode", [Mode.NAVIGATE, Mode.FOLLOW])
def test_navigation_is_commanded_and_failures_are_set_aside(mode):
    (trial,), link = driven(mode, Behaviour(failures=3))
    assert trial.outcome == "satisfied"
    assert link.goals
    assert sum(bool(decision.failure) for decision in trial.decisions) == 3
    assert any(decision.set_aside for decision in trial.decisions)


def test_a_silent_robot_is_stopped_and_goes_on_when_it_is_heard_again():
    (trial,), link = driven(Mode.NAVIGATE, Behaviour(silent=(2.0, 7.0)))
    assert trial.outcome == "satisfied"
    assert link.cancelled
    assert any("no pose" in decision.failure for decision in trial.decisions)
    states = [json.loads(message["data"])["state"] for message in published(link, "/potlp/state")]
    assert "stopped" in states


def test_a_robot_that_is_silent_for_good_ends_the_drive():
    (trial,), link = driven(Mode.NAVIGATE, Behaviour(silent=(2.0, math.inf)), silence=0.5, patience=5.0)
    assert trial.outcome == "unfinished"
    assert link.cancelled


def on_the_floor(mode=Mode.NAVIGATE, behaviour=ORDINARY, **options):
    """A robot that has been observed, where it is, its link, and what it said."""
    config, said = dataclasses.replace(CONFIG, mode=mode, patience=5.0), []
    link = SimulatedLink(FLOOR, behaviour, Network(Perturbation(), np.random.default_rng(0)))
    inbox = SteppedInbox(link, config, TASK.propositions)
    for topic, (kind, _) in inbox.handlers.items():
        link.subscribe(topic, kind, lambda message, topic=topic: inbox.handle(topic, message))
    mover = mover_of(config, link)
    robot = RemoteRobot(inbox, mover, config, TASK.propositions, clock=link.clock, say=said.append, **options)
    return robot, robot.observe()[1], link, said


def way(cell, length):
    """A path to the right."""
    cells = jnp.array([[cell[0], cell[1] + number] for number in range(length + 1)], jnp.int32)
    states, cost = jnp.zeros(length + 1, jnp.int32), jnp.float32(length)
    return KnownPath(cells=cells, states=states, length=jnp.int32(length), cost=cost)


# A leg ends at once, or where its path does.
AT_ONCE, AT_THE_END = (
    Stop(replan_distance=jnp.float32(99), budget=jnp.float32(budget), is_frontier=jnp.bool_(False))
    for budget in (1, 99)
)


def test_a_robot_that_knows_no_move_stands_though_the_leg_before_left_its_goal():
    robot, cell, link, _ = on_the_floor()
    leg = robot.advance(way(cell, 5), AT_ONCE)
    # On purpose: a robot does not halt for a decision.
    assert 0 < len(leg.cells) < 5
    assert not link.cancelled
    _, cell = robot.observe()
    # Of the moment in which it is stopped.
    assert len(robot.advance(way(cell, 0), AT_THE_END).cells) <= 1
    assert link.cancelled == ["goal 0"]
    assert not link._way


def test_a_robot_that_is_already_where_it_is_to_go_stands():
    robot, cell, link, _ = on_the_floor()
    robot.advance(way(cell, 5), AT_ONCE)
    _, cell = robot.observe()
    # Into the next cell while it is decided.
    link.step(FLOOR.resolution / ORDINARY.speed)
    assert robot.advance(way(cell, 1), AT_THE_END).cells == ((cell[0], cell[1] + 1),)
    assert link.cancelled == link.goals == ["goal 0"]


def test_a_goal_is_taken_back_again_when_the_robot_is_heard_again():
    class Deaf(SimulatedLink):
        """Loses what it is told for a while, and says nothing meanwhile."""

        def cancel(self, action, goal):
            if self.time >= self._behaviour.silent[1]:
                super().cancel(action, goal)

    config = dataclasses.replace(CONFIG, mode=Mode.NAVIGATE, silence=0.5)
    link = Deaf(FLOOR, Behaviour(silent=(2.0, 4.0), speed=0.1), Network(Perturbation(), np.random.default_rng(0)))
    inbox = SteppedInbox(link, config, TASK.propositions)
    drive = drive_robot(link, TASK, "baseline", jax.random.key(0), config, inbox=inbox, clock=link.clock)
    ways = []

    def told(topic, kind, message, publish=link.publish):
        if topic == "/potlp/state" and "heard again" in message["data"]:
            ways.append((tuple(link.cancelled), list(link._way)))
        publish(topic, kind, message)

    link.publish = told
    next(drive)
    drive.close()
    # Before the next decision.
    assert len(ways) == 1
    assert ways[0][0]
    assert not ways[0][1]


def absurd_map(link):
    """A map that lies 100 km away, newer than what was sent before."""
    link._network.send(link.time, "/map", grid(86_400 + link.time + STEP / 2, [[0, 0]], x=1e5))


def test_a_map_that_cannot_be_laid_is_left_out():
    robot, cell, link, said = on_the_floor()
    before, _ = robot.observe()
    absurd_map(link)
    link.step(0.1)
    now, here = robot.observe()
    assert np.array_equal(now.cells, before.cells)
    assert here == cell
    (told,) = said
    assert told.startswith("a map is left out, and the one before stays: the map needs")
    assert robot.noticed == (told,)
    # The next one is right, and what is wrong later is not what was wrong before.
    link.step(1.0)
    assert robot.advance(way(cell, 3), AT_THE_END).cells
    link.step(20.0)
    robot.observe()


def test_a_map_that_cannot_be_laid_for_long_ends_the_drive():
    robot, _, link, _ = on_the_floor()
    link._tell_map = lambda header: None
    absurd_map(link)
    link.step(0.1)
    robot.observe()
    link.step(4.0)
    robot.observe()
    link.step(2.0)
    with pytest.raises(RobotError, match="no map of use for 6 s: the map needs"):
        robot.observe()


def test_a_first_map_that_cannot_be_laid_is_an_error():
    with pytest.raises(RobotError, match="more than 4096"):
        robot_on(["." * 5000], {})


def test_a_dry_run_decides_once_and_publishes_nothing():
    (trial,), link = driven(Mode.DRY)
    assert len(trial.decisions) == 1
    assert not link.published
    assert not link.goals


def test_another_formula_takes_over_and_one_that_is_none_does_not():
    def ask(link):
        link.ask_for("F ((")

    (trial,), link = driven(Mode.ADVISE, before=ask)
    assert trial.outcome == "satisfied"
    assert "refused" in published(link, "/potlp/state")[0]["data"]
    (first, second), _ = driven(Mode.ADVISE, before=lambda link: link.ask_for("F exit"), tasks=2)
    assert first.outcome == "unfinished"
    assert (second.outcome, second.task_text) == ("satisfied", "F exit")


def test_a_robot_stands_while_somebody_has_the_record_of_a_trial_that_ended_on_the_way():
    drive, link = begun(Mode.NAVIGATE, options={"trial_config": TrialConfig(budget_factor=0.06)})
    trial = next(drive)
    assert trial.outcome == "budget"
    assert link.cancelled
    assert not link._way


def test_a_formula_that_comes_while_somebody_has_the_record_is_the_next_task():
    drive, link = begun(Mode.ADVISE)
    assert next(drive).outcome == "satisfied"
    link.ask_for("!fire U exit")
    link.step(2.0)
    assert [trial.task_text for trial in drive] == ["!fire U exit"]


def interrupted_drive(when, behaviour=ORDINARY, *, before=lambda _link: None, **settings):
    """Trials of a drive that is interrupted when a condition on the link and the decisions holds, and the link."""
    decisions = []
    options = {"interrupted": lambda: when(link, decisions), "listener": lambda *decision: decisions.append(decision)}
    drive, link = begun(Mode.NAVIGATE, behaviour, before=before, options=options, **settings)
    return list(drive), link


def test_who_interrupts_a_drive_has_its_record():
    (trial,), link = interrupted_drive(lambda link, _: bool(link.goals))
    assert trial.outcome == "unfinished"
    assert trial.decisions
    assert link.cancelled == link.goals == ["goal 0"]


def test_after_an_interruption_no_goal_is_sent():
    # Nor is the task begun that is asked for.
    (trial,), link = interrupted_drive(lambda _, decisions: bool(decisions), before=lambda link: link.ask_for("F exit"))
    assert trial.outcome == "unfinished"
    assert len(trial.decisions) == 1
    assert not link.goals


def test_before_the_first_decision_an_interruption_ends_the_drive_without_a_record():
    # Without a map, and where the map has no cell for the robot.
    trials, link = interrupted_drive(lambda link, _: link.time > 1.0, topics=Topics(map="/other"), patience=20.0)
    assert not trials
    assert link.time < 2.0
    trials, link = interrupted_drive(lambda link, _: link.time > 1.0, patience=20.0, radius=1.5)
    assert not trials
    assert link.time < 2.0


def test_who_waits_for_a_silent_robot_may_interrupt():
    (trial,), link = interrupted_drive(
        lambda link, _: link.time > 6.0, behaviour=Behaviour(silent=(2.0, math.inf)), silence=0.5, patience=100.0
    )
    assert trial.outcome == "unfinished"
    assert "no pose" in trial.decisions[-1].failure
    assert link.time < 7.0


def test_ctrl_c_is_asked_for_and_a_second_one_ends_at_once():
    before = signal.getsignal(signal.SIGINT)
    with _interruption() as interrupted:
        assert not interrupted()
        signal.raise_signal(signal.SIGINT)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_drive_writes_over_no_other(tmp_path):
    """Neither over one of the same command nor over one of an earlier: no drive can be had again."""
    (trial,), _ = driven(Mode.DRY)
    written = [_write(trial, tmp_path)[0] for _ in range(3)]
    assert written == [tmp_path / RECORD, tmp_path / "2" / RECORD, tmp_path / "3" / RECORD]
    assert all(file.is_file() for file in written)


def test_without_a_map_the_error_says_what_to_look_at():
    with pytest.raises(RobotError, match="no map within 3 s: is /other published"):
        driven(Mode.ADVISE, patience=3.0, topics=Topics(map="/other"))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(12))
def test_perturbed_streams_end_well(seed):
    row = run_stream(seed, {})
    assert row["end"] not in ("crash", "hung"), row
    assert not row["wrong"]


# Over a socket.


@pytest.fixture
def server():
    found = RosbridgeServer(Behaviour(), speed=5.0)
    yield found
    found.close()


@pytest.mark.parametrize("mode", [Mode.ADVISE, Mode.NAVIGATE])
def test_a_drive_over_a_real_socket(server, mode):
    pytest.importorskip("roslibpy")
    link = RosbridgeLink(f"127.0.0.1:{server.port}")
    config = dataclasses.replace(CONFIG, mode=mode, silence=20.0, patience=60.0)
    try:
        trial = next(drive_robot(link, TASK, "baseline", jax.random.key(0), config, name="simulator"))
    finally:
        link.close()
    assert trial.outcome == "satisfied"
    assert server.advertised["/potlp/path"] == "nav_msgs/Path"
    assert bool(server.link.goals) == (mode is Mode.NAVIGATE)


def test_a_robot_that_answers_too_late_is_left_alone(monkeypatch):
    pytest.importorskip("roslibpy")
    monkeypatch.setattr("potlp_jax.drive.rosbridge.CONNECT_SECONDS", 0.1)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(RobotError, match=rf"nobody answers at 127\.0\.0\.1:{port}"):
        RosbridgeLink(f"127.0.0.1:{port}")
    left = threading.Event()

    def talk(connection):
        for _ in connection:
            pass
        left.set()

    # roslibpy goes on trying: what it finds later must not stay connected behind the caller's back.
    with serve(talk, "127.0.0.1", port) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        assert left.wait(60)
        server.shutdown()


def test_a_goal_is_not_kept_for_later_while_the_connection_is_lost(server):
    pytest.importorskip("roslibpy")
    link, told = RosbridgeLink(f"127.0.0.1:{server.port}"), []
    link.close()
    # It is closed by another thread.
    until = time.monotonic() + 10
    while link.is_connected and time.monotonic() < until:
        time.sleep(0.01)
    goal = link.send_goal(
        "/follow_path", "nav2_msgs/action/FollowPath", {}, lambda succeeded, words: told.append((succeeded, words))
    )
    assert told == [(False, "/follow_path was not asked: the connection is lost")]
    link.cancel("/follow_path", goal)


def test_the_command_says_that_it_was_interrupted_before_the_first_decision(server, tmp_path, monkeypatch):
    pytest.importorskip("roslibpy")
    monkeypatch.setattr("potlp_jax.cli.drive._interruption", lambda: contextlib.nullcontext(lambda: True))
    asked = ["--task", TASK.text, "--propositions", ",".join(FLOOR.propositions), "--out", str(tmp_path / "drive")]
    result = CliRunner().invoke(app, ["drive", f"127.0.0.1:{server.port}", *asked])
    assert result.exit_code == FAILED
    assert "interrupted before the first decision" in result.output
    assert not list(tmp_path.rglob(RECORD))


@pytest.mark.parametrize(
    ("said", "policy"),
    [
        ([], "baseline"),
        (["--estimator", "firefighting"], "potlp"),
        (["--estimator", "firefighting", "-p", "baseline"], "baseline"),
    ],
)
def test_the_command_asks_the_estimator_that_is_named(server, monkeypatch, said, policy):
    pytest.importorskip("roslibpy")
    asked = []

    def drive_robot(link, task, policy, key, config, **_):
        asked.append(policy)
        return iter(())

    monkeypatch.setattr("potlp_jax.drive.driving.drive_robot", drive_robot)
    arguments = ["--task", TASK.text, "--propositions", ",".join(FLOOR.propositions), *said]
    for pictures in (["--image-topic", "/camera"], []):
        told = CliRunner().invoke(app, ["drive", f"127.0.0.1:{server.port}", *arguments, *pictures])
        noted = "--image-topic is of use with an --estimator alone" in " ".join(told.stderr.split())
        assert noted == bool(pictures and not said)
    assert asked == [policy] * 2


@pytest.mark.parametrize("broken", [False, True])
def test_the_command_keeps_the_record_of_a_drive_that_ends_by_an_error_too(server, tmp_path, monkeypatch, broken):
    pytest.importorskip("roslibpy")
    observe, maps = RemoteRobot.observe, []

    def observe_twice(robot):
        if broken and len(maps) == 2:
            raise RobotError("the map needs 9999 rows")
        maps.append(None)
        return observe(robot)

    monkeypatch.setattr(RemoteRobot, "observe", observe_twice)
    limits = ["--silence", "20", "--patience", "60", "--radius", "0.05", "--resolution", str(FLOOR.resolution)]
    asked = ["--task", TASK.text, "--propositions", ",".join(FLOOR.propositions), "--navigate", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, ["drive", f"127.0.0.1:{server.port}", *asked, *limits])
    trial = load_trial(tmp_path / RECORD)
    assert (tmp_path / PAGE).is_file()
    if broken:
        assert result.exit_code not in (0, 1)
        assert "the map needs 9999 rows" in result.output
        assert trial.outcome == "unfinished"
        assert len(trial.decisions) == 2
    else:
        assert result.exit_code == 0, result.output
        assert trial.outcome == "satisfied"
