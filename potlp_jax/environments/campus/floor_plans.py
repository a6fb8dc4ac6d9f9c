"""Delivery worlds on real floor plans: ``floorplan:FILE.xml``, or ``floorplan:FOLDER`` for all plans of a folder.

Options follow after commas: ``floorplan:FILE.xml,resolution=0.4,kinds=OTHER.yaml``. Names of files hold no comma. Plans
are test data: worlds on them can be drawn from the test split alone (``potlp_jax.environments.splits``).

A plan is a drawing, not a map. `rasterise` turns it into a floor:

1. A cell belongs to the room whose outline holds its centre; where outlines overlap, to the smallest of them. The
   scale is the file's.
2. Rooms are traced one by one, so that walls are double: the gap between two outlines is solid. Where it is narrower
   than a cell, the cells along it become the wall: those of the room that is no hallway, else of the larger one.
3. A door is a point. An opening 0.9 m wide (a double door 1.8 m) is cut through the wall there, straight across it; one
   that the file calls implicit has no wall, and becomes as wide as the rooms face each other.
4. Rooms without a door, and others that cannot be reached, are walled up: the largest connected part stays.

``FloorReport`` counts what was lost or bent on the way. A room whose label nobody explained is a room of no particular
kind, and a warning names the label.

A plan is used for every task whose places it has. Its worlds have all propositions of the delivery task, so that
letters mean the same in all of them; one for which the plan has no room holds nowhere. A task that cannot be satisfied
without it is refused by ``FloorPlans.task``. In a folder it is refused where that is so on every plan; on single ones
the world is impossible, and sweeps draw another. ``needs=professor+grad`` leaves plans out that lack one of these. What
every plan needs is a hallway, where the robot starts, and a place.
"""

import itertools
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Int, Int32, PRNGKeyArray

from potlp_jax.environments.base import Generator, host_generators
from potlp_jax.environments.campus.delivery import DELIVERY_FAMILY, scaled_to
from potlp_jax.environments.campus.floor_plan_xml import FloorPlan, PlanDoor, PlanRoom, read_kinds, read_plan
from potlp_jax.environments.campus.furnishing import (
    MANY_DOORS,
    NO_ROOM,
    PEOPLE,
    Floor,
    FurnishConfig,
    Kind,
    Placement,
    absent_propositions,
    furnish,
    name_kinds,
)
from potlp_jax.environments.options import parse_options
from potlp_jax.environments.ros.map_files import GridFrame
from potlp_jax.environments.ros.places import Polygon, component_labels
from potlp_jax.environments.splits import FLOOR_PLAN_PREFIX
from potlp_jax.errors import MapError, MapWarning, TaskError
from potlp_jax.task.task import Task
from potlp_jax.world.grid import World
from potlp_jax.world.settings import Settings

DOOR_WIDTH = 0.9
"""Metres; the door by which the corpus's files are scaled, too."""

DEEPEST_WALL = 1.5
"""Metres from a door's point in which the rooms on both sides are looked for."""

MOST_CELLS = 1000
"""Rows, and columns, of a floor, at most."""

# Up to two cells, a metre at the default resolution: farther away it would be another door.
_SHIFTS = (0, 1, -1, 2, -2)
"""Cells by which an opening may be beside its point, in order of preference: doors stand in corners, too."""

Cut = tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]
"""Rows and columns of cells to open."""

NAMED_PLANS = 5
"""Plans of a folder that an error about a task names."""

LOST_ROOMS = 0.25
"""Share of the rooms from which on their loss is worth a warning."""


@dataclass(frozen=True)
class FloorPlanConfig:
    """Which plans, and how they become grids.

    Attributes:
        path: an XML file, or a folder of them.
        resolution: side of a cell in metres.
        kinds: YAML of what the labels mean; None: the shipped one.
        needs: propositions that a plan must have a room for, to be used.
        furnishing: people, light and colours.
    """

    path: str | Path
    resolution: float = 0.5
    kinds: str | Path | None = None
    needs: tuple[str, ...] = ()
    furnishing: FurnishConfig = FurnishConfig()


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


