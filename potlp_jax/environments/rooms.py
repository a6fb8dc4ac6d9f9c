"""Floors of many rooms with loops: the same building never twice, for any formula over its propositions.

A floor is a lattice of rooms of uneven sizes. Doors join them to a spanning tree, further doors close loops, and some
rooms hold an obstacle. Each proposition is true on a few patches; patches may overlap, so that letters with several
propositions occur.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Int32, PRNGKeyArray

from potlp_jax.checks import SHARE, require_fields
from potlp_jax.environments.base import Generator, host_generators
from potlp_jax.errors import WorldError
from potlp_jax.task.propositions import in_formula
from potlp_jax.world.grid import World, make_world, pad_world
from potlp_jax.world.settings import Settings

OBSTACLE = 3
"""Cells of a side of an obstacle."""


@dataclasses.dataclass(frozen=True)
class RoomsConfig:
    """Sizes in cells.

    Attributes:
        propositions: names; each gets ``patches`` patches.
        smallest, largest: bounds of the floor's height and width, drawn apart; arrays always have the largest size.
        room: least side of a room, walls left out; the last room of a row may be one cell narrower. Rooms are up to
            about twice as large.
        door_width: of every door.
        loops: probability of a door between neighbouring rooms that the spanning tree does not join.
        obstacles: probability of an obstacle in the middle of a room that has space to go around it.
        patches, patch_radius: how many patches a proposition has, and how far a patch reaches from its middle.
    """

    propositions: tuple[str, ...] = ("a", "b", "c")
    smallest: int = 48
    largest: int = 128
    room: int = 9
    door_width: int = 2
    loops: float = 0.3
    obstacles: float = 0.3
    patches: int = 2
    patch_radius: int = 1

    def __post_init__(self) -> None:
        if not 2 * (self.room + 1) < self.smallest <= self.largest:
            raise WorldError(
                f"smallest={self.smallest} must hold two rooms of {self.room} cells a side and not exceed "
                f"largest={self.largest}"
            )
        if not 1 <= self.door_width < self.room or self.patches < 1 or not 0 <= self.patch_radius < self.room // 2:
            raise WorldError("door_width, patches and patch_radius must be positive and smaller than a room")
        if not self.propositions:
            raise WorldError("propositions is empty; give at least one")
        require_fields(self, ("loops", "obstacles"), SHARE, WorldError)


class Rooms(Generator):
    """Generator of floors of rooms."""

    name = "rooms"
    # Floors of this size have more open doors at a time than the default keeps.
    settings = Settings({"decision": {"frontiers": {"max_subgoals": 48}}})

    def __init__(self, config: RoomsConfig | None = None) -> None:
        self.config: RoomsConfig = RoomsConfig() if config is None else config
        self.propositions = self.config.propositions
        self.tasks = _tasks(self.propositions)

    @classmethod
    def toy(cls) -> "Rooms":
        """Floors of 16 to 24 cells a side."""
        return cls(RoomsConfig(smallest=16, largest=24, room=5, patches=1, patch_radius=0))

    def draw(self, key: PRNGKeyArray) -> World:
        """The floor of this key."""
        (rng,) = host_generators(key, 1)
        # The size, then the walls, the doors, the start and the letters: the order of the draws is part of the world.
        height, width = (int(rng.integers(self.config.smallest, self.config.largest + 1)) for _ in range(2))
        rows, columns = (_walls(rng, size, self.config.room) for size in (height, width))
        occupied = _floor(rng, self.config, rows, columns)
        free = np.argwhere(~occupied)
        start = free[rng.integers(len(free))]
        letters = _letters(rng, self.config, occupied)
        world = make_world(occupied, letters, (int(start[0]), int(start[1])), propositions=self.propositions)
        # All floors of a family have one array shape, so that one compilation serves them all.
        return pad_world(world, self.config.largest, self.config.largest)


def _tasks(propositions: tuple[str, ...]) -> dict[str, str]:
    """Find each proposition, in any order (1) and in the order of their names (2)."""
    names = [in_formula(name) for name in propositions]
    ordered = f"F {names[-1]}"
    for name in reversed(names[:-1]):
        ordered = f"F({name} & {ordered})"
    return {"1": " & ".join(f"F {name}" for name in names), "2": ordered}


def _walls(rng: np.random.Generator, size: int, room: int) -> list[int]:
    """Positions of the walls across one axis, both ends included, at least a room apart."""
    walls = [0]
    # As long as two rooms and the wall between them fit; what remains at the end is the last room.
    while size - 1 - walls[-1] > 2 * (room + 1):
        walls.append(walls[-1] + 1 + int(rng.integers(room, min(2 * room, size - 2 - walls[-1] - room) + 1)))
    return [*walls, size - 1]


def _floor(
    rng: np.random.Generator, config: RoomsConfig, rows: list[int], columns: list[int]
) -> Bool[np.ndarray, "H W"]:
    occupied = np.zeros((rows[-1] + 1, columns[-1] + 1), bool)
    occupied[rows] = True
    occupied[:, columns] = True
    for i in range(len(rows) - 1):
        for j in range(len(columns) - 1):
            sides = rows[i + 1] - rows[i] - 1, columns[j + 1] - columns[j] - 1
            # The draw is part of the world, also where an obstacle would leave no way around it.
            if rng.random() < config.obstacles and min(sides) >= OBSTACLE + 2:
                row, column = (rows[i] + rows[i + 1]) // 2, (columns[j] + columns[j + 1]) // 2
                around = OBSTACLE // 2
                occupied[row - around : row + around + 1, column - around : column + around + 1] = True
    for first, second in _doors(rng, config, len(rows) - 1, len(columns) - 1):
        _carve(rng, occupied, config.door_width, rows, columns, first, second)
    return occupied


def _doors(
    rng: np.random.Generator, config: RoomsConfig, height: int, width: int
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Pairs of neighbouring rooms to join: a random spanning tree (Kruskal), and some of the others."""
    down = [((i, j), (i + 1, j)) for i in range(height - 1) for j in range(width)]
    pairs = down + [((i, j), (i, j + 1)) for i in range(height) for j in range(width - 1)]
    # Union-find without ranks: there are at most some hundred rooms.
    group = {(i, j): (i, j) for i in range(height) for j in range(width)}
    joined = []
    for index in rng.permutation(len(pairs)):
        first, second = pairs[index]
        # A door between two groups belongs to the tree; one inside of a group closes a loop.
        separate = group[first] != group[second]
        if separate or rng.random() < config.loops:
            joined.append((first, second))
        if separate:
            old, new = group[first], group[second]
            group = {room: new if member == old else member for room, member in group.items()}
    return joined


