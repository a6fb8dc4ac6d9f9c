"""The simulator as a robot that records: a trial as a bag, with the topics and frames of a real one.

For trying what reads bags without a robot, and as an example of what to record.
"""

import math
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
import yaml
from jaxtyping import Bool, Int32, UInt8
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from potlp_jax.codec import config_from_dict
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.occupancy_map import FREE, OCCUPIED, UNKNOWN
from potlp_jax.errors import LogError
from potlp_jax.logs.log import FIXED_TOPIC, IMAGE_TYPE, MAP_TYPE, ODOMETRY_TYPE, SECOND, TRANSFORM_TYPES, typestore
from potlp_jax.logs.transforms import Quaternion, quaternion_of
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import Trial, belief_seen_by
from potlp_jax.trials.robot import photograph
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.equirectangular import to_equirectangular
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import step_lengths

SECONDS_A_CELL = 0.4
START = 1_600_000_000 * SECOND
"""When the first message is recorded, in nanoseconds since 1970."""

TOPICS = {
    "/map": MAP_TYPE,
    "/tf": TRANSFORM_TYPES[0],
    FIXED_TOPIC: TRANSFORM_TYPES[0],
    "/odom": ODOMETRY_TYPE,
    "/panorama/compressed": IMAGE_TYPE,
}


class BagFormat(StrEnum):
    """What a bag is written as."""

    ROS1 = "ros1"
    ROS2 = "ros2"
    MCAP = "mcap"


def write_trial(trial: Trial, out: Path, kind: BagFormat, labels: Path, height: int = 1024) -> int:
    """Write a simulated trial as a bag, and where its propositions are.

    Args:
        trial: from ``run_trial`` or ``load_trial``.
        out: file or folder that does not exist yet.
        kind: what the bag is written as.
        labels: file for where the propositions are.
        height: of the pictures in pixels; their width is twice as large.

    Returns:
        The number of messages.

    Raises:
        LogError: there is something at ``out`` or ``labels`` already, or the world has no place for a proposition.
    """
    config = config_from_dict(TrialConfig, trial.config, "trial record")

    def panorama(step: int) -> UInt8[np.ndarray, "rows columns 3"]:
        cell = jax.numpy.asarray(trial.path[step], jax.numpy.int32)
        return np.asarray(photograph(trial.world, cell, jax.random.key(step), config.camera, config.disturbance))

    # They may be of another bag, or have been written by hand.
    if labels.exists():
        raise LogError(f"{labels} exists already: choose another name for the bag")
    text = labels_text(trial.world)
    count = write_drive(out, kind, trial.world, trial.path, trial.first_seen, panorama, config.camera, height)
    labels.write_text(text, "utf-8")
    return count


def write_drive(
    out: Path,
    kind: BagFormat,
    world: World,
    path: Sequence[tuple[int, int]],
    first_seen: Int32[np.ndarray, "H W"],
    panorama: Callable[[int], UInt8[np.ndarray, "rows columns 3"]],
    camera: CameraConfig = CameraConfig(),
    height: int = 1024,
) -> int:
    """Write a path through a world as a bag.

    At every cell entered: the map of what was seen so far, cut to where anything was seen, as mapping publishes it;
    the transforms map -> odom -> base_link, and the second as odometry too; and a PNG.

    Args:
        out: file or folder that does not exist yet.
        kind: what the bag is written as.
        world: the true map.
        path: cells in order, the start first.
        first_seen: index into the path at which each cell was first observed, ``NEVER_SEEN`` where it was not.
        panorama: gives what the camera sees at an index into the path.
        camera: of the panoramas.
        height: of the pictures in pixels; their width is twice as large.

    Returns:
        The number of messages.

    Raises:
        LogError: there is something at ``out`` already.
    """
    # A bag is a folder of its own in ROS 2: nothing is overwritten.
    if out.exists():
        raise LogError(f"{out} exists already: choose another name")
    out.parent.mkdir(parents=True, exist_ok=True)
    frame, turns = frame_of(world), _headings(path)
    # Time goes with the distance: diagonal moves take longer.
    travelled = np.cumsum([0.0, *step_lengths(path)])
    count = 0
    with Recorder(out, kind) as recorder:
        recorder.transforms(FIXED_TOPIC, START, [("base_link", "panorama", (0.0, 0.0, 0.0), quaternion_of(0.0))])
        for step, cell in enumerate(path):
            time = START + round(travelled[step] * SECONDS_A_CELL * SECOND)
            recorder.map(time, frame, belief_seen_by(world, first_seen, step))
            x, y = frame.cell_to_metres(*cell)
            # Odometry begins where the robot starts, looking ahead.
            along, across = _turned(x, y, -turns[0])
            odometry = ((along, across, 0.0), quaternion_of(turns[step] - turns[0]))
            recorder.transforms(
                "/tf",
                time,
                [("map", "odom", (0.0, 0.0, 0.0), quaternion_of(turns[0])), ("odom", "base_link", *odometry)],
            )
            recorder.odometry(time, *odometry)
            recorder.picture(time, to_equirectangular(panorama(step), camera, height, 2 * height, -turns[step]))
            count = recorder.count
    return count


