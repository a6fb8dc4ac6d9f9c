"""Drawing of a task's automaton: states in layers from the initial state, guards on the edges.

Positions come from networkx's layered layout. How the edges bend and where their guards stand is chosen by a small
search that counts what would overlap, so that automata of up to about eight states stay readable.
"""

import dataclasses
import itertools
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import networkx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, PathPatch
from matplotlib.path import Path as Curve

from potlp_jax.view.style import FAINT, INK, new_figure, state_colour

RADIUS: float = 0.27
GUARD_SIZE: float = 9.0
FAINT_GUARD_SIZE: float = 7.5
BENDS: tuple[float, ...] = (0.0, 0.18, -0.18, 0.36, -0.36, 0.6, -0.6, 0.9, -0.9)
PAIR_BENDS: tuple[float, ...] = (0.36, 0.55, 0.8, -0.36, -0.55, -0.8)
"""For two states joined both ways: with equal signs the two edges bend apart."""
LOOP_ANGLES: tuple[float, ...] = (90.0, -90.0, 60.0, 120.0, -60.0, -120.0, 0.0, 180.0)
LABEL_PLACES: tuple[float, ...] = (0.5, 0.42, 0.58, 0.34, 0.66, 0.26, 0.74)


@dataclasses.dataclass(frozen=True)
class Automaton:
    """What the drawing needs: states, marks, and one guard text per pair of states that are joined."""

    states: tuple[int, ...]
    initial: int
    accepting: frozenset[int]
    trap: frozenset[int]
    guards: Mapping[tuple[int, int], str]

    @classmethod
    def from_description(cls, description: Mapping[str, Any]) -> "Automaton":
        """The automaton that ``Task.describe`` describes."""
        return cls(
            states=tuple(range(description["states"])),
            initial=description["initial"],
            accepting=frozenset(description["accepting"]),
            trap=frozenset(description["trap"]),
            guards={(move["from"], move["to"]): move["guard"] for move in description["transitions"]},
        )


@dataclasses.dataclass
class _Edge:
    source: int
    target: int
    text: str
    faint: bool
    size: tuple[float, float]
    points: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))
    label: tuple[float, float] = (0.0, 0.0)


def draw_automaton(automaton: Automaton, title: str | None = None) -> Figure:
    """A figure of the automaton: initial arrow, accepting states with a double circle, the trap state faint."""
    edges = _edges(automaton)
    positions = _positions(automaton, edges)
    _route(edges, positions, automaton.initial)
    _place_labels(edges, positions)
    return _draw(automaton, edges, positions, title)


def _edges(automaton: Automaton) -> list[_Edge]:
    edges = []
    for (source, target), guard in sorted(automaton.guards.items()):
        if source in automaton.trap:
            continue
        faint = target in automaton.trap
        text = _wrap_guard(guard)
        edges.append(_Edge(source, target, text, faint, _text_size(text, FAINT_GUARD_SIZE if faint else GUARD_SIZE)))
    return edges


def _wrap_guard(guard: str) -> str:
    """Break long guards at their disjunctions first."""
    lines: list[str] = []
    for part in guard.split(" | "):
        if lines and len(lines[-1]) + len(part) <= 24:
            lines[-1] += f" | {part}"
        else:
            lines.append(part)
    lines = [*(f"{line} |" for line in lines[:-1]), lines[-1]]
    broken = [piece for line in lines for piece in textwrap.wrap(line, 30)]
    shown = broken if len(broken) <= 6 else [*broken[:5], f"... {len(broken) - 5} more lines"]
    return "\n".join(shown)


def _text_size(text: str, points: float) -> tuple[float, float]:
    """Width and height in inches, from the mean character width of the sans-serif font."""
    lines = text.split("\n")
    return max(map(len, lines)) * points * 0.56 / 72 + 0.06, len(lines) * points * 1.25 / 72 + 0.04


