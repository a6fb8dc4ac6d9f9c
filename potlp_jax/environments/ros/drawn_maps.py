"""Occupancy maps of buildings that are drawn by their walls: how walls become pixels, and outer walls are closed.

A plan in metres becomes an `OccupancyMap` like that of a ROS map, so that cleaning, labels, previews and worlds need no
second way. What is outside of the building is unknown.

Plans whose windows are gaps, as doors are, leak. `close_outer_walls` continues every wall that ends, for up to
`WIDEST_GAP` metres, where it meets another wall. With all these pieces in place, what is connected with the edge of
the picture is outside. Pieces beside it stay and close the outer walls; the others are doors within the building, and
are left out. What was closed is kept in ``OccupancyMap.closed`` and drawn by the preview: it is a guess, to be looked
at. Where a wall goes around the whole plan nothing is closed, and a yard within it belongs to the building.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Int32
from scipy import ndimage

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.map_settings import MapSettings
from potlp_jax.environments.ros.occupancy_map import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from potlp_jax.environments.ros.places import Places, Point, component_labels
from potlp_jax.environments.ros.working_grid import require_memory
from potlp_jax.errors import MapError

PIXEL = Fraction(1, 20)
"""Metres a pixel of a drawn map, as robots' own maps have."""

MOST_PIXELS = 1 << 24
"""Pixels of a drawn map; of a larger building the pixels are twice as large, or four times."""

WIDEST_GAP = 4.0
"""Metres of an outer wall that are missing, at most, where it is closed."""

MARGIN = 1.0
"""Metres around the outermost walls."""

_SUBPIXEL = 4
"""Bits of the fractions of a pixel in which corners are given to OpenCV."""


@dataclass(frozen=True)
class Wall:
    """A straight piece of a wall: its middle line in metres (x, y), and how thick it is."""

    start: Point
    end: Point
    thickness: float

    @property
    def corners(self) -> list[Point]:
        """The four corners of the wall."""
        along = np.subtract(self.end, self.start)
        length = math.hypot(*along)
        aside = np.array([-along[1], along[0]]) / length * self.thickness / 2 if length else np.zeros(2)
        ends = np.array([self.start, self.end], dtype=np.float64)
        return [(float(x), float(y)) for x, y in (ends[0] + aside, ends[1] + aside, ends[1] - aside, ends[0] - aside)]


def frame_around(file: Path, points: Sequence[Point]) -> GridFrame:
    """Pixels around all points, `PIXEL` metres large or, in large buildings, a power of two larger."""
    low, high = np.min(points, axis=0) - MARGIN, np.max(points, axis=0) + MARGIN
    pixel = PIXEL
    while math.prod(np.ceil((high - low) / float(pixel)).tolist()) > MOST_PIXELS:
        pixel *= 2
        if pixel > 1:
            raise MapError(file, "", f"measures {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} m: check the scale")
    width, height = (int(size) for size in np.ceil((high - low) / float(pixel)))
    require_memory(file, width, height)
    return GridFrame(height, width, float(pixel), float(low[0]), float(low[1]))


def draw_areas(areas: Sequence[Sequence[Point]], frame: GridFrame) -> Int32[np.ndarray, "H W"]:
    """The number, from 1, of the polygon that each pixel lies in, edges included (no wall is too thin); 0 elsewhere.

    Where polygons overlap, the last one has the pixel.
    """
    canvas = np.zeros((frame.height, frame.width), np.int32)
    for number, area in enumerate(areas, 1):
        across, up = frame.to_grid(np.array(area, dtype=np.float64)).T
        # OpenCV counts from the middle of the top left pixel.
        corners = np.stack([across - 0.5, frame.height - up - 0.5], axis=1) * (1 << _SUBPIXEL)
        cv2.fillPoly(canvas, [np.rint(corners).astype(np.int32)], (number,), shift=_SUBPIXEL)
    return canvas


