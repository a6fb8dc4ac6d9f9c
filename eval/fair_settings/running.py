"""Trials of every policy with every setting, in rows that are kept."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from eval.fair_settings.settings import Setting, changes_of, grid
from potlp_jax.codec import with_settings
from potlp_jax.environments.base import Generator
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import identity_of, named_estimator
from potlp_jax.planning.policies import Policy, named_policy
from potlp_jax.sweep.rows import source_commit, trial_budget
from potlp_jax.sweep.specification import configuration_hash
from potlp_jax.task.task import Task, TaskArrays, TaskSizes
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import trial_config_for
from potlp_jax.trials.rules import estimator_of, trial_key
from potlp_jax.world.grid import World

ROWS: str = "rows.jsonl"
"""Name of the file of rows in the folder."""

PORTION: int = 20
"""Worlds that all settings visit before the next ones, so that what is finished early is paired."""

CONFIRMING: int = 500
"""From this number on worlds do not choose: the best setting is held against the default there once more."""

Row = Mapping[str, Any]


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
