"""Generated floors beside real ones, at one scale, coloured by what rooms are for."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from scipy import ndimage

from potlp_jax.environments.campus.furnishing import Floor, Kind
from potlp_jax.view.style import INK, new_figure

_COLOURS = {
    Kind.HALLWAY: (226, 222, 212),
    Kind.OTHER: (160, 155, 150),
    Kind.OFFICE: (108, 146, 212),
    Kind.LAB: (110, 190, 120),
    Kind.CLASSROOM: (226, 170, 84),
}
_WALL, _DOOR = (52, 52, 52), (200, 30, 30)
_OUTSIDE = (255, 255, 255)
_COLUMNS = 3
_METRES_PER_INCH = 45.0
_GAP = 0.35
"""Inches between floors."""


def picture_of(floor: Floor) -> UInt8[np.ndarray, "H W 3"]:
    """A floor from above: doors red, closed rooms half as bright."""
    image = np.full((*floor.rooms.shape, 3), _WALL, np.uint8)
    kinds = floor.kind_of_cell
    for kind, colour in _COLOURS.items():
        image[kinds == kind] = colour
    image[floor.doors & ~floor.occupied] = _DOOR
    image[np.isin(floor.rooms, sorted(floor.closed))] //= 2
    # What no room is near is no wall: outdoors, or a solid core.
    image[np.logical_not(ndimage.binary_dilation(~floor.occupied, np.ones((3, 3))))] = _OUTSIDE
    return image


def draw_sheet(groups: Sequence[tuple[str, Sequence[Floor]]], file: Path) -> None:
    """Write a picture of floors in groups side by side, each in columns of its own, all at one scale.

    Args:
        groups: a title and the floors of each, three at least.
        file: .png, .jpg or .pdf.
    """
    columns = [floors[part::_COLUMNS] for _, floors in groups for part in range(_COLUMNS)]
    sizes = [[np.array(floor.rooms.shape) * floor.resolution / _METRES_PER_INCH for floor in own] for own in columns]
    widths = [max(wide for _, wide in own) + _GAP for own in sizes]
    width = sum(widths) + _GAP
    height = max(sum(tall + _GAP for tall, _ in own) for own in sizes) + 2 * _GAP
    figure = new_figure(width, height)
    for number, (column, own) in enumerate(zip(columns, sizes, strict=True)):
        left, top = _GAP + sum(widths[:number]), height - 2 * _GAP
        if number % _COLUMNS == 0:
            figure.text(left / width, 1 - 0.8 * _GAP / height, groups[number // _COLUMNS][0], size=11, color=INK)
        for floor, (tall, wide) in zip(column, own, strict=True):
            pane = figure.add_axes((left / width, (top - tall) / height, wide / width, tall / height))
            pane.imshow(picture_of(floor), interpolation="nearest", aspect="auto")
            pane.set_axis_off()
            top -= tall + _GAP
    figure.savefig(file, dpi=110)
