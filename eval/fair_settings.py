"""A fair opponent: the settings that are best for each policy, chosen on validation worlds.

    python -m eval.fair_settings firefighting --policies baseline --worlds 60 --out out/fair
    python -m eval.fair_settings delivery --policies baseline,potlp --worlds 60 --out out/fair
    python -m eval.fair_settings --out out/fair --report docs/results/fair_settings     # what is finished so far

Every policy runs in the same worlds with every combination of

- the frontier rule: the fewest cells of a frontier that is a subgoal while larger ones remain (``min_size``),
- the replanning distance: cells after which a changed map is worth a new decision (``replan_distance``),
- the commitment of policies that search: by what fraction another action must be cheaper (``commitment``).

A trial that is not satisfied is charged its budget, as in sweeps. The best setting has the least mean cost in the
worlds of the default. It is chosen if the 95 % interval of its difference to the default, paired by world, lies below
0; otherwise the default is.
Rows are appended to ``rows.jsonl`` as trials end, and the same command goes on. ``--report`` writes NAME.json and the
page NAME.md; the former holds ``policy_settings`` of each family as a sweep's file takes them.
"""

import argparse
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float64

from eval.provenance import lines_of
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.codec import with_settings
from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import identity_of, named_estimator
from potlp_jax.planning.policies import Policy, named_policy
from potlp_jax.sweep.rows import provenance, source_commit, trial_budget
from potlp_jax.sweep.specification import configuration_hash
from potlp_jax.task.task import Task, TaskArrays, TaskSizes
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.trials.record import Outcome
from potlp_jax.trials.rules import estimator_of, trial_key
from potlp_jax.world.grid import World

ROWS: str = "rows.jsonl"
"""Name of the file of rows in the folder."""

SIZES: tuple[int, ...] = (1, 2, 4)
DISTANCES: tuple[float, ...] = (2.0, 4.0, 8.0)
COMMITMENTS: tuple[float, ...] = (0.0, 0.15, 0.3)
"""What is tried besides what the family's trials have by default."""

PORTION: int = 20
"""Worlds that all settings visit before the next ones, so that what is finished early is paired."""

RESAMPLES: int = 10_000
SEARCHING: tuple[str, ...] = (Policy.ORACLE, Policy.POTLP)
"""Policies of which commitment means anything."""

Setting = tuple[int, float, float]
"""Least component size, replanning distance and commitment."""

Row = Mapping[str, Any]


def setting_of(config: TrialConfig) -> Setting:
    """What is varied of a configuration."""
    return config.decision.frontiers.min_size, config.replan_distance, config.decision.commitment


def changes_of(setting: Setting) -> dict[str, Any]:
    """A setting as ``settings`` of a sweep's file."""
    size, distance, commitment = setting
    return {
        "replan_distance": distance,
        "decision": {"commitment": commitment, "frontiers": {"min_size": size}},
    }


def grid(
    policy: str, default: TrialConfig, sizes: Sequence[int], distances: Sequence[float], commitments: Sequence[float]
) -> list[Setting]:
    """Every combination for a policy, its default first.

    Args:
        policy: a name.
        default: what trials of the family have.
        sizes, distances, commitments: to try besides the default's; commitments only where the policy searches.

    Returns:
        The settings, each once.
    """
    own = setting_of(default)
    combined = itertools.product(
        sorted({own[0], *sizes}),
        sorted({own[1], *distances}),
        sorted({own[2], *(commitments if policy in SEARCHING else ())}),
    )
    return [own, *(setting for setting in combined if setting != own)]