class FloorPlans(Generator):
    """Worlds on real plans; they differ in the building, who is where, light and colours.

    Attributes:
        name: ``floorplan:`` and the name of the file or folder.
        floors: the buildings, in the order of their files' names.
        left_out: why files of a folder are no buildings, by name.
    """

    propositions = PEOPLE.propositions
    tasks = PEOPLE.tasks
    # They look like the generator's, and the camera shows the same metres.
    family = DELIVERY_FAMILY

    def __init__(self, config: FloorPlanConfig) -> None:
        """Reads and rasterises the plans.

        Raises:
            MapError: a file cannot be used, or no plan of the folder can.

        Warns:
            MapWarning: plans of a folder are left out, a plan has lost more than a quarter of its rooms, or has labels
                of which nothing says what they mean.
        """
        self.config = config
        path, kinds = Path(config.path), read_kinds(config.kinds)
        self.left_out: dict[str, str] = {}
        floors = []
        for file in _files(path):
            try:
                floors.append(_usable_floor(file, kinds, config))
            except MapError as error:
                if not path.is_dir():
                    raise
                self.left_out[file.name] = str(error)
        if not floors:
            raise MapError(path, "", "no plan can be used:\n" + "\n".join(self.left_out.values()))
        self.floors: tuple[PlanFloor, ...] = tuple(floors)
        self.name = f"{FLOOR_PLAN_PREFIX}{path.stem}"
        self.settings = Settings({**MANY_DOORS, **scaled_to(config.resolution)})
        shapes = np.array([floor.floor.rooms.shape for floor in floors])
        self._shape = int(shapes[:, 0].max()), int(shapes[:, 1].max())
        self._warn_of_losses(path)

    @classmethod
    def from_spec(cls, spec: str) -> "FloorPlans":
        """From ``floorplan:PATH``, with options ``,resolution=...``, ``,kinds=...`` and ``,needs=...``.

        Raises:
            MapError: the text is not of that form, or see the class.
        """
        return cls(parse_spec(spec))

    def task(self, text: str | int) -> Task:
        """A task over the propositions of the delivery task, as ``Generator.task``.

        Raises:
            TaskError: there is no such task, or it needs places that no plan has.
        """
        task = super().task(text)
        lacking = [(floor, _needed(task, floor.absent)) for floor in self.floors]
        if all(needed for _, needed in lacking):
            plans = "\n".join(
                f"{floor.name} has no room for {', '.join(needed)}; it has {', '.join(floor.present)}. "
                f"Its labels: {', '.join(floor.labels)}"
                for floor, needed in lacking[:NAMED_PLANS]
            )
            more = f"\nand {len(lacking) - NAMED_PLANS} plans more" if len(lacking) > NAMED_PLANS else ""
            raise TaskError(
                f"{self.config.path}: the task {task.text!r} needs places that no plan has:\n{plans}{more}\n"
                "kinds=FILE.yaml gives labels another meaning; or give a task of the places that are there."
            )
        return task

    def draw(self, key: PRNGKeyArray) -> World:
        """The world of this key: a building, drawn uniformly, and people in it."""
        return self.generate_with_layout(key)[0]

    def generate_with_layout(self, key: PRNGKeyArray) -> tuple[World, PlanFloor, Placement]:
        """The world of this key, its building without padding, and who is where."""
        # The key itself draws the building, so that people need one of their own.
        furnish_key = jax.random.fold_in(key, 0)
        floor = self.building(key)
        world, placement = furnish(floor.floor, furnish_key, PEOPLE, self.config.furnishing, self._shape, floor.absent)
        return self.signed(world), floor, placement

    def building(self, key: PRNGKeyArray) -> PlanFloor:
        """The building of this key's world; trials in one building are not independent."""
        (rng,) = host_generators(key, 1)
        return self.floors[int(rng.integers(len(self.floors)))]

    def _warn_of_losses(self, path: Path) -> None:
        if self.left_out:
            names = ", ".join(sorted(self.left_out))
            _warn(path, f"{len(self.left_out)} of {len(self.left_out) + len(self.floors)} plans are left out: {names}")
        for floor in self.floors:
            if floor.report.rooms_lost > LOST_ROOMS * floor.report.rooms:
                _warn(path, f"{floor.name} has lost many of its rooms: {floor.report}")
        # A label that nobody explained must not become some kind of room in silence.
        unknown = sorted({label for floor in self.floors for label in floor.unknown})
        if unknown:
            names = ", ".join(unknown)
            _warn(path, f"no kind is given for {names}: rooms of no particular kind; list them in a file of kinds=")


