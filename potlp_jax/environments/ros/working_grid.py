"""How large the cells of a working grid are where nobody says it, and what memory a map takes.

`DEFAULT_CELL` unless that makes more than `MOST_CELLS` cells of the map; then the finest multiple of the map's pixels
with which it makes no more. Cells are never chosen so large that a door of `DOOR` metres could be closed to the robot
(docs/maps.md: a passage stays open for certain if it holds two cells beside the robot): a map that is larger even so
gets more cells. The choice is a warning, since doors that are narrower may be closed by it.
"""

import logging
import os
import warnings
from fractions import Fraction
from pathlib import Path

from potlp_jax.errors import MapError, MapWarning

logger = logging.getLogger(__name__)

DEFAULT_CELL = Fraction(1, 5)
"""Metres. With a robot of 0.1 m a door of 0.6 m stays open wherever it lies on the grid."""

MOST_CELLS = 1 << 19
"""Cells of a working grid, somewhat more than the largest of which decisions were timed (docs/maps.md)."""

DOOR = Fraction(9, 10)
"""Metres: the width of an ordinary door."""

BYTES_A_PIXEL = 64
"""Memory at the height of reading and cleaning, rounded up; tests/test_working_grid.py measures it."""

LARGE = 1 << 22
"""Pixels from which on the memory that a map takes is stated: a quarter of a gibibyte."""


def choose_cell(file: Path, pixels: tuple[int, int], pixel: Fraction, radius: Fraction) -> Fraction:
    """The size of a cell, as the module describes.

    Args:
        file: the map, for the warning.
        pixels: rows and columns of the map.
        pixel: metres a pixel.
        radius: the robot's, in metres.

    Returns:
        Metres, at least those of a pixel.

    Warns:
        MapWarning: cells are larger than the default.
    """
    least = max(DEFAULT_CELL, pixel)
    widest = max(least, (DOOR / 2 - radius) // pixel * pixel)
    cell = least
    # The multiple of the pixels next to the default, and on from there.
    while _cells(pixels, pixel, cell) > MOST_CELLS and cell < widest:
        cell = min((cell // pixel + 1) * pixel, widest)
    if cell > DEFAULT_CELL:
        warnings.warn(_remark(file, pixels, pixel, cell, radius), MapWarning, stacklevel=3)
    return cell


def _cells(pixels: tuple[int, int], pixel: Fraction, cell: Fraction) -> int:
    height, width = (-(-size * pixel // cell) for size in pixels)
    return height * width


def _remark(file: Path, pixels: tuple[int, int], pixel: Fraction, cell: Fraction, radius: Fraction) -> str:
    height, width = pixels
    narrow, finer = 2 * (radius + cell), max(DEFAULT_CELL, pixel)
    why = (
        f"with cells of {float(finer):g} m there would be {_cells(pixels, pixel, finer):,}, more than {MOST_CELLS:,}"
        if cell > finer
        else "its pixels are as large"
    )
    return (
        f"{file}: resolution: {width:,} x {height:,} pixels of {float(pixel):g} m become "
        f"{_cells(pixels, pixel, cell):,} cells of {float(cell):g} m, because {why}; passages narrower than "
        f"{float(narrow):g} m may be closed. Give a resolution to choose another"
    )


def require_memory(file: Path, width: int, height: int) -> None:
    """State the memory that reading and cleaning a map takes, before it is taken.

    Raises:
        MapError: it is more than is available.

    """
    if width * height < LARGE:
        return
    need, free = width * height * BYTES_A_PIXEL, available_memory()
    known = "" if free is None else f"; {free / 2**30:.1f} GiB are available"
    text = f"{width:,} x {height:,} pixels: reading and cleaning takes about {need / 2**30:.1f} GiB of memory{known}"
    if free is not None and need > free:
        raise MapError(file, "", f"{text}. Crop the image, or save it with larger pixels")
    # Not a warning: those are gathered by `potlp map inspect`, and shown when the memory has been taken.
    logger.warning(f"{file}: {text}")


def available_memory() -> int | None:
    """Bytes that could be taken; None where the system does not say."""
    try:
        for line in Path("/proc/meminfo").read_text("utf-8").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) << 10
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None