def _carve(
    rng: np.random.Generator,
    occupied: Bool[np.ndarray, "H W"],
    width: int,
    rows: list[int],
    columns: list[int],
    first: tuple[int, int],
    second: tuple[int, int],
) -> None:
    """Open a door in the wall between two neighbouring rooms."""
    # ``first`` is above or to the left of ``second``, so the wall is the one after ``first``.
    (i, j), below = first, first[0] != second[0]
    along = (columns[j], columns[j + 1]) if below else (rows[i], rows[i + 1])
    start = int(rng.integers(along[0] + 1, along[1] - width + 1))
    door = slice(start, start + width)
    if below:
        occupied[rows[i + 1], door] = False
    else:
        occupied[door, columns[j + 1]] = False


def _letters(
    rng: np.random.Generator, config: RoomsConfig, occupied: Bool[np.ndarray, "H W"]
) -> Int32[np.ndarray, "H W"]:
    letters = np.zeros(occupied.shape, np.int32)
    free = np.argwhere(~occupied)
    for bit in range(len(config.propositions)):
        # Middles of patches are drawn from all free cells, with replacement: patches may coincide.
        for row, column in free[rng.integers(len(free), size=config.patches)]:
            reach = config.patch_radius
            patch = (slice(max(row - reach, 0), row + reach + 1), slice(max(column - reach, 0), column + reach + 1))
            letters[patch] |= 1 << bit
    # Patches reach over walls; an obstacle has no letter.
    return np.where(occupied, 0, letters).astype(np.int32)
