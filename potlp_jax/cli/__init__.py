"""``potlp ...``: the command line.

Here are the commands' options and help texts; what a command does is in the file of its name. Those files are imported
when a command runs, so that help is quick.
"""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from potlp_jax.cache import enable_compilation_cache
from potlp_jax.cli.log_app import log_app
from potlp_jax.cli.output import Json, clear_errors, package_version

NO_CACHE = "--no-cache"

app = typer.Typer(
    name="potlp",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Environment = Annotated[
    str,
    typer.Argument(
        metavar="ENV",
        help="[cyan]toy[/cyan], [cyan]firefighting[/cyan], [cyan]rooms[/cyan] or [cyan]map:FILE.yaml[/cyan] (ROS map).",
    ),
]
TaskName = Annotated[
    str, typer.Option("--task", "-t", help="Number of one of the environment's tasks, a formula, or a .hoa file.")
]
SplitName = Annotated[
    str, typer.Option("--split", help="Which worlds to draw from: calibration, training, validation or test.")
]
Simulations = Annotated[
    int | None, typer.Option("--simulations", min=1, help="Simulations per decision of policies that search.")
]

estimator_app = typer.Typer(
    name="estimator", no_args_is_help=True, rich_markup_mode="rich", help="Describe or evaluate a trained estimator."
)
app.add_typer(estimator_app)
app.add_typer(log_app)
Estimator = Annotated[Path, typer.Argument(metavar="CHECKPOINT", help="An estimator (.npz), as train.fit writes it.")]
EstimatorFile = Annotated[
    Path | None, typer.Option("--estimator", help="Trained estimator for the policy potlp; default: the shipped one.")
]


_ABOUT = (
    "Plan temporal-logic tasks in buildings that the robot has never seen.\n\n"
    "A task says what to reach and what to avoid: [cyan](!fire U extinguisher) & F fire[/cyan] means no fire until the "
    "extinguisher is found, and in the end the fire. The robot sees as it goes, weighs the frontiers of what it has "
    "seen by the chance that the task goes on behind them, and moves until the task is satisfied."
)


def _print_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"potlp {package_version()}")
        raise typer.Exit
    return wanted


@app.callback(
    help=_ABOUT,
    epilog="""
[bold]A first tour[/bold]

[cyan]potlp task "!hazard U goal"[/cyan] - what the formula means, as an automaton

[cyan]potlp run toy --task 2 --out demo[/cyan] - one small world: record, picture and animation in demo/

[cyan]potlp explain demo:0[/cyan] - why the robot decided as it did at first

[cyan]potlp compare toy --task 2 --policies oracle --trials 20[/cyan] - does it save anything?

[dim]Exit codes: 0 done, 1 not satisfied or failed, 2 bad input, 130 interrupted.[/dim]
""",
)
def potlp(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and leave.")
    ] = False,
    no_cache: Annotated[
        bool,
        typer.Option(
            NO_CACHE,
            help="Do not keep compiled programs in your cache folder for the next start (nor with POTLP_NO_CACHE=1).",
        ),
    ] = False,
) -> None:
    """The options of ``potlp`` itself; ``main`` heeds ``no_cache``."""


