"""The top of a searched tree as a picture, from the nested values of ``potlp_jax.planning.search.inspect.tree_top``."""

import dataclasses
import math
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from potlp_jax.task.task import Task
from potlp_jax.task.words import transition_words
from potlp_jax.view.decisions import cost_text, shortened
from potlp_jax.view.style import CHOSEN, FAINT, INK, QUIET, new_figure

LEVEL_INCHES: float = 2.35
ROW_INCHES: float = 0.75
BOX_WIDTH: float = 0.8
BOX_HEIGHT: float = 0.82
"""Of a box, as shares of the distances between levels and rows."""

NAME_LETTERS: int = 30
"""Of what is tried, so that it stays in its box; longer words are cut."""

KEY = (
    "solid: success, dashed: failure; coloured: least expected cost, followed further\n"
    "P: probability of the outcome, Q: expected cost of the rest of the task if the action is taken, n: simulations,\n"
    "D: path cost to the subgoal, R: expected cost beyond it (R_S after success, R_F after failure), then what follows"
)


@dataclasses.dataclass
class _Box:
    """One outcome of one action (at the root: where the search began)."""

    text: str
    best: bool
    success: bool = True
    share: float = 1.0
    children: list["_Box"] = dataclasses.field(default_factory=list)
    # Filled in by ``_arrange``, which needs the whole tree.
    level: int = 0
    height: float = 0.0


def draw_tree(tree: Mapping[str, Any], task: Task, title: str | None = None, *, breadth: int = 3) -> Figure:
    """The tree from left to right: up to ``breadth`` actions of a node, each with its outcomes, the best followed.

    The width of a line follows the probability of getting there times the share of simulations of its action.

    Args:
        tree: the nested values of ``tree_top``.
        task: says what the attempts of the tree are.
        title: stands above; default: nothing.
        breadth: actions of a node that are drawn, those of least expected cost.

    Returns:
        The figure: one box an outcome.
    """
    text = f"robot in state {tree['state']}\nexpected cost {cost_text(tree['value'])}\nn {tree['visits']}"
    root = _Box(text, best=True, children=_children(tree, task, breadth, tree["visits"]))
    rows = _arrange(root, level=0, row=0.0)
    boxes = list(_walk(root))
    # Wide enough for the key at least.
    width = max(7.0, 0.3 + LEVEL_INCHES * (1 + max(box.level for box in boxes)))
    heading = textwrap.wrap(title, int(width / 0.09)) if title else []
    top, bottom = 1.15 + 0.34 * len(heading), max(rows, 2.0) + 0.15
    figure = new_figure(width, ROW_INCHES * (top + bottom))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    # Rows count downward, so that the action of least expected cost stands on top.
    axes.set(xlim=(-0.1, (width - 0.3) / LEVEL_INCHES), ylim=(bottom, -top))
    axes.axis("off")
    for box in boxes:
        for child in box.children:
            _draw_branch(axes, box, child)
        _draw_box(axes, box)
    for line, part in enumerate(heading):
        axes.text(-0.03, -top + 0.3 + 0.34 * line, part, size=10, weight="bold", va="center", color=INK)
    axes.text(-0.03, -0.5, KEY, size=8, va="center", color=QUIET)
    return figure


def _children(node: Mapping[str, Any], task: Task, breadth: int, simulations: int) -> list[_Box]:
    """Both outcomes of a node's first actions; only those of the best action are followed."""
    boxes = []
    for rank, action in enumerate(node["actions"][:breadth]):
        for name in ("success", "failure"):
            outcome = action[name]
            # An outcome that cannot occur: finishing in known space never fails.
            if outcome is None:
                continue
            # Following every action would fill walls: the tree grows by its breadth at each level.
            below = outcome["node"] if rank == 0 else None
            boxes.append(
                _Box(
                    _outcome_text(action, task, outcome, name == "success"),
                    best=rank == 0,
                    success=name == "success",
                    # How much of the search went there: probability times the action's share of simulations.
                    share=outcome["probability"] * action["visits"] / max(simulations, 1),
                    children=[] if below is None else _children(below, task, breadth, simulations),
                )
            )
    return boxes


def _outcome_text(action: Mapping[str, Any], task: Task, outcome: Mapping[str, Any], success: bool) -> str:
    """Four lines: what was tried and how it ended, in words, the figures of the action, the cost of the outcome."""
    figures = f"Q {cost_text(action['q_value'])}  n {action['visits']}  D {cost_text(action['distance'])}"
    last = f"R {cost_text(outcome['cost'])}, then {_then(outcome)}"
    if action["subgoal"] is None:
        return f"finish\nin known space\n{figures}\n{last}"
    words = transition_words(task, action["from_state"], action["to_state"], brief=True)
    head = f"s{action['subgoal']} {'succeeds' if success else 'fails'}  P {outcome['probability']:.2f}"
    return f"{head}\n{shortened(words, NAME_LETTERS)}\n{figures}\n{last}"


def _then(outcome: Mapping[str, Any]) -> str:
    node = outcome["node"]
    if node is not None and node["accepting"]:
        return "done"
    # Expanded by no simulation: the search has no opinion yet.
    if outcome["value"] is None:
        return "not tried"
    return "a dead end" if node is not None and node["dead_end"] else cost_text(outcome["value"])


def _arrange(box: _Box, level: int, row: float) -> float:
    """Places: leaves one below the other, a box beside the middle of its children. Returns the next free row."""
    box.level = level
    if not box.children:
        box.height = row + 0.5
        return row + 1
    for child in box.children:
        row = _arrange(child, level + 1, row)
    # Beside the middle of its children, as trees are usually drawn.
    box.height = (box.children[0].height + box.children[-1].height) / 2
    return row


def _walk(box: _Box) -> Iterator[_Box]:
    yield box
    for child in box.children:
        yield from _walk(child)


def _draw_branch(axes: Axes, parent: _Box, child: _Box) -> None:
    start, end = parent.level + BOX_WIDTH, child.level
    axes.plot(
        # Short level ends: where lines of several children begin, they still meet their boxes at a right angle.
        [start, start + 0.05, end - 0.05, end],
        [parent.height, parent.height, child.height, child.height],
        color=CHOSEN if child.best else FAINT,
        # The root makes rare branches visible.
        linewidth=0.7 + 4.0 * math.sqrt(child.share),
        linestyle="solid" if child.success else (0, (3, 1.5)),
        solid_capstyle="butt",
        zorder=2 if child.best else 1,
    )


def _draw_box(axes: Axes, box: _Box) -> None:
    colour, line = (CHOSEN, 1.4) if box.best else (FAINT, 0.8)
    corner = (box.level, box.height - BOX_HEIGHT / 2)
    axes.add_patch(
        Rectangle(corner, BOX_WIDTH, BOX_HEIGHT, facecolor="white", edgecolor=colour, linewidth=line, zorder=3)
    )
    axes.text(box.level + 0.02, box.height, box.text, size=7.5, va="center", linespacing=1.3, color=INK, zorder=4)
