"""A building from a map, for the simulated robot: walls, what is to be found, and what a camera sees there."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, UInt8

from potlp_jax.environments.families import MAP_PREFIX
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.mapped_rooms import MappedRooms
from potlp_jax.environments.ros.ros_map import RosMap
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.trials.config import trial_config_for
from potlp_jax.trials.robot import photograph
from potlp_jax.world.camera import Disturbance
from potlp_jax.world.equirectangular import to_equirectangular
from potlp_jax.world.grid import World
from potlp_jax.world.moves import Cell, as_cell
from potlp_jax.world.sensing import SensorConfig, visible

REACH = int(SensorConfig().range_cells)
"""Cells that the robot maps around it where it sees them, as in trials."""

PICTURE = 1024, 2048
"""Rows and columns of a panorama."""


@dataclass(frozen=True, eq=False)
class Building:
    """A ``Ground`` from a ``World``: the robot maps what is in line of sight, and its camera is that of trials.

    Attributes:
        world: the truth; its letters are the places.
        frame: where its cells lie in the map's metres.
    """

    world: World
    frame: GridFrame

    @classmethod
    def from_spec(cls, spec: str, number: int) -> "Building":
        """A test world of a map.

        Args:
            spec: ``map:FILE.yaml``, whose places are labelled, or ``parcels:FILE.yaml``, whose rooms are named, with
                options (``RosMap.from_spec``, ``MappedRooms.from_spec``).
            number: of the world.

        Raises:
            MapError: the map cannot be used.
        """
        generator = (RosMap if spec.startswith(MAP_PREFIX) else MappedRooms).from_spec(spec)
        building = cls(generator.generate(world_key(Split.TEST, number, generator.name)), generator.clean.frame)
        # Compiled before the robot is there, which would be silent meanwhile.
        building.seen_from(building.start, REACH)
        building.picture_from(building.start)
        return building

    @property
    def propositions(self) -> tuple[str, ...]:
        """Of the world."""
        return self.world.propositions

    @property
    def walls(self) -> Bool[np.ndarray, "H W"]:
        """True on walls."""
        return np.asarray(self.world.occupied)

    @property
    def start(self) -> Cell:
        """Row and column."""
        return as_cell(self.world.start)

    def places(self, seen: Bool[np.ndarray, "H W"]) -> dict[str, list[dict[str, Any]]]:
        """Of each proposition the cells where it holds and was seen to, one rectangle for each run of them in a row."""
        found: dict[str, list[dict[str, Any]]] = {}
        letters = np.asarray(self.world.letters)
        for bit, name in enumerate(self.propositions):
            shown = seen & ((letters >> bit) & 1 == 1)
            # Begins and ends of runs alternate along each row.
            edges = np.argwhere(np.diff(np.pad(shown, ((0, 0), (1, 1))).astype(np.int8), axis=1))
            for (row, first), (_, end) in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                found.setdefault(name, []).append({"polygon": self._rectangle(row, first, end)})
        return found

    def seen_from(self, cell: Cell, reach: int) -> Bool[np.ndarray, "H W"]:
        """All in line of sight within reach."""
        return np.asarray(_visible(self.world.occupied, jnp.asarray(cell, jnp.int32), SensorConfig(float(reach))))

    def picture_from(self, cell: Cell) -> UInt8[np.ndarray, "h w 3"]:
        """What the camera sees, undisturbed."""
        camera = trial_config_for(self.world).camera
        at = jnp.asarray(cell, jnp.int32)
        panorama = photograph(self.world, at, jax.random.key(0), camera, Disturbance())
        return to_equirectangular(np.asarray(panorama), camera, *PICTURE)

    def _rectangle(self, row: int, first: int, end: int) -> list[list[float]]:
        """Corners of the cells from one column up to another, in metres."""
        part = self.frame.window(row, first, 1, end - first)
        width = part.resolution * part.width
        right, top = part.x + width, part.y + part.resolution
        return [[part.x, part.y], [right, part.y], [right, top], [part.x, top]]


_visible = jax.jit(visible, static_argnames=("config",))
