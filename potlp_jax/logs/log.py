"""A robot's log: which topics hold the map, the pose and the panoramas, and what their messages say.

The final map and the transforms are kept in memory; earlier maps and pictures are read again when they are wanted, for
there may be gigabytes of them.
"""

import contextlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Int8, UInt8
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.map_settings import LARGEST_NUMBER, LARGEST_PIXEL, SMALLEST_PIXEL
from potlp_jax.environments.ros.occupancy_map import OCCUPIED
from potlp_jax.errors import LogError
from potlp_jax.files import reading, short
from potlp_jax.images import check_whole, decode_image, image_size
from potlp_jax.logs.bag import RawMessage, open_bag
from potlp_jax.logs.transforms import Edge, Quaternion, Transforms, yaw_of

MAP_TYPE = "nav_msgs/msg/OccupancyGrid"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
IMAGE_TYPE = "sensor_msgs/msg/CompressedImage"
TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
RAW_IMAGE_TYPE = "sensor_msgs/msg/Image"
MAP_UPDATE_TYPE = "map_msgs/msg/OccupancyGridUpdate"

FIXED_TOPIC = "/tf_static"

BASE_FRAMES = ("base_link", "base_footprint", "base")
"""Names that robots give to their body (REP 105)."""

LONGEST_DELAY = 5_000_000_000
"""Nanoseconds between a message's stamp and its recording above which they are by different clocks."""

SECOND = 1_000_000_000


@dataclass(frozen=True)
class LogConfig:
    """What the topics are, and how they are read.

    Attributes:
        map_topic, image_topic: None: the only topic of the type, or the only one of a usual name.
        base_frame: the robot's body; None: the child frame of the odometry, or one of ``BASE_FRAMES``.
        free, occupied: occupancy in percent: free is at most ``free``, an obstacle at least ``occupied``, and what lies
            between is unknown.
        camera_yaw: angle in degrees, counter-clockwise, from the robot's heading to where the middle of a picture
            looks; None: as the transforms say, or 0.
        vertical_field: angle in degrees from the lower to the upper edge of a picture; None: pixels are square.
        longest_gap: seconds without a pose, or between a picture and the nearest pose, that are no gap.
    """

    map_topic: str | None = None
    image_topic: str | None = None
    base_frame: str | None = None
    free: int = 25
    occupied: int = 65
    camera_yaw: float | None = None
    vertical_field: float | None = None
    longest_gap: float = 2.0

    def __post_init__(self) -> None:
        if not 0 <= self.free < self.occupied <= 100:
            raise LogError(
                f"thresholds are percent with 0 <= free < occupied <= 100, found {self.free} and {self.occupied}"
            )
        if self.camera_yaw is not None and not math.isfinite(self.camera_yaw):
            raise LogError(f"the camera's yaw must be a number of degrees, found {self.camera_yaw}")
        if self.vertical_field is not None and not 0 < self.vertical_field <= 180:
            raise LogError(f"the vertical field must lie between 0 and 180 degrees, found {self.vertical_field}")


@dataclass(frozen=True, eq=False)
class MapMessage:
    """A map as it was published, row 0 on top; ``time`` in nanoseconds, when it was received."""

    time: int
    frame_id: str
    frame: GridFrame
    occupancy: Int8[np.ndarray, "H W"]

    def free(self, config: LogConfig) -> Bool[np.ndarray, "H W"]:
        """What the thresholds call free."""
        return (self.occupancy >= 0) & (self.occupancy <= config.free)

    def obstacles(self, config: LogConfig) -> Bool[np.ndarray, "H W"]:
        """What the thresholds call an obstacle."""
        return (self.occupancy >= config.occupied) & (self.occupancy <= 100)


@dataclass(frozen=True)
class Picture:
    """A picture of the log: ``time`` in nanoseconds, when it was taken, and its ``index`` among those of its topic."""

    index: int
    time: int
    frame_id: str
    width: int
    height: int


