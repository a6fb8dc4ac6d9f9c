"""Hallways and rooms that fill the blocks of a floor: what generated floors of every size are made of.

Hallways divide a block: each new one runs across and joins the hallways that the block already touches, so that all
hallways are connected. One that meets hallways at both ends closes a loop (unless a room is put in its middle); one
that meets a hallway at one end only is a dead end at the other, and may stop short with a room behind its end. What is
left between hallways is filled with one or two rows of rooms, is a lobby, or stays outdoors. A row of rooms is mostly
offices, laboratories or classrooms, as departments are; deep rows have rooms behind rooms. Doors lead to hallways where
a room touches one, else to a neighbouring room; large rooms may have two, and some neighbours are joined, which closes
loops through rooms.

All lengths are in cells, which are meant to be half a metre.
"""

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Int

from potlp_jax.checks import require_rules
from potlp_jax.environments.campus.furnishing import NO_ROOM, Floor, Kind
from potlp_jax.errors import WorldError

HALLWAYS: int = 0
"""Number of the room that all hallways are."""
MIN_SIDE: int = 5
"""Least side of a room, in cells: 2.5 m at half a metre a cell."""
_DEEPEST_SMALL = 13
"""Deepest office or other small room; a deeper one gets another room behind it."""
_POSITIONS = 8
"""Positions of a new hallway that are compared."""

_WIDTHS = {Kind.OFFICE: (5, 9), Kind.LAB: (10, 20), Kind.CLASSROOM: (11, 20), Kind.OTHER: (4, 8)}
"""Of rooms along their row: 2.5 to 4.5 m for an office, at half a metre a cell."""

_USES = (
    ({Kind.OFFICE: 0.76, Kind.OTHER: 0.14, Kind.LAB: 0.06, Kind.CLASSROOM: 0.04}, (1.0, 0.4, 0.1)),
    ({Kind.LAB: 0.60, Kind.OFFICE: 0.24, Kind.OTHER: 0.12, Kind.CLASSROOM: 0.04}, (0.2, 0.4, 0.5)),
    ({Kind.CLASSROOM: 0.62, Kind.OTHER: 0.16, Kind.OFFICE: 0.14, Kind.LAB: 0.08}, (0.2, 0.4, 0.6)),
)
"""Kinds of rooms in a row of offices, of laboratories, of classrooms, and how likely each row is where it is at most 9
cells deep, at most 13, and deeper."""


@dataclasses.dataclass(frozen=True)
class BlockStyle:
    """How hallways and rooms fill blocks; lengths in cells.

    Attributes:
        hallway_width: least and largest.
        door_width: of every door.
        row_depth: a row of rooms is at most so deep; a block that is deeper gets a second row or another hallway.
        dead_end: probability that a hallway with one loose end stops short of the outer wall.
        severed: probability that a hallway between two others is closed by a room in its middle.
        split: probability that a block which rooms could fill is divided by another hallway.
        outdoors, lobby: probability that a block stays solid, or that a small one is a lobby.
        room_behind: probability that a small room 11 to 13 cells deep has another behind it; deeper ones always do.
        second_door: probability of a second door to the hallways, for rooms at least 12 cells wide.
        joining_door: probability, per room, of a door to a neighbouring room.
    """

    hallway_width: tuple[int, int] = (3, 6)
    door_width: int = 2
    row_depth: int = 18
    dead_end: float = 0.4
    severed: float = 0.15
    split: float = 0.15
    outdoors: float = 0.12
    lobby: float = 0.12
    room_behind: float = 0.6
    second_door: float = 0.35
    joining_door: float = 0.06

    def __post_init__(self) -> None:
        require_rules(self.rules(), "a building", WorldError)

    def rules(self) -> Iterator[tuple[bool, str]]:
        """What must hold, and how it is said where it does not."""
        chances = (
            *(self.dead_end, self.severed, self.split, self.outdoors, self.lobby),
            *(self.room_behind, self.second_door, self.joining_door),
        )
        yield (
            1 <= self.door_width <= self.hallway_width[0] <= self.hallway_width[1] <= 8,
            "door_width, and the two bounds of hallway_width, must lie in 1 to 8 in increasing order",
        )
        yield self.row_depth >= 10, "row_depth must be at least 10"
        yield all(0 <= chance <= 1 for chance in chances), "a probability must lie between 0 and 1"


