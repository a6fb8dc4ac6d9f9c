"""Where things are in a fire-fighting building (Bradley et al. 2021, section V-A): sizes, layouts, walls, tiles, smoke.

The robot starts in one room, the extinguisher and the exit lie in the other. One hallway, chosen uniformly, is closed
before it reaches the far room: a dead end, with the alarm at its end and green tiles on its floor. One hallway, chosen
uniformly and perhaps the same, holds a fire across its whole width, in white smoke. In the dead end the fire lies
between the mouth and the alarm, which is then out of reach without passing it.

Everything that the paper leaves open is a field of ``FirefightingConfig``. The same random numbers are drawn whatever
the configuration, so that two configurations are compared on like worlds.
"""

import dataclasses
import enum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32

from potlp_jax.checks import SHARE, require_fields, require_rules
from potlp_jax.errors import WorldError

Cell = tuple[int, int]

HALLWAYS: int = 3

PROPOSITIONS: tuple[str, ...] = ("fire", "alarm", "extinguisher", "exit")
"""Bit ``i`` of a letter is proposition ``i``."""


class Room(enum.StrEnum):
    """The two rooms."""

    LEFT = "left"
    RIGHT = "right"

    @property
    def other(self) -> "Room":
        """The room at the far end of the hallways."""
        return Room.RIGHT if self is Room.LEFT else Room.LEFT


