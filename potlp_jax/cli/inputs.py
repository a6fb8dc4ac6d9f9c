"""From the words of the command line to policies, worlds, stores and configurations.

Imports the library, so commands import this module inside of their functions.
"""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from potlp_jax.cli.completion import SEARCHES
from potlp_jax.cli.output import fail
from potlp_jax.codec import with_settings
from potlp_jax.environments.base import Generator
from potlp_jax.environments.splits import MAX_INDEX, Split, check_split, default_split, world_key
from potlp_jax.learning.estimator import TrainedEstimator, named_estimator
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.store import Store
from potlp_jax.trials import run
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.world.grid import World

logger = logging.getLogger(__name__)

RECORD: str = "trial.json"
"""Name of the record in a folder that ``potlp run --out`` wrote."""


def read_names(text: str | None) -> list[str] | None:
    """Names joined by commas; None stays None."""
    # `a,,b` and `a, b,` are slips of the finger and mean what they seem to mean.
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def record_file(trial: Path) -> Path:
    """The record of a trial that is named by its file or by its folder."""
    return trial / RECORD if trial.is_dir() else trial


def default_policy_with_note(
    world: World, config: TrialConfig, given: TrainedEstimator | Estimator | None = None
) -> Policy:
    """PO-TLP where an estimator is given or shipped for such worlds, otherwise the baseline, with a note."""
    policy = run.default_policy(world, config, given)
    if policy is not Policy.POTLP:
        reason = run.reason_for_baseline(world, config)
        logger.warning(f"{reason}: the policy is {policy}; choose another with --policy, or an --estimator")
    return policy


def read_estimator(name: str | None) -> TrainedEstimator | Estimator | None:
    """An estimator by name; None asks for the shipped one. Raises EstimatorError or PluginError."""
    return None if name is None else named_estimator(name)


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
    """One world.

    Args:
        generator: its family.
        split: from which split.
        number: within the split, from 0.

    Returns:
        The world, the same on every machine.

    Raises:
        WorldError: none can be made.
    """
    # Checked here as well as in `world_key`, to name the option that was wrong.
    if number > MAX_INDEX:
        fail(f"--world {number} is too large; the last world is number {MAX_INDEX}")
    return generator.generate(world_key(split, number, generator.name))


def setting_changes(
    *, simulations: int | None = None, search: str | None = None, camera: str | None = None
) -> dict[str, Any]:
    """What the options change of the settings of a trial, as a sweep's file would say it.

    Args:
        simulations: per decision; None: as the search has by default.
        search: ``best-first`` or ``uct``; None: the first.
        camera: name of a renderer; None: the shipped one.

    Returns:
        Nested settings for ``trial_config``, or for a sweep's ``settings``.
    """
    if search is not None and search not in SEARCHES:
        fail(f"unknown search {search!r}; choose from: {', '.join(SEARCHES)}")
    searching = {name: value for name, value in (("kind", search), ("simulations", simulations)) if value is not None}
    changes: dict[str, Any] = {"decision": {"search": searching}} if searching else {}
    return changes if camera is None else {**changes, "camera": {"renderer": camera}}


def trial_config(changes: Mapping[str, Any], generator: Generator | None = None) -> TrialConfig:
    """Settings of a trial: what the generator's worlds call for (None: the defaults), with some of them changed."""
    config = TrialConfig() if generator is None else trial_config_for(generator)
    return with_settings(config, changes)


@contextmanager
def open_store(folder: Path) -> Iterator[Store]:
    """The store of a sweep that has been begun, closed at the end."""
    if folder.is_file():
        fail(f"{folder}: is a file; give the folder of the sweep")
    # Asked first, because opening a store makes one where there is none.
    if not (folder / RESULTS).is_file():
        fail(
            f"{folder}: there is no sweep in here (no {RESULTS}); begin one with `potlp sweep FILE.yaml --out {folder}`"
        )
    store = Store(folder / RESULTS, read_only=True)
    try:
        yield store
    finally:
        store.close()
