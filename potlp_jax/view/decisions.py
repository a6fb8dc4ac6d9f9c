"""One decision for people and programs: the table of its actions, and the top of the searched tree.

The tree is a nested dict, the form that ``potlp_jax.planning.pouct.tree_top`` gives::

    {"name": str,               what is done here: "robot" at the root, else an action such as "s2: 0→1" or "finish"
     "outcome": str | None,     "success" or "failure" of that action, None at the root
     "probability": float,      of that outcome (P)
     "q": float,                expected cost of the action before its outcome is known (root: the least of all)
     "visits": int,             simulations that came through
     "distance": float,         cost of reaching the place of the action (D)
     "children": [...]}         the same again, most visited first
"""

import dataclasses
import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.records import ActionRecord, Decision, Trial
from potlp_jax.view.style import CHOSEN, FAINT, INK, new_figure

LEVEL_INCHES: float = 2.35
ROW_INCHES: float = 0.56
BOX_WIDTH: float = 0.76
"""Of a node in the picture of a tree, as a share of the distance between levels."""


def rank_actions(decision: Decision) -> list[ActionRecord]:
    """Actions by expected cost, the chosen one first among equals."""
    return sorted(decision.actions, key=lambda action: (action.q_value, action.index != decision.choice, action.index))


def action_name(action: ActionRecord) -> str:
    """``finish``, or the subgoal and the transition that is tried beyond it."""
    if action.subgoal is None:
        return "finish"
    return f"s{action.subgoal}: {action.from_state}→{action.to_state}"


def action_table(trial: Trial, decision: Decision) -> Table:
    """The actions of a decision by expected cost, the chosen one marked."""
    caption = f"expected cost {decision.value:.2f}; costs in units of resolution"
    table = Table(
        title=describe_decision(trial, decision),
        caption=caption,
        title_justify="left",
        box=SIMPLE_HEAD,
        caption_justify="left",
    )
    table.add_column("", width=1)
    table.add_column("action", no_wrap=True)
    table.add_column("subgoal")
    for name in ("P_S", "R_S", "R_F", "D", "Q", "visits"):
        table.add_column(name, justify="right")
    for action in rank_actions(decision):
        chosen = action.index == decision.choice
        place = "-" if action.cell is None else f"{action.cell[0]},{action.cell[1]}"
        table.add_row(
            "*" if chosen else "",
            action_name(action),
            place,
            f"{action.success_probability:.3f}",
            *(f"{value:.1f}" for value in (action.success_cost, action.failure_cost, action.distance, action.q_value)),
            str(action.visits),
            style="bold" if chosen else None,
        )
    return table


def describe_decision(trial: Trial, decision: Decision) -> str:
    """Where and when the decision was made, and what it led to, in one line."""
    went = "nowhere" if decision.target is None else f"cell {decision.target} in state {decision.target_state}"
    return (
        f"decision {decision.index} of {trial.policy} (step {decision.step}): cell {decision.cell} in state "
        f"{decision.state}, {decision.kind} toward {went}"
    )


def decision_to_dict(decision: Decision) -> dict[str, Any]:
    """JSON-able values of a decision, actions by expected cost; what is infinite becomes None."""
    ranked = dataclasses.replace(decision, actions=tuple(rank_actions(decision)))
    return _finite(dataclasses.asdict(ranked))


def draw_tree(tree: Mapping[str, Any], title: str | None = None, *, depth: int = 3, breadth: int = 3) -> Figure:
    """The top of a searched tree from left to right: the most visited actions, both outcomes of each.

    The width of a line follows the share of simulations that took it; dashed lines are failures.
    """
    nodes, rows = _arrange(tree, depth, breadth)
    levels = 1 + max(node.level for node in nodes)
    width = max(7.0, 0.3 + LEVEL_INCHES * levels)
    heading = textwrap.wrap(title, int(width / 0.09)) if title else []
    top, bottom = 1.1 + 0.36 * len(heading), max(rows, 2.0) + 0.2
    figure = new_figure(width, ROW_INCHES * (top + bottom))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-0.1, (width - 0.3) / LEVEL_INCHES), ylim=(bottom, -top))
    axes.axis("off")
    for node in nodes:
        if node.parent is not None:
            _draw_branch(axes, node, node.parent, tree["visits"])
    for node in nodes:
        _draw_node(axes, node)
    for line, text in enumerate(heading):
        axes.text(-0.03, -top + 0.3 + 0.36 * line, text, size=10, weight="bold", va="center", color=INK)
    key = (
        "solid: success, dashed: failure, width: share of simulations, coloured: least expected cost\n"
        "P: probability of the outcome, Q: expected cost of the action, n: visits, D: distance"
    )
    axes.text(-0.03, -0.55, key, size=8, va="center", color="#6E6E6E")
    return figure


