"""A drive: what a log says about one run of a robot, in the planner's terms.

All maps of the log are laid on the grid of the final map, whatever their size, origin and resolution were. The final
map is taken for the truth: what it does not show is an obstacle in ``Drive.world``, and never observed. A cell counts
as known from the first map on that showed it. Its value is the final map's, so that a correction by the robot's own
mapping counts as seen from the start; how much was corrected is among the notes.

A working cell of several pixels is free where all its pixels are, after obstacles were grown by the robot's radius, and
known where all its pixels are. It is an obstacle where an obstacle's pixel, grown, lies in it, and known once one of
those is.
"""

import heapq
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64, Shaped, UInt8
from scipy import ndimage

from potlp_jax.environments.map_server import BOUNDARY_DECIMALS, GridFrame
from potlp_jax.environments.places import Places, component_labels, place_letters
from potlp_jax.environments.ros_map import inflate, resample
from potlp_jax.logs.errors import LogError
from potlp_jax.logs.log import SECOND, Log, MapMessage, Picture
from potlp_jax.logs.transforms import headings
from potlp_jax.records import NEVER_SEEN, belief_seen_by
from potlp_jax.world.equirectangular import from_equirectangular
from potlp_jax.world.frontiers import FrontierConfig, frontier_cells
from potlp_jax.world.grid import BeliefMap, World, make_world
from potlp_jax.world.panorama import CameraConfig

Cell = tuple[int, int]

RESOLUTION = 0.2
"""Metres a cell, unless the map is coarser or another is asked for: as for ``map:`` worlds."""

FARTHEST_SNAP = 2.0
"""Cells, beyond the robot's radius, from the nearest free cell at which a pose still counts as being in it."""

CORRECTED_SHARE = 0.02
"""Share of a map's known pixels that are otherwise in the final map, above which it is worth a note."""

_NEVER = np.iinfo(np.int32).max
"""Number of the map that first shows a cell which none does."""

_OPTICAL = ("_optical", "_optical_frame")


@dataclass(frozen=True)
class GridConfig:
    """The planner's grid: metres a cell (None: 0.2, or the map's where that is coarser), and the robot's radius, by
    which obstacles grow."""

    resolution: float | None = None
    radius: float = 0.1

    def __post_init__(self) -> None:
        numbers = [self.radius] if self.resolution is None else [self.radius, self.resolution]
        if not all(math.isfinite(number) and number >= 0 for number in numbers) or self.resolution == 0:
            raise LogError(f"resolution and radius are metres, the resolution above 0, found {self}")


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
        """Free cells beside what was never seen, in components that are large enough to be a way on."""
        truth = BeliefMap.revealed(self.world)
        cells = jnp.where(jnp.asarray(self.seen), truth.cells, jnp.int8(BeliefMap.UNKNOWN))
        edge = np.asarray(frontier_cells(replace(truth, cells=cells), ~self.world.occupied))
        labels = np.zeros(edge.shape, np.int32)
        ndimage.label(edge, np.ones((3, 3)), output=labels)
        return edge & (np.bincount(labels.ravel())[labels] >= FrontierConfig().min_size)


class Eyes:
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
        field = vertical_field(image.shape[1], image.shape[0], self._drive.log)
        return from_equirectangular(image, self._camera, self._drive.bearings[step], field)

    def _read(self, index: int) -> UInt8[np.ndarray, "h w 3"] | None:
        if index < self._index:
            self._stream, self._index = self._drive.log.read_pictures(), -1
        while self._index < index:
            self._index, self._picture = next(self._stream)
        return self._picture


