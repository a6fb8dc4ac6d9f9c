"""What a robot has said: the newest map, pose and picture, whatever order the network brought them in.

Messages are taken by their stamps. One that is older than what is known, or the same once more, changes nothing, so
that delay, loss, duplicates and reordering leave the same state as the messages that arrived, in order, would. A stamp
that lies far in the past means that the robot's clock began anew, as in a simulation that was restarted: what is known
gives way.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from potlp_jax.drive.config import DriveConfig
from potlp_jax.drive.lattice import Scan
from potlp_jax.drive.messages import (
    Message,
    picture_of,
    pose_of,
    regions_of,
    scan_of,
    stamp_of,
    text_of,
    transforms_of,
    update_of,
)
from potlp_jax.environments.ros.places import Region
from potlp_jax.errors import RobotError

RESTART: int = 5_000_000_000
"""Nanoseconds by which a stamp must lie before the newest one for the clock to have begun anew."""

Pose = tuple[float, float, float]
"""x, y and yaw in metres and radians of the map's frame."""

Edge = tuple[str, str]
"""Parent and child of a transform."""


@dataclass(frozen=True, eq=False)
class Heard:
    """What is known of the robot; a new one after each message that changed something.

    Attributes:
        scan: the newest map with its updates; None before the first.
        frame_id: of the map.
        maps: how many maps and updates changed it.
        poses: those of the robot since they were last taken, in order.
        pose: the newest one.
        heard: when a pose was last heard, by the clock of this program; of transforms, when that of the robot's body
            in its odometry was, whatever localisation says meanwhile.
        picture: the newest one, RGB.
        regions: where propositions hold by what the robot sees.
        task: a formula that was asked for and not taken yet.
    """

    scan: Scan | None = None
    frame_id: str = ""
    maps: int = 0
    poses: tuple[Pose, ...] = ()
    pose: Pose | None = None
    heard: float = 0.0
    picture: UInt8[np.ndarray, "h w 3"] | None = None
    regions: tuple[tuple[str, Region], ...] = ()
    task: str | None = None


