"""A picture of a map in metres: what the robot can reach of it, and where the propositions are."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D, blended_transform_factory

from potlp_jax.environments.ros.cleaning import CleanMap
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.occupancy_map import OccupancyMap
from potlp_jax.environments.ros.places import component_labels
from potlp_jax.environments.ros.ros_map import RosMap
from potlp_jax.environments.ros.survey import SPECK
from potlp_jax.view.labels import AreaLabel, draw_labels, place_labels
from potlp_jax.view.layers import area_handles, legend_columns
from potlp_jax.view.style import CHOSEN, FAINT, INK, area_colour, new_figure, rgb
from potlp_jax.world.grid import World

# Reachable space is of a light blue, which neither states (dark) nor areas (warm) have.
OBSTACLE, UNREACHED, UNKNOWN, REACHED = "#3A3A3A", "#FFFFFF", "#D2D2D2", "#D7E8F7"
CUT_OFF: str = "#F6C9DC"
"""Pink: parts as large as a room in which a robot fits, and which it does not reach."""
LONGEST: float = 10.0
"""Inches of the longer side of the map."""

RASTER: int = 1050
"""Pixels of the longer side of the raster: below those of the picture, so that no thin wall is lost in drawing."""

# Metres: 1, 2 and 5 of each decade, as cartographers draw them.
SCALE_BARS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500)


def draw_map(image_map: OccupancyMap, clean: CleanMap, title: str) -> Figure:
    """The map and its cleaned grid, without propositions.

    Args:
        image_map: the map as it was read.
        clean: what the planner makes of it.
        title: stands above.

    Returns:
        The figure, in metres.
    """
    figure, axes = _plan(image_map, clean, title, [])
    _finish(figure, axes, clean, _closed_handles(image_map))
    return figure


def draw_places(family: RosMap, world: World, title: str) -> Figure:
    """The same with the propositions of a family of worlds, and the start if its places fix one.

    Args:
        family: the map, its cleaned grid and its places.
        world: one of its worlds, whose labels are drawn.
        title: stands above.

    Returns:
        The figure, in metres.
    """
    present: list[Patch | Line2D] = [*area_handles(family.propositions, world)]
    figure, axes = _plan(family.image_map, family.clean, title, _letter_raster(world, len(family.propositions)))
    scale = axes.bbox.width / figure.dpi / float(np.ptp(axes.get_xlim()))
    draw_labels(axes, _labels_in_metres(family, world, scale * family.clean.frame.resolution))
    if family.places.start is not None:
        axes.plot(*family.places.start, "o", ms=9, mfc="white", mec=INK, mew=1.8, zorder=6)
        present.append(Line2D([], [], marker="o", ls="", ms=8, mfc="white", mec=INK, mew=1.6, label="start"))
    _finish(figure, axes, family.clean, [*_closed_handles(family.image_map), *present])
    return figure


def _closed_handles(image_map: OccupancyMap) -> list[Patch | Line2D]:
    """What the legend says of closed outer walls."""
    closed = image_map.closed
    return [] if closed is None or not closed.any() else [Patch(facecolor=CHOSEN, label="gap in an outer wall, closed")]


def _plan(
    image_map: OccupancyMap, clean: CleanMap, title: str, letters: Sequence[UInt8[np.ndarray, "H W 4"]]
) -> tuple[Figure, Axes]:
    """Figure and axes in metres, with the rasters of map, grid and letters."""
    (left, right), (bottom, top) = _limits(image_map, clean)
    scale = LONGEST / max(right - left, top - bottom)
    width, height = (right - left) * scale, (top - bottom) * scale
    # However narrow the map, its title and its legend must fit.
    total_width, total_height = max(width, 4.6) + 0.95, height + 1.75
    figure = new_figure(total_width, total_height)
    axes = figure.add_axes((0.7 / total_width, 1.1 / total_height, width / total_width, height / total_height))
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", facecolor=UNKNOWN)
    # Rasters that reach beyond the limits must not widen them.
    axes.set_autoscale_on(False)
    # Walls above cells: a cell is free only if all of its pixels are, but its square reaches over their edges.
    block = _block(image_map.frame)
    _show(axes, _map_raster(image_map, block), image_map.frame, zorder=0, block=block)
    _show(axes, _painted(clean.lost, CUT_OFF), clean.whole, zorder=1)
    for raster in (_painted(clean.free, REACHED), *letters):
        _show(axes, raster, clean.frame, zorder=1)
    _show(axes, _wall_raster(image_map, block), image_map.frame, zorder=2, block=block)
    if image_map.closed is not None:
        _show(axes, _painted(_any_in_blocks(image_map.closed, block), CHOSEN), image_map.frame, zorder=3, block=block)
    axes.set_xlabel("x (m)", size=9)
    axes.set_ylabel("y (m)", size=9)
    axes.tick_params(labelsize=8)
    figure.text(0.7 / total_width, 1 - 0.22 / total_height, title, size=11, weight="bold", va="center")
    _scale_bar(axes, scale)
    return figure, axes


def _limits(image_map: OccupancyMap, clean: CleanMap) -> tuple[tuple[float, float], tuple[float, float]]:
    """Metres (x, y) that hold the reachable part and all free parts but specks, and their walls."""
    frame = image_map.frame
    labels = component_labels(image_map.free)
    # Specks of free space outside, from stray laser beams, would shrink the building to a corner of the picture.
    shown = (np.bincount(labels.ravel()) * frame.resolution**2 >= SPECK)[labels] & image_map.free
    rows, cols = np.nonzero(shown if shown.any() else image_map.free)
    # Rows count from the top, metres from the bottom.
    low = (float(cols.min()), float(frame.height - 1 - rows.max()))
    high = (float(cols.max() + 1), float(frame.height - rows.min()))
    # The map may be turned: limits in metres are those of the turned corners.
    corners = [_corners(frame, low, high), _corners(clean.frame, (0, 0), (clean.frame.width, clean.frame.height))]
    points = np.concatenate(corners)
    least, most = points.min(axis=0), points.max(axis=0)
    margin = max(0.5, 0.02 * float(np.max(most - least)))
    return (float(least[0]) - margin, float(most[0]) + margin), (float(least[1]) - margin, float(most[1]) + margin)


def _corners(
    frame: GridFrame, low: tuple[float | int, float | int], high: tuple[float | int, float | int]
) -> Float64[np.ndarray, "4 2"]:
    """Metres of the corners of a rectangle, given in cells across and up."""
    corners = [(across, up) for across in (low[0], high[0]) for up in (low[1], high[1])]
    return np.asarray(_to_metres(frame).transform(np.array(corners, dtype=np.float64)))


def _to_metres(frame: GridFrame) -> Affine2D:
    """From cells across and up, counted from the lower left corner, to metres."""
    return Affine2D().scale(frame.resolution).rotate(frame.yaw).translate(frame.x, frame.y)


def _show(axes: Axes, raster: UInt8[np.ndarray, "h w C"], frame: GridFrame, zorder: int, block: int = 1) -> None:
    """Put a raster whose pixels are blocks of the frame's cells, from the top left on, where it lies in metres."""
    axes.imshow(
        raster,
        # An extent is always upright; what turns the raster is the transform.
        extent=(0, raster.shape[1] * block, frame.height - raster.shape[0] * block, frame.height),
        transform=_to_metres(frame) + axes.transData,
        interpolation="nearest",
        zorder=zorder,
        aspect="equal",
    )


