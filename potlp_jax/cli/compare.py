"""``potlp compare``: policies in the same worlds. A sweep over one environment and task, shown at once."""

import csv
import shlex
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from potlp_jax.cli.completion import complete_policies
from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import (
    CameraName,
    Environment,
    EstimatorName,
    Json,
    SearchName,
    Simulations,
    SplitName,
    TaskName,
    WorldNumber,
)
from potlp_jax.cli.output import console, fail, file_console, make_folder, print_json, print_next, to_json
from potlp_jax.cli.sweep import print_cell, run_reported

if TYPE_CHECKING:
    from potlp_jax.environments.base import Generator
    from potlp_jax.environments.splits import Split
    from potlp_jax.sweep.results import CellResults, Results
    from potlp_jax.sweep.specification import Specification

app = command_app()


@app.command(
    "compare",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp compare rooms --policies oracle --trials 20[/cyan]

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
    search: SearchName = None,
    estimator: EstimatorName = None,
    camera: CameraName = None,
    processes: Annotated[int, typer.Option(min=1, help="Workers, each on a core of its own.")] = 1,
    picture: Annotated[
        int | None,
        typer.Option(min=0, metavar="WORLD", help="Draw the trials in this world side by side, in --out."),
    ] = None,
    json: Json = False,
) -> None:
    """Compare policies in the same worlds, with the share of attainable savings and its uncertainty."""
    from potlp_jax.cli.doubts import warn_of_sweep
    from potlp_jax.cli.inputs import read_names, read_split, setting_changes
    from potlp_jax.environments.registry import make
    from potlp_jax.sweep.results import remarks_on_given_up
    from potlp_jax.sweep.specification import specification_from_dict

    # Before any trial runs: minutes later the complaint would cost those minutes.
    if picture is not None and out is None:
        fail("--picture needs --out, the folder in which the picture is written")
    if picture is not None and picture < world:
        fail(f"--picture {picture}: the worlds compared begin with {world}")
    generator = make(environment)
    chosen_split = read_split(split, generator)
    changes = setting_changes(simulations=simulations, search=search, camera=camera)
    # The same entries as in a sweep's file, checked by the same code.
    entries: dict[str, Any] = {
        "environments": [environment],
        "tasks": [task],
        "policies": read_names(policies) or [_default_policy(generator, chosen_split, world, changes, estimator)],
        "worlds": trials,
        "split": chosen_split.value,
        "first_world": world,
        "settings": changes,
    }
    if estimator is not None:
        entries["estimator"] = estimator
    specification = specification_from_dict(entries, "compare")
    warn_of_sweep(specification)
    if out is not None:
        results = _run(specification, make_folder(out), processes, kept=True)
        files = _write(results, out)
    # Without a folder the store is needed only until the results are read from it.
    else:
        files = []
        with tempfile.TemporaryDirectory(prefix="potlp-compare-") as folder:
            results = _run(specification, Path(folder), processes, kept=False)
    # The document of `potlp sweep show --json`: one way to read the results of both.
    if json:
        print_json(results.to_dict())
    else:
        print_cell(console(), results.cells[0], specification.split)
        for line in remarks_on_given_up(results.given_up):
            console().print(line)
    # After the table: which worlds are impossible, and so have no picture, is known only by then.
    if out is not None and picture is not None:
        files.append(_draw(specification, results, out, picture))
    if out is not None and not json:
        console().print(f"wrote {', '.join(file.name for file in files)} in {out}")
        print_next(console(), shlex.join(["potlp", "report", str(out)]))


def _default_policy(
    generator: "Generator", split: "Split", world: int, changes: Mapping[str, Any], estimator: str | None
) -> str:
    from potlp_jax.cli.inputs import default_policy_with_note, make_world, read_estimator, trial_config

    made = make_world(generator, split, world)
    return default_policy_with_note(made, trial_config(changes, generator), read_estimator(estimator)).value


def _run(specification: "Specification", folder: Path, processes: int, kept: bool) -> "Results":
    from potlp_jax.cli.inputs import open_store
    from potlp_jax.sweep.results import read_results

    run_reported(specification, folder, processes, kept=kept)
    with open_store(folder) as store:
        return read_results(store)


def _write(results: "Results", folder: Path) -> list[Path]:
    """The results for programs, for tables and for people; returns the files."""
    from potlp_jax.sweep.results import remarks_on_given_up
    from potlp_jax.view.comparisons import draw_scatter
    from potlp_jax.view.style import save_figure

    (cell,) = results.cells
    names = ("compare.json", "trials.csv", "scatter.png", "table.txt")
    data, trials, scatter, table = (folder / name for name in names)
    data.write_text(to_json(results.to_dict()) + "\n", "utf-8")
    split, policies = results.specification["split"], results.specification["policies"]
    # As wide as the widest table: a file has no terminal to ask.
    with table.open("w", encoding="utf-8") as file:
        print_cell(file_console(file, width=150), cell, split)
        file.writelines(f"{line}\n" for line in remarks_on_given_up(results.given_up))
    _write_csv(cell, trials)
    title = f"{cell.environment}/{split}, task {cell.task}: {len(cell.pairs)} worlds"
    save_figure(draw_scatter(cell.pairs, policies, title), scatter)
    return [data, trials, scatter, table]


def _draw(specification: "Specification", results: "Results", folder: Path, world: int) -> Path:
    """The baseline's and the other policies' trials in one world, run again, on one picture; returns its file."""
    from potlp_jax.planning.policies import Policy
    from potlp_jax.sweep.results import world_of
    from potlp_jax.sweep.runner import Sweep
    from potlp_jax.view.maps import draw_side_by_side
    from potlp_jax.view.style import save_figure

    (cell,) = results.cells
    numbers = [world_of(pair) for pair in cell.pairs]
    # Impossible worlds are not among those compared, although their numbers lie between them.
    if world not in numbers:
        told = f"{len(numbers)} of {numbers[0]} to {numbers[-1]}" if numbers else "none"
        fail(f"--picture {world}: the worlds compared are {told}")
    # Rows keep no maps. The trials are made again from world and key, and are the same (tests/test_sweep.py).
    sweep, pair = Sweep(specification, folder, read_only=True), cell.pairs[numbers.index(world)]
    # The known map's path shows no exploration, which is what the picture is to compare.
    trials = [sweep.trial(row.item) for policy, row in pair.items() if policy != Policy.KNOWN_MAP]
    sweep.store.close()
    file = folder / f"world-{world}.png"
    save_figure(draw_side_by_side(trials), file)
    return file


def _write_csv(cell: "CellResults", file: Path) -> None:
    """A line for each trial; paths and versions are in what ``potlp sweep export`` writes."""
    from potlp_jax.types import status_names

    names = ("outcome", "cost", "steps", "decisions", "fallbacks", "budget")
    with file.open("w", encoding="utf-8", newline="") as opened:
        writer = csv.writer(opened)
        writer.writerow(("world", "policy", *names, "status"))
        for pair in cell.pairs:
            for policy, row in pair.items():
                values = (getattr(row, name) for name in names)
                writer.writerow((row.item.world, policy, *values, " ".join(status_names(row.status))))
