"""A task's automaton as a picture, and as text for Graphviz (DOT) and Mermaid.

The picture needs no program beside Python: networkx places the states in layers and draws the arrows. Whoever has
Graphviz or Mermaid gets their layout from ``to_dot`` and ``to_mermaid``.
"""

import dataclasses
import textwrap
from pathlib import Path

import networkx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from potlp_jax.task.task import Task
from potlp_jax.task.words import state_words, transition_words
from potlp_jax.view.style import FAINT, INK, QUIET, new_figure, save_figure, state_colour

ACROSS, DOWN = 3.4, 1.35
"""Inches from one layer to the next, and between the states of a layer: room for a label of ``LABEL_LETTERS``."""

NODE_SIZE: float = 900.0
"""Area of a state's disc in square points, as matplotlib counts it."""

LABEL_LETTERS: int = 30
"""Width of a label; longer ones are broken."""

BEND: float = 0.16
"""Curvature of an edge between neighbouring layers, as a share of its length; edges of a pair bend apart."""

MAX_EDGES: int = 14
"""A picture with more edges than this is thinned out; all of them are in the table of ``potlp task``."""


# Mermaid reads these of a label as its own; on the right are its names for them.
_MERMAID = str.maketrans({'"': "#quot;", "|": "#124;", "<": "#lt;", ">": "#gt;", "#": "#35;", "\n": "<br>"})


@dataclasses.dataclass(frozen=True)
class Edge:
    """A transition: the words for it, and its guard as a formula."""

    source: int
    target: int
    words: str
    guard: str

    @property
    def label(self) -> str:
        """Words and guard; a state that merely stays as it is has no words of its own."""
        return self.guard if self.source == self.target else f"{self.words}\n{self.guard}".strip()


def automaton_edges(task: Task) -> list[Edge]:
    """The transitions that a reader needs: those of traps are left out, for nothing leads out of one."""
    return [
        Edge(move["from"], move["to"], transition_words(task, move["from"], move["to"], brief=True), move["guard"])
        for move in task.describe()["transitions"]
        if not task.dfa.trap[move["from"]]
    ]


def save_automaton(task: Task, path: Path) -> None:
    """Write the automaton in the form of the file's ending.

    Args:
        task: the task whose automaton is meant.
        path: ``.dot`` (or ``.gv``) for Graphviz, ``.mmd`` for Mermaid, else a picture: ``.png``, ``.svg``, ``.pdf``.

    Raises:
        PictureError: the ending names no known format.
    """
    texts = {".dot": to_dot, ".gv": to_dot, ".mmd": to_mermaid}
    if path.suffix in texts:
        path.write_text(texts[path.suffix](task), "utf-8")
    else:
        save_figure(draw_automaton(task), path)


def to_dot(task: Task) -> str:
    """The automaton as a graph that ``dot -Tsvg`` draws."""
    # An arrow from a point without a name marks the initial state, as in textbooks.
    lines = ["digraph task {", "  rankdir=LR;", '  start [shape=point, label=""];', f"  start -> {task.dfa.initial};"]
    for state in range(task.dfa.num_states):
        shape = "doublecircle" if task.dfa.accepting[state] else "circle"
        tooltip = _quoted(state_words(task, state))
        lines.append(f'  {state} [shape={shape}, color="{_colour(task, state)}", tooltip={tooltip}];')
    for edge in automaton_edges(task):
        style = ", style=dashed" if task.dfa.trap[edge.target] else ""
        lines.append(f"  {edge.source} -> {edge.target} [label={_quoted(edge.label)}{style}];")
    return "\n".join([*lines, "}", ""])


def to_mermaid(task: Task) -> str:
    """The automaton as a flow chart that Markdown pages show."""
    lines = ["flowchart LR", f"  start(( )) --> s{task.dfa.initial}"]
    for state in range(task.dfa.num_states):
        # Three parentheses are Mermaid's double circle.
        left, right = ("(((", ")))") if task.dfa.accepting[state] else ("((", "))")
        lines.append(f"  s{state}{left}{state}{right}")
    for edge in automaton_edges(task):
        arrow = "-.->" if task.dfa.trap[edge.target] else "-->"
        lines.append(f'  s{edge.source} {arrow}|"{edge.label.translate(_MERMAID)}"| s{edge.target}')
    return "\n".join([*lines, ""])


def draw_automaton(task: Task) -> Figure:
    """The automaton from left to right: accepting states with two rings, traps grey below, words and guards.

    With more than ``MAX_EDGES`` edges guards and loops are left out, and edges that pass over layers (several
    propositions found at one cell) are thin and without words.
    """
    edges = automaton_edges(task)
    places = _places(task, edges)
    if len(edges) > MAX_EDGES:
        edges = [_thinned(edge, places) for edge in edges if edge.source != edge.target]
    # Labels stand at the middles of the arcs and have to lie within the picture as states do.
    arcs = [_bend(edge, places) * np.array([0.0, _length(edge, places) / 2]) + _middle(edge, places) for edge in edges]
    corners = np.array([*places.values(), *arcs])
    # Half the width of a broken label on either side, and above the room of a loop with its guard.
    low, high = corners.min(axis=0) - np.array([1.1, 0.5]), corners.max(axis=0) + np.array([1.1, 0.75])
    title = textwrap.wrap(task.text, max(24, int((high - low)[0] / 0.085)))
    width, height, head = *(high - low), 0.3 + 0.18 * len(title)
    figure = new_figure(width, height + head)
    axes = figure.add_axes((0.0, 0.0, 1.0, height / (height + head)))
    figure.text(0.5, 1 - 0.12 / (height + head), "\n".join(title), size=11, color=INK, ha="center", va="top")
    _draw_states(axes, task, places)
    for edge in edges:
        _draw_edge(axes, task, edge, places)
    # networkx fits the limits to what it drew last.
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.axis("off")
    return figure


