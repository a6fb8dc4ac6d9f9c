"""``potlp sweep``: thousands of paired trials, resumable, in one store."""

import csv
import dataclasses
import json as json_module
import logging
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import Animation, ClusterName, Json, SweepFolder, TrialFolder, WorldNumber
from potlp_jax.cli.output import FAILED, console, fail, make_folder, print_json, print_table, progress_bar

if TYPE_CHECKING:
    from potlp_jax.engine.engine import Engine
    from potlp_jax.sweep.results import CellResults
    from potlp_jax.sweep.runner import Progress
    from potlp_jax.sweep.specification import Specification
    from potlp_jax.sweep.store import Row

logger = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES: float = 10.0
"""Between lines of progress where stderr is no terminal."""


class _RunByDefault(TyperGroup):
    """A group whose first command runs where none is named: `potlp sweep FILE.yaml`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        # A file called `show` would have to be written ./show.
        if args and not args[0].startswith("-") and args[0] not in self.commands:
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)


app = command_app(
    "sweep",
    "Run many paired trials; show or export their results. [cyan]potlp sweep FILE.yaml --out DIR[/cyan] runs.",
    _RunByDefault,
)


@app.command(
    "run",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp sweep firefighting --out out/firefighting[/cyan] - one that is shipped

[cyan]potlp sweep mine.yaml --out out/mine --processes 1[/cyan]

[cyan]potlp sweep mine.yaml --out out/mine --cluster slurm:partition=cpu,walltime=04:00:00,workers=64[/cyan]

[dim]Killed or interrupted, the same command again continues. docs/sweeps.md describes the file, docs/clusters.md
--cluster.[/dim]
""",
)
def run(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.yaml",
            help="What to run (docs/sweeps.md), or the name of a shipped sweep: firefighting, firefighting-held-out.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")],
    processes: Annotated[
        int | None, typer.Option(min=1, help="Workers, each on a core of its own; default: one per core.")
    ] = None,
    cluster: ClusterName = None,
    retry_broken: Annotated[
        bool, typer.Option("--retry-broken", help="Begin again the trials that were given up.")
    ] = False,
    json: Json = False,
) -> None:
    """Run environments × tasks × policies × worlds, or what is missing of it."""
    from potlp_jax.cli.doubts import warn_of_sweep
    from potlp_jax.cli.inputs import warn_of_test_worlds
    from potlp_jax.environments.splits import Split
    from potlp_jax.sweep.specification import read_specification

    specification = read_specification(file)
    # `potlp run` and `potlp compare` say so where they read the split; here the file names it.
    if specification.split is Split.TEST:
        warn_of_test_worlds()
    warn_of_sweep(specification)
    run_reported(specification, make_folder(out), processes, cluster, retry_broken)
    # From the store, so that a sweep shows the same tables whether it has just ended or is shown again.
    show(out, json)


@app.command("show", cls=Command)
def show(folder: SweepFolder, json: Json = False) -> None:
    """Show the tables of what is finished."""
    from potlp_jax.cli.inputs import open_store
    from potlp_jax.sweep.results import read_results, remarks_on_given_up
    from potlp_jax.sweep.specification import own_settings

    with open_store(folder) as store:
        results = read_results(store)
    if json:
        print_json(results.to_dict())
        return
    for cell in results.cells:
        if cell.pairs:
            print_cell(console(), cell, results.specification["split"])
        else:
            console().print(f"{cell.environment}, task {cell.task}: no world that all policies have finished yet")
    for policy, told in own_settings(results.specification).items():
        console().print(f"settings of {policy}: {told}")
    for line in remarks_on_given_up(results.given_up):
        console().print(line)


@app.command("status", cls=Command)
def status(folder: SweepFolder, json: Json = False) -> None:
    """Show how far a sweep is, also while it runs."""
    from potlp_jax.cli.inputs import open_store
    from potlp_jax.sweep.results import read_status

    with open_store(folder) as store:
        found = read_status(store)
    if json:
        print_json(dataclasses.asdict(found))
        return
    given_up = f", {found.broken} given up" if found.broken else ""
    console().print(f"{folder}: {found.done} of {found.total} trials done{given_up}")
    for policy, done in found.of_policies.items():
        console().print(f"{policy}: {done} of {found.total // len(found.of_policies)}")


