"""How large buildings are of which only walls are known: Gazebo worlds, and files of Open-RMF's traffic editor.

Both are read for their extent alone: the sides of the rectangle around all walls.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float64

Sides = tuple[float, float]
"""The longer and the shorter, in metres."""


def gazebo_sides(file: Path) -> Sides:
    """Of a world whose walls are boxes: links with a pose, and a collision box with a pose of its own."""
    points = [point for link in ElementTree.parse(file).iter("link") for point in _ends_of_wall(link)]
    return _sides(np.array(points))


def _ends_of_wall(link: ElementTree.Element) -> Iterator[Sides]:
    size, pose = link.find("collision/geometry/box/size"), link.find("pose")
    # The ground has no box.
    if size is None or pose is None:
        return
    length = float((size.text or "").split()[0])
    x, y, *_, yaw = (float(part) for part in (pose.text or "").split())
    # A wall begins at its link's pose and runs along its yaw.
    yield x, y
    yield x + length * math.cos(yaw), y + length * math.sin(yaw)


def traffic_editor_sides(file: Path) -> dict[str, Sides]:
    """Of each level of a building that has walls and a measured line, by the level's name."""
    levels = yaml.safe_load(file.read_text("utf-8"))["levels"]
    found = {}
    for name, level in levels.items():
        if level.get("walls") and level.get("measurements"):
            points = np.array([vertex[:2] for vertex in level["vertices"]], float)
            walls = points[[end for wall in level["walls"] for end in wall[:2]]]
            found[name] = _sides(walls * _metres_per_pixel(level, points))
    return found


def _metres_per_pixel(level: dict[str, Any], points: Float64[np.ndarray, "N 2"]) -> float:
    scales = [
        measured["distance"][1] / float(np.hypot(*(points[first] - points[last])))
        for first, last, measured in level["measurements"]
    ]
    return float(np.mean(scales))


def _sides(points: Float64[np.ndarray, "N 2"]) -> Sides:
    width, height = (float(side) for side in np.ptp(points, axis=0))
    return max(width, height), min(width, height)
