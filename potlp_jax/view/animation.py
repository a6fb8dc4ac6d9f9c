"""Animation of a trial: one frame a decision, with the map as believed then and the actions that were weighed."""

import io
import math
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from PIL import Image

from potlp_jax.task.words import state_words
from potlp_jax.trials.record import NEVER_SEEN, ActionRecord, Decision, Trial
from potlp_jax.view.decisions import (
    FIGURES,
    action_names,
    cost_text,
    decision_number,
    describe_move,
    figure_texts,
    rank_actions,
    shortened,
    task_of,
)
from potlp_jax.view.labels import draw_labels, map_extent, place_labels
from potlp_jax.view.layers import (
    LEGEND_SIZE,
    area_handles,
    draw_ends,
    draw_path,
    draw_subgoals,
    legend_columns,
    shorten_labels,
    show_cells,
    state_handles,
    subgoal_handles,
)
from potlp_jax.view.maps import MAX_INCHES_PER_CELL, Handle, describe_outcome
from potlp_jax.view.style import (
    AREA_COLOURS,
    CHOSEN,
    CHOSEN_ROW,
    DOTS_PER_INCH,
    FAINT,
    FREE_UNSEEN,
    INK,
    QUIET,
    ROBOT,
    STATE_COLOURS,
    WALL_SEEN,
    WALL_UNSEEN,
    faded,
    new_figure,
    rgb,
    take_literally,
)

MAX_FRAMES: int = 36
MAX_BYTES: int = 3_000_000
FRAME_MILLISECONDS: int = 700
LAST_FRAME_MILLISECONDS: int = 3_000
SHOWN_ACTIONS: int = 7
"""Rows of the table of actions; a decision may have a hundred."""

KEY_ROWS: float = 0.72 * len(FIGURES)
"""Rows below the table that say what its columns mean, in smaller letters."""

LETTER_INCHES: float = 0.075
"""Mean width of a letter in the panel."""

NAME_LETTERS: int = 36
"""Of an action's name, so that it ends before the bar of P_S."""

LABEL_SIZE, SMALL_SIZE = 8.0, 7.0
"""Points of names on the map, and of the legend."""

ROW_INCHES: float = 0.25
IMAGE_PIXELS: int = 400
"""Longer side of the map's raster: coarser than in a picture, for a GIF stores every frame."""

MIXED_COLOURS: int = 64
"""Of the palette's 256; the rest are the exact colours of states, areas and marks."""

THEME: tuple[str, ...] = ("#FFFFFF", INK, FAINT, CHOSEN, ROBOT, CHOSEN_ROW, WALL_SEEN, FREE_UNSEEN, WALL_UNSEEN)

Progress = Callable[[int, int], None]
"""Called after each frame with the number of frames done and in all."""


def save_animation(
    trial: Trial,
    path: Path,
    *,
    max_frames: int = MAX_FRAMES,
    max_bytes: int = MAX_BYTES,
    progress: Progress | None = None,
) -> int:
    """Write the trial as a GIF and return its number of frames.

    Decisions are thinned out evenly to ``max_frames``; the first one and the end are always shown. If the file would be
    larger than ``max_bytes``, every other frame is left out until it fits.

    Args:
        trial: finished, with or without decisions.
        path: the GIF's file.
        max_frames: at most so many frames, the last one included.
        max_bytes: size of the file.
        progress: called after each frame that was drawn.

    Returns:
        The number of frames that were written.
    """
    steps = frame_steps(trial, max_frames)
    stage = _Stage(trial)
    frames = []
    for count, decision in enumerate(steps):
        frames.append(stage.frame(decision))
        if progress is not None:
            progress(count + 1, len(steps))
    data = _encode(frames)
    while len(data) > max_bytes and len(frames) > 2:
        # Halving keeps the rhythm even; the end always stays.
        frames = [*frames[:-1:2], frames[-1]]
        data = _encode(frames)
    path.write_bytes(data)
    return len(frames)


def frame_steps(trial: Trial, max_frames: int) -> list[Decision | None]:
    """The decisions that get a frame, evenly spread; None is the end of the trial."""
    count = len(trial.decisions)
    # Rounded positions may coincide, hence unique; the first and the last decision are always among them.
    kept = np.unique(np.linspace(0, count - 1, min(count, max(1, max_frames - 1))).round().astype(int)) if count else []
    return [*(trial.decisions[index] for index in kept), None]