class Trials:
    """Trials of a family's tasks in its validation worlds, with rows that are kept."""

    def __init__(self, family: Generator, tasks: Sequence[str], folder: Path, estimator: str | None) -> None:
        self._family, self._file = family, folder / ROWS
        self._default = trial_config_for(family)
        self._estimator = None if estimator is None else named_estimator(estimator)
        compiled = {name: family.task(name) for name in tasks}
        self._tasks = _padded(compiled)
        self._worlds: dict[int, World] = {}
        self._done = {_identity(row) for row in read_rows(folder)}

    def run(self, policy: str, setting: Setting, worlds: Sequence[int]) -> None:
        """Run what is missing; each trial is written as it ends."""
        config = with_settings(self._default, changes_of(setting))
        asked = self._asked(policy)
        common = {
            "environment": self._family.name,
            "policy": policy,
            "setting": list(setting),
            "is_default": config == self._default,
            "configuration": configuration_hash(config),
            "estimator": None if asked is None else identity_of(asked),
            "commit": source_commit(),
        }
        wanted = ({**common, "task": task, "world": world} for world in worlds for task in self._tasks)
        rows = {(row["task"], row["world"]): row for row in wanted if _identity(row) not in self._done}
        starts = (
            Start(self._world(world), self._tasks[task], trial_key(world), name=(task, world)) for task, world in rows
        )
        with self._file.open("a", encoding="utf-8") as file:
            for trial in run_batch(starts, named_policy(policy), config, estimator=asked):
                row = rows[cast(tuple[str, int], trial.name)]
                world = self._world(row["world"])
                found = {
                    "outcome": str(trial.outcome),
                    "cost": trial.cost,
                    "budget": trial_budget(world, config.budget_factor),
                    "decisions": trial.decisions,
                    "status": trial.status,
                }
                file.write(json.dumps(row | found) + "\n")
                file.flush()
                self._done.add(_identity(row))

    def settings(self, policy: str, *values: Sequence[Any]) -> list[Setting]:
        """The grid of a policy in this family."""
        return grid(policy, self._default, *values)

    def _asked(self, policy: str) -> Any:
        world = self._world(0)
        here = Domain.of_world(world, self._default.camera)
        return estimator_of(named_policy(policy), world.propositions, here, self._estimator)

    def _world(self, number: int) -> World:
        # Every setting visits the worlds of a portion; more of them need not be kept.
        if number not in self._worlds:
            if len(self._worlds) > 2 * PORTION:
                self._worlds.clear()
            self._worlds[number] = self._family.generate(world_key(Split.VALIDATION, number, self._family.name))
        return self._worlds[number]


def _padded(tasks: Mapping[str, Task]) -> dict[str, TaskArrays]:
    """Arrays of one size, so that all tasks share a compilation."""
    sizes: TaskSizes | None = None
    for task in tasks.values():
        sizes = task.sizes if sizes is None else sizes.union(task.sizes)
    assert sizes is not None
    return {name: task.padded(sizes) for name, task in tasks.items()}