def parse_spec(spec: str) -> FloorPlanConfig:
    """``floorplan:PATH,option=value,...`` as a configuration.

    Raises:
        MapError: the text is not of that form.
    """
    usage = "write floorplan:FILE.xml (or a folder)[,resolution=METRES][,kinds=FILE.yaml][,needs=NAME+NAME]"
    options = {"resolution": float, "kinds": str, "needs": str}
    path, values = parse_options(spec, FLOOR_PLAN_PREFIX, "plan", options, usage)
    needs = tuple(values.pop("needs").split("+")) if "needs" in values else ()
    unknown = [name for name in needs if name not in PEOPLE.propositions]
    if unknown:
        raise MapError(spec, "needs", f"{unknown[0]!r} is none of {', '.join(PEOPLE.propositions)}; {usage}")
    return FloorPlanConfig(path, needs=needs, **values)


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
    drawing = _Drawing(rooms, [kinds.get(room.label, Kind.OTHER) for room in rooms], frame)
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


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = sorted(path.glob("*.xml"))
    if not files:
        raise MapError(path, "", "the folder holds no .xml file")
    return files


def _usable_floor(file: Path, kinds: Mapping[str, Kind], config: FloorPlanConfig) -> PlanFloor:
    """The floor of a plan. Raises MapError where it has no hallway to start in, no place, or lacks what is needed."""
    found = rasterise(read_plan(file), kinds, config.resolution)
    # Without any place every task would be over at once, or impossible.
    absent = found.absent if not found.present else tuple(name for name in config.needs if name in found.absent)
    needed = [(Kind.HALLWAY,)] * (not found.floor.rooms_of(Kind.HALLWAY)) + [PEOPLE.rooms[name] for name in absent]
    if needed:
        purpose = f"for {', '.join(absent)}" if absent else "where the robot could start"
        raise MapError(
            file,
            "",
            f"no room of kind {name_kinds(tuple(needed))} can be reached, {purpose}. The labels are: "
            f"{', '.join(found.labels)}; kinds=FILE.yaml gives them another meaning. ({found.report})",
        )
    return found


def _needed(task: Task, absent: tuple[str, ...]) -> tuple[str, ...]:
    """Of the propositions that hold nowhere, those without which no path satisfies the task."""
    if task.can_do_without(absent):
        return ()
    alone = tuple(name for name in absent if not task.can_do_without([name]))
    # Of `F grad | F undergrad` neither is needed alone.
    return alone or absent


def _warn(path: Path, message: str) -> None:
    warnings.warn(f"{path}: {message}", MapWarning, stacklevel=4)


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