def enclosed(walls: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Free pixels that are not connected with the edge of the picture."""
    labels = component_labels(~np.pad(walls, 1))
    return (~walls) & (labels != labels[0, 0])[1:-1, 1:-1]


def close_outer_walls(walls: Sequence[Wall], frame: GridFrame) -> tuple[Bool[np.ndarray, "H W"], ...]:
    """Closes gaps in outer walls, as the module describes.

    Args:
        walls: of the plan.
        frame: metres to pixels.

    Returns:
        The pixels of the walls, those by which gaps are closed, and the free ones within the building.
    """
    drawn = draw_areas([wall.corners for wall in walls], frame) > 0
    pieces = draw_areas([piece.corners for wall in walls for piece in _continued(wall, drawn, frame)], frame)
    pieces[drawn] = 0
    all_closed = drawn | (pieces > 0)
    outside = ~(all_closed | enclosed(all_closed))
    # Two pixels more on all sides: the outer half of a closed gap touches it.
    beside = np.asarray(ndimage.binary_dilation(outside, np.ones((5, 5), bool)), dtype=bool)
    closed = np.isin(pieces, np.setdiff1d(pieces[beside], 0))
    # Gaps within the building are open again.
    labels = component_labels(~(drawn | closed))
    return drawn, closed, (labels > 0) & ~np.isin(labels, np.unique(labels[outside]))


def _continued(wall: Wall, drawn: Bool[np.ndarray, "H W"], frame: GridFrame) -> list[Wall]:
    """From either end of a wall on, in its direction, to the next wall, where there is one near enough."""
    ends = np.array([wall.start, wall.end], dtype=np.float64)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    # Thicker than long: its direction is that of no wall.
    if length <= wall.thickness:
        return []
    found = []
    for end, other in (ends, ends[::-1]):
        direction = (end - other) / length
        steps = np.arange(1, round((WIDEST_GAP + wall.thickness) / frame.resolution) + 1) * frame.resolution
        points = end + (wall.thickness / 2 + steps)[:, None] * direction
        hit = _first_wall(points, drawn, frame)
        # A wall that goes on at once has no gap here.
        if hit is not None and hit > 1:
            found.append(Wall(_point(end), _point(points[hit]), wall.thickness))
    return found


def _first_wall(points: np.ndarray, drawn: Bool[np.ndarray, "H W"], frame: GridFrame) -> int | None:
    across, up = np.floor(frame.to_grid(points)).astype(int).T
    rows = frame.height - 1 - up
    inside = (rows >= 0) & (rows < frame.height) & (across >= 0) & (across < frame.width)
    walls = np.flatnonzero(drawn[rows[inside], across[inside]])
    return int(walls[0]) if walls.size else None


def _point(point: np.ndarray) -> Point:
    return float(point[0]), float(point[1])


def drawn_map(
    file: Path,
    free: Bool[np.ndarray, "H W"],
    occupied: Bool[np.ndarray, "H W"],
    frame: GridFrame,
    *,
    kind: str,
    closed: Bool[np.ndarray, "H W"] | None = None,
    places: Places | None = None,
) -> OccupancyMap:
    """A plan as a map.

    Args:
        file: of the plan.
        free, occupied: pixels; what is neither is unknown.
        frame: metres to pixels.
        kind: of file, for people.
        closed: obstacles that were added.
        places: that the plan names.

    Returns:
        The map, with what was closed and named kept beside it.

    Raises:
        MapError: nothing is free.
    """
    if not free.any():
        raise MapError(file, "", "no space is enclosed by its walls: nothing is inside of the building")
    # What thresholds would say of a picture, for readers of settings; a plan has no greys.
    settings = MapSettings(
        file=file,
        image=file,
        resolution=Fraction(str(frame.resolution)),
        origin=(frame.x, frame.y, frame.yaw),
        mode="trinary",
        negate=False,
        occupied_thresh=Fraction(65, 100),
        free_thresh=Fraction(196, 1000),
    )
    occupancy = np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.int8)
    return OccupancyMap(settings, occupancy, free, occupied, frame, kind=kind, closed=closed, places=places)