def run_reported(
    specification: "Specification",
    folder: Path,
    processes: int | None,
    cluster: str | None = None,
    retry_broken: bool = False,
    kept: bool = True,
) -> None:
    """Run what is missing of a sweep, with progress on stderr.

    Args:
        specification: what to run.
        folder: of the store.
        processes, cluster: where (``engine.opening.open_engine``).
        retry_broken: begin again the trials that were given up.
        kept: whether the folder stays where the sweep is interrupted, or asked to end: it is said that it can go on.
    """
    from potlp_jax.sweep.ending import ENDED, KEPT, end_process_soon
    from potlp_jax.sweep.runner import run_sweep

    reporter = _Reporter()
    try:
        run_sweep(specification, folder, processes, reporter.report, cluster, reporter.begun, retry_broken, kept)
    except KeyboardInterrupt:
        if kept:
            logger.warning(f"interrupted; {KEPT}")
        raise
    except SystemExit as asked:
        # A plug-in may exit, too, as it likes.
        if asked.code == ENDED:
            end_process_soon()
        raise
    finally:
        reporter.close()


class _Reporter:
    """Progress on stderr: a bar on a terminal, otherwise a line now and then; with the rate and the time remaining."""

    def __init__(self) -> None:
        # Of the monotonic clock: a clock that is set while a sweep runs must not change the rate.
        self._first: tuple[float, int] | None = None
        self._done_before, self._last_line = -1, 0.0
        self._last_said = ""
        self._bar = progress_bar()
        self._task: Any = None

    def begun(self, engine: "Engine") -> None:
        """Say where the work can be looked at, where it can."""
        page = getattr(engine, "dashboard", None)
        if page:
            logger.info(f"Dask's page of the work: {page}")

    def report(self, progress: "Progress") -> None:
        """Where the sweep stands."""
        if self._done_before < 0:
            # A sweep that continues has trials from before, which say nothing about the rate of this run.
            self._done_before = progress.done
            self._bar.start()
            self._task = self._bar.add_task("trials (the first ones compile)", total=progress.total)
        if self._first is None and progress.done > self._done_before:
            # Until then programs were compiled, which says nothing about the trials that follow.
            self._first = time.monotonic(), progress.done
        text = self._rate(progress)
        self._bar.update(self._task, completed=progress.done, description=f"trials{text}")
        finished = progress.done >= progress.total
        now = time.monotonic()
        if self._bar.disable and (finished or now - self._last_line >= SECONDS_BETWEEN_LINES):
            self._last_line = now
            self._say(f"{progress.done} of {progress.total} trials{text}")

    def _say(self, line: str) -> None:
        # Before the first trial has ended, which takes as long as compilation, there is nothing new.
        if line != self._last_said:
            logger.info(line)
        self._last_said = line

    def close(self) -> None:
        """A bar that is left running would keep the terminal's cursor hidden."""
        self._bar.stop()

    def _rate(self, progress: "Progress") -> str:
        if self._first is None or progress.done == self._first[1]:
            return ""
        seconds, done = time.monotonic() - self._first[0], progress.done - self._first[1]
        remaining = (progress.total - progress.done) * seconds / done
        workers = f"{progress.workers} workers, " if progress.workers != 1 else ""
        return f" ({workers}{done / seconds:.2f} a second, {_duration(remaining)} remaining)"


def _duration(seconds: float) -> str:
    # In the unit in which the number is small: nobody counts 5,400 seconds.
    minutes = round(seconds / 60)
    return f"{round(seconds)} s" if seconds < 90 else f"{minutes} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def print_cell(out: Console, cell: "CellResults", split: str) -> None:
    """Print the results of one environment and task: a heading, one table, and what qualifies it.

    Args:
        out: a terminal, or a file.
        cell: the results.
        split: from which the worlds are, for the heading.
    """
    from potlp_jax.sweep.results import remarks_on_worlds
    from potlp_jax.view.comparisons import comparison_table, remark_lines

    redrawn = f", {cell.redrawn} impossible ones left out" if cell.redrawn else ""
    out.print(f"{cell.environment}/{split}, task {cell.task}: {len(cell.pairs)} worlds{redrawn}", style="bold")
    print_table(out, comparison_table(cell.comparison))
    for line in [*remark_lines(cell.comparison), *remarks_on_worlds(cell.pairs)]:
        out.print(line)