def _positions(automaton: Automaton, edges: Sequence[_Edge]) -> dict[int, np.ndarray]:
    """Layers in the order that crosses least; the trap state stands below."""
    graph = networkx.DiGraph((edge.source, edge.target) for edge in edges)
    graph.add_nodes_from(automaton.states)
    # A task that cannot be satisfied has nothing but a trap.
    shown = [state for state in automaton.states if state not in automaton.trap] or list(automaton.states)
    layers = _untangle(_layers(graph.subgraph(shown)), edges)
    widest = max((edge.size[0] for edge in edges if edge.source != edge.target and not edge.faint), default=1.0)
    tallest = max((edge.size[1] for edge in edges), default=0.2)
    across, down = max(1.5, widest + 5 * RADIUS), max(1.35, 2.2 * tallest + 3 * RADIUS)
    layered = networkx.DiGraph()
    for index, layer in enumerate(layers):
        layered.add_nodes_from(layer, subset=index)
    grid = networkx.multipartite_layout(layered, scale=1.0)
    positions: dict[int, np.ndarray] = {}
    for index, layer in enumerate(layers):
        # The layout gives the order within a layer; the scale must fit the guards.
        ranked = sorted(layer, key=lambda state: (-grid[state][1], layer.index(state)))
        for rank, state in enumerate(ranked):
            # A slight slant keeps three states of three layers off one line, so edges that skip a layer bend less.
            positions[state] = np.array([index * across, ((len(layer) - 1) / 2 - rank) * down])
    lowest = min(position[1] for position in positions.values())
    middle = (len(layers) - 1) * across / 2
    for rank, state in enumerate(sorted(automaton.trap - positions.keys())):
        positions[state] = np.array([middle + rank * across, lowest - down - 0.5])
    return positions


def _layers(live: networkx.DiGraph) -> list[list[int]]:
    """States by the longest way to them, so that progress reads from left to right; cycles share a layer or two."""
    condensed = networkx.condensation(live)
    depth: dict[int, int] = {}
    for component in networkx.topological_sort(condensed):
        before = [depth[other] + 1 for other in condensed.predecessors(component)]
        depth[component] = max(before, default=0)
    ranked = {state: depth[component] for state, component in condensed.graph["mapping"].items()}
    return [
        sorted(state for state, rank in ranked.items() if rank == layer) for layer in range(max(depth.values()) + 1)
    ]


def _untangle(layers: list[list[int]], edges: Sequence[_Edge]) -> list[list[int]]:
    """Order the states within each layer so that straight edges cross least (all orders, if there are few)."""
    orders = math.prod(math.factorial(len(layer)) for layer in layers)
    if orders > 5_000:
        return layers

    def crossings(candidate: Iterable[Sequence[int]]) -> int:
        spot = {
            state: (index, rank - (len(layer) - 1) / 2)
            for index, layer in enumerate(candidate)
            for rank, state in enumerate(layer)
        }
        lines = [
            sorted((spot[edge.source], spot[edge.target]))
            for edge in edges
            if edge.source in spot and edge.target in spot and edge.source != edge.target
        ]
        return sum(
            max(a[0][0], b[0][0]) < min(a[1][0], b[1][0]) + 1 and (a[0][1] - b[0][1]) * (a[1][1] - b[1][1]) < 0
            for a, b in itertools.combinations(lines, 2)
        )

    best = min(itertools.product(*(itertools.permutations(layer) for layer in layers)), key=crossings)
    return [list(layer) for layer in best]


def _route(edges: Sequence[_Edge], positions: Mapping[int, np.ndarray], initial: int) -> None:
    """Choose a bend per edge that meets no state and few other edges: short edges first, then loops, then long ones."""
    joined = {(edge.source, edge.target) for edge in edges}
    gaps = [_length(edge, positions) for edge in edges if edge.source != edge.target]
    start = positions[initial]
    # Edges that are in the way a little, and loops with their guards, which must not be met at all.
    routed = [np.linspace(start - [RADIUS + 0.6, 0], start - [RADIUS, 0], 20)]
    loops: list[np.ndarray] = []
    for edge in sorted(edges, key=lambda edge: (edge.faint, _length(edge, positions) or 1.1 * min(gaps, default=1.0))):
        bends = PAIR_BENDS if (edge.target, edge.source) in joined else BENDS
        candidates = _candidates(edge, positions, bends, samples=40)
        costs = [
            _route_cost(points, edge, routed, loops, positions) + 0.6 * rank for rank, points in enumerate(candidates)
        ]
        best = int(np.argmin(costs))
        edge.points = _candidates(edge, positions, bends, samples=160)[best]
        if edge.source == edge.target:
            edge.label = _label_spots(edge, positions)[0]
            grid = np.linspace(-0.5, 0.5, 8)
            box = np.array([np.add(edge.label, np.multiply(edge.size, spot)) for spot in itertools.product(grid, grid)])
            loops.append(np.concatenate([candidates[best], box]))
        else:
            routed.append(candidates[best])


