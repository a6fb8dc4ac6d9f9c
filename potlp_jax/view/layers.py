"""The layers of a map's picture: cells, path, marks and subgoals, each drawn onto given axes, and their legend.

Axes show the map in cells: x is the column, y the row, row 0 at the top.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from potlp_jax.task.task import Task
from potlp_jax.task.words import state_words
from potlp_jax.trials.record import Decision, Trial
from potlp_jax.view.decisions import shortened
from potlp_jax.view.labels import map_extent
from potlp_jax.view.style import (
    CHOSEN,
    FAINT,
    FREE_SEEN,
    FREE_UNSEEN,
    HATCH,
    INK,
    QUIET,
    ROBOT,
    WALL_SEEN,
    WALL_UNSEEN,
    area_colour,
    faded,
    rgb,
    state_colour,
)
from potlp_jax.world.grid import World

# What covers what (zorder): the raster 0, path 3, decisions and the lines of names 4, names and the intended path 5,
# subgoals and the start 6, the end 7, changes of state and the robot 8, numbers of subgoals 9.
IMAGE_PIXELS: int = 1400
"""Longer side of the raster below the lines; cells become squares of whole pixels."""

MAX_CELL_PIXELS: int = 60
"""Small maps need no larger squares than this."""

PATH_WIDTH: float = 2.4
"""Of the line of a path, in points."""

MARK_INCHES, LETTER_INCHES = 0.5, 0.068
"""Of a legend: the mark and the gaps before and after its words, and their letters of ``LEGEND_SIZE``."""

LEGEND_SIZE: float = 8.5
"""Points."""

MAX_CHANGES: int = 30
"""Changes of state that are marked; a trial with more shows the first."""


def cell_image(
    world: World, seen: Bool[np.ndarray, "H W"], propositions: Sequence[str], *, hatch: bool, pixels: int = IMAGE_PIXELS
) -> UInt8[np.ndarray, "h w 3"]:
    """The map as a raster: seen cells clear, unseen ones grey (with stripes if ``hatch``), labelled areas coloured.

    A cell with several propositions has stripes of their colours.

    Args:
        world: the true map.
        seen: True for cells that are drawn as known.
        propositions: names by bit of a letter; only their number matters.
        hatch: whether unseen cells are striped, so that they differ from walls in grey prints too.
        pixels: of the image's longer side, at most.

    Returns:
        The image, row 0 at the top; all cells are squares of the same whole number of pixels.
    """
    rows, columns = map_extent(world)
    seen = seen[:rows, :columns]
    occupied = np.asarray(world.occupied)[:rows, :columns]
    letters = np.asarray(world.letters)[:rows, :columns]
    # Whole pixels a cell: a raster that is scaled by a fraction loses thin walls.
    scale = int(np.clip(pixels // max(rows, columns), 1, MAX_CELL_PIXELS))
    # Index: occupied + 2 * unseen.
    palette = np.array([rgb(FREE_SEEN), rgb(WALL_SEEN), rgb(FREE_UNSEEN), rgb(WALL_UNSEEN)], np.uint8)
    image = _enlarge(palette[occupied + 2 * ~seen], scale)
    line, column = np.indices(image.shape[:2])
    stripe = line + column
    for letter in np.unique(letters[letters > 0]):
        colours = [rgb(area_colour(bit)) for bit in range(len(propositions)) if letter >> bit & 1]
        area = _enlarge(letters == letter, scale)
        # Stripes run diagonally, so that each cell shows every colour whatever its place.
        striped = np.array(colours, np.uint8)[(stripe // max(3, scale // 2)) % len(colours)]
        image[area] = striped[area]
    unseen = _enlarge(~seen, scale)
    area = _enlarge(letters > 0, scale) & unseen
    image[area] = faded(image[area])
    # Every fourteenth diagonal, two pixels wide: visible, and calmer than the walls.
    if hatch:
        image[unseen & (stripe % 14 < 2)] = rgb(HATCH)
    return image


def show_cells(
    axes: Axes,
    world: World,
    seen: Bool[np.ndarray, "H W"],
    propositions: Sequence[str],
    *,
    hatch: bool,
    pixels: int = IMAGE_PIXELS,
) -> None:
    """Put the raster of ``cell_image`` on the axes and fit them to it.

    Args:
        axes: x becomes the column, y the row, row 0 at the top.
        world: the true map.
        seen: True for cells that are drawn as known.
        propositions: names by bit of a letter.
        hatch: whether unseen cells are striped.
        pixels: of the raster's longer side, at most.
    """
    rows, columns = map_extent(world)
    image = cell_image(world, seen, propositions, hatch=hatch, pixels=pixels)
    # Cell centres are whole numbers.
    axes.imshow(image, extent=(-0.5, columns - 0.5, rows - 0.5, -0.5), interpolation="nearest", zorder=0)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), aspect="equal")
    for spine in axes.spines.values():
        spine.set_color(FAINT)


def draw_path(
    axes: Axes, path: Sequence[tuple[int, int]], states: Sequence[int], *, inches_per_cell: float
) -> LineCollection:
    """The path in the colours of the states in which its steps were begun; traffic keeps to the right.

    Keeping to the right by half a line's width shows both colours where the robot came back the same way.

    Args:
        axes: a map.
        path: cells (row, column), the start first.
        states: of the automaton, one per cell of the path.
        inches_per_cell: scale of the map, which turns the line's width into cells.

    Returns:
        The lines, one segment a step.
    """
    # Points to inches to cells. Slightly more than half a line's width, so that a gap parts the two directions.
    lane = _keep_right(np.array(path, float)[:, ::-1], 0.6 * PATH_WIDTH / 72 / inches_per_cell)
    segments = np.stack([lane[:-1], lane[1:]], axis=1)
    lines = LineCollection(
        list(segments),
        # The state changes on arrival: a step has the colour of the state in which it was begun.
        colors=[state_colour(state) for state in states[:-1]],
        linewidths=PATH_WIDTH,
        capstyle="round",
        zorder=3,
    )
    axes.add_collection(lines)
    return lines


def draw_ends(axes: Axes, path: Sequence[tuple[int, int]]) -> None:
    """The first cell as a white disc, the last one as a star."""
    axes.plot(path[0][1], path[0][0], "o", ms=9, mfc="white", mec=INK, mew=1.8, zorder=6)
    axes.plot(path[-1][1], path[-1][0], "*", ms=16, mfc=ROBOT, mec=INK, mew=1.0, zorder=7)


def mark_changes(axes: Axes, trial: Trial) -> None:
    """A numbered disc where the automaton's state changed."""
    changes = [step for step in range(1, len(trial.states)) if trial.states[step] != trial.states[step - 1]]
    ends = (trial.path[0], trial.path[-1])
    for step in changes[:MAX_CHANGES]:
        row, column = trial.path[step]
        state = trial.states[step]
        axes.annotate(
            str(state),
            (column, row),
            # Beside the mark of the start or the end, which would hide it.
            xytext=(12, 8) if (row, column) in ends else (0, 0),
            textcoords="offset points",
            ha="center",
            va="center",
            size=7.5,
            color="white",
            zorder=8,
            bbox={"boxstyle": "circle,pad=0.25", "facecolor": state_colour(state), "edgecolor": "white", "lw": 0.8},
        )


