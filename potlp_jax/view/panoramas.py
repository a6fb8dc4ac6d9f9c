"""What the robot saw of each subgoal when it decided: panoramas with the answers of the estimator."""

import textwrap
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from potlp_jax.trials.record import Decision, Trial
from potlp_jax.view.decisions import FIGURES, action_names, describe_decision, rank_actions, task_of
from potlp_jax.view.style import CHOSEN, INK, QUIET, new_figure
from potlp_jax.world.camera import bearing, roll_to

_ACTIONS_SHOWN = 6
_NAME_LETTERS = 24
"""Of what is tried; longer words are cut."""

WIDTH: float = 12.0
# What is left holds the 50 letters of a line of answers: 3.2 inches in the monospaced font.
PICTURE_WIDTH: float = 8.2
ROW_HEIGHT: float = 1.75
TITLE_HEIGHT: float = 0.28
"""Inches of the figure, of a panorama, of a row, and of the line above a panorama."""

HEADING_LINE: float = 0.19
KEY_LINE: float = 0.15
HEADING_LETTERS, KEY_LETTERS = 150, 185
"""Inches of a line, and how many letters fit into the figure's width."""

# The estimator answers the first three; the search makes Q of them, and a reader compares actions by it.
KEY: str = "dashed: direction of the subgoal; " + "; ".join(
    f"{name}: {FIGURES[name]}" for name in ("P_S", "R_S", "R_F", "Q")
)


def draw_panoramas(
    trial: Trial, decision: Decision, panoramas: Mapping[int, UInt8[np.ndarray, "rows columns 3"]]
) -> Figure:
    """One row per subgoal: the panorama that its estimates come from, rolled so that the subgoal is in the centre.

    Args:
        trial: the trial of the decision.
        decision: one whose policy looked (``decision.observations`` is not empty).
        panoramas: by the number of the decision at which they were taken, in the frame of the map.

    Returns:
        The figure: panoramas on the left, the estimator's answers about each subgoal on the right.
    """
    heading = textwrap.wrap(describe_decision(trial, decision), HEADING_LETTERS)
    key = textwrap.wrap(KEY, KEY_LETTERS)
    head = 0.15 + HEADING_LINE * len(heading) + KEY_LINE * len(key)
    total = head + ROW_HEIGHT * len(decision.subgoals) + 0.05
    figure = new_figure(WIDTH, total)
    figure.text(0.01, 1 - 0.08 / total, "\n".join(heading), va="top", size=9, color=INK)
    below = 0.08 + HEADING_LINE * len(heading)
    figure.text(0.01, 1 - below / total, "\n".join(key), va="top", size=7.5, color=QUIET)
    chosen = {action.subgoal for action in decision.actions if action.index == decision.choice}
    for subgoal, look in enumerate(decision.observations):
        origin = trial.decisions[look].cell
        bottom, height = total - head - ROW_HEIGHT * (subgoal + 1), ROW_HEIGHT - TITLE_HEIGHT
        left, width = 0.01 * WIDTH, WIDTH - PICTURE_WIDTH
        picture = figure.add_axes((left / WIDTH, bottom / total, PICTURE_WIDTH / WIDTH, height / total))
        # Answers begin a little right of the panorama, level with its top.
        text = figure.add_axes(((PICTURE_WIDTH + 0.3) / WIDTH, bottom / total, (width - 0.3) / WIDTH, height / total))
        _draw_rolled(picture, panoramas[look], origin, decision.subgoals[subgoal])
        mark = "chosen: " if subgoal in chosen else ""
        # A subgoal keeps its estimates until it is seen anew, possibly from elsewhere.
        when = "now" if look == decision.index else f"at decision {look}"
        picture.set_title(
            f"{mark}s{subgoal} at {_cell_text(decision.subgoals[subgoal])}, seen {when} from {_cell_text(origin)}",
            fontsize=8,
            loc="left",
            color=CHOSEN if mark else INK,
        )
        text.axis("off")
        text.text(0.0, 1.0, _answers(trial, decision, subgoal), va="top", fontsize=7.5, family="monospace", color=INK)
    return figure


def _draw_rolled(axes: Axes, panorama: np.ndarray, origin: tuple[int, int], subgoal: tuple[int, int]) -> None:
    # From where the panorama was taken, not from where the robot is now: only there its columns are directions.
    angle = bearing(jnp.asarray(origin, jnp.int32), jnp.asarray(subgoal, jnp.int32))
    rolled = np.asarray(roll_to(jnp.asarray(panorama), angle))
    axes.imshow(rolled, aspect="auto", interpolation="nearest")
    axes.axvline(rolled.shape[1] / 2 - 0.5, color=CHOSEN, linewidth=1.0, linestyle=(0, (4, 4)))
    axes.set_xticks([])
    axes.set_yticks([])


def _cell_text(cell: tuple[int, int]) -> str:
    """As tables and headings write cells: row and column."""
    return f"{cell[0]},{cell[1]}"


def _answers(trial: Trial, decision: Decision, subgoal: int) -> str:
    """The cheapest actions of a subgoal as lines of text; says how many are left out."""
    own = [action for action in rank_actions(decision) if action.subgoal == subgoal]
    # The picture says which subgoal it is.
    head = f"s{subgoal}: "
    names = action_names(decision, task_of(trial), letters=len(head) + _NAME_LETTERS)
    lines = [f"{'try':{_NAME_LETTERS}}  P_S    R_S    R_F      Q"] if own else ["nothing can be tried here"]
    for action in own[:_ACTIONS_SHOWN]:
        name = names[action.index].removeprefix(head)
        costs = "".join(f" {value:6.0f}" for value in (action.success_cost, action.failure_cost, action.q_value))
        lines.append(f"{name:{_NAME_LETTERS}} {action.success_probability:.2f}{costs}")
    hidden = len(own) - _ACTIONS_SHOWN
    return "\n".join(lines + ([f"and {hidden} more"] if hidden > 0 else []))