@app.command(
    "task",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp task "F goal"[/cyan]

[cyan]potlp task "(!fire U extinguisher) & F fire" --propositions fire,extinguisher,exit --svg task.svg[/cyan]

[cyan]potlp task automaton.hoa --json[/cyan]
""",
)
@clear_errors
def task_command(
    formula: Annotated[
        str,
        typer.Argument(
            metavar="FORMULA", help="A co-safe formula in Spot's syntax, the name of a shipped task, or a .hoa file."
        ),
    ],
    propositions: Annotated[
        str | None, typer.Option("--propositions", "-p", help="All propositions, in the order of a letter's bits: a,b.")
    ] = None,
    max_positive_literals: Annotated[
        int | None, typer.Option(min=0, help="Leave out ways that need more propositions to hold in one place.")
    ] = None,
    svg: Annotated[Path | None, typer.Option("--svg", help="Draw the automaton (.svg, .png or .pdf).")] = None,
    json: Json = False,
) -> None:
    """Show a task as an automaton: states, transitions, and the outcomes that have to be estimated."""
    from potlp_jax.cli.task import show_task

    show_task(formula, propositions, max_positive_literals, svg, json)


@app.command(
    "run",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp run toy --task 1[/cyan]

[cyan]potlp run firefighting --task 3 --seed 7 --out out/fire[/cyan]

[cyan]potlp run firefighting --task "!fire U exit" --policy baseline --json[/cyan]

[dim]Ends with exit code 1 if the task was not satisfied.[/dim]
""",
)
@clear_errors
def run_command(
    environment: Environment,
    task: TaskName = "1",
    policy: Annotated[
        str | None,
        typer.Option(
            "--policy",
            "-p",
            help="potlp (the default where an estimator is shipped), known-map, baseline, optimistic or oracle.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Which world of the split.")] = 0,
    split: SplitName = "validation",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for trial.json, trial.png and trial.gif.")
    ] = None,
    animation: Annotated[bool, typer.Option(help="Make the animation, the slowest of the three files.")] = True,
    simulations: Simulations = None,
    estimator: EstimatorFile = None,
    json: Json = False,
) -> None:
    """Run one trial: one world, one task, one policy."""
    from potlp_jax.cli.run import run_one

    run_one(environment, task, policy, seed, split, out, animation, simulations, estimator, json)


@app.command(
    "compare",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp compare toy --task 2 --trials 20[/cyan]

[cyan]potlp compare firefighting -t 1 --policies baseline,optimistic,oracle --trials 100 --out out/table[/cyan]

[dim]known-map (the floor) and baseline are always run: savings are measured between them.[/dim]
""",
)
@clear_errors
def compare_command(
    environment: Environment,
    task: TaskName = "1",
    policies: Annotated[
        str | None,
        typer.Option(
            "--policies", help="Names, joined by commas; default: potlp where it is shipped.", show_default=False
        ),
    ] = None,
    trials: Annotated[int, typer.Option("--trials", "-n", min=1, help="Worlds; every policy runs in each.")] = 20,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="First world of the split.")] = 0,
    split: SplitName = "validation",
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for compare.json, trials.csv, scatter.png and table.txt."),
    ] = None,
    simulations: Simulations = None,
    estimator: EstimatorFile = None,
    json: Json = False,
) -> None:
    """Compare policies in the same worlds, with the share of attainable savings and its uncertainty."""
    from potlp_jax.cli.compare import compare_policies

    compare_policies(environment, task, policies, trials, seed, split, out, simulations, estimator, json)


@app.command(
    "explain",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp explain out/fire:0[/cyan] - the first decision of out/fire/trial.json

[cyan]potlp explain out/fire/trial.json:12 --out tree.png[/cyan]

[cyan]potlp explain out/fire:12 --json[/cyan]
""",
)
@clear_errors
def explain_command(
    decision: Annotated[
        str, typer.Argument(metavar="DECISION", help="FOLDER:INDEX or FILE:INDEX of a trial that `potlp run` recorded.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Search again and draw the top of the tree (.png, .svg or .pdf)."),
    ] = None,
    depth: Annotated[int, typer.Option(min=1, max=5, help="Actions in a row in the picture of the tree.")] = 2,
    estimator: EstimatorFile = None,
    json: Json = False,
) -> None:
    """Explain one decision: the actions that were weighed, their estimates and expected costs."""
    from potlp_jax.cli.explain import explain_decision

    explain_decision(decision, out, depth, estimator, json)