def mark_decisions(axes: Axes, trial: Trial) -> None:
    """A small dot where each decision was made."""
    if trial.decisions:
        rows, columns = zip(*(decision.cell for decision in trial.decisions), strict=True)
        axes.scatter(columns, rows, s=9, color=INK, linewidths=0, zorder=4)


def draw_subgoals(axes: Axes, decision: Decision, *, size: float = 8.0) -> None:
    """Open triangles at the subgoals of a decision, with their numbers as in its actions; a filled one where it went.

    Args:
        axes: a map.
        decision: whose subgoals and target are drawn.
        size: of the numbers, in points.
    """
    if decision.subgoals:
        rows, columns = zip(*decision.subgoals, strict=True)
        axes.scatter(columns, rows, s=52, marker="^", facecolors="white", edgecolors=CHOSEN, linewidths=1.6, zorder=6)
    if decision.target is not None:
        row, column = decision.target
        # Larger than an open triangle, which it covers where the target is one of the subgoals.
        axes.scatter([column], [row], s=60, marker="^", facecolors=CHOSEN, edgecolors="white", linewidths=0.8, zorder=6)
    # A white rim keeps a number readable on walls and on the path.
    rim = [patheffects.withStroke(linewidth=2.5, foreground="white")]
    # Toward the middle of the map, so that no number leaves it.
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    for number, (row, column) in enumerate(decision.subgoals):
        inward = (1 if column < (left + right) / 2 else -1, -1 if row < (bottom + top) / 2 else 1)
        axes.annotate(
            f"s{number}",
            (column, row),
            xytext=(8 * inward[0], 7 * inward[1]),
            textcoords="offset points",
            ha="center",
            va="center",
            size=size,
            weight="bold",
            color=CHOSEN if (row, column) == decision.target else INK,
            path_effects=rim,
            zorder=9,
        )


