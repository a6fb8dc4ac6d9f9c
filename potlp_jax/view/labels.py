"""Where the names of a map's areas stand: beside or within the area, clear of the path, of its ends, of each other."""

import dataclasses
from collections.abc import Sequence
from typing import cast

import numpy as np
from jaxtyping import Float, Int, Int32, Num
from matplotlib.axes import Axes
from scipy import ndimage

from potlp_jax.view.style import INK
from potlp_jax.world.grid import World

MARGIN: float = 0.05
"""Inches between an area and a name beside it."""

MARK: float = 0.16
"""Inches from the centre of the marks of start and end that no name may touch."""

MAX_LABELS: int = 24
"""Areas that get a name, the largest first: more names than that cover the map."""

DISTANCES: tuple[float, ...] = (1.0, 1.6, 2.4, 3.4)
"""How far out a name is tried, in halves of its own size."""

SIDES = ((0, -1), (0, 1), (1, 0), (-1, 0), (1, -1), (-1, -1), (1, 1), (-1, 1))
"""Where a name is tried around its area (x, y), the best first: above, below, right, left, then the corners."""

# The others sum up to 68: both ends 30, the path 20, areas 10, and 8 for the last of 33 places.
FORBIDDEN: float = 100.0
"""Price of a name beyond the map or on another name: above the sum of all other prices."""


@dataclasses.dataclass(frozen=True)
class AreaLabel:
    """The name of an area, its ``centre`` and ``half_size`` (x, y), and the cell of the area that it points to."""

    name: str
    centre: tuple[float, float]
    anchor: tuple[float, float]
    half_size: tuple[float, float]


def map_extent(world: World) -> tuple[int, int]:
    """Rows and columns of the map without padding."""
    rows, columns = np.asarray(world.extent)
    return int(rows), int(columns)


def letter_name(letter: int, propositions: Sequence[str]) -> str:
    """The propositions that a letter makes true, joined by ``&``; ``-`` for none."""
    return " & ".join(name for bit, name in enumerate(propositions) if letter >> bit & 1) or "-"


def place_labels(
    world: World,
    propositions: Sequence[str],
    path: Sequence[tuple[int, int]],
    *,
    inches_per_cell: float,
    size: float = 9.0,
) -> list[AreaLabel]:
    """Names for the connected areas of each letter, largest first, where they hide little.

    Args:
        world: the map whose labelled areas are named.
        propositions: names by bit of a letter.
        path: cells (row, column) that a name should not cover; its ends, which are marked, weigh more.
        inches_per_cell: scale of the map in the picture.
        size: of the letters, in points.

    Returns:
        At most ``MAX_LABELS`` names in cells (x, y). An area around which there is no room has none.
    """
    rows, columns = map_extent(world)
    letters = np.asarray(world.letters)[:rows, :columns]
    labels: list[AreaLabel] = []
    # From (row, column) to (x, y).
    steps = np.array(path, float)[:, ::-1]
    # Greedy, large areas first, for their names are looked for first: the best placement of all names together is
    # NP-hard (Marks and Shieber, 1991).
    for letter, cells in _areas(letters)[:MAX_LABELS]:
        name = letter_name(letter, propositions)
        # Mean width and height of the font's letters, with the box around them: good enough without drawing it first.
        half = np.array([len(name) * size * 0.6 / 72 + 0.1, size * 1.35 / 72 + 0.06]) / 2 / inches_per_cell
        candidates = _candidates(cells, half, MARGIN / inches_per_cell)
        prices = [
            # The rank breaks ties in favour of near and upper places.
            _price(centre, half, labels, steps, letters, MARK / inches_per_cell) + 0.25 * rank
            for rank, centre in enumerate(candidates)
        ]
        best = int(np.argmin(prices))
        if prices[best] < FORBIDDEN:
            centre = candidates[best]
            anchor = cells[np.argmin(np.linalg.norm(cells[:, ::-1] - centre, axis=1))][::-1]
            labels.append(AreaLabel(name, _pair(centre), _pair(anchor), _pair(half)))
    return labels