def _identity(row: Row) -> tuple[Any, ...]:
    """What makes two rows the same trial: nothing that runs otherwise is taken for it."""
    return tuple(row[name] for name in ("environment", "task", "policy", "world", "configuration", "estimator"))


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """All rows of a folder; a last line that a kill has cut off is left out, and out of the file."""
    file = folder / ROWS
    if not file.exists():
        return []
    text = file.read_text("utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        file.write_text(whole, "utf-8")
    return [json.loads(line) for line in whole.splitlines()]


def run(
    family: Generator,
    policies: Sequence[str],
    worlds: int,
    folder: Path,
    values: Sequence[Sequence[Any]],
    estimator: str | None = None,
    tasks: Sequence[str] | None = None,
) -> None:
    """Run what is missing of every policy with every setting, and the known map once.

    Args:
        family: of the worlds.
        policies: names.
        worlds: how many, from number 0.
        folder: for the rows.
        values: least sizes, distances and commitments to try besides the default's.
        estimator: a name, for the policies that ask one.
        tasks: names of the family's tasks; None: all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    trials = Trials(family, list(family.tasks) if tasks is None else tasks, folder, estimator)
    for first in range(0, worlds, PORTION):
        portion = range(first, min(first + PORTION, worlds))
        # Where a task is impossible is known from the known map, which has no settings to choose.
        trials.run(Policy.KNOWN_MAP, trials.settings(Policy.KNOWN_MAP, (), (), ())[0], portion)
        for policy in policies:
            for setting in trials.settings(policy, *values):
                trials.run(policy, setting, portion)
                print(f"{family.name}, worlds to {portion[-1]}: {policy} {setting}", flush=True)


def charged(row: Row) -> float:
    """The cost of a trial; its budget where the task was not satisfied."""
    return row["cost"] if row["outcome"] == Outcome.SATISFIED else row["budget"]


def compare(rows: Sequence[Row], possible: set[tuple[str, int]]) -> dict[str, Any]:
    """The settings of one policy in one family, each against the default in the worlds that both have finished.

    Args:
        rows: of the policy, with all settings.
        possible: tasks and worlds in which the known map suffices to satisfy the task.

    Returns:
        JSON-able: ``settings``, by difference to the default; the ``default``; the ``best`` of those that have finished
        what the default has; the one that is ``chosen``; the default's ``trials`` and ``worlds``.
    """
    found: dict[Setting, dict[tuple[str, int], Row]] = {}
    for row in rows:
        if (row["task"], row["world"]) in possible:
            found.setdefault(_setting(row), {})[row["task"], row["world"]] = row
    default = next(_setting(row) for row in rows if row["is_default"])
    compared = [_against(setting, own, found[default]) for setting, own in found.items()]
    # Equal costs: the default, which nobody has to explain.
    compared.sort(key=lambda entry: (entry["difference"], entry["setting"] != list(default)))
    trials = len(found[default])
    best = next(entry for entry in compared if entry["trials"] == trials)
    return {
        "default": list(default),
        "best": best["setting"],
        "chosen": best["setting"] if best["high"] < 0 else list(default),
        "trials": trials,
        "worlds": len({world for _, world in found[default]}),
        "settings": compared,
    }


def _against(
    setting: Setting, own: Mapping[tuple[str, int], Row], default: Mapping[tuple[str, int], Row]
) -> dict[str, Any]:
    """The figures of a setting in the worlds that it shares with the default."""
    pairs = sorted(own.keys() & default.keys())
    costs = np.array([charged(own[pair]) for pair in pairs])
    usual = np.array([charged(default[pair]) for pair in pairs])
    low, high = interval(costs - usual, np.array([world for _, world in pairs]))
    return {
        "setting": list(setting),
        "trials": len(pairs),
        "mean_cost": float(costs.mean()),
        "default_cost": float(usual.mean()),
        "difference": float((costs - usual).mean()),
        "low": low,
        "high": high,
        "unsatisfied": sum(own[pair]["outcome"] != Outcome.SATISFIED for pair in pairs),
    }


def _setting(row: Row) -> Setting:
    size, distance, commitment = row["setting"]
    return size, distance, commitment


def interval(
    differences: Float64[np.ndarray, " B"], worlds: np.ndarray, resamples: int = RESAMPLES
) -> tuple[float, float]:
    """95 % bootstrap percentile interval of the mean; all tasks of a world are drawn together.

    Args:
        differences: one for each trial, at least one.
        worlds: the number of its world.
        resamples: how many.

    Returns:
        Lower and upper end.
    """
    _, index = np.unique(worlds, return_inverse=True)
    sums, counts = np.bincount(index, differences), np.bincount(index)
    drawn = np.random.default_rng(0).integers(0, len(sums), (resamples, len(sums)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def results(folder: Path) -> dict[str, Any]:
    """What is finished, by family and policy, with the settings that were chosen."""
    rows = read_rows(folder)
    families: dict[str, Any] = {}
    for name in sorted({row["environment"] for row in rows}):
        own = [row for row in rows if row["environment"] == name]
        possible = {
            (row["task"], row["world"])
            for row in own
            if row["policy"] == Policy.KNOWN_MAP and row["outcome"] == Outcome.SATISFIED
        }
        policies = [policy for policy in dict.fromkeys(row["policy"] for row in own) if policy != Policy.KNOWN_MAP]
        compared = {policy: compare([row for row in own if row["policy"] == policy], possible) for policy in policies}
        families[name] = {
            "tasks": sorted({row["task"] for row in own}),
            "estimators": sorted({row["estimator"] for row in own if row["estimator"]}),
            "policies": compared,
            "policy_settings": {policy: _chosen_changes(entry) for policy, entry in compared.items()},
        }
    commits = sorted({row["commit"] for row in rows})
    return {"provenance": provenance(), "commits": commits, "split": Split.VALIDATION.value, "families": families}


def _chosen_changes(compared: Mapping[str, Any]) -> dict[str, Any]:
    size, distance, commitment = compared["chosen"]
    return changes_of((size, distance, commitment))


def chosen_settings(file: Path, family: str) -> dict[str, Any]:
    """``policy_settings`` of a sweep over a family, from a report's JSON."""
    return json.loads(file.read_text("utf-8"))["families"][family]["policy_settings"]


def page(found: Mapping[str, Any], name: str) -> str:
    """The page of results; ``name``: of the JSON file beside it."""
    lines = [*_introduction(), *_chosen_table(found), "", f"<!-- made: {name} -->", "", *_tables(found, name)]
    return "\n".join(lines).rstrip() + "\n"


def _introduction() -> list[str]:
    return [
        "# Settings that are fair to each policy",
        "",
        "A comparison of policies says little if a setting suits one of them and not the other. So each policy, the",
        "baseline too, is given the settings that are best for it: the fewest cells of a frontier that is a subgoal",
        "(`min_size`), the cells after which a changed map is worth a new decision (`replan_distance`) and, where it",
        "searches, its commitment. They are chosen on validation worlds of the family. Real maps have none: there the",
        "settings of the family are used that has generated floors of the same resolution.",
        "",
        "The best setting has the least mean cost; a trial that is not satisfied is charged its budget. It is chosen",
        "if the 95 % interval of its difference to the default (paired by world, all tasks of a world resampled",
        "together) lies below 0; otherwise the default stays. The best of many settings looks better on the worlds on",
        "which it was found than elsewhere: figures of a policy come from test worlds. The JSON file holds the chosen",
        "settings as `policy_settings` of a [sweep's file](../sweeps.md).",
        "",
    ]


def _chosen_table(found: Mapping[str, Any]) -> Iterator[str]:
    yield "| family | policy | worlds | default | best | difference to the default (95 %) | chosen |"
    yield "|---|---|---|---|---|---|---|"
    for family, entry in found["families"].items():
        for policy, compared in entry["policies"].items():
            best = next(row for row in compared["settings"] if row["setting"] == compared["best"])
            chosen = "default" if compared["chosen"] == compared["default"] else "best"
            yield (
                f"| {family} | {policy} | {compared['worlds']} | {_told(compared['default'], policy)} | "
                f"{_told(compared['best'], policy)} | {_difference(best, compared)} | {chosen} |"
            )


def _tables(found: Mapping[str, Any], name: str) -> Iterator[str]:
    for family, entry in found["families"].items():
        for policy, compared in entry["policies"].items():
            yield f"## {family}: {policy}"
            yield ""
            yield f"Tasks {', '.join(entry['tasks'])} in {compared['worlds']} worlds."
            if any(row["trials"] < compared["trials"] for row in compared["settings"]):
                yield "A setting with fewer trials than the default is not finished, and cannot be chosen yet."
            if policy in SEARCHING and entry["estimators"]:
                yield f"Estimator: {', '.join(entry['estimators'])}."
            yield ""
            yield "| setting | trials | mean cost | difference to the default (95 %) | not satisfied |"
            yield "|---|---|---|---|---|"
            for row in compared["settings"]:
                yield (
                    f"| {_told(row['setting'], policy)} | {row['trials']} | {row['mean_cost']:.1f} | "
                    f"{_difference(row, compared)} | {row['unsatisfied']} |"
                )
            yield ""
            yield f"<!-- made: {name} -->"
            yield ""


def _told(setting: Sequence[Any], policy: str) -> str:
    size, distance, commitment = setting
    told = f"`min_size` {size}, `replan_distance` {distance:g}"
    return told + (f", `commitment` {commitment:g}" if policy in SEARCHING else "")


def _difference(row: Mapping[str, Any], compared: Mapping[str, Any]) -> str:
    if row["setting"] == compared["default"]:
        return "the default"
    percent = 100 * row["difference"] / row["default_cost"]
    return f"{row['difference']:+.1f} ({row['low']:+.1f} to {row['high']:+.1f}), {percent:+.1f} %"


def write_report(folder: Path, report: Path) -> None:
    """Write NAME.json and NAME.md of what is finished."""
    found = results(folder)
    data = report.with_suffix(".json")
    data.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    report.with_suffix(".md").write_text(lines_of(page(found, data.name), data.parent), "utf-8")


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.split(",") if part]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", nargs="?", help="family of worlds; without it nothing is run")
    parser.add_argument("--policies", default=Policy.BASELINE.value, help="names, joined by commas")
    parser.add_argument("--worlds", type=int, default=60)
    parser.add_argument("--estimator", help="what potlp asks; default: the shipped one")
    parser.add_argument("--min-sizes", type=_numbers, default=list(SIZES))
    parser.add_argument("--replan-distances", type=_numbers, default=list(DISTANCES))
    parser.add_argument("--commitments", type=_numbers, default=list(COMMITMENTS))
    parser.add_argument("--out", type=Path, required=True, help="folder of the rows")
    parser.add_argument("--report", type=Path, help="NAME of NAME.json and NAME.md")
    arguments = parser.parse_args()
    enable_compilation_cache()
    if arguments.environment is not None:
        sizes = [int(size) for size in arguments.min_sizes]
        values = (sizes, arguments.replan_distances, arguments.commitments)
        policies = arguments.policies.split(",")
        run(make(arguments.environment), policies, arguments.worlds, arguments.out, values, arguments.estimator)
    if arguments.report is not None:
        write_report(arguments.out, arguments.report)


if __name__ == "__main__":
    main()