def frame_of(world: World) -> GridFrame:
    """Where a world lies in metres: the robot starts at the origin, as with mapping."""
    height, width = world.shape
    resolution = float(str(np.float32(world.resolution)))
    # The centre of the start cell is at (0, 0); the frame's origin is its lower left corner.
    row, column = (int(entry) for entry in world.start)
    return GridFrame(height, width, resolution, -(column + 0.5) * resolution, -(height - row - 0.5) * resolution)


def labels_text(world: World) -> str:
    """YAML of where the propositions of a world are, as rectangles."""
    frame, letters = frame_of(world), np.asarray(world.letters)
    # From centre to edge: rectangles of cells reach to the outer edges of the outermost ones.
    half = frame.resolution / 2
    regions: dict[str, list[dict[str, Any]]] = {}
    for bit, name in enumerate(world.propositions):
        for (top, left), (bottom, right) in _rectangles((letters >> bit) & 1 == 1):
            (x0, y1), (x1, y0) = frame.cell_to_metres(top, left), frame.cell_to_metres(bottom, right)
            corners = [(x0 - half, y0 - half), (x1 + half, y0 - half), (x1 + half, y1 + half), (x0 - half, y1 + half)]
            regions.setdefault(name, []).append({"polygon": [[round(x, 4), round(y, 4)] for x, y in corners]})
    # A label file without a proposition would be refused when it is read: better here.
    missing = [name for name in world.propositions if name not in regions]
    if missing:
        raise LogError(f"the world has no place for {', '.join(missing)}: labels name every proposition's")
    return yaml.safe_dump({"propositions": regions}, default_flow_style=None, sort_keys=False)


