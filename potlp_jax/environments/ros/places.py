"""Where the propositions of a task are true on a map: a small YAML file in map metres.

    propositions:                # in the order of the letters' bits
      document:                  # a name, with one region or more
        - {point: [3.5, -2.0], radius: 0.5}
      package:
        - {polygon: [[0, 0], [2, 0], [2, 1.5], [0, 1.5]]}
    start: [1.0, 4.5]            # optional; without it the start is drawn at random
    tasks:                       # optional: formulas by name
      "1": F document & F package

A *point* with a radius covers the cells whose centre is at most that far away and that can be reached from the
point's own cell without leaving the disc (a robot within the radius but behind a wall is not at the point); the point's
own cell always counts. A *polygon* covers the cells whose centre lies inside, by the even-odd rule. Only free cells
carry a proposition.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Bool, Float64, Int32
from scipy import ndimage

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.map_settings import parse_number, parse_numbers, read_yaml
from potlp_jax.errors import MapError
from potlp_jax.files import require_file, short, write_whole
from potlp_jax.task.propositions import MAX_PROPOSITIONS

PLACE_RADIUS = 0.5
"""Metres around a point that count as being there, where nothing gives a radius."""

Point = tuple[float | int, float | int]
"""Metres (x, y) in the map's frame."""


def places_file(file: Path, level: str | None = None) -> Path:
    """The file of a map's labels: beside it, and of every level that is named one of its own."""
    require_file(file, MapError)
    return file.with_suffix(".places.yaml" if level is None else f".{level.replace('/', '_')}.places.yaml")


@dataclass(frozen=True)
class Disc:
    """All that is near a point, in metres."""

    centre: Point
    radius: float | int

    def __str__(self) -> str:
        return f"point {_text(self.centre)} with radius {self.radius:g}"

    def covers(self, free: Bool[np.ndarray, "H W"], frame: GridFrame) -> Bool[np.ndarray, "H W"]:
        """Free cells of the disc that are connected within it to its point, or to the free cell nearest to that."""
        distance = _distances(self.centre, frame)
        # Distances are in cells, and exact where both the point and the resolution are round.
        near = distance <= self.radius / frame.resolution
        own = frame.metres_to_cell(*self.centre)
        # A small radius may reach no centre of a cell at all; the point's own cell counts whatever the radius is.
        if frame.contains(*own):
            near[own] = True
            distance[own] = 0.0
        near &= free
        if not near.any():
            return near
        # Of the pieces that walls leave of the disc only that of the point, so that nobody is met through a wall.
        labels = component_labels(near)
        return labels == labels.flat[np.argmin(np.where(near, distance, np.inf))]


@dataclass(frozen=True)
class Polygon:
    """The inside of a closed line through the vertices, in metres; the last one joins the first."""

    vertices: tuple[Point, ...]

    def __str__(self) -> str:
        return "polygon " + ", ".join(_text(vertex) for vertex in self.vertices)

    def covers(self, free: Bool[np.ndarray, "H W"], frame: GridFrame) -> Bool[np.ndarray, "H W"]:
        """Free cells whose centre lies inside."""
        vertices = frame.to_grid(np.array(self.vertices, dtype=np.float64))
        up, across = _centres(frame)
        inside = np.zeros(free.shape, dtype=bool)
        for (x0, y0), (x1, y1) in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
            # A ray to the right of a centre crosses the side; half-open in y, so that a shared vertex counts once.
            if y0 != y1:
                crosses = (y0 <= up) != (y1 <= up)
                inside ^= crosses & (across < x0 + (up - y0) * ((x1 - x0) / (y1 - y0)))
        return inside & free


Region = Disc | Polygon


@dataclass(frozen=True)
class Places:
    """Regions of each proposition, in the order of the letters' bits, and optionally a start and tasks.

    Attributes:
        propositions: pairs of a name and its regions.
        start: metres (x, y), or None to draw the start at random.
        tasks: pairs of a name and a formula.
        source: what to call this in messages: the file.
    """

    propositions: tuple[tuple[str, tuple[Region, ...]], ...]
    start: Point | None = None
    tasks: tuple[tuple[str, str], ...] = ()
    source: str = "places"

    @property
    def names(self) -> tuple[str, ...]:
        """The propositions' names."""
        return tuple(name for name, _ in self.propositions)


def load_places(file: Path | str) -> Places:
    """Read propositions, start and tasks from a YAML file.

    Raises:
        MapError: the file cannot be read, a key is missing or unknown, or a region is none.
    """
    file = Path(file)
    fields = read_yaml(file)
    _check_known(file, "", fields, ("propositions", "start", "tasks"))
    start = None
    if "start" in fields:
        # Whether it is free can be said of a grid only.
        start = _point(file, "start", fields["start"])
    return Places(
        _propositions(file, fields.get("propositions")), start, _tasks(file, fields.get("tasks", {})), str(file)
    )


