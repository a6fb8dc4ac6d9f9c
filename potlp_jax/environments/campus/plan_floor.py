"""From a floor plan to a floor of cells: `rasterise`. A plan is a drawing, not a map.

1. A cell belongs to the room whose outline holds its centre; where outlines overlap, to the smallest of them. The
   scale is the file's.
2. Rooms are traced one by one, so that walls are double: the gap between two outlines is solid. Where it is narrower
   than a cell, the cells along it become the wall: those of the room that is no hallway, else of the larger one.
3. A door is a point. An opening 0.9 m wide (a double door 1.8 m) is cut through the wall there, straight across it; one
   that the file calls implicit has no wall, and becomes as wide as the rooms face each other.
4. Rooms without a door, and others that cannot be reached, are walled up: the largest connected part stays.

``FloorReport`` counts what was lost or bent on the way.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from potlp_jax.environments.campus.floor_plan_xml import FloorPlan
from potlp_jax.environments.campus.furnishing import NO_ROOM, PEOPLE, Floor, Kind, absent_propositions
from potlp_jax.environments.campus.plan_drawing import Drawing
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.errors import MapError

MOST_CELLS = 1000
"""Rows, and columns, of a floor, at most."""


@dataclass(frozen=True)
class FloorReport:
    """What became of a plan's rooms and doors.

    Attributes:
        rooms, doors: in the file.
        rooms_without_door: that no door mentions.
        rooms_without_cells: too narrow for the resolution, or covered by others.
        rooms_cut_off: that cannot be reached all the same.
        doors_without_point: mentioned, but drawn nowhere.
        doors_unplaced: near whose point the two rooms do not face each other.
        doors_narrowed: narrower than they should be, since the rooms face each other on less.
    """

    rooms: int
    doors: int
    rooms_without_door: int = 0
    rooms_without_cells: int = 0
    rooms_cut_off: int = 0
    doors_without_point: int = 0
    doors_unplaced: int = 0
    doors_narrowed: int = 0

    @property
    def rooms_lost(self) -> int:
        """Rooms that the floor does not have."""
        return self.rooms_without_door + self.rooms_without_cells + self.rooms_cut_off

    def __str__(self) -> str:
        losses = [field.name for field in fields(self)[2:] if getattr(self, field.name)]
        return f"{self.rooms} rooms, {self.doors} doors" + "".join(
            f", {getattr(self, name)} {name.replace('_', ' ')}" for name in losses
        )


@dataclass(frozen=True, eq=False)
class PlanFloor:
    """The floor of a plan.

    Attributes:
        name: of the building: the file's, without folder and ending.
        floor: with a closed border.
        room_ids: of the floor's rooms, as in the file.
        frame: metres of the plan (y upwards) to cells.
        report: what was lost.
        labels: of the plan's rooms, in alphabetical order.
        unknown: those of which it was not given what they mean.
    """

    name: str
    floor: Floor
    room_ids: tuple[str, ...]
    frame: GridFrame
    report: FloorReport
    labels: tuple[str, ...]
    unknown: tuple[str, ...]

    @cached_property
    def absent(self) -> tuple[str, ...]:
        """Propositions of the delivery task for which the floor has no room."""
        return absent_propositions(self.floor, PEOPLE)

    @property
    def present(self) -> tuple[str, ...]:
        """The others."""
        return tuple(name for name in PEOPLE.propositions if name not in self.absent)


def rasterise(plan: FloorPlan, kinds: Mapping[str, Kind], resolution: float) -> PlanFloor:
    """The floor of a plan, as the module describes.

    Args:
        plan: in metres.
        kinds: the kind of room that each label means; a room with another label is of the kind ``OTHER``.
        resolution: side of a cell in metres.

    Returns:
        The floor, and what was lost on the way.

    Raises:
        MapError: the resolution is not positive or leaves nothing, or the floor would have more than a thousand rows or
            columns.
    """
    frame = _frame_around(plan, resolution)
    # Rooms that no door mentions would be solid in the end anyway, and until then be in the way of doors.
    with_door = {name for door in plan.doors for name in door.rooms}
    rooms = [room for room in plan.rooms if room.id in with_door]
    drawing = Drawing(rooms, [kinds.get(room.label, Kind.OTHER) for room in rooms], frame)
    without_cells = len(set(range(len(rooms))) - set(np.unique(drawing.cells).tolist()))
    # All doors are cut into the same building without doors, so that their order does not matter.
    placed = [drawing.cut_door(door) for door in plan.doors if door.points]
    kept = drawing.wall_up()
    report = FloorReport(
        rooms=len(plan.rooms),
        doors=len(plan.doors),
        rooms_without_door=len(plan.rooms) - len(rooms),
        rooms_without_cells=without_cells,
        rooms_cut_off=len(rooms) - without_cells - len(kept),
        doors_without_point=len(plan.doors) - len(placed),
        doors_unplaced=placed.count(0.0),
        doors_narrowed=sum(0 < share < 1 for share in placed),
    )
    if not kept:
        raise MapError(plan.file, "", f"nothing is left of it with cells of {resolution} m: {report}")
    # Rooms are numbered anew without gaps; the last entry keeps NO_ROOM, -1, what it is.
    numbers = np.full(len(rooms) + 1, NO_ROOM, np.int32)
    numbers[kept] = np.arange(len(kept))
    floor = Floor(numbers[drawing.cells], drawing.doors, tuple(drawing.kinds[room] for room in kept), resolution)
    labels = tuple(sorted({room.label for room in plan.rooms}))
    unknown = tuple(label for label in labels if label not in kinds)
    return PlanFloor(plan.file.stem, floor, tuple(rooms[room].id for room in kept), frame, report, labels, unknown)


def _frame_around(plan: FloorPlan, resolution: float) -> GridFrame:
    """Cells that hold every outline, and a ring around them."""
    if not (np.isfinite(resolution) and resolution > 0):
        raise MapError(plan.file, "resolution", f"{resolution} is not a positive number of metres")
    points = np.array([point for room in plan.rooms for point in room.outline])
    low, high = points.min(axis=0), points.max(axis=0)
    # Two more: a ring of obstacles on all sides.
    width, height = (int(size) for size in np.ceil((high - low) / resolution) + 2)
    if max(width, height) > MOST_CELLS:
        raise MapError(
            plan.file,
            "scale",
            f"the plan measures {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} m, {height} x {width} cells; check the "
            f"scale, or choose larger cells than {resolution} m",
        )
    return GridFrame(height, width, resolution, float(low[0]) - resolution, float(low[1]) - resolution)
