"""What a map holds, before it serves as a world: shares, components, passages and what looks like a defect."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32
from scipy import ndimage

from potlp_jax.environments.ros.cleaning import CleanMap
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.occupancy_map import OccupancyMap
from potlp_jax.environments.ros.places import Point, component_labels

WIDEST = 1.5
"""Metres from which on a way from one part of a building to another is no passage but open space."""

PART_AREA = 2.0
"""Square metres on either side from which on a narrowing is a passage, not a gap between two chairs."""

WIDE_SHARE = 1 / 16
"""Of `PART_AREA` that has to lie in a part's wide places: all parts with less are passed over without a closer look."""

SPECK = 0.2
"""Square metres below which a component of the free space is a speck."""


@dataclass(frozen=True)
class Passage:
    """The widest way between two parts of the free space, where it is narrowest.

    Attributes:
        at: metres (x, y).
        width: metres, whole pixels, up to one pixel less than the truth.
        area: of the smaller of the two parts, in square metres.
        is_open: whether a robot gets through on the cleaned grid.
    """

    at: Point
    width: float
    area: float
    is_open: bool


@dataclass(frozen=True)
class MapSurvey:
    """Counts are of the map's pixels, areas in square metres, lengths in metres.

    Attributes:
        free, occupied, unknown: shares of the image; they sum to 1.
        components: connected parts of the free space.
        largest: area of the largest of them.
        specks: components of a few pixels, less than `SPECK` square metres.
        loose_obstacles: obstacles of one pixel with nothing but free space around them.
        open_edge: length along which the largest component meets unknown space, or the image's edge, without a wall.
        passages: narrowest first.
    """

    free: float
    occupied: float
    unknown: float
    components: int
    largest: float
    specks: int
    loose_obstacles: int
    open_edge: float
    passages: tuple[Passage, ...]


def survey_map(image_map: OccupancyMap, clean: CleanMap) -> MapSurvey:
    """Look a map over.

    ``clean`` says which passages a robot gets through on the cells that it plans with.
    """
    free, frame = image_map.free, image_map.frame
    labels = component_labels(free)
    areas = np.bincount(labels.ravel())[1:] * frame.resolution**2
    # Passages are looked for in the largest component alone: others are not part of the building that is planned in.
    largest = labels == 1 + np.argmax(areas)
    rows, cols = (slice(int(found.min()), int(found.max()) + 1) for found in np.nonzero(largest))
    window = frame.window(rows.start, cols.start, rows.stop - rows.start, cols.stop - cols.start)
    return MapSurvey(
        free=float(free.mean()),
        occupied=float(image_map.occupied.mean()),
        unknown=float((~free & ~image_map.occupied).mean()),
        components=len(areas),
        largest=float(areas.max()),
        specks=int(np.sum(areas < SPECK)),
        loose_obstacles=_loose_obstacles(image_map),
        open_edge=_open_edge(largest, image_map.occupied) * frame.resolution,
        passages=find_passages(largest[rows, cols], window, clean),
    )


def _loose_obstacles(image_map: OccupancyMap) -> int:
    around = ndimage.binary_erosion(image_map.free | image_map.occupied, np.ones((3, 3), bool))
    neighbours = ndimage.convolve(image_map.occupied.astype(np.uint8), np.ones((3, 3), np.uint8), mode="constant")
    return int(np.sum(image_map.occupied & around & (neighbours == 1)))


def _open_edge(part: Bool[np.ndarray, "H W"], occupied: Bool[np.ndarray, "H W"]) -> int:
    """Sides of pixels between the part and what is neither in it nor an obstacle; beyond the image is neither."""
    # Padded, so that what rolls over the edge of the image is neither.
    inside, unknown = np.pad(part, 1), ~np.pad(part | occupied, 1)
    return sum(int(np.sum(inside & np.roll(unknown, shift, axis))) for axis in (0, 1) for shift in (-1, 1))


def find_passages(
    part: Bool[np.ndarray, "H W"], frame: GridFrame, clean: CleanMap, widest: float = WIDEST, area: float = PART_AREA
) -> tuple[Passage, ...]:
    """Where large parts of the free space are joined by little.

    The space is filled from its widest places on, a pixel of width at a time; where two parts meet is a passage.

    Args:
        part: True on the free pixels of one connected part.
        frame: metres to pixels.
        clean: the grid that a robot plans with; says which passages are open on it.
        widest: metres from which on a narrowing is no passage.
        area: square metres that there must be on either side.

    Returns:
        The passages, narrowest first.
    """
    # From each pixel's centre to that of the nearest obstacle; beyond the image all are obstacles.
    clearance = np.asarray(ndimage.distance_transform_edt(np.pad(part, 1)))[1:-1, 1:-1]
    kept = _kept_pixels(clean, frame)
    smallest = area / frame.resolution**2
    passages: list[Passage] = []
    parts = np.zeros(part.shape, np.int32)
    for width in range(int(widest / frame.resolution), 0, -1):
        # In the middle of a passage of an odd number of pixels, the nearest obstacle's centre is so far away.
        wide = clearance >= (width + 1) / 2
        labels = component_labels(wide)
        for meeting in _meetings(parts, labels, smallest, (width + 2) / 2):
            passages += _passages_between(meeting, parts, labels, clearance, kept, frame, width)
        # Only parts with enough wide space are followed: the rest is clutter, and there are thousands of it.
        parts = np.where((np.bincount(labels.ravel()) >= WIDE_SHARE * smallest)[labels], labels, 0)
    return tuple(sorted(passages, key=lambda passage: (passage.width, -passage.area)))


