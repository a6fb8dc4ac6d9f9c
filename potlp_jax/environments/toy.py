"""Two rooms joined by a door: small enough to work distances out by hand.

The robot starts in the left room; the goal and a hazard are single cells of the right one. The hazard never seals the
door, so that both tasks can be satisfied in every world. What the configuration leaves open is drawn by the key.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.environments.base import Generator, host_generators
from potlp_jax.errors import WorldError
from potlp_jax.world.grid import World, make_world

Cell = tuple[int, int]


@dataclasses.dataclass(frozen=True)
class ToyConfig:
    """Sizes in cells, the border included; ``None`` is drawn at random.

    Attributes:
        height, width: of the grid, odd width: the wall with the door is the middle column.
        door_row: the row of the door, one cell wide.
        start: in the left room.
        goal, hazard: different cells of the right room; the hazard not in front of the door.
    """

    height: int = 9
    width: int = 15
    door_row: int | None = None
    start: Cell | None = None
    goal: Cell | None = None
    hazard: Cell | None = None

    def __post_init__(self) -> None:
        if self.height < 5 or self.width < 9 or self.width % 2 == 0:
            raise WorldError(f"a toy world needs height >= 5 and an odd width >= 9, found {self.height}x{self.width}")


class Toy(Generator):
    """Generator of two-room worlds. Propositions: goal, hazard."""

    name: str = "toy"
    propositions: tuple[str, ...] = ("goal", "hazard")
    tasks: Mapping[str, str] = MappingProxyType({"1": "F goal", "2": "!hazard U goal"})

    def __init__(self, config: ToyConfig | None = None) -> None:
        self.config: ToyConfig = ToyConfig() if config is None else config

    def draw(self, key: PRNGKeyArray) -> World:
        """The world of this key. Raises WorldError where the configuration puts something on a wall."""
        config = self.config
        (rng,) = host_generators(key, 1)
        # Rows and columns 0 and the last are the outer wall; the middle column is the wall between the rooms.
        middle = config.width // 2
        rows = np.arange(1, config.height - 1)
        occupied = np.ones((config.height, config.width), bool)
        occupied[1:-1, 1:middle] = occupied[1:-1, middle + 1 : -1] = False
        door = _pick(rng, [(int(row), middle) for row in rows], _door(config, middle), "the door")
        occupied[door] = False
        left = [(int(row), column) for row in rows for column in range(1, middle)]
        right = [(int(row), column) for row in rows for column in range(middle + 1, config.width - 1)]
        start = _pick(rng, left, config.start, "the start")
        # On the cell behind the door the hazard could not be avoided, and the second task would be impossible.
        sealing = (door[0], middle + 1)
        hazard = _pick(rng, [cell for cell in right if cell not in (sealing, config.goal)], config.hazard, "the hazard")
        goal = _pick(rng, [cell for cell in right if cell != hazard], config.goal, "the goal")
        letters = np.zeros(occupied.shape, np.int32)
        letters[goal] = 1 << self.propositions.index("goal")
        letters[hazard] = 1 << self.propositions.index("hazard")
        return make_world(occupied, letters, start, propositions=self.propositions)


def _door(config: ToyConfig, middle: int) -> Cell | None:
    return None if config.door_row is None else (config.door_row, middle)


def _pick(rng: np.random.Generator, cells: list[Cell], fixed: Cell | None, what: str) -> Cell:
    """The fixed cell, or one drawn; the draw is made in any case, so that fixing one thing does not move the others."""
    # A 32-bit number scaled to the list: the same draw whatever the number of cells, unlike that of rejection sampling.
    drawn = cells[int(rng.integers(2**32)) * len(cells) >> 32]
    if fixed is not None and fixed not in cells:
        raise WorldError(f"{what} of the toy world cannot be at {fixed}: allowed are {cells[0]} to {cells[-1]}")
    return drawn if fixed is None else fixed
