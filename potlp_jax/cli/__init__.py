"""``potlp ...``: the command line. One file a command, imported when the command is used.

Importing this package, showing help and completing words import neither jax nor anything that does: files of commands
import the library inside of their functions, and what only annotations need under ``TYPE_CHECKING``.
``tests/test_cli.py`` holds them to it.
"""

import io
import logging
import sys
from typing import Annotated

import typer

from potlp_jax.cli.group import CommandGroup
from potlp_jax.cli.output import package_version, set_verbosity

# Warnings are what --quiet silences: what ends a command is no log message but an error of its own.
_QUIET, _NORMAL, _VERBOSE = logging.ERROR, logging.INFO, logging.DEBUG

app = typer.Typer(
    name="potlp",
    cls=CommandGroup,
    no_args_is_help=True,
    rich_markup_mode="rich",
    # A traceback is for whoever mends the program, and is easier to send as Python prints it.
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_ABOUT = (
    "Plan temporal-logic tasks in buildings that the robot has never seen.\n\n"
    "A task says what to reach and what to avoid: [cyan](!fire U extinguisher) & F fire[/cyan] means no fire until the "
    "extinguisher is found, and in the end the fire. The robot explores, weighs each frontier of the map by the "
    "probability that the task can be continued behind it, and moves until the task is satisfied."
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

[cyan]potlp run rooms --policy oracle --out demo[/cyan] - one building: record, picture and animation in demo/

[cyan]potlp explain demo:0[/cyan] - why the robot decided as it did at first

[cyan]potlp compare rooms --policies oracle --trials 20[/cyan] - what it saves at most, with estimates that are true

[dim]Exit codes: 0 done, 1 not satisfied or failed, 2 bad input, 130 interrupted.[/dim]
""",
)
def potlp(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and leave.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Also say what the library does, on stderr.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="No notes and no progress on stderr, only errors.")
    ] = False,
    no_cache: Annotated[
        bool,
        typer.Option(
            "--no-cache",
            help="Do not keep compiled programs in your cache folder for the next start (nor with POTLP_NO_CACHE=1).",
        ),
    ] = False,
) -> None:
    """The options of ``potlp`` itself, which stand before the command: ``potlp --quiet run toy``."""
    # `group.Command` applies `no_cache`, because only a command that really runs may import jax.
    set_verbosity(_QUIET if quiet else _VERBOSE if verbose else _NORMAL)


def _keep_compiled_programs() -> None:
    # Imports jax.
    from potlp_jax.cache import enable_compilation_cache

    enable_compilation_cache()


def main() -> None:
    """Entry point of the ``potlp`` script. Only here is the cache turned on: ``app`` may run within other programs."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal or pipe of another encoding than UTF-8 shows "?" for a letter that it lacks: better than no table.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    # The context's object is what a command calls before it runs (`group.Command.invoke`).
    app(obj=_keep_compiled_programs)