def _kept_pixels(clean: CleanMap, frame: GridFrame) -> Bool[np.ndarray, "H W"]:
    """The pixels at the centres of the cells that the robot can reach."""
    # The lower left corner of the cleaned grid, in pixels of this one; both have the same axes.
    corner = frame.to_grid(np.array([[clean.frame.x, clean.frame.y]]))[0]
    cells = np.argwhere(clean.free)
    steps = np.stack([cells[:, 1], clean.frame.height - 1 - cells[:, 0]], axis=1) + 0.5
    across, up = np.floor(corner[None, :] + steps * (clean.frame.resolution / frame.resolution)).astype(int).T
    inside = (across >= 0) & (across < frame.width) & (up >= 0) & (up < frame.height)
    kept = np.zeros((frame.height, frame.width), bool)
    kept[frame.height - 1 - up[inside], across[inside]] = True
    return kept


def _meetings(
    parts: Int32[np.ndarray, "H W"], labels: Int32[np.ndarray, "H W"], smallest: float, reach: float
) -> list[list[int]]:
    """Numbers of the parts that have come together in one component, the largest part first.

    Parts count as ``smallest`` pixels or more if they do with all that is nearer than ``reach`` to them.
    """
    # ``parts`` are those of the level before, ``labels`` the components of this one, which is wider by a pixel.
    sizes = np.bincount(parts.ravel())
    component = np.zeros(len(sizes), np.int32)
    # Any pixel will do: a part lies in one component as a whole, for every level holds the one before.
    component[parts.ravel()] = labels.ravel()
    members: dict[int, list[int]] = {}
    for number in 1 + np.argsort(-sizes[1:], kind="stable"):
        if sizes[number]:
            members.setdefault(int(component[number]), []).append(int(number))
    boxes = ndimage.find_objects(parts)
    counted = [
        [number for number in found if sizes[number] >= smallest or _grown(parts, number, boxes, reach) >= smallest]
        for found in members.values()
        if len(found) > 1
    ]
    return [found for found in counted if len(found) > 1]


def _grown(parts: Int32[np.ndarray, "H W"], number: int, boxes: list[tuple[slice, slice] | None], reach: float) -> int:
    """Pixels nearer than ``reach`` to a part. All are free where no obstacle is nearer than that to the part."""
    # Only the surroundings of the part are looked at: a transform of the whole map for each part would take minutes.
    box = boxes[number - 1]
    assert box is not None, "a part has pixels"
    # Nothing unknown beside it: an obstacle on the edge of what was mapped may be the beginning of a wall.
    around = np.pad(parts[box] == number, math.ceil(reach))
    return int(np.sum(np.asarray(ndimage.distance_transform_edt(~around)) < reach))


def _passages_between(
    meeting: list[int],
    parts: Int32[np.ndarray, "H W"],
    labels: Int32[np.ndarray, "H W"],
    clearance: Float64[np.ndarray, "H W"],
    kept: Bool[np.ndarray, "H W"],
    frame: GridFrame,
    width: int,
) -> list[Passage]:
    """The passage from each part of a meeting, but for the largest, to the rest."""
    # Everything happens in the window around the component in which the parts meet.
    component = labels == labels[parts == meeting[0]][0]
    rows, cols = (slice(int(np.min(index)), int(np.max(index)) + 1) for index in np.nonzero(component))
    component, members = component[rows, cols], parts[rows, cols] * np.isin(parts[rows, cols], meeting)
    nearest = np.asarray(ndimage.distance_transform_edt(members == 0, return_distances=False, return_indices=True))
    # Each pixel goes to the nearest part. Where owners change the parts meet; the widest pixel there is the passage.
    owner = np.where(component, members[tuple(nearest)], 0)
    border = np.flatnonzero(_borders(owner))
    border_owner, space = owner.flat[border], clearance[rows, cols].flat[border]
    # A part that has no pixel of the cleaned grid, or all of them, is separated from the rest on it.
    reached, boxes = np.bincount(owner[kept[rows, cols]], minlength=owner.max() + 1), ndimage.find_objects(owner)
    reached[0] = 0
    found = []
    for number in meeting[1:]:
        narrow = border[border_owner == number][np.argmax(space[border_owner == number])]
        row, col = np.unravel_index(narrow, owner.shape)
        found.append(
            Passage(
                at=frame.cell_to_metres(int(row) + rows.start, int(col) + cols.start),
                width=round(width * frame.resolution, 9),
                area=_grown(owner, number, boxes, (width + 1) / 2) * frame.resolution**2,
                is_open=bool(0 < reached[number] < reached.sum()),
            )
        )
    return found


def _borders(owner: Int32[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels that belong to someone and have a neighbour that belongs to someone else."""
    border = np.zeros(owner.shape, bool)
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        meets = (owner[one] != owner[other]) & (owner[one] > 0) & (owner[other] > 0)
        border[one] |= meets
        border[other] |= meets
    return border
