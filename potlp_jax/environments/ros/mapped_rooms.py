"""Parcels to deliver in a real building: a ROS map whose rooms are known by name, to the simulator alone.

The third experiment of Bradley et al. 2021 (section V-C), with a simulated robot: a document and a package are for two
people in two rooms, drawn at random; those rooms are lit, others are dark. ``parcels:FILE.yaml`` takes the rooms from
``FILE.rooms.yaml`` beside it, in map metres and in the form of ``environments.ros.places``:

    rooms:
      "3.422": [{polygon: [[12.0, 3.5], [15.2, 3.5], [15.2, 8.0], [12.0, 8.0]]}]
      "3.424": [{polygon: [[8.9, 3.5], [11.8, 3.5], [11.8, 8.0], [8.9, 8.0]]}]

What belongs to no room is hallway: there the robot starts. Where rooms overlap, the first listed has the cells. Options
follow after commas: ``parcels:FILE.yaml,rooms=OTHER.yaml,resolution=0.25,radius=0.1``.

A map has no colours: walls and floors look like those of ``parcels``, the generator that the estimator learns from.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.environments.base import Generator
from potlp_jax.environments.campus.delivery import PARCELS_FAMILY, scaled_to
from potlp_jax.environments.campus.furnishing import (
    NARROW_DOORS,
    NO_ROOM,
    PARCELS,
    Floor,
    FurnishConfig,
    Kind,
    Placement,
    furnish,
)
from potlp_jax.environments.campus.people_posterior import PeoplePosterior, people_posterior
from potlp_jax.environments.families import PARCELS_PREFIX
from potlp_jax.environments.options import parse_options
from potlp_jax.environments.ros.cleaning import CleanMap, clean_map, warn_of_cut_off
from potlp_jax.environments.ros.occupancy_map import load_map
from potlp_jax.environments.ros.places import Region, load_regions
from potlp_jax.errors import MapError, MapWarning
from potlp_jax.files import require_file
from potlp_jax.world.grid import World
from potlp_jax.world.settings import Settings

PERSON_RADIUS = 0.5
"""Metres around a person's cell, along rows and columns, on which the person is met."""

LEAST_ROOM = 2.0
"""Square metres that the robot must be able to reach of a room."""

_HALLWAY = 0

_EXAMPLE = """rooms:
  kitchen: [{polygon: [[12.0, 3.5], [15.2, 3.5], [15.2, 8.0], [12.0, 8.0]]}]
  office: [{polygon: [[8.9, 3.5], [11.8, 3.5], [11.8, 8.0], [8.9, 8.0]]}]
"""


@dataclass(frozen=True)
class MappedRoomsConfig:
    """Which map, and how it becomes a grid.

    Attributes:
        file: the map's YAML.
        rooms: YAML of its rooms; None: ``FILE.rooms.yaml`` beside the map.
        resolution: size of a working cell in metres, not finer than the map's pixels; None: 0.2, or larger on large
            maps (`environments.ros.working_grid`).
        radius: the robot's radius in metres, by which obstacles grow.
    """

    file: str | Path
    rooms: str | Path | None = None
    resolution: float | None = None
    radius: float = 0.1


