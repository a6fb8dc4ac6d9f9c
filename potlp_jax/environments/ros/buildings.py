"""Maps of buildings in every format that is read, by what the file is: one reader for commands and worlds.

======================================  ================================================================
``FILE.yaml`` with an image             `environments.ros.occupancy_map`: ROS ``map_server``
``FILE.yaml`` with levels               `environments.ros.rmf`: a level of Open-RMF's ``building.yaml``
``FILE.world``, ``FILE.sdf``            `environments.ros.gazebo`: boxes of a Gazebo world
``FILE.xml``                            `environments.campus.plan_floor`: plans with rooms and doors
======================================  ================================================================
"""

from pathlib import Path

from potlp_jax.environments.campus.floor_plan_xml import read_kinds, read_plan
from potlp_jax.environments.campus.plan_floor import MOST_CELLS, rasterise
from potlp_jax.environments.ros.drawn_maps import MARGIN, drawn_map
from potlp_jax.environments.ros.gazebo import read_world
from potlp_jax.environments.ros.map_settings import read_yaml
from potlp_jax.environments.ros.occupancy_map import OccupancyMap, load_map
from potlp_jax.environments.ros.places import Places, Polygon
from potlp_jax.environments.ros.rmf import is_building, read_level
from potlp_jax.errors import MapError

PLAN_CELL = 0.1
"""Metres a pixel of a plan in XML; twice as much, or four times, where it would have more than `MOST_CELLS` a side."""


def load_building(file: Path | str, level: str | None = None) -> OccupancyMap:
    """Read a map in any of the formats.

    Args:
        file: the map.
        level: of a building with several.

    Returns:
        The map. ``closed`` has what was added to close outer walls, ``places`` what the file names.

    Raises:
        MapError: the file is missing, in no such format, or makes no sense; or a level is given where there is none.

    Warns:
        MapWarning: what was passed over or is probably not meant.
    """
    file = Path(file)
    ending = file.suffix.lower()
    levels = ending in (".yaml", ".yml") and is_building(read_yaml(file))
    if level is not None and not levels:
        raise MapError(file, "level", "only a building.yaml of Open-RMF has levels")
    if ending == ".xml":
        return _read_plan(file)
    if ending in (".world", ".sdf"):
        return read_world(file)
    return read_level(file, level) if levels else load_map(file)


def _read_plan(file: Path) -> OccupancyMap:
    """A plan in XML, its rooms as places by their ids."""
    plan = read_plan(file)
    points = [point for room in plan.rooms for point in room.outline]
    longest = max(max(point[axis] for point in points) - min(point[axis] for point in points) for axis in (0, 1))
    pixel = PLAN_CELL
    while longest + 2 * MARGIN > pixel * MOST_CELLS:
        pixel *= 2
    found = rasterise(plan, read_kinds(), pixel)
    free = ~found.floor.occupied
    outlines = {room.id: (Polygon(room.outline),) for room in plan.rooms if room.id in found.room_ids}
    places = Places(tuple(outlines.items()), source=str(file))
    return drawn_map(file, free, ~free, found.frame, kind="floor plan", places=places)
