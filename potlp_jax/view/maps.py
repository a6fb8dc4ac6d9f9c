"""Pictures of trials: the true map, what was seen of it, and the path by automaton state."""

import math
import re
import textwrap
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from potlp_jax.errors import PictureError
from potlp_jax.trials.record import NEVER_SEEN, Outcome, Trial
from potlp_jax.view.decisions import task_of
from potlp_jax.view.labels import draw_labels, map_extent, place_labels
from potlp_jax.view.layers import (
    LEGEND_SIZE,
    area_handles,
    cell_handles,
    draw_ends,
    draw_path,
    draw_subgoals,
    end_handles,
    legend_columns,
    mark_changes,
    mark_decisions,
    shorten_labels,
    show_cells,
    state_handles,
    subgoal_handles,
)
from potlp_jax.view.style import INK, QUIET, new_figure, policy_styles

MAX_INCHES_PER_CELL: float = 0.45
"""Larger cells show nothing more."""

LONGEST: float = 11.0
"""Inches of a map that has the width of the page for itself."""

LINE: float = 0.24
"""Inches from one line of the heading to the next."""

LEGEND_LINE: float = 0.2
"""Inches from one line of the legend to the next."""

NAMELESS: str = "no named environment"
"""What is said of a world that was made in Python."""

Handle = Line2D | Patch


def draw_trial(trial: Trial) -> Figure:
    """One picture of a finished trial, with its legend.

    A trial that did not satisfy its task also shows the subgoals of its last decision: what was left to try.
    """
    rows, columns = map_extent(trial.world)
    # The figure is made to fit the map, not the map to the figure: cells stay square, and no border is left over.
    width, height = _map_size(rows, columns, LONGEST)
    # 0.55 inches on the left are for the numbers of the rows.
    total_width = width + 0.9
    heading = [*_formula_lines(trial, total_width), *textwrap.wrap(describe_outcome(trial), _letters(total_width))]
    groups = _legend_groups([trial], total_width)
    if trial.decisions:
        # A trial whose task is infeasible from the start has decided nothing.
        groups[0].append(Line2D([], [], marker="o", ls="", ms=3.5, color=INK, label="decision"))
    left = trial.decisions[-1:] if trial.outcome is not Outcome.SATISFIED else ()
    groups[0] += subgoal_handles(left)
    head, foot = LINE * len(heading) + 0.2, 0.5 + _legend_inches(groups, total_width)
    total = height + head + foot
    figure = new_figure(total_width, total)
    axes = figure.add_axes((0.55 / total_width, foot / total, width / total_width, height / total))
    _draw_walk(axes, trial, inches_per_cell=width / columns)
    mark_decisions(axes, trial)
    for decision in left:
        draw_subgoals(axes, decision)
    axes.tick_params(labelsize=7, colors=QUIET, length=2)
    axes.set_xlabel("column", size=8, color=QUIET, labelpad=1)
    axes.set_ylabel("row", size=8, color=QUIET, labelpad=1)
    _add_heading(figure, heading)
    _add_legend(figure, groups)
    return figure