@dataclasses.dataclass(frozen=True)
class _Node:
    data: Mapping[str, Any]
    level: int
    height: float
    parent: "_Node | None"
    best: bool


def _arrange(tree: Mapping[str, Any], depth: int, breadth: int) -> tuple[list[_Node], float]:
    """Places of the nodes that are shown: leaves one below the other, parents beside the middle of their children."""
    nodes: list[_Node] = []
    rows = 0.0

    def middle(data: Mapping[str, Any], level: int) -> float:
        """Height that a subtree's root will get; leaves take rows in the order of the walk."""
        nonlocal rows
        shown = _shown_children(data, breadth) if level < depth else []
        if not shown:
            rows += 1
            heights[id(data)] = rows - 0.5
        else:
            below = [middle(child, level + 1) for child in shown]
            heights[id(data)] = (below[0] + below[-1]) / 2
        return heights[id(data)]

    def place(data: Mapping[str, Any], level: int, parent: _Node | None, best: bool) -> None:
        node = _Node(data=data, level=level, height=heights[id(data)], parent=parent, best=best)
        nodes.append(node)
        shown = _shown_children(data, breadth) if level < depth else []
        least = min((child["q"] for child in shown), default=math.nan)
        for child in shown:
            place(child, level + 1, node, child["q"] == least)

    heights: dict[int, float] = {}
    middle(tree, 0)
    place(tree, 0, None, True)
    return nodes, rows


def _shown_children(data: Mapping[str, Any], breadth: int) -> Sequence[Mapping[str, Any]]:
    """All outcomes of the first ``breadth`` actions, kept together."""
    children = data.get("children", ())
    names = list(dict.fromkeys(child["name"] for child in children))[:breadth]
    return [child for name in names for child in children if child["name"] == name]


def _draw_branch(axes: Axes, node: _Node, parent: _Node, simulations: int) -> None:
    share = node.data["visits"] / max(simulations, 1)
    start = parent.level + BOX_WIDTH
    axes.plot(
        [start, start + 0.05, node.level - 0.05, node.level],
        [parent.height, parent.height, node.height, node.height],
        color=CHOSEN if node.best else FAINT,
        linewidth=0.6 + 4.0 * math.sqrt(share),
        linestyle="solid" if node.data["outcome"] == "success" else (0, (3, 1.5)),
        solid_capstyle="butt",
        zorder=1,
    )


def _draw_node(axes: Axes, node: _Node) -> None:
    data = node.data
    head = data["name"]
    lines = f"Q {_number(data['q'])}  n {data['visits']}"
    if data["outcome"] is not None:
        head = f"{head}  {'succeeds' if data['outcome'] == 'success' else 'fails'}  P {data['probability']:.2f}"
        lines = f"{lines}  D {_number(data['distance'])}"
    colour, line = (CHOSEN, 1.4) if node.best else (FAINT, 0.8)
    place = (node.level, node.height - 0.36)
    axes.add_patch(Rectangle(place, BOX_WIDTH, 0.72, facecolor="white", edgecolor=colour, linewidth=line, zorder=2))
    axes.text(
        node.level + 0.02, node.height, f"{head}\n{lines}", size=7.5, va="center", linespacing=1.3, color=INK, zorder=3
    )


def _number(value: float | None) -> str:
    return "∞" if value is None or not math.isfinite(value) else f"{value:.1f}"


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return value