def _rectangles(cells: Bool[np.ndarray, "H W"]) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """First and last cells of rectangles that cover the True cells: equal runs in rows below each other are one."""
    # +1 where a run of cells begins, -1 behind its end.
    edges = np.diff(np.pad(cells.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    starts, ends = np.argwhere(edges == 1).tolist(), np.argwhere(edges == -1).tolist()
    last_row: dict[tuple[int, int], tuple[int, int]] = {}
    done = []
    for (row, left), (_, end) in zip(starts, ends, strict=True):
        top, bottom = last_row.get((left, end - 1), (row, row - 1))
        # The run above was not in the row before: its rectangle is finished.
        if bottom < row - 1:
            done.append(((top, left), (bottom, end - 1)))
            top = row
        last_row[left, end - 1] = top, row
    return done + [((top, left), (bottom, right)) for (left, right), (top, bottom) in last_row.items()]


def _headings(path: Sequence[tuple[int, int]]) -> list[float]:
    """Toward the next cell, counter-clockwise from x with y upward; the last as the one before."""
    cells = np.array(path)
    steps = np.diff(cells, axis=0)
    # Rows grow downward, y upward.
    turns = np.arctan2(-steps[:, 0], steps[:, 1]).tolist() or [0.0]
    return [*turns, turns[-1]][: len(cells)]


def _turned(x: float, y: float, angle: float) -> tuple[float, float]:
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * x - sin * y, sin * x + cos * y


class Recorder:
    """Writes messages of the topics above to a bag; a context manager."""

    def __init__(self, out: Path, kind: BagFormat) -> None:
        self._is_ros1 = kind is BagFormat.ROS1
        self._store = typestore(self._is_ros1)
        plugin = StoragePlugin.MCAP if kind is BagFormat.MCAP else StoragePlugin.SQLITE3
        self._writer = Rosbag1Writer(out) if self._is_ros1 else Rosbag2Writer(out, version=9, storage_plugin=plugin)
        self._connections: dict[str, Any] = {}
        self.count = 0

    def __enter__(self) -> "Recorder":
        self._writer.open()
        for topic, kind in TOPICS.items():
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def map(self, time: int, frame: GridFrame, belief: BeliefMap) -> None:
        """Publish what was seen so far, cut to where anything was."""
        # Mapping publishes the part that it knows, with a moving origin: readers must cope, and are tested with it.
        known = ~np.asarray(belief.unknown)
        rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        top, left, height, width = rows[0], columns[0], rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1
        cut = frame.window(int(top), int(left), int(height), int(width))
        cells = np.asarray(belief.cells)[top : top + height, left : left + width]
        values = np.where(cells == BeliefMap.UNKNOWN, UNKNOWN, np.where(cells == BeliefMap.FREE, FREE, OCCUPIED))
        info = self._make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=self._stamp(time),
            resolution=frame.resolution,
            width=cut.width,
            height=cut.height,
            origin=self._pose((cut.x, cut.y, 0.0), quaternion_of(cut.yaw)),
        )
        header = self._header(time, "map")
        self._write("/map", time, header=header, info=info, data=values[::-1].ravel().astype(np.int8))

    def transforms(
        self, topic: str, time: int, edges: Sequence[tuple[str, str, tuple[float, float, float], Quaternion]]
    ) -> None:
        """Publish where frames lie in others: parent, child, position, turn."""
        transforms = [
            self._make(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(time, parent),
                child_frame_id=child,
                transform=self._make(
                    "geometry_msgs/msg/Transform", translation=self._vector(position), rotation=self._turn(turn)
                ),
            )
            for parent, child, position, turn in edges
        ]
        self._write(topic, time, transforms=transforms)

    def odometry(self, time: int, position: tuple[float, float, float], turn: Quaternion) -> None:
        """Publish where the robot is, in its own frame."""
        still = self._make(
            "geometry_msgs/msg/Twist", linear=self._vector((0.0, 0.0, 0.0)), angular=self._vector((0.0, 0.0, 0.0))
        )
        # By convention a covariance of zeros is not known.
        unknown = np.zeros(36)
        self._write(
            "/odom",
            time,
            header=self._header(time, "odom"),
            child_frame_id="base_link",
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(position, turn), covariance=unknown
            ),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=unknown),
        )

    def picture(self, time: int, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Publish an RGB picture."""
        done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        assert done, f"OpenCV could not encode a picture of shape {image.shape}"
        self._write(
            "/panorama/compressed", time, header=self._header(time, "panorama"), format="png", data=data.ravel()
        )

    def _write(self, topic: str, time: int, **fields: Any) -> None:
        kind = TOPICS[topic]
        serialize = self._store.serialize_ros1 if self._is_ros1 else self._store.serialize_cdr
        self._writer.write(self._connections[topic], time, serialize(self._make(kind, **fields), kind))
        self.count += 1

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _stamp(self, time: int) -> Any:
        return self._make("builtin_interfaces/msg/Time", sec=time // SECOND, nanosec=time % SECOND)

    def _header(self, time: int, frame_id: str) -> Any:
        # ROS 1 counts messages in their headers, ROS 2 does not.
        number = {"seq": self.count} if self._is_ros1 else {}
        return self._make("std_msgs/msg/Header", stamp=self._stamp(time), frame_id=frame_id, **number)

    def _vector(self, position: tuple[float, float, float], kind: str = "Vector3") -> Any:
        return self._make(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", position, strict=True)))

    def _turn(self, turn: Quaternion) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True)))

    def _pose(self, position: tuple[float, float, float], turn: Quaternion) -> Any:
        return self._make(
            "geometry_msgs/msg/Pose", position=self._vector(position, "Point"), orientation=self._turn(turn)
        )