def _skipped(edge: Edge, places: dict[int, np.ndarray]) -> float:
    """Layers from one end to the other."""
    return abs(places[edge.target][0] - places[edge.source][0]) / ACROSS


def _thinned(edge: Edge, places: dict[int, np.ndarray]) -> Edge:
    return dataclasses.replace(edge, guard="", words=edge.words if _skipped(edge, places) < 1.5 else "")


def _middle(edge: Edge, places: dict[int, np.ndarray]) -> np.ndarray:
    return (places[edge.source] + places[edge.target]) / 2


def _length(edge: Edge, places: dict[int, np.ndarray]) -> float:
    return float(np.linalg.norm(places[edge.target] - places[edge.source]))


def _bend(edge: Edge, places: dict[int, np.ndarray]) -> float:
    """Curvature, upward if positive: outward, and further for an edge that passes over layers."""
    return BEND * max(1.0, _skipped(edge, places)) * (1 if _middle(edge, places)[1] > -DOWN / 4 else -1)


def _places(task: Task, edges: list[Edge]) -> dict[int, np.ndarray]:
    """Inches of each state: in layers by the longest path from the start, so that progress reads from left to right."""
    live = networkx.DiGraph((e.source, e.target) for e in edges if not task.dfa.trap[e.target])
    live.add_nodes_from(z for z in range(task.dfa.num_states) if not task.dfa.trap[z])
    # States that lead back to each other are one node here: what remains has no cycles, hence layers.
    condensed = networkx.condensation(live)
    layers = list(networkx.topological_generations(condensed))
    columns = [sorted(z for part in layer for z in condensed.nodes[part]["members"]) for layer in layers]
    places = {
        # A slight slant keeps states of several layers off one line, on which their edges would lie on each other.
        state: np.array([column * ACROSS, ((len(states) - 1) / 2 - rank) * DOWN - 0.12 * (column % 2)])
        for column, states in enumerate(columns)
        for rank, state in enumerate(states)
    }
    # Traps stand below all other states and outside the layers, for progress never goes through one.
    lowest = min(place[1] for place in places.values())
    for rank, state in enumerate(np.flatnonzero(task.dfa.trap).tolist()):
        places[state] = np.array([(rank + 0.5) * ACROSS, lowest - DOWN - 0.35])
    return places


def _draw_states(axes: Axes, task: Task, places: dict[int, np.ndarray]) -> None:
    graph = networkx.DiGraph()
    graph.add_nodes_from(places)
    colours = [_colour(task, state) for state in graph]
    networkx.draw_networkx_nodes(
        graph, places, ax=axes, node_size=NODE_SIZE, node_color="white", edgecolors=colours, linewidths=2.0
    )
    accepting = [state for state in graph if task.dfa.accepting[state]]
    networkx.draw_networkx_nodes(
        # The second ring: a disc of 0.66 of the area lies 2.8 points within the first.
        graph.subgraph(accepting),
        places,
        ax=axes,
        node_size=0.66 * NODE_SIZE,
        node_color="white",
        edgecolors=[_colour(task, state) for state in accepting],
        linewidths=1.4,
    )
    networkx.draw_networkx_labels(graph, places, ax=axes, font_size=11, font_color=INK)
    for state in np.flatnonzero(task.dfa.trap).tolist():
        x, y = places[state]
        axes.text(x + 0.3, y, "failed", size=9, color=QUIET, va="center")
    x, y = places[task.dfa.initial]
    arrow = {"arrowstyle": "-|>", "color": INK, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (x - 0.25, y), xytext=(x - 0.85, y), arrowprops=arrow)


def _draw_edge(axes: Axes, task: Task, edge: Edge, places: dict[int, np.ndarray]) -> None:
    # Edge by edge, because networkx takes one curvature for all that it draws in a call.
    graph = networkx.DiGraph([(edge.source, edge.target)])
    graph.add_nodes_from(places)
    failed = bool(task.dfa.trap[edge.target])
    faint = failed or not edge.label
    # matplotlib counts a bend to the right of the direction of travel as negative; all progress goes to the right.
    bend = f"arc3,rad={-_bend(edge, places):.2f}"
    networkx.draw_networkx_edges(
        graph,
        places,
        ax=axes,
        node_size=NODE_SIZE,
        connectionstyle=bend,
        edge_color=FAINT if faint else INK,
        style="dashed" if failed else "solid",
        width=1.0 if edge.label else 0.6,
        arrowsize=13,
    )
    networkx.draw_networkx_edge_labels(
        graph,
        places,
        ax=axes,
        edge_labels={(edge.source, edge.target): _broken(edge.label)} if edge.label else {},
        # Nearer to the start than to the end: where edges cross, halfway, labels would meet.
        label_pos=0.5 if edge.guard else 0.3,
        connectionstyle=bend,
        node_size=NODE_SIZE,
        rotate=False,
        font_size=8,
        font_color=QUIET if faint else INK,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.9, "boxstyle": "square,pad=0.1"},
    )


def _broken(text: str) -> str:
    """Lines of at most ``LABEL_LETTERS``, guards broken at their disjunctions where that is possible."""
    return "\n".join(part for line in text.split("\n") for part in textwrap.wrap(line, LABEL_LETTERS))


def _colour(task: Task, state: int) -> str:
    return FAINT if task.dfa.trap[state] else state_colour(state)


def _quoted(text: str) -> str:
    """A DOT string; its line ends are written out."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n") + '"'