class _Drawing:
    """The cells of a plan, while doors are cut.

    Attributes:
        kinds: of the rooms, which are numbered in the order given.
        cells: number of the room of each cell, or ``NO_ROOM``.
        doors: cells of doors.
    """

    def __init__(self, rooms: list[PlanRoom], kinds: list[Kind], frame: GridFrame) -> None:
        self.kinds, self.frame = kinds, frame
        self.numbers = {room.id: number for number, room in enumerate(rooms)}
        self.areas = [room.area for room in rooms]
        self.cells = np.full((frame.height, frame.width), NO_ROOM, np.int32)
        # Large rooms first: a closet drawn inside of a hall stays visible.
        for number in sorted(range(len(rooms)), key=lambda number: -self.areas[number]):
            self._fill(number, rooms[number])
        self._separate()
        self.doors = np.zeros(self.cells.shape, bool)
        self._without_doors = self.cells.copy()

    def _fill(self, number: int, room: PlanRoom) -> None:
        # Only the window around the outline is tested for being inside of it.
        corners = [self.frame.metres_to_cell(*point) for point in room.outline]
        rows, columns = zip(*corners, strict=True)
        top, left = min(rows), min(columns)
        window = self.frame.window(top, left, max(rows) - top + 1, max(columns) - left + 1)
        inside = Polygon(room.outline).covers(np.ones((window.height, window.width), bool), window)
        self.cells[top : top + window.height, left : left + window.width][inside] = number

    def _separate(self) -> None:
        """Walls between rooms that touch: of two cells, that of the room which can better do without it."""
        # Hallways rank lowest and keep their cells, since they are narrow; of other rooms the smaller one keeps its.
        order = sorted(
            range(len(self.kinds)), key=lambda number: (self.kinds[number] is not Kind.HALLWAY, self.areas[number])
        )
        # The inverse of the order; the last entry is the rank of NO_ROOM, -1.
        rank = np.argsort(np.array([*order, len(order)]))
        walls = np.zeros(self.cells.shape, bool)
        for cells, wall in ((self.cells, walls), (self.cells.T, walls.T)):
            # Transposed arrays are views, so that the second pass writes the same walls along the other axis.
            one, other = cells[:-1], cells[1:]
            touch = (one != other) & (one != NO_ROOM) & (other != NO_ROOM)
            wall[:-1] |= touch & (rank[one] > rank[other])
            wall[1:] |= touch & (rank[other] > rank[one])
        self.cells[walls] = NO_ROOM

    def cut_door(self, door: PlanDoor) -> float:
        """Open a door; returns the share of its width that was possible, 0 where the rooms do not face each other."""
        rooms = self.numbers[door.rooms[0]], self.numbers[door.rooms[1]]
        wanted = max(1, round(DOOR_WIDTH * (2 if door.double else 1) / self.frame.resolution))
        # Where the outlines of both rooms have the door, the place is in the middle of the wall between them.
        x, y = (sum(values) / len(door.points) for values in zip(*door.points, strict=True))
        up, across = self.frame.to_grid(np.array([[x, y]]))[0][::-1]
        place = self.frame.height - up, across
        # Files do not say in which wall a door is: the direction in which more of it fits is right.
        best = max((self._passages(place, rooms, wanted, door.implicit, turned) for turned in (False, True)), key=len)
        for rows, columns in best:
            self.cells[rows, columns] = self._behind(rooms)
            self.doors[rows, columns] = True
        return min(1.0, len(best) / wanted)

    def wall_up(self) -> list[int]:
        """Leave the largest connected part alone; returns the rooms of which something is left."""
        labels = component_labels(self.cells != NO_ROOM)
        # The appended 0 stands for a drawing without any free cell.
        largest = 1 + np.argmax(np.append(np.bincount(labels.ravel())[1:], 0))
        self.cells[labels != largest] = NO_ROOM
        self.doors &= self.cells != NO_ROOM
        return sorted(set(np.unique(self.cells).tolist()) - {NO_ROOM})

    def _behind(self, rooms: tuple[int, int]) -> int:
        """The room that a door belongs to: that which is no hallway, else the smaller one."""
        return min(rooms, key=lambda number: (self.kinds[number] is Kind.HALLWAY, self.areas[number]))

    def _passages(
        self, place: tuple[float, float], rooms: tuple[int, int], width: int, implicit: bool, turned: bool
    ) -> list[Cut]:
        """Cuts along rows (columns if ``turned``) that join two rooms near a place, side by side."""
        cells = self._without_doors.T if turned else self._without_doors
        along, across = place[::-1] if turned else place
        reach = max(1, round(DEEPEST_WALL / self.frame.resolution))

        def cut(line: int, along: float) -> Cut | None:
            if not 0 <= line < cells.shape[1]:
                return None
            steps = _gap(cells[:, line], along, reach, rooms)
            beside = cells[steps, max(line - 1, 0) : line + 2]
            # A cut along a third room would open that, too.
            if not len(steps) or not np.isin(beside, (NO_ROOM, *rooms)).all():
                return None
            return steps, np.full_like(steps, line)

        # An opening without a door is as wide as both rooms go; a door has its width, perhaps a little aside.
        if implicit:
            found = _all_cuts(cut, int(across), along)
        else:
            first = round(across - width / 2)
            tries = ([cut(first + shift + line, along) for line in range(width)] for shift in _SHIFTS)
            found = max(([one for one in cuts if one is not None] for cuts in tries), key=len)
        return [(columns, rows) for rows, columns in found] if turned else found


def _gap(line: Int32[np.ndarray, " N"], middle: float, reach: int, rooms: tuple[int, int]) -> Int[np.ndarray, " M"]:
    """The cells of no room between two rooms that follow each other in a line of cells, nearest to its middle."""
    low = max(int(middle) - reach, 0)
    window = line[low : int(middle) + reach + 1]
    # Two rooms face each other where one follows the other with nothing but wall between.
    taken = np.flatnonzero(window != NO_ROOM)
    gaps = [
        np.arange(low + one + 1, low + other)
        for one, other in itertools.pairwise(taken.tolist())
        if {int(window[one]), int(window[other])} == set(rooms)
    ]
    return min(gaps, key=lambda gap: abs(float(gap.mean()) + 0.5 - middle), default=np.zeros(0, np.int64))


def _all_cuts(cut: Callable[[int, float], Cut | None], middle: int, along: float) -> list[Cut]:
    """Cuts side by side, from the line nearest to the middle on, as far as both rooms go; they may drift aside."""
    first = next((middle + shift for shift in _SHIFTS if cut(middle + shift, along)), None)
    if first is None:
        return []
    found = []
    for line, step in ((first, 1), (first - 1, -1)):
        # The wall may be slanted: the next cut is looked for where this one was.
        place = along
        while (one := cut(line, place)) is not None:
            found.append(one)
            line, place = line + step, float(one[0].mean()) + 0.5
    return found
