"""From a raw ROS map to a grid on which a robot can move.

A raw map does not describe a closed building: pixels are free that no robot reached, and free space touches unknown
space without a wall between. `clean_map` therefore

1. takes what is unknown, and all beyond the image, for an obstacle;
2. inflates obstacles by the robot's radius (between centres of pixels);
3. resamples to the working resolution: a cell is an obstacle if it shares area with any obstacle pixel, so that no wall
   is lost, however thin; a passage of width w keeps at least ``floor((w - 2 radius) / resolution) - 1`` free cells;
4. keeps what is connected with the start (8-connected without corner cutting, which is the same as 4-connected), or the
   largest such component;
5. crops to it, with a ring of obstacles around.

Steps 2 and 3 can close a doorway, and on the map itself a building may fall into parts that nothing joins. What step 4
drops is named, with its area and its cause: in ``CleanMap.cut_off``, and by a warning where a world is made of the map.
"""

import enum
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, Shaped
from scipy import ndimage

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.occupancy_map import OccupancyMap
from potlp_jax.environments.ros.places import Point, component_labels, nearest_free
from potlp_jax.environments.ros.working_grid import choose_cell
from potlp_jax.errors import MapError, MapWarning

CUT_OFF_AREA = 2.0
"""Square metres of free cells from which on a part that is cut off counts as a room, not as a niche."""


@dataclass(frozen=True)
class FreeArea:
    """Free space in square metres: on the map, and what each step of cleaning leaves of it.

    Attributes:
        mapped: what the thresholds call free.
        inflated: where a robot's centre can be.
        resampled: cells without any obstacle.
        reachable: cells connected with the start, or the largest component.
    """

    mapped: float
    inflated: float
    resampled: float
    reachable: float


class Cause(enum.StrEnum):
    """Why a part of the building cannot be reached."""

    MAP = "map"
    """No free pixels join it with the rest."""
    RADIUS = "radius"
    """The robot is too wide for what joins it."""
    CELLS = "cells"
    """The robot fits, and the working grid closes the passage."""


@dataclass(frozen=True)
class CutOff:
    """A part of the building that the robot fits into and does not reach.

    Attributes:
        at: metres (x, y) of one of its free cells, near its middle.
        area: of its free cells, in square metres.
        cause: why it is not reached.
    """

    at: Point
    area: float
    cause: Cause

    def __str__(self) -> str:
        return f"{self.area:.1f} m2 at [{self.at[0]:.2f}, {self.at[1]:.2f}]"


@dataclass(frozen=True, eq=False)
class CleanMap:
    """Cells that the robot can reach, all others being obstacles, and where they lie.

    Attributes:
        free: the cells that can be reached.
        frame: metres to cells.
        area: what cleaning left of the map's free space.
        cut_off: parts of `CUT_OFF_AREA` or more that are not reached, the largest first.
        lost: the cells of these parts, on the grid before it was cropped.
        whole: metres to cells of ``lost``.
    """

    free: Bool[np.ndarray, "H W"]
    frame: GridFrame
    area: FreeArea
    cut_off: tuple[CutOff, ...]
    lost: Bool[np.ndarray, "h w"]
    whole: GridFrame


