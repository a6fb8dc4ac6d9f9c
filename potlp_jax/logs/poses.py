"""Where a robot was, by its log, and the cells that it entered."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy import ndimage

from potlp_jax.environments.ros.places import component_labels
from potlp_jax.environments.ros.poses import FARTHEST_SNAP, shortest
from potlp_jax.errors import LogError
from potlp_jax.logs.log import SECOND, Log
from potlp_jax.logs.working_grid import WorkingGrid
from potlp_jax.world.moves import Cell

MOST_PAUSES = 0.1
"""Share of a transform's intervals that may be too long, where it is published at a steady rate."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Where the robot was, in metres in the frame of the map.

    Attributes:
        times: in nanoseconds.
        points: at these times.
        heard: when each transform that a pose is made of was published, of those that are published at a steady rate.
            Far from any of these times there is no telling where the robot was.
    """

    times: Int64[np.ndarray, "N"]
    points: Float64[np.ndarray, "N 2"]
    heard: tuple[Int64[np.ndarray, "..."], ...]


def read_poses(log: Log, notes: list[str]) -> Poses:
    """The poses of the robot in the frame of the map; gaps in time are noted.

    Args:
        log: with a map.
        notes: what is doubtful is added here, in words.

    Returns:
        One pose at each time at which the robot's frame was published.

    Raises:
        LogError: nothing says where the robot's frame lies in that of the map, at any time.
    """
    base, frame = log.base_frame, log.map_frame
    assert frame is not None
    # Both errors list the frames: the usual cause is another name than the one expected.
    known = ", ".join(sorted(log.transforms.frames)) or "none"
    if base is None:
        raise LogError(
            f"{log.path}: has no pose: record /tf and /tf_static, or nav_msgs/Odometry in the frame of the map, or "
            f"name the robot's frame with --base-frame; its frames: {known}"
        )
    if log.transforms.chain(frame, base) is None:
        raise LogError(
            f"{log.path}: nothing says where {base!r} lies in {frame!r}, the frame of {log.map_topic}: record /tf, in "
            f"which localisation or mapping publishes {frame} -> odom; its frames: {known}"
        )
    times = log.transforms.times(frame, base)
    if not len(times):
        raise LogError(f"{log.path}: {base!r} never moves in {frame!r}: its transforms are all static; record /tf")
    # A gap is no error: localisation may be lost for a while, and what lies between can be guessed and said.
    gaps = np.diff(times) / SECOND
    long = gaps[gaps > log.config.longest_gap]
    if len(long):
        notes.append(
            f"pose: {len(long)} gaps of more than {log.config.longest_gap:g} s, the longest of {long.max():.1f} s; the "
            "path across is taken to be the shortest in the final map"
        )
    return Poses(times, log.transforms.poses(frame, base, times)[:, :2, 3], _heard(log, times, notes))


def _heard(log: Log, times: Int64[np.ndarray, "N"], notes: list[str]) -> tuple[Int64[np.ndarray, "..."], ...]:
    """``Poses.heard`` of poses at some times; pauses of any transform are noted."""
    assert log.map_frame is not None
    assert log.base_frame is not None
    heard = []
    for (parent, child), track in log.transforms.tracks(log.map_frame, log.base_frame).items():
        pauses = _pauses(track, times, log.config.longest_gap)
        # Some mapping publishes a correction only when there is a new one: its silence says that nothing has changed.
        is_steady = len(pauses) <= MOST_PAUSES * max(len(track) - 1, 1)
        if is_steady:
            heard.append(track)
        if len(pauses) and is_steady:
            notes.append(
                f"pose: {parent} -> {child}: {len(pauses)} gaps of more than {log.config.longest_gap:g} s, the longest "
                f"of {pauses.max():.1f} s; the path across goes by the other transforms"
            )
        elif len(pauses):
            notes.append(
                f"pose: {parent} -> {child}: {len(track)} messages at no steady rate, with pauses of up to "
                f"{pauses.max():.1f} s: between two it is interpolated, and nothing counts as a gap"
            )
    return tuple(heard)


def _pauses(
    track: Int64[np.ndarray, "..."], times: Int64[np.ndarray, "N"], longest: float
) -> Float64[np.ndarray, "..."]:
    """Seconds, above ``longest``, for which there were poses at ``times`` and none of the transform's messages."""
    between = np.diff(times)
    # Where there are no poses either, that is a gap of its own.
    driven = np.where(between <= longest * SECOND, between, 0)
    # Counted by how many of its messages were before: so it also may begin too late, or end too early.
    seconds = np.bincount(np.searchsorted(track, times[:-1] + between // 2), weights=driven) / SECOND
    return seconds[seconds > longest]


def drive_path(
    poses: Poses, grid: WorkingGrid, log: Log, radius: float, notes: list[str]
) -> tuple[list[Cell], Int64[np.ndarray, "N"]]:
    """Cells entered, and for each the number of the pose by which it was.

    Args:
        poses: in the frame of the map.
        grid: the final map on working cells.
        log: for messages.
        radius: of the robot, in metres.
        notes: poses that are passed over are noted here, in words.

    Returns:
        The cells, each a neighbour of the one before, and the index into ``poses`` at which each was entered.

    Raises:
        LogError: no pose is in free space.
    """
    frame = grid.frame
    across, up = frame.to_grid(poses.points).T
    inside = (across >= 0) & (across < frame.width) & (up >= 0) & (up < frame.height)
    rows, columns = frame.height - 1 - np.floor(up).astype(int), np.floor(across).astype(int)
    # Noise puts poses into walls and outside. The component with most of them is where the robot was.
    labels = component_labels(grid.free)
    reached = labels[rows[inside], columns[inside]]
    on_free = reached[reached > 0]
    if not len(on_free):
        raise LogError(
            f"{log.path}: none of {len(inside)} poses is in free space of the last map: is it of the same run, and "
            f"{log.base_frame!r} the robot's frame?"
        )
    main = labels == np.bincount(on_free).argmax()
    # The nearest cell of that component for every cell of the map, in one pass.
    found = ndimage.distance_transform_edt(~main, return_indices=True)
    assert found is not None
    distance, nearest = found
    numbers = np.flatnonzero(inside)
    # Poses beside free space are snapped to it; those far away are errors of localisation.
    near = distance[rows[numbers], columns[numbers]] <= FARTHEST_SNAP + radius / frame.resolution
    numbers = numbers[near]
    if len(numbers) < len(inside):
        notes.append(
            f"pose: {len(inside) - len(numbers)} of {len(inside)} poses are passed over: they are not in, or near, the "
            "space that the robot could reach in the last map"
        )
    snapped = nearest[:, rows[numbers], columns[numbers]].T
    path: list[Cell] = []
    entered: list[int] = []
    for number, cell in zip(numbers.tolist(), map(tuple, snapped.tolist()), strict=True):
        # Cells entered, not time spent in them.
        if path and cell == path[-1]:
            continue
        between = [cell] if not path else shortest(main, path[-1], cell)
        path += between
        entered += [number] * len(between)
    return path, np.array(entered)
