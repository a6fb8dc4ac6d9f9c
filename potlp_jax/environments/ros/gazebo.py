"""Reads buildings from Gazebo worlds (SDF): boxes at the height of a robot are walls.

    sdf > world > model[@name] > link > collision > geometry > box > size      x y z in metres
    pose of model, link and collision: x y z roll pitch yaw; each is relative to the one around it; degrees="true"

Models may hold models. Poses are composed in the plane; a box that is tilted, another shape than a box or a plane, and
an ``include`` of another file are left out, with a warning. The floors of the KTH campus are such files; doors and
windows are gaps in them, so that outer walls are closed (`environments.ros.drawn_maps`).

References:
    Aydemir, Jensfelt and Folkesson, What can we learn from 38,000 rooms?, IROS 2012 (the floors of KTH).
    SDFormat specification, http://sdformat.org/spec.
"""

import math
import warnings
import xml.etree.ElementTree as ElementTree
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path

from potlp_jax.environments.ros.drawn_maps import Wall, close_outer_walls, drawn_map, frame_around
from potlp_jax.environments.ros.map_settings import LARGEST_NUMBER
from potlp_jax.environments.ros.occupancy_map import OccupancyMap
from potlp_jax.errors import MapError, MapWarning
from potlp_jax.files import one_line, read_xml, short

ROBOT_HEIGHT = (0.1, 1.5)
"""Metres above the floor between which a box is in the way: below it is a floor, above it a lintel or a ceiling."""

Pose = tuple[float, float, float, float]
"""x, y, z and yaw."""


def read_world(file: Path) -> OccupancyMap:
    """The building of a world.

    Raises:
        MapError: the file is missing, is no SDF, has no walls, or a pose or size makes no sense.

    Warns:
        MapWarning: shapes and included files that are left out.
    """
    root = read_xml(file, MapError)
    if root.tag != "sdf":
        raise MapError(file, one_line(root.tag), "the file must hold a world of SDF")
    walls, left_out = _walls(file, root)
    included = sum(1 for _ in root.iter("include"))
    if included:
        warnings.warn(f"{file}: {included} included files are left out", MapWarning, stacklevel=2)
    if left_out:
        warnings.warn(f"{file}: {left_out} shapes that are no upright boxes are left out", MapWarning, stacklevel=2)
    if not walls:
        raise MapError(file, "", "has no box at the height of a robot: there are no walls")
    frame = frame_around(file, [corner for wall in walls for corner in wall.corners])
    drawn, closed, free = close_outer_walls(walls, frame)
    return drawn_map(file, free, drawn | closed, frame, kind="Gazebo world", closed=closed)


def _walls(file: Path, root: ElementTree.Element) -> tuple[list[Wall], int]:
    """The walls, and how many shapes are none that can be read."""
    walls, left_out = [], 0
    for chain in _collisions(root):
        collision = chain[-1]
        if collision.find("geometry/plane") is not None:
            continue
        size = collision.findtext("geometry/box/size")
        pose = _composed(_pose(file, part) for part in chain)
        if size is None or pose is None:
            left_out += 1
        elif (wall := _wall(pose, _numbers(file, "box: size", size, 3))) is not None:
            walls.append(wall)
    return walls, left_out


def _collisions(root: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, ...]]:
    """Of every collision the parts whose poses lead to it: the models, outermost first, the link and itself last."""
    models: deque[tuple[ElementTree.Element, ...]] = deque(
        (model,) for model in root.findall("world/model") + root.findall("model")
    )
    while models:
        chain = models.popleft()
        for link in chain[-1].findall("link"):
            yield from ((*chain, link, collision) for collision in link.findall("collision"))
        models.extend((*chain, model) for model in chain[-1].findall("model"))


def _wall(pose: Pose, size: list[float]) -> Wall | None:
    """The middle line of a box along its longer side; None where it is not in a robot's way."""
    x, y, z, yaw = pose
    if z + size[2] / 2 < ROBOT_HEIGHT[0] or z - size[2] / 2 > ROBOT_HEIGHT[1]:
        return None
    turn = yaw if size[0] >= size[1] else yaw + math.pi / 2
    half, thickness = max(size[:2]) / 2, min(size[:2])
    right, up = half * math.cos(turn), half * math.sin(turn)
    return Wall((x - right, y - up), (x + right, y + up), thickness)


def _pose(file: Path, part: ElementTree.Element) -> Pose | None:
    """The pose of a part in that around it; None where it is tilted."""
    element = part.find("pose")
    if element is None or not (element.text or "").strip():
        return 0.0, 0.0, 0.0, 0.0
    if element.get("frame") or element.get("relative_to"):
        raise MapError(file, f"{part.tag} {part.get('name')}: pose", "is relative to a frame by name; write it plainly")
    where = f"{part.tag} {part.get('name')}: pose"
    if (form := element.get("rotation_format", "euler_rpy")) != "euler_rpy":
        raise MapError(file, where, f"rotation_format {short(form)} is not read; write it as roll, pitch and yaw")
    x, y, z, *angles = _numbers(file, where, element.text or "", 6)
    roll, pitch, yaw = (math.radians(angle) for angle in angles) if _in_degrees(element) else angles
    return None if max(abs(roll), abs(pitch)) > 1e-6 else (x, y, z, yaw)


def _in_degrees(pose: ElementTree.Element) -> bool:
    return pose.get("degrees", "false") in ("true", "1")


def _composed(chain: Iterable[Pose | None]) -> Pose | None:
    x = y = z = yaw = 0.0
    for pose in chain:
        if pose is None:
            return None
        x, y = (
            x + math.cos(yaw) * pose[0] - math.sin(yaw) * pose[1],
            y + math.sin(yaw) * pose[0] + math.cos(yaw) * pose[1],
        )
        z, yaw = z + pose[2], yaw + pose[3]
    return x, y, z, yaw


def _numbers(file: Path, field: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) <= LARGEST_NUMBER for value in values):
        raise MapError(file, one_line(field), f"{short(text)} must be {count} numbers of at most {LARGEST_NUMBER:g}")
    return values
