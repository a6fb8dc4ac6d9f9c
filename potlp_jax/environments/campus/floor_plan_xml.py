"""Reads floor plans in the XML format of M. Luperto's corpus of schools and offices, and of any corpus like it.

    building > scale > represented_distance > value (pixels) stand for real_distance > value, um (cm or m)
    building > floor > spaces > space[@id]
        labels > label                             what the room is for
        bounding_polygon > point[@x, @y]           its outline in pixels, y downwards
        space_representation > linesegment[@id]    class PORTAL: a door, two points, mostly equal; type IMPLICIT: an
                                                   opening without a door; features DOUBLE: a double door
        portals > portal                           linesegment: the id of a door; target > id, id: the rooms it joins

What the files leave open or get wrong, and what is done about it, is told in
``potlp_jax.environments.campus.plan_floor``.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from potlp_jax.environments.campus.furnishing import Kind
from potlp_jax.environments.ros.map_settings import LARGEST_NUMBER, read_yaml
from potlp_jax.environments.ros.places import Point
from potlp_jax.errors import MapError
from potlp_jax.files import one_line, read_xml, short

_METRES = {"cm": 0.01, "m": 1.0, "mm": 0.001}


@dataclass(frozen=True)
class PlanRoom:
    """One space of a plan.

    Attributes:
        id: as in the file.
        label: what it is for, in capitals.
        outline: metres (x, y), y upwards; the last point joins the first.
    """

    id: str
    label: str
    outline: tuple[Point, ...]

    @property
    def area(self) -> float:
        """Square metres inside of the outline."""
        # The shoelace formula; the sign tells the direction of the outline, which files do not agree on.
        pairs = zip(self.outline, (*self.outline[1:], *self.outline[:1]), strict=True)
        return abs(sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in pairs)) / 2


@dataclass(frozen=True)
class PlanDoor:
    """A door between two rooms.

    Attributes:
        rooms: their ids.
        points: metres (x, y) where the rooms' outlines have the door, one of each room that has it; mostly equal, at
            most about a wall apart.
        implicit: an opening without a door, such as that between two stretches of a corridor.
        double: a double door.
    """

    rooms: tuple[str, str]
    points: tuple[Point, ...]
    implicit: bool
    double: bool


@dataclass(frozen=True)
class FloorPlan:
    """A plan as its file has it, in metres.

    Attributes:
        file: where it was read from.
        rooms: in the order of the file.
        doors: every door once. Doors to the outside, which no portal mentions, are left out.
    """

    file: Path
    rooms: tuple[PlanRoom, ...]
    doors: tuple[PlanDoor, ...]


def read_plan(file: Path | str) -> FloorPlan:
    """Read a plan.

    Raises:
        MapError: the file is missing, is no XML or no such plan, or a number, a room's id, label or outline makes no
            sense; the message names the room.
    """
    file = Path(file)
    building = read_xml(file, MapError)
    # The corpus has legends in the same folder, which are XML, too.
    if building.tag != "building":
        raise MapError(
            file, one_line(building.tag), "the file must hold a building: is it a legend, or another format?"
        )
    floors = building.findall("floor")
    if len(floors) != 1:
        raise MapError(file, "floor", f"there are {len(floors)}; put each floor into a file of its own")
    # Everything that is read from here on is in metres.
    scale = _read_scale(file, building)
    spaces = floors[0].findall("spaces/space")
    if not spaces:
        raise MapError(file, "spaces", "the floor has no rooms")
    rooms = tuple(_read_room(file, space, scale) for space in spaces)
    # Portals refer to rooms by id: given twice, it would join the wrong ones.
    ids = [room.id for room in rooms]
    if len(set(ids)) < len(ids):
        twice = next(name for name in ids if ids.count(name) > 1)
        raise MapError(file, f"space {twice}", "the id is given twice")
    return FloorPlan(file, rooms, tuple(_read_doors(file, spaces, set(ids), scale)))


def read_kinds(file: Path | str | None = None) -> Mapping[str, Kind]:
    """The kind of room by label, from a YAML file with a list of labels for each kind; None: the shipped file.

    Raises:
        MapError: a kind is unknown, a label is there twice, or the file cannot be read.
    """
    if file is None:
        with resources.as_file(resources.files("potlp_jax.environments") / "data" / "room_kinds.yaml") as shipped:
            return read_kinds(shipped)
    file, kinds = Path(file), {kind.name.lower(): kind for kind in Kind}
    found: dict[str, Kind] = {}
    for name, labels in read_yaml(file).items():
        if name not in kinds:
            raise MapError(file, name, f"is no kind of room; choose from: {', '.join(kinds)}")
        if not isinstance(labels, list) or not all(isinstance(label, str) for label in labels):
            raise MapError(file, name, "must be a list of labels")
        for label in labels:
            # Files of a corpus write labels in capitals or not.
            if found.setdefault(label.upper(), kinds[name]) is not kinds[name]:
                raise MapError(file, name, f"label {label!r} is listed under another kind, too")
    return found


def _read_scale(file: Path, building: ElementTree.Element) -> float:
    pixels = _number(file, "scale: represented_distance", building.findtext("scale/represented_distance/value"))
    real = _number(file, "scale: real_distance", building.findtext("scale/real_distance/value"))
    unit = (building.findtext("scale/real_distance/um") or "").strip().lower()
    if unit not in _METRES:
        raise MapError(file, "scale: real_distance: um", f"{unit!r} must be one of {', '.join(_METRES)}")
    if not (pixels > 0 and real > 0):
        raise MapError(file, "scale", f"{pixels:g} pixels for {real:g} {unit}: both must be positive")
    # ``um`` is the corpus's word for the unit of measure.
    return real * _METRES[unit] / pixels


def _read_room(file: Path, space: ElementTree.Element, scale: float) -> PlanRoom:
    name = space.get("id")
    if not name:
        raise MapError(file, "space", "has no id")
    label = (space.findtext("labels/label") or "").strip().upper()
    if not label:
        raise MapError(file, f"space {name}", "has no label")
    outline = tuple(
        _read_point(file, f"space {name}: bounding_polygon", point, scale)
        for point in space.findall("bounding_polygon/point")
    )
    if len(outline) < 3:
        raise MapError(file, f"space {name}", f"the bounding_polygon has {len(outline)} points, fewer than three")
    return PlanRoom(name, label, outline)


def _read_doors(file: Path, spaces: list[ElementTree.Element], ids: set[str], scale: float) -> Iterator[PlanDoor]:
    """Each door once, though both of its rooms list it."""
    # The drawn lines of each door by its id, with the room that draws them: ids are unique within a room only.
    segments: dict[str, list[tuple[str, ElementTree.Element]]] = {}
    for space in spaces:
        for segment in space.findall("space_representation/linesegment"):
            if segment.findtext("class") == "PORTAL":
                segments.setdefault(segment.get("id", ""), []).append((space.get("id", ""), segment))
    seen = set()
    for space in spaces:
        for portal in space.findall("portals/portal"):
            segment_id = (portal.findtext("linesegment") or "").strip()
            rooms = sorted({(target.text or "").strip() for target in portal.findall("target/id")})
            if len(rooms) != 2 or not set(rooms) <= ids:
                raise MapError(
                    file, f"space {space.get('id')}: portal {segment_id}", f"must join two rooms, found {rooms}"
                )
            # The rooms are sorted, so that the door of one room and that of the other are recognised as the same.
            if (segment_id, *rooms) not in seen:
                seen.add((segment_id, *rooms))
                own = [segment for owner, segment in segments.get(segment_id, []) if owner in rooms]
                yield _make_door(file, (rooms[0], rooms[1]), [portal, *own], own, scale)


def _make_door(
    file: Path,
    rooms: tuple[str, str],
    described: list[ElementTree.Element],
    segments: list[ElementTree.Element],
    scale: float,
) -> PlanDoor:
    points = []
    for segment in segments:
        ends = [
            _read_point(file, f"linesegment {segment.get('id')}", point, scale) for point in segment.findall("point")
        ]
        # Mostly both ends are the same point; where they differ, the middle is meant.
        if ends:
            points.append((sum(x for x, _ in ends) / len(ends), sum(y for _, y in ends) / len(ends)))
    return PlanDoor(
        rooms,
        tuple(points),
        implicit=any(part.findtext("type") == "IMPLICIT" for part in described),
        double=any(part.findtext("features") == "DOUBLE" for part in described),
    )


def _read_point(file: Path, field: str, point: ElementTree.Element, scale: float) -> Point:
    # Pixels count downwards, metres upwards.
    return _number(file, field, point.get("x")) * scale, -_number(file, field, point.get("y")) * scale


def _number(file: Path, field: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        # Refused below, together with the infinities that ``float`` reads.
        value = math.nan
    if not math.isfinite(value):
        raise MapError(file, one_line(field), f"{short(text)} is not a finite number")
    if abs(value) > LARGEST_NUMBER:
        raise MapError(file, one_line(field), f"{value:g} is beyond {LARGEST_NUMBER:g}, the largest that is read")
    return value
