"""From the words of the command line to policies, worlds, stores and configurations.

Imports the library, so commands import this module inside of their functions.
"""

import dataclasses
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from potlp_jax.cli.output import fail
from potlp_jax.environments.base import Generator
from potlp_jax.environments.splits import MAX_INDEX, Split, check_split, default_split, world_key
from potlp_jax.learning.estimator import TrainedEstimator, read_estimator, shipped_estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.store import Store
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.world.grid import World

logger = logging.getLogger(__name__)

RECORD: str = "trial.json"
"""Name of the record in a folder that ``potlp run --out`` wrote."""


def read_names(text: str | None) -> list[str] | None:
    """Names joined by commas; None stays None."""
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def record_file(trial: Path) -> Path:
    """The record of a trial that is named by its file or by its folder."""
    return trial / RECORD if trial.is_dir() else trial


def read_policy(name: str) -> Policy:
    """A policy by name; ``known_map`` is as good as ``known-map``."""
    try:
        return Policy(name.strip().replace("_", "-"))
    except ValueError:
        fail(f"unknown policy {name.strip()!r}; choose from: {', '.join(Policy)}")


def default_policy(generator: Generator) -> Policy:
    """PO-TLP where an estimator is shipped for the environment's propositions, otherwise the baseline, with a note."""
    if shipped_estimator(generator.propositions) is not None:
        return Policy.POTLP
    logger.warning(
        f"no estimator is shipped for {generator.name}: the policy is {Policy.BASELINE}; choose another with --policy"
    )
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
        warn_of_test_worlds()
    return Split(name)


def warn_of_test_worlds() -> None:
    """Say that a run on the test split counts (`environments.splits`)."""
    logger.warning("worlds of the test split are for reported figures: log this run")


def make_world(generator: Generator, split: Split, number: int) -> World:
    """World ``number`` of a split. Raises WorldError where none can be made."""
    if number > MAX_INDEX:
        fail(f"--world {number} is too large; the last world is number {MAX_INDEX}")
    return generator.generate(world_key(split, number, generator.name))


def trial_config(simulations: int | None, generator: Generator | None = None) -> TrialConfig:
    """What the generator's worlds call for, with another number of simulations if one is given."""
    config = TrialConfig() if generator is None else trial_config_for(generator)
    if simulations is None:
        return config
    search = dataclasses.replace(config.decision.search, simulations=simulations)
    return dataclasses.replace(config, decision=dataclasses.replace(config.decision, search=search))


@contextmanager
def open_store(folder: Path) -> Iterator[Store]:
    """The store of a sweep that has been begun, closed at the end."""
    if not (folder / RESULTS).is_file():
        fail(
            f"{folder}: there is no sweep in here (no {RESULTS}); begin one with `potlp sweep FILE.yaml --out {folder}`"
        )
    store = Store(folder / RESULTS)
    try:
        yield store
    finally:
        store.close()