def load_regions(file: Path | str, names: Sequence[str]) -> dict[str, dict[str, tuple[Region, ...]]]:
    """Regions by name under each of the keys ``names`` of a YAML file, in the form of the propositions above.

    Raises:
        MapError: the file cannot be read, has other keys, or a region is none.
    """
    file = Path(file)
    fields = read_yaml(file)
    _check_known(file, "", fields, tuple(names))
    return {name: dict(_named_regions(file, name, fields.get(name))) for name in names}


def save_places(places: Places, file: Path) -> None:
    """Write what `load_places` reads back as the same propositions, start and tasks. Raises OSError."""
    # The order of the propositions is that of the letters' bits, and is kept (``sort_keys``).
    fields: dict[str, Any] = {
        "propositions": {name: [_region_fields(region) for region in regions] for name, regions in places.propositions}
    }
    if places.start is not None:
        fields["start"] = _numbers(places.start)
    if places.tasks:
        fields["tasks"] = dict(places.tasks)
    # Labels are typed by hand: a full disk must not take those that were there.
    write_whole(file, yaml.safe_dump(fields, default_flow_style=None, sort_keys=False, allow_unicode=True))


def _region_fields(region: Region) -> dict[str, Any]:
    if isinstance(region, Disc):
        return {"point": _numbers(region.centre), "radius": float(region.radius)}
    return {"polygon": [_numbers(vertex) for vertex in region.vertices]}


def _numbers(point: Point) -> list[float]:
    return [float(point[0]), float(point[1])]


def check_points(places: Places, reachable: Bool[np.ndarray, "H W"], frame: GridFrame) -> None:
    """Check that every point of a disc lies in a cell that the robot can reach.

    A disc whose point lies in a wall still covers what is near on one side of it (`Disc.covers`), perhaps not the side
    that was meant.

    Args:
        places: whose discs are checked; polygons have no point.
        reachable: True on cells that the robot can reach.
        frame: metres to cells.

    Raises:
        MapError: one does not; the nearest cell that can be reached is named.
    """
    for name, regions in places.propositions:
        for region in regions:
            if isinstance(region, Disc):
                cell = frame.metres_to_cell(*region.centre)
                if not frame.contains(*cell) or not reachable[cell]:
                    raise MapError(
                        places.source,
                        f"propositions: {name}",
                        f"the robot cannot reach {_text(region.centre)}: it lies in or too near an obstacle, in "
                        "unknown space, or in a part that is not connected with the rest; the nearest cell that it "
                        "can reach is at "
                        f"{_text(nearest_free(region.centre, reachable, frame))}",
                    )


def place_letters(places: Places, reachable: Bool[np.ndarray, "H W"], frame: GridFrame) -> Int32[np.ndarray, "H W"]:
    """Letter of every cell; bit i is proposition i.

    Args:
        places: the propositions and their regions, in metres.
        reachable: True on cells that the robot can reach; only these carry propositions.
        frame: metres to cells.

    Returns:
        The letters, 0 where nothing holds.

    Raises:
        MapError: a region lies outside of the map, or covers no cell that the robot can reach.
    """
    letters = np.zeros(reachable.shape, dtype=np.int32)
    for bit, (name, regions) in enumerate(places.propositions):
        for region in regions:
            # A region that covers nothing would make its proposition silently impossible.
            covered = region.covers(reachable, frame)
            if not covered.any():
                raise MapError(
                    places.source, f"propositions: {name}", f"{region} {_why_nowhere(region, reachable, frame)}"
                )
            # Regions of two propositions may overlap: the cell's letter has both bits.
            letters[covered] |= 1 << bit
    return letters


def component_labels(free: Bool[np.ndarray, "H W"]) -> Int32[np.ndarray, "H W"]:
    """Number, from 1, of each free cell's component, in row-major order of their first cells; 0 on other cells.

    Components are 4-connected, which is the same as 8-connected without corner cutting.
    """
    labels = np.zeros(free.shape, dtype=np.int32)
    ndimage.label(free, output=labels)
    return labels


def free_cell_beside(
    region: Region, free: Bool[np.ndarray, "H W"], obstacle: Bool[np.ndarray, "H W"], frame: GridFrame
) -> tuple[int, int] | None:
    """Where a region is met that lies in obstacles, as where a map has turned a little since the region was named.

    Args:
        region: one that covers no free cell.
        free: True on free cells.
        obstacle: True on cells that are known to be obstacles.
        frame: metres to cells.

    Returns:
        Of the free cells that touch a cell of the region, also at a corner, the one nearest to the region's middle; of
        those at the same distance the first in row-major order. None where there is none, or where a cell of the region
        is no obstacle: what was not seen yet may turn out to be free.
    """
    own = region.covers(np.ones_like(free), frame)
    if not own.any() or not obstacle[own].all():
        return None
    beside = free & ndimage.binary_dilation(own, np.ones((3, 3), bool))
    return frame.metres_to_cell(*nearest_free(_middle(region), beside, frame)) if beside.any() else None


