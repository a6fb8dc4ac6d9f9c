"""Maps that grow, shift, turn or change their resolution, brought onto one grid that never moves.

The lattice has the axes of the first map and cells of the planner's size. Each map is laid on it by the centres of its
pixels: a cell is free where every pixel in it is, after obstacles grew by the robot's radius, and an obstacle where one
is. A cell into which no pixel's centre falls, as where pixels are larger or turned, is what the pixel at its own centre
says. For maps whose origin does not shift by parts of a pixel this is what logs make of them (``logs.working_grid``).

The planner gets a window of the lattice. Its shape is one of few (``bucket``) and larger than what is known, so that
nothing is compiled again while the map grows within it.
"""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from potlp_jax.environments.ros.cleaning import inflate
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.places import Disc, Region
from potlp_jax.errors import RobotError
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.moves import Cell

MARGIN: int = 8
"""Cells around what is known that a new window has at least, so that the next scan does not outgrow it."""

LARGEST: int = 4096
"""Rows or columns of a window, at most: beyond that a map is an error."""

_SMALL: int = 10_000
"""Cells of a box around a region, at most, for it to be asked whether it is too small."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A map as a robot published it, row 0 on top: -1 unknown, otherwise occupancy in percent."""

    frame: GridFrame
    occupancy: Int8[np.ndarray, "H W"]


@dataclass(frozen=True)
class LatticeConfig:
    """Metres a cell, the robot's radius, and the thresholds in percent."""

    resolution: float
    radius: float
    free: int
    occupied: int


@dataclass(frozen=True)
class Window:
    """A part of the lattice: its first row and column, and how many there are."""

    top: int
    left: int
    height: int
    width: int

    def holds(self, other: "Window") -> bool:
        """Whether another window lies within this one."""
        return (
            self.top <= other.top
            and self.left <= other.left
            and other.top + other.height <= self.top + self.height
            and other.left + other.width <= self.left + self.width
        )

    def joined(self, other: "Window") -> "Window":
        """The smallest window that holds both."""
        top, left = min(self.top, other.top), min(self.left, other.left)
        bottom = max(self.top + self.height, other.top + other.height)
        right = max(self.left + self.width, other.left + other.width)
        return Window(top, left, bottom - top, right - left)


def bucket(size: int) -> int:
    """The smallest of 32, 48, 64, 96, 128, 192, ... that is not below a size. Raises RobotError beyond ``LARGEST``."""
    if size > LARGEST:
        raise RobotError(
            f"the map needs {size} rows or columns, more than {LARGEST}: make cells larger, or look at the map's origin"
        )
    power = max(32, 1 << (size - 1).bit_length())
    return power * 3 // 4 if power > 32 and size <= power * 3 // 4 else power


