"""Pictures of a trial: the true map, what was seen of it, and the path by automaton state."""

import dataclasses
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy import ndimage

from potlp_jax.errors import PictureError
from potlp_jax.task.task import Task
from potlp_jax.trials.record import NEVER_SEEN, Decision, Trial
from potlp_jax.view.style import CHOSEN, FAINT, INK, ROBOT, area_colour, new_figure, rgb, state_colour
from potlp_jax.world.grid import World

FREE_SEEN, WALL_SEEN = "#FFFFFF", "#4A4A4A"
FREE_UNSEEN, WALL_UNSEEN = "#E4E4E4", "#C6C6C6"
HATCH = "#B4B4B4"
IMAGE_PIXELS: int = 1400
"""Longer side of the raster below the lines; cells become squares of whole pixels."""

MAX_INCHES_PER_CELL: float = 0.45
LABEL_MARGIN: float = 0.05
MAX_LABELS: int = 24
PATH_WIDTH: float = 2.4


def draw_trial(trial: Trial) -> Figure:
    """One picture of a finished trial, with its legend."""
    rows, columns = map_extent(trial.world)
    width, height = _map_size(rows, columns, longest=11.0)
    task = Task.from_hoa(trial.task_hoa, trial.propositions)
    title, handles = _title(trial, width + 0.9), _legend(trial, task)
    legend_columns = _legend_columns(width)
    head, foot = 0.24 * len(title) + 0.2, 0.52 + _legend_inches(handles, legend_columns)
    figure = new_figure(width + 0.9, height + head + foot)
    total = height + head + foot
    axes = figure.add_axes((0.55 / (width + 0.9), foot / total, width / (width + 0.9), height / total))
    _draw_walk(axes, trial, inches_per_cell=width / columns)
    if trial.decisions:
        _mark_decisions(axes, trial)
    axes.tick_params(labelsize=7, colors="#6E6E6E", length=2)
    axes.set_xlabel("column", size=8, color="#6E6E6E", labelpad=1)
    axes.set_ylabel("row", size=8, color="#6E6E6E", labelpad=1)
    for line, text in enumerate(title):
        weight = "normal" if line == len(title) - 1 else "bold"
        place = 1 - (0.16 + 0.24 * line) / total
        figure.text(0.5, place, text, ha="center", va="center", size=11 if weight == "bold" else 10, weight=weight)
    _add_legend(figure, handles, legend_columns)
    return figure


