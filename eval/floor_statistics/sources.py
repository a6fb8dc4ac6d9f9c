"""Floors to measure: generated ones, and real ones from the folder that ``POTLP_EXTERNAL_DATA`` names."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from eval.floor_statistics.walls import Sides, gazebo_sides, traffic_editor_sides
from potlp_jax.environments.campus.floor_generator import FloorGenerator
from potlp_jax.environments.campus.floor_plan_xml import read_kinds, read_plan
from potlp_jax.environments.campus.furnishing import Floor
from potlp_jax.environments.campus.plan_floor import rasterise
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key

FAMILIES: Mapping[str, str] = {
    "delivery": "delivery",
    "small": "campus-small",
    "medium": "campus-medium",
    "large": "campus-large",
}
"""Generators by the name of their group."""

_RESOLUTION = 0.5
"""Metres a cell, for plans as for generated floors."""


def generated_floors(family: str, count: int) -> Iterator[Floor]:
    """The first floors of the split from which estimators learn."""
    generator = generator_of(family)
    for index in range(count):
        yield generator.draw_floor(world_key(Split.TRAINING, index, generator.name))


def generator_of(family: str) -> FloorGenerator:
    """The generator of a family of floors, by name."""
    generator = make(family)
    assert isinstance(generator, FloorGenerator)
    return generator


def plan_floors(folder: Path) -> Iterator[tuple[str, Floor]]:
    """The kind of building and the floor of every plan, whether or not tasks can be set in it."""
    kinds = read_kinds()
    for file in sorted(folder.glob("floorplans/*/*.xml")):
        yield file.parent.name, rasterise(read_plan(file), kinds, _RESOLUTION).floor


def wall_sides(folder: Path) -> dict[str, list[Sides]]:
    """Sides of the buildings of which only walls are known, by where they come from."""
    levels = [traffic_editor_sides(file) for file in sorted(folder.glob("buildings/rmf/*.building.yaml"))]
    return {
        "KTH campus": [gazebo_sides(file) for file in sorted(folder.glob("buildings/kth/*.world"))],
        "Open-RMF": [sides for building in levels for sides in building.values()],
    }
