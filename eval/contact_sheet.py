"""Panoramas of fire-fighting buildings beside their maps: ``python -m eval.contact_sheet --out FILE``.

The worlds are training worlds. The figure's format is that of the file's ending.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from scipy import ndimage

from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.environments.firefighting_layout import (
    HALLWAYS,
    FirefightingConfig,
    FirefightingLayout,
    Room,
    hallway_columns,
    hallway_rows,
    room_columns,
)
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.view.style import CHOSEN, INK, area_colour, new_figure
from potlp_jax.world.camera import CameraConfig, Disturbance, disturb
from potlp_jax.world.grid import World
from potlp_jax.world.renderer import render

_WIDTH, _ROW_HEIGHT = 15.0, 1.85
_PICTURE_SHARE = 0.62
_QUALITY = 84

Cell = tuple[int, int]


class Scene(NamedTuple):
    """One row of the sheet."""

    title: str
    world: World
    cell: Cell
    disturbance: Disturbance = Disturbance()


def choose_scenes(count: int) -> list[Scene]:
    """Poses that tell something, taken from the first ``count`` training worlds that show it."""
    generator = Firefighting()
    drawn = [generator.generate_with_layout(world_key(Split.TRAINING, i, generator.name)) for i in range(count)]
    config = generator.config
    in_front, in_dead_end = (
        next(
            pair for pair in drawn if pair[1].alarm_blocked == blocked and pair[1].dead_end_mouth == pair[1].robot_room
        )
        for blocked in (False, True)
    )
    return [*_tour(config, *in_front), *_blocked_dead_end(config, *in_dead_end), *_conditions(config, *in_front)]


def _tour(config: FirefightingConfig, world: World, layout: FirefightingLayout) -> list[Scene]:
    clear = next(number for number in range(HALLWAYS) if number not in (layout.dead_end, layout.fire_hallway))
    room, far_room = layout.robot_room, layout.robot_room.other
    (first, last), (fire, _) = hallway_columns(config), layout.fire_columns
    middle = sum(hallway_rows(config, layout.fire_hallway)) // 2
    beside_fire = fire - 25 if fire - 25 > first else fire + 27
    mid_clear = (sum(hallway_rows(config, clear)) // 2, (first + last) // 2)
    smoke_title = f"before the fire's hallway, {_distance(config, room, fire)} cells off: smoke"
    return [
        Scene("at the start", world, layout.start),
        Scene("at the far wall of the robot's room", world, _opposite(config, room, clear, config.room_width - 2)),
        Scene("before the dead end: green tiles", world, _opposite(config, room, layout.dead_end, 4)),
        Scene(smoke_title, world, _opposite(config, room, layout.fire_hallway, 4)),
        Scene("before the clear hallway", world, _opposite(config, room, clear, 4)),
        Scene("in the fire's hallway, 25 cells from the fire", world, (middle, beside_fire)),
        Scene("in the fire", world, (middle, fire)),
        Scene("in the middle of the clear hallway", world, mid_clear),
        Scene("in the far room, before the fire's hallway", world, _opposite(config, far_room, layout.fire_hallway, 8)),
    ]


def _blocked_dead_end(config: FirefightingConfig, world: World, layout: FirefightingLayout) -> list[Scene]:
    distance = _distance(config, layout.dead_end_mouth, layout.fire_columns[0])
    before = _opposite(config, layout.dead_end_mouth, layout.dead_end, 6)
    return [Scene(f"another world: the dead end holds the fire, {distance} cells off", world, before)]


def _conditions(config: FirefightingConfig, world: World, layout: FirefightingLayout) -> list[Scene]:
    """The same places with lights off, and through a worse camera."""
    lit, (first, last) = np.ones(world.shape, np.float32), hallway_columns(config)
    dark_hallways, dark_room = lit.copy(), lit.copy()
    dark_hallways[:, first:last] = 0.0
    dark_room[:, slice(*room_columns(config, layout.robot_room))] = 0.0
    before = _opposite(config, layout.robot_room, layout.dead_end, 4)
    rough = Disturbance(noise=6.0, exposure=0.15, colour=0.05)
    return [
        Scene("lights off in the hallways", _lit(world, dark_hallways), before),
        Scene("lights off in the robot's room", _lit(world, dark_room), before),
        Scene("noise, exposure and colours disturbed", world, before, rough),
    ]


def _lit(world: World, light: np.ndarray) -> World:
    return dataclasses.replace(world, appearance=dataclasses.replace(world.appearance, light=jnp.asarray(light)))


def _opposite(config: FirefightingConfig, room: Room, hallway: int, distance: int) -> Cell:
    """The cell of a room that lies ``distance`` cells in front of the middle of a hallway's mouth."""
    first, last = room_columns(config, room)
    return sum(hallway_rows(config, hallway)) // 2, last - distance if room is Room.LEFT else first + distance - 1