class Log:
    """A bag whose topics are known. ``problems`` is everything that was lost or is doubtful, in words."""

    def __init__(self, path: Path, config: LogConfig = LogConfig()) -> None:
        """Look through the bag once.

        Raises:
            LogError: the bag cannot be read, or a topic that ``config`` names is not in it or of another type.
        """
        self.config = config
        self.bag = open_bag(path)
        self.problems: list[str] = list(self.bag.problems)
        self._store = typestore(self.bag.is_ros1)
        self.map_topic = self._choose(MAP_TYPE, config.map_topic, ("/map",), "--map-topic")
        self.image_topic = self._choose(
            IMAGE_TYPE, config.image_topic, ("/panorama/compressed", "/panorama"), "--image-topic"
        )
        self.transforms = Transforms()
        self.last_map: MapMessage | None = None
        self.map_count = 0
        self.pictures: list[Picture] = []
        self.odometry: dict[str, Edge] = {}
        self._odometry_poses: dict[Edge, list[tuple[int, tuple[float, ...]]]] = {}
        self._lost: dict[str, Counter[str]] = {}
        self._other_clock: Counter[str] = Counter()
        self._read()

    @property
    def path(self) -> Path:
        """Of the bag."""
        return self.bag.path

    def of_type(self, *types: str) -> list[str]:
        """Topics of some types, in order."""
        return sorted(topic for topic, kind in self.bag.topics.items() if kind in types)

    def read_maps(self) -> Iterator[MapMessage]:
        """The maps, by the time at which they were received where the bag is whole."""
        # Read again at each call: the maps of an hour may take gigabytes.
        topics = () if self.map_topic is None else (self.map_topic,)
        for message in self.bag.messages(topics):
            # The same messages are lost as in the first pass, which has counted them.
            with contextlib.suppress(LogError), reading(self.path, LogError, "a map"):
                yield self._map(message)

    def read_pictures(self) -> Iterator[tuple[int, UInt8[np.ndarray, "h w 3"] | None]]:
        """Index and RGB of each message of the pictures' topic; None where it cannot be decoded."""
        topics = () if self.image_topic is None else (self.image_topic,)
        for index, message in enumerate(self.bag.messages(topics)):
            fields = self._decode(message)
            # Numbered with those that cannot be decoded: an index means the same message here and in ``pictures``.
            picture = None
            with contextlib.suppress(LogError), reading(self.path, LogError, "a picture"):
                picture = cv2.cvtColor(decode_image(bytes(fields.data), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
            yield index, picture

    @cached_property
    def base_frame(self) -> str | None:
        """The frame of the robot's body; None where none is known."""
        # What the user says is right, even where the log has no such frame: the error then names it.
        if self.config.base_frame is not None:
            return self.config.base_frame
        # Odometry says which frame it is of; without it, usual names that the transforms know.
        children = [child for _, child in self.odometry.values()]
        return next((name for name in (*children, *BASE_FRAMES) if name in self.transforms.frames), None)

    @property
    def map_frame(self) -> str | None:
        """The frame of the maps."""
        return None if self.last_map is None else self.last_map.frame_id

    def _choose(self, kind: str, wanted: str | None, usual: tuple[str, ...], option: str) -> str | None:
        """The topic of a type that is meant; None where there is none."""
        found = self.of_type(kind)
        # A topic that was asked for and is not there is an error, not a reason to take another.
        if wanted is not None:
            if wanted not in found:
                known = self.bag.topics.get(wanted)
                what = "is not in it" if known is None else f"is of type {known}"
                raise LogError(
                    f"{self.path}: topic {wanted} {what}; topics of type {kind}: {', '.join(found) or 'none'}"
                )
            return wanted
        # One topic of the type needs no usual name; of several only a usual name is chosen without asking.
        chosen = found if len(found) == 1 else [name for name in usual if name in found][:1]
        if found and not chosen:
            raise LogError(
                f"{self.path}: several topics are of type {kind}: {', '.join(found)}; name one with {option}"
            )
        return chosen[0] if chosen else None

    def _read(self) -> None:
        """One pass: transforms, the last map, and what the pictures are."""
        wanted = {*self.of_type(ODOMETRY_TYPE, *TRANSFORM_TYPES), self.map_topic, self.image_topic}
        index = 0
        for message in self.bag.messages([topic for topic in wanted if topic is not None]):
            fields = self._decode(message)
            if message.topic == self.image_topic:
                index += 1
            if fields is None:
                self._lose(message.topic, f"of another definition than {message.type}")
            else:
                self._keep(message, fields, index - 1)
        # Odometry is the same transform as in /tf, by another topic: used where /tf does not have it.
        for edge, poses in self._odometry_poses.items():
            if not self.transforms.has(*edge):
                for time, values in poses:
                    self.transforms.add(*edge, time, values)
        for topic, reasons in self._lost.items():
            for reason, count in reasons.items():
                total = len(self.bag.times[topic])
                self.problems.append(f"{topic}: {count} of {total} messages are lost: {reason}")
        for topic, count in self._other_clock.items():
            self.problems.append(
                f"{topic}: {count} stamps are by another clock than the recording, whose times are used for them"
            )

    def _keep(self, message: RawMessage, fields: Any, index: int) -> None:
        try:
            with reading(self.path, LogError, "a message"):
                if message.topic == self.map_topic:
                    self._keep_map(message)
                elif message.topic == self.image_topic:
                    self._keep_picture(message, fields, index)
                elif message.type == ODOMETRY_TYPE:
                    self._keep_odometry(message, fields)
                else:
                    self._keep_transforms(message, fields)
        # Flipped bits leave messages that can be decoded and make no sense: one is lost, not the log.
        except _LostError as error:
            self._lose(message.topic, str(error))
        except LogError:
            self._lose(message.topic, "damaged")

    def _decode(self, message: RawMessage) -> Any:
        """The message's fields; None where it is not of its type's definition."""
        decode = self._store.deserialize_ros1 if self.bag.is_ros1 else self._store.deserialize_cdr
        # A definition that is not the type's own, or bytes that were damaged, fail in many ways.
        with contextlib.suppress(Exception):
            return decode(message.data, message.type)
        return None

    def _lose(self, topic: str, reason: str) -> None:
        self._lost.setdefault(topic, Counter())[reason] += 1

    def _time(self, message: RawMessage, stamp: Any) -> int:
        """When a message was stamped, where its clock is that of the recording; else when it was recorded."""
        # Stamps say when a measurement was made, which is better than when it was received - if the clocks agree.
        stamped = stamp.sec * SECOND + stamp.nanosec
        if abs(stamped - message.time) <= LONGEST_DELAY:
            return stamped
        self._other_clock[message.topic] += 1
        return message.time

    def _map(self, message: RawMessage) -> MapMessage:
        """A map. Raises _LostError."""
        fields = self._decode(message)
        if fields is None:
            raise _LostError(f"of another definition than {message.type}")
        info = fields.info
        height, width = int(info.height), int(info.width)
        # The shortest decimal that is this float32: 0.05, not 0.05000000074505806.
        resolution = float(str(np.float32(info.resolution)))
        if height * width == 0 or not SMALLEST_PIXEL <= resolution <= LARGEST_PIXEL:
            raise _LostError(f"empty, {height} x {width} cells of {resolution:g} m")
        if len(fields.data) != height * width:
            raise _LostError(f"{len(fields.data)} values for {height} x {width} cells")
        # ROS counts rows from the bottom, this library from the top.
        occupancy = np.asarray(fields.data, np.int8).reshape(height, width)[::-1]
        if occupancy.min() < -1 or occupancy.max() > OCCUPIED:
            raise _LostError(f"values from {occupancy.min()} to {occupancy.max()}, beyond -1 to 100")
        x, y, _, *_ = _values(info.origin.position, info.origin.orientation)
        frame = GridFrame(height, width, resolution, x, y, yaw_of(_quaternion(info.origin.orientation)))
        return MapMessage(message.time, fields.header.frame_id.lstrip("/"), frame, occupancy)

    def _keep_map(self, message: RawMessage) -> None:
        found = self._map(message)
        self.map_count += 1
        # By time, not by place in the file: a damaged bag is not in order.
        if self.last_map is None or found.time >= self.last_map.time:
            self.last_map = found

    def _keep_picture(self, message: RawMessage, fields: Any, index: int) -> None:
        data = bytes(fields.data)
        try:
            # The header alone: sizes are wanted now, pixels later and not of all.
            with reading(self.path, LogError, "a picture"):
                width, height = image_size(data)
        except LogError as error:
            raise _LostError(f"format {short(fields.format)} is no JPEG or PNG, or it is damaged") from error
        try:
            # Now and not with the pixels: a picture that is lost must be counted, and take no other one's place.
            with reading(self.path, LogError, "a picture"):
                check_whole(data)
        except LogError as error:
            raise _LostError("pictures that are cut off or damaged") from error
        time = self._time(message, fields.header.stamp)
        self.pictures.append(Picture(index, time, fields.header.frame_id.lstrip("/"), width, height))

    def _keep_odometry(self, message: RawMessage, fields: Any) -> None:
        edge = fields.header.frame_id.lstrip("/"), fields.child_frame_id.lstrip("/") or BASE_FRAMES[0]
        self.odometry[message.topic] = edge
        pose = fields.pose.pose
        values = _values(pose.position, pose.orientation)
        self._odometry_poses.setdefault(edge, []).append((self._time(message, fields.header.stamp), values))

    def _keep_transforms(self, message: RawMessage, fields: Any) -> None:
        for transform in fields.transforms:
            # Static transforms hold for ever, whenever they were published.
            time = None if message.topic == FIXED_TOPIC else self._time(message, transform.header.stamp)
            values = _values(transform.transform.translation, transform.transform.rotation)
            self.transforms.add(transform.header.frame_id, transform.child_frame_id, time, values)


class _LostError(LogError):
    """A message that can be decoded and cannot be used; the text says why, as the log's problems count it."""


def typestore(is_ros1: bool) -> Typestore:
    """Definitions of the messages that logs are read from; they are the same in all versions of ROS 2."""
    if not is_ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    # ROS 1 had two packages with the same transform message.
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in TRANSFORM_TYPES:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return store


def _values(position: Any, orientation: Any) -> tuple[float, ...]:
    values = float(position.x), float(position.y), float(position.z), *_quaternion(orientation)
    # NaN fails the comparison, too.
    if not all(abs(value) <= LARGEST_NUMBER for value in values):
        raise _LostError("coordinates that are no numbers, or beyond any building")
    return values


def _quaternion(turn: Any) -> Quaternion:
    """x, y, z, w; what is left at zero means no turn."""
    x, y, z, w = (float(getattr(turn, name)) for name in "xyzw")
    return (x, y, z, w) if x * x + y * y + z * z + w * w > 0 else (0.0, 0.0, 0.0, 1.0)