def draw_side_by_side(trials: Sequence[Trial], titles: Sequence[str] | None = None) -> Figure:
    """Several trials in one world on one picture, so that their paths can be compared.

    The maps stand beside each other, or below each other where the world is wider than high; they share the heading
    (task, environment, world) and the legend.

    Args:
        trials: at least one; all of the same world and task, such as those of two policies.
        titles: what stands above each map, one per trial; default: the policy. Cost and outcome are added.

    Returns:
        The figure: paths coloured by the state of the task, unseen parts of each trial grey.
    """
    first = trials[0]
    if any(trial.task_hoa != first.task_hoa or map_extent(trial.world) != map_extent(first.world) for trial in trials):
        raise PictureError("trials that are drawn side by side must have the same world and task")
    rows, columns = map_extent(first.world)
    stacked = columns > rows
    width, height = _map_size(rows, columns, longest=11.0 if stacked else 5.6)
    across, down = (1, len(trials)) if stacked else (len(trials), 1)
    edge, gap, row_head = 0.12, 0.2, 0.3
    total_width = across * width + (across - 1) * gap + 2 * edge
    heading = [*_formula_lines(first, total_width), _place_in_words(first)]
    handles = _shared_legend(trials)
    legend_columns = _legend_columns(total_width)
    head, foot = 0.24 * len(heading) + 0.14, _legend_inches(handles, legend_columns) + 0.16
    total = head + foot + down * (height + row_head)
    figure = new_figure(total_width, total)
    for line, text in enumerate(heading):
        weight = "normal" if line == len(heading) - 1 else "bold"
        figure.text(0.5, 1 - (0.16 + 0.24 * line) / total, text, ha="center", va="center", size=11, weight=weight)
    for index, trial in enumerate(trials):
        left = edge + (index % across) * (width + gap)
        top = total - head - (index // across) * (height + row_head) - row_head
        axes = figure.add_axes((left / total_width, (top - height) / total, width / total_width, height / total))
        _draw_walk(axes, trial, inches_per_cell=width / columns)
        axes.set(xticks=[], yticks=[])
        name = trial.policy if titles is None else titles[index]
        text = f"{name}: cost {trial.cost:.1f}, {trial.outcome.value}"
        figure.text(left / total_width, (top + 0.06) / total, text, ha="left", va="bottom", size=11, weight="bold")
    _add_legend(figure, handles, legend_columns)
    return figure


def _draw_walk(axes: Axes, trial: Trial, *, inches_per_cell: float) -> None:
    """The map as it was known in the end, the names of its areas, and the path with its changes of state."""
    seen = trial.first_seen != NEVER_SEEN
    show_cells(axes, trial.world, seen, trial.propositions, hatch=True)
    draw_path(axes, trial.path, trial.states, inches_per_cell=inches_per_cell)
    _mark_changes(axes, trial)
    draw_ends(axes, trial.path)
    draw_labels(axes, place_labels(trial.world, trial.propositions, trial.path, inches_per_cell=inches_per_cell))


def _legend_columns(width: float) -> int:
    return max(3, min(7, int(width / 1.6)))


def _legend_inches(handles: Sequence[Line2D | Patch], columns: int) -> float:
    return 0.2 * math.ceil(len(handles) / columns)


def _add_legend(figure: Figure, handles: list[Line2D | Patch], columns: int) -> None:
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=columns,
        fontsize=8.5,
        frameon=False,
        handlelength=1.6,
        columnspacing=1.4,
        borderaxespad=0.2,
    )


def map_extent(world: World) -> tuple[int, int]:
    """Rows and columns of the map without padding."""
    rows, columns = np.asarray(world.extent)
    return int(rows), int(columns)


