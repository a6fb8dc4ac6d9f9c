"""Where PO-TLP loses most in a sweep, and which of its answers it loses it by.

    python -m eval.limit.worst out/table1 --out out/worst --report docs/results/worst
    python -m eval.limit.worst out/delivery/generated --out out/worst-delivery --buildings 8

Takes the trials of a sweep of one environment that cost most beyond the known map, and runs each again with the truth
in place of one part of the answers, and with an ideal observer's where the family has one (``eval.limit``). What takes
away at least half of a loss is its cause. The sweep needs known map, baseline and PO-TLP; its settings of PO-TLP are
kept. Rows are appended to a file of JSON lines; the same command goes on where it was stopped. ``--report`` writes
NAME.json; the table is printed as Markdown.
"""

import argparse
import dataclasses
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.limit.arms import Arm, Experiment, key_of
from eval.limit.rows import ROWS, append_row, charged, read_rows
from eval.savings import read_rows as rows_of_sweep
from eval.savings import versions_of
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments.registry import make
from potlp_jax.learning.domain import unit_of
from potlp_jax.learning.estimator import named_estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.results import charged_cost, pair_rows, reliable_pairs
from potlp_jax.sweep.rows import provenance
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.specification import specification_from_store
from potlp_jax.sweep.statistics import UNRELIABLE
from potlp_jax.sweep.store import Row, Store
from potlp_jax.trials.config import trial_config_for

CAUSES = {Arm.TRUE_CHANCES: "P_S", Arm.TRUE_COSTS: "R_S and R_F", Arm.IDEAL_OBSERVER: "several answers at once"}
"""By the arm that takes a loss away, simplest first: the observer changes all answers."""

NOT_SEEN = "not to be seen"
"""The cause where an ideal observer loses as much: what was needed could not be known, or the planner is wrong."""

NOT_ONE = "more than one answer"
"""The cause where no part of the answers takes it away alone, and no ideal observer tells what all could do."""


@dataclasses.dataclass(frozen=True)
class Loss:
    """A trial of PO-TLP, and what it cost beyond the known map.

    Attributes:
        task: name of the task in its family.
        world: number in the split.
        known_map, baseline, potlp: costs, in units of the resolution.
        points: of the task's share of the attainable savings that this trial costs, in %.
    """

    task: str
    world: int
    known_map: float
    baseline: float
    potlp: float
    points: float

    @property
    def lost(self) -> float:
        """Cost beyond the known map."""
        return self.potlp - self.known_map


def worst_of(rows: Sequence[Row], tasks: Mapping[str, str], number: int) -> list[Loss]:
    """The trials that lose most, worst first; one that is not satisfied is charged its budget.

    Args:
        rows: of the sweep, one environment.
        tasks: formulas by their names in the family.
        number: how many trials.
    """
    names = (Arm.KNOWN_MAP.value, Arm.BASELINE.value, Arm.POTLP.value)
    found = []
    for task, formula in tasks.items():
        pairs = reliable_pairs(pair_rows([row for row in rows if row.item.task == formula], names))
        attainable = sum(charged_cost(pair[names[1]]) - charged_cost(pair[names[0]]) for pair in pairs)
        for pair in pairs:
            known, baseline, potlp = (charged_cost(pair[name]) for name in names)
            points = 100 * (potlp - known) / attainable if attainable else 0.0
            found.append(Loss(task, pair[names[0]].item.world, known, baseline, potlp, points))
    return sorted(found, key=lambda loss: -loss.lost)[:number]


def cause_of(loss: Loss, costs: Mapping[Arm, float]) -> str:
    """Which answer a loss is due to, from the costs of the trial by arm."""
    for arm, cause in CAUSES.items():
        if arm in costs and loss.potlp - costs[arm] >= loss.lost / 2:
            return cause
    return NOT_SEEN if Arm.IDEAL_OBSERVER in costs else NOT_ONE


def run(file: Path, experiment: Experiment, losses: Sequence[Loss]) -> list[dict[str, Any]]:
    """Run what is missing of every arm in these worlds; returns the rows of all."""
    known = {key_of(row): row for row in read_rows(file)}
    arms = [arm for arm in CAUSES if arm in experiment.arms]
    for loss in losses:
        for arm in arms:
            key = experiment.key(loss.task, loss.world, arm)
            if key not in known:
                known[key] = experiment.row(loss.task, loss.world, arm)
                append_row(file, known[key])
                print(f"task {loss.task} world {loss.world} {arm}: {known[key]['cost']:.1f}", flush=True)
    return [known[experiment.key(loss.task, loss.world, arm)] for loss in losses for arm in arms]


