"""What generated floors are like beside real ones: sizes, rooms, hallways, loops, and what large arrays cost.

Real plans and walls are read from the folder that POTLP_EXTERNAL_DATA names. Writes ``floors.json`` and ``floors.md``;
with ``--sheet`` only a picture of generated floors beside real ones, which does not belong into the repository.
"""

import argparse
import json
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.floor_statistics.exploring import array_costs, frontiers_after_walk
from eval.floor_statistics.page import QUANTILES, page_of
from eval.floor_statistics.shape import FloorShape, shape_of
from eval.floor_statistics.sheet import draw_sheet
from eval.floor_statistics.sources import FAMILIES, generated_floors, plan_floors, wall_sides
from eval.provenance import RESULTS, lines_of
from potlp_jax.environments.campus.campus import LARGE
from potlp_jax.environments.campus.campus_builder import CampusFloor
from potlp_jax.environments.campus.furnishing import Floor
from potlp_jax.errors import MapError
from potlp_jax.sweep.rows import provenance

_SHOWN = 12
_MEDIUM = 64.0
"""Metres of the long side from which on a building is not small."""


def external_data() -> Path:
    """The folder of real plans."""
    folder = os.environ.get("POTLP_EXTERNAL_DATA")
    if folder is None:
        raise MapError("POTLP_EXTERNAL_DATA", "", "name the folder of real plans in this variable of the environment")
    return Path(folder)


def collect(folder: Path, count: int) -> dict[str, Any]:
    """All that is measured, JSON-able.

    Args:
        folder: of real plans and walls.
        count: floors of each generator.

    Returns:
        ``groups`` of floors with their measures and the shares of what they have, ``walls``, ``costs``, ``provenance``.
    """
    floors = {name: list(generated_floors(family, count)) for name, family in FAMILIES.items()}
    plans = [floor for _, floor in plan_floors(folder)]
    groups = {name: _measured(found) for name, found in {**floors, "plans": plans}.items()}
    campus = [name for name in FAMILIES if name != "delivery"]
    groups["generated"] = [one for name in campus for one in groups[name]]
    groups["plans to 64 m"] = [one for one in groups["plans"] if one[0].long_side <= _MEDIUM]
    groups["plans from 64 m"] = [one for one in groups["plans"] if one[0].long_side > _MEDIUM]
    return {
        "provenance": provenance(),
        "groups": {
            name: {"floors": len(found), "measures": _summary(found), "shares": _shares(floors.get(name, []))}
            for name, found in groups.items()
        },
        "walls": {
            name: {
                "floors": len(sides),
                "long_side": _quantiles([long for long, _ in sides]),
                "short_side": _quantiles([short for _, short in sides]),
            }
            for name, sides in wall_sides(folder).items()
        },
        "costs": array_costs(FAMILIES),
    }


def _measured(floors: Sequence[Floor]) -> list[tuple[FloorShape, int]]:
    """The shape of each, and its frontiers after a walk."""
    return [(shape_of(floor), frontiers_after_walk(floor, LARGE.largest, i)) for i, floor in enumerate(floors)]


def _summary(measured: Sequence[tuple[FloorShape, int]]) -> dict[str, list[float]]:
    single = ("long_side", "short_side", "area", "free", "rooms", "middle_room", "hallway_share", "longest_hallway")
    single += ("hallway_width", "doors_per_room", "room_loops", "hallway_loops", "dead_ends")
    found = {name: _quantiles([float(getattr(shape, name)) for shape, _ in measured]) for name in single}
    found["room_areas"] = _quantiles([area for shape, _ in measured for area in shape.room_areas])
    found["frontiers"] = _quantiles([float(count) for _, count in measured])
    return found


def _quantiles(values: Sequence[float]) -> list[float]:
    return np.quantile(values, QUANTILES).round(3).tolist()


def _shares(floors: Sequence[Floor]) -> dict[str, float]:
    """How many of the floors have each outline and each part."""
    campus = [floor for floor in floors if isinstance(floor, CampusFloor)]
    counts = Counter(f"outline: {floor.outline}" for floor in campus)
    counts.update(str(part) for floor in campus for part in floor.parts)
    return {name: counts[name] / len(campus) for name in sorted(counts, key=str.lower)}


def draw(folder: Path, file: Path) -> None:
    """Write twelve generated floors, of all sizes, beside twelve plans."""
    families = [family for family in FAMILIES.values() if family != "delivery"]
    generated = [
        floor for row in zip(*(generated_floors(f, _SHOWN // 3) for f in families), strict=True) for floor in row
    ]
    plans = sorted((floor for _, floor in plan_floors(folder)), key=lambda floor: max(floor.rooms.shape))
    chosen = [plans[int(index)] for index in np.linspace(0, len(plans) - 1, _SHOWN)]
    draw_sheet([("generated", generated), ("real", chosen)], file)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--floors", type=int, default=100, help="generated floors of each size")
    parser.add_argument("--out", type=Path, default=RESULTS, help="the folder of results")
    parser.add_argument("--sheet", type=Path, help="write this picture and nothing else")
    arguments = parser.parse_args()
    folder = external_data()
    if arguments.sheet is not None:
        draw(folder, arguments.sheet)
        return
    data = collect(folder, arguments.floors)
    (arguments.out / "floors.json").write_text(json.dumps(data, indent=1) + "\n", "utf-8")
    (arguments.out / "floors.md").write_text(lines_of(page_of(data), arguments.out), "utf-8")


if __name__ == "__main__":
    main()