def draw_labels(axes: Axes, labels: Sequence[AreaLabel], *, size: float = 9.0) -> None:
    """The names, with a thin line to areas that they stand beside.

    Args:
        axes: whose units are those of the labels: cells, or metres.
        labels: from ``place_labels``.
        size: of the letters in points, as they were placed.
    """
    for label in labels:
        # A name within its area needs no line.
        apart = np.abs(np.subtract(label.anchor, label.centre)) > label.half_size
        if np.any(apart):
            (x, y), (to_x, to_y) = label.centre, label.anchor
            # Above the path; the name itself above its line, and below the marks of start and end.
            axes.plot([x, to_x], [y, to_y], color=INK, linewidth=0.7, zorder=4)
        axes.text(
            *label.centre,
            label.name,
            ha="center",
            va="center",
            size=size,
            color=INK,
            zorder=5,
            bbox={"boxstyle": "round,pad=0.18", "facecolor": "white", "edgecolor": "#BBBBBB", "alpha": 0.9, "lw": 0.6},
        )


def _areas(letters: Int32[np.ndarray, "h w"]) -> list[tuple[int, Int[np.ndarray, "k 2"]]]:
    """Connected areas of equal letter as (letter, cells), large ones first."""
    areas = []
    for letter in np.unique(letters[letters > 0]).tolist():
        # Cells that touch at a corner belong together: diagonal rows of cells are one area to the eye.
        labelled = ndimage.label(letters == letter, structure=np.ones((3, 3), int))
        components, count = cast(tuple[np.ndarray, int], labelled)
        areas += [(letter, np.argwhere(components == index)) for index in range(1, count + 1)]
    return sorted(areas, key=lambda area: -len(area[1]))


def _candidates(
    cells: Int[np.ndarray, "k 2"], half: Float[np.ndarray, "2"], margin: float
) -> list[Float[np.ndarray, "2"]]:
    """Centres (x, y) to try, the best first: within an area that is large enough, then around it."""
    low, high = cells.min(axis=0)[::-1], cells.max(axis=0)[::-1]
    # Half a cell more than from centre to centre: cells are squares around whole numbers.
    centre, reach = (low + high) / 2, (high - low) / 2 + 0.5
    around = [centre + np.array(side) * (reach + grow * half + margin) for grow in DISTANCES for side in SIDES]
    return [centre, *around] if np.all(reach > half) else around


def _price(
    centre: Float[np.ndarray, "2"],
    half: Float[np.ndarray, "2"],
    placed: Sequence[AreaLabel],
    steps: Float[np.ndarray, "N 2"],
    letters: Int32[np.ndarray, "h w"],
    mark: float,
) -> float:
    """What a name would hide: another name (forbidden), the ends of the path, cells of the path and of areas."""
    # The picture ends half a cell beyond the centres of the outermost cells.
    last = np.array(letters.shape)[::-1] - 0.5
    outside = np.any(centre - half < -0.5) or np.any(centre + half > last)
    covers = any(np.all(np.abs(centre - other.centre) < half + other.half_size) for other in placed)
    if outside or covers:
        return FORBIDDEN
    ends = int(np.all(np.abs(steps[[0, -1]] - centre) < half + mark, axis=1).sum())
    on_path = int(np.all(np.abs(steps - centre) < half + 0.5, axis=1).sum())
    labelled = np.argwhere(letters > 0)[:, ::-1]
    on_areas = int(np.all(np.abs(labelled - centre) < half, axis=1).sum())
    # Bounded, so that a long path or a large area does not outweigh the ends. Within its own large area a name covers
    # at most the bound, like any name on an area; that is still better than a name far out.
    return 15.0 * ends + min(20.0, 1.5 * on_path) + min(10.0, 0.5 * on_areas)


def _pair(values: Num[np.ndarray, "2"]) -> tuple[float, float]:
    return float(values[0]), float(values[1])