def results_of(losses: Sequence[Loss], rows: Sequence[Mapping[str, Any]], unit: str) -> dict[str, Any]:
    """JSON-able: every trial with its costs by arm and its cause, and what each cause costs over all, in ``unit``."""
    costs: dict[tuple[str, int], dict[Arm, float]] = defaultdict(dict)
    for row in rows:
        if not row["status"] & UNRELIABLE:
            costs[row["task"], row["world"]][Arm(row["arm"])] = charged(row)
    causes = [cause_of(loss, costs[loss.task, loss.world]) for loss in losses]
    total: dict[str, float] = defaultdict(float)
    for loss, cause in zip(losses, causes, strict=True):
        total[cause] += loss.lost
    return {
        "trials": [
            {**dataclasses.asdict(loss), "costs": {arm.value: cost for arm, cost in found.items()}, "cause": cause}
            for loss, cause in zip(losses, causes, strict=True)
            for found in [costs[loss.task, loss.world]]
        ],
        "unit": unit,
        "lost_by_cause": dict(sorted(total.items(), key=lambda item: -item[1])),
        "problems": [text for row in rows for text in row["problems"]],
        "commits": sorted({row["commit"] for row in rows}),
        "provenance": provenance() | {"versions": versions_of(row["versions"] for row in rows)},
    }


def markdown(results: Mapping[str, Any]) -> str:
    """The table of the trials, and a line for every cause."""
    titles = ("task", "world", "known map", "baseline", "PO-TLP", "true P_S", "true R_S and R_F", "ideal observer")
    lines = [f"| {' | '.join(titles)} | points of the share | cause |", "|---" * (len(titles) + 2) + "|"]
    for trial in results["trials"]:
        costs = [trial[name] for name in ("known_map", "baseline", "potlp")]
        costs += [trial["costs"].get(arm.value) for arm in CAUSES]
        shown = " | ".join("" if cost is None else f"{cost:.0f}" for cost in costs)
        lines.append(f"| {trial['task']} | {trial['world']} | {shown} | {trial['points']:.2f} | {trial['cause']} |")
    lines.append("")
    lines += [f"- {cause}: {lost:.0f} {results['unit']} lost" for cause, lost in results["lost_by_cause"].items()]
    return "\n".join(lines)


def experiment_of(sweep: Path, buildings: int) -> Experiment:
    """The trials of a sweep of one environment, to be run with other answers.

    Raises:
        ValueError: the sweep has several environments, or a seed of its own, which an experiment has not.
    """
    store = Store(sweep / RESULTS, read_only=True)
    specification = specification_from_store(store.specification())
    store.close()
    environments = sorted({cell.environment for cell in specification.cells})
    if len(environments) != 1:
        raise ValueError(f"{sweep} has trials in {', '.join(environments)}: give a sweep of one environment")
    generator, given = make(environments[0]), specification.estimator
    if specification.seed != 0:
        raise ValueError(f"{sweep} has the seed {specification.seed}: give a sweep with seed 0")
    settings = specification.config_of(Policy.POTLP)
    return Experiment(
        generator=generator,
        split=specification.split,
        tasks=tuple(generator.tasks),
        given=None if given is None else named_estimator(given),
        buildings=buildings,
        settings=None if settings == trial_config_for(generator) else settings,
    )


def main() -> None:
    enable_compilation_cache()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sweep", type=Path, help="folder of the sweep")
    parser.add_argument("--out", type=Path, required=True, help="folder of the rows")
    parser.add_argument("--trials", type=int, default=10, help="how many of the worst")
    parser.add_argument("--buildings", type=int, default=16, help="that the ideal observer draws at a decision")
    parser.add_argument("--report", type=Path, help="without suffix: where the results go")
    options = parser.parse_args()
    experiment = experiment_of(options.sweep, options.buildings)
    losses = worst_of(rows_of_sweep(options.sweep), experiment.generator.tasks, options.trials)
    unit = unit_of(float(experiment.world(0).resolution))
    results = results_of(losses, run(options.out / ROWS, experiment, losses), unit)
    print(markdown(results))
    if options.report is not None:
        options.report.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
