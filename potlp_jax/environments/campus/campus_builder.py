"""Draws one floor of a campus building: wings, their hallways, what lies on both sides of these, doors, furniture.

1. The outline gives wings; a hallway runs along each and on to those of the wings that it stands on.
2. What a wing has on both sides of its hallway is divided as in ``blocks``: rows of rooms, more hallways where it is
   deep. Now and then a stretch of it is something larger: an open-plan office, a hall, an atrium.
3. Stairs and some other rooms are closed, shafts are solid, long hallways have doors across.
4. Doors are cut, many of them one cell wide; then furniture is put where it leaves a way around each piece.
"""

import dataclasses
import enum
from collections.abc import Mapping

import numpy as np

from potlp_jax.environments.campus.blocks import HALLWAYS, MIN_SIDE, BlockBuilder, BlockStyle, Box
from potlp_jax.environments.campus.furnishing import NO_ROOM, Floor, Kind
from potlp_jax.environments.campus.furniture import Furniture, put_furniture
from potlp_jax.environments.campus.outlines import Outline, Wing

_SEGMENT = (30, 60)
"""Columns of a stretch along a hallway that is drawn as a whole, as departments are; 15 to 30 m."""
_CORE = (22, 100)
"""Least and largest side of a core that is one thing, a gym for instance: 11 to 50 m."""
_LARGE_ROOM = 240
"""Cells of a room that may have wide doors: 60 square metres."""

_MIXES: tuple[Mapping[Kind, float], ...] = (
    {Kind.OFFICE: 0.52, Kind.OTHER: 0.38, Kind.LAB: 0.06, Kind.CLASSROOM: 0.04},
    {Kind.LAB: 0.4, Kind.OTHER: 0.38, Kind.OFFICE: 0.17, Kind.CLASSROOM: 0.05},
    {Kind.CLASSROOM: 0.5, Kind.OTHER: 0.4, Kind.OFFICE: 0.07, Kind.LAB: 0.03},
    {Kind.OTHER: 0.78, Kind.OFFICE: 0.12, Kind.CLASSROOM: 0.1},
)
"""Kinds of rooms in a row of each of ``CampusStyle.departments``."""

_GRAIN_OF = {Kind.OFFICE: 1.0, Kind.LAB: 0.7, Kind.CLASSROOM: 0.7, Kind.OTHER: 0.4}
"""Powers of the grain that rooms of a kind are wider by: laboratories are wide anyway, and closets small."""


class Part(enum.StrEnum):
    """What a building may have beside rooms along hallways."""

    ATRIUM = "atrium"
    FURNISHED_HALL = "furnished hall"
    COURTYARD = "courtyard"
    OPEN_PLAN = "open-plan office"
    LARGE_ROOM = "large room"
    STAIRS = "stairs"
    SHAFT = "shaft"
    CLOSED_ROOM = "closed room"
    HALLWAY_DOOR = "door across a hallway"


@dataclasses.dataclass(frozen=True)
class CampusStyle(BlockStyle):
    """How one building is: lengths in cells, chances for each of what they are about.

    Attributes:
        departments: chances that a row of rooms has offices, laboratories, classrooms, or mostly other rooms.
        grain: offices are so many times as wide as on the floors of ``delivery``, other rooms by less.
        atrium, open_plan, large_room: chance that a stretch along a hallway is one.
        core: chance that a block with hallways on both sides is one thing: a large room, a courtyard or an atrium.
        stairs, shaft: chance that a small room that is no office is one.
        closed: chance that a room cannot be entered.
        narrow_door: chance that a door is one cell wide.
        wide_door: chance that a door of a large room is four cells wide.
        hallway_door: chance of a door across, for every 30 m of a wing's hallway.

    Of what ``BlockStyle`` says, hallways within blocks, lobbies and blocks that stay outdoors are rarer by default:
    wings have hallways, atria and courts of their own.
    """

    severed: float = 0.1
    split: float = 0.06
    outdoors: float = 0.06
    lobby: float = 0.05
    room_behind: float = 0.4
    departments: tuple[float, ...] = (0.4, 0.15, 0.3, 0.15)
    grain: float = 1.4
    atrium: float = 0.06
    open_plan: float = 0.06
    large_room: float = 0.14
    core: float = 0.4
    stairs: float = 0.15
    shaft: float = 0.1
    closed: float = 0.06
    narrow_door: float = 0.3
    wide_door: float = 0.4
    hallway_door: float = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class CampusFloor(Floor):
    """A floor, and what it was drawn as.

    Attributes:
        outline: the building's form.
        parts: what it has.
    """

    outline: Outline = Outline.BAR
    parts: frozenset[Part] = frozenset()


