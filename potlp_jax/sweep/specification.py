"""What a sweep runs: environments × tasks × policies × worlds, with settings, read from a YAML file.

    environments: [firefighting]
    tasks: [1, 2, 3, 4]            # numbers of the environment's tasks, formulas, or .hoa files beside this file
    policies: [known-map, baseline, oracle, potlp]
    worlds: 200                    # per environment and task; impossible ones are redrawn
    split: validation              # optional, as are all below
    first_world: 0
    estimator: out/fit/estimator.npz
    settings:                      # any field of TrialConfig; the other fields are what the environment calls for
      replan_distance: 4
      decision: {search: {simulations: 300}}
    policy_settings:               # of single policies, beyond ``settings``: how they decide, nothing of the trial
      baseline: {decision: {frontiers: {min_size: 2}}}

``known-map`` and ``baseline`` always run: savings are measured between them.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from potlp_jax import plugins
from potlp_jax.codec import config_from_dict, differences, json_copy, read_settings, settings_file, with_settings
from potlp_jax.environments.base import Generator
from potlp_jax.environments.families import PREFIXED
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import MAX_INDEX, Split, check_split
from potlp_jax.errors import PluginError, SpecificationError, TaskError, WorldError
from potlp_jax.files import short
from potlp_jax.learning.estimator import shipped_files
from potlp_jax.planning.policies import Policy, named_policy
from potlp_jax.task.doubts import structure_of
from potlp_jax.task.reading import read_task
from potlp_jax.task.shipped import shipped_tasks
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig, trial_config_for


@dataclasses.dataclass(frozen=True)
class Cell:
    """One cell of the sweep's grid: ``worlds`` trials of every policy.

    Attributes:
        environment: by its name.
        task: a formula, or the name of a ``.hoa`` file that has none (``Specification.automata``).
    """

    environment: str
    task: str


@dataclasses.dataclass(frozen=True)
class Specification:
    """A checked specification.

    Attributes:
        cells: environments × tasks, in the order of the file.
        policies: names (``planning.policies.named_policy``), known map and baseline first.
        worlds: worlds per cell in which the task is possible.
        split, first_world: from which worlds they are taken, in increasing order.
        estimator: a name (``learning.estimator.named_estimator``); None for the shipped one.
        config: settings of every trial whose policy has none of its own.
        seed: of the trials' keys (not of the worlds).
        policy_configs: settings of the trials of single policies, in the order of the policies.
        automata: tasks of the cells that were read from files, and what the files held, in HOA format: the sweep is of
            these automata, whatever becomes of the files.
    """

    cells: tuple[Cell, ...]
    policies: tuple[str, ...]
    worlds: int
    split: Split = Split.VALIDATION
    first_world: int = 0
    estimator: str | None = None
    config: TrialConfig = TrialConfig()
    seed: int = 0
    policy_configs: tuple[tuple[str, TrialConfig], ...] = ()
    automata: tuple[tuple[str, str], ...] = ()

    def task_of(self, cell: Cell, generator: Generator) -> Task:
        """The task of a cell, over the propositions of its environment."""
        automaton = dict(self.automata).get(cell.task)
        return generator.task(cell.task) if automaton is None else Task.from_hoa(automaton, generator.propositions)

    def config_of(self, policy: str) -> TrialConfig:
        """The settings of a policy's trials."""
        return dict(self.policy_configs).get(policy, self.config)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; equal specifications give equal dictionaries."""
        data = {
            "cells": [dataclasses.asdict(cell) for cell in self.cells],
            "policies": list(self.policies),
            "worlds": self.worlds,
            "split": self.split.value,
            "first_world": self.first_world,
            "estimator": self.estimator,
            "settings": dataclasses.asdict(self.config),
            "seed": self.seed,
        }
        # Left out where there are none: the same trials as ever are the same sweep as ever.
        own = {policy: dataclasses.asdict(config) for policy, config in self.policy_configs}
        further = {"policy_settings": own, "automata": dict(self.automata)}
        return data | {name: entry for name, entry in further.items() if entry}


def specification_from_store(data: Mapping[str, Any]) -> Specification:
    """The specification that ``Specification.to_dict`` wrote."""
    return Specification(
        cells=tuple(Cell(**cell) for cell in data["cells"]),
        policies=tuple(data["policies"]),
        worlds=data["worlds"],
        split=Split(data["split"]),
        first_world=data["first_world"],
        estimator=data["estimator"],
        config=config_from_dict(TrialConfig, data["settings"], "settings"),
        seed=data["seed"],
        policy_configs=tuple(
            (policy, config_from_dict(TrialConfig, settings, f"policy_settings: {policy}"))
            for policy, settings in data.get("policy_settings", {}).items()
        ),
        automata=tuple(data.get("automata", {}).items()),
    )


def own_settings(data: Mapping[str, Any]) -> dict[str, str]:
    """By policy, in which settings it differs from those of the sweep, in words; ``data``: of ``to_dict``."""
    own = data.get("policy_settings", {})
    told = {policy: ", ".join(differences(data["settings"], settings)) for policy, settings in own.items()}
    # A value that is named and is also the sweep's is no difference.
    return {policy: found for policy, found in told.items() if found}


def configuration_hash(config: TrialConfig) -> str:
    """Twelve hexadecimal digits that differ for different settings."""
    # 48 bits: among a million settings the chance that two share a hash is 0.2 %.
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
_OPTIONAL = ("split", "first_world", "estimator", "settings", "seed", "policy_settings")

_OF_THE_POLICY = ("decision", "replan_distance", "panoramas")
"""Fields of ``TrialConfig`` in which policies of one sweep may differ: the others say what the trial is."""


def specification_from_dict(data: Mapping[str, Any], where: str, folder: Path = Path()) -> Specification:
    """Check the entries of a specification.

    Args:
        data: the entries, as in the file.
        where: names the specification in messages.
        folder: what names of files are relative to.

    Returns:
        The specification, with tasks as formulas and known map and baseline among the policies.

    Raises:
        SpecificationError: an entry is missing, unknown or wrong.
        ConfigurationError: a setting is.
    """
    # Unknown entries first: a misspelt one is then named, rather than the right one reported as missing.
    for name in data:
        if name not in (*_REQUIRED, *_OPTIONAL):
            raise SpecificationError(f"{where}: unknown entry {name!r}; known: {', '.join((*_REQUIRED, *_OPTIONAL))}")
    for name in _REQUIRED:
        if name not in data:
            raise SpecificationError(f"{where}: {name} is missing")
    policies = _policies(_list(data, "policies", where), where)
    environments = [_environment(str(name), folder) for name in _list(data, "environments", where)]
    split = _split(data.get("split", Split.VALIDATION.value), environments, where)
    automata: dict[str, str] = {}
    cells = [
        Cell(environment, _task(environment, task, folder, automata, where))
        for environment in environments
        for task in _list(data, "tasks", where)
    ]
    # Task 1 and its formula are the same cell; run twice, its rows would overwrite each other.
    for cell in cells:
        if cells.count(cell) > 1:
            raise SpecificationError(f"{where}: {cell.environment} with {cell.task!r} is there twice")
    first_world, worlds = _number(data, "first_world", 0, where, default=0), _number(data, "worlds", 1, where)
    if first_world + worlds > MAX_INDEX + 1:
        raise SpecificationError(f"{where}: worlds: {worlds} from number {first_world} on, and the last is {MAX_INDEX}")
    config = with_settings(_common_config(environments, where), data.get("settings", {}), f"{where}: settings")
    estimator = data.get("estimator")
    if estimator is not None and not isinstance(estimator, str):
        raise SpecificationError(f"{where}: estimator: give a file or module:attribute, found {estimator!r}")
    return Specification(
        cells=tuple(cells),
        policies=policies,
        worlds=worlds,
        split=split,
        first_world=first_world,
        estimator=None if estimator is None else _estimator(estimator, folder),
        config=config,
        seed=_number(data, "seed", 0, where, default=0),
        policy_configs=_policy_configs(data.get("policy_settings", {}), policies, config, f"{where}: policy_settings"),
        automata=tuple(automata.items()),
    )


def _list(data: Mapping[str, Any], name: str, where: str) -> list[Any]:
    value = data[name]
    if not isinstance(value, list) or not value:
        raise SpecificationError(f"{where}: {name}: give a list such as [{_EXAMPLES[name]}], found {short(value)}")
    return value


_EXAMPLES = {"environments": "firefighting", "tasks": "1, 2", "policies": "baseline, oracle, potlp"}


def _number(data: Mapping[str, Any], name: str, least: int, where: str, default: int | None = None) -> int:
    value = data.get(name, default)
    # To Python, True is a whole number; in a file it is a mistake.
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= MAX_INDEX:
        raise SpecificationError(f"{where}: {name}: give a whole number of at least {least}, found {short(value)}")
    return value


def _policies(names: list[Any], where: str) -> tuple[str, ...]:
    # Savings are measured between these two, so they run whether named or not.
    found = [Policy.KNOWN_MAP.value, Policy.BASELINE.value]
    for name in map(str, names):
        try:
            policy = named_policy(name)
        except PluginError as error:
            raise SpecificationError(f"{where}: policies: {error}") from error
        # Functions keep the name that was given: workers find them by it.
        found.append(policy.value if isinstance(policy, Policy) else name)
    return tuple(dict.fromkeys(found))


def _policy_configs(
    given: Any, policies: Sequence[str], config: TrialConfig, where: str
) -> tuple[tuple[str, TrialConfig], ...]:
    """The settings of the policies that have their own."""
    if not isinstance(given, Mapping):
        raise SpecificationError(f"{where}: give settings by policy, found {short(given)}")
    for policy, settings in given.items():
        if policy not in policies:
            raise SpecificationError(f"{where}: {policy!r} is none of the policies: {', '.join(policies)}")
        # Policies are compared in the same trials: what the robot sees, or may spend, is not theirs to choose.
        for field in settings if isinstance(settings, Mapping) else ():
            if hasattr(config, str(field)) and field not in _OF_THE_POLICY:
                raise SpecificationError(
                    f"{where}: {policy}: {field} is the same for all policies; set it in settings (a policy may have "
                    f"its own {', '.join(_OF_THE_POLICY)})"
                )
    return tuple(
        (policy, with_settings(config, given[policy], f"{where}: {policy}")) for policy in policies if policy in given
    )


def _estimator(name: str, folder: Path) -> str:
    """A file beside the specification, or a name as it stands."""
    beside = folder / name
    is_name = name in shipped_files() or plugins.is_known(name, plugins.ESTIMATORS)
    if beside.is_file():
        # Wherever the command is given from, it is the same sweep.
        return str(beside.resolve())
    return name if is_name else str(beside)


def _environment(name: str, folder: Path) -> str:
    """The name of an environment with files that lie beside the specification; others are as they stand."""
    prefix = next((prefix for prefix in PREFIXED if name.startswith(prefix)), None)
    # What is given in the folder of the specification keeps its short name.
    if prefix is None or folder.resolve() == Path.cwd():
        return name

    def located(part: str) -> str:
        option, equals, file = part.rpartition("=")
        beside = folder / file
        is_beside = file and not Path(file).is_absolute() and beside.exists()
        return f"{option}{equals}{beside.resolve()}" if is_beside else part

    return prefix + ",".join(located(part) for part in name.removeprefix(prefix).split(","))


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


def _task(environment: str, given: Any, folder: Path, automata: dict[str, str], where: str) -> str:
    """A task's name in its cell: its formula, or where a file's automaton has none the file's name.

    Args:
        environment: by its name.
        given: in the specification: a number, a formula, the name of a shipped task or of a ``.hoa`` file.
        folder: what names of files are relative to.
        automata: what files hold, in HOA format, by the name in the cell; added to.
        where: names the specification in messages.

    Raises:
        SpecificationError: it is no task of the environment.
    """
    generator = make(environment)
    # To Python, True is a whole number; and YAML reads `~`, dates and fractions as neither text nor number.
    if isinstance(given, bool) or not isinstance(given, int | str):
        raise SpecificationError(f"{where}: tasks: give numbers or formulas, found {short(given)}")
    text = str(given)
    is_file = text.endswith(".hoa")
    # Compiled here, so that a wrong task ends the command and not a worker.
    try:
        task = generator.task(str(folder / text) if is_file else given)
    except TaskError as error:
        raise SpecificationError(f"{where}: tasks: {error}") from error
    if not is_file:
        return task.text if text in shipped_tasks() else generator.formula(given)
    name = text if structure_of(task) is None else task.text
    # Over its own propositions, so that it can be read over those of every environment of the sweep.
    automata[name] = read_task(str(folder / text)).to_hoa()
    return name


def _common_config(environments: Sequence[str], where: str) -> TrialConfig:
    """What all environments call for."""
    # Cells of one sweep are shown in one table, so that their settings must not differ without being named.
    configs = {name: trial_config_for(make(name)) for name in environments}
    first = configs[environments[0]]
    for name, config in configs.items():
        if config != first:
            raise SpecificationError(
                f"{where}: environments: trials in {environments[0]} and {name} need different settings, and a sweep "
                "has one; make a sweep of each"
            )
    return first