@app.command(
    "view",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp view out/fire[/cyan] - out/fire/replay.html, opened in the browser

[cyan]potlp view out/fire/trial.json --out page.html --no-open[/cyan]

[dim]The page is one file. Arrow keys go by steps, Page Up and Page Down by decisions.[/dim]
""",
)
@clear_errors
def view_command(
    trial: Annotated[Path, typer.Argument(metavar="TRIAL", help="Folder or file that `potlp run --out` wrote.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Page to write; default: replay.html beside it.")
    ] = None,
    open_it: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")] = True,
) -> None:
    """Replay a trial in the browser: the map as it was revealed, the actions and panoramas of every decision."""
    from potlp_jax.cli.view import view_trial

    view_trial(trial, out, open_it)


@app.command(
    "report",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp report out/validation[/cyan] - writes out/validation/report.html

[cyan]potlp report out/validation --replays 0 --out table.html[/cyan] - tables and plots alone, a small file
""",
)
@clear_errors
def report_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a sweep, finished or not.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Page to write; default: report.html in DIR.")] = None,
    replays: Annotated[
        int, typer.Option(min=0, help="Worst and as many best trials of each task to replay; about 1 MB each.")
    ] = 2,
) -> None:
    """Write a sweep as one page: tables, plots, and the worst and best trials as replays."""
    from potlp_jax.cli.report import write_report

    write_report(folder, out, replays)


@app.command(
    "export",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp export "!fire U exit" --out planner[/cyan] - the search, for distances of your own

[cyan]potlp export "F a & F b" --height 64 --width 64 --subgoals 8 --batch any --out planner[/cyan]

[dim]planner/manifest.json names every input and output; docs/planner.md shows how to call the programs.[/dim]
""",
)
@clear_errors
def export_command(
    formula: Annotated[
        str,
        typer.Argument(
            metavar="FORMULA", help="A co-safe formula in Spot's syntax, the name of a shipped task, or a .hoa file."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the programs and manifest.json.")],
    propositions: Annotated[
        str | None, typer.Option("--propositions", "-p", help="All propositions, in the order of a letter's bits: a,b.")
    ] = None,
    height: Annotated[int | None, typer.Option(min=1, help="Rows of the map, for the whole decision.")] = None,
    width: Annotated[int | None, typer.Option(min=1, help="Columns of the map, for the whole decision.")] = None,
    subgoals: Annotated[int, typer.Option(min=1, help="Length of the array of subgoals.")] = 12,
    simulations: Simulations = None,
    batch: Annotated[
        str | None, typer.Option(help="Problems per call: a number, or 'any'. Default: one, without a batch axis.")
    ] = None,
    platforms: Annotated[str, typer.Option(help="cpu, cuda, rocm, tpu; joined by commas.")] = "cpu,cuda",
    json: Json = False,
) -> None:
    """Export the planner as programs of plain arrays that run with jax alone."""
    from potlp_jax.cli.export import export_task

    export_task(formula, propositions, height, width, subgoals, simulations, batch, platforms, out, json)


@app.command(
    "bench",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp bench[/cyan] - search, distances and the whole decision

[cyan]potlp bench --parts search --family firefighting --batches 1,64,256 --core 0[/cyan]

[cyan]potlp bench --parts decision --environment firefighting --json[/cyan]

[cyan]potlp bench --parts looking --environment firefighting --world 1[/cyan] - what the camera and the network add

[dim]Compiled anew for every measurement: the cache of compiled programs is left out.[/dim]
""",
)
@clear_errors
def bench_command(
    parts: Annotated[
        str, typer.Option("--parts", help="search, distances, decision, looking; joined by commas.")
    ] = "search,distances,decision",
    family: Annotated[str, typer.Option(help="Family of benchmark problems for the search.")] = "three-single",
    subgoals: Annotated[int, typer.Option(min=1, help="Subgoals of the problems for the search.")] = 8,
    batches: Annotated[str, typer.Option(help="Problems searched at once; joined by commas.")] = "1,16,64",
    simulations: Simulations = None,
    environment: Annotated[
        str, typer.Option("--environment", "-e", help="Where distances and decisions are made.")
    ] = "rooms",
    task: TaskName = "1",
    size: Annotated[int, typer.Option(min=21, help="Cells a side of a floor of rooms.")] = 64,
    world: Annotated[int, typer.Option(min=0, help="Number of the world, of those for validation.")] = 0,
    sources: Annotated[int, typer.Option(min=1, help="Places from which to measure distances.")] = 16,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs, of which the median is shown.")] = 5,
    core: Annotated[int | None, typer.Option(min=0, help="Stay on this core, with one thread.")] = None,
    json: Json = False,
) -> None:
    """Measure the planner on this machine: times of compiling and running, throughput, memory."""
    from potlp_jax.cli.bench import run_bench

    run_bench(
        parts, family, subgoals, batches, simulations, environment, task, size, world, sources, repeats, core, json
    )


