"""What floors of academic buildings have in common, wherever they come from: kinds of rooms, people, light, colours.

A ``Floor`` says which room each free cell belongs to and of what kind the rooms are. ``furnish`` makes it a world: a
professor stands in an office, a graduate student in a laboratory, an undergraduate in a classroom, each in a room drawn
uniformly from those of its kind; the robot starts anywhere in the hallways.

Light. Bradley et al. 2021, section V-B, say of rooms only: those that are occupied have the lights on, others are not
illuminated. Hallways are therefore lit (by an amount that differs between worlds), rooms of every kind are dark unless
somebody is in them. The cells of a doorway are as light as the room behind it.

Walls are a cell thick in most places, and a cell has one colour: that of the room beside it, where several are, of the
first of classroom, laboratory, office, other room, hallway. The wall between a hallway and a laboratory is the
laboratory's on both sides; between a laboratory and an office, too.
"""

import dataclasses
import enum
from collections.abc import Collection, Mapping
from types import MappingProxyType

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float32, Int32, PRNGKeyArray

from potlp_jax.environments.base import host_generators
from potlp_jax.errors import WorldError
from potlp_jax.world.grid import Appearance, World, make_world
from potlp_jax.world.settings import Settings

Cell = tuple[int, int]

NO_ROOM: int = -1
"""Number of no room: the cell is an obstacle."""


class Kind(enum.IntEnum):
    """What a room is for; where two meet at a wall, the larger value gives its colour."""

    HALLWAY = 0
    OTHER = 1
    OFFICE = 2
    LAB = 3
    CLASSROOM = 4


@dataclasses.dataclass(frozen=True)
class Errand:
    """What there is to do on a floor. Plain values, because generators go to other processes.

    Attributes:
        rooms: the kinds of room in which each proposition may hold, in the order of the letters' bits. No two hold in
            the same room.
        tasks: formulas by number.
    """

    rooms: Mapping[str, tuple[Kind, ...]]
    tasks: Mapping[str, str]

    @property
    def propositions(self) -> tuple[str, ...]:
        """In the order of the letters' bits."""
        return tuple(self.rooms)


PEOPLE: Errand = Errand(
    rooms={"professor": (Kind.OFFICE,), "grad": (Kind.LAB,), "undergrad": (Kind.CLASSROOM,)},
    tasks={"1": "F professor & F grad & F undergrad"},
)
"""Bradley et al. 2021, section V-B."""

_ANY_ROOM = (Kind.OTHER, Kind.OFFICE, Kind.LAB, Kind.CLASSROOM)

PARCELS: Errand = Errand(
    rooms={"document": _ANY_ROOM, "package": _ANY_ROOM},
    tasks={"1": "F document & F package", "2": "F (document & F package)"},
)
"""Bradley et al. 2021, section V-C: a document and a package for two people, in any order or the document first."""

# Thirty doors that may all lead to one unseen hallway are not thirty chances, and what it costs when all of them fail
# outweighs all else where it is large (docs/results/delivery.md, "Chances that are one").
_SMALL_CHANCES = {"least_chance": 0.1, "dead_end_factor": 0.5}

MANY_DOORS: Settings = Settings({"decision": {"frontiers": {"max_subgoals": 64}, **_SMALL_CHANCES}, "panoramas": 64})
"""Settings of trials: from a hallway one sees 18 to 27 doors at a time, in the mean of a trial; and up to 28 panoramas
still showed a frontier at a time."""

NARROW_DOORS: Settings = Settings(
    {"decision": {"frontiers": {"max_subgoals": 96, "min_size": 1}, **_SMALL_CHANCES}, "panoramas": 128}
)
"""Settings of trials where a door may be as narrow as one cell, as after resampling the map of a real building: a
frontier is to be dropped only where it is smaller than any passage (docs/model.md section 6). Slivers that stay open
are remembered: up to 59 panoramas still showed a frontier at a time."""

