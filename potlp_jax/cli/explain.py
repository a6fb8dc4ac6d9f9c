"""``potlp explain``: one recorded decision."""

import re
from pathlib import Path

import numpy as np

from potlp_jax.cli.inputs import read_trained_estimator
from potlp_jax.cli.output import console, fail, note, print_json
from potlp_jax.cli.run import RECORD
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.planning.search.inspect import tree_top
from potlp_jax.trials.record import Decision, Trial, load_trial
from potlp_jax.trials.replay import panorama_at, replay_decision
from potlp_jax.view.decisions import action_table, decision_to_dict, describe_decision
from potlp_jax.view.panoramas import draw_panoramas
from potlp_jax.view.style import save_figure
from potlp_jax.view.trees import draw_tree

BREADTH: int = 4
"""Actions per node in the picture of a tree."""


def explain_decision(name: str, out: Path | None, depth: int, estimator: Path | None, json: bool) -> None:
    """Print the actions of a decision; with ``out``, search again and draw the top of the tree, and what was seen."""
    trial, decision = _read_decision(name)
    files = [] if out is None else _draw(trial, decision, out, depth, read_trained_estimator(estimator))
    if json:
        print_json({"trial": trial.summary(), **decision_to_dict(decision)})
        return
    output = console()
    if decision.actions:
        output.print(action_table(trial, decision))
    else:
        output.print(describe_decision(trial, decision), markup=False)
        output.print(f"policy {trial.policy} does not search: it weighed no actions", markup=False)
    for file in files:
        output.print(f"wrote {file}", markup=False)


def _read_decision(name: str) -> tuple[Trial, Decision]:
    match = re.fullmatch(r"(.+):(\d+)", name)
    if match is None:
        fail(f"{name!r} names no decision; write FOLDER:INDEX or FILE:INDEX, such as out/trial.json:0")
    path, index = Path(match[1]), int(match[2])
    trial = load_trial(path / RECORD if path.is_dir() else path)
    if index >= len(trial.decisions):
        count = len(trial.decisions)
        known = f"decisions 0 to {count - 1}" if count else "no decisions"
        fail(f"{path}: the trial has {known}; there is no decision {index}")
    return trial, trial.decisions[index]


def _draw(trial: Trial, decision: Decision, out: Path, depth: int, estimator: TrainedEstimator | None) -> list[Path]:
    """Pictures of the tree and, where the policy looks, of the panoramas; returns their files."""
    if not decision.actions:
        fail(f"decision {decision.index} of policy {trial.policy} did not search: there is no tree to draw")
    problem, plan, tree = replay_decision(trial, decision.index, estimator)
    if int(plan.action) != (decision.choice if decision.preferred is None else decision.preferred):
        note("searching again chose another action than recorded: the versions of the software may differ")
    top = tree_top(problem, tree, depth=depth, width=BREADTH)
    save_figure(draw_tree(top, describe_decision(trial, decision), breadth=BREADTH), out)
    if not decision.observations:
        return [out]
    seen = {look: np.asarray(panorama_at(trial, trial.decisions[look])) for look in decision.observations}
    beside = out.with_name(f"{out.stem}-panoramas.png")
    save_figure(draw_panoramas(trial, decision, seen), beside)
    return [out, beside]