def clean_map(
    image_map: OccupancyMap,
    resolution: float | None = None,
    radius: float = 0.1,
    start: Point | None = None,
    source: str = "start",
) -> CleanMap:
    """The grid on which a robot of this radius can move, as the module describes.

    Args:
        image_map: the map as published.
        resolution: size of a working cell in metres; None: as `working_grid.choose_cell` does.
        radius: the robot's radius in metres.
        start: metres (x, y) whose component is kept; None: the largest.
        source: the file that gives the start, for messages.

    Returns:
        The cells that can be reached, where they lie, and what was lost on the way.

    Raises:
        MapError: the resolution is finer than the map's, a cell larger than the map, nothing is left free, or the start
            lies outside or is blocked.

    Warns:
        MapWarning: the cells that were chosen are larger than usual.
    """
    # Exact fractions: a cell of 0.2 m must be 4 pixels of 0.05 m, not 4.000000000000001.
    file, pixel = image_map.settings.file, image_map.settings.resolution
    grown = _exact(file, "radius", radius)
    if resolution is None:
        resolution = float(choose_cell(file, image_map.free.shape, pixel, grown))
    ratio = _exact(file, "resolution", resolution) / pixel
    # Finer cells would invent detail that the map does not have.
    if ratio < 1:
        raise MapError(file, "resolution", f"{resolution} m a cell is finer than the map's {float(pixel)} m a pixel")
    if ratio > max(image_map.free.shape):
        rows, columns = (f"{float(count * pixel):g}" for count in image_map.free.shape)
        raise MapError(file, "resolution", f"{resolution} m a cell is more than the map has, {rows} m by {columns} m")
    inflated = ~inflate(~image_map.free, grown / pixel)
    free = ~resample(~inflated, ratio)
    height, width = free.shape
    frame = GridFrame(height, width, float(ratio * pixel), *image_map.settings.origin)
    if not free.any():
        raise MapError(
            file, "", f"nothing is left free with cells of {resolution} m and a radius of {radius} m; make them smaller"
        )
    kept = _largest_component(free) if start is None else _component_of(start, free, frame, source)
    # The first two are counted in pixels, the others in cells.
    area = FreeArea(
        *(float(pixels.sum()) * float(pixel) ** 2 for pixels in (image_map.free, inflated)),
        *(float(cells.sum()) * frame.resolution**2 for cells in (free, kept)),
    )
    lost = free & ~kept
    causes = {
        Cause.CELLS: (reached := _joined_cells(inflated, image_map.frame, kept, frame)),
        Cause.RADIUS: (joined := _joined_cells(image_map.free, image_map.frame, kept, frame)) & ~reached,
        Cause.MAP: ~joined,
    }
    parts = [part for cause, where in causes.items() for part in _parts(lost & where, cause, frame)]
    parts.sort(key=lambda part: -part[0].area)
    all_lost = np.any([cells for _, cells in parts], axis=0) if parts else np.zeros_like(lost)
    return _crop(kept, frame, area, tuple(part for part, _ in parts), all_lost)


def _exact(file: Path, field: str, number: float) -> Fraction:
    if not np.isfinite(number) or number < 0:
        raise MapError(file, field, f"{number} is not a finite number of metres, 0 or more")
    # By its shortest text: 0.1 means one tenth, not the nearest binary fraction.
    return Fraction(str(number))


def inflate(blocked: Bool[np.ndarray, "H W"], pixels: Fraction) -> Bool[np.ndarray, "H W"]:
    """Obstacles and all whose centre is within a radius, in pixels, of an obstacle's centre."""
    # Padded, because what is beyond the image counts as an obstacle, too.
    distance = np.asarray(ndimage.distance_transform_edt(~np.pad(blocked, 1, constant_values=True)))[1:-1, 1:-1]
    # Squared distances between centres are integers, so that the comparison can be exact.
    return np.rint(distance**2) <= int(pixels * pixels)


def resample(
    pixels: Shaped[np.ndarray, "H W"], ratio: Fraction, reduce: np.ufunc = np.logical_or, beyond: bool | int = True
) -> Shaped[np.ndarray, "h w"]:
    """Cells of several pixels, from the lower left corner on.

    Args:
        pixels: row 0 at the top.
        ratio: pixels per cell, along each side.
        reduce: makes a cell of all pixels that share area with it.
        beyond: what every pixel beyond the image is.

    Returns:
        The cells, row 0 at the top. By default a cell is True (blocked) if one of its pixels is, or is missing.
    """
    # Row 0 is the top of the map, and cells are counted from the bottom.
    upwards = _reduce_each(pixels[::-1], ratio, reduce, beyond)[::-1]
    return _reduce_each(upwards.T, ratio, reduce, beyond).T