class _Stage:
    """The figure of an animation; title, legend and frame are drawn once, the rest anew for each frame."""

    def __init__(self, trial: Trial) -> None:
        self._trial = trial
        handles = _legend_handles(trial)
        self._figure, self._axes, self._panel, self._scale = _layout(*map_extent(trial.world), handles)
        # Names are placed once for the whole path, so that they stand still from frame to frame.
        self._labels = place_labels(
            trial.world, trial.propositions, trial.path, inches_per_cell=self._scale, size=LABEL_SIZE
        )
        self._axes.set(xticks=[], yticks=[])
        self._panel.axis("off")
        _legend(self._figure, self._axes, handles)
        # One line: the layout leaves room for two lines of heading, and the second one says how it went.
        formula = trial.task_text if len(trial.task_text) <= 90 else trial.task_text[:87] + "..."
        place = 1 - 0.1 / self._figure.get_figheight()
        heading = f"{formula}\n{describe_outcome(trial)}"
        self._figure.text(0.5, place, heading, size=9, color=INK, ha="center", va="top")
        canvas = self._figure.canvas
        assert isinstance(canvas, FigureCanvasAgg)
        self._canvas = canvas
        # Drawn once and kept as pixels: title, legend and frame of the map are the same in every frame, and laying out
        # their texts takes most of the time that a frame would.
        canvas.draw()
        self._background = canvas.copy_from_bbox(self._figure.bbox)

    def frame(self, decision: Decision | None) -> Image.Image:
        """The belief, path and actions at a decision, or the end of the trial if ``decision`` is None."""
        # Whatever is drawn from here on belongs to this frame alone and is taken off again.
        still = {axes: set(axes.get_children()) for axes in (self._axes, self._panel)}
        self._draw_map(decision)
        _draw_panel(self._panel, self._trial, decision)
        self._canvas.restore_region(self._background)
        for axes, before in still.items():
            fresh = [artist for artist in axes.get_children() if artist not in before]
            # draw_artist knows no order of its own: lower layers first, as a full drawing would.
            fresh.sort(key=lambda artist: artist.get_zorder())
            for artist in fresh:
                take_literally(artist)
                axes.draw_artist(artist)
            for artist in fresh:
                artist.remove()
        # A copy, for the buffer is drawn over by the next frame.
        return Image.fromarray(np.asarray(self._canvas.buffer_rgba())[..., :3].copy())

    def _draw_map(self, decision: Decision | None) -> None:
        trial, axes = self._trial, self._axes
        # A decision is made after observing from its cell, hence what was first seen at its own step counts as seen.
        step = len(trial.path) - 1 if decision is None else decision.step
        seen = (trial.first_seen != NEVER_SEEN) & (trial.first_seen <= step)
        path, states = trial.path[: step + 1], trial.states[: step + 1]
        show_cells(axes, trial.world, seen, trial.propositions, hatch=False, pixels=IMAGE_PIXELS)
        draw_labels(axes, self._labels, size=LABEL_SIZE)
        draw_path(axes, path, states, inches_per_cell=self._scale)
        if decision is None:
            # The robot stands where the star of the end is.
            draw_ends(axes, path)
        else:
            _draw_intention(axes, decision)


def _layout(rows: int, columns: int, handles: Sequence[Handle]) -> tuple[Figure, Axes, Axes, float]:
    """The map beside its panel, or above it if the map is wide, with room for a legend of these entries below the map.

    The last value is inches per cell.
    """
    # A wide map beside a panel would shrink to a strip.
    if columns >= 1.6 * rows:
        width, panel_height = 9.0, 2.35
        scale = min((width - 0.3) / columns, 4.4 / rows, MAX_INCHES_PER_CELL)
        foot = panel_height + _legend_inches(handles, width)
        height = rows * scale + foot + 0.45
        figure = new_figure(width, height)
        left = (width - columns * scale) / 2
        place = (left / width, foot / height, columns * scale / width, rows * scale / height)
        return figure, figure.add_axes(place), figure.add_axes((0.02, 0.0, 0.96, panel_height / height)), scale
    # A row of the table in letters of 8.5 points needs 5.6 inches; the map takes what it needs beside them.
    panel_width = 5.6
    scale = min(5.2 / rows, 5.6 / columns, MAX_INCHES_PER_CELL)
    width = columns * scale + panel_width + 0.4
    foot = _legend_inches(handles, width)
    height = foot + 5.7
    figure = new_figure(width, height)
    place = (0.2 / width, foot / height, columns * scale / width, rows * scale / height)
    panel = ((columns * scale + 0.4) / width, (foot + 0.12) / height, (panel_width - 0.1) / width, 4.96 / height)
    return figure, figure.add_axes(place), figure.add_axes(panel), scale