@app.command(
    "trial",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp sweep trial out/sweep --task 1 --world 7[/cyan] - of PO-TLP

[cyan]potlp sweep trial out/sweep --task 1 --world 7 --policy baseline --out out/seen[/cyan]

[dim]Then potlp explain out/seen:0, potlp view out/seen. Ends with exit code 1 if the task was not satisfied.[/dim]
""",
)
def trial(
    folder: SweepFolder,
    world: WorldNumber,
    task: Annotated[
        str | None,
        typer.Option("--task", "-t", help="As the sweep's file or its tables name it; default: the only one."),
    ] = None,
    policy: Annotated[
        str | None, typer.Option("--policy", "-p", help="Default: potlp where it took part, or else the last one.")
    ] = None,
    environment: Annotated[
        str | None, typer.Option("--environment", "-e", help="Default: the only one of the sweep.")
    ] = None,
    out: TrialFolder = None,
    animation: Animation = True,
    json: Json = False,
) -> None:
    """Run one trial of a sweep once more, for its record, picture and animation."""
    from potlp_jax.cli.sweep_trial import chosen_row, opened, warn_of_differences
    from potlp_jax.cli.trial_files import print_trial, require_folder, write_trial
    from potlp_jax.sweep.rows import differences_of
    from potlp_jax.trials.record import Outcome

    require_folder(out, animation)
    sweep = opened(folder)
    row = chosen_row(sweep, environment, task, policy, world)
    # Another building would be shown as that of the row.
    sweep.require_same_world(row)
    written_to = None if out is None else make_folder(out)
    with progress_bar() as progress:
        progress.add_task("running the trial (the first decision compiles the planner)", total=None)
        again = sweep.trial(row.item)
    files = [] if written_to is None else write_trial(again, written_to, animation)
    differing = differences_of(row, again)
    if json:
        print_json({**again.summary(), "files": [str(file) for file in files], "differs_from_row": differing})
    else:
        print_trial(again, files)
    warn_of_differences(row, differing)
    if again.outcome is not Outcome.SATISFIED:
        raise typer.Exit(FAILED)


@app.command("export", cls=Command)
def export(
    folder: SweepFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write: .csv or .parquet.")],
) -> None:
    """Write one line per finished trial to a file."""
    from potlp_jax.cli.inputs import open_store

    with open_store(folder) as store:
        specification = store.specification()
        rows = [_flat(row) | {name: specification[name] for name in ("split", "seed")} for row in store.rows()]
    if out.suffix == ".csv":
        _write_csv(rows, out)
    elif out.suffix == ".parquet":
        _write_parquet(rows, out)
    else:
        fail(f"--out {out}: give a name that ends in .csv or .parquet")
    console().print(f"wrote {len(rows)} trials to {out}")


def _flat(row: "Row") -> dict[str, Any]:
    """One level of plain values."""
    from potlp_jax.types import status_names

    # Status, keys and versions as text: CSV has no lists, and Parquet's would differ from row to row.
    values = dataclasses.asdict(row)
    item = values.pop("item")
    values |= {
        "status": " ".join(status_names(row.status)),
        "key": " ".join(map(str, row.key)),
        "versions": json_module.dumps(values["versions"], sort_keys=True),
    }
    return {**item, **values}


def _write_csv(rows: list[dict[str, Any]], file: Path) -> None:
    # A sweep without a finished trial is an empty table, not an error.
    names = list(rows[0]) if rows else ["environment", "task", "policy", "world"]
    with file.open("w", encoding="utf-8", newline="") as opened:
        writer = csv.DictWriter(opened, names)
        writer.writeheader()
        writer.writerows(rows)


def _write_parquet(rows: list[dict[str, Any]], file: Path) -> None:
    try:
        import pyarrow
        import pyarrow.parquet
    # CSV needs nothing; only the extra for training brings pyarrow.
    except ImportError:
        fail("Parquet files need pyarrow: pip install 'potlp-jax[train]', or write a .csv", FAILED)
    # Errors of files that pyarrow opens do not say which one.
    with file.open("wb") as opened:
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), opened)
