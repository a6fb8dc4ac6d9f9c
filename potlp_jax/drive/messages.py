"""Messages of ROS as rosbridge writes them, JSON, in both directions.

ROS 1 and ROS 2 differ in the names of a stamp's fields alone. What is published here carries no stamp, which both take
for "now".
"""

import base64
import binascii
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int8, UInt8

from potlp_jax.drive.lattice import Scan
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.map_settings import LARGEST_PIXEL, SMALLEST_PIXEL
from potlp_jax.environments.ros.occupancy_map import OCCUPIED
from potlp_jax.environments.ros.places import Disc, Polygon, Region
from potlp_jax.errors import PotlpError, RobotError
from potlp_jax.files import short
from potlp_jax.images import decode_image
from potlp_jax.logs.transforms import Quaternion, quaternion_of, yaw_of

Message = Mapping[str, Any]

_FAULTS = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, binascii.Error)
"""What reading a message raises that is not what its type says."""


def stamp_of(message: Message) -> int:
    """Nanoseconds of a header's stamp, of ROS 1 or ROS 2. Raises RobotError."""
    try:
        stamp = message["header"]["stamp"]
        seconds, parts = (stamp["sec"], stamp["nanosec"]) if "sec" in stamp else (stamp["secs"], stamp["nsecs"])
        return int(seconds) * 1_000_000_000 + int(parts)
    except _FAULTS as error:
        raise RobotError(f"a message without a stamp: {short(repr(error))}") from error


def scan_of(message: Message) -> Scan:
    """A ``nav_msgs/OccupancyGrid``. Raises RobotError."""
    try:
        info = message["info"]
        height, width = int(info["height"]), int(info["width"])
        # The shortest decimal that is this float32: 0.05, not 0.05000000074505806.
        resolution = float(str(np.float32(info["resolution"])))
        if height <= 0 or width <= 0 or not SMALLEST_PIXEL <= resolution <= LARGEST_PIXEL:
            raise RobotError(f"a map of {height} x {width} pixels of {resolution:g} m")
        occupancy = _occupancy(message["data"], height, width)
        x, y, yaw = pose_of(info["origin"])
        return Scan(GridFrame(height, width, resolution, x, y, yaw), occupancy)
    except RobotError:
        raise
    except _FAULTS as error:
        raise RobotError(f"a map that is no nav_msgs/OccupancyGrid: {short(repr(error))}") from error


def update_of(message: Message) -> tuple[int, int, Int8[np.ndarray, "h w"]]:
    """A ``map_msgs/OccupancyGridUpdate``: its first column, its first row from below, and the values, row 0 on top.

    Raises RobotError.
    """
    try:
        x, y = int(message["x"]), int(message["y"])
        return x, y, _occupancy(message["data"], int(message["height"]), int(message["width"]))
    except RobotError:
        raise
    except _FAULTS as error:
        raise RobotError(f"a map update that is none: {short(repr(error))}") from error


def _occupancy(data: Any, height: int, width: int) -> Int8[np.ndarray, "h w"]:
    # Some bridges pack bytes into base64.
    values = np.frombuffer(base64.b64decode(data), np.int8) if isinstance(data, str) else np.asarray(data)
    if values.shape != (height * width,) or values.dtype.kind not in "iu":
        raise RobotError(f"{values.size} values for {height} x {width} pixels")
    if values.size and (values.min() < -1 or values.max() > OCCUPIED):
        raise RobotError(f"values from {values.min()} to {values.max()}, beyond -1 to 100")
    # ROS counts rows from the bottom, this library from the top.
    return values.astype(np.int8).reshape(height, width)[::-1]


def pose_of(pose: Message) -> tuple[float, float, float]:
    """x, y and yaw of a ``geometry_msgs/Pose``, whether alone, stamped or with a covariance. Raises RobotError."""
    try:
        while "pose" in pose:
            pose = pose["pose"]
        position = pose["position"]
        x, y = float(position["x"]), float(position["y"])
        yaw = yaw_of(_quaternion(pose["orientation"]))
    except _FAULTS as error:
        raise RobotError(f"a pose that is none: {short(repr(error))}") from error
    if not all(map(math.isfinite, (x, y, yaw))):
        raise RobotError(f"a pose that is not finite: {x}, {y}, {yaw}")
    return x, y, yaw


def transforms_of(message: Message) -> list[tuple[str, str, int, Float64[np.ndarray, "4 4"]]]:
    """Parent, child, stamp and matrix of each transform of a ``tf2_msgs/TFMessage``. Raises RobotError."""
    try:
        return [_transform(entry) for entry in message["transforms"]]
    except RobotError:
        raise
    except _FAULTS as error:
        raise RobotError(f"transforms that are none: {short(repr(error))}") from error