def _length(edge: _Edge, positions: Mapping[int, np.ndarray]) -> float:
    return float(np.linalg.norm(positions[edge.target] - positions[edge.source]))


def _candidates(
    edge: _Edge, positions: Mapping[int, np.ndarray], bends: Sequence[float], samples: int
) -> list[np.ndarray]:
    start, end = positions[edge.source], positions[edge.target]
    if edge.source == edge.target:
        return [_loop(start, angle, samples) for angle in LOOP_ANGLES]
    return [_bend(start, end, bend, samples) for bend in bends]


def _bend(start: np.ndarray, end: np.ndarray, bend: float, samples: int) -> np.ndarray:
    """A quadratic curve from rim to rim; ``bend`` is the height of its control point relative to the distance."""
    across = np.array([-(end - start)[1], (end - start)[0]])
    control = (start + end) / 2 + bend * across
    t = np.linspace(0, 1, samples)[:, None]
    points = (1 - t) ** 2 * start + 2 * t * (1 - t) * control + t**2 * end
    return points[(_distance(points, start) > RADIUS) & (_distance(points, end) > RADIUS + 0.03)]


def _loop(centre: np.ndarray, angle: float, samples: int) -> np.ndarray:
    """A drop-shaped loop on the rim of a state, around the direction ``angle`` (degrees)."""
    direction = math.radians(angle)
    spread, reach = math.radians(55), 0.95
    ends = [centre, centre + reach * np.array([math.cos(direction + spread), math.sin(direction + spread)])]
    ends += [centre + reach * np.array([math.cos(direction - spread), math.sin(direction - spread)]), centre]
    t = np.linspace(0, 1, samples)[:, None]
    weights = [(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3]
    points = sum((weight * end for weight, end in zip(weights, ends, strict=True)), np.zeros((samples, 2)))
    return points[_distance(points, centre) > RADIUS + 0.02]


def _route_cost(
    points: np.ndarray,
    edge: _Edge,
    routed: Sequence[np.ndarray],
    loops: Sequence[np.ndarray],
    positions: Mapping[int, np.ndarray],
) -> float:
    cost = 0.0
    for state, centre in positions.items():
        if state not in (edge.source, edge.target):
            near = _distance(points, centre) < RADIUS + 0.16
            cost += 8.0 * float(near.any()) + 30.0 * float(near.mean())
    # Near their states all edges meet; farther out they must not.
    ends = [positions[edge.source], positions[edge.target]]
    away = np.all([_distance(points, end) > RADIUS + 0.12 for end in ends], axis=0)
    for other in (*routed, *loops):
        near = np.linalg.norm(points[:, None] - other[None], axis=-1).min(axis=1) < 0.13
        cost += 12.0 * float(near.mean())
        if edge.source == edge.target or any(other is loop for loop in loops):
            cost += 4.0 * float((near & away).any())
    return cost


def _place_labels(edges: Sequence[_Edge], positions: Mapping[int, np.ndarray]) -> None:
    """Put each guard where it covers least; a few rounds, because guards get out of each other's way."""
    order = sorted(edges, key=lambda edge: -edge.size[0] * edge.size[1])
    placed: dict[int, tuple[float, float]] = {}
    for _ in range(4):
        for edge in order:
            spots = _label_spots(edge, positions)
            costs = [_label_cost(spot, edge, edges, placed, positions) + 0.05 * rank for rank, spot in enumerate(spots)]
            edge.label = spots[int(np.argmin(costs))]
            placed[id(edge)] = edge.label


def _label_spots(edge: _Edge, positions: Mapping[int, np.ndarray]) -> list[tuple[float, float]]:
    if edge.source == edge.target:
        centre = positions[edge.source]
        tip = edge.points[len(edge.points) // 2]
        outward = (tip - centre) / np.linalg.norm(tip - centre)
        reach = abs(outward[0]) * edge.size[0] / 2 + abs(outward[1]) * edge.size[1] / 2 + 0.03
        base = tip + outward * reach
        return [(float(base[0] + shift), float(base[1])) for shift in (0.0, 0.25, -0.25, 0.5, -0.5)]
    last = len(edge.points) - 1
    return [(float(point[0]), float(point[1])) for point in (edge.points[round(t * last)] for t in LABEL_PLACES)]


def _label_cost(
    spot: tuple[float, float],
    edge: _Edge,
    edges: Sequence[_Edge],
    placed: Mapping[int, tuple[float, float]],
    positions: Mapping[int, np.ndarray],
) -> float:
    half = np.array(edge.size) / 2
    cost = 0.0
    for centre in positions.values():
        gap = np.maximum(np.abs(centre - np.array(spot)) - half, 0)
        cost += 20.0 * float(np.linalg.norm(gap) < RADIUS + 0.04)
    for other in edges:
        if other is edge:
            continue
        inside = np.all(np.abs(other.points - np.array(spot)) < half, axis=1)
        cost += 6.0 * float(inside.any()) + 6.0 * float(inside.mean())
        if id(other) in placed:
            overlap = half + np.array(other.size) / 2 - np.abs(np.array(placed[id(other)]) - np.array(spot))
            if np.all(overlap > 0):
                cost += 10.0 + 40.0 * float(np.prod(overlap))
    return cost


def _draw(
    automaton: Automaton, edges: Sequence[_Edge], positions: Mapping[int, np.ndarray], title: str | None
) -> Figure:
    corners = [np.array([*positions.values()]) + sign * (RADIUS + 0.1) for sign in (-1, 1)]
    corners += [edge.points for edge in edges]
    corners += [np.array([edge.label]) + sign * np.array(edge.size) / 2 for edge in edges for sign in (-1, 1)]
    corners.append(np.array([positions[automaton.initial] - [RADIUS + 0.75, 0]]))
    spots = np.concatenate(corners)
    low, high = spots.min(axis=0) - 0.12, spots.max(axis=0) + 0.12
    heading = textwrap.wrap(title, max(24, int((high[0] - low[0]) / 0.085))) if title else []
    head = 0.24 * len(heading) + (0.15 if heading else 0.0)
    width, height = high[0] - low[0], high[1] - low[1] + head
    figure = new_figure(width, height)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1] + head), aspect="equal")
    axes.axis("off")
    for edge in edges:
        _draw_edge(axes, edge)
    for state in automaton.states:
        _draw_state(axes, state, positions[state], automaton)
    _draw_initial(axes, positions[automaton.initial])
    if heading:
        axes.text(
            (low[0] + high[0]) / 2, high[1] + head - 0.1, "\n".join(heading), ha="center", va="top", size=11, color=INK
        )
    return figure


