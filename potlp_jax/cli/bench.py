"""``potlp bench``: how fast the planner is on this machine, and how much memory it takes."""

import os
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.cli.completion import complete_environment
from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import Json, Simulations, TaskName
from potlp_jax.cli.output import console, fail, package_version, print_json, progress_bar

if TYPE_CHECKING:
    from potlp_jax.bench.planner import DistanceRow, PhaseRow, Scene, SearchRow
    from potlp_jax.learning.estimator import TrainedEstimator
    from potlp_jax.trials.config import TrialConfig

# In the order in which they are measured and shown.
PARTS = ("search", "distances", "decision", "perception")

app = command_app()


@app.command(
    "bench",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp bench[/cyan] - search, distances and the whole decision

[cyan]potlp bench --parts search --family firefighting --batches 1,64,256 --core 0[/cyan]

[cyan]potlp bench --parts decision --environment firefighting --json[/cyan]

[cyan]potlp bench --parts perception --environment firefighting --world 1[/cyan] - what the camera and the network add

[dim]Every measurement compiles anew, without the cache of compiled programs.[/dim]
""",
)
def run_bench(
    parts: Annotated[
        str, typer.Option("--parts", help="search, distances, decision, perception; joined by commas.")
    ] = "search,distances,decision",
    family: Annotated[str, typer.Option(help="Family of benchmark problems for the search.")] = "three-single",
    subgoals: Annotated[int, typer.Option(min=1, help="Subgoals of the problems for the search.")] = 8,
    batches: Annotated[str, typer.Option(help="Problems searched at once; joined by commas.")] = "1,16,64",
    simulations: Simulations = None,
    environment: Annotated[
        str,
        typer.Option(
            "--environment", "-e", help="Where distances and decisions are made.", autocompletion=complete_environment
        ),
    ] = "rooms",
    task: TaskName = "1",
    size: Annotated[int, typer.Option(min=21, help="Cells a side of a floor of rooms.")] = 64,
    world: Annotated[int, typer.Option(min=0, help="Number of the world, of those for validation.")] = 0,
    sources: Annotated[int, typer.Option(min=1, help="Cells from which to measure distances.")] = 16,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs, of which the median is shown.")] = 5,
    core: Annotated[int | None, typer.Option(min=0, help="Stay on this core, with one thread.")] = None,
    json: Json = False,
) -> None:
    """Measure the planner on this machine: times of compiling and running, throughput, memory."""
    from potlp_jax.bench.planner import make_scene, make_world, measure_search
    from potlp_jax.bench.problems import FAMILIES
    from potlp_jax.bench.timing import environment as describe_environment
    from potlp_jax.cli.inputs import setting_changes
    from potlp_jax.codec import with_settings
    from potlp_jax.environments.registry import make
    from potlp_jax.learning.domain import Domain
    from potlp_jax.learning.estimator import estimator_for
    from potlp_jax.planning.search.config import BestFirstConfig
    from potlp_jax.trials.config import trial_config_for

    chosen = _read_parts(parts)
    # All words are read before anything is measured: measuring takes minutes.
    counts = _read_batches(batches)
    if family not in FAMILIES:
        fail(f"unknown family {family!r}; choose from: {', '.join(FAMILIES)}")
    # Before anything starts XLA, which counts the cores once and makes a thread for each.
    _pin(core)
    # Of the two searches the default is measured; `eval.bench` compares them.
    searching = BestFirstConfig() if simulations is None else BestFirstConfig(simulations=simulations)
    rows: dict[str, list[Any]] = {}
    with progress_bar() as progress:
        bar = progress.add_task("compiling and measuring", total=None)
        if "search" in chosen:
            rows["search"] = [measure_search(family, subgoals, batch, searching, repeats) for batch in counts]
        if set(chosen) - {"search"}:
            progress.update(bar, description="exploring a world")
            asked = make(environment).task(task)
            made = make_world(environment, size, world)
            # A decision takes longer with more subgoals: what is measured is a trial's in such worlds.
            config = with_settings(trial_config_for(made), setting_changes(simulations=simulations))
            here = Domain.of_world(made, config.camera)
            # Before the world is explored, so that a missing estimator is reported before anything long.
            trained = estimator_for(asked.propositions, here) if "perception" in chosen else None
            scene = make_scene(made, asked, config.sensor)
            progress.update(bar, description="compiling and measuring")
            rows |= _measure_scene(
                scene, parts=chosen, trained=trained, config=config, sources=sources, repeats=repeats
            )
    # Figures mean nothing without the machine: every table and document begins with it.
    where = describe_environment()
    if json:
        print_json({"potlp_jax": package_version(), "environment": where, "rows": _plain(rows)})
        return
    _print(rows, where)


def _measure_scene(
    scene: "Scene",
    *,
    parts: list[str],
    trained: "TrainedEstimator | None",
    config: "TrialConfig",
    sources: int,
    repeats: int,
) -> dict[str, list[Any]]:
    from potlp_jax.bench.perception import measure_perception
    from potlp_jax.bench.planner import measure_decision, measure_distances

    rows: dict[str, list[Any]] = {}
    if "distances" in parts:
        rows["distances"] = [measure_distances(scene, sources, repeats)]
    if "decision" in parts:
        rows["decision"] = measure_decision(scene, config.decision, repeats)
    if trained is not None:
        rows["perception"] = measure_perception(scene, trained, config, repeats)
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
    # macOS has no such call.
    if not hasattr(os, "sched_setaffinity"):
        fail("--core needs Linux")
    try:
        os.sched_setaffinity(0, {core})
    except OSError:
        fail(f"--core {core}: there is no such core, or this process may not use it")


def _plain(rows: dict[str, list[Any]]) -> dict[str, list[dict[str, Any]]]:
    from potlp_jax.bench.planner import as_dict

    return {part: [as_dict(row) for row in measured] for part, measured in rows.items()}


def _print(rows: dict[str, list[Any]], where: dict[str, Any]) -> None:
    out = console()
    threads = "one thread" if where["threads"] == "one" else f"threads on {where['usable_cores']} cores"
    out.print(f"{where['processor']}, {where['platform']}, {threads}; jax {where['jax']}")
    if "search" in rows:
        out.print(_search_table(rows["search"]))
    if "distances" in rows:
        out.print(_distance_table(rows["distances"]))
    if "decision" in rows:
        out.print(_phase_table("one decision, by phase", rows["decision"]))
    if "perception" in rows:
        out.print(_phase_table("perception, and one decision with the trained network, by phase", rows["perception"]))
    out.print("medians; compile is what XLA took, run is one call after a warm-up", style="dim")


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    for column in columns:
        table.add_column(column, justify="right")
    return table


def _search_table(rows: "list[SearchRow]") -> Table:
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
            # Not every search counts its depth.
            "-" if row.mean_depth is None else f"{row.mean_depth:.2f}",
            _bytes(row.tree_bytes),
            _bytes(row.batch_tree_bytes),
            _seconds(row.timing.compile_s),
            _seconds(row.timing.run_s),
        )
    return table


def _distance_table(rows: "list[DistanceRow]") -> Table:
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


def _phase_table(title: str, rows: "list[PhaseRow]") -> Table:
    table = _table(title, "phase", "run", "per second", "working memory", "trace", "compile")
    for row in rows:
        # None where the backend does not report what memory a program takes.
        memory = row.timing.memory
        table.add_row(
            row.phase,
            _seconds(row.timing.run_s),
            f"{row.per_s:,.1f}",
            "-" if memory is None else _bytes(memory["temporaries"]),
            _seconds(row.timing.trace_s),
            _seconds(row.timing.compile_s),
            # The last phase is the whole decision, apart from its parts.
            end_section=row is rows[-2],
        )
    return table


def _seconds(seconds: float) -> str:
    # Three digits: repeated runs agree in no more.
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def _bytes(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e6 else f"{count / 1e3:,.1f} kB"