def _distance(config: FirefightingConfig, room: Room, column: int) -> int:
    """Cells from a room to a column of the hallways."""
    first, last = hallway_columns(config)
    return column - first if room is Room.LEFT else last - 1 - column


def draw_sheet(scenes: list[Scene], path: Path) -> None:
    """Write the sheet: a row a scene, the panorama on the left, the map on the right."""
    look = jax.jit(render, static_argnums=2)
    figure = new_figure(_WIDTH, _ROW_HEIGHT * len(scenes))
    for number, scene in enumerate(scenes):
        picture = look(scene.world, jnp.asarray(np.array(scene.cell, np.int32)), CameraConfig())
        picture = disturb(picture, jax.random.key(number), scene.disturbance)
        bottom, height = 1 - (number + 1) / len(scenes), 1 / len(scenes)
        pane = figure.add_axes((0.01, bottom + 0.14 * height, _PICTURE_SHARE - 0.02, 0.72 * height))
        pane.imshow(np.asarray(picture), aspect="auto", interpolation="nearest")
        mark_bearings(pane, picture.shape[1])
        pane.set_title(scene.title, size=9, loc="left", pad=3, color=INK)
        plan = figure.add_axes((_PICTURE_SHARE, bottom + 0.06 * height, 0.99 - _PICTURE_SHARE, 0.86 * height))
        draw_plan(plan, scene.world, Firefighting.propositions, scene.cell)
    figure.savefig(path, pil_kwargs={"quality": _QUALITY} if path.suffix.lower() in (".jpg", ".jpeg") else None)


def mark_bearings(pane: Axes, columns: int) -> None:
    """Name the bearings below a panorama of so many columns."""
    names = ("west", "north", "east", "south", "west")
    pane.set_xticks(np.linspace(0, columns, len(names)) - 0.5, names, size=7, color="#6E6E6E")
    pane.set_yticks([])
    pane.tick_params(length=2, color="#6E6E6E", pad=1)


def draw_plan(plan: Axes, world: World, propositions: Sequence[str], cell: Cell, *, wall_colours: bool = False) -> None:
    """The map as it looks from above, without padding, its letters, and the robot's cell; walls grey or coloured."""
    rows, columns = (int(size) for size in np.asarray(world.extent))
    window, look = (slice(rows), slice(columns)), world.appearance
    occupied, smoke = np.asarray(world.occupied)[window], np.asarray(look.smoke)[window][..., None]
    floor = np.asarray(look.floor_colour)[window] * (0.25 + 0.75 * np.asarray(look.light)[window][..., None])
    hidden = 1 - np.exp(-6 * smoke)
    # Walls have a colour where they stand beside something; the rest is out of sight.
    facing = np.logical_and(wall_colours, ndimage.binary_dilation(~occupied, np.ones((3, 3))))[..., None]
    walls = np.where(facing, 0.6 * np.asarray(look.wall_colour)[window], 70)
    image = np.where(occupied[..., None], walls, floor * (1 - hidden) + 250 * hidden)
    plan.imshow(image.astype(np.uint8), interpolation="nearest")
    letters = np.asarray(world.letters)[window]
    for bit, name in enumerate(propositions):
        rows_of, columns_of = np.nonzero(letters >> bit & 1)
        colour = area_colour(bit)
        plan.scatter(columns_of, rows_of, s=5, marker="s", color=colour, linewidths=0)
        above = name == "exit" or rows_of.mean() > 0.9 * rows
        plan.annotate(
            name,
            (columns_of.mean(), rows_of.mean() + (-2 if above else 2)),
            ha="center",
            va="bottom" if above else "top",
            size=6,
            color=INK,
            bbox={"boxstyle": "round,pad=0.12", "facecolor": "white", "edgecolor": colour, "lw": 0.8},
        )
    plan.plot(cell[1], cell[0], marker="o", markersize=7, color=CHOSEN, markeredgecolor="white", markeredgewidth=1.2)
    plan.set_axis_off()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="the picture's file: .png, .jpg, .pdf")
    parser.add_argument("--worlds", type=int, default=20, help="training worlds to choose from")
    arguments = parser.parse_args()
    draw_sheet(choose_scenes(arguments.worlds), arguments.out)


if __name__ == "__main__":
    main()
