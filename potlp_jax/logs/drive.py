"""A drive: what a log says about one run of a robot, in the planner's terms.

All maps of the log are laid on the grid of the final map, whatever their size, origin and resolution were. The final
map is taken for the truth: what it does not show is an obstacle in ``Drive.world``, and never observed. A cell counts
as known from the first map on that showed it. Its value is the final map's, so that a correction by the robot's own
mapping counts as seen from the start; how much was corrected is among the notes.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int8, Int32, Int64, UInt8
from scipy import ndimage

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.places import Places, place_letters
from potlp_jax.errors import LogError
from potlp_jax.learning.domain import LOGS
from potlp_jax.logs.log import Log, MapMessage, Picture
from potlp_jax.logs.pictures import match_pictures, vertical_field
from potlp_jax.logs.poses import drive_path, read_poses
from potlp_jax.logs.working_grid import NEVER, GridConfig, WorkingGrid
from potlp_jax.trials.record import NEVER_SEEN, belief_seen_by
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.equirectangular import from_equirectangular
from potlp_jax.world.frontiers import FrontierConfig, frontier_cells
from potlp_jax.world.grid import BeliefMap, World, make_world
from potlp_jax.world.moves import Cell

CORRECTED_SHARE = 0.02
"""Share of a map's known pixels that are otherwise in the final map, above which it is worth a note."""


@dataclass(frozen=True, eq=False)
class Drive:
    """One run of a robot.

    Attributes:
        log: what it was read from.
        world: the final map, its letters and the first cell; what was never seen is an obstacle.
        frame: where the world's cells lie in the map's metres.
        seen: what the final map knows.
        path: cells entered, 8-connected, corners not cut, the first included.
        times: when each was entered, in nanoseconds.
        first_seen: index into ``path`` at which each cell was first known, ``NEVER_SEEN`` where it never was.
        pictures: by index into ``path``, the picture taken nearest to the middle of the cell, where there is one.
        bearings: direction, in the grid's frame, in which the middle of each of these pictures looks.
        propositions, tasks: of the labels.
        notes: what was lost or is doubtful, in words.
    """

    log: Log
    world: World
    frame: GridFrame
    seen: Bool[np.ndarray, "H W"]
    path: tuple[Cell, ...]
    times: Int64[np.ndarray, "N"]
    first_seen: Int32[np.ndarray, "H W"]
    pictures: dict[int, Picture]
    bearings: dict[int, float]
    propositions: tuple[str, ...]
    tasks: dict[str, str]
    notes: tuple[str, ...]

    def belief_at(self, step: int) -> BeliefMap:
        """What was known when ``path[step]`` had been entered."""
        return belief_seen_by(self.world, self.first_seen, step)

    def unexplored(self) -> Bool[np.ndarray, "H W"]:
        """Free cells beside what was never seen, in components that are large enough to lead on."""
        # As a frontier of a robot that knows all that the final map does.
        truth = BeliefMap.revealed(self.world)
        cells = jnp.where(jnp.asarray(self.seen), truth.cells, jnp.int8(BeliefMap.UNKNOWN))
        edge = np.asarray(frontier_cells(replace(truth, cells=cells), ~self.world.occupied))
        labels = np.zeros(edge.shape, np.int32)
        ndimage.label(edge, np.ones((3, 3)), output=labels)
        return edge & (np.bincount(labels.ravel())[labels] >= FrontierConfig().min_size)


class PanoramaReader:
    """Panoramas of a drive. Pictures are read in the order in which they were taken: asking backward starts again."""

    def __init__(self, drive: Drive, camera: CameraConfig) -> None:
        self._drive, self._camera = drive, camera
        self._stream: Iterator[tuple[int, UInt8[np.ndarray, "h w 3"] | None]] = iter(())
        self._index, self._picture = math.inf, None

    def panorama(self, step: int) -> UInt8[np.ndarray, "rows columns 3"] | None:
        """What the camera saw from ``path[step]``, in the frame of the map; None where there is no picture.

        Raises:
            LogError: the picture's shape fits no equirectangular one.
        """
        picture = self._drive.pictures.get(step)
        image = None if picture is None else self._read(picture.index)
        if image is None:
            return None
        # The picture's own size, for a topic may change it.
        field = vertical_field(image.shape[1], image.shape[0], self._drive.log)
        return from_equirectangular(image, self._camera, self._drive.bearings[step], field)

    def _read(self, index: int) -> UInt8[np.ndarray, "h w 3"] | None:
        # Bags are read forward only. A step backward, rare in a drive, begins again.
        if index < self._index:
            self._stream, self._index = self._drive.log.read_pictures(), -1
        while self._index < index:
            self._index, self._picture = next(self._stream)
        return self._picture


