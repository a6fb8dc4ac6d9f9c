"""``potlp compare``: policies in the same worlds."""

import csv
import dataclasses
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

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
from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.results import Pair, compare_pairs
from potlp_jax.sweep.rows import trial_row
from potlp_jax.sweep.runner import IMPOSSIBLE_IN_A_ROW
from potlp_jax.sweep.statistics import KNOWN_MAP, Comparison
from potlp_jax.sweep.store import Item, Row
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial, trial_key
from potlp_jax.trials.record import Outcome
from potlp_jax.view.comparisons import draw_scatter, loss_lines, outcome_table, savings_table
from potlp_jax.view.style import save_figure
from potlp_jax.world.grid import World


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

    def row(self, world: World, seed: int, policy: Policy) -> Row:
        """The trial of a policy in world ``seed``; its key is the same for all policies."""
        start, key = time.perf_counter(), trial_key(seed)
        name = f"{self.environment}/{self.split}"
        trained = self.estimator if policy is Policy.POTLP else None
        trial = run_trial(world, self.task, policy, key, self.config, environment=name, seed=seed, estimator=trained)
        item = Item(self.environment, self.task.text, policy.value, seed)
        return trial_row(item, trial, key, self.config, time.perf_counter() - start)

    def pairs(self) -> Iterator[Pair]:
        """The worlds in which the task is possible, with the trials of all policies in each, the known map's first."""
        impossible = 0
        for seed in itertools.count(self.first):
            world = make_world(self.generator, self.split, seed)
            floor = self.row(world, seed, Policy.KNOWN_MAP)
            if floor.outcome == Outcome.SATISFIED:
                impossible = 0
                others = [self.row(world, seed, policy) for policy in self.policies if policy is not Policy.KNOWN_MAP]
                yield {row.item.policy: row for row in (floor, *others)}
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
    setting = _Setting(
        environment, generator, split, seed, task, policies, trial_config(simulations, generator), trained
    )
    folder = output_folder(out)
    pairs = _run(setting, trials)
    comparison = compare_pairs(pairs, [policy.value for policy in policies])
    redrawn = _seed(pairs[-1]) - seed + 1 - trials
    report = {
        "environment": environment,
        "split": str(split),
        "task": task.text,
        "first_seed": seed,
        "seeds": [_seed(pair) for pair in pairs],
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


def _run(setting: _Setting, trials: int) -> list[Pair]:
    """The first ``trials`` pairs, with progress on stderr: a bar on a terminal, else a line per world."""
    pairs: list[Pair] = []
    with progress_bar() as progress:
        bar = progress.add_task("worlds (the first one compiles the planner)", total=trials)
        for pair in itertools.islice(setting.pairs(), trials):
            pairs.append(pair)
            progress.update(bar, completed=len(pairs), description="worlds")
            if progress.disable:
                costs = ", ".join(f"{name} {row.cost:.1f}" for name, row in pair.items())
                note(f"world {_seed(pair)} ({len(pairs)} of {trials}): {costs}")
    return pairs


def _read_policies(names: str) -> tuple[Policy, ...]:
    """Known map and baseline first, whether named or not; the others in their order, each once."""
    named = [read_policy(name) for name in names.split(",") if name.strip()]
    return tuple(dict.fromkeys([Policy.KNOWN_MAP, Policy.BASELINE, *named]))


def _seed(pair: Pair) -> int:
    return pair[KNOWN_MAP].item.world


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
    folder: Path, report: Mapping[str, Any], heading: str, comparison: Comparison, pairs: Sequence[Pair]
) -> None:
    (folder / "compare.json").write_text(to_json(report) + "\n", "utf-8")
    with (folder / "table.txt").open("w", encoding="utf-8") as file:
        _print(Console(file=file, width=150, highlight=False), heading, comparison)
    with (folder / "trials.csv").open("w", encoding="utf-8", newline="") as file:
        names = ("outcome", "cost", "steps", "decisions", "fallbacks", "status", "budget")
        writer = csv.writer(file)
        writer.writerow(("seed", "policy", *names))
        for pair in pairs:
            for policy, row in pair.items():
                writer.writerow((row.item.world, policy, *(getattr(row, name) for name in names)))
    save_figure(draw_scatter(pairs, list(pairs[0]), heading), folder / "scatter.png")
