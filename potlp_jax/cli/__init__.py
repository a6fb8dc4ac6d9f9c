"""``potlp ...``: the command line.

Options and help texts are in `commands`; what a command does is in the file of its name beside this one.
"""

import sys
from typing import Annotated

import typer

from potlp_jax.cache import enable_compilation_cache
from potlp_jax.cli.commands import estimator, log, maps, planner, report, sweep, task, trials
from potlp_jax.cli.output import package_version

NO_CACHE = "--no-cache"

app = typer.Typer(
    name="potlp",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for group in (task, trials, report, planner, estimator, sweep, maps, log):
    app.add_typer(group.app)

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


def main() -> None:
    """Entry point of the ``potlp`` script. Only here is the cache turned on: ``app`` may run within other programs."""
    if NO_CACHE not in sys.argv[1:]:
        enable_compilation_cache()
    app()