class Inbox:
    """Messages go in from any thread; ``heard`` is what they come to, and ``refused`` counts those of no use."""

    def __init__(
        self, config: DriveConfig, propositions: Sequence[str], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._config, self._propositions, self._clock = config, propositions, clock
        self._changed = threading.Condition()
        self._heard = Heard(heard=clock())
        self._newest: dict[str, int] = {}
        self._pixel_stamps: Int64[np.ndarray, "H W"] | None = None
        self._transforms: dict[Edge, Float64[np.ndarray, "4 4"]] = {}
        self._static: set[Edge] = set()
        # When each that moves was last heard.
        self._edge_heard: dict[Edge, float] = {}
        self._refused = Counter[str]()
        topics = config.topics
        # What is not subscribed has no name here, and no message.
        self.handlers: dict[str, tuple[str, Callable[[Message], Heard | None]]] = {
            topic: (kind, handler)
            for topic, kind, handler in (
                (topics.map, "nav_msgs/OccupancyGrid", self._map),
                (topics.map_updates, "map_msgs/OccupancyGridUpdate", self._update),
                (topics.pose, "geometry_msgs/PoseStamped", self._pose),
                ("" if topics.pose else topics.tf, "tf2_msgs/TFMessage", self._transform),
                ("" if topics.pose else topics.tf_static, "tf2_msgs/TFMessage", self._static_transform),
                (topics.image, _image_type(topics.image), self._picture),
                (topics.places, "std_msgs/String", self._places),
                (topics.task, "std_msgs/String", self._task),
            )
            if topic
        }

    @property
    def heard(self) -> Heard:
        """What is known now."""
        with self._changed:
            return self._heard

    @property
    def refused(self) -> Counter[str]:
        """How many messages were refused, by their topic and what is wrong with them."""
        with self._changed:
            return self._refused.copy()

    def handle(self, topic: str, message: Message) -> None:
        """Take a message. One that is not what its type says is counted, named by its topic, and nothing else."""
        with self._changed:
            try:
                found = self.handlers[topic][1](message)
            except RobotError as error:
                self._refused[f"{topic}: {error}"] += 1
                return
            if found is not None:
                self._heard = found
                self._changed.notify_all()

    def wait(self, seconds: float) -> None:
        """Until something changes, or so many seconds."""
        with self._changed:
            self._changed.wait(seconds)

    def take_poses(self) -> tuple[Pose, ...]:
        """Poses since the last call, in order."""
        with self._changed:
            poses, self._heard = self._heard.poses, replace(self._heard, poses=())
        return poses

    def take_task(self) -> str | None:
        """A formula that was asked for, once."""
        with self._changed:
            task, self._heard = self._heard.task, replace(self._heard, task=None)
        return task

    def _is_new(self, what: str, stamp: int) -> bool:
        """Whether a stamp is newer than the newest one of a stream, which it becomes."""
        newest = self._newest.get(what)
        if newest is not None and newest - RESTART < stamp <= newest:
            return False
        self._newest[what] = stamp
        return True

    def _map(self, message: Message) -> Heard | None:
        scan, stamp = scan_of(message), stamp_of(message)
        if not self._is_new("map", stamp):
            return None
        before, stamps = self._heard.scan, self._pixel_stamps
        self._pixel_stamps = np.full(scan.occupancy.shape, stamp)
        # An update that overtook the map it belongs to is kept, pixel by pixel.
        if before is not None and before.frame == scan.frame and stamps is not None:
            newer = (stamps > stamp) & (stamps < stamp + RESTART)
            scan = Scan(scan.frame, np.where(newer, before.occupancy, scan.occupancy))
            self._pixel_stamps = np.where(newer, stamps, self._pixel_stamps)
        frame_id = str(message["header"].get("frame_id", "")).lstrip("/")
        # The same once more is no news: whoever waits for the map goes on waiting.
        same_frame = before is not None and (before.frame, self._heard.frame_id) == (scan.frame, frame_id)
        if before is not None and same_frame and np.array_equal(before.occupancy, scan.occupancy):
            return None
        heard, renamed = self._heard, frame_id != self._heard.frame_id
        # Metres of the frame of before mean other places in this one. A topic of poses has no frame but the map's.
        if renamed and not self._config.topics.pose:
            heard = replace(heard, poses=(), pose=None)
        self._heard = replace(heard, scan=scan, frame_id=frame_id, maps=heard.maps + 1)
        # What was heard before of where the robot is tells its pose in this frame from now on.
        placed = self._placed() if renamed else None
        return placed or self._heard

    def _update(self, message: Message) -> Heard | None:
        (x, y, values), stamp = update_of(message), stamp_of(message)
        scan, stamps = self._heard.scan, self._pixel_stamps
        # Of which map an update is, nothing says: without one it is of no use.
        if scan is None or stamps is None:
            return None
        height, width = values.shape
        top = scan.frame.height - y - height
        if x < 0 or y < 0 or top < 0 or x + width > scan.frame.width:
            raise RobotError("an update that reaches beyond the map")
        area = np.s_[top : top + height, x : x + width]
        newer = (stamp > stamps[area]) | (stamp <= stamps[area] - RESTART)
        if not newer.any():
            return None
        occupancy, self._pixel_stamps = scan.occupancy.copy(), stamps.copy()
        occupancy[area] = np.where(newer, values, occupancy[area])
        self._pixel_stamps[area] = np.where(newer, stamp, stamps[area])
        if np.array_equal(occupancy, scan.occupancy):
            return None
        return replace(self._heard, scan=Scan(scan.frame, occupancy), maps=self._heard.maps + 1)

    def _pose(self, message: Message) -> Heard | None:
        pose, stamp = pose_of(message), stamp_of(message)
        return self._with_pose(pose, self._clock()) if self._is_new("pose", stamp) else None

    def _static_transform(self, message: Message) -> Heard | None:
        self._static |= {(parent, child) for parent, child, _, _ in transforms_of(message)}
        return self._transform(message)

    def _transform(self, message: Message) -> Heard | None:
        changed, now = set[Edge](), self._clock()
        for parent, child, stamp, matrix in transforms_of(message):
            if self._is_new(f"{parent} to {child}", stamp):
                self._transforms[(parent, child)], self._edge_heard[(parent, child)] = matrix, now
                changed.add((parent, child))
        return self._placed(changed)

    def _placed(self, changed: Collection[Edge] | None = None) -> Heard | None:
        """The robot where its transforms place it in the map; None where they do not, or where none of it changed.

        Args:
            changed: transforms that are new; None: the map's frame is.
        """
        matrix, edges = self._chain()
        # A wheel that turns says nothing of where the robot is, and must not pass for a pose.
        news = set(edges) if changed is None else set(edges).intersection(changed)
        if matrix is None or not news:
            return None
        yaw = float(np.arctan2(matrix[1, 0], matrix[0, 0]))
        return self._with_pose((float(matrix[0, 3]), float(matrix[1, 3]), yaw), self._body_heard(edges))

    def _body_heard(self, edges: Sequence[Edge]) -> float:
        """When it was last heard that the robot's body moved, or stood.

        SLAM publishes its correction of the odometry by a timer, also where the odometry has been silent for long.
        """
        moving = next((edge for edge in edges if edge not in self._static), None)
        # Where nothing moves, as in a simulation that places the robot, a static transform is all that is to be heard.
        return self._clock() if moving is None else self._edge_heard[moving]

    def _with_pose(self, pose: Pose, heard: float) -> Heard:
        return replace(self._heard, pose=pose, poses=(*self._heard.poses, pose), heard=heard)

    def _chain(self) -> tuple[Float64[np.ndarray, "4 4"] | None, list[Edge]]:
        """From the robot's frame upwards to the map's, and the edges in order; None where nothing connects them."""
        parents = {child: (parent, matrix) for (parent, child), matrix in self._transforms.items()}
        frame, matrix, edges = self._config.base_frame, np.eye(4), list[Edge]()
        while frame != self._heard.frame_id:
            # A ring of transforms is a fault of the robot's, and would never end.
            if frame not in parents or (parents[frame][0], frame) in edges:
                return None, edges
            edges.append((parents[frame][0], frame))
            frame, above = parents[frame]
            matrix = above @ matrix
        return matrix, edges

    def _picture(self, message: Message) -> Heard | None:
        stamp, picture = stamp_of(message), picture_of(message)
        height, width, _ = picture.shape
        if 2 * height > width:
            raise RobotError(
                f"a picture of {width} x {height} pixels is not equirectangular with square pixels, for it would reach "
                "over more than a half circle: publish pictures at most half as high as they are wide"
            )
        return replace(self._heard, picture=picture) if self._is_new("picture", stamp) else None

    def _places(self, message: Message) -> Heard | None:
        regions = regions_of(message, self._propositions)
        # Equal places change nothing, so that a robot may repeat them.
        if regions == self._heard.regions:
            return None
        return replace(self._heard, regions=regions, maps=self._heard.maps + 1)

    def _task(self, message: Message) -> Heard | None:
        return replace(self._heard, task=text_of(message))


def _image_type(topic: str) -> str:
    return "sensor_msgs/CompressedImage" if topic.endswith("compressed") else "sensor_msgs/Image"