def cell_image(
    world: World, seen: Bool[np.ndarray, "H W"], propositions: Sequence[str], *, hatch: bool, pixels: int = IMAGE_PIXELS
) -> UInt8[np.ndarray, "h w 3"]:
    """The map as a raster: seen cells clear, unseen ones grey (with stripes if ``hatch``), labelled areas coloured.

    A cell with several propositions has stripes of their colours.
    """
    rows, columns = map_extent(world)
    seen = seen[:rows, :columns]
    occupied = np.asarray(world.occupied)[:rows, :columns]
    letters = np.asarray(world.letters)[:rows, :columns]
    scale = int(np.clip(pixels // max(rows, columns), 1, 60))
    palette = np.array([rgb(FREE_SEEN), rgb(WALL_SEEN), rgb(FREE_UNSEEN), rgb(WALL_UNSEEN)], np.uint8)
    image = _enlarge(palette[occupied + 2 * ~seen], scale)
    line, column = np.indices(image.shape[:2])
    stripe = line + column
    for letter in np.unique(letters[letters > 0]):
        colours = [rgb(area_colour(bit)) for bit in range(len(propositions)) if letter >> bit & 1]
        area = _enlarge(letters == letter, scale)
        striped = np.array(colours, np.uint8)[(stripe // max(3, scale // 2)) % len(colours)]
        image[area] = striped[area]
    unseen = _enlarge(~seen, scale)
    area = _enlarge(letters > 0, scale) & unseen
    image[area] = (0.55 * image[area] + 0.45 * np.array(rgb(FREE_UNSEEN))).astype(np.uint8)
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
    """Put the raster on the axes: x is the column, y the row, row 0 at the top."""
    rows, columns = map_extent(world)
    image = cell_image(world, seen, propositions, hatch=hatch, pixels=pixels)
    axes.imshow(image, extent=(-0.5, columns - 0.5, rows - 0.5, -0.5), interpolation="nearest", zorder=0)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), aspect="equal")
    for spine in axes.spines.values():
        spine.set_color(FAINT)


def draw_path(
    axes: Axes, path: Sequence[tuple[int, int]], states: Sequence[int], *, inches_per_cell: float
) -> LineCollection:
    """The path in the colours of the states in which its steps were begun; traffic keeps to the right.

    Keeping to the right by half a line's width shows both colours where the robot came back the same way.
    """
    lane = _keep_right(np.array(path, float)[:, ::-1], 0.6 * PATH_WIDTH / 72 / inches_per_cell)
    segments = np.stack([lane[:-1], lane[1:]], axis=1)
    lines = LineCollection(
        list(segments),
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


@dataclasses.dataclass(frozen=True)
class AreaLabel:
    """The name of a labelled area, its centre (x, y), and the cell (x, y) that it belongs to."""

    name: str
    spot: tuple[float, float]
    anchor: tuple[float, float]
    half_size: tuple[float, float]


def place_labels(
    world: World,
    propositions: Sequence[str],
    path: Sequence[tuple[int, int]],
    *,
    inches_per_cell: float,
    size: float = 9.0,
) -> list[AreaLabel]:
    """Names for the connected areas of each letter, largest first, where they cover little of the path and no name."""
    rows, columns = map_extent(world)
    letters = np.asarray(world.letters)[:rows, :columns]
    labels: list[AreaLabel] = []
    steps = np.array(path, float)[:, ::-1]
    for letter, cells in _areas(letters)[:MAX_LABELS]:
        name = letter_name(letter, propositions)
        half = np.array([len(name) * size * 0.6 / 72 + 0.1, size * 1.35 / 72 + 0.06]) / 2 / inches_per_cell
        spot, cost = _label_spot(cells, half, LABEL_MARGIN / inches_per_cell, labels, steps, letters)
        if cost >= _FORBIDDEN:
            continue
        anchor = cells[np.argmin(np.linalg.norm(cells[:, ::-1] - spot, axis=1))][::-1]
        labels.append(AreaLabel(name, _pair(spot), _pair(anchor), _pair(half)))
    return labels


def draw_labels(axes: Axes, labels: Sequence[AreaLabel], *, size: float = 9.0) -> None:
    """The names, with a thin line to areas that they stand beside."""
    for label in labels:
        apart = np.abs(np.subtract(label.anchor, label.spot)) > label.half_size
        if np.any(apart):
            (x, y), (to_x, to_y) = label.spot, label.anchor
            axes.plot([x, to_x], [y, to_y], color=INK, linewidth=0.7, zorder=4)
        axes.text(
            *label.spot,
            label.name,
            ha="center",
            va="center",
            size=size,
            color=INK,
            zorder=5,
            bbox={"boxstyle": "round,pad=0.18", "facecolor": "white", "edgecolor": "#BBBBBB", "alpha": 0.9, "lw": 0.6},
        )


def letter_name(letter: int, propositions: Sequence[str]) -> str:
    """The propositions that a letter makes true, joined by ``&``; ``-`` for none."""
    return " & ".join(name for bit, name in enumerate(propositions) if letter >> bit & 1) or "-"


def describe_outcome(trial: Trial) -> str:
    """Environment, policy, cost and how the trial ended, in one line."""
    place = _place_in_words(trial)
    return f"{place}  ·  policy {trial.policy}  ·  cost {trial.cost:.1f}  ·  {trial.outcome.value}"


def _place_in_words(trial: Trial) -> str:
    """The environment and which of its worlds it was; of a path only the name is kept."""
    environment = re.sub(r"^(map|floorplan|parcels):(?:[^,]*/)?([^/,]+)/?(,.*)?(/\w+)$", r"\1:\2\4", trial.environment)
    return environment if trial.seed is None else f"{environment}, world {trial.seed}"


def _title(trial: Trial, width: float) -> list[str]:
    return [*_formula_lines(trial, width), *textwrap.wrap(describe_outcome(trial), max(20, int(width / 0.08)))]


def _formula_lines(trial: Trial, width: float) -> list[str]:
    """The formula in lines that fit ``width`` inches, four at most."""
    formula = textwrap.wrap(trial.task_text, max(20, int(width / 0.092)))
    return formula if len(formula) <= 4 else [*formula[:3], formula[3] + " ..."]


def _map_size(rows: int, columns: int, longest: float) -> tuple[float, float]:
    """Inches of the map: at most ``longest`` wide and 0.75 of it high, small maps smaller."""
    scale = min(longest / columns, 0.75 * longest / rows, MAX_INCHES_PER_CELL)
    return columns * scale, rows * scale


def _enlarge(cells: np.ndarray, scale: int) -> np.ndarray:
    return cells.repeat(scale, axis=0).repeat(scale, axis=1)


def _keep_right(points: Float[np.ndarray, "N 2"], offset: float) -> Float[np.ndarray, "N 2"]:
    """Points moved to the right of the direction of travel (y downward), the direction averaged over a few steps."""
    if len(points) < 2:
        return points
    padded = np.concatenate([points[:1], points[:1], points, points[-1:], points[-1:]])
    heading = padded[4:] - padded[:-4]
    length = np.linalg.norm(heading, axis=1, keepdims=True)
    right = np.stack([-heading[:, 1], heading[:, 0]], axis=1) / np.where(length > 0, length, 1)
    return points + offset * right


def _areas(letters: Int32[np.ndarray, "rows columns"]) -> list[tuple[int, np.ndarray]]:
    """Connected areas of equal letter as (letter, cells [k, 2]), large ones first."""
    areas = []
    for letter in np.unique(letters[letters > 0]).tolist():
        labelled = ndimage.label(letters == letter, structure=np.ones((3, 3), int))
        components, count = cast(tuple[np.ndarray, int], labelled)
        areas += [(letter, np.argwhere(components == index)) for index in range(1, count + 1)]
    return sorted(areas, key=lambda area: -len(area[1]))


_FORBIDDEN = 100.0
_SIDES = ((0, -1), (0, 1), (1, 0), (-1, 0), (1, -1), (-1, -1), (1, 1), (-1, 1))


def _label_spot(
    cells: np.ndarray,
    half: np.ndarray,
    margin: float,
    placed: Sequence[AreaLabel],
    steps: np.ndarray,
    letters: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Centre of a name (x, y) and what it costs: covering names is forbidden, path and areas are avoided."""
    low, high = cells.min(axis=0)[::-1], cells.max(axis=0)[::-1]
    centre, radius = (low + high) / 2, (high - low) / 2
    reach = radius + 0.5
    spots = [
        centre + np.array(side) * (reach + grow * half + margin) for grow in (1.0, 1.6, 2.4, 3.4) for side in _SIDES
    ]
    if np.all(reach > half):
        spots.insert(0, centre)
    labelled = np.argwhere(letters > 0)[:, ::-1]
    last = np.array(letters.shape)[::-1] - 0.5

    def cost(rank: int, spot: np.ndarray) -> float:
        outside = np.any(spot - half < -0.5) or np.any(spot + half > last)
        covers = any(np.all(np.abs(spot - other.spot) < half + other.half_size) for other in placed)
        on_path = int(np.all(np.abs(steps - spot) < half + 0.5, axis=1).sum())
        inside = spot is centre
        on_areas = 0 if inside else int(np.all(np.abs(labelled - spot) < half, axis=1).sum())
        return _FORBIDDEN * (outside or covers) + min(20.0, 1.5 * on_path) + min(10.0, 0.5 * on_areas) + 0.25 * rank

    costs = [cost(rank, spot) for rank, spot in enumerate(spots)]
    best = int(np.argmin(costs))
    return spots[best], costs[best]


def _pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _mark_changes(axes: Axes, trial: Trial) -> None:
    """A numbered disc where the automaton's state changed; the first few changes only if they are very many."""
    changes = [step for step in range(1, len(trial.states)) if trial.states[step] != trial.states[step - 1]]
    ends = (trial.path[0], trial.path[-1])
    for step in changes[:30]:
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


def _mark_decisions(axes: Axes, trial: Trial) -> None:
    rows, columns = zip(*(decision.cell for decision in trial.decisions), strict=True)
    axes.scatter(columns, rows, s=9, color=INK, linewidths=0, zorder=4)
    last = trial.decisions[-1]
    draw_subgoals(axes, last)


def draw_subgoals(axes: Axes, decision: Decision) -> None:
    """Open triangles at the subgoals of a decision, a filled one where it went."""
    if decision.subgoals:
        rows, columns = zip(*decision.subgoals, strict=True)
        axes.scatter(columns, rows, s=52, marker="^", facecolors="white", edgecolors=CHOSEN, linewidths=1.6, zorder=6)
    if decision.target is not None:
        row, column = decision.target
        axes.scatter([column], [row], s=60, marker="^", facecolors=CHOSEN, edgecolors="white", linewidths=0.8, zorder=6)


def _legend(trial: Trial, task: Task) -> list[Line2D | Patch]:
    handles = [*cell_handles(), *area_handles(trial), *state_handles(trial, task), *_end_handles()]
    if trial.decisions:
        handles.append(Line2D([], [], marker="o", ls="", ms=3.5, color=INK, label="decision"))
        if trial.decisions[-1].subgoals:
            handles.append(
                Line2D([], [], marker="^", ls="", ms=7, mfc="white", mec=CHOSEN, mew=1.5, label="last subgoals")
            )
        if trial.decisions[-1].target is not None:
            handles.append(Line2D([], [], marker="^", ls="", ms=7, mfc=CHOSEN, mec="white", label="last target"))
    return handles


def _shared_legend(trials: Sequence[Trial]) -> list[Line2D | Patch]:
    """One legend for trials of one world and task: the states that any of them visited."""
    task = Task.from_hoa(trials[0].task_hoa, trials[0].propositions)
    visited = dataclasses.replace(trials[0], states=tuple(state for trial in trials for state in trial.states))
    return [*cell_handles(), *area_handles(trials[0]), *state_handles(visited, task), *_end_handles()]


def cell_handles() -> list[Line2D | Patch]:
    """Legend entries of what is known of a cell."""
    return [
        Patch(facecolor=FREE_SEEN, edgecolor=FAINT, label="seen free"),
        Patch(facecolor=WALL_SEEN, label="seen wall"),
        Patch(facecolor=FREE_UNSEEN, edgecolor="#8A8A8A", hatch="////", linewidth=0, label="never seen"),
    ]


def _end_handles() -> list[Line2D | Patch]:
    return [
        Line2D([], [], marker="o", ls="", ms=8, mfc="white", mec=INK, mew=1.6, label="start"),
        Line2D([], [], marker="*", ls="", ms=12, mfc=ROBOT, mec=INK, label="end"),
    ]


def area_handles(trial: Trial) -> list[Patch]:
    """Legend entries of the propositions that occur in the world."""
    present = int(np.bitwise_or.reduce(np.asarray(trial.world.letters), axis=None))
    return [
        Patch(facecolor=to_rgba(area_colour(bit)), edgecolor=FAINT, linewidth=0.5, label=name)
        for bit, name in enumerate(trial.propositions)
        if present >> bit & 1
    ]


def state_handles(trial: Trial, task: Task) -> list[Line2D]:
    """Legend entries of the automaton states that the trial visited."""
    marks: Mapping[int, str] = {
        state: " (accepting)" if task.dfa.accepting[state] else " (initial)" if state == task.dfa.initial else ""
        for state in set(trial.states)
    }
    return [
        Line2D([], [], color=state_colour(state), linewidth=3, label=f"state {state}{marks[state]}")
        for state in sorted(marks)
    ]
