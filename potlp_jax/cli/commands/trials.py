"""Options and help of the commands that run trials and show them: run, compare, explain, view."""

from pathlib import Path
from typing import Annotated

import typer

from potlp_jax.cli.commands.options import Environment, EstimatorFile, Json, Simulations, SplitName, TaskName
from potlp_jax.cli.output import clear_errors

app = typer.Typer()


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
    split: SplitName = None,
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
    split: SplitName = None,
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
