"""From the words of the command line to tasks, policies, worlds and configurations."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from potlp_jax.cli.output import fail, note
from potlp_jax.environments.base import Generator
from potlp_jax.environments.splits import MAX_INDEX, Split, check_split, default_split, world_key
from potlp_jax.learning.estimator import TrainedEstimator, read_estimator, shipped_estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.task.task import Task, shipped_tasks
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.world.grid import World


def read_task(text: str, propositions: Sequence[str] | None = None, max_positive_literals: int | None = None) -> Task:
    """A task from a .hoa file, the name of a shipped task, or a formula. Raises TaskError."""
    if text.endswith(".hoa"):
        return Task.from_hoa(_read(Path(text)), propositions, max_positive_literals)
    if text in shipped_tasks():
        return Task.from_hoa(Task.shipped(text).to_hoa(), propositions, max_positive_literals)
    return Task.from_formula(text, propositions, max_positive_literals)


def read_environment_task(generator: Generator, text: str) -> Task:
    """A task over the environment's propositions; a number (or name) of the environment's tasks is its formula."""
    formula = generator.tasks.get(text, text)
    if formula.strip().isdigit():
        known = ", ".join(f"{number} ({entry})" for number, entry in generator.tasks.items()) or "none"
        fail(f"the environment has no task {text}; it has: {known}. Or give a formula.")
    if formula in generator.tasks.values():
        return Task.of_formula(formula, generator.propositions)
    return read_task(formula, generator.propositions)


def read_policy(name: str) -> Policy:
    """A policy by name; ``known_map`` is as good as ``known-map``."""
    try:
        return Policy(name.strip().replace("_", "-"))
    except ValueError:
        fail(f"unknown policy {name.strip()!r}; choose from: {', '.join(Policy)}")


def default_policy(generator: Generator) -> Policy:
    """PO-TLP where an estimator is shipped for the environment's propositions, else the baseline, with a note."""
    if shipped_estimator(generator.propositions) is not None:
        return Policy.POTLP
    note(f"no estimator is shipped for {generator.name}: the policy is {Policy.BASELINE}; choose another with --policy")
    return Policy.BASELINE


def read_trained_estimator(path: Path | None) -> TrainedEstimator | None:
    """An estimator from a file; None asks for the shipped one. Raises CheckpointError."""
    return None if path is None else read_estimator(path)


def read_split(name: str | None, generator: Generator) -> Split:
    """A split of worlds by name; None: the environment's default. Raises WorldError where it has no such worlds."""
    if name is None:
        name = default_split(generator.name)
    if name not in list(Split):
        fail(f"unknown split {name!r}; choose from: {', '.join(Split)}")
    check_split(Split(name), generator.name)
    if name == Split.TEST:
        note("worlds of the test split are for reported figures: log this run")
    return Split(name)


def make_world(generator: Generator, split: Split, seed: int) -> World:
    """World number ``seed`` of a split. Raises WorldError where none can be made."""
    if seed > MAX_INDEX:
        fail(f"--seed {seed} is too large; the last world is number {MAX_INDEX}")
    return generator.generate(world_key(split, seed, generator.name))


def trial_config(simulations: int | None, generator: Generator | None = None) -> TrialConfig:
    """What the generator's worlds call for, with another number of simulations if one is given."""
    config = TrialConfig() if generator is None else trial_config_for(generator)
    if simulations is None:
        return config
    search = dataclasses.replace(config.decision.search, simulations=simulations)
    return dataclasses.replace(config, decision=dataclasses.replace(config.decision, search=search))


def _read(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except OSError as error:
        fail(f"{path}: {error.strerror}")
    except UnicodeDecodeError:
        fail(f"{path}: not a text file")