@dataclasses.dataclass(frozen=True)
class FirefightingConfig:
    """Sizes in cells.

    Attributes:
        room_width, room_height: inside of each room.
        hallway_length: from room to room; its width; and from the middle of one hallway to the middle of the next.
        dead_end_fraction: share of the dead end's length, from its mouth, at which it is closed.
        dead_end_opens_into_robot_room: probability that the dead end's mouth is in the robot's room.
        dead_end_wall: thickness of the closing wall.
        stub_filled: whether what is left of the dead end beyond the wall is solid, or an alcove of the far room.
        alarm_depth: cells of the dead end's closed end, over its whole width, that carry the alarm.
        fire_range: where the fire begins, uniform, as a share of the length it can lie in: the whole hallway, counted
            from the left, or the dead end from its mouth to the alarm.
        fire_thickness: cells along the hallway that burn, over its whole width.
        patch_radius: extinguisher and exit are squares of ``2 * patch_radius + 1`` cells a side inside of the room.
        smoke_density: density of the smoke at the fire, per cell.
        smoke_reach: cells along the hallway over which the density falls by a factor of e.
        tile_size: side of the green tiles.
        tint: largest shift of each colour, per world; tint_noise: of the brightness, per cell (both of 255).
    """

    # What the paper leaves open was chosen with eval.calibrate_firefighting on the calibration split, so that the mean
    # costs of known map and baseline come near to those of its Table I. No learned planner was involved.
    room_width: int = 30
    room_height: int = 60
    hallway_length: int = 120
    hallway_width: int = 7
    hallway_spacing: int = 22
    dead_end_fraction: float = 0.85
    dead_end_opens_into_robot_room: float = 0.85
    dead_end_wall: int = 1
    stub_filled: bool = False
    alarm_depth: int = 1
    fire_range: tuple[float, float] = (0.1, 0.6)
    fire_thickness: int = 2
    patch_radius: int = 0
    smoke_density: float = 0.3
    smoke_reach: float = 12.0
    tile_size: int = 2
    tint: int = 12
    tint_noise: int = 3

    def __post_init__(self) -> None:
        _check(self)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every world, the border included."""
        return self.room_height + 2, 2 * self.room_width + self.hallway_length + 2

    @property
    def dead_end_length(self) -> int:
        """Open cells of the dead end, from its mouth to the closing wall."""
        return round(self.dead_end_fraction * self.hallway_length)


@dataclasses.dataclass(frozen=True)
class FirefightingLayout:
    """Where things are. Hallways are numbered from the top; columns are half-open intervals.

    Attributes:
        robot_room: room of the start; the extinguisher and the exit are in the other.
        start, extinguisher, exit: cells (the middle of a patch).
        dead_end: number of the hallway that is closed; dead_end_mouth: the room into which it opens.
        dead_end_columns: its open part; closed_columns: the cells that close it, the stub included where it is filled.
        alarm_columns: the alarm's.
        fire_hallway, fire_columns: the fire's.
    """

    robot_room: Room
    start: Cell
    extinguisher: Cell
    exit: Cell
    dead_end: int
    dead_end_mouth: Room
    dead_end_columns: tuple[int, int]
    closed_columns: tuple[int, int]
    alarm_columns: tuple[int, int]
    fire_hallway: int
    fire_columns: tuple[int, int]

    @property
    def alarm_blocked(self) -> bool:
        """Whether the fire lies in front of the alarm."""
        return self.fire_hallway == self.dead_end


class Shares(NamedTuple):
    """What a building is drawn from: independent numbers, uniform in [0, 1), one for each choice (``layout_of``)."""

    side: float
    mouth: float
    dead_end: float
    fire_hallway: float
    fire: float
    start: float
    extinguisher: float
    exit: float


@dataclasses.dataclass(frozen=True)
class Building:
    """A layout on the grid.

    Attributes:
        occupied: True on walls.
        letters: bit ``i`` is ``PROPOSITIONS[i]``.
        green: True where the floor has the dead end's tiles.
        smoke: density of the smoke per cell.
    """

    occupied: Bool[np.ndarray, "H W"]
    letters: Int32[np.ndarray, "H W"]
    green: Bool[np.ndarray, "H W"]
    smoke: Float32[np.ndarray, "H W"]


def hallway_rows(config: FirefightingConfig, hallway: int) -> tuple[int, int]:
    """The rows of a hallway, as a half-open interval."""
    # The three hallways are centred on the rooms' height; row 0 is the outer wall.
    used = (HALLWAYS - 1) * config.hallway_spacing + config.hallway_width
    first = 1 + (config.room_height - used) // 2 + hallway * config.hallway_spacing
    return first, first + config.hallway_width


def hallway_columns(config: FirefightingConfig) -> tuple[int, int]:
    """The columns of the hallways, as a half-open interval; the left room ends before it, the right begins after."""
    return 1 + config.room_width, 1 + config.room_width + config.hallway_length


def room_columns(config: FirefightingConfig, room: Room) -> tuple[int, int]:
    """The columns of a room, as a half-open interval."""
    first = 1 if room is Room.LEFT else hallway_columns(config)[1]
    return first, first + config.room_width


def layout_of(config: FirefightingConfig, shares: Shares) -> FirefightingLayout:
    """The layout that some shares choose: with independent uniform shares, the family's distribution of layouts.

    Args:
        config: sizes.
        shares: ``side``, ``mouth``, ``dead_end`` and ``fire_hallway`` choose between few; ``fire`` is how far along its
            range the fire begins; the last three choose cells.

    Returns:
        The layout.
    """
    robot_room = Room.LEFT if shares.side < 0.5 else Room.RIGHT
    mouth = robot_room if shares.mouth < config.dead_end_opens_into_robot_room else robot_room.other
    # Uniform numbers in [0, 1) times the number of hallways, rounded down.
    dead_end, fire_hallway = int(shares.dead_end * HALLWAYS), int(shares.fire_hallway * HALLWAYS)
    # A patch reaches beyond its middle, so its middle keeps a distance from the walls; the start is a single cell.
    start = _cell_at(room_cells(config, robot_room, 0), shares.start)
    far_cells = room_cells(config, robot_room.other, config.patch_radius)
    extinguisher = _cell_at(far_cells, shares.extinguisher)
    # The patches of extinguisher and exit share no cell.
    apart = np.abs(far_cells - np.array(extinguisher)).max(axis=1) > 2 * config.patch_radius
    length = config.dead_end_length
    filled = config.hallway_length - length if config.stub_filled else config.dead_end_wall
    # In the dead end the fire lies between the mouth and the alarm, elsewhere anywhere in the hallway.
    space = length - config.alarm_depth if fire_hallway == dead_end else config.hallway_length
    low, high = config.fire_range
    fire = round((low + (high - low) * shares.fire) * (space - config.fire_thickness))
    fire_from = mouth if fire_hallway == dead_end else Room.LEFT
    return FirefightingLayout(
        robot_room=robot_room,
        start=start,
        extinguisher=extinguisher,
        exit=_cell_at(far_cells[apart], shares.exit),
        dead_end=dead_end,
        dead_end_mouth=mouth,
        dead_end_columns=_columns_from(config, mouth, 0, length),
        closed_columns=_columns_from(config, mouth, length, filled),
        alarm_columns=_columns_from(config, mouth, length - config.alarm_depth, config.alarm_depth),
        fire_hallway=fire_hallway,
        fire_columns=_columns_from(config, fire_from, fire, config.fire_thickness),
    )


def building_of(config: FirefightingConfig, layout: FirefightingLayout) -> Building:
    """Walls, letters, tiles and smoke of a layout."""
    occupied = _walls(config, layout)
    green = np.zeros(config.shape, bool)
    green[slice(*hallway_rows(config, layout.dead_end)), slice(*layout.dead_end_columns)] = True
    letters = _letters(config, layout)
    return Building(occupied=occupied, letters=letters, green=green, smoke=_smoke(config, layout, occupied))


def room_cells(config: FirefightingConfig, room: Room, margin: int) -> Int32[np.ndarray, "cells 2"]:
    """The cells of a room at a distance from its walls.

    Args:
        config: sizes.
        room: which one.
        margin: cells of the room, at least, between a cell and the walls around it; 0 for all cells. The middle of a
            patch keeps ``patch_radius``, so that the patch lies inside of the room.

    Returns:
        Row and column of each on the grid, whose outermost cells are walls, in row-major order; none where the margin
        leaves none.
    """
    first, last = room_columns(config, room)
    rows = np.arange(1 + margin, 1 + config.room_height - margin)
    columns = np.arange(first + margin, last - margin)
    return np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.int32)


def _cell_at(cells: Int32[np.ndarray, "cells 2"], share: float) -> Cell:
    # The same share of any list of cells: with other sizes things stay in like places.
    row, column = cells[int(share * len(cells))]
    return int(row), int(column)


def _columns_from(config: FirefightingConfig, room: Room, distance: int, count: int) -> tuple[int, int]:
    """``count`` columns of the hallways that begin ``distance`` cells from a room."""
    first, last = hallway_columns(config)
    return (
        (first + distance, first + distance + count)
        if room is Room.LEFT
        else (last - distance - count, last - distance)
    )


def _walls(config: FirefightingConfig, layout: FirefightingLayout) -> Bool[np.ndarray, "H W"]:
    occupied = np.ones(config.shape, bool)
    for room in Room:
        occupied[1:-1, slice(*room_columns(config, room))] = False
    for hallway in range(HALLWAYS):
        occupied[slice(*hallway_rows(config, hallway)), slice(*hallway_columns(config))] = False
    # Last, because it closes a hallway that has just been opened.
    occupied[slice(*hallway_rows(config, layout.dead_end)), slice(*layout.closed_columns)] = True
    return occupied


def _letters(config: FirefightingConfig, layout: FirefightingLayout) -> Int32[np.ndarray, "H W"]:
    letters = np.zeros(config.shape, np.int32)
    bit = {name: np.int32(1 << index) for index, name in enumerate(PROPOSITIONS)}
    # The fire burns over the whole width of its hallway, so that nobody walks past it.
    letters[slice(*hallway_rows(config, layout.fire_hallway)), slice(*layout.fire_columns)] |= bit["fire"]
    letters[slice(*hallway_rows(config, layout.dead_end)), slice(*layout.alarm_columns)] |= bit["alarm"]
    for name, (row, column) in (("extinguisher", layout.extinguisher), ("exit", layout.exit)):
        reach = config.patch_radius
        letters[row - reach : row + reach + 1, column - reach : column + reach + 1] |= bit[name]
    return letters


def _smoke(
    config: FirefightingConfig, layout: FirefightingLayout, occupied: Bool[np.ndarray, "H W"]
) -> Float32[np.ndarray, "H W"]:
    """Densest at the fire, thinner along its hallway; it does not pass the wall that closes a dead end."""
    # In the dead end smoke stays behind the closing wall; in an open hallway it fills the whole length.
    burning = layout.dead_end_columns if layout.alarm_blocked else hallway_columns(config)
    columns = np.arange(config.shape[1])
    first, last = layout.fire_columns
    # Columns from the nearest end of the fire, 0 inside of it.
    away = np.maximum(np.maximum(first - columns, columns - (last - 1)), 0)
    density = config.smoke_density * np.exp(-away / config.smoke_reach)
    smoke = np.zeros(config.shape, np.float32)
    smoke[slice(*hallway_rows(config, layout.fire_hallway)), slice(*burning)] = density[slice(*burning)]
    return np.where(occupied, np.float32(0), smoke)


def _check(config: FirefightingConfig) -> None:
    # First, because lengths follow from it.
    require_fields(config, ("dead_end_fraction",), SHARE, WorldError)
    used = (HALLWAYS - 1) * config.hallway_spacing + config.hallway_width
    low, high = config.fire_range
    patch = 2 * config.patch_radius + 1
    rules = (
        (config.hallway_width >= 1, "hallway_width must be at least 1"),
        (
            config.hallway_spacing > config.hallway_width,
            "hallway_spacing must exceed hallway_width: a wall lies between",
        ),
        (used <= config.room_height, f"the three hallways need {used} rows, room_height is {config.room_height}"),
        (
            config.patch_radius >= 0 and patch <= config.room_width and 2 * patch <= config.room_height,
            f"two patches of {patch}x{patch} cells must fit the {config.room_height}x{config.room_width} room",
        ),
        # Wherever the first one lies there must be a place for the other: in the middle, it leaves the least.
        (
            max(config.room_height, config.room_width) >= 3 * patch - 1,
            f"beside a patch of {patch}x{patch} cells in the middle another must fit the "
            f"{config.room_height}x{config.room_width} room",
        ),
        (config.dead_end_wall >= 1 and config.alarm_depth >= 1, "dead_end_wall and alarm_depth must be at least 1"),
        (config.fire_thickness >= 1, "fire_thickness must be at least 1"),
        (
            config.dead_end_length >= config.alarm_depth + config.fire_thickness,
            f"the dead end, {config.dead_end_length} cells long, must hold the alarm and the fire",
        ),
        (
            config.dead_end_length + config.dead_end_wall <= config.hallway_length,
            f"dead_end_fraction {config.dead_end_fraction} leaves no space for the closing wall",
        ),
        (0 <= config.dead_end_opens_into_robot_room <= 1, "dead_end_opens_into_robot_room is a probability"),
        (0 <= low <= high <= 1, f"fire_range must be two shares in increasing order, found {config.fire_range}"),
        (0 <= config.smoke_density <= 1 and config.smoke_reach > 0, "smoke_density is a share, smoke_reach positive"),
        (config.tile_size >= 1 and config.tint >= 0 and config.tint_noise >= 0, "tiles and tints cannot be negative"),
    )
    require_rules(rules, "a fire-fighting building", WorldError)