@dataclasses.dataclass(frozen=True)
class Box:
    """Cells ``top <= row < bottom``, ``left <= column < right``. A block's outermost cells are its walls."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def height(self) -> int:
        return self.bottom - self.top

    @property
    def width(self) -> int:
        return self.right - self.left

    @property
    def cells(self) -> tuple[slice, slice]:
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def inside(self) -> "Box":
        return Box(self.top + 1, self.bottom - 1, self.left + 1, self.right - 1)

    @property
    def turned(self) -> "Box":
        return Box(self.left, self.right, self.top, self.bottom)

    def rows(self, top: int, bottom: int) -> "Box":
        return Box(top, bottom, self.left, self.right)

    def columns(self, left: int, right: int) -> "Box":
        return Box(self.top, self.bottom, left, right)


@dataclasses.dataclass(frozen=True)
class Wall:
    """Where a room may have doors on one of its sides: cells of the wall, in order, and the rooms beyond them."""

    rows: Int[np.ndarray, " N"]
    columns: Int[np.ndarray, " N"]
    beyond: Int[np.ndarray, " N"]


class BlockBuilder:
    """Draws hallways and rooms into blocks of one floor. Room 0 is the hallways.

    Attributes:
        style: widths, depths and probabilities.
        rng: draws everything.
        rooms: number of the room of each cell, so far.
        doors: cells of doors, so far.
        kinds: of the rooms, by number.
        boxes: of the rooms, from room 1 on.
        closed: numbers of the rooms that get no door.
    """

    def __init__(self, style: BlockStyle, rng: np.random.Generator, shape: tuple[int, int]) -> None:
        self.style, self.rng = style, rng
        self.rooms = np.full(shape, NO_ROOM, np.int32)
        self.doors = np.zeros(shape, bool)
        self.kinds: list[Kind] = [Kind.HALLWAY]
        self.boxes: list[Box] = []
        self.closed: set[int] = set()

    def build_rectangle(self, resolution: float) -> Floor:
        """One building that fills the whole array: its first hallway runs from wall to wall."""
        height, width = self.rooms.shape
        # The outermost cells of the first block are the outer walls.
        block = Box(0, height, 0, width)
        self.cut(block, self._choose_turn(block, [False, True]), first=True)
        return self.finish(self.open_doors(), resolution)

    def room_width(self, kind: Kind) -> tuple[int, int]:
        """Least and largest width of a room along its row."""
        return _WIDTHS[kind]

    def draw_mix(self, depth: int) -> Mapping[Kind, float]:
        """What the rooms of a row this deep are for: shares of the kinds."""
        # 9 and 13 cells bound the three depths for which ``_USES`` gives chances.
        uses = np.array([chances[int(np.searchsorted((9, 13), depth))] for _, chances in _USES])
        return _USES[int(self.rng.choice(len(_USES), p=uses / uses.sum()))][0]

    def deepest_small(self) -> int:
        """Depth from which on a small room has another behind it."""
        return _DEEPEST_SMALL

    def door_width(self, number: int) -> int:
        """Of the next door of a room."""
        return self.style.door_width

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    # Blocks and hallways

    def divide(self, block: Box) -> None:
        """Fill a block with rooms, or run a hallway through it and go on with what lies on both sides."""
        # Everything is written for rows; ``turned`` exchanges rows and columns.
        fits = [turned for turned in (False, True) if self._fits(block, turned)]
        cuts = [turned for turned in (False, True) if any(self.contacts(block, turned))]
        # Where rooms fit, another hallway is a matter of chance; where they do not, the block must be divided.
        if cuts and (not fits or self.chance(self.style.split)) and self.cut(block, self._choose_turn(block, cuts)):
            return
        if fits:
            self.fill(block, fits[int(self.rng.integers(len(fits)))])
        else:
            self._fill_strip(block)

    def contacts(self, block: Box, turned: bool) -> tuple[bool, bool]:
        """Whether hallways lie along the block's first and last row (first and last column if ``turned``)."""
        # Transposed arrays are views: what is written through them is written to the building.
        rooms, box = (self.rooms.T, block.turned) if turned else (self.rooms, block)
        before = rooms[box.top - 1, box.left : box.right] if box.top > 0 else np.zeros(0)
        after = rooms[box.bottom, box.left : box.right] if box.bottom < len(rooms) else np.zeros(0)
        first, last = (bool(np.count_nonzero(side == HALLWAYS) >= MIN_SIDE) for side in (before, after))
        return first, last

    def _fits(self, block: Box, turned: bool) -> bool:
        """Whether rows of rooms, one a hallway, can fill the block."""
        count = sum(self.contacts(block, turned))
        depth = block.width if turned else block.height
        return count > 0 and depth <= count * self.style.row_depth

    def _choose_turn(self, block: Box, turns: list[bool]) -> bool:
        """Across which side a hallway runs: mostly so that it divides the longer one."""
        if len(turns) == 1:
            return turns[0]
        # By squares of the sides: a block twice as long as wide is cut across its length with a chance of four in five.
        return self.chance(block.height**2 / (block.height**2 + block.width**2))

    def cut(self, block: Box, turned: bool, *, first: bool = False) -> bool:
        """Run a hallway through a block, from its first row to its last, and divide what lies on both sides of it.

        Width and place are drawn; of a few places the one counts that leaves rows of rooms the best depths.

        Args:
            block: its outermost cells are its walls.
            turned: whether the hallway runs from the first column to the last instead.
            first: whether it is the first one of a building, which need not meet another.

        Returns:
            Whether it was possible. Nothing is built where the block is too narrow for a room on each side, or the
            hallway would meet no other in any of these places.
        """
        width = int(self.rng.integers(self.style.hallway_width[0], self.style.hallway_width[1] + 1))
        box = block.turned if turned else block
        left = self._choose_position(box, width, turned, first)
        if left is None:
            return False
        self.carve_hallway(box.columns(left, left + width), turned)
        for side in (box.columns(box.left, left), box.columns(left + width, box.right)):
            self.divide(side.turned if turned else side)
        return True

    def _choose_position(self, box: Box, width: int, turned: bool, first: bool) -> int | None:
        """Of a few positions the one beside which rows of rooms fit best."""
        # The margin holds the least room, its two walls and a cell to spare.
        margin, depth = MIN_SIDE + 3, self.style.row_depth
        if box.width < 2 * margin + width:
            return None
        left = self.rng.integers(box.left + margin, box.right - margin - width + 1, size=_POSITIONS)
        joined = np.array([first or any(self.meets(box.columns(one, one + width), turned)) for one in left.tolist()])
        # One row of rooms fills a side up to its depth; a deeper side is best near 1.7 depths, which hold two rows.
        sides = np.stack([left - box.left, box.right - left - width])
        wasted = np.where(sides <= depth, 0, np.minimum(abs(sides - 1.7 * depth), depth)).sum(axis=0)
        return int(left[np.argmin(np.where(joined, wasted, np.inf))]) if joined.any() else None

    def meets(self, hallway: Box, turned: bool) -> tuple[bool, bool]:
        """Whether a hallway, over its whole width, meets another at its first row, and at its last."""
        rooms, columns = self.rooms.T if turned else self.rooms, slice(hallway.left, hallway.right)
        before = hallway.top > 0 and bool((rooms[hallway.top - 1, columns] == HALLWAYS).all())
        after = hallway.bottom < len(rooms) and bool((rooms[hallway.bottom, columns] == HALLWAYS).all())
        return before, after

    def carve_hallway(self, hallway: Box, turned: bool, *, severable: bool = True) -> None:
        """Open a hallway up to the hallways that it meets; it may stop short, or be closed in its middle.

        One that meets another at one end only, 24 cells long or more, stops short by the style's chance ``dead_end``,
        with a room behind its end.

        Args:
            hallway: its cells, from its first row to its last; rows and columns change places if ``turned``. Its first
                and last row become part of it where it meets another hallway there, and stay wall otherwise.
            turned: whether it runs from the left of the floor to its right, not from top to bottom.
            severable: whether the hallways that it joins are connected without it. Then one that meets others at both
                ends, 40 cells long or more, is closed by a room in its middle by the style's chance ``severed``.
        """
        rooms, meets = self.rooms.T if turned else self.rooms, self.meets(hallway, turned)
        top, bottom = hallway.top + (not meets[0]), hallway.bottom - (not meets[1])
        # Where the hallway meets another, its first or last row is an opening instead of a wall.
        length = bottom - top
        room = int(self.rng.integers(MIN_SIDE + 1, 13))
        parts, closed = [hallway.rows(top, bottom)], None
        # A long hallway between two others may be severed by a room, one with a loose end may stop short: dead ends.
        if severable and all(meets) and length >= 40 and self.chance(self.style.severed):
            # Not near its ends, where a stub would look like a niche.
            middle = top + int(length * self.rng.uniform(0.3, 0.6))
            parts = [hallway.rows(top, middle), hallway.rows(middle + room + 2, bottom)]
            closed = hallway.rows(middle + 1, middle + room + 1)
        elif any(meets) and not all(meets) and length >= 24 and self.chance(self.style.dead_end):
            room = min(room, length // 2)
            ends = (top + room + 1, bottom) if meets[1] else (top, bottom - room - 1)
            parts = [hallway.rows(*ends)]
            closed = hallway.rows(top, top + room) if meets[1] else hallway.rows(bottom - room, bottom)
        for part in parts:
            rooms[part.cells] = HALLWAYS
        if closed is not None:
            kind = Kind.OFFICE if self.chance(0.6) else Kind.OTHER
            self.add_room(closed.turned if turned else closed, kind)

    # Rooms

    def fill(self, block: Box, turned: bool) -> None:
        """Rows of rooms along the block's rows (columns if ``turned``), a lobby, or nothing."""
        if self.chance(self.style.outdoors):
            return
        box = block.turned if turned else block
        inside = box.inside
        # At half a metre a cell 400 cells are 100 square metres.
        if block.height * block.width <= 400 and self.chance(self.style.lobby):
            self.open_lobby(block)
        elif sum(self.contacts(block, turned)) == 2 and inside.height >= 2 * MIN_SIDE + 3:
            # Hallways on both sides and depth for two rows: back to back, with a wall somewhere in the middle half.
            slack = inside.height - 1 - 2 * MIN_SIDE
            wall = inside.top + MIN_SIDE + int(slack * self.rng.uniform(0.25, 0.75))
            self.fill_row(inside.rows(inside.top, wall), turned, front_first=True)
            self.fill_row(inside.rows(wall + 1, inside.bottom), turned, front_first=False)
        else:
            self.fill_row(inside, turned, front_first=self.contacts(block, turned)[0])

    def _fill_strip(self, block: Box) -> None:
        """Rooms along one hallway of a block too deep for them; the rest stays outdoors."""
        depth = self.style.row_depth
        for turned in (False, True):
            box, (first, last) = block.turned if turned else block, self.contacts(block, turned)
            if first or last:
                strip = box.rows(box.top, box.top + depth) if first else box.rows(box.bottom - depth, box.bottom)
                self.fill(strip.turned if turned else strip, turned)
                return

    def open_lobby(self, block: Box) -> None:
        """The block becomes part of the hallways that it touches."""
        self.rooms[block.inside.cells] = HALLWAYS
        for turned in (False, True):
            rooms, box = (self.rooms.T, block.turned) if turned else (self.rooms, block)
            for touches, line, beyond in zip(
                self.contacts(block, turned), (box.top, box.bottom - 1), (box.top - 1, box.bottom), strict=True
            ):
                # The wall opens only where the hallway really is beyond it.
                if touches:
                    columns = np.arange(box.left + 1, box.right - 1)
                    rooms[line, columns[rooms[beyond, columns] == HALLWAYS]] = HALLWAYS

    def fill_row(self, row: Box, turned: bool, front_first: bool) -> None:
        """Rooms side by side along the columns of a row, with a wall one cell thick between them.

        What the row is for is drawn first (``draw_mix``), then kind and width of each room. The last room takes what
        would be too narrow for another.

        Args:
            row: the cells of the rooms, without the walls around them; rows and columns change places if ``turned``.
            turned: whether the row runs from the top of the floor to its bottom, not from left to right.
            front_first: whether the hallway is before the first row of ``row``, not after its last: of two rooms one
                behind the other the front one lies there.
        """
        mix = self.draw_mix(row.height)
        left = row.left
        while left < row.right:
            kind = list(mix)[int(self.rng.choice(len(mix), p=list(mix.values())))]
            # A laboratory that would be as narrow as an office is one.
            if kind in (Kind.LAB, Kind.CLASSROOM) and min(row.right - left, row.height + 3) < _WIDTHS[kind][0]:
                kind = Kind.OFFICE
            low, high = self.room_width(kind)
            right = left + int(self.rng.integers(low, high + 1))
            # What remains would be too narrow for a room: the last one takes it.
            if row.right - right < MIN_SIDE + 1:
                right = row.right
            self._add_rooms_in_depth(row.columns(left, right), kind, turned, front_first)
            left = right + 1

    def _add_rooms_in_depth(self, box: Box, kind: Kind, turned: bool, front_first: bool) -> None:
        """One room, or a small one with another behind it."""
        parts = [(box, kind)]
        small, possible = kind in (Kind.OFFICE, Kind.OTHER), box.height >= 2 * MIN_SIDE + 1
        if small and possible and (box.height > self.deepest_small() or self.chance(self.style.room_behind)):
            wall = box.top + MIN_SIDE + int(self.rng.integers(0, box.height - 2 * MIN_SIDE))
            # The front room is the one beside the hallway.
            front, back = box.rows(box.top, wall), box.rows(wall + 1, box.bottom)
            if not front_first:
                front, back = back, front
            parts = [(front, kind), (back, Kind.OFFICE if self.chance(0.6) else Kind.OTHER)]
        for part, part_kind in parts:
            self.add_room(part.turned if turned else part, part_kind)

    def add_room(self, box: Box, kind: Kind) -> None:
        self.rooms[box.cells] = len(self.kinds)
        self.kinds.append(kind)
        self.boxes.append(box)

    # Doors

    def open_doors(self) -> set[int]:
        """Doors to the hallways, then from room to room; returns the rooms that can be reached."""
        boxes = {n: box for n, box in enumerate(self.boxes, start=1) if n not in self.closed}
        walls = {number: list(self.walls_of(box)) for number, box in boxes.items()}
        reached = {HALLWAYS}
        for number, box in boxes.items():
            if self.open_door(walls[number], number, HALLWAYS):
                reached.add(number)
                # Twelve cells are six metres: large rooms have two doors.
                if max(box.height, box.width) >= 12 and self.chance(self.style.second_door):
                    self.open_door(walls[number], number, HALLWAYS)
        self._reach_inner_rooms(walls, reached)
        # Doors between rooms that are reached anyway close loops. Sorted: the order of a set differs between runs.
        for number in sorted(reached - {HALLWAYS}):
            others = _neighbours(walls[number]) & reached - {HALLWAYS, number}
            if others and self.chance(self.style.joining_door):
                self.open_door(walls[number], number, sorted(others)[int(self.rng.integers(len(others)))])
        return reached

    def _reach_inner_rooms(self, walls: Mapping[int, list[Wall]], reached: set[int]) -> None:
        """Join rooms without a hallway to rooms that are reached, as far as that goes."""
        # A room behind a room behind a room is reached in the third round.
        grown = True
        while grown:
            grown = False
            for number in sorted(set(walls) - reached):
                known = sorted(_neighbours(walls[number]) & reached - {HALLWAYS})
                if any(self.open_door(walls[number], number, other) for other in known):
                    reached.add(number)
                    grown = True

    def walls_of(self, box: Box) -> Iterator[Wall]:
        rows, columns = np.arange(box.top, box.bottom), np.arange(box.left, box.right)
        for wall_rows, wall_columns, step in (
            (np.full_like(columns, box.top - 1), columns, (-1, 0)),
            (np.full_like(columns, box.bottom), columns, (1, 0)),
            (rows, np.full_like(rows, box.left - 1), (0, -1)),
            (rows, np.full_like(rows, box.right), (0, 1)),
        ):
            # The outermost wall has nothing beyond it; where that wraps around lies the opposite one.
            height, width = self.rooms.shape
            beyond = self.rooms[(wall_rows + step[0]) % height, (wall_columns + step[1]) % width]
            yield Wall(wall_rows, wall_columns, beyond)

    def open_door(self, walls: list[Wall], number: int, target: int) -> bool:
        """Open a door from a room to another, anywhere along their common walls.

        Args:
            walls: those of the room (``walls_of``).
            number: of the room; the door's cells belong to it from then on, and its ``door_width`` is taken.
            target: number of the room beyond, ``HALLWAYS`` for a hallway.

        Returns:
            Whether there is one. There is none where no stretch of the walls, as long as the door is wide, has the
            other room behind it; cells of doors are no wall any more.
        """
        width = self.door_width(number)
        places = []
        for wall in walls:
            # Cells of the wall behind which the target lies, and that are still wall.
            leads = (wall.beyond == target) & (self.rooms[wall.rows, wall.columns] == NO_ROOM)
            # First cells of stretches as long as the door is wide.
            stretches = leads[: max(len(leads) - width + 1, 0)].copy()
            for step in range(1, width):
                stretches &= leads[step : step + len(stretches)]
            places += [(wall, int(first)) for first in np.flatnonzero(stretches)]
        if not places:
            return False
        wall, first = places[int(self.rng.integers(len(places)))]
        cells = wall.rows[first : first + width], wall.columns[first : first + width]
        # A door belongs to the room that it was opened for, which is the one behind it as seen from the hallway.
        self.rooms[cells] = number
        self.doors[cells] = True
        return True

    def finish(self, reached: set[int], resolution: float) -> Floor:
        """The floor: rooms that are neither reached nor closed become solid, the others are numbered without gaps."""
        # The appended entry keeps NO_ROOM, -1, what it is.
        kept = np.array([number in reached or number in self.closed for number in range(len(self.kinds))])
        new_numbers = np.append(np.where(kept, np.cumsum(kept) - 1, NO_ROOM), NO_ROOM).astype(np.int32)
        kinds = tuple(kind for kind, keep in zip(self.kinds, kept, strict=True) if keep)
        closed = frozenset(int(new_numbers[number]) for number in self.closed)
        return Floor(new_numbers[self.rooms], self.doors, kinds, resolution, closed)


def _neighbours(walls: list[Wall]) -> set[int]:
    """The rooms beyond the walls of a room."""
    return {room for wall in walls for room in wall.beyond.tolist()} - {NO_ROOM}