def _reduce_each(
    pixels: Shaped[np.ndarray, "H W"], ratio: Fraction, reduce: np.ufunc, beyond: bool | int
) -> Shaped[np.ndarray, "h W"]:
    # Rounded up: a last cell that is only partly in the image counts.
    count = -(-len(pixels) // ratio)
    spans = [(int(cell * ratio), int(-(-(cell + 1) * ratio // 1))) for cell in range(count)]
    # A last cell may reach over the image's edge.
    padded = np.pad(pixels, ((0, spans[-1][1] + 1 - len(pixels)), (0, 0)), constant_values=beyond)
    # `reduceat` reduces between consecutive indices; every other result spans one cell.
    return reduce.reduceat(padded, np.array(spans).ravel(), axis=0)[::2]


def _largest_component(free: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    # Entry 0 counts what is not free.
    labels = component_labels(free)
    return labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])


def _component_of(
    start: Point, free: Bool[np.ndarray, "H W"], frame: GridFrame, source: str
) -> Bool[np.ndarray, "H W"]:
    # A start in a wall is a mistake in the file: the nearest free cell is named, not taken.
    cell = frame.metres_to_cell(*start)
    inside = frame.contains(*cell)
    if not inside or not free[cell]:
        x, y = nearest_free(start, free, frame)
        why = (
            "is blocked: it lies in or too near an obstacle, or in unknown space" if inside else "is outside of the map"
        )
        raise MapError(
            source, "start", f"[{start[0]:g}, {start[1]:g}] {why}; the nearest free cell is at [{x:.2f}, {y:.2f}]"
        )
    labels = component_labels(free)
    return labels == labels[cell]


def _joined_cells(
    passable: Bool[np.ndarray, "H W"], pixels: GridFrame, kept: Bool[np.ndarray, "h w"], frame: GridFrame
) -> Bool[np.ndarray, "h w"]:
    """Cells whose pixels are connected with those of the cells that are kept, through ``passable`` pixels."""
    numbers = component_labels(passable)[_pixels_of(frame, pixels)]
    return numbers == numbers[tuple(np.argwhere(kept)[0])]


def _parts(
    lost: Bool[np.ndarray, "h w"], cause: Cause, frame: GridFrame
) -> list[tuple[CutOff, Bool[np.ndarray, "h w"]]]:
    """The components of lost cells that are no niches, and the cells of each."""
    labels = component_labels(lost)
    sizes = np.bincount(labels.ravel())[1:] * frame.resolution**2
    found = [(float(sizes[index]), labels == 1 + index) for index in np.flatnonzero(sizes >= CUT_OFF_AREA).tolist()]
    return [(CutOff(_middle(cells, frame), area, cause), cells) for area, cells in found]


def _pixels_of(frame: GridFrame, pixels: GridFrame) -> tuple[Int[np.ndarray, "h 1"], Int[np.ndarray, "1 w"]]:
    """Row and column of the pixel at every cell's centre, or of the nearest one where the cell lies beyond the image.

    Both grids have the same lower left corner.
    """
    # Rows count from the top in both grids, so heights are compared from the bottom, where both begin.
    ratio = frame.resolution / pixels.resolution
    up = ((frame.height - np.arange(frame.height) - 0.5) * ratio).astype(int)
    across = ((np.arange(frame.width) + 0.5) * ratio).astype(int)
    rows = pixels.height - 1 - np.minimum(up, pixels.height - 1)
    return rows[:, None], np.minimum(across, pixels.width - 1)[None, :]


def _middle(part: Bool[np.ndarray, "h w"], frame: GridFrame) -> Point:
    """Centre of the part's cell that is nearest to its centroid, in metres."""
    # The centroid of a part that is bent around a corner may lie outside of it.
    cells = np.argwhere(part)
    row, col = cells[np.argmin(np.linalg.norm(cells - cells.mean(axis=0, keepdims=True), axis=1))].tolist()
    return frame.cell_to_metres(row, col)


def _crop(
    kept: Bool[np.ndarray, "H W"],
    frame: GridFrame,
    area: FreeArea,
    cut_off: tuple[CutOff, ...],
    lost: Bool[np.ndarray, "H W"],
) -> CleanMap:
    rows, cols = np.flatnonzero(kept.any(axis=1)), np.flatnonzero(kept.any(axis=0))
    # All kept cells, and one ring of obstacles: sensors and sweeps rely on a closed border.
    content = kept[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    free = np.pad(content, 1)
    cropped = frame.window(int(rows[0]) - 1, int(cols[0]) - 1, *free.shape)
    return CleanMap(free=free, frame=cropped, area=area, cut_off=cut_off, lost=lost, whole=frame)


CUT_OFF_NAMED = 3
"""Parts that a warning names; `CleanMap.cut_off` has all."""


def warn_of_cut_off(file: str | Path, clean: CleanMap, radius: float) -> None:
    """Say what of a map cannot be reached by a robot of this radius, one MapWarning for each cause."""
    remarks = {
        Cause.MAP: "field start: on the map itself no free space joins {parts} with the rest, {total:.0f} of the "
        "{free:.0f} m2 in which a robot fits; open what joins them in the image, or give a start in the part you mean",
        Cause.RADIUS: f"radius: passages are too narrow for a robot of radius {radius} m, and cut off {{parts}}; "
        "use a smaller radius to keep them",
        Cause.CELLS: f"resolution: cells of {clean.frame.resolution} m close passages into which a robot of radius "
        f"{radius} m fits, and cut off {{parts}}; use smaller cells to keep them",
    }
    for cause, remark in remarks.items():
        parts = [part for part in clean.cut_off if part.cause is cause]
        if parts:
            total, free = sum(part.area for part in parts), clean.area.resampled
            text = remark.format(parts=_named(parts), total=total, free=free)
            warnings.warn(f"{file}: {text}", MapWarning, stacklevel=3)


def _named(parts: Sequence[CutOff]) -> str:
    rest = len(parts) - CUT_OFF_NAMED
    return ", ".join(map(str, parts[:CUT_OFF_NAMED])) + (f" and {rest} more" if rest > 0 else "")