def cell_handles() -> list[Line2D | Patch]:
    """Legend entries of what is known of a cell."""
    return [
        Patch(facecolor=FREE_SEEN, edgecolor=FAINT, label="seen free"),
        Patch(facecolor=WALL_SEEN, label="seen wall"),
        # matplotlib hatches in the colour of the edge; a width of 0 leaves out the edge itself.
        Patch(facecolor=FREE_UNSEEN, edgecolor=QUIET, hatch="////", linewidth=0, label="never seen"),
    ]


def area_handles(propositions: Sequence[str], world: World) -> list[Patch]:
    """Legend entries of the propositions that occur in the world."""
    # A proposition that the world does not have would be searched for in vain.
    present = int(np.bitwise_or.reduce(np.asarray(world.letters), axis=None))
    return [
        Patch(facecolor=to_rgba(area_colour(bit)), edgecolor=FAINT, linewidth=0.5, label=name)
        for bit, name in enumerate(propositions)
        if present >> bit & 1
    ]


def end_handles() -> list[Line2D | Patch]:
    """Legend entries of the marks of start and end."""
    return [
        Line2D([], [], marker="o", ls="", ms=8, mfc="white", mec=INK, mew=1.6, label="start"),
        Line2D([], [], marker="*", ls="", ms=12, mfc=ROBOT, mec=INK, label="end"),
    ]


def subgoal_handles(decisions: Sequence[Decision]) -> list[Line2D | Patch]:
    """Legend entries of the subgoals and targets of decisions, of which there may be none."""
    handles: list[Line2D | Patch] = []
    if any(decision.subgoals for decision in decisions):
        handles.append(Line2D([], [], marker="^", ls="", ms=7, mfc="white", mec=CHOSEN, mew=1.5, label="subgoal"))
    if any(decision.target is not None for decision in decisions):
        handles.append(Line2D([], [], marker="^", ls="", ms=7, mfc=CHOSEN, mec="white", label="chosen"))
    return handles


def state_handles(states: Sequence[int], task: Task, *, words: bool = True) -> list[Line2D]:
    """Legend entries of automaton states.

    Args:
        states: in any order, with repetitions.
        task: says what a state asks for.
        words: whether that is written after the number.

    Returns:
        One entry a state, by number.
    """
    return [
        Line2D(
            [],
            [],
            color=state_colour(state),
            linewidth=3,
            label=f"state {state}: {state_words(task, state)}" if words else f"state {state}",
        )
        for state in sorted(set(states))
    ]


def legend_columns(handles: Sequence[Line2D | Patch], width: float) -> int:
    """As many columns of a legend as fit ``width`` inches, such that its rows are equally long if possible."""
    # matplotlib makes a column as wide as its widest entry; as if all were as wide as the longest, none runs out.
    longest = max(len(str(handle.get_label())) for handle in handles)
    fit = max(1, int(width / (MARK_INCHES + LETTER_INCHES * longest)))
    # Seven entries in rows of six would leave one alone in the second row.
    return math.ceil(len(handles) / math.ceil(len(handles) / fit))


def shorten_labels(handles: Sequence[Line2D | Patch], width: float) -> None:
    """Cut the labels of legend entries that alone are wider than ``width`` inches."""
    letters = int((width - MARK_INCHES) / LETTER_INCHES)
    for handle in handles:
        handle.set_label(shortened(str(handle.get_label()), letters))


def _enlarge(cells: np.ndarray, scale: int) -> np.ndarray:
    return cells.repeat(scale, axis=0).repeat(scale, axis=1)


def _keep_right(points: Float[np.ndarray, "N 2"], offset: float) -> Float[np.ndarray, "N 2"]:
    """Points moved to the right of the direction of travel (y downward), the direction averaged over a few steps."""
    if len(points) < 2:
        return points
    # Two steps before and after: staircases of diagonal paths are smoothed, corners stay.
    padded = np.concatenate([points[:1], points[:1], points, points[-1:], points[-1:]])
    heading = padded[4:] - padded[:-4]
    length = np.linalg.norm(heading, axis=1, keepdims=True)
    # y points down, hence right of (x, y) is (-y, x). A robot that stands still has no direction.
    right = np.stack([-heading[:, 1], heading[:, 0]], axis=1) / np.where(length > 0, length, 1)
    return points + offset * right
