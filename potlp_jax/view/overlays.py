"""What an estimator shows (``learning.overlays``), for the page of a trial and as a picture of one decision."""

import base64
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from potlp_jax.learning.overlays import Imagined, Overlay, Painted
from potlp_jax.trials.record import Decision, Trial
from potlp_jax.view.decisions import describe_decision
from potlp_jax.view.labels import map_extent
from potlp_jax.view.layers import cell_image, draw_subgoals
from potlp_jax.view.style import (
    IMAGINED_FREE,
    IMAGINED_WALL,
    INK,
    QUIET,
    ROBOT,
    area_colour,
    new_figure,
    rgb,
)

LEAST_CHANCE: float = 0.02
"""That a proposition holds in a square; less than this is not drawn."""

_WIDTH: float = 12.0
"""Inches of the picture of one decision."""


def strength(chance: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """How strong the colour of a chance is, from 0 to 1: its square root, on pages too (replay.js)."""
    # A fire may be anywhere, and then no square has more than a few percent: those must be seen.
    return np.where(chance < LEAST_CHANCE, 0.0, np.sqrt(chance))


def describe_overlay(overlay: Overlay, extent: tuple[int, int]) -> dict[str, Any]:
    """What a page says once about an overlay of all decisions; ``extent``: rows and columns that are shown."""
    if isinstance(overlay, Painted):
        return {"kind": "painted", "name": overlay.name}
    rows, columns = _squares(overlay, extent)
    return {"kind": "imagined", "name": overlay.name, "side": overlay.side, "rows": rows, "columns": columns}


def pack_overlay(overlay: Overlay, extent: tuple[int, int]) -> str:
    """An overlay at one decision as text: an image, a pixel for each cell; or bytes of chances, 255 for certainty."""
    return _pack_colours(overlay, extent) if isinstance(overlay, Painted) else _pack_chances(overlay, extent)


def _pack_colours(painted: Painted, extent: tuple[int, int]) -> str:
    rows, columns = extent
    mask = np.asarray(painted.mask)[:rows, :columns, None]
    # Cells without a colour are transparent; what their colour would be must not make the image larger.
    colours = np.where(mask, np.asarray(painted.colours)[:rows, :columns], 0)
    buffer = io.BytesIO()
    image = np.concatenate([colours, np.where(mask, 255, 0)], axis=2).astype(np.uint8)
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _pack_chances(imagined: Imagined, extent: tuple[int, int]) -> str:
    rows, columns = _squares(imagined, extent)
    chances = np.concatenate([np.asarray(imagined.free)[:, :, None], np.asarray(imagined.holds)], axis=2)
    # The page tells a percent from the next one; a byte is finer.
    return base64.b64encode(np.round(chances[:rows, :columns] * 255).astype(np.uint8).tobytes()).decode()


def _squares(overlay: Imagined, extent: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the squares that have a cell within the extent."""
    return -(-extent[0] // overlay.side), -(-extent[1] // overlay.side)


def draw_overlays(trial: Trial, decision: Decision, overlays: Sequence[Overlay]) -> Figure:
    """The map at a decision, once for each overlay, with the subgoals and the robot.

    Args:
        trial: of the decision.
        decision: what was known then is drawn as known.
        overlays: of the estimator at this decision, at least one.

    Returns:
        Panels below each other, or side by side where the map is higher than wide.
    """
    rows, columns = map_extent(trial.world)
    across = len(overlays) if rows > columns else 1
    down = len(overlays) // across
    panel = _WIDTH / across - 0.2, (_WIDTH / across - 0.2) * rows / columns
    head, foot = 0.35, 0.55
    height = head + down * (panel[1] + 0.3) + foot
    figure = new_figure(_WIDTH, height)
    figure.text(0.01, 1 - 0.1 / height, describe_decision(trial, decision), va="top", size=9, color=INK)
    for number, overlay in enumerate(overlays):
        line, column = divmod(number, across)
        bottom = foot + (down - 1 - line) * (panel[1] + 0.3)
        box = (0.1 + column * _WIDTH / across) / _WIDTH, bottom / height, panel[0] / _WIDTH, panel[1] / height
        axes = figure.add_axes(box)
        axes.imshow(_picture(trial, decision, overlay), extent=(-0.5, columns - 0.5, rows - 0.5, -0.5), zorder=0)
        axes.set(xticks=[], yticks=[])
        axes.set_title(overlay.name, loc="left", size=9, color=INK)
        _mark(axes, decision)
    _draw_key(figure, trial.propositions, height)
    return figure


def _mark(axes: Axes, decision: Decision) -> None:
    draw_subgoals(axes, decision)
    axes.plot(decision.cell[1], decision.cell[0], "o", ms=8, mfc=ROBOT, mec=INK, mew=1.2, zorder=8)


def _picture(trial: Trial, decision: Decision, overlay: Overlay) -> UInt8[np.ndarray, "h w 3"]:
    """The map as it was known, below or around the overlay; squares of whole pixels for each cell."""
    rows, columns = map_extent(trial.world)
    seen = ~np.asarray(trial.belief_of(decision).unknown)
    known = cell_image(trial.world, seen, trial.propositions, hatch=False)
    scale = known.shape[0] // rows
    colours, mask = _laid(overlay, seen)
    colours, mask = (part[:rows, :columns].repeat(scale, axis=0).repeat(scale, axis=1) for part in (colours, mask))
    return np.where(mask[:, :, None], colours, known)


def _laid(overlay: Overlay, seen: Bool[np.ndarray, "H W"]) -> tuple[UInt8[np.ndarray, "H W 3"], np.ndarray]:
    """Colours of cells, and where they cover the map."""
    if isinstance(overlay, Painted):
        return np.asarray(overlay.colours), np.asarray(overlay.mask)
    height, width = seen.shape
    return _imagined_colours(overlay)[:height, :width], ~seen


def _imagined_colours(imagined: Imagined) -> UInt8[np.ndarray, "rows columns 3"]:
    """Colours of the cells of all squares: of how free they are, and over it of what is likely to hold there."""
    free, holds = (np.asarray(part, np.float64) for part in (imagined.free, imagined.holds))
    wall, ground = (np.array(rgb(colour), float) for colour in (IMAGINED_WALL, IMAGINED_FREE))
    below = wall + (ground - wall) * free[:, :, None]
    areas = np.array([rgb(area_colour(bit)) for bit in range(holds.shape[2])], float)
    strong = strength(holds)
    line, column = np.indices((free.shape[0] * imagined.side, free.shape[1] * imagined.side))
    square = line // imagined.side, column // imagined.side
    # Cells along a diagonal take turns, so that several propositions of one square show beside each other.
    count = np.maximum(np.sum(strong > 0, axis=2), 1)[square]
    order = np.argsort(-strong, axis=2, kind="stable")[square]
    bit = np.take_along_axis(order, ((line + column) % count)[:, :, None], axis=2)[:, :, 0]
    weight = strong[(*square, bit)][:, :, None]
    return np.round((1 - weight) * below[square] + weight * areas[bit]).astype(np.uint8)


def _draw_key(figure: Figure, propositions: Sequence[str], height: float) -> None:
    entries: Mapping[str, str] = {"imagined free": IMAGINED_FREE, "imagined obstacle": IMAGINED_WALL} | {
        name: area_colour(bit) for bit, name in enumerate(propositions)
    }
    handles = [Patch(facecolor=colour, edgecolor=QUIET, linewidth=0.5, label=name) for name, colour in entries.items()]
    figure.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(0.005, 0.18 / height),
        ncols=len(handles),
        fontsize=8,
        frameon=False,
    )
    text = "Where nothing was observed yet, the stronger a proposition's colour the more likely it holds there."
    figure.text(0.01, 0.08 / height, text, size=7.5, color=QUIET, va="bottom")