@estimator_app.command(
    "evaluate",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp estimator evaluate out/fit/estimator.npz data/validation[/cyan]

[cyan]potlp estimator evaluate out/fit/estimator.npz data/validation --ablate all --out out/figures[/cyan]

[dim]Needs the extra: pip install 'potlp-jax\\[train]'. docs/estimator.md says what the figures mean.[/dim]
""",
)
@clear_errors
def estimator_evaluate_command(
    checkpoint: Estimator,
    dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of samples, as train.collect writes it.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for evaluation.json, table.txt and three pictures."),
    ] = None,
    ablate: Annotated[
        str,
        typer.Option("--ablate", help="Also without the [cyan]image[/cyan], with shuffled [cyan]phi[/cyan], or all."),
    ] = "none",
    json: Json = False,
) -> None:
    """Measure an estimator on worlds it has not seen: skill, calibration, errors of costs."""
    from potlp_jax.cli.estimator import evaluate_estimator

    evaluate_estimator(checkpoint, dataset, out, ablate, json)


@estimator_app.command(
    "info",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp estimator info out/fit/estimator.npz[/cyan]

[cyan]potlp estimator info out/fit/estimator.npz --json[/cyan]
""",
)
@clear_errors
def estimator_info_command(checkpoint: Estimator, json: Json = False) -> None:
    """Show what an estimator knows, how large it is and how it was trained."""
    from potlp_jax.cli.estimator import show_estimator

    show_estimator(checkpoint, json)


class _RunByDefault(TyperGroup):
    """A group whose first command runs where none is named: `potlp sweep FILE.yaml`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and not args[0].startswith("-") and args[0] not in self.commands:
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)


sweep_app = typer.Typer(
    name="sweep",
    cls=_RunByDefault,
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="Run many paired trials; show or export their results. [cyan]potlp sweep FILE.yaml --out DIR[/cyan] runs.",
)
app.add_typer(sweep_app)
SweepFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a sweep, as --out named it.")]


@sweep_app.command(
    "run",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp sweep eval/sweeps/validation.yaml --out out/validation[/cyan]

[cyan]potlp sweep mine.yaml --out out/mine --processes 1[/cyan]

[dim]Killed or interrupted, the same command again continues; several may run on one folder. docs/sweeps.md describes
the file.[/dim]
""",
)
@clear_errors
def sweep_run_command(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="What to run: docs/sweeps.md.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")],
    processes: Annotated[
        int | None, typer.Option(min=1, help="Workers, each on a core of its own; default: one per core.")
    ] = None,
    json: Json = False,
) -> None:
    """Run environments × tasks × policies × worlds, or what is missing of it."""
    from potlp_jax.cli.sweep import sweep

    sweep(file, out, processes, json)


@sweep_app.command("show")
@clear_errors
def sweep_show_command(folder: SweepFolder, json: Json = False) -> None:
    """Show the tables of what is finished."""
    from potlp_jax.cli.sweep import show_sweep

    show_sweep(folder, json)


@sweep_app.command("export")
@clear_errors
def sweep_export_command(
    folder: SweepFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write: .csv or .parquet.")],
) -> None:
    """Write one line per finished trial to a file."""
    from potlp_jax.cli.sweep import export_sweep

    export_sweep(folder, out)


def main() -> None:
    """Entry point of the ``potlp`` script. Only here is the cache turned on: ``app`` may run within other programs."""
    if NO_CACHE not in sys.argv[1:]:
        enable_compilation_cache()
    app()
