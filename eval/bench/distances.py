"""How long do product distances take? The library against Dijkstra's algorithm on the same product graph.

Sixteen sources on one map: costs to eight targets in every state of the automaton and to acceptance. Opponents solve
the same sources: scipy's Dijkstra (its graph is built once and timed apart) and two written for this comparison, with
a heap and with buckets (``eval/bench/opponents/dijkstra_numba.py``; they need ``pip install numba``). Every opponent's
distances are compared with the library's. Times are medians over repeats, in
milliseconds of processor time per source, so that other work on the machine counts little; pin the process to a core.

    taskset -c 0 python -m eval.bench.distances --out distances.json --plot distances.png
    taskset -c 0 python -m eval.bench.distances --quick
"""

import argparse
import dataclasses
import functools
import importlib.util
import json
import platform
import statistics
import time
from collections.abc import Callable, Iterable
from typing import cast

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import scipy.sparse
from jaxtyping import Bool, Int32
from scipy import ndimage
from scipy.sparse.csgraph import dijkstra

from potlp_jax.environments.rooms import Rooms, RoomsConfig
from potlp_jax.planning.distances.product import distance_table, product_distances, product_transitions
from potlp_jax.sweep.rows import provenance
from potlp_jax.task.task import Task
from potlp_jax.world.moves import NEIGHBOURS

mpl.use("Agg")
import matplotlib.pyplot as plt

TASKS = {1: "1", 4: "F a & F b", 8: "F a & F b & F c"}
"""Tasks by their number of states."""
SOURCES = 16
TARGETS = 8
POINTS = 4
"""Cells per proposition where labels are points."""
AREA = 0.3
"""Share of the free cells with a letter where labels are areas."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One row of the benchmark: ``map`` is "office" or "maze", ``labels`` is "points" or "areas"."""

    map: str
    size: int
    states: int
    labels: str


CASES = tuple(
    Case(kind, size, states, labels)
    for kind, size in (("office", 64), ("office", 128), ("office", 256), ("maze", 256), ("office", 512))
    for states in TASKS
    for labels in ("points", "areas")
    if states > 1 or labels == "points"
)
QUICK = tuple(case for case in CASES if case.size == 64)


@dataclasses.dataclass(frozen=True)
class Instance:
    """A case made concrete; see ``potlp_jax.planning.distances.product`` for the arrays."""

    free: Bool[np.ndarray, "H W"]
    transitions: Int32[np.ndarray, "H W Z"]
    accepting: Bool[np.ndarray, " Z"]
    cells: Int32[np.ndarray, "Q 2"]
    states: Int32[np.ndarray, " Q"]
    targets: Int32[np.ndarray, "T 2"]


def make_instance(case: Case, sources: int, seed: int = 0) -> Instance:
    """A map with letters, sources and targets drawn at random; the same for the same arguments."""
    rng = np.random.default_rng([seed, case.size, case.states, len(case.labels), len(case.map)])
    free = office(rng, case.size) if case.map == "office" else maze(rng, case.size)
    cells = np.argwhere(_largest_component(free)).astype(np.int32)
    if case.states == 1:
        transitions, accepting = np.where(free, 0, -1).astype(np.int32)[:, :, None], np.zeros(1, bool)
    else:
        task = Task.from_formula(TASKS[case.states])
        letters = _letters(rng, case.labels, free, cells, len(task.propositions))
        transitions = np.asarray(product_transitions(task.arrays, jnp.asarray(letters), jnp.asarray(free)))
        accepting = np.asarray(task.dfa.accepting)
    chosen = cells[rng.choice(len(cells), sources + TARGETS, replace=False)]
    return Instance(
        free=free,
        transitions=transitions,
        accepting=accepting,
        cells=chosen[:sources],
        states=np.zeros(sources, np.int32),
        targets=chosen[sources:],
    )