def draw_side_by_side(trials: Sequence[Trial], titles: Sequence[str] | None = None) -> Figure:
    """Several trials in one world on one picture, so that their paths can be compared.

    The maps stand beside each other, or below each other where the world is wider than high; they share the heading
    (task, environment, world) and the legend.

    Args:
        trials: at least one; all of the same world and task, such as those of two policies.
        titles: what stands above each map, one per trial; default: the policy. Cost and outcome are added.

    Returns:
        The figure: paths coloured by the state of the task, parts that a trial never saw grey.

    Raises:
        PictureError: the trials have different tasks or maps.
    """
    first = trials[0]
    # Tasks are compared as automata: their states are what the colours of the paths mean.
    if any(trial.task_hoa != first.task_hoa or map_extent(trial.world) != map_extent(first.world) for trial in trials):
        raise PictureError("trials that are drawn side by side must have the same world and task")
    rows, columns = map_extent(first.world)
    # Beside another a map has half the page's width, which would make a strip of a wide one.
    stacked = columns > rows
    width, height = _map_size(rows, columns, LONGEST if stacked else LONGEST / 2)
    across, down = (1, len(trials)) if stacked else (len(trials), 1)
    edge, gap, title = 0.12, 0.2, 0.3
    total_width = across * width + (across - 1) * gap + 2 * edge
    heading = [*_formula_lines(first, total_width), _world_in_words(first)]
    groups = _legend_groups(trials, total_width)
    head, foot = LINE * len(heading) + 0.14, _legend_inches(groups, total_width) + 0.16
    total = head + foot + down * (height + title)
    figure = new_figure(total_width, total)
    _add_heading(figure, heading)
    styles = policy_styles(trial.policy for trial in trials)
    for index, trial in enumerate(trials):
        left = edge + (index % across) * (width + gap)
        top = total - head - (index // across) * (height + title) - title
        axes = figure.add_axes((left / total_width, (top - height) / total, width / total_width, height / total))
        _draw_walk(axes, trial, inches_per_cell=width / columns)
        axes.set(xticks=[], yticks=[])
        name = trial.policy if titles is None else titles[index]
        text = f"{name}: cost {trial.cost:.1f}, {trial.outcome.value}"
        figure.text(
            left / total_width,
            (top + 0.06) / total,
            text,
            # The policy's colour, as in plots and tables; colours of the path say states.
            color=styles[trial.policy].colour,
            va="bottom",
            size=11,
            weight="bold",
        )
    _add_legend(figure, groups)
    return figure


def describe_outcome(trial: Trial) -> str:
    """Environment, policy, cost and how the trial ended, in one line."""
    parts = (_world_in_words(trial), f"policy {trial.policy}", f"cost {trial.cost:.1f}", trial.outcome.value)
    return "  ·  ".join(parts)


def _world_in_words(trial: Trial) -> str:
    """The environment and which of its worlds it was; of a path only the name is kept."""
    # Environments made from files are named KIND:PATH,SETTINGS/SPLIT. The heading has no room for folders and settings;
    # the record has them.
    environment = re.sub(r"^(map|floorplan|parcels):(?:[^,]*/)?([^/,]+)/?(,.*)?(/\w+)$", r"\1:\2\4", trial.environment)
    environment = environment or NAMELESS
    return environment if trial.world_number is None else f"{environment}, world {trial.world_number}"


def _draw_walk(axes: Axes, trial: Trial, *, inches_per_cell: float) -> None:
    """The map as it was known in the end, the names of its areas, and the path with its changes of state."""
    seen = trial.first_seen != NEVER_SEEN
    show_cells(axes, trial.world, seen, trial.propositions, hatch=True)
    draw_path(axes, trial.path, trial.states, inches_per_cell=inches_per_cell)
    mark_changes(axes, trial)
    draw_ends(axes, trial.path)
    draw_labels(axes, place_labels(trial.world, trial.propositions, trial.path, inches_per_cell=inches_per_cell))


def _map_size(rows: int, columns: int, longest: float) -> tuple[float, float]:
    """Inches of the map: at most ``longest`` wide and 0.75 of it high, small maps smaller."""
    # With heading and legend a picture of these proportions still fits a landscape screen.
    scale = min(longest / columns, 0.75 * longest / rows, MAX_INCHES_PER_CELL)
    return columns * scale, rows * scale


def _letters(width: float, points: float = 10.0) -> int:
    """How many letters of a line fit ``width`` inches, from the mean width of the sans-serif font's letters."""
    # 0.58 of the size: DejaVu Sans, which matplotlib brings along. Measuring needs a figure, and the figure's size
    # depends on the number of lines.
    return max(20, int(width / (0.58 * points / 72)))


def _formula_lines(trial: Trial, width: float) -> list[str]:
    """The formula in lines that fit ``width`` inches, four at most."""
    # Bold letters are wider.
    formula = textwrap.wrap(trial.task_text, _letters(width, 11.5))
    # The record has the formula whole; more lines would push the map off the screen.
    return formula if len(formula) <= 4 else [*formula[:3], formula[3] + " ..."]


def _add_heading(figure: Figure, lines: Sequence[str]) -> None:
    """The formula in bold, and where and how it went as the last line."""
    for line, text in enumerate(lines):
        size, weight = (10, "normal") if line == len(lines) - 1 else (11, "bold")
        place = 1 - (0.16 + LINE * line) / figure.get_figheight()
        figure.text(0.5, place, text, ha="center", va="center", color=INK, size=size, weight=weight)


def _legend_groups(trials: Sequence[Trial], width: float) -> list[list[Handle]]:
    """Two legends for trials of one world and task: short entries, and the states that any trial visited in words.

    No entry is wider than ``width`` inches.
    """
    first = trials[0]
    states = [state for trial in trials for state in trial.states]
    # Apart, for the words of states are long: in one legend they would widen its columns and scatter the short entries.
    short = [*cell_handles(), *area_handles(first.propositions, first.world), *end_handles()]
    groups: list[list[Handle]] = [short, [*state_handles(states, task_of(first))]]
    for handles in groups:
        shorten_labels(handles, width)
    return groups


def _legend_inches(groups: Sequence[Sequence[Handle]], width: float) -> float:
    return LEGEND_LINE * sum(math.ceil(len(handles) / legend_columns(handles, width)) for handles in groups)


def _add_legend(figure: Figure, groups: Sequence[Sequence[Handle]]) -> None:
    """The groups below each other at the bottom of the figure, the last one lowest."""
    width, height = figure.get_size_inches()
    bottom = 0.06
    # Upward from the bottom, by the same number of lines as ``_legend_inches`` made room for.
    for handles in reversed(groups):
        columns = legend_columns(handles, width)
        figure.legend(
            handles=list(handles),
            loc="lower center",
            bbox_to_anchor=(0.5, bottom / height),
            ncols=columns,
            fontsize=LEGEND_SIZE,
            frameon=False,
            handlelength=1.6,
            columnspacing=1.4,
            borderaxespad=0.0,
            borderpad=0.0,
        )
        bottom += LEGEND_LINE * math.ceil(len(handles) / columns)