class MappedRooms(Generator):
    """Worlds in one real building; they differ in who is where, the start, light and tints.

    Attributes:
        name: ``parcels:`` and the name of the map's file.
        clean: the grid; ``clean.frame`` converts metres to cells.
        floor: which room each cell belongs to.
        rooms: names of the floor's rooms, by number, the hallways first.
        left_out: rooms of the file of which too little can be reached.
    """

    propositions = PARCELS.propositions
    tasks = PARCELS.tasks
    # They look like the generator's, and the camera shows the same metres.
    family = PARCELS_FAMILY

    def __init__(self, config: MappedRoomsConfig) -> None:
        """Reads the map and its rooms.

        Raises:
            MapError: one of them cannot be used, or fewer than two rooms can be reached.

        Warns:
            MapWarning: a part of the building cannot be reached, or rooms are left out, because the robot can reach
                less than ``LEAST_ROOM`` of them.
        """
        self.config = config
        if config.rooms is None:
            file = require_file(config.file, MapError).with_suffix(".rooms.yaml")
        else:
            file = Path(config.rooms)
        if config.rooms is None and not file.exists():
            raise MapError(
                Path(config.file),
                "rooms",
                f"{file} does not exist. Write the outlines of the rooms into it, in map metres, for instance\n"
                f"{_EXAMPLE}(a map whose places are labelled is map:{config.file})",
            )
        regions = load_regions(file, ("rooms",))["rooms"]
        self.clean: CleanMap = clean_map(load_map(config.file), config.resolution, config.radius)
        self.name = f"{PARCELS_PREFIX}{Path(config.file).stem}"
        warn_of_cut_off(config.file, self.clean, config.radius)
        self.rooms, self.left_out, self.floor = _floor(regions, self.clean)
        # The hallway counts as the first; two people need two rooms.
        if len(self.rooms) < 3 or not np.any(self.floor.rooms == _HALLWAY):
            raise MapError(
                file,
                "rooms",
                f"two rooms and a hallway outside of them are needed; of {', '.join(regions)} the robot can reach "
                f"{', '.join(self.rooms[1:]) or 'none'}",
            )
        if self.left_out:
            warnings.warn(
                f"{file}: the robot can reach less than {LEAST_ROOM:g} m2 of {', '.join(self.left_out)}; nobody will "
                "be there",
                MapWarning,
                stacklevel=2,
            )
        self.settings = _settings(self.clean.frame.resolution)
        # At least the neighbouring cells: on a coarse grid a person is met beside their cell, too.
        reach = max(1, round(PERSON_RADIUS / self.clean.frame.resolution))
        self._furnishing = FurnishConfig(person_radius=reach, coloured=False)

    @classmethod
    def from_spec(cls, spec: str) -> "MappedRooms":
        """From ``parcels:FILE.yaml``, with options ``,rooms=...``, ``,resolution=...``, ``,radius=...``.

        Raises:
            MapError: the text is not of that form, or see the class.
        """
        usage = "write parcels:FILE.yaml[,rooms=FILE][,resolution=METRES][,radius=METRES]"
        options = {"rooms": str, "resolution": float, "radius": float}
        file, values = parse_options(spec, PARCELS_PREFIX, "map", options, usage)
        return cls(MappedRoomsConfig(file, **values))

    def draw(self, key: PRNGKeyArray) -> World:
        """The world of this key."""
        return self.generate_with_layout(key)[0]

    def generate_with_layout(self, key: PRNGKeyArray) -> tuple[World, Placement]:
        """The world of this key, and who is where."""
        world, placement = furnish(self.floor, key, PARCELS, self._furnishing, self.floor.rooms.shape)
        return self.signed(world), placement

    def posterior(self, key: PRNGKeyArray, noise: PRNGKeyArray, count: int) -> PeoplePosterior:
        """Who may be where in the building, which is known; see ``Generator.posterior``."""
        _, placement = self.generate_with_layout(key)
        reach, shape = self._furnishing.person_radius, self.floor.rooms.shape
        return people_posterior(self.floor, PARCELS, reach, placement.rooms, shape, noise, count)


def _settings(resolution: float) -> Settings:
    """Camera and replanning as in ``parcels``, in metres, space for all frontiers, and none too narrow."""
    return Settings({**NARROW_DOORS, **scaled_to(resolution)})


def _floor(
    regions: Mapping[str, tuple[Region, ...]], clean: CleanMap
) -> tuple[tuple[str, ...], tuple[str, ...], Floor]:
    """Names of the rooms that can be used, the hallways first, of those that cannot, and the floor."""
    numbers = np.where(clean.free, _HALLWAY, NO_ROOM).astype(np.int32)
    used, left_out = ["hallway"], []
    for name, parts in regions.items():
        # What an earlier room has taken is no hallway any more, and stays with it.
        covered = np.any([part.covers(clean.free, clean.frame) for part in parts], axis=0) & (numbers == _HALLWAY)
        if np.count_nonzero(covered) * clean.frame.resolution**2 < LEAST_ROOM:
            left_out.append(name)
        else:
            numbers[covered] = len(used)
            used.append(name)
    # A map does not say what a room is for; without colours (see the class) it does not matter.
    kinds = (Kind.HALLWAY,) + (Kind.OTHER,) * (len(used) - 1)
    # Where rooms end is not drawn as a door: the map's own walls and openings are.
    doors = np.zeros(numbers.shape, bool)
    return tuple(used), tuple(left_out), Floor(numbers, doors, kinds, clean.frame.resolution)
