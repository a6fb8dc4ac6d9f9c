"""``potlp compare``: policies in the same worlds."""

import csv
import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from potlp_jax.cli.inputs import (
    default_policy,
    make_world,
    read_environment_task,
    read_policy,
    read_split,
    read_trained_estimator,
    trial_config,
)
from potlp_jax.cli.output import (
    FAILED,
    console,
    fail,
    note,
    output_folder,
    print_json,
    progress_bar,
    to_json,
)
from potlp_jax.environments import Generator, make
from potlp_jax.environments.splits import Split
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.planning.policies import Policy
from potlp_jax.records import Outcome, Trial
from potlp_jax.sweep.statistics import Comparison, TrialResult
from potlp_jax.task.task import Task
from potlp_jax.trial import run_trial
from potlp_jax.trial_config import TrialConfig
from potlp_jax.view.comparisons import draw_scatter, loss_lines, outcome_table, savings_table
from potlp_jax.view.style import save_figure
from potlp_jax.world.grid import World

IMPOSSIBLE_IN_A_ROW: int = 100
"""Worlds that are redrawn one after the other before the task is taken to be impossible in all of them."""


@dataclasses.dataclass(frozen=True)
class _Pair:
    """One world with the trials of all policies, reduced to what is reported."""

    seed: int
    trials: Mapping[str, dict[str, Any]]
    budget: float


@dataclasses.dataclass(frozen=True)
class _Setting:
    """What is compared: the worlds of a split from ``first`` on, a task, and the policies."""

    environment: str
    generator: Generator
    split: Split
    first: int
    task: Task
    policies: tuple[Policy, ...]
    config: TrialConfig
    estimator: TrainedEstimator | None

    def trial(self, world: World, seed: int, policy: Policy) -> Trial:
        """The trial of a policy in world ``seed``; its key is the same for all policies."""
        name = f"{self.environment}/{self.split}"
        key = jax.random.key(seed)
        trained = self.estimator if policy is Policy.POTLP else None
        return run_trial(world, self.task, policy, key, self.config, environment=name, seed=seed, estimator=trained)

    def pairs(self) -> Iterator[_Pair]:
        """The worlds in which the task is possible, with a trial of every policy in each."""
        impossible = 0
        for seed in itertools.count(self.first):
            world = make_world(self.generator, self.split, seed)
            floor = self.trial(world, seed, Policy.KNOWN_MAP)
            if floor.outcome is Outcome.SATISFIED:
                impossible = 0
                others = [self.trial(world, seed, policy) for policy in self.policies if policy is not Policy.KNOWN_MAP]
                trials = {trial.policy: trial.summary() for trial in (floor, *others)}
                yield _Pair(seed, trials, _budget(world, self.config))
                continue
            impossible += 1
            if impossible == IMPOSSIBLE_IN_A_ROW:
                fail(f"the task is impossible in {impossible} worlds in a row, up to seed {seed}; check it", FAILED)


def compare_policies(
    environment: str,
    task_name: str,
    policy_names: str | None,
    trials: int,
    seed: int,
    split_name: str | None,
    out: Path | None,
    simulations: int | None,
    estimator: Path | None,
    json: bool,
) -> None:
    """Run every policy in the same worlds and report the paired figures (docs/model.md, section 8)."""
    generator = make(environment)
    split = read_split(split_name, generator)
    policies = _read_policies(default_policy(generator) if policy_names is None else policy_names)
    trained = read_trained_estimator(estimator)
    task = read_environment_task(generator, task_name)
    setting = _Setting(environment, generator, split, seed, task, policies, trial_config(simulations), trained)
    folder = output_folder(out)
    pairs = _run(setting, trials)
    results = {policy.value: [_result(pair, policy) for pair in pairs] for policy in policies}
    comparison = Comparison.from_results(results)
    redrawn = pairs[-1].seed - seed + 1 - trials
    report = {
        "environment": environment,
        "split": str(split),
        "task": task.text,
        "first_seed": seed,
        "seeds": [pair.seed for pair in pairs],
        "redrawn": redrawn,
        **comparison.to_dict(),
    }
    heading = f"{environment}/{split}, task {task.text}, {trials} worlds from {seed}, {redrawn} redrawn as impossible"
    if folder is not None:
        _write(folder, report, heading, comparison, pairs)
    if json:
        print_json(report)
        return
    _print(console(), heading, comparison)
    if folder is not None:
        console().print(f"wrote compare.json, trials.csv, scatter.png and table.txt in {folder}", markup=False)


def _run(setting: _Setting, trials: int) -> list[_Pair]:
    """The first ``trials`` pairs, with progress on stderr: a bar on a terminal, else a line per world."""
    pairs: list[_Pair] = []
    with progress_bar() as progress:
        bar = progress.add_task("worlds (the first one compiles the planner)", total=trials)
        for pair in itertools.islice(setting.pairs(), trials):
            pairs.append(pair)
            progress.update(bar, completed=len(pairs), description="worlds")
            if progress.disable:
                costs = ", ".join(f"{name} {row['cost']:.1f}" for name, row in pair.trials.items())
                note(f"world {pair.seed} ({len(pairs)} of {trials}): {costs}")
    return pairs


def _read_policies(names: str) -> tuple[Policy, ...]:
    """Known map and baseline first, whether named or not; the others in their order, each once."""
    named = [read_policy(name) for name in names.split(",") if name.strip()]
    return tuple(dict.fromkeys([Policy.KNOWN_MAP, Policy.BASELINE, *named]))


def _budget(world: World, config: TrialConfig) -> float:
    return config.budget_factor * float(np.sum(np.asarray(world.extent))) * float(world.resolution)


def _result(pair: _Pair, policy: Policy) -> TrialResult:
    trial = pair.trials[policy.value]
    return TrialResult(cost=trial["cost"], outcome=trial["outcome"], budget=pair.budget, status=trial["status"])


def _print(out: Console, heading: str, comparison: Comparison) -> None:
    out.print(heading, markup=False, style="bold")
    satisfied, charged = comparison.satisfied, comparison.charged
    title = f"{satisfied.pairs} worlds in which every policy satisfied the task ({satisfied.dropped} left out)"
    out.print(savings_table(satisfied, title))
    out.print(savings_table(charged, f"all {charged.pairs} worlds, unsatisfied trials charged their budget"))
    out.print(outcome_table(comparison))
    for line in loss_lines(comparison):
        out.print(line, markup=False)


def _write(
    folder: Path, report: Mapping[str, Any], heading: str, comparison: Comparison, pairs: Sequence[_Pair]
) -> None:
    (folder / "compare.json").write_text(to_json(report) + "\n", "utf-8")
    with (folder / "table.txt").open("w", encoding="utf-8") as file:
        _print(Console(file=file, width=150, highlight=False), heading, comparison)
    with (folder / "trials.csv").open("w", encoding="utf-8", newline="") as file:
        names = ("policy", "outcome", "cost", "steps", "decisions", "fallbacks", "status")
        writer = csv.writer(file)
        writer.writerow(("seed", *names, "budget"))
        for pair in pairs:
            writer.writerows((pair.seed, *(row[name] for name in names), pair.budget) for row in pair.trials.values())
    costs = {name: [pair.trials[name] for pair in pairs] for name in pairs[0].trials}
    save_figure(draw_scatter(costs, heading), folder / "scatter.png")
