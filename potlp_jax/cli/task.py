"""``potlp task``: what a formula means."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import Formula, Json, Propositions
from potlp_jax.cli.output import console, print_json

if TYPE_CHECKING:
    from potlp_jax.task.task import Task

app = command_app()


@app.command(
    "task",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp task "F goal"[/cyan]

[cyan]potlp task "(!fire U extinguisher) & F fire" --propositions fire,extinguisher,exit --out task.svg[/cyan]

[cyan]potlp task automaton.hoa --json[/cyan]
""",
)
def show_task(
    formula: Formula,
    propositions: Propositions = None,
    max_positive_literals: Annotated[
        int | None, typer.Option(min=0, help="Leave out cubes that need more propositions to hold at one cell.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Draw the automaton (.png, .svg, .pdf), or write it as .dot or .mmd (Mermaid)."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Show a task as an automaton: states, transitions, and the outcomes that have to be estimated."""
    from potlp_jax.cli.inputs import read_names
    from potlp_jax.task.reading import read_task

    task = read_task(formula, read_names(propositions), max_positive_literals)
    description = task.describe()
    if out is not None:
        from potlp_jax.view.automata import save_automaton

        save_automaton(task, out)
    if json:
        print_json(description)
        return
    shown = console()
    shown.print(task.text, style="bold")
    shown.print(f"propositions: {', '.join(task.propositions) or 'none'}")
    shown.print(_states(task, description))
    if description["classes"]:
        shown.print(_classes(description))
    if out is not None:
        shown.print(f"wrote {out}")


def _states(task: "Task", description: dict[str, Any]) -> Table:
    from potlp_jax.task.words import transition_words

    table = Table(title="states and transitions", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("state", justify="right")
    table.add_column("role")
    table.add_column("to", justify="right")
    table.add_column("in words")
    table.add_column("when")
    # State and role on the first line of each state alone, so that a state reads as one block.
    for state in range(description["states"]):
        moves = [move for move in description["transitions"] if move["from"] == state]
        for line, move in enumerate(moves):
            first = (str(state), _role(state, description)) if line == 0 else ("", "")
            words = transition_words(task, state, move["to"])
            end = line == len(moves) - 1
            table.add_row(*first, str(move["to"]), words, move["guard"], end_section=end)
    return table


def _role(state: int, description: dict[str, Any]) -> str:
    # The initial state may also accept, when the task holds from the start.
    roles = ["initial"] if state == description["initial"] else []
    roles += [role for role in ("accepting", "trap") if state in description[role]]
    return ", ".join(roles)


def _classes(description: dict[str, Any]) -> Table:
    table = Table(title="outcome classes of a move into the unknown", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("class", justify="right")
    table.add_column("all the while")
    table.add_column("until")
    table.add_column("transitions")
    for index, outcome in enumerate(description["classes"]):
        edges = [
            f"{edge['from']}→{edge['to']}"
            for edge in description["edges"]
            if index in description["conditions"][edge["condition"]]["classes"]
        ]
        # Literals that all keeping letters share may admit further letters; labels use the exact ones.
        stay = outcome["stay"] + ("" if outcome["stay_is_exact"] else " (among others)")
        table.add_row(str(index), stay, outcome["cube"], ", ".join(edges))
    return table