def office(rng: np.random.Generator, size: int) -> Bool[np.ndarray, "H W"]:
    """Rooms with doors and obstacles, as in ``potlp_jax.environments.rooms``."""
    config = RoomsConfig(smallest=size, largest=size, room=max(6, min(14, size // 12)))
    world = Rooms(config).generate(jax.random.key(int(rng.integers(2**31))))
    return ~np.asarray(world.occupied)


def maze(rng: np.random.Generator, size: int, corridor: int = 3) -> Bool[np.ndarray, "H W"]:
    """A spanning tree of corridors (randomised depth-first search), walls one cell thick."""
    pitch = corridor + 1
    count = (size - 1) // pitch
    free = np.zeros((size, size), bool)
    seen = np.zeros((count, count), bool)
    stack = [(0, 0)]
    seen[0, 0] = True
    while stack:
        i, j = stack[-1]
        free[1 + i * pitch : pitch + i * pitch, 1 + j * pitch : pitch + j * pitch] = True
        around = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        around = [(a, b) for a, b in around if 0 <= a < count and 0 <= b < count and not seen[a, b]]
        if not around:
            stack.pop()
            continue
        a, b = around[rng.integers(len(around))]
        rows, columns = (
            slice(1 + min(i, a) * pitch, pitch + max(i, a) * pitch),
            slice(1 + min(j, b) * pitch, pitch + max(j, b) * pitch),
        )
        free[rows, columns] = True
        seen[a, b] = True
        stack.append((a, b))
    return free


def _largest_component(free: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    labels, _ = cast(tuple[np.ndarray, int], ndimage.label(free))
    return labels == np.argmax(np.bincount(labels[free]))


def _letters(rng, labels: str, free, cells, propositions: int) -> Int32[np.ndarray, "H W"]:
    letters = np.zeros(free.shape, np.int32)
    for bit in range(propositions):
        if labels == "points":
            chosen = cells[rng.choice(len(cells), POINTS, replace=False)]
            letters[chosen[:, 0], chosen[:, 1]] |= 1 << bit
            continue
        side = max(3, free.shape[0] // 10)
        while np.mean((letters[free] >> bit) & 1) < AREA / propositions:
            row, column = cells[rng.integers(len(cells))] - side // 2
            letters[max(row, 0) : row + side, max(column, 0) : column + side] |= 1 << bit
    return np.where(free, letters, 0)


@jax.jit
def _table(transitions, free, accepting, cells, states, targets):
    return distance_table(transitions, free, accepting, cells, states, targets, jnp.float32(1))


@jax.jit
def _grids(transitions, free, cells, states):
    return product_distances(transitions, free, cells, states, jnp.float32(1))


def measure(case: Case, repeats: int, sources: int) -> dict:
    """Milliseconds per source of the library and of every opponent, and how much faster the library is."""
    instance = make_instance(case, sources)
    arrays = [jnp.asarray(array) for array in dataclasses.astuple(instance)]
    free, transitions, accepting, cells, states, targets = arrays
    started = time.perf_counter()
    table = _table.lower(transitions, free, accepting, cells, states, targets).compile()
    compiled = time.perf_counter() - started
    grids = _grids.lower(transitions, free, cells, states).compile()
    ours = _median(lambda: jax.block_until_ready(table(transitions, free, accepting, cells, states, targets)), repeats)
    whole = _median(lambda: jax.block_until_ready(grids(transitions, free, cells, states)), repeats)
    travel = np.asarray(table(transitions, free, accepting, cells, states, targets)[0])
    row = dataclasses.asdict(case) | {
        "compile_s": compiled,
        "table_ms": ours / sources,
        "grids_ms": whole / sources,
        "active_cells": int(
            np.any((instance.transitions >= 0) & (instance.transitions != np.arange(case.states)), axis=2).sum()
        ),
    }
    for name, build in _opponents().items():
        started = time.perf_counter()
        solve = build(instance)
        row[f"{name}_build_ms"] = 1e3 * (time.perf_counter() - started)
        used = min(sources, 4)
        row[f"{name}_ms"] = _median(functools.partial(solve, used), repeats) / used
        theirs = np.stack([grid[:, instance.targets[:, 0], instance.targets[:, 1]].T for grid in solve(used)])
        np.testing.assert_allclose(travel[:used], theirs, rtol=1e-4, err_msg=f"{name} disagrees in {case}")
        row[f"{name}_ratio"] = row[f"{name}_ms"] / row["table_ms"]
    return row


def _median(function: Callable[[], object], repeats: int) -> float:
    """Milliseconds of processor time, after one call to warm up."""
    function()
    times = []
    for _ in range(repeats):
        started = time.process_time()
        function()
        times.append(time.process_time() - started)
    return 1e3 * statistics.median(times)


def _opponents() -> dict[str, Callable[[Instance], Callable[[int], Iterable[np.ndarray]]]]:
    """By name: prepares an instance and returns what solves its first sources, each as [Z, H, W]."""
    opponents = {"scipy": _scipy}
    if importlib.util.find_spec("numba") is not None:
        from eval.bench.opponents.dijkstra_numba import ProductGrid

        def compiled(kernel):
            def build(instance: Instance):
                grid = ProductGrid.build(instance.transitions, instance.free)
                sources = list(zip(instance.cells.tolist(), instance.states.tolist(), strict=True))
                return lambda count: [kernel(grid, *source) for source in sources[:count]]

            return build

        opponents["heap"] = compiled(ProductGrid.heap_distances)
        opponents["bucket"] = compiled(ProductGrid.bucket_distances)
    return opponents


def _scipy(instance: Instance) -> Callable[[int], Iterable[np.ndarray]]:
    height, width, states = instance.transitions.shape
    graph = product_graph(instance.transitions, instance.free)
    sources = np.ravel_multi_index((instance.states, *instance.cells.T), (states, height, width))

    def solve(count: int) -> np.ndarray:
        return dijkstra(graph, indices=sources[:count]).reshape(count, states, height, width)

    return solve


def product_graph(transitions: Int32[np.ndarray, "H W Z"], free: Bool[np.ndarray, "H W"]) -> scipy.sparse.csr_matrix:
    """The product as a sparse matrix; node ``(z * H + row) * W + column``."""
    height, width, states = transitions.shape
    padded = np.pad(free, 1)
    sources, sinks, lengths = [], [], []
    for step_down, step_right in NEIGHBOURS:
        there = padded[1 + step_down : 1 + step_down + height, 1 + step_right : 1 + step_right + width]
        below = padded[1 + step_down : 1 + step_down + height, 1 : 1 + width]
        right = padded[1 : 1 + height, 1 + step_right : 1 + step_right + width]
        diagonal = step_down != 0 and step_right != 0
        rows, columns = np.nonzero(there & below & right if diagonal else there)
        start = rows * width + columns
        end = (rows + step_down, columns + step_right)
        for state in range(states):
            following = transitions[end[0], end[1], state]
            exists = following >= 0
            sources.append(state * height * width + start[exists])
            sinks.append((following * height * width + end[0] * width + end[1])[exists])
            lengths.append(np.full(exists.sum(), np.sqrt(2.0) if diagonal else 1.0))
    nodes = states * height * width
    # scipy's Dijkstra copies a matrix whose indices are not int32 at every call.
    ends = [np.concatenate(nodes).astype(np.int32) for nodes in (sources, sinks)]
    return scipy.sparse.csr_matrix((np.concatenate(lengths), tuple(ends)), shape=(nodes, nodes))


def table_of(rows: list[dict]) -> str:
    """A Markdown table: our time, and in brackets how many times faster than scipy / heap / bucket."""
    lines = [
        "| map | labels | Z | active cells | table | grids | scipy / heap / bucket |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        ratios = [f"{row[name]:.2f}" for name in ("scipy_ratio", "heap_ratio", "bucket_ratio") if name in row]
        lines.append(
            f"| {row['map']} {row['size']}² | {row['labels']} | {row['states']} | {row['active_cells']} "
            f"| {row['table_ms']:.3f} | {row['grids_ms']:.3f} | {' / '.join(ratios)} |"
        )
    return "\n".join(lines)


def growth(rows: list[dict]) -> dict[str, float]:
    """Exponent with which our time a source grows with the side of the office maps, by labels and Z: 2 is per cell."""
    slopes = {}
    for (labels, states), group in _by_size(rows).items():
        sizes, times = np.log([row["size"] for row in group]), np.log([row["table_ms"] for row in group])
        slopes[f"{labels} Z {states}"] = float(np.polyfit(sizes, times, 1)[0])
    return slopes


def _by_size(rows: list[dict]) -> dict[tuple[str, int], list[dict]]:
    """Rows of office maps by labels and Z, where there are several sizes."""
    kinds = sorted({(row["labels"], row["states"]) for row in rows})
    groups = {
        kind: [row for row in rows if row["map"] == "office" and (row["labels"], row["states"]) == kind]
        for kind in kinds
    }
    return {kind: group for kind, group in groups.items() if len(group) > 1}


def plot(rows: list[dict], path: str) -> None:
    """Time a source over the side of the office maps, ours and the opponents'."""
    groups, slopes = _by_size(rows), growth(rows)
    figure, axes = plt.subplots(1, len(groups), figsize=(3.2 * len(groups), 3.2), sharey=True, squeeze=False)
    for axis, ((labels, states), group) in zip(axes[0], groups.items(), strict=True):
        sizes = [row["size"] for row in group]
        for column, name in (("table_ms", "ours"), *((f"{name}_ms", name) for name in _opponents())):
            axis.plot(sizes, [row[column] for row in group], "o-", label=name)
        axis.set(xscale="log", yscale="log", xlabel="side of the map")
        axis.set_title(f"{labels}, Z {states}: ours ~ side^{slopes[f'{labels} Z {states}']:.2f}", fontsize=9)
        axis.set_xticks(sizes, [str(size) for size in sizes])
        axis.minorticks_off()
        axis.grid(alpha=0.25)
    axes[0, 0].set_ylabel("CPU ms a source")
    axes[0, 0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="maps of 64² only")
    parser.add_argument("--only", default="", help="cases whose description contains this, e.g. 'office 256 8 points'")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", help="JSON file for the rows")
    parser.add_argument("--plot", help="picture of how the time grows with the map")
    arguments = parser.parse_args()
    rows = []
    for case in QUICK if arguments.quick else CASES:
        if arguments.only in f"{case.map} {case.size} {case.states} {case.labels}":
            rows.append(measure(case, arguments.repeats, SOURCES if case.size < 512 else 4))
            print(json.dumps(rows[-1]), flush=True)
    print(table_of(rows))
    print("Our time a source grows with the side to the power:", growth(rows))
    if arguments.plot:
        plot(rows, arguments.plot)
    if arguments.out:
        made_by = provenance()
        # What our figures are compared with is of these versions.
        made_by["versions"] |= {"scipy": scipy.__version__, "python": platform.python_version()}
        made_by["device"] = str(jax.devices()[0])
        with open(arguments.out, "w", encoding="utf-8") as file:
            json.dump(
                {"provenance": made_by, "repeats": arguments.repeats, "growth": growth(rows), "rows": rows},
                file,
                indent=1,
            )


if __name__ == "__main__":
    main()
