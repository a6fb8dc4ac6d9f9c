"""What a sweep runs: environments × tasks × policies × worlds, with settings, read from a YAML file.

    environments: [firefighting]
    tasks: [1, 2, 3, 4]            # numbers of the environment's tasks, or formulas
    policies: [known-map, baseline, oracle, potlp]
    worlds: 200                    # per environment and task; impossible ones are redrawn
    split: validation              # optional, as are all below
    first_world: 0
    estimator: out/fit/estimator.npz
    settings:                      # any field of TrialConfig; others are what the environment calls for
      replan_distance: 4
      decision: {search: {simulations: 300}}

``known-map`` and ``baseline`` always run: savings are measured between them.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from potlp_jax.codec import config_from_dict, json_copy, read_settings, settings_file, with_settings
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import MAX_INDEX, Split, check_split
from potlp_jax.environments.tasks import environment_task
from potlp_jax.errors import SpecificationError, TaskError, WorldError
from potlp_jax.planning.policies import Policy
from potlp_jax.trials.config import TrialConfig, trial_config_for


@dataclasses.dataclass(frozen=True)
class Cell:
    """One cell of the sweep's grid: ``worlds`` trials of every policy. ``task`` is a formula or a ``.hoa`` file."""

    environment: str
    task: str


@dataclasses.dataclass(frozen=True)
class Specification:
    """A checked specification.

    Attributes:
        cells: environments × tasks, in the order of the file.
        policies: known map and baseline first.
        worlds: worlds per cell in which the task is possible.
        split, first_world: from which worlds they are taken, in increasing order.
        estimator: file of the trained network; None for the shipped one.
        config: settings of every trial.
        seed: of the trials' keys (not of the worlds).
    """

    cells: tuple[Cell, ...]
    policies: tuple[Policy, ...]
    worlds: int
    split: Split = Split.VALIDATION
    first_world: int = 0
    estimator: Path | None = None
    config: TrialConfig = TrialConfig()
    seed: int = 0

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; equal specifications give equal dictionaries."""
        return {
            "cells": [dataclasses.asdict(cell) for cell in self.cells],
            "policies": [policy.value for policy in self.policies],
            "worlds": self.worlds,
            "split": self.split.value,
            "first_world": self.first_world,
            "estimator": None if self.estimator is None else str(self.estimator),
            "settings": dataclasses.asdict(self.config),
            "seed": self.seed,
        }


def specification_from_store(data: Mapping[str, Any]) -> Specification:
    """The specification that ``Specification.to_dict`` wrote."""
    return Specification(
        cells=tuple(Cell(**cell) for cell in data["cells"]),
        policies=tuple(Policy(name) for name in data["policies"]),
        worlds=data["worlds"],
        split=Split(data["split"]),
        first_world=data["first_world"],
        estimator=None if data["estimator"] is None else Path(data["estimator"]),
        config=config_from_dict(TrialConfig, data["settings"], "settings"),
        seed=data["seed"],
    )


def configuration_hash(config: TrialConfig) -> str:
    """Twelve hexadecimal digits that tell settings apart."""
    text = json.dumps(json_copy(dataclasses.asdict(config)), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def read_specification(given: str | Path) -> Specification:
    """Read and check a specification: a file, or the name of one that is shipped (``potlp_jax/sweep/data``).

    Raises:
        ConfigurationError: there is no such file, or one of its entries is wrong.
        TaskError, WorldError: a formula or an environment is.
    """
    path = settings_file(given, "potlp_jax.sweep")
    return specification_from_dict(read_settings(path), str(path), path.parent)


_REQUIRED = ("environments", "tasks", "policies", "worlds")
_OPTIONAL = ("split", "first_world", "estimator", "settings", "seed")


def specification_from_dict(data: Mapping[str, Any], where: str, folder: Path = Path()) -> Specification:
    """Check the entries of a specification; ``where`` names it in messages, ``folder`` is where its files are."""
    for name in data:
        if name not in (*_REQUIRED, *_OPTIONAL):
            raise SpecificationError(f"{where}: unknown entry {name!r}; known: {', '.join((*_REQUIRED, *_OPTIONAL))}")
    for name in _REQUIRED:
        if name not in data:
            raise SpecificationError(f"{where}: {name} is missing")
    policies = _policies(_list(data, "policies", where), where)
    environments = [str(name) for name in _list(data, "environments", where)]
    split = _split(data.get("split", Split.VALIDATION.value), environments, where)
    cells = [
        Cell(environment, _formula(environment, task, where))
        for environment in environments
        for task in _list(data, "tasks", where)
    ]
    for cell in cells:
        if cells.count(cell) > 1:
            raise SpecificationError(f"{where}: {cell.environment} with {cell.task!r} is there twice")
    estimator = data.get("estimator")
    if estimator is not None and not isinstance(estimator, str):
        raise SpecificationError(f"{where}: estimator: give the name of a file, found {estimator!r}")
    return Specification(
        cells=tuple(cells),
        policies=policies,
        worlds=_number(data, "worlds", 1, where),
        split=split,
        first_world=_number(data, "first_world", 0, where, default=0),
        estimator=None if estimator is None else folder / estimator,
        config=with_settings(_common_config(environments, where), data.get("settings", {}), f"{where}: settings"),
        seed=_number(data, "seed", 0, where, default=0),
    )


def _list(data: Mapping[str, Any], name: str, where: str) -> list[Any]:
    value = data[name]
    if not isinstance(value, list) or not value:
        raise SpecificationError(f"{where}: {name}: give a list such as [{_EXAMPLES[name]}], found {value!r}")
    return value


_EXAMPLES = {"environments": "firefighting", "tasks": "1, 2", "policies": "baseline, oracle, potlp"}


def _number(data: Mapping[str, Any], name: str, least: int, where: str, default: int | None = None) -> int:
    value = data.get(name, default)
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= MAX_INDEX:
        raise SpecificationError(f"{where}: {name}: give a whole number of at least {least}, found {value!r}")
    return value


def _policies(names: list[Any], where: str) -> tuple[Policy, ...]:
    known = [policy.value for policy in Policy]
    for name in names:
        if name not in known:
            raise SpecificationError(f"{where}: policies: unknown policy {name!r}; choose from: {', '.join(known)}")
    return tuple(dict.fromkeys([Policy.KNOWN_MAP, Policy.BASELINE, *map(Policy, names)]))


def _split(name: Any, environments: Sequence[str], where: str) -> Split:
    known = [split.value for split in Split]
    if name not in known:
        raise SpecificationError(f"{where}: split: unknown split {name!r}; choose from: {', '.join(known)}")
    for environment in environments:
        try:
            check_split(Split(name), environment)
        except WorldError as error:
            raise SpecificationError(f"{where}: split: {error}") from error
    return Split(name)


def _formula(environment: str, task: Any, where: str) -> str:
    """A task by number as its formula, any other (a formula, a ``.hoa`` file) as it is. Raises for what is no task."""
    generator = make(environment)
    try:
        environment_task(generator, str(task))
    except TaskError as error:
        raise SpecificationError(f"{where}: tasks: {error}") from error
    return generator.tasks.get(str(task), str(task))


def _common_config(environments: Sequence[str], where: str) -> TrialConfig:
    """What all environments call for."""
    configs = {name: trial_config_for(make(name)) for name in environments}
    first = configs[environments[0]]
    for name, config in configs.items():
        if config != first:
            raise SpecificationError(
                f"{where}: environments: trials in {environments[0]} and {name} need different settings, and a sweep "
                "has one; make a sweep of each"
            )
    return first
