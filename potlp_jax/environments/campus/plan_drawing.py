"""The cells of a floor plan while rooms are drawn and doors are cut; ``plan_floor`` says by which rules."""

import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Int, Int32

from potlp_jax.environments.campus.floor_plan_xml import PlanDoor, PlanRoom
from potlp_jax.environments.campus.furnishing import NO_ROOM, Kind
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.places import Polygon, component_labels

DOOR_WIDTH = 0.9
"""Metres; the door by which the corpus's files are scaled, too."""

DEEPEST_WALL = 1.5
"""Metres from a door's point in which the rooms on both sides are looked for."""

# Up to two cells, a metre at the default resolution: farther away it would be another door.
_SHIFTS = (0, 1, -1, 2, -2)
"""Cells by which an opening may be beside its point, in order of preference: doors stand in corners, too."""

Cut = tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]
"""Rows and columns of cells to open."""


class Drawing:
    """The cells of a plan, while doors are cut.

    Attributes:
        kinds: of the rooms, which are numbered in the order given.
        frame: metres of the plan (y upwards) to cells.
        numbers: of the rooms, by their ids in the file.
        areas: of the rooms, in square metres.
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
    window = line[low : max(int(middle) + reach + 1, 0)]
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
