"""Which picture of a log belongs to which cell of the robot's path, and where it looks."""

import math

import numpy as np
from jaxtyping import Float64, Int64

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.errors import LogError
from potlp_jax.logs.log import SECOND, Log, Picture
from potlp_jax.logs.poses import Poses
from potlp_jax.logs.transforms import headings
from potlp_jax.world.moves import Cell

# Names of camera frames whose z axis looks forward (REP 103).
_OPTICAL = ("_optical", "_optical_frame")


def vertical_field(width: int, height: int, log: Log) -> float:
    """Angle from the lower to the upper edge of a picture.

    Args:
        width, height: of the picture in pixels.
        log: whose settings may give the angle.

    Returns:
        The angle in radians.

    Raises:
        LogError: with square pixels it would be more than a half circle.
    """
    if log.config.vertical_field is not None:
        return math.radians(log.config.vertical_field)
    # The picture goes once around: with square pixels its height follows from its width.
    field = 2 * math.pi * height / width
    if field > math.pi * (1 + 1e-9):
        raise LogError(
            f"{log.path}: {log.image_topic}: a picture of {width} x {height} pixels is not equirectangular with square "
            "pixels, for it would reach over more than a half circle: give the angle from its lower to its upper edge, "
            "--vertical-field DEGREES"
        )
    return min(field, math.pi)


def match_pictures(
    log: Log, poses: Poses, path: list[Cell], times: Int64[np.ndarray, "N"], frame: GridFrame, notes: list[str]
) -> tuple[dict[int, Picture], dict[int, float]]:
    """The picture taken nearest to the middle of each cell of the path, and where its middle looks.

    Args:
        log: whose pictures they are.
        poses: of the robot.
        path: cells entered.
        times: when each was, in nanoseconds.
        frame: where the cells lie in the map's metres.
        notes: what is passed over is noted here, in words.

    Returns:
        By index into the path, the picture and the bearing of its middle in the grid's frame; no entry where there is
        no picture.
    """
    # Before the robot entered its first cell, or after its last pose, there is no cell to which a picture belongs.
    taken = [picture for picture in log.pictures if times[0] <= picture.time <= poses.times[-1]]
    if not log.pictures:
        notes.append(
            "no picture: policies that take panoramas, and datasets, need a topic of type sensor_msgs/CompressedImage"
        )
    if len(taken) < len(log.pictures):
        notes.append(
            f"{log.image_topic}: {len(log.pictures) - len(taken)} of {len(log.pictures)} pictures are passed over: "
            "before the first cell or after the last pose"
        )
    if not taken:
        return {}, {}
    moments = np.array([picture.time for picture in taken])
    gap = int(log.config.longest_gap * SECOND)
    # Near in each of the transforms: odometry goes on where localisation has lost the robot.
    is_near = np.all([_distances(track, moments) <= gap for track in poses.heard], axis=0)
    if not is_near.all():
        notes.append(f"{log.image_topic}: {np.sum(~is_near)} of {len(taken)} pictures are passed over: no pose is near")
    assert log.map_frame is not None
    assert log.base_frame is not None
    # Where the body was at the moment of the picture, interpolated, not at the pose nearest in time.
    base = log.transforms.poses(log.map_frame, log.base_frame, moments)
    headings_taken = _headings(log, taken, moments, base, notes)
    steps = np.searchsorted(times, moments, side="right") - 1
    pictures: dict[int, Picture] = {}
    bearings: dict[int, float] = {}
    nearest: dict[int, float] = {}
    # One picture per cell: estimates were learned from the middle of a cell.
    for index in np.flatnonzero(is_near):
        step = int(steps[index])
        distance = math.dist(frame.cell_to_metres(*path[step]), base[index, :2, 3])
        if distance < nearest.get(step, math.inf):
            nearest[step], pictures[step] = distance, taken[index]
            # Headings grow counter-clockwise with y upward, bearings clockwise with rows downward.
            bearings[step] = -(float(headings_taken[index]) - frame.yaw)
    return pictures, bearings


def _distances(times: Int64[np.ndarray, "..."], moments: Int64[np.ndarray, "N"]) -> Int64[np.ndarray, "N"]:
    """From each moment to the nearest of some times in order."""
    # The times just before and just after; at the ends one of them twice.
    after = np.clip(np.searchsorted(times, moments), 1, max(len(times) - 1, 1))
    around = np.stack([times[after - 1], times[np.minimum(after, len(times) - 1)]])
    return np.min(np.abs(around - moments), axis=0)


def _headings(
    log: Log,
    pictures: list[Picture],
    times: Int64[np.ndarray, "N"],
    base: Float64[np.ndarray, "N 4 4"],
    notes: list[str],
) -> Float64[np.ndarray, "N"]:
    """Where the middle of each picture looks, in the frame of the map."""
    # From what is known best: the user, the transforms, or a guess that is noted.
    camera = pictures[0].frame_id
    assert log.map_frame is not None
    if log.config.camera_yaw is not None:
        return headings(base, optical=False) + math.radians(log.config.camera_yaw)
    if camera and log.transforms.chain(log.map_frame, camera) is not None:
        return headings(log.transforms.poses(log.map_frame, camera, times), camera.endswith(_OPTICAL))
    notes.append(
        f"{log.image_topic}: no transform says where the camera {camera!r} looks: the middle of its pictures is taken "
        "to look ahead; give --camera-yaw DEGREES otherwise"
    )
    return headings(base, optical=False)