class Lattice:
    """Where all maps of a drive are laid, anchored at the first one."""

    def __init__(self, first: GridFrame, config: LatticeConfig) -> None:
        if config.resolution < first.resolution * (1 - 1e-6):
            raise RobotError(
                f"cells of {config.resolution:g} m are finer than the map's, {first.resolution:g} m: give larger ones"
            )
        self._config = config
        # Row -1 lies above the anchor's corner: rows count downwards, as on all maps here.
        self._anchor = GridFrame(0, 0, config.resolution, first.x, first.y, first.yaw)
        self.window = Window(0, 0, 0, 0)

    @property
    def origin(self) -> Cell:
        """First row and column of the window."""
        return self.window.top, self.window.left

    @property
    def frame(self) -> GridFrame:
        """Where the window lies in the map's metres."""
        return self._anchor.window(*self.origin, self.window.height, self.window.width)

    def cell_of(self, x: float, y: float) -> Cell:
        """Row and column of the lattice at a point in the map's metres."""
        return self._anchor.metres_to_cell(x, y)

    def position_of(self, x: float, y: float) -> tuple[float, float]:
        """Rows and columns, with their parts, from the anchor; the centre of cell (0, 0) is at (0.5, 0.5)."""
        across, up = self._anchor.to_grid(np.array([[x, y]], dtype=np.float64))[0]
        return -float(up), float(across)

    def has_centre_in(self, region: Region) -> bool:
        """Whether a region covers a cell, were all of them free."""
        # A point's own cell counts, however small its radius is.
        if isinstance(region, Disc):
            return True
        rows, columns = zip(*(self.cell_of(x, y) for x, y in region.vertices), strict=True)
        height, width = max(rows) - min(rows) + 1, max(columns) - min(columns) + 1
        if height * width > _SMALL:
            return True
        frame = self._anchor.window(min(rows), min(columns), height, width)
        return bool(region.covers(np.ones((height, width), bool), frame).any())

    def lay(self, scan: Scan) -> Int8[np.ndarray, "H W"]:
        """A map on the window, which grows where it must: values of ``BeliefMap.cells``."""
        free = (scan.occupancy >= 0) & (scan.occupancy <= self._config.free)
        obstacle = scan.occupancy >= self._config.occupied
        # In pixels, as for maps from files: what is not free keeps the robot away, whatever it is.
        radius = Fraction(str(self._config.radius)) / Fraction(str(scan.frame.resolution))
        margin = math.ceil(radius) + 1
        blocked = inflate(np.pad(~free, margin, constant_values=True), radius)[margin:-margin, margin:-margin]
        grown = self._near(obstacle, radius)
        rows, columns = self._cells(_centres(scan.frame))
        self._grow(rows, columns)
        return self._values(scan, blocked, grown, rows - self.window.top, columns - self.window.left)

    def _values(
        self,
        scan: Scan,
        blocked: Bool[np.ndarray, "h w"],
        obstacle: Bool[np.ndarray, "h w"],
        rows: Int64[np.ndarray, "h w"],
        columns: Int64[np.ndarray, "h w"],
    ) -> Int8[np.ndarray, "H W"]:
        shape = (self.window.height, self.window.width)
        is_blocked, is_obstacle, hit = (np.zeros(shape, bool) for _ in range(3))
        is_blocked[rows[blocked], columns[blocked]] = True
        is_obstacle[rows[obstacle], columns[obstacle]] = True
        hit[rows, columns] = True
        # Larger or turned pixels leave cells without a centre in them.
        empty = np.argwhere(~hit)
        across, up = scan.frame.to_grid(self._points(empty)).T
        pixel_rows, pixel_columns = scan.frame.height - 1 - np.floor(up).astype(int), np.floor(across).astype(int)
        height, width = blocked.shape
        inside = (pixel_rows >= 0) & (pixel_rows < height) & (pixel_columns >= 0) & (pixel_columns < width)
        at, pixels = tuple(empty[inside].T), (pixel_rows[inside], pixel_columns[inside])
        is_blocked[at], is_obstacle[at], hit[at] = blocked[pixels], obstacle[pixels], True
        free = hit & ~is_blocked
        # In doubt a robot stays away: what is neither free nor an obstacle was not seen.
        cells = np.where(free, BeliefMap.FREE, np.where(is_obstacle, BeliefMap.OCCUPIED, BeliefMap.UNKNOWN))
        return cells.astype(np.int8)

    def _near(self, obstacle: Bool[np.ndarray, "h w"], radius: Fraction) -> Bool[np.ndarray, "h w"]:
        # What lies beyond the map is no obstacle, but unknown.
        margin = math.ceil(radius) + 1
        return inflate(np.pad(obstacle, margin), radius)[margin:-margin, margin:-margin] if obstacle.any() else obstacle

    def _cells(self, points: Float64[np.ndarray, "h w 2"]) -> tuple[Int64[np.ndarray, "h w"], Int64[np.ndarray, "h w"]]:
        height, width, _ = points.shape
        across, up = self._anchor.to_grid(points.reshape(-1, 2)).T
        rows, columns = -1 - np.floor(up).astype(np.int64), np.floor(across).astype(np.int64)
        return rows.reshape(height, width), columns.reshape(height, width)

    def _points(self, cells: Int64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Centres of cells of the window, in metres."""
        frame, resolution = self.frame, self._config.resolution
        across, up = (cells[:, 1] + 0.5) * resolution, (frame.height - cells[:, 0] - 0.5) * resolution
        cos, sin = math.cos(frame.yaw), math.sin(frame.yaw)
        return np.stack([frame.x + cos * across - sin * up, frame.y + sin * across + cos * up], axis=1)

    def _grow(self, rows: Int64[np.ndarray, "h w"], columns: Int64[np.ndarray, "h w"]) -> None:
        """Take another window where a map and a ring around it do not fit into the present one."""
        top, left = int(rows.min()) - 1, int(columns.min()) - 1
        needed = Window(top, left, int(rows.max()) + 2 - top, int(columns.max()) + 2 - left)
        if self.window.holds(needed):
            return
        needed = self.window.joined(needed) if self.window.height else needed
        height, width = bucket(needed.height + 2 * MARGIN), bucket(needed.width + 2 * MARGIN)
        # In the middle: nobody knows to which side a map will grow.
        self.window = Window(
            needed.top - (height - needed.height) // 2, needed.left - (width - needed.width) // 2, height, width
        )


def _centres(frame: GridFrame) -> Float64[np.ndarray, "h w 2"]:
    """Centres of a map's pixels in metres."""
    across = (np.arange(frame.width)[None, :] + 0.5) * frame.resolution
    up = (frame.height - 0.5 - np.arange(frame.height)[:, None]) * frame.resolution
    cos, sin = math.cos(frame.yaw), math.sin(frame.yaw)
    return np.stack([frame.x + cos * across - sin * up, frame.y + sin * across + cos * up], axis=2)