class CampusBuilder(BlockBuilder):
    """Draws one floor.

    Attributes:
        parts: what it has so far.
    """

    style: CampusStyle

    def __init__(self, style: CampusStyle, rng: np.random.Generator, shape: tuple[int, int]) -> None:
        super().__init__(style, rng, shape)
        self.style = style
        self.parts: set[Part] = set()
        # Furnished once doors are cut, because nothing may stand before them.
        self._furniture: list[tuple[Box, Furniture]] = []

    def build(self, outline: Outline, wings: tuple[Wing, ...], resolution: float) -> CampusFloor:
        """Draw the floor of these wings, once: what is built stays in the builder.

        Args:
            outline: what the wings are an outline of; the floor says so, and nothing else depends on it.
            wings: inside of the builder's array, in the order of ``draw_wings``: a hallway runs on to the hallways of
                wings before its own.
            resolution: side of a cell in metres.

        Returns:
            The floor, mirrored at random along both axes. Rooms that could get no door are solid, unlike those that
            are meant to have none (``Floor.closed``). Where there is no office, laboratory or classroom, a room of a
            kind of which there are several has become one.
        """
        ground = np.zeros(self.rooms.shape, bool)
        for wing in wings:
            ground[wing.box.cells] = True
        hallways = [self._carve_pair(wing) if wing.deep else [self._carve_spine(wing, ground)] for wing in wings]
        for wing, own in zip(wings, hallways, strict=True):
            for strip in self._strips(wing, own):
                for block in self._between_crossings(strip, wing.turned):
                    self.divide(block)
        for wing, own in zip(wings, hallways, strict=True):
            for hallway in own:
                self._close_across(hallway, wing.turned)
        self._close_rooms()
        reached = self.open_doors()
        self._complete_kinds(reached - {HALLWAYS})
        for box, how in self._furniture:
            put_furniture(self.rooms, self.doors, box, how, self.rng)
        return self._mirrored(self.finish(reached, resolution), outline)

    # Wings

    def _carve_spine(self, wing: Wing, ground: np.ndarray) -> Box:
        """The hallway along a wing, on to the hallways of the wings before it that lie straight ahead."""
        box = wing.box.turned if wing.turned else wing.box
        low, high = self.style.hallway_width
        width = int(self.rng.integers(low, high + 1))
        top = box.top + self._depth_above(box.height, width)
        # Everything in blocks is written for hallways from the first row to the last: rows and columns change places.
        left, right = self._extended(box.rows(top, top + width), wing.turned, ground)
        spine = Box(left, right, top, top + width)
        self.carve_hallway(spine, not wing.turned, severable=False)
        return spine.turned

    def _depth_above(self, depth: int, width: int) -> int:
        """Rows of a wing before its hallway: as many as rooms can fill, here and behind it."""
        beside, most = depth - width, self.style.row_depth
        # A shallow wing may have rooms on one side only: there is the outer wall on the other.
        if beside - 1 <= most and self.chance(0.3):
            return int(self.rng.choice([1, beside - 1]))
        low, high = max(MIN_SIDE + 2, beside - most), min(most, beside - MIN_SIDE - 2)
        return int(self.rng.integers(low, high + 1)) if low <= high else beside // 2

    def _extended(self, line: Box, turned: bool, ground: np.ndarray) -> tuple[int, int]:
        """First and last column of a hallway, as far as there are wings before the next hallway on its way."""
        rooms, land = (self.rooms.T, ground.T) if turned else (self.rooms, ground)
        rows = slice(line.top, line.bottom)
        hallway: np.ndarray = np.all(rooms[rows] == HALLWAYS, axis=0)
        built: np.ndarray = np.all(land[rows], axis=0)
        ends = []
        for first, step in ((line.left - 1, -1), (line.right, 1)):
            column = first
            while 0 <= column < rooms.shape[1] and built[column] and not hallway[column]:
                column += step
            meets = 0 <= column < rooms.shape[1] and hallway[column]
            ends.append(column - step if meets else first - step)
        return ends[0], ends[1] + 1

    def _carve_pair(self, wing: Wing) -> list[Box]:
        """Two hallways along a deep wing, and others across it that join them: loops around a core."""
        box = wing.box.turned if wing.turned else wing.box
        rooms = self.rooms.T if wing.turned else self.rooms
        low, high = self.style.hallway_width
        width = int(self.rng.integers(low, high + 1))
        # What remains for the core is a room's least side with its walls, at least.
        most = min((box.height - 2 * width - MIN_SIDE - 2) // 2, self.style.row_depth)
        above, below, *ends = (int(side) for side in self.rng.integers(MIN_SIDE + 2, most + 1, size=4))
        along = box.columns(box.left + 1, box.right - 1)
        pair = [along.rows(along.top + above, along.top + above + width)]
        pair.append(along.rows(along.bottom - below - width, along.bottom - below))
        between = box.rows(pair[0].bottom, pair[1].top)
        # One near each end, and one for every 40 m or so.
        places = np.linspace(ends[0], box.width - ends[1] - width, 2 + box.width // 100)
        across = [between.columns(box.left + int(place), box.left + int(place) + width) for place in places]
        for hallway in (*pair, *across):
            rooms[hallway.cells] = HALLWAYS
        return pair

    def _strips(self, wing: Wing, hallways: list[Box]) -> list[Box]:
        """What lies beside and between the hallways along a wing."""
        box = wing.box.turned if wing.turned else wing.box
        edges = [box.top, *(edge for hallway in hallways for edge in (hallway.top, hallway.bottom)), box.bottom]
        return [box.rows(top, bottom) for top, bottom in zip(edges[::2], edges[1::2], strict=True)]

    def _between_crossings(self, strip: Box, turned: bool) -> list[Box]:
        """The blocks of a strip, between the hallways that cross it."""
        rooms = self.rooms.T if turned else self.rooms
        if strip.height < MIN_SIDE + 2:
            return []
        crossed = (rooms[strip.cells] == HALLWAYS).any(axis=0)
        edges = strip.left + np.flatnonzero(np.diff(np.concatenate([[1], crossed.astype(np.int8), [1]])))
        found = [strip.columns(int(first), int(last)) for first, last in zip(edges[::2], edges[1::2], strict=True)]
        return [block.turned if turned else block for block in found if block.width >= MIN_SIDE + 2]

    def _close_across(self, spine: Box, turned: bool) -> None:
        """Doors across a long hallway."""
        rooms, doors = (self.rooms.T, self.doors.T) if turned else (self.rooms, self.doors)
        for start in range(spine.left, spine.right - 60, 60):
            column = start + int(self.rng.integers(20, 60))
            if not self.chance(self.style.hallway_door):
                continue
            across, beside = slice(spine.top, spine.bottom), [spine.top - 1, spine.bottom]
            # Only where the hallway is one, with a wall on both sides.
            around = rooms[across, column - 1 : column + 2]
            if (around == HALLWAYS).all() and (rooms[beside, column] == NO_ROOM).all():
                width = min(2, spine.height)
                first = spine.top + (spine.height - width) // 2
                rooms[across, column] = NO_ROOM
                rooms[first : first + width, column] = HALLWAYS
                doors[first : first + width, column] = True
                self.parts.add(Part.HALLWAY_DOOR)

    # What fills a wing

    def draw_mix(self, depth: int) -> Mapping[Kind, float]:
        """Departments of a building are those that its style says, however deep the row is."""
        return _MIXES[int(self.rng.choice(len(_MIXES), p=self.style.departments))]

    def room_width(self, kind: Kind) -> tuple[int, int]:
        """As in ``blocks``, as many times as the building's grain says."""
        low, high = super().room_width(kind)
        grain = self.style.grain ** _GRAIN_OF[kind]
        return max(round(low * grain), MIN_SIDE), max(round(high * grain), MIN_SIDE + 1)

    def divide(self, block: Box) -> None:
        """As in ``blocks``, but for cores that are one thing."""
        low, high = _CORE
        inner = any(all(self.contacts(block, turned)) for turned in (False, True))
        sides = sorted((block.height, block.width))
        if inner and low <= sides[0] and sides[1] <= high and self.chance(self.style.core):
            choices = [Part.LARGE_ROOM, Part.COURTYARD, Part.ATRIUM]
            self._add_part(choices[int(self.rng.choice(3, p=[0.5, 0.35, 0.15]))], block)
        else:
            super().divide(block)

    def deepest_small(self) -> int:
        """As in ``blocks``, and deeper where rooms are wider."""
        return round(super().deepest_small() * min(self.style.grain, 1.6))

    def fill(self, block: Box, turned: bool) -> None:
        """Stretches along the block, each of which is rooms or one larger part."""
        box = block.turned if turned else block
        if box.width > _SEGMENT[0] + _SEGMENT[1]:
            wall = box.left + int(self.rng.integers(*_SEGMENT))
            # Neighbouring stretches share a wall.
            for part in (box.columns(box.left, wall + 1), box.columns(wall, box.right)):
                self.fill(part.turned if turned else part, turned)
            return
        part = self._draw_part(box)
        if part is None or not any(self.contacts(block, turned)):
            super().fill(block, turned)
            return
        length = min(int(self.rng.integers(20, 61)), box.width)
        # What would remain is too short for rooms.
        length = box.width if box.width - length < 2 * MIN_SIDE else length
        piece, rest = box.columns(box.left, box.left + length), box.columns(box.left + length - 1, box.right)
        self._add_part(part, piece.turned if turned else piece)
        if length < box.width:
            super().fill(rest.turned if turned else rest, turned)

    def _draw_part(self, box: Box) -> Part | None:
        """The larger part that a stretch is, or None."""
        # Smaller ones would be rooms like others: 12 cells are 6 m.
        if min(box.height, box.width) < 12:
            return None
        chances = {
            Part.ATRIUM: self.style.atrium,
            Part.OPEN_PLAN: self.style.open_plan,
            Part.LARGE_ROOM: self.style.large_room,
        }
        drawn = float(self.rng.random())
        for part, chance in chances.items():
            drawn -= chance
            if drawn < 0:
                return part
        return None

    def _add_part(self, part: Part, block: Box) -> None:
        self.parts.add(part)
        inside = block.inside
        if part is Part.COURTYARD:
            return
        if part is Part.ATRIUM:
            self.open_lobby(block)
            how = Furniture.TABLES if self.chance(0.5) else Furniture.PILLARS
            self._furniture.append((inside, how))
            self.parts |= {Part.FURNISHED_HALL} if how is Furniture.TABLES else set()
        elif part is Part.OPEN_PLAN:
            # What plans call shared offices and open spaces stands in for laboratories (room_kinds.yaml).
            super().add_room(inside, Kind.LAB)
            self._furniture.append((inside, Furniture.DESKS))
        else:
            kind = Kind(int(self.rng.choice([Kind.OTHER, Kind.CLASSROOM], p=[0.6, 0.4])))
            super().add_room(inside, kind)
            # Libraries and canteens; a gym or a lecture hall is empty or as good as.
            how = [None, Furniture.SHELVES, Furniture.TABLES][int(self.rng.integers(3))]
            if how is not None:
                self._furniture.append((inside, how))

    def add_room(self, box: Box, kind: Kind) -> None:
        """A room; one of no particular kind may be stairs, or a shaft and solid."""
        if kind is Kind.OTHER and self.chance(self.style.shaft):
            self.parts.add(Part.SHAFT)
            return
        super().add_room(box, kind)
        if kind is Kind.OTHER and self.chance(self.style.stairs):
            self.parts.add(Part.STAIRS)
            self.closed.add(len(self.kinds) - 1)

    # Doors and kinds

    def _close_rooms(self) -> None:
        for number in range(1, len(self.kinds)):
            if self.chance(self.style.closed):
                self.parts.add(Part.CLOSED_ROOM)
                self.closed.add(number)

    def door_width(self, number: int) -> int:
        """One cell, two, or four for large rooms."""
        box = self.boxes[number - 1]
        if box.height * box.width >= _LARGE_ROOM and self.chance(self.style.wide_door):
            return 4
        return 1 if self.chance(self.style.narrow_door) else 2

    def _complete_kinds(self, rooms: set[int]) -> None:
        """Rooms of other kinds become the office, the laboratory or the classroom that the building lacks."""
        for kind in (Kind.CLASSROOM, Kind.LAB, Kind.OFFICE):
            kinds = [self.kinds[number] for number in sorted(rooms)]
            spare = [number for number in sorted(rooms) if kinds.count(self.kinds[number]) > 1]
            if kind not in kinds and spare:
                # Offices are small, the others large.
                area = {number: self.boxes[number - 1].height * self.boxes[number - 1].width for number in spare}
                chosen = min(spare, key=area.__getitem__) if kind is Kind.OFFICE else max(spare, key=area.__getitem__)
                self.kinds[chosen] = kind

    def _mirrored(self, floor: Floor, outline: Outline) -> CampusFloor:
        steps = tuple(int(step) for step in self.rng.choice([-1, 1], size=2))
        rooms, doors = (np.ascontiguousarray(cells[:: steps[0], :: steps[1]]) for cells in (floor.rooms, floor.doors))
        return CampusFloor(
            rooms, doors, floor.kinds, floor.resolution, floor.closed, outline=outline, parts=frozenset(self.parts)
        )