def nearest_free(point: Point, free: Bool[np.ndarray, "H W"], frame: GridFrame) -> Point:
    """The free cell nearest to a point.

    Args:
        point: metres (x, y).
        free: True on free cells; at least one is.
        frame: metres to cells.

    Returns:
        The cell's centre, metres (x, y). Of cells at the same distance the first in row-major order.
    """
    # Everything that is not free is infinitely far away.
    row, col = np.unravel_index(np.argmin(np.where(free, _distances(point, frame), np.inf)), free.shape)
    return frame.cell_to_metres(int(row), int(col))


def _why_nowhere(region: Region, reachable: Bool[np.ndarray, "H W"], frame: GridFrame) -> str:
    # On a map without walls: tells a region beyond the map from one inside of a wall.
    everywhere = region.covers(np.ones_like(reachable), frame)
    what = "covers no cell that the robot can reach" if everywhere.any() else "lies outside of the map's reachable part"
    return f"{what}; the nearest cell it can reach is at {_text(nearest_free(_middle(region), reachable, frame))}"


def _middle(region: Region) -> Point:
    points = np.array([region.centre] if isinstance(region, Disc) else region.vertices)
    return float(points[:, 0].mean()), float(points[:, 1].mean())


def _distances(point: Point, frame: GridFrame) -> Float64[np.ndarray, "H W"]:
    """From a point in metres to the centre of every cell, in cells."""
    up, across = _centres(frame)
    point_across, point_up = frame.to_grid(np.array([point], dtype=np.float64))[0]
    return np.hypot(across - point_across, up - point_up)


def _centres(frame: GridFrame) -> tuple[Float64[np.ndarray, "H 1"], Float64[np.ndarray, "1 W"]]:
    """Cell centres from the lower left corner, in cells: up for each row, across for each column."""
    return frame.height - 0.5 - np.arange(frame.height)[:, None], 0.5 + np.arange(frame.width)[None, :]


def _propositions(file: Path, value: Any) -> tuple[tuple[str, tuple[Region, ...]], ...]:
    # Regions of rooms (``load_regions``) may be more than a letter has bits; propositions may not.
    found = _named_regions(file, "propositions", value)
    if len(found) > MAX_PROPOSITIONS:
        raise MapError(file, "propositions", f"{len(found)} of them, at most {MAX_PROPOSITIONS} are possible")
    return found


def _named_regions(file: Path, field: str, value: Any) -> tuple[tuple[str, tuple[Region, ...]], ...]:
    if not isinstance(value, dict) or not value:
        raise MapError(file, field, "is missing or empty; it maps names to lists of regions")
    return tuple((str(name), _regions(file, f"{field}: {name}", regions)) for name, regions in value.items())


def _regions(file: Path, field: str, value: Any) -> tuple[Region, ...]:
    if not isinstance(value, list) or not value:
        raise MapError(
            file, field, "must be a list of regions, each {point: [x, y], radius: r} or {polygon: [[x, y], ...]}"
        )
    return tuple(_region(file, field, region) for region in value)


def _region(file: Path, field: str, value: Any) -> Region:
    # The keys tell what it is; one too many or too few is neither.
    if isinstance(value, dict) and set(value) == {"point", "radius"}:
        radius = float(parse_number(file, f"{field}: radius", value["radius"]))
        if radius < 0:
            raise MapError(file, f"{field}: radius", f"{radius:g} must not be negative")
        return Disc(_point(file, f"{field}: point", value["point"]), radius)
    if isinstance(value, dict) and set(value) == {"polygon"}:
        corners = value["polygon"]
        if not isinstance(corners, list) or len(corners) < 3:
            raise MapError(file, f"{field}: polygon", "needs three vertices [x, y] or more")
        return Polygon(tuple(_point(file, f"{field}: polygon", corner) for corner in corners))
    raise MapError(
        file, field, f"{short(value)} is no region; write {{point: [x, y], radius: r}} or {{polygon: [[x, y], ...]}}"
    )


def _point(file: Path, field: str, value: Any) -> Point:
    x, y = parse_numbers(file, field, value, ("x", "y"))
    return x, y


def _tasks(file: Path, value: Any) -> tuple[tuple[str, str], ...]:
    if not isinstance(value, dict) or not all(isinstance(text, str) and text.strip() for text in value.values()):
        raise MapError(file, "tasks", "must map names to formulas")
    return tuple(value.items())


def _check_known(file: Path, field: str, fields: Mapping[str, Any], known: tuple[str, ...]) -> None:
    unknown = sorted(set(fields) - set(known))
    if unknown:
        raise MapError(file, field or unknown[0], f"unknown key {unknown[0]!r}; known are {', '.join(known)}")


def _text(point: Point) -> str:
    return f"[{point[0]:.2f}, {point[1]:.2f}]"
