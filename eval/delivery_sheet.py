"""Floors of the delivery task from above, and what a robot sees of them: ``python -m eval.delivery_sheet --out FILE``.

Generated floors are training worlds, as many of each of the environments. ``--plans`` draws real floor plans, a file or
a folder, in their place.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy import ndimage

from eval.contact_sheet import Cell, draw_plan, mark_bearings
from potlp_jax.environments.campus.floor_generator import FloorGenerator
from potlp_jax.environments.campus.floor_plans import FloorPlanConfig, FloorPlans
from potlp_jax.environments.campus.furnishing import PEOPLE, Floor, Kind, Placement
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.view.style import INK, new_figure
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import World
from potlp_jax.world.renderer import render

_COLUMNS, _WIDTH = 4, 15.0
_PLAN_HEIGHT, _VIEW_HEIGHT = 2.5, 1.9
_QUALITY = 80


class Furnished(NamedTuple):
    """A world of the sheet."""

    title: str
    world: World
    floor: Floor
    placement: Placement


class View(NamedTuple):
    """A panorama of the sheet."""

    title: str
    world: World
    cell: Cell


def generated(environments: Sequence[str], count: int) -> Iterator[Furnished]:
    """The first training worlds of each."""
    for environment in environments:
        generator = make(environment)
        if not isinstance(generator, FloorGenerator):
            raise SystemExit(f"{environment} draws no floors: name delivery, parcels or a campus")
        for index in range(count // len(environments)):
            drawn = generator.generate_with_layout(world_key(Split.TRAINING, index, generator.name))
            yield Furnished(f"{environment} {index}", *drawn)


def planned(path: Path, count: int) -> Iterator[Furnished]:
    """The first buildings of a folder of plans, or one plan, with people in them."""
    files = sorted(path.glob("*.xml")) if path.is_dir() else [path]
    names = {floor.name for floor in FloorPlans(FloorPlanConfig(path)).floors}
    for file in [file for file in files if file.stem in names][:count]:
        generator = FloorPlans(FloorPlanConfig(file))
        world, found, placement = generator.generate_with_layout(world_key(Split.TEST, 0, generator.name))
        yield Furnished(found.name, world, found.floor, placement)


def choose_views(shown: Furnished) -> Iterator[View]:
    """The start, before a lit and a dark room, and inside of rooms."""
    world, floor, placement = shown.world, shown.floor, shown.placement
    yield View(f"{shown.title}, at the start", world, placement.start)
    lit, dark = _hallway_cells(floor, set(placement.rooms.values())), _hallway_cells(floor, None)
    if lit:
        yield View("in a hallway, before the door of a lit room", world, lit[0])
    if dark:
        yield View("in a hallway, before the door of a dark room", world, dark[len(dark) // 2])
    for name, (kind,) in PEOPLE.rooms.items():
        yield View(f"with the {name}, in a lit {kind.name.lower()}", world, placement.cells[name])
    empty = [room for room in floor.rooms_of(Kind.LAB) if room not in placement.rooms.values()]
    for room in empty[:1]:
        cells = np.argwhere((floor.rooms == room) & ~floor.doors)
        row, column = cells[len(cells) // 2]
        yield View("in an empty lab, in the dark", world, (int(row), int(column)))


def _hallway_cells(floor: Floor, rooms: set[int] | None) -> list[Cell]:
    """Cells of hallways two cells from a door of one of the rooms; None: of any room."""
    doors = floor.doors if rooms is None else floor.doors & np.isin(floor.rooms, list(rooms))
    away = ndimage.distance_transform_cdt(~doors, "taxicab")
    return [(int(row), int(column)) for row, column in np.argwhere((away == 2) & (floor.kind_of_cell == Kind.HALLWAY))]


def draw_sheet(shown: list[Furnished], views: list[View], path: Path) -> None:
    """Write the sheet: floors from above, then panoramas, two in a row."""
    plan_rows, view_rows = -(-len(shown) // _COLUMNS), -(-len(views) // 2)
    height = plan_rows * _PLAN_HEIGHT + view_rows * _VIEW_HEIGHT
    figure = new_figure(_WIDTH, height)
    for number, one in enumerate(shown):
        place = figure.add_axes(_box(number, _COLUMNS, 0.0, _PLAN_HEIGHT, height))
        draw_plan(place, one.world, PEOPLE.propositions, one.placement.start, wall_colours=True)
        place.set_title(one.title[:40], size=8, color=INK, pad=2)
    _draw_views(figure, views, plan_rows * _PLAN_HEIGHT, height)
    figure.savefig(path, dpi=90, pil_kwargs={"quality": _QUALITY} if path.suffix.lower() in (".jpg", ".jpeg") else None)


def _draw_views(figure: Figure, views: list[View], top: float, height: float) -> None:
    look = jax.jit(render, static_argnums=2)
    for number, view in enumerate(views):
        picture = np.asarray(look(view.world, jnp.asarray(np.array(view.cell, np.int32)), CameraConfig()))
        pane = figure.add_axes(_box(number, 2, top, _VIEW_HEIGHT, height))
        pane.imshow(picture, aspect="auto", interpolation="nearest")
        mark_bearings(pane, picture.shape[1])
        pane.set_title(view.title, size=8, loc="left", pad=2, color=INK)


def _box(number: int, columns: int, top: float, size: float, height: float) -> tuple[float, float, float, float]:
    """Left, bottom, width, height of a pane, as shares of the figure."""
    row, column = divmod(number, columns)
    return (column + 0.02) / columns, 1 - (top + (row + 0.88) * size) / height, 0.96 / columns, 0.74 * size / height


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="the picture's file: .png, .jpg, .pdf")
    parser.add_argument("--floors", type=int, default=12, help="how many floors")
    parser.add_argument("--environments", nargs="+", default=["delivery"], help="families of generated floors")
    parser.add_argument("--plans", type=Path, help="a floor plan or a folder of them")
    arguments = parser.parse_args()
    count = arguments.floors
    shown = list(
        generated(arguments.environments, count) if arguments.plans is None else planned(arguments.plans, count)
    )
    draw_sheet(shown, list(choose_views(shown[0])), arguments.out)


if __name__ == "__main__":
    main()