_WALL_COLOURS = {
    Kind.HALLWAY: (208, 204, 194),
    Kind.OTHER: (160, 152, 150),
    Kind.OFFICE: (108, 146, 212),
    Kind.LAB: (110, 190, 120),
    Kind.CLASSROOM: (226, 170, 84),
}
_FLOOR_COLOURS = {
    Kind.HALLWAY: (150, 150, 152),
    Kind.OTHER: (132, 128, 124),
    Kind.OFFICE: (136, 140, 150),
    Kind.LAB: (140, 150, 140),
    Kind.CLASSROOM: (158, 146, 128),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Floor:
    """A floor without people.

    Attributes:
        rooms: number of the room of each free cell, ``NO_ROOM`` on obstacles. A door's cells belong to the room behind
            it, not to the hallway.
        doors: the cells of doors.
        kinds: the kind of each room, by its number.
        resolution: side of a cell in metres.
        closed: numbers of the rooms whose doors are closed: nobody is in them, and they cannot be entered.
    """

    rooms: Int32[np.ndarray, "H W"]
    doors: Bool[np.ndarray, "H W"]
    kinds: tuple[Kind, ...]
    resolution: float
    closed: frozenset[int] = frozenset()

    @property
    def occupied(self) -> Bool[np.ndarray, "H W"]:
        """True on obstacles."""
        return self.rooms == NO_ROOM

    @property
    def kind_of_cell(self) -> Int32[np.ndarray, "H W"]:
        """The ``Kind`` of each free cell's room; ``NO_ROOM`` on obstacles."""
        # NO_ROOM is -1, which indexes the entry that is appended.
        return np.append(np.array(self.kinds, np.int32), np.int32(NO_ROOM))[self.rooms]

    def rooms_of(self, kind: Kind) -> list[int]:
        """Numbers of the rooms of a kind that can be entered."""
        return [number for number, found in enumerate(self.kinds) if found is kind and number not in self.closed]


@dataclasses.dataclass(frozen=True)
class FurnishConfig:
    """People, light and colours.

    Attributes:
        person_radius: a person is met on a square of ``2 * person_radius + 1`` cells a side, inside of the room.
        coloured: whether walls and floors tell the kind of a room; else hallways and rooms all look alike.
        hallway_light: bounds of the hallways' brightness, drawn once a world.
        tint: largest shift of each colour, per world; tint_noise: of the brightness, per cell (both of 255).
    """

    person_radius: int = 1
    coloured: bool = True
    hallway_light: tuple[float, float] = (0.6, 1.0)
    tint: int = 16
    tint_noise: int = 3

    def __post_init__(self) -> None:
        low, high = self.hallway_light
        if self.person_radius < 0 or not 0 <= low <= high <= 1 or self.tint < 0 or self.tint_noise < 0:
            raise WorldError(
                "person_radius, tint and tint_noise must not be negative, and hallway_light two numbers of 0 to 1 in "
                f"increasing order; found {self}"
            )


@dataclasses.dataclass(frozen=True)
class Placement:
    """Who is where.

    Attributes:
        start: the robot's first cell.
        rooms, cells: number of the room and middle cell of each person, by proposition.
        hallway_light: brightness of the hallways.
    """

    start: Cell
    rooms: Mapping[str, int]
    cells: Mapping[str, Cell]
    hallway_light: float


def absent_propositions(floor: Floor, errand: Errand) -> tuple[str, ...]:
    """Those for which the floor has no room, in the order of the letters' bits; where rooms are too few, the last."""
    present: dict[str, tuple[Kind, ...]] = {}
    for name, kinds in errand.rooms.items():
        if kinds not in missing_kinds(floor, Errand({**present, name: kinds}, {})):
            present[name] = kinds
    return tuple(name for name in errand.propositions if name not in present)


def missing_kinds(floor: Floor, errand: Errand, absent: Collection[str] = ()) -> tuple[tuple[Kind, ...], ...]:
    """The kinds of room of which the floor has too few.

    Args:
        floor: the building.
        errand: who needs a room; the robot needs a hallway.
        absent: propositions that need none.

    Returns:
        For each kind (or choice of kinds) of which there is no room, or too few for all who need one.
    """
    # The robot starts in a hallway, so that one is needed, too.
    needed = [(Kind.HALLWAY,), *(kinds for name, kinds in errand.rooms.items() if name not in absent)]
    rooms = {kinds: [number for kind in kinds for number in floor.rooms_of(kind)] for kinds in needed}
    # As many rooms as there are people with the same choice of kinds, because no two share a room.
    return tuple(kinds for kinds in rooms if len(rooms[kinds]) < needed.count(kinds))


def furnish(
    floor: Floor,
    key: PRNGKeyArray,
    errand: Errand,
    config: FurnishConfig,
    shape: tuple[int, int],
    absent: Collection[str] = (),
) -> tuple[World, Placement]:
    """The floor with people, a start, light and colours, all drawn by key; costs are in metres.

    Args:
        floor: the building without people.
        key: of the world; used for nothing else.
        errand: who has to be placed, and in which kinds of rooms.
        config: people, light and colours.
        shape: rows and columns of the world's arrays: what is missing is solid and no part of its ``extent``. Two
            floors of one shape cost one compilation.
        absent: propositions that hold nowhere. Their bits stay, so that letters mean the same on every floor.

    Returns:
        The world, and who is where in it.

    Raises:
        WorldError: a room that somebody or the robot needs is missing, or the floor is larger than ``shape``.
    """
    # Before anything is drawn: the message names what a person could change, a failed draw would not.
    missing = missing_kinds(floor, errand, absent)
    if missing:
        raise WorldError(f"the floor has too few rooms of kind {name_kinds(missing)}, which the errand needs")
    # Padding is solid and belongs to no room; the extent remembers the size of the building.
    extent = floor.rooms.shape
    floor = _padded(floor, shape)
    # Separate streams, so that another palette moves nobody.
    people_rng, look_rng = host_generators(key, 2)
    placement = _place_people(floor, people_rng, errand, config, absent)
    look = _appearance(floor, placement, look_rng, config)
    letters = _letters(floor, placement, errand, config)
    world = make_world(floor.occupied, letters, placement.start, floor.resolution, look, errand.propositions)
    return dataclasses.replace(world, extent=jnp.asarray(np.array(extent, np.int32))), placement


def name_kinds(missing: tuple[tuple[Kind, ...], ...]) -> str:
    """What ``missing_kinds`` found, in words."""
    return ", ".join(" or ".join(kind.name.lower() for kind in kinds) for kinds in missing)


def _padded(floor: Floor, shape: tuple[int, int]) -> Floor:
    missing = [(0, size - found) for size, found in zip(shape, floor.rooms.shape, strict=True)]
    if min(missing)[1] < 0:
        raise WorldError(f"a floor of {floor.rooms.shape} cells does not fit into arrays of {shape}; give larger ones")
    rooms = np.pad(floor.rooms, missing, constant_values=NO_ROOM)
    return dataclasses.replace(floor, rooms=rooms, doors=np.pad(floor.doors, missing))


def _place_people(
    floor: Floor, rng: np.random.Generator, errand: Errand, config: FurnishConfig, absent: Collection[str]
) -> Placement:
    # A doorway is part of the room behind it, and no place to begin.
    hallway = np.isin(floor.rooms, floor.rooms_of(Kind.HALLWAY)) & ~floor.doors
    start = _draw_cell(rng, hallway)
    chosen: dict[str, int] = {}
    for name, kinds in errand.rooms.items():
        if name in absent:
            continue
        # One person a room: who is found must not tell where the next one is.
        vacant = [room for kind in kinds for room in floor.rooms_of(kind) if room not in chosen.values()]
        chosen[name] = vacant[int(rng.integers(len(vacant)))]
    # After all rooms: a person's cell does not depend on where the others stand.
    cells = {name: _draw_cell(rng, (floor.rooms == number) & ~floor.doors) for name, number in chosen.items()}
    low, high = config.hallway_light
    light = low + (high - low) * float(rng.random())
    return Placement(start, MappingProxyType(chosen), MappingProxyType(cells), light)


def _draw_cell(rng: np.random.Generator, allowed: Bool[np.ndarray, "H W"]) -> Cell:
    row, column = np.argwhere(allowed)[rng.integers(np.count_nonzero(allowed))]
    return int(row), int(column)


def _letters(floor: Floor, placement: Placement, errand: Errand, config: FurnishConfig) -> Int32[np.ndarray, "H W"]:
    letters = np.zeros(floor.rooms.shape, np.int32)
    reach = config.person_radius
    for name, (row, column) in placement.cells.items():
        bit = errand.propositions.index(name)
        patch = (slice(max(row - reach, 0), row + reach + 1), slice(max(column - reach, 0), column + reach + 1))
        # A patch that reaches over a wall or through a door would be met from the hallway; it ends at its room's walls.
        letters[patch] |= np.where(floor.rooms[patch] == placement.rooms[name], 1 << bit, 0).astype(np.int32)
    return letters


def _appearance(floor: Floor, placement: Placement, rng: np.random.Generator, config: FurnishConfig) -> Appearance:
    tints = rng.integers(-config.tint, config.tint + 1, size=(2, len(Kind), 3))
    # One value a cell for all three colours: brightness varies, hue does not.
    noise = rng.integers(-config.tint_noise, config.tint_noise + 1, size=(2, *floor.rooms.shape, 1))
    floor_palette = np.array([_FLOOR_COLOURS[kind] for kind in Kind]) + tints[0]
    wall_palette = np.array([_WALL_COLOURS[kind] for kind in Kind]) + tints[1]
    # Without colours everything looks like a room of no particular kind, hallways included.
    kinds = floor.kind_of_cell if config.coloured else np.full_like(floor.rooms, Kind.OTHER)
    return Appearance(
        # Obstacles have no floor; the index only has to exist.
        floor_colour=_colours(floor_palette[np.maximum(kinds, 0)] + noise[0]),
        wall_colour=_colours(wall_palette[_kind_of_wall(kinds)] + noise[1]),
        smoke=jnp.asarray(np.zeros(floor.rooms.shape, np.float32)),
        light=jnp.asarray(_light(floor, placement)),
    )


def _colours(values: Int32[np.ndarray, "H W 3"] | np.ndarray) -> jnp.ndarray:
    return jnp.asarray(np.clip(values, 0, 255).astype(np.uint8))


def _kind_of_wall(kinds: Int32[np.ndarray, "H W"]) -> Int32[np.ndarray, "H W"]:
    """The largest kind among a cell and its eight neighbours; ``HALLWAY`` where no room is near."""
    # Dilation takes unsigned bytes: one is added so that NO_ROOM becomes 0.
    largest = cv2.dilate((kinds + 1).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.int32) - 1
    return np.maximum(largest, Kind.HALLWAY).astype(np.int32)


def _light(floor: Floor, placement: Placement) -> Float32[np.ndarray, "H W"]:
    # The last entry is that of NO_ROOM, -1: obstacles are dark.
    lit = np.zeros(len(floor.kinds) + 1, np.float32)
    lit[floor.rooms_of(Kind.HALLWAY)] = placement.hallway_light
    lit[list(placement.rooms.values())] = 1.0
    return lit[floor.rooms]