def _block(frame: GridFrame) -> int:
    """Pixels of the map, along a side, in a pixel of the raster."""
    return math.ceil(max(frame.height, frame.width) / RASTER)


def _map_raster(image_map: OccupancyMap, block: int) -> UInt8[np.ndarray, "h w 3"]:
    """What is free and what is not known."""
    free = _any_in_blocks(image_map.free, block)
    return np.where(free[..., None], np.array(rgb(UNREACHED), np.uint8), np.array(rgb(UNKNOWN), np.uint8))


def _wall_raster(image_map: OccupancyMap, block: int) -> UInt8[np.ndarray, "h w 4"]:
    """Obstacles, all else clear: above the cells, which reach over the edges of pixels."""
    return _painted(_any_in_blocks(image_map.occupied, block), OBSTACLE)


def _any_in_blocks(pixels: Bool[np.ndarray, "H W"], block: int) -> Bool[np.ndarray, "h w"]:
    height, width = (-(-side // block) * block for side in pixels.shape)
    # The last blocks are filled up with False, which changes no "any".
    padded = np.pad(pixels, ((0, height - pixels.shape[0]), (0, width - pixels.shape[1])))
    return np.asarray(padded.reshape(height // block, block, width // block, block).any(axis=(1, 3)))


def _painted(where: Bool[np.ndarray, "H W"], colour: str) -> UInt8[np.ndarray, "H W 4"]:
    # Alpha 0: where nothing is painted, lower layers show.
    raster = np.zeros((*where.shape, 4), np.uint8)
    raster[where] = (*rgb(colour), 255)
    return raster


def _letter_raster(world: World, propositions: int) -> list[UInt8[np.ndarray, "H W 4"]]:
    """Labelled cells in the colours of their propositions; several propositions in stripes."""
    letters = np.asarray(world.letters)
    raster = np.zeros((*letters.shape, 4), np.uint8)
    row, col = np.indices(letters.shape)
    for letter in np.unique(letters[letters > 0]).tolist():
        colours = [(*rgb(area_colour(bit)), 255) for bit in range(propositions) if letter >> bit & 1]
        striped = np.array(colours, np.uint8)[(row + col) % len(colours)]
        raster[letters == letter] = striped[letters == letter]
    return [raster]


def _labels_in_metres(family: RosMap, world: World, inches_per_cell: float) -> list[AreaLabel]:
    """The names of the labelled areas, placed on the grid and carried over to metres."""
    frame = family.clean.frame
    to_metres = _to_metres(frame)

    def metres(cell: tuple[float, float]) -> tuple[float, float]:
        x, y = to_metres.transform((cell[0] + 0.5, frame.height - 0.5 - cell[1]))
        return float(x), float(y)

    start = tuple(np.asarray(world.start).tolist())
    # Names are placed on the upright grid and keep clear of each other there; on a map that is turned they may come
    # nearer, because their boxes stay level.
    placed = place_labels(world, family.propositions, [start], inches_per_cell=inches_per_cell)
    half = frame.resolution
    return [
        AreaLabel(
            label.name,
            metres(label.centre),
            metres(label.anchor),
            (label.half_size[0] * half, label.half_size[1] * half),
        )
        for label in placed
    ]


def _scale_bar(axes: Axes, scale: float) -> None:
    """A bar of a round length above the right end of the map; ``scale`` is inches a metre."""
    (left, right), pixels = axes.get_xlim(), blended_transform_factory(axes.transData, axes.transAxes)
    # The longest round length within a quarter of the width.
    length = max((bar for bar in SCALE_BARS if bar <= (right - left) / 4), default=SCALE_BARS[0])
    above = 1 + 0.14 / (axes.bbox.height / axes.figure.dpi)
    axes.plot(
        [right - length, right], [above] * 2, transform=pixels, color=INK, lw=3, solid_capstyle="butt", clip_on=False
    )
    axes.text(right - length - 0.08 / scale, above, f"{length:g} m", transform=pixels, ha="right", va="center", size=9)


def _finish(figure: Figure, axes: Axes, clean: CleanMap, handles: list[Patch | Line2D]) -> None:
    """Marks what is cut off, and adds the legend."""
    shown: list[Patch | Line2D] = [
        Patch(facecolor=REACHED, edgecolor=FAINT, label="reachable"),
        Patch(facecolor=UNREACHED, edgecolor=FAINT, label="free, not reachable"),
        Patch(facecolor=OBSTACLE, label="obstacle"),
        Patch(facecolor=UNKNOWN, edgecolor=FAINT, label="unknown"),
    ]
    if clean.cut_off:
        x, y = zip(*(part.at for part in clean.cut_off), strict=True)
        axes.plot(x, y, "X", ms=10, mfc=CHOSEN, mec="white", mew=1.0, ls="", zorder=6)
        # A white rim keeps an area readable on walls.
        rim = [patheffects.withStroke(linewidth=2.5, foreground="white")]
        for part in clean.cut_off:
            axes.annotate(
                f"{part.area:.0f} m²",
                part.at,
                (0, -14),
                textcoords="offset points",
                ha="center",
                size=8,
                path_effects=rim,
                zorder=7,
            )
        total = sum(part.area for part in clean.cut_off)
        shown.append(Patch(facecolor=CUT_OFF, edgecolor=FAINT, label=f"cut off, {total:.0f} m² in all"))
    shown += handles
    columns = legend_columns(shown, figure.get_figwidth())
    figure.legend(handles=shown, loc="lower center", ncols=columns, fontsize=8.5, frameon=False, handlelength=1.4)