def _draw_intention(axes: Axes, decision: Decision) -> None:
    """Subgoals, the one chosen, the path toward it and the robot on top."""
    if len(decision.path) > 1:
        rows, columns = zip(*decision.path, strict=True)
        axes.plot(columns, rows, color=CHOSEN, linewidth=1.8, linestyle=(0, (2, 1.2)), zorder=5)
    draw_subgoals(axes, decision)
    row, column = decision.cell
    axes.plot(column, row, "o", ms=9, mfc=ROBOT, mec=INK, mew=1.3, zorder=8)


def _legend_handles(trial: Trial) -> list[Handle]:
    """Short entries; what a state asks for is said beside the map at each decision."""
    return [
        Patch(facecolor=FREE_UNSEEN, edgecolor=FAINT, label="not seen yet"),
        *state_handles(trial.states, task_of(trial), words=False),
        *area_handles(trial.propositions, trial.world),
        Line2D([], [], marker="o", ls="", ms=7, mfc=ROBOT, mec=INK, label="robot"),
        *subgoal_handles(trial.decisions),
        Line2D([], [], color=CHOSEN, linewidth=1.8, linestyle=(0, (2, 1.2)), label="path to it"),
    ]


def _legend_columns(handles: Sequence[Handle], width: float) -> int:
    """Two rows where a figure of ``width`` inches has room for them, more below each other where it has not."""
    return min(max(6, (len(handles) + 1) // 2), legend_columns(handles, width * LEGEND_SIZE / SMALL_SIZE))


def _legend_inches(handles: Sequence[Handle], width: float) -> float:
    return 0.18 + 0.16 * max(2, math.ceil(len(handles) / _legend_columns(handles, width)))


def _legend(figure: Figure, axes: Axes, handles: Sequence[Handle]) -> None:
    """The legend below the map; where it is wider than the map, from the left edge of the figure on."""
    shorten_labels(handles, figure.get_figwidth())
    legend = axes.legend(
        handles=list(handles),
        loc="upper center",
        bbox_to_anchor=(0.5, -0.005),
        ncols=_legend_columns(handles, figure.get_figwidth()),
        fontsize=SMALL_SIZE,
        frameon=False,
        handlelength=1.4,
        columnspacing=1.0,
        labelspacing=0.2,
    )
    take_literally(legend)
    if legend.get_window_extent().x0 < 0:
        legend.set_loc("upper left")
        legend.set_bbox_to_anchor((0.0, axes.get_position().y0), figure.transFigure)


def _draw_panel(panel: Axes, trial: Trial, decision: Decision | None) -> None:
    """What was decided and the actions that were weighed; at the end, how the trial ended."""
    inches = panel.get_window_extent().height / DOTS_PER_INCH
    panel.set(xlim=(0, 1), ylim=(max(SHOWN_ACTIONS + KEY_ROWS + 3.4, inches / ROW_INCHES), -0.2))
    letters = int(panel.get_window_extent().width / DOTS_PER_INCH / LETTER_INCHES)
    task = task_of(trial)
    if decision is None:
        state = trial.states[-1]
        lines = [
            f"end: {trial.outcome.value} after {len(trial.path) - 1} steps, cost {trial.cost:.1f}",
            f"state {state}: {state_words(task, state)}; {len(trial.decisions)} decisions",
        ]
        _panel_text(panel, lines)
        return
    lines = [
        f"{decision_number(trial, decision)}   step {decision.step}   expected cost {cost_text(decision.value)}",
        shortened(f"state {decision.state}: {state_words(task, decision.state)}", letters),
    ]
    if not decision.actions:
        # A policy that does not search has no expected cost.
        lines[0] = f"{decision_number(trial, decision)}   step {decision.step}"
        _panel_text(panel, [*lines, *textwrap.wrap(describe_move(trial, decision), letters)])
        return
    _panel_text(panel, lines)
    _action_rows(panel, rank_actions(decision), trial, decision)


def _panel_text(panel: Axes, lines: Sequence[str]) -> None:
    for line, text in enumerate(lines):
        panel.text(0.0, 0.1 + line, text, size=9.0, weight="normal" if line else "bold", va="center", color=INK)


_COLUMNS = dict(zip(FIGURES, (0.61, 0.69, 0.77, 0.84, 0.92, 1.0), strict=True))
"""Right ends of the columns of figures, as shares of the panel's width."""

_BAR, _BAR_WIDTH = 0.44, 0.1
"""Left end and width of the bar that shows P_S."""


def _action_rows(panel: Axes, actions: Sequence[ActionRecord], trial: Trial, decision: Decision) -> None:
    """The best actions as a table, and below it what its columns mean."""
    names = action_names(decision, task_of(trial), letters=NAME_LETTERS)
    panel.text(0.0, 2.2, "best actions", size=8, color=QUIET, va="center")
    for name, place in _COLUMNS.items():
        panel.text(place, 2.2, name, size=8, color=QUIET, ha="right", va="center")
    for row, action in enumerate(actions[:SHOWN_ACTIONS], start=3):
        chosen = action.index == decision.choice
        if chosen:
            panel.add_patch(Rectangle((-0.01, row - 0.34), 1.02, 0.9, facecolor=CHOSEN_ROW, edgecolor="none"))
        colour, weight = (CHOSEN, "bold") if chosen else (INK, "normal")
        panel.text(0.0, row + 0.1, names[action.index], size=8.5, color=colour, weight=weight, va="center")
        # The grey bar is a certain success, against which the coloured one is read.
        for share, fill in ((1.0, "#EEEEEE"), (action.success_probability, colour)):
            bar = Rectangle((_BAR, row - 0.15), _BAR_WIDTH * share, 0.5, facecolor=fill, edgecolor="none")
            panel.add_patch(bar)
        for value, place in zip(figure_texts(action), _COLUMNS.values(), strict=True):
            panel.text(place, row + 0.1, value, size=8.5, color=colour, weight=weight, ha="right", va="center")
    # Rows are counted in units of ROW_INCHES from the top of the panel: two for the heading, one for the columns.
    last = 3 + min(len(actions), SHOWN_ACTIONS)
    if len(actions) > SHOWN_ACTIONS:
        rest = f"and {len(actions) - SHOWN_ACTIONS} more"
        panel.text(0.0, last + 0.05, rest, size=8, color=QUIET, va="center")
    for row, (name, meaning) in enumerate(FIGURES.items()):
        panel.text(0.0, last + 1.0 + 0.72 * row, f"{name}: {meaning}", size=7, color=QUIET, va="center")


def _encode(frames: Sequence[Image.Image]) -> bytes:
    """A GIF with one palette for all frames, so that only what changes between frames takes space."""
    palette = _palette(frames)
    # No dithering: noise in flat areas changes from frame to frame, and the file grows severalfold.
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [FRAME_MILLISECONDS] * (len(frames) - 1) + [LAST_FRAME_MILLISECONDS]
    buffer = io.BytesIO()
    indexed[0].save(buffer, "GIF", save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=False)
    return buffer.getvalue()


def _palette(frames: Sequence[Image.Image]) -> Image.Image:
    """The colours of the pictures' parts exactly, the rest (rims of letters and lines) as the frames need them."""
    areas = np.array([rgb(colour) for colour in AREA_COLOURS], np.uint8)
    others = np.array([rgb(colour) for colour in (*THEME, *STATE_COLOURS)], np.uint8)
    # A small area that was not seen would else take the nearest colour, which may be that of another proposition.
    fixed = np.concatenate([others, areas, faded(areas)])
    # Every third pixel of three frames has all mixed colours that matter; all of them would take seconds.
    thumbnails = [np.asarray(frame)[::3, ::3] for frame in (frames[0], frames[len(frames) // 2], frames[-1])]
    sample = Image.fromarray(np.concatenate(thumbnails)).quantize(MIXED_COLOURS, method=Image.Quantize.MEDIANCUT)
    mixed = np.array(sample.getpalette(), np.uint8).reshape(-1, 3)[:MIXED_COLOURS]
    # Entries that hardly differ from an exact colour would win over it for some pixels.
    apart = np.abs(mixed[:, None].astype(int) - fixed[None]).max(axis=-1).min(axis=1) > 10
    colours = np.concatenate([fixed, mixed[apart]])
    palette = Image.new("P", (1, 1))
    # Unused entries repeat the first colour, lest black creep in.
    filled = np.concatenate([colours, np.repeat(fixed[:1], 256 - len(colours), axis=0)])
    palette.putpalette(filled.flatten().tolist())
    return palette
