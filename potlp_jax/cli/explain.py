"""``potlp explain``: one recorded decision."""

import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import EstimatorName, Json
from potlp_jax.cli.output import console, fail, print_json, print_table

if TYPE_CHECKING:
    from potlp_jax.trials.record import Decision, Trial

logger = logging.getLogger(__name__)

# More would not fit: every node at the first depth has as many below it.
BREADTH: int = 4
"""Actions per node in the picture of a tree."""

DEPTH: int = 2
"""Actions in a row in the picture of a tree, unless another number is given."""

app = command_app()


@app.command(
    "explain",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp explain out/fire:0[/cyan] - the first decision of out/fire/trial.json

[cyan]potlp explain out/fire/trial.json:12 --out tree.png[/cyan]

[cyan]potlp explain out/fire:12 --json[/cyan]
""",
)
def explain_decision(
    decision: Annotated[
        str,
        typer.Argument(
            metavar="DECISION",
            help="FOLDER:INDEX or FILE:INDEX of a trial that `potlp run` recorded; the first decision is 0.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Search again and draw the top of the tree (.png, .svg or .pdf)."),
    ] = None,
    depth: Annotated[
        int | None, typer.Option(min=1, max=5, help=f"Actions in a row in the picture of the tree; default: {DEPTH}.")
    ] = None,
    estimator: EstimatorName = None,
    json: Json = False,
) -> None:
    """Explain one decision: the actions that were weighed, their estimates and expected costs."""
    from potlp_jax.view.decisions import action_table, decision_to_dict, describe_decision, why_no_actions

    for name, value in (("--depth", depth), ("--estimator", estimator)):
        if out is None and value is not None:
            fail(f"{name} needs --out: it is for the picture of the tree")
    trial, found = _read_decision(decision)
    files = [] if out is None else _draw(trial, found, out, depth=depth or DEPTH, estimator=estimator)
    if json:
        print_json({"trial": trial.summary(), **decision_to_dict(found)})
        return
    output = console()
    if found.actions:
        print_table(output, action_table(trial, found))
    else:
        output.print(describe_decision(trial, found))
        output.print(why_no_actions(trial, found))
    for file in files:
        output.print(f"wrote {file}")


def _read_decision(name: str) -> "tuple[Trial, Decision]":
    from potlp_jax.cli.inputs import record_file
    from potlp_jax.trials.record import load_trial

    # The last colon separates: a path may hold others.
    match = re.fullmatch(r"(.+):(\d+)", name)
    if match is None:
        fail(f"{name!r} names no decision; write FOLDER:INDEX or FILE:INDEX, such as out/trial.json:0")
    path, index = Path(match[1]), int(match[2])
    trial = load_trial(record_file(path))
    # Indices are those of the record, from 0, as on the page and in the animation.
    if index >= len(trial.decisions):
        count = len(trial.decisions)
        known = f"decisions 0 to {count - 1}" if count else "no decisions"
        fail(f"{path}: the trial has {known}; there is no decision {index}")
    return trial, trial.decisions[index]


def _draw(trial: "Trial", decision: "Decision", out: Path, *, depth: int, estimator: str | None) -> list[Path]:
    """Pictures of the tree and of what the policy saw, painted and imagined, if it did; returns their files."""
    import numpy as np

    from potlp_jax.cli.inputs import read_estimator
    from potlp_jax.learning.overlays import overlays_of
    from potlp_jax.planning.search.inspect import tree_top
    from potlp_jax.trials.replay import estimator_at, panorama_at, replay_decision
    from potlp_jax.view.decisions import describe_decision, task_of, why_no_actions
    from potlp_jax.view.overlays import draw_overlays
    from potlp_jax.view.panoramas import draw_panoramas
    from potlp_jax.view.style import save_figure
    from potlp_jax.view.trees import draw_tree

    if not decision.actions:
        fail(f"decision {decision.index}: {why_no_actions(trial, decision)}; there is no tree to draw")
    # A record keeps the actions of a decision but not the tree. Searching again, with its key where the search samples,
    # grows the same tree.
    given = read_estimator(estimator)
    problem, plan, tree = replay_decision(trial, decision.index, given)
    # Where commitment overrode the search, the record holds what the search itself preferred apart.
    if int(plan.action) != (decision.choice if decision.preferred is None else decision.preferred):
        logger.warning("searching again chose another action than recorded: the versions of the software may differ")
    top = tree_top(problem, tree, depth=depth, width=BREADTH)
    save_figure(draw_tree(top, task_of(trial), describe_decision(trial, decision), breadth=BREADTH), out)
    # Photographs and rasters, for which PNG serves whatever format the tree is wanted in.
    beside = {}
    if decision.observations:
        seen = {look: np.asarray(panorama_at(trial, trial.decisions[look])) for look in decision.observations}
        beside["panoramas"] = draw_panoramas(trial, decision, seen)
    overlays = overlays_of(estimator_at(trial, decision.index, given), trial.belief_of(decision))
    if overlays:
        beside["map"] = draw_overlays(trial, decision, overlays)
    files = {out.with_name(f"{out.stem}-{name}.png"): figure for name, figure in beside.items()}
    for file, figure in files.items():
        save_figure(figure, file)
    return [out, *files]
