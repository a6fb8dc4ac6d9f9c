"""``potlp compare``: policies in the same worlds. A sweep over one environment and task, shown at once."""

import csv
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from potlp_jax.cli.completion import complete_policies
from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import Environment, EstimatorFile, Json, Simulations, SplitName, TaskName, WorldNumber
from potlp_jax.cli.output import console, make_folder, print_json, to_json
from potlp_jax.cli.sweep import print_cell, run_reported

if TYPE_CHECKING:
    from potlp_jax.sweep.results import CellResults, Results
    from potlp_jax.sweep.specification import Specification

app = command_app()


@app.command(
    "compare",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp compare toy --task 2 --trials 20[/cyan]

[cyan]potlp compare firefighting -t 1 --policies baseline,optimistic,oracle --trials 100 --out out/table[/cyan]

[dim]known-map (the least possible cost) and baseline are always run: savings are measured between them. With --out the
folder is that of a sweep: the same command continues it, and potlp report makes a page of it.[/dim]
""",
)
def compare_policies(
    environment: Environment,
    task: TaskName = "1",
    policies: Annotated[
        str | None,
        typer.Option(
            "--policies",
            help="Names, joined by commas; default: potlp where it is shipped.",
            show_default=False,
            autocompletion=complete_policies,
        ),
    ] = None,
    trials: Annotated[int, typer.Option("--trials", "-n", min=1, help="Worlds; every policy runs in each.")] = 20,
    world: WorldNumber = 0,
    split: SplitName = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for the sweep, compare.json, trials.csv, scatter.png and table.txt."),
    ] = None,
    simulations: Simulations = None,
    estimator: EstimatorFile = None,
    processes: Annotated[int, typer.Option(min=1, help="Workers, each on a core of its own.")] = 1,
    json: Json = False,
) -> None:
    """Compare policies in the same worlds, with the share of attainable savings and its uncertainty."""
    from potlp_jax.cli.inputs import default_policy, read_names, read_split
    from potlp_jax.environments.registry import make
    from potlp_jax.sweep.specification import specification_from_dict

    generator = make(environment)
    entries: dict[str, Any] = {
        "environments": [environment],
        "tasks": [task],
        "policies": read_names(policies) or [default_policy(generator).value],
        "worlds": trials,
        "split": read_split(split, generator).value,
        "first_world": world,
        "settings": {} if simulations is None else {"decision": {"search": {"simulations": simulations}}},
    }
    if estimator is not None:
        entries["estimator"] = str(estimator)
    specification = specification_from_dict(entries, "compare")
    if out is not None:
        results = _run(specification, make_folder(out), processes)
        _write(results, out)
    else:
        with tempfile.TemporaryDirectory(prefix="potlp-compare-") as folder:
            results = _run(specification, Path(folder), processes)
    if json:
        print_json(results.to_dict())
        return
    (cell,) = results.cells
    print_cell(console(), cell, specification.split)
    if out is not None:
        console().print(f"wrote compare.json, trials.csv, scatter.png and table.txt in {out}", markup=False)
        console().print(f"next: potlp report {out}", markup=False, style="dim")


def _run(specification: "Specification", folder: Path, processes: int) -> "Results":
    from potlp_jax.cli.inputs import open_store
    from potlp_jax.sweep.results import read_results

    run_reported(specification, folder, processes)
    with open_store(folder) as store:
        return read_results(store)


def _write(results: "Results", folder: Path) -> None:
    from potlp_jax.view.comparisons import draw_scatter
    from potlp_jax.view.style import save_figure

    (cell,) = results.cells
    (folder / "compare.json").write_text(to_json(results.to_dict()) + "\n", "utf-8")
    split, policies = results.specification["split"], results.specification["policies"]
    with (folder / "table.txt").open("w", encoding="utf-8") as file:
        print_cell(Console(file=file, width=150, highlight=False), cell, split)
    _write_csv(cell, folder / "trials.csv")
    title = f"{cell.environment}/{split}, task {cell.task}: {len(cell.pairs)} worlds"
    save_figure(draw_scatter(cell.pairs, policies, title), folder / "scatter.png")


def _write_csv(cell: "CellResults", file: Path) -> None:
    """A line for each trial; paths and versions are in what ``potlp sweep export`` writes."""
    names = ("outcome", "cost", "steps", "decisions", "fallbacks", "status", "budget")
    with file.open("w", encoding="utf-8", newline="") as opened:
        writer = csv.writer(opened)
        writer.writerow(("world", "policy", *names))
        for pair in cell.pairs:
            for policy, row in pair.items():
                writer.writerow((row.item.world, policy, *(getattr(row, name) for name in names)))