def vertical_field(width: int, height: int, log: Log) -> float:
    """Angle from the lower to the upper edge of a picture, in radians.

    Raises:
        LogError: with square pixels it were more than a half circle.
    """
    if log.config.vertical_field is not None:
        return math.radians(log.config.vertical_field)
    field = 2 * math.pi * height / width
    if field > math.pi * (1 + 1e-9):
        raise LogError(
            f"{log.path}: {log.image_topic}: a picture of {width} x {height} pixels is not equirectangular with square "
            "pixels, for it would reach over more than a half circle: give the angle from its lower to its upper edge, "
            "--vertical-field DEGREES"
        )
    return min(field, math.pi)


def read_drive(log: Log, places: Places, config: GridConfig = GridConfig()) -> Drive:
    """The drive of a log, with the propositions where ``places`` puts them.

    Raises:
        LogError: there is no map, or no pose in its frame, or the robot was never on it.
        MapError: a region lies where the log shows no free cell.
    """
    notes = list(log.problems)
    grid = _WorkingGrid(_final_map(log), log, config)
    poses = _read_poses(log, notes)
    path, entered = _drive_path(poses, grid, log, config.radius, notes)
    letters = _letters(places, grid, notes)
    first_seen, start = _first_seen(log, grid, path, poses.times[entered], notes)
    path, times = path[start:], poses.times[entered][start:]
    pictures, bearings = _pictures(log, poses, path, times, grid.frame, notes)
    return Drive(
        log=log,
        world=make_world(~grid.free, letters, path[0], resolution=grid.frame.resolution),
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
    for kind, pixels, option in (
        ("nothing free", final.free(log.config), "--free"),
        ("no obstacle", final.obstacles(log.config), "--occupied"),
    ):
        if not pixels.any():
            values = ", ".join(map(str, np.unique(final.occupancy)[:8]))
            raise LogError(
                f"{log.path}: {log.map_topic}: the thresholds leave {kind} in the last map, whose values are {values}; "
                f"give {option} PERCENT"
            )
    return final


class _WorkingGrid:
    """The final map on working cells, and how earlier maps are laid on it.

    ``free`` and ``obstacle`` exclude each other; cells that are neither were never seen.
    """

    def __init__(self, final: MapMessage, log: Log, config: GridConfig) -> None:
        self._final, self._log = final, log
        pixel = Fraction(str(final.frame.resolution))
        wanted = (
            max(Fraction(str(RESOLUTION)), pixel) if config.resolution is None else Fraction(str(config.resolution))
        )
        if wanted < pixel:
            raise LogError(
                f"{log.path}: cells of {float(wanted):g} m are finer than the map's, {float(pixel):g} m: give a larger "
                "--resolution"
            )
        self._ratio, self._radius = wanted / pixel, Fraction(str(config.radius)) / pixel
        # As many pixels as whole cells take, and enough that nothing from beyond the map grows into it.
        self._margin = self._ratio.numerator * math.ceil((self._radius + 1) / self._ratio.numerator)
        self._free_pixels, self._obstacle_pixels = final.free(log.config), final.obstacles(log.config)
        free = ~self._cells(self._grown(~self._free_pixels, beyond=True), np.logical_or, beyond=True)
        obstacle = self._cells(self._grown(self._obstacle_pixels, beyond=False), np.logical_or, beyond=False)
        height, width = free.shape
        frame = GridFrame(height, width, float(wanted), final.frame.x, final.frame.y, final.frame.yaw)
        # Outside of a grid is unobserved: its edge would be a frontier for ever.
        self._ring = bool(free[0].any() or free[-1].any() or free[:, 0].any() or free[:, -1].any())
        self.frame = frame.window(-1, -1, frame.height + 2, frame.width + 2) if self._ring else frame
        self.free, self.obstacle = self._ringed(free, False), self._ringed(obstacle & ~free, False)
        if not self.free.any():
            raise LogError(
                f"{log.path}: nothing is left free with cells of {float(wanted):g} m and a radius of "
                f"{config.radius:g} m; make them smaller"
            )

    @property
    def seen(self) -> Bool[np.ndarray, "H W"]:
        """What the final map knows."""
        return self.free | self.obstacle

    def first_known(self, maps: Iterable[MapMessage]) -> tuple[Int32[np.ndarray, "H W"], list[MapMessage], float]:
        """Number of the first map that shows each cell (``_NEVER``: none does), and the maps without their pixels.

        Third, the largest share of a map's known pixels that the final map shows otherwise.
        """
        first = np.full(self._free_pixels.shape, _NEVER, np.int32)
        heads: list[MapMessage] = []
        most = 0.0
        for number, earlier in enumerate(maps):
            free = self._on_final(earlier.free(self._log.config), earlier)
            obstacles = self._on_final(earlier.obstacles(self._log.config), earlier)
            known = free | obstacles
            first[known & (first == _NEVER)] = number
            changed = (free & self._obstacle_pixels) | (obstacles & self._free_pixels)
            most = max(most, float(changed.sum() / max(known.sum(), 1)))
            heads.append(replace(earlier, occupancy=earlier.occupancy[:0]))
        as_free = self._cells(np.pad(first, self._margin, constant_values=_NEVER), np.maximum, beyond=_NEVER)
        walls = np.where(self._obstacle_pixels, first, _NEVER)
        near = ndimage.minimum_filter(
            np.pad(walls, self._margin, constant_values=_NEVER), footprint=self._disc(), mode="nearest"
        )
        as_obstacle = self._cells(near, np.minimum, beyond=_NEVER)
        known_at = np.where(self.free, self._ringed(as_free, _NEVER), self._ringed(as_obstacle, _NEVER))
        return np.where(self.seen, known_at, _NEVER).astype(np.int32), heads, most

    def _disc(self) -> Bool[np.ndarray, "side side"]:
        """The pixels within the robot's radius of a pixel."""
        reach = int(self._radius)
        offset = np.arange(-reach, reach + 1)
        return offset[:, None] ** 2 + offset[None, :] ** 2 <= int(self._radius * self._radius)

    def _grown(self, pixels: Bool[np.ndarray, "h w"], beyond: bool) -> Bool[np.ndarray, "h2 w2"]:
        """With a margin around the map, all within the robot's radius of the pixels."""
        return inflate(np.pad(pixels, self._margin, constant_values=beyond), self._radius)

    def _cells(
        self, pixels: Shaped[np.ndarray, "h2 w2"], reduce: np.ufunc, beyond: bool | int
    ) -> Shaped[np.ndarray, "H W"]:
        """Working cells of the map, from pixels with its margin."""
        coarse = resample(pixels, self._ratio, reduce, beyond)
        margin = int(self._margin / self._ratio)
        height, width = (int(-(-size // self._ratio)) for size in self._free_pixels.shape)
        return coarse[len(coarse) - margin - height : len(coarse) - margin, margin : margin + width]

    def _on_final(self, pixels: Bool[np.ndarray, "h w"], earlier: MapMessage) -> Bool[np.ndarray, "H W"]:
        """Pixels of an earlier map, at the centres of the final map's pixels."""
        mine, its = self._final.frame, earlier.frame
        if abs(math.remainder(mine.yaw - its.yaw, 2 * math.pi)) > 1e-6:
            raise LogError(
                f"{self._log.path}: {self._log.map_topic}: the maps are turned against each other, by {its.yaw:g} and "
                f"{mine.yaw:g} radians: give a log of one mapping session"
            )
        if earlier.frame_id != self._final.frame_id:
            raise LogError(
                f"{self._log.path}: {self._log.map_topic}: the maps are in several frames, {earlier.frame_id!r} and "
                f"{self._final.frame_id!r}: choose a topic with one, --map-topic"
            )
        across, up = its.to_grid(np.array([mine.cell_to_metres(mine.height - 1, 0)]))[0]
        scale = mine.resolution / its.resolution
        columns = np.floor(np.round(across + scale * np.arange(mine.width), BOUNDARY_DECIMALS)).astype(int)
        from_below = np.floor(np.round(up + scale * np.arange(mine.height), BOUNDARY_DECIMALS)).astype(int)
        rows = its.height - 1 - from_below[::-1]
        inside = ((rows >= 0) & (rows < its.height))[:, None] & ((columns >= 0) & (columns < its.width))[None, :]
        taken = pixels[np.clip(rows, 0, its.height - 1)][:, np.clip(columns, 0, its.width - 1)]
        return taken & inside

    def _ringed(self, cells: Shaped[np.ndarray, "h w"], beyond: bool | int) -> Shaped[np.ndarray, "H W"]:
        return np.pad(cells, 1, constant_values=beyond) if self._ring else cells


@dataclass(frozen=True, eq=False)
class _Poses:
    """Where the robot was, in metres in the frame of the map."""

    times: Int64[np.ndarray, "N"]
    points: Float64[np.ndarray, "N 2"]


def _read_poses(log: Log, notes: list[str]) -> _Poses:
    base, frame = log.base_frame, log.map_frame
    assert frame is not None
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
    gaps = np.diff(times) / SECOND
    long = gaps[gaps > log.config.longest_gap]
    if len(long):
        notes.append(
            f"pose: {len(long)} gaps of more than {log.config.longest_gap:g} s, the longest of {long.max():.1f} s; the "
            "way across is taken to be the shortest in the final map"
        )
    return _Poses(times, log.transforms.poses(frame, base, times)[:, :2, 3])


def _drive_path(
    poses: _Poses, grid: _WorkingGrid, log: Log, radius: float, notes: list[str]
) -> tuple[list[Cell], Int64[np.ndarray, "N"]]:
    """Cells entered, and for each the number of the pose by which it was."""
    frame = grid.frame
    across, up = frame.to_grid(poses.points).T
    inside = (across >= 0) & (across < frame.width) & (up >= 0) & (up < frame.height)
    rows, columns = frame.height - 1 - np.floor(up).astype(int), np.floor(across).astype(int)
    labels = component_labels(grid.free)
    reached = labels[rows[inside], columns[inside]]
    on_free = reached[reached > 0]
    if not len(on_free):
        raise LogError(
            f"{log.path}: none of {len(inside)} poses is in free space of the last map: is it of the same run, and "
            f"{log.base_frame!r} the robot's frame?"
        )
    main = labels == np.bincount(on_free).argmax()
    found = ndimage.distance_transform_edt(~main, return_indices=True)
    assert found is not None
    distance, nearest = found
    numbers = np.flatnonzero(inside)
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
        if path and cell == path[-1]:
            continue
        way = [cell] if not path else _way(main, path[-1], cell)
        path += way
        entered += [number] * len(way)
    return path, np.array(entered)


def _way(free: Bool[np.ndarray, "H W"], start: Cell, goal: Cell) -> list[Cell]:
    """Cells of a shortest way, the start left out: 8-connected, corners not cut. Both are in one component."""
    best, came_from = {start: 0.0}, {}
    queue = [(0.0, start)]
    while queue:
        _, cell = heapq.heappop(queue)
        if cell == goal:
            break
        for there, length in _moves(free, cell):
            cost = best[cell] + length
            if cost < best.get(there, math.inf):
                best[there], came_from[there] = cost, cell
                heapq.heappush(queue, (cost + math.dist(there, goal), there))
    way = [goal]
    while way[-1] != start:
        way.append(came_from[way[-1]])
    return way[-2::-1]


def _moves(free: Bool[np.ndarray, "H W"], cell: Cell) -> Iterator[tuple[Cell, float]]:
    """Neighbours, and how far they are. The outermost cells are never free."""
    row, column = cell
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            open_sides = free[row + down, column] and free[row, column + right]
            if (down or right) and free[row + down, column + right] and open_sides:
                yield (row + down, column + right), math.hypot(down, right)


def _first_seen(
    log: Log, grid: _WorkingGrid, path: list[Cell], times: Int64[np.ndarray, "N"], notes: list[str]
) -> tuple[Int32[np.ndarray, "H W"], int]:
    """Index into the path from its ``start`` on, the second value, at which each cell was first known."""
    number, heads, corrected = grid.first_known(log.read_maps())
    if corrected > CORRECTED_SHARE:
        notes.append(
            f"{log.map_topic}: up to {corrected:.1%} of what a map showed is otherwise in the last one, which is taken "
            "for what was seen from the start"
        )
    received = np.array([head.time for head in heads])
    start = max(int(np.searchsorted(times, received.min(), side="right")) - 1, 0)
    steps = np.clip(np.searchsorted(times[start:], received, side="right") - 1, 0, None).astype(np.int32)
    if len(np.unique(steps)) == 1:
        notes.append(
            f"{log.map_topic}: the map is the same all along: all of it counts as known from the start, and there is "
            "nothing to explore. Record while the robot maps"
        )
    seen = np.where(number == _NEVER, NEVER_SEEN, np.append(steps, NEVER_SEEN)[np.minimum(number, len(steps))])
    # Where the robot drove it knew that it could.
    for step, cell in reversed(list(enumerate(path[start:]))):
        seen[cell] = step if seen[cell] == NEVER_SEEN else min(seen[cell], step)
    return seen.astype(np.int32), start


def _pictures(
    log: Log, poses: _Poses, path: list[Cell], times: Int64[np.ndarray, "N"], frame: GridFrame, notes: list[str]
) -> tuple[dict[int, Picture], dict[int, float]]:
    """The picture taken nearest to the middle of each cell of the path, and where its middle looks."""
    taken = [picture for picture in log.pictures if times[0] <= picture.time <= poses.times[-1]]
    if not taken:
        notes.append("no picture: policies that look, and datasets, need a topic of type sensor_msgs/CompressedImage")
        return {}, {}
    moments = np.array([picture.time for picture in taken])
    gap = int(log.config.longest_gap * SECOND)
    after = np.clip(np.searchsorted(poses.times, moments), 1, max(len(poses.times) - 1, 1))
    around = np.stack([poses.times[after - 1], poses.times[np.minimum(after, len(poses.times) - 1)]])
    is_near = np.min(np.abs(around - moments), axis=0) <= gap
    if not is_near.all():
        notes.append(f"{log.image_topic}: {np.sum(~is_near)} of {len(taken)} pictures are passed over: no pose is near")
    assert log.map_frame is not None
    assert log.base_frame is not None
    base = log.transforms.poses(log.map_frame, log.base_frame, moments)
    looks = _headings(log, taken, moments, base, notes)
    steps = np.searchsorted(times, moments, side="right") - 1
    pictures: dict[int, Picture] = {}
    bearings: dict[int, float] = {}
    nearest: dict[int, float] = {}
    for index in np.flatnonzero(is_near):
        step = int(steps[index])
        distance = math.dist(frame.cell_to_metres(*path[step]), base[index, :2, 3])
        if distance < nearest.get(step, math.inf):
            nearest[step], pictures[step] = distance, taken[index]
            # Headings grow counter-clockwise with y upward, bearings clockwise with rows downward.
            bearings[step] = -(float(looks[index]) - frame.yaw)
    return pictures, bearings


def _headings(
    log: Log,
    pictures: list[Picture],
    times: Int64[np.ndarray, "N"],
    base: Float64[np.ndarray, "N 4 4"],
    notes: list[str],
) -> Float64[np.ndarray, "N"]:
    """Where the middle of each picture looks, in the frame of the map."""
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


def _letters(places: Places, grid: _WorkingGrid, notes: list[str]) -> Int32[np.ndarray, "H W"]:
    """Letters of free cells; regions in what the log never saw are left out, with a note."""
    kept = []
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