def _draw_edge(axes: Axes, edge: _Edge) -> None:
    colour = FAINT if edge.faint else INK
    axes.add_patch(
        FancyArrowPatch(
            path=Curve(edge.points),
            arrowstyle="-|>,head_length=5,head_width=2.6",
            color=colour,
            linewidth=0.8 if edge.faint else 1.2,
            linestyle=(0, (4, 2)) if edge.faint else "solid",
            capstyle="butt",
            shrinkA=0,
            shrinkB=0,
            zorder=1,
        )
    )
    axes.text(
        *edge.label,
        edge.text,
        ha="center",
        va="center",
        size=FAINT_GUARD_SIZE if edge.faint else GUARD_SIZE,
        color="#6E6E6E" if edge.faint else INK,
        zorder=4,
        linespacing=1.15,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.9, "boxstyle": "square,pad=0.08"},
    )


def _draw_state(axes: Axes, state: int, centre: np.ndarray, automaton: Automaton) -> None:
    trap = state in automaton.trap
    colour = FAINT if trap else state_colour(state)
    fill = "#F4F4F4" if trap else "white"
    place = (float(centre[0]), float(centre[1]))
    axes.add_patch(Circle(place, RADIUS, facecolor=fill, edgecolor=colour, linewidth=1.0 if trap else 2.2, zorder=3))
    if state in automaton.accepting:
        axes.add_patch(Circle(place, RADIUS - 0.055, facecolor="none", edgecolor=colour, linewidth=1.6, zorder=3))
    axes.text(*place, str(state), ha="center", va="center", size=12, color=FAINT if trap else INK, zorder=5)
    if trap:
        axes.text(place[0] + RADIUS + 0.08, place[1], "trap", ha="left", va="center", size=9, color="#6E6E6E", zorder=5)


def _draw_initial(axes: Axes, centre: np.ndarray) -> None:
    start, end = (centre[0] - RADIUS - 0.6, centre[1]), (centre[0] - RADIUS - 0.02, centre[1])
    axes.add_patch(
        FancyArrowPatch(start, end, arrowstyle="-|>,head_length=5,head_width=2.6", color=INK, shrinkA=0, shrinkB=0)
    )
    axes.add_patch(PathPatch(Curve([start, start]), color=INK))


def _distance(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - centre, axis=-1)
