"""Options and help of ``potlp task``."""

from pathlib import Path
from typing import Annotated

import typer

from potlp_jax.cli.commands.options import Json
from potlp_jax.cli.output import clear_errors

app = typer.Typer()


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