def _transform(entry: Message) -> tuple[str, str, int, Float64[np.ndarray, "4 4"]]:
    moved, matrix = entry["transform"]["translation"], np.eye(4)
    # In the plane: robots that drive indoors do not leave it.
    yaw = yaw_of(_quaternion(entry["transform"]["rotation"]))
    matrix[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    matrix[:2, 3] = float(moved["x"]), float(moved["y"])
    if not np.isfinite(matrix).all():
        raise RobotError("a transform that is not finite")
    return entry["header"]["frame_id"].lstrip("/"), entry["child_frame_id"].lstrip("/"), stamp_of(entry), matrix


def _quaternion(turn: Message) -> Quaternion:
    x, y, z, w = (float(turn[name]) for name in "xyzw")
    # What is left at zero means no turn.
    return (x, y, z, w) if x * x + y * y + z * z + w * w > 0 else (0.0, 0.0, 0.0, 1.0)


def picture_of(message: Message) -> UInt8[np.ndarray, "h w 3"]:
    """RGB of a ``sensor_msgs/CompressedImage`` or ``Image``. Raises RobotError."""
    try:
        data = base64.b64decode(message["data"])
        if "encoding" not in message:
            return cv2.cvtColor(decode_image(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        channels = {"rgb8": 3, "bgr8": 3, "mono8": 1}.get(message["encoding"])
        if channels is None:
            raise RobotError(f"a picture of encoding {short(message['encoding'])}: publish rgb8, bgr8 or mono8")
        height, width, step = (int(message[name]) for name in ("height", "width", "step"))
        rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, : width * channels]
        pixels = rows.reshape(height, width, channels)
        turned = pixels[..., ::-1] if message["encoding"] == "bgr8" else pixels
        return np.ascontiguousarray(np.broadcast_to(turned, (height, width, 3)))
    except RobotError:
        raise
    # The last three are what libraries of images raise of damaged ones.
    except (*_FAULTS, PotlpError, OSError, SyntaxError, cv2.error) as error:
        raise RobotError(f"a picture that cannot be read: {short(repr(error))}") from error


def regions_of(message: Message, names: Sequence[str]) -> tuple[tuple[str, Region], ...]:
    """Where propositions hold, of a ``std_msgs/String`` in JSON as of the labels' file. Raises RobotError.

    ``{"fire": [{"point": [3.5, -2.0], "radius": 0.5}], "exit": [{"polygon": [[0, 0], [2, 0], [2, 1]]}]}``
    """
    try:
        given = json.loads(message["data"])
        unknown = sorted(set(given) - set(names))
        if unknown:
            raise RobotError(f"places of {unknown[0]!r}, which is none of {', '.join(names)}")
        return tuple((name, _region(region)) for name in names for region in given.get(name, ()))
    except RobotError:
        raise
    except _FAULTS as error:
        raise RobotError(f"places that are none: {short(repr(error))}") from error


def _region(given: Message) -> Region:
    numbers = [given["point"]] if "point" in given else given["polygon"]
    points = tuple((float(x), float(y)) for x, y in numbers)
    radius = float(given["radius"]) if "point" in given else 0.0
    if not (np.isfinite(np.array(points)).all() and math.isfinite(radius) and radius >= 0):
        raise ValueError("not finite")
    if "point" not in given and len(points) < 3:
        raise ValueError("a polygon has three vertices or more")
    return Disc(points[0], radius) if "point" in given else Polygon(points)


def text_of(message: Message) -> str:
    """Of a ``std_msgs/String``. Raises RobotError."""
    text = message.get("data")
    if not isinstance(text, str):
        raise RobotError(f"a text that is none: {short(repr(text))}")
    return text


def make_pose(x: float, y: float, yaw: float) -> dict[str, Any]:
    """A ``geometry_msgs/Pose`` on the ground.

    Args:
        x, y: metres in the frame that the message is published with.
        yaw: radians, counter-clockwise from the x axis.

    Returns:
        JSON-able values: the position, with a height of 0, and the orientation as a quaternion.
    """
    qx, qy, qz, qw = quaternion_of(yaw)
    return {"position": {"x": x, "y": y, "z": 0.0}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}


def make_path(points: Sequence[tuple[float, float]], frame_id: str) -> dict[str, Any]:
    """A ``nav_msgs/Path`` through points, each pose looking to the next."""
    header = {"frame_id": frame_id}
    return {
        "header": header,
        "poses": [{"header": header, "pose": make_pose(*pose)} for pose in with_headings(points)],
    }


def with_headings(points: Sequence[tuple[float, float]]) -> list[tuple[float, float, float]]:
    """Points and the directions to the ones after; the last keeps that of the one before."""
    yaws = [math.atan2(y1 - y0, x1 - x0) for (x0, y0), (x1, y1) in itertools.pairwise(points)]
    yaws.append(yaws[-1] if yaws else 0.0)
    return [(x, y, yaw) for (x, y), yaw in zip(points, yaws, strict=True)]