def read_drive(log: Log, places: Places, config: GridConfig = GridConfig()) -> Drive:
    """The drive of a log.

    Args:
        log: with a map and poses.
        places: where the propositions are.
        config: size of the planner's cells and radius of the robot.

    Returns:
        The drive, with notes on what is doubtful.

    Raises:
        LogError: there is no map, or no pose in its frame, or the robot was never on it.
        MapError: a region lies where the log shows no free cell.
    """
    # Everything doubtful is collected and handed on with the drive: a log is seldom perfect and often good enough.
    notes = list(log.problems)
    grid = WorkingGrid(_final_map(log), log, config)
    poses = read_poses(log, notes)
    path, entered = drive_path(poses, grid, log, config.radius, notes)
    letters = _letters(places, grid, notes)
    first_seen, start = _first_seen(log, grid, path, poses.times[entered], notes)
    # Before the first map nothing was known, and no policy could have decided.
    path, times = path[start:], poses.times[entered][start:]
    pictures, bearings = match_pictures(log, poses, path, times, grid.frame, notes)
    world = make_world(~grid.free, letters, path[0], resolution=grid.frame.resolution, propositions=places.names)
    return Drive(
        log=log,
        world=replace(world, family=LOGS),
        frame=grid.frame,
        seen=grid.seen,
        path=tuple(path),
        times=times,
        first_seen=first_seen,
        pictures=pictures,
        bearings=bearings,
        propositions=places.names,
        tasks=dict(places.tasks),
        notes=tuple(notes),
    )


def _final_map(log: Log) -> MapMessage:
    final = log.last_map
    if final is None:
        lost = "; ".join(log.problems)
        raise LogError(
            f"{log.path}: no map can be read from {log.map_topic}: {lost}"
            if log.map_topic
            else f"{log.path}: has no map: record a topic of type nav_msgs/OccupancyGrid, such as /map; it has: "
            + ", ".join(f"{topic} ({kind})" for topic, kind in sorted(log.bag.topics.items()))
        )
    # A map without free cells or without obstacles is nearly always one with other thresholds.
    for kind, pixels in (("nothing free", final.free(log.config)), ("no obstacle", final.obstacles(log.config))):
        if not pixels.any():
            raise LogError(
                f"{log.path}: {log.map_topic}: the thresholds leave {kind} in the last map: {_advise(final.occupancy)}"
            )
    return final


def _advise(occupancy: Int8[np.ndarray, "H W"]) -> str:
    """Thresholds under which a map has free space and obstacles, where there are any."""
    known = np.unique(occupancy[occupancy >= 0])
    if len(known) < 2:
        found = f"the value {known[0]} and unknown cells" if len(known) else "unknown cells"
        return f"it holds {found} only; drive further, or give another --map-topic"
    # Both at once: advice on one alone may ask for a value that the other forbids.
    third = int(known[-1] - known[0]) // 3
    return (
        f"its values are {', '.join(map(str, known[:8]))}{', ...' if len(known) > 8 else ''}; give thresholds between "
        f"{known[0]} and {known[-1]}, such as --free {known[0] + third} --occupied {known[-1] - third}"
    )


def _first_seen(
    log: Log, grid: WorkingGrid, path: list[Cell], times: Int64[np.ndarray, "N"], notes: list[str]
) -> tuple[Int32[np.ndarray, "H W"], int]:
    """Index into the path from its ``start`` on, the second value, at which each cell was first known."""
    # Maps come with the time at which they were received: that is when the robot knew.
    number, heads, corrected = grid.first_known(log.read_maps())
    if corrected > CORRECTED_SHARE:
        notes.append(
            f"{log.map_topic}: up to {corrected:.1%} of what a map showed is otherwise in the last one, which is taken "
            "for what was seen from the start"
        )
    received = np.array([head.time for head in heads])
    # The last cell entered before the first map is where the drive begins.
    start = max(int(np.searchsorted(times, received.min(), side="right")) - 1, 0)
    # From times of maps to indices into the path: a map belongs to the cell in which it was received.
    steps = np.clip(np.searchsorted(times[start:], received, side="right") - 1, 0, None).astype(np.int32)
    if len(np.unique(steps)) == 1:
        notes.append(
            f"{log.map_topic}: the map is the same all along: all of it counts as known from the start, and there is "
            "nothing to explore. Record while the robot maps"
        )
    seen = np.where(number == NEVER, NEVER_SEEN, np.append(steps, NEVER_SEEN)[np.minimum(number, len(steps))])
    # Where the robot drove it knew that it could.
    for step, cell in reversed(list(enumerate(path[start:]))):
        seen[cell] = step if seen[cell] == NEVER_SEEN else min(seen[cell], step)
    return seen.astype(np.int32), start


def _letters(places: Places, grid: WorkingGrid, notes: list[str]) -> Int32[np.ndarray, "H W"]:
    """Letters of free cells; regions in what the log never saw are left out, with a note."""
    kept = []
    # A region that was never seen is no error: the drive may have ended before.
    for name, regions in places.propositions:
        seen = tuple(region for region in regions if region.covers(grid.seen, grid.frame).any())
        if len(seen) < len(regions):
            missing = next(region for region in regions if region not in seen)
            notes.append(
                f"{places.source}: {name}: {len(regions) - len(seen)} of {len(regions)} regions lie in what the log "
                f"never saw, and are nowhere: {missing}"
            )
        kept.append((name, seen))
    # Not only what the robot could reach: places may be seen across a gap.
    return place_letters(replace(places, propositions=tuple(kept)), grid.free, grid.frame)
