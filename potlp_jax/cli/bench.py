"""``potlp bench``: how fast the planner is here, and what it takes."""

import os
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.bench.perception import measure_looking
from potlp_jax.bench.planner import (
    DistanceRow,
    PhaseRow,
    Scene,
    SearchRow,
    as_dict,
    make_scene,
    make_world,
    measure_decision,
    measure_distances,
    measure_search,
)
from potlp_jax.bench.problems import FAMILIES
from potlp_jax.bench.timing import environment as describe_environment
from potlp_jax.cli.inputs import read_environment_task, trial_config
from potlp_jax.cli.output import console, fail, package_version, print_json, progress_bar
from potlp_jax.environments.registry import make
from potlp_jax.learning.estimator import TrainedEstimator, estimator_for
from potlp_jax.planning.policies import DecisionConfig

PARTS = ("search", "distances", "decision", "looking")


def run_bench(
    parts: str,
    family: str,
    subgoals: int,
    batches: str,
    simulations: int | None,
    environment: str,
    task_name: str,
    size: int,
    world: int,
    sources: int,
    repeats: int,
    core: int | None,
    json: bool,
) -> None:
    """Measure what was asked for and print it."""
    chosen = _read_parts(parts)
    counts = _read_batches(batches)
    if family not in FAMILIES:
        fail(f"unknown family {family!r}; choose from: {', '.join(FAMILIES)}")
    _pin(core)
    decision = trial_config(simulations).decision
    rows: dict[str, list[Any]] = {}
    with progress_bar() as progress:
        bar = progress.add_task("compiling and measuring", total=None)
        if "search" in chosen:
            rows["search"] = [measure_search(family, subgoals, batch, decision.search, repeats) for batch in counts]
        if set(chosen) - {"search"}:
            progress.update(bar, description="looking around in a world")
            generator = make(environment)
            task = read_environment_task(generator, task_name)
            # First of all, so that a missing one is told before anything long.
            trained = estimator_for(task.propositions) if "looking" in chosen else None
            scene = make_scene(make_world(environment, size, world), task)
            progress.update(bar, description="compiling and measuring")
            rows |= _measure_scene(scene, trained, chosen, decision, sources, repeats)
    where = describe_environment()
    if json:
        print_json({"potlp_jax": package_version(), "environment": where, "rows": _plain(rows)})
        return
    _print(rows, where)


def _measure_scene(
    scene: Scene,
    trained: TrainedEstimator | None,
    chosen: list[str],
    decision: DecisionConfig,
    sources: int,
    repeats: int,
) -> dict[str, list[Any]]:
    rows: dict[str, list[Any]] = {}
    if "distances" in chosen:
        rows["distances"] = [measure_distances(scene, sources, repeats)]
    if "decision" in chosen:
        rows["decision"] = measure_decision(scene, decision, repeats)
    if trained is not None:
        rows["looking"] = measure_looking(scene, trained, decision, repeats)
    return rows


def _read_parts(text: str) -> list[str]:
    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts:
        if part not in PARTS:
            fail(f"unknown part {part!r}; choose from: {', '.join(PARTS)}")
    return parts or fail(f"--parts is empty; choose from: {', '.join(PARTS)}")


def _read_batches(text: str) -> list[int]:
    try:
        batches = [int(word) for word in text.split(",")]
    except ValueError:
        fail(f"--batches {text!r}: give numbers joined by commas, such as 1,16,64")
    if min(batches) < 1:
        fail(f"--batches {text!r}: a batch holds at least one problem")
    return batches


def _pin(core: int | None) -> None:
    """Keep the process on one core; XLA, which has not started yet, then uses a single thread."""
    if core is None:
        return
    if not hasattr(os, "sched_setaffinity"):
        fail("--core needs Linux")
    try:
        os.sched_setaffinity(0, {core})
    except OSError:
        fail(f"--core {core}: there is no such core, or this process may not use it")


def _plain(rows: dict[str, list[Any]]) -> dict[str, list[dict[str, Any]]]:
    return {part: [as_dict(row) for row in measured] for part, measured in rows.items()}


def _print(rows: dict[str, list[Any]], where: dict[str, Any]) -> None:
    out = console()
    threads = "one thread" if where["threads"] == "one" else f"threads on {where['usable_cores']} cores"
    out.print(f"{where['processor']}, {where['platform']}, {threads}; jax {where['jax']}", markup=False)
    if "search" in rows:
        out.print(_search_table(rows["search"]))
    if "distances" in rows:
        out.print(_distance_table(rows["distances"]))
    if "decision" in rows:
        out.print(_phase_table("one decision, by phase", rows["decision"]))
    if "looking" in rows:
        out.print(_phase_table("looking, and one decision with the trained network, by phase", rows["looking"]))
    out.print("medians; compile is what XLA took, run is one call after a warm-up", style="dim")


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    for column in columns:
        table.add_column(column, justify="right")
    return table


def _search_table(rows: list[SearchRow]) -> Table:
    first = rows[0]
    table = _table(
        f"search: family {first.family}, {first.subgoals} subgoals, {first.states} states, {first.actions} actions, "
        f"{first.simulations} simulations",
        *("batch", "simulations/s", "searches/s", "mean depth", "memory per tree", "of the batch", "compile", "run"),
    )
    for row in rows:
        table.add_row(
            str(row.batch),
            f"{row.simulations_per_s:,.0f}",
            f"{row.searches_per_s:,.1f}",
            "-" if row.mean_depth is None else f"{row.mean_depth:.2f}",
            _bytes(row.tree_bytes),
            _bytes(row.batch_tree_bytes),
            _seconds(row.timing.compile_s),
            _seconds(row.timing.run_s),
        )
    return table


def _distance_table(rows: list[DistanceRow]) -> Table:
    table = _table("distances: map × automaton, to everywhere", "grid", "states", "sources", "per source", "compile")
    for row in rows:
        table.add_row(
            f"{row.height} × {row.width}",
            str(row.states),
            str(row.sources),
            f"{row.ms_per_source:.3g} ms",
            _seconds(row.timing.compile_s),
        )
    return table


def _phase_table(title: str, rows: list[PhaseRow]) -> Table:
    table = _table(title, "phase", "run", "per second", "working memory", "trace", "compile")
    for row in rows:
        memory = row.timing.memory
        table.add_row(
            row.phase,
            _seconds(row.timing.run_s),
            f"{row.per_s:,.1f}",
            "-" if memory is None else _bytes(memory["temporaries"]),
            _seconds(row.timing.trace_s),
            _seconds(row.timing.compile_s),
            end_section=row is rows[-2],
        )
    return table


def _seconds(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def _bytes(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e6 else f"{count / 1e3:,.1f} kB"
