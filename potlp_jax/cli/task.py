"""``potlp task``: what a formula means."""

import dataclasses
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.cli.completion import complete_environment
from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import Formula, Json, Propositions
from potlp_jax.cli.output import console, fail, print_json
from potlp_jax.errors import TaskWarning

if TYPE_CHECKING:
    from potlp_jax.task.doubts import Surroundings
    from potlp_jax.task.task import Task

logger = logging.getLogger(__name__)

app = command_app()


@app.command(
    "task",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp task "F goal"[/cyan]

[cyan]potlp task "(!fire U extinguisher) & F fire" --propositions fire,extinguisher,exit --out task.svg[/cyan]

[cyan]potlp task "F (goal & hazard)" --environment toy[/cyan]

[cyan]potlp task automaton.hoa --json[/cyan]

[dim]A word is a list of letters; a letter, such as {fire, exit}, is what holds at one place. What was probably not
meant is said on stderr.[/dim]
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
    environment: Annotated[
        str | None,
        typer.Option(
            "--environment",
            "-e",
            metavar="ENV",
            help="Check the task against the first worlds of an environment, whose propositions it then has.",
            autocompletion=complete_environment,
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Explain a task: in words, by examples, and as an automaton with the outcomes that have to be estimated."""
    from potlp_jax.cli.doubts import surroundings_of
    from potlp_jax.cli.inputs import read_names
    from potlp_jax.environments.registry import make
    from potlp_jax.task.reading import read_task

    if environment is not None and propositions is not None:
        fail("--environment brings its own propositions: leave out --propositions")
    generator = None if environment is None else make(environment)
    names = read_names(propositions) if generator is None else generator.propositions
    formula = formula if generator is None else generator.formula(formula)
    # What the warnings say stands among the doubts below.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TaskWarning)
        task = read_task(formula, names, max_positive_literals)
    surroundings = None if generator is None else surroundings_of(generator)
    explained = explain_task(task, surroundings, names is not None)
    description = {**task.describe(), **explained}
    if out is not None:
        from potlp_jax.view.automata import save_automaton

        save_automaton(task, out)
    if json:
        print_json(description)
        return
    shown = console()
    shown.print(task.text, style="bold")
    for line in _explanation_lines(explained):
        shown.print(line, soft_wrap=True)
    shown.print(f"propositions: {', '.join(task.propositions) or 'none'}")
    shown.print(_states(task, description))
    if description["classes"]:
        shown.print(_classes(description))
    if out is not None:
        shown.print(f"wrote {out}")
    for doubt in explained["doubts"]:
        logger.warning(doubt["message"])


def explain_task(task: "Task", surroundings: "Surroundings | None", propositions_given: bool) -> dict[str, Any]:
    """A task for people: in words, whether it can be lost, examples and doubts; JSON-able.

    Args:
        task: the task.
        surroundings: where it is to be used; examples are then made of what occurs there.
        propositions_given: whether somebody said which propositions there are.

    Returns:
        ``words`` (None where only the automaton is known), ``can_be_lost``, ``examples`` and ``doubts``.
    """
    from potlp_jax.task.doubts import find_doubts, structure_of
    from potlp_jax.task.phrases import formula_phrase
    from potlp_jax.task.witnesses import shortest_satisfying, shortest_violating

    structure = structure_of(task)
    letters = None if surroundings is None else surroundings.letters
    found = {"satisfying": shortest_satisfying(task, letters), "violating": shortest_violating(task, letters)}
    doubts = find_doubts(task, surroundings, propositions_given=propositions_given)
    return {
        "words": None if structure is None else formula_phrase(structure),
        "can_be_lost": bool(task.dfa.trap.any()),
        "examples": {name: None if word is None else dataclasses.asdict(word) for name, word in found.items()},
        "doubts": [dataclasses.asdict(doubt) for doubt in doubts],
    }


def _explanation_lines(explained: dict[str, Any]) -> Iterator[str]:
    from potlp_jax.task.witnesses import Word

    if explained["words"] is not None:
        yield f"in words:     {explained['words'][0].upper()}{explained['words'][1:]}."
    yield f"lost for good: {'possible' if explained['can_be_lost'] else 'never, whatever happens'}"
    for name, what in (("satisfying", "satisfied by"), ("violating", "violated by")):
        word = explained["examples"][name]
        yield f"{what}: {'no word' if word is None else Word(**word)}"


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
