"""Reads levels of Open-RMF's ``building.yaml``, as its traffic editor writes them.

    coordinate_system: reference_image      or cartesian_meters
    levels:
      L1:
        vertices: [[x, y, z, name, {...}], ...]        pixels, y downwards; or metres, y upwards
        measurements: [[v, v, {distance: [3, 9.3]}]]   metres between two vertices: the scale
        walls: [[v, v, {...}], ...]
        doors: [[v, v, {type: [1, hinged], ...}], ...]
        floors: [{vertices: [v, ...]}, ...]

Lanes, lifts, models and what else there is are left aside. Values stand behind a number that tells their type. What is
free lies on a floor and in no wall; a level without floors is what its walls enclose. Doors of the types in
`OPEN_DOORS` are open, and cut the walls that they stand in; others are closed. Names of vertices are places.

References:
    Open-RMF, "Traffic editor", and the building map tools of rmf_traffic_editor.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from potlp_jax.environments.ros.drawn_maps import Wall, draw_areas, drawn_map, enclosed, frame_around
from potlp_jax.environments.ros.map_settings import parse_number, read_yaml
from potlp_jax.environments.ros.occupancy_map import OccupancyMap
from potlp_jax.environments.ros.places import PLACE_RADIUS, Disc, Places, Point
from potlp_jax.errors import MapError, MapWarning
from potlp_jax.files import short

OPEN_DOORS = ("hinged", "double_hinged", "sliding", "double_sliding", "double_telescope")
"""Types of doors that open for a robot."""

WALL_THICKNESS = 0.1
"""Metres, as Open-RMF makes them."""

DOOR_THICKNESS = 0.3
"""Metres across a wall that an open door cuts away: walls on either side of it may not quite meet."""


def read_level(file: Path, level: str | None = None) -> OccupancyMap:
    """A level of a building.

    Args:
        file: ``building.yaml``.
        level: its name; None: the only one.

    Raises:
        MapError: the file is missing or no such building, the level is missing or not named, has no walls or no scale,
            or refers to a vertex that it does not have.

    Warns:
        MapWarning: doors of a type that does not open.
    """
    fields = read_yaml(file)
    level, found = _find_level(file, fields, level)
    points = _vertices(file, fields, level, found)
    walls = [_wall(file, level, edge, points) for edge in _list(file, level, found, "walls")]
    if not walls:
        raise MapError(file, f"levels: {level}: walls", "the level has no walls")
    doors, closed = _doors(file, level, found, points)
    # Walls end at the posts of a door: a closed one stands between them as a wall does.
    walls += closed
    floors = [_corners(file, level, floor, points) for floor in _list(file, level, found, "floors")]
    corners = [wall.corners for wall in walls]
    frame = frame_around(file, [corner for each in (*corners, *floors) for corner in each])
    open_doors = draw_areas([door.corners for door in doors], frame) > 0
    drawn = draw_areas(corners, frame) > 0
    # Without floors, the doors to the outside would let the outside in: they are closed while it is told apart.
    inside = draw_areas(floors, frame) > 0 if floors else enclosed(drawn | open_doors) | open_doors
    occupied = drawn & ~open_doors
    places = _places(file, level, found, points)
    return drawn_map(file, inside & ~occupied, occupied, frame, kind=f"Open-RMF level {level}", places=places)


def is_building(fields: Mapping[str, Any]) -> bool:
    """Whether the fields of a YAML file are those of a building."""
    return isinstance(fields.get("levels"), dict)


def _find_level(file: Path, fields: Mapping[str, Any], level: str | None) -> tuple[str, Mapping[str, Any]]:
    levels = fields.get("levels")
    if not isinstance(levels, dict) or not levels:
        raise MapError(file, "levels", "is missing or empty; is it a building.yaml of Open-RMF?")
    names = ", ".join(map(str, levels))
    if level is None and len(levels) > 1:
        raise MapError(file, "levels", f"there are {names}: name one with --level, or as map:FILE,level=NAME")
    chosen = next(iter(levels)) if level is None else level
    if not isinstance(levels.get(chosen), dict):
        raise MapError(file, "levels", f"there is no level {chosen!r}; there are: {names}")
    return chosen, levels[chosen]


def _vertices(file: Path, fields: Mapping[str, Any], level: str, found: Mapping[str, Any]) -> list[Point]:
    """The vertices in metres, y upwards."""
    raw = [_vertex(file, level, vertex) for vertex in _list(file, level, found, "vertices")]
    system = fields.get("coordinate_system", "reference_image")
    if system == "cartesian_meters":
        return raw
    if system != "reference_image":
        raise MapError(file, "coordinate_system", f"{short(system)} is not read; use reference_image, cartesian_meters")
    scale = _scale(file, level, found, raw)
    return [(x * scale, -y * scale) for x, y in raw]


def _vertex(file: Path, level: str, vertex: Any) -> Point:
    field = f"levels: {level}: vertices"
    if not isinstance(vertex, list) or len(vertex) < 2:
        raise MapError(file, field, f"{short(vertex)} must be [x, y, z, name]")
    x, y = (float(parse_number(file, field, value)) for value in vertex[:2])
    return x, y


def _scale(file: Path, level: str, found: Mapping[str, Any], raw: Sequence[Point]) -> float:
    """Metres a pixel: the mean over all measurements, as Open-RMF takes it."""
    field, scales = f"levels: {level}: measurements", []
    for edge in _list(file, level, found, "measurements"):
        start, end, values = _edge(file, field, edge, raw)
        pixels, metres = math.dist(start, end), float(parse_number(file, field, _value(values, "distance")))
        if not (pixels > 0 and metres > 0):
            raise MapError(file, field, f"{pixels:g} pixels for {metres:g} m: both must be positive")
        scales.append(metres / pixels)
    if not scales:
        raise MapError(file, field, "there is none, so that the scale is not known")
    return sum(scales) / len(scales)


def _wall(file: Path, level: str, edge: Any, points: Sequence[Point]) -> Wall:
    start, end, _ = _edge(file, f"levels: {level}: walls", edge, points)
    return Wall(start, end, WALL_THICKNESS)


def _doors(file: Path, level: str, found: Mapping[str, Any], points: Sequence[Point]) -> tuple[list[Wall], list[Wall]]:
    """The doors that open, as thick as they cut walls, and the others, as thick as walls."""
    opening, closed, names = [], [], []
    for edge in _list(file, level, found, "doors"):
        start, end, values = _edge(file, f"levels: {level}: doors", edge, points)
        if _value(values, "type") in OPEN_DOORS:
            opening.append(Wall(start, end, DOOR_THICKNESS))
        else:
            closed.append(Wall(start, end, WALL_THICKNESS))
            names.append(str(_value(values, "name") or "(no name)"))
    if names:
        known = ", ".join(OPEN_DOORS)
        warnings.warn(
            f"{file}: levels: {level}: doors of no type that opens ({known}) are closed: {short(', '.join(names))}",
            MapWarning,
            stacklevel=3,
        )
    return opening, closed


def _places(file: Path, level: str, found: Mapping[str, Any], points: Sequence[Point]) -> Places | None:
    """The named vertices; those that share a name are one place."""
    regions: dict[str, list[Disc]] = {}
    for vertex, point in zip(found["vertices"], points, strict=True):
        name = vertex[3].strip() if len(vertex) > 3 and isinstance(vertex[3], str) else ""
        if name:
            regions.setdefault(name, []).append(Disc(point, PLACE_RADIUS))
    named = tuple((name, tuple(discs)) for name, discs in regions.items())
    return Places(named, source=f"{file}: level {level}") if named else None


def _corners(file: Path, level: str, floor: Any, points: Sequence[Point]) -> list[Point]:
    field = f"levels: {level}: floors"
    numbers = floor.get("vertices") if isinstance(floor, dict) else None
    if not isinstance(numbers, list) or len(numbers) < 3:
        raise MapError(file, field, f"{short(floor)} must have three vertices or more")
    return [points[_index(file, field, number, points)] for number in numbers]


def _edge(file: Path, field: str, edge: Any, points: Sequence[Point]) -> tuple[Point, Point, Mapping[str, Any]]:
    if not isinstance(edge, list) or len(edge) < 2:
        raise MapError(file, field, f"{short(edge)} must be [vertex, vertex, {{...}}]")
    values = edge[2] if len(edge) > 2 and isinstance(edge[2], dict) else {}
    start, end = (points[_index(file, field, number, points)] for number in edge[:2])
    return start, end, values


def _index(file: Path, field: str, number: Any, points: Sequence[Point]) -> int:
    if not isinstance(number, str) or not number.isdecimal() or int(number) >= len(points):
        raise MapError(file, field, f"{short(number)} is no number of one of the {len(points)} vertices")
    return int(number)


def _value(values: Mapping[str, Any], name: str) -> Any:
    """A value without the number of its type; None where it is missing."""
    found = values.get(name)
    return found[1] if isinstance(found, list) and len(found) == 2 else None


def _list(file: Path, level: str, found: Mapping[str, Any], name: str) -> list[Any]:
    value = found.get(name, [])
    if not isinstance(value, list):
        raise MapError(file, f"levels: {level}: {name}", f"{short(value)} must be a list")
    return value
