"""Worlds on real buildings: a ROS map, cleaned until it can serve as the truth, with propositions placed in metres.

``map:FILE.yaml`` takes the propositions from ``FILE.places.yaml`` beside it (`environments.ros.places`), and
``map:FILE.yaml,level=NAME`` from ``FILE.NAME.places.yaml``. Options follow after commas:
``map:FILE.yaml,places=OTHER.yaml,resolution=0.2,radius=0.1``. Names of files hold no comma.

Costs are in metres, since ``World.resolution`` is the size of a cell in metres.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Int32, PRNGKeyArray

from potlp_jax.environments.base import Generator, host_generators
from potlp_jax.environments.campus.furnishing import NARROW_DOORS
from potlp_jax.environments.families import MAP_PREFIX
from potlp_jax.environments.options import parse_options
from potlp_jax.environments.ros.buildings import load_building
from potlp_jax.environments.ros.cleaning import CleanMap, clean_map, warn_of_cut_off
from potlp_jax.environments.ros.occupancy_map import OccupancyMap
from potlp_jax.environments.ros.places import Places, load_places, place_letters, places_file
from potlp_jax.errors import MapError, MapWarning
from potlp_jax.files import one_line
from potlp_jax.task.propositions import MAX_PROPOSITIONS
from potlp_jax.world.grid import World, make_world

_OPTIONS: Mapping[str, type[str] | type[float]] = MappingProxyType(
    {"places": str, "resolution": float, "radius": float, "level": str}
)


@dataclass(frozen=True)
class RosMapConfig:
    """Which map, and how it becomes a grid.

    Attributes:
        file: the map, in one of the formats of `environments.ros.buildings`.
        places: YAML of the propositions, or the propositions; None: `places_file` beside the map.
        resolution: size of a working cell in metres, not finer than the map's pixels; None: 0.2, or larger on large
            maps (`environments.ros.working_grid`).
        radius: the robot's radius in metres, by which obstacles grow.
        level: of a building with several.

    With the defaults a door of 0.6 m stays open wherever it lies on the grid.
    """

    file: str | Path
    places: str | Places | None = None
    resolution: float | None = None
    radius: float = 0.1
    level: str | None = None


class RosMap(Generator):
    """Worlds on one map; they differ in the start, unless the places fix it.

    Attributes:
        name: ``map:`` and the name of the file, without its folder and ending.
        propositions: names, in the order of the letters' bits.
        tasks: formulas by name, from the places.
        image_map: the map as its server would publish it; ``image_map.frame`` converts metres to pixels.
        clean: the grid; ``clean.frame`` converts metres to cells of the worlds.
    """

    settings = NARROW_DOORS

    def __init__(self, config: RosMapConfig) -> None:
        """Reads and cleans the map, and places the propositions.

        Raises:
            MapError: the map or the places cannot be used; the message names the file, the field, and what to do.

        Warns:
            MapWarning: a part of the building cannot be reached, cells are larger than usual, or labels of no level lie
                beside a building of which a level is named; see also
                `potlp_jax.environments.ros.buildings.load_building`.
        """
        self.config = config
        self.image_map = load_building(config.file, config.level)
        # From Python the places may be given as they are; from the command line they are a file.
        places = config.places if isinstance(config.places, Places) else _find_places(config, self.image_map)
        self.places = places
        self.clean = clean_map(self.image_map, config.resolution, config.radius, places.start, places.source)
        warn_of_cut_off(config.file, self.clean, config.radius)
        # Not the path as typed: the name goes into the keys of its worlds, and a map is the same map from every folder.
        self.name = f"{MAP_PREFIX}{Path(config.file).stem}"
        self.propositions = places.names
        self.tasks = dict(places.tasks)
        # Letters and cells do not depend on the key: they are made once, worlds differ in the start.
        self._letters = place_letters(places, self.clean.free, self.clean.frame)
        self._free_cells: Int32[np.ndarray, "N 2"] = np.argwhere(self.clean.free).astype(np.int32)

    @classmethod
    def from_spec(cls, spec: str) -> "RosMap":
        """From ``map:FILE.yaml``, with options ``,places=...``, ``,resolution=...``, ``,radius=...``.

        Raises:
            MapError: the text is not of that form, or see the class.
        """
        return cls(parse_spec(spec))

    def draw(self, key: PRNGKeyArray) -> World:
        """The world with the start that the places fix, or with one drawn from all cells by key."""
        # A start that the places give is part of the map; otherwise every cell is as likely.
        if self.places.start is not None:
            start = self.metres_to_cell(*self.places.start)
        else:
            row, col = self._free_cells[host_generators(key, 1)[0].integers(len(self._free_cells))]
            start = int(row), int(col)
        return make_world(
            ~self.clean.free,
            self._letters,
            start,
            resolution=self.clean.frame.resolution,
            propositions=self.propositions,
        )

    def metres_to_cell(self, x: float | int, y: float | int) -> tuple[int, int]:
        """Cell (row, col) of the worlds that holds a point in map metres; outside of the grid where the point is."""
        return self.clean.frame.metres_to_cell(x, y)

    def cell_to_metres(self, row: int, col: int) -> tuple[float, float]:
        """Centre of a cell of the worlds, in map metres."""
        return self.clean.frame.cell_to_metres(row, col)


def reachable_places(places: Places, clean: CleanMap) -> Places:
    """The places that cover a cell which the robot can reach."""
    found = (
        (name, tuple(region for region in regions if region.covers(clean.free, clean.frame).any()))
        for name, regions in places.propositions
    )
    return replace(places, propositions=tuple((name, regions) for name, regions in found if regions))


def parse_spec(spec: str) -> RosMapConfig:
    """``map:FILE.yaml,option=value,...`` as a configuration.

    Raises:
        MapError: the text is not of that form.
    """
    usage = "write map:FILE.yaml[,places=FILE][,resolution=METRES][,radius=METRES][,level=NAME]"
    file, values = parse_options(spec, MAP_PREFIX, "map", _OPTIONS, usage)
    return RosMapConfig(file, **values)


def _find_places(config: RosMapConfig, image_map: OccupancyMap) -> Places:
    file = places_file(Path(config.file), config.level) if config.places is None else Path(str(config.places))
    if config.places is not None or file.is_file():
        return load_places(file)
    of_no_level = places_file(Path(config.file))
    if of_no_level.is_file():
        warnings.warn(
            f"{of_no_level} belongs to no level and is not read: if its labels are those of {config.level}, rename it "
            f"{file.name}, or add places={of_no_level}",
            MapWarning,
            stacklevel=3,
        )
    clean = clean_map(image_map, config.resolution, config.radius)
    named = None if image_map.places is None else reachable_places(image_map.places, clean)
    if named is not None and 0 < len(named.propositions) <= MAX_PROPOSITIONS:
        lost = [name for name in (image_map.places or named).names if name not in named.names]
        if lost:
            warnings.warn(
                f"{config.file}: places that the robot cannot reach are left out: {one_line(', '.join(lost))}",
                MapWarning,
                stacklevel=3,
            )
        return named
    many = "" if named is None else f"It names {len(named.names)} places: --named of `potlp map label` takes them. "
    # The example in the message has two points that exist on this very map.
    cells = np.argwhere(clean.free)
    (x0, y0), (x1, y1) = (clean.frame.cell_to_metres(*map(int, cells[i])) for i in (0, -1))
    raise MapError(
        Path(config.file),
        "places",
        f"{file} does not exist, and the map itself does not name 1 to {MAX_PROPOSITIONS} places that can be reached. "
        f"{many}Write the file with `potlp map label` or by hand, in map metres, for instance\n"
        "propositions:\n"
        f"  document: [{{point: [{x0:.2f}, {y0:.2f}], radius: 0.5}}]\n"
        f"  package: [{{point: [{x1:.2f}, {y1:.2f}], radius: 0.5}}]\n"
        "tasks:\n"
        '  "1": F document & F package\n',
    )
