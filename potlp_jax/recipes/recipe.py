"""Recipes: everything that makes an estimator, in a file. The shipped estimators' recipes ship with them.

environment: firefighting
training_worlds: 1300           # of the split training
validation_worlds: 60           # of the split validation
collect: {disturbance: {noise: 6}}              # optional: fields of CollectConfig
fit: {epochs: 7, training: {patience: 10}}      # optional: fields of FitConfig
rounds:                         # optional: PO-TLP drives with what was fitted, and all is fitted again
  - {worlds: 300, validation_worlds: 20, epochs: 4}
"""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from potlp_jax.codec import read_settings, settings_file, with_settings
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.errors import ConfigurationError
from potlp_jax.learning.dataset import Samples, joined, read_dataset
from potlp_jax.learning.training import Trained
from potlp_jax.planning.policies import Policy
from potlp_jax.recipes.collection import CollectConfig, Collected, collect, collection_of
from potlp_jax.recipes.fitting import ESTIMATOR, FitConfig, fit
from potlp_jax.recipes.journal import Display

PACKAGE: str = "potlp_jax.recipes"
"""Where the shipped recipes are, as package data."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Round:
    """Once more: PO-TLP drives through new worlds with what was fitted before, and the fit goes on with all records.

    Attributes:
        worlds, validation_worlds: how many further worlds of the splits it drives through. The validation data of the
            round are its own alone: they are of the states that the estimator meets.
        views_per_world, drives: as in ``CollectConfig``.
        epochs: passes over all records of training so far.
    """

    worlds: int
    validation_worlds: int
    views_per_world: int = 24
    drives: int = 2
    epochs: int = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe:
    """What makes an estimator.

    Attributes:
        environment: name of the family of worlds.
        training_worlds, validation_worlds: how many worlds of these splits are explored.
        collect: what is recorded in them.
        fit: what is fitted to the records.
        rounds: are made after that, in order.
    """

    environment: str
    training_worlds: int
    validation_worlds: int
    collect: CollectConfig
    fit: FitConfig = FitConfig()
    rounds: tuple[Round, ...] = ()

    def worlds(self, split: Split) -> int:
        """How many worlds of a split are explored; 0 for the splits that training never sees."""
        # Nothing is learned from worlds of the splits that figures are reported on.
        return {Split.TRAINING: self.training_worlds, Split.VALIDATION: self.validation_worlds}.get(split, 0)


def read_recipe(given: str | Path) -> Recipe:
    """A recipe by the name of a shipped one, or by its file.

    Raises:
        ConfigurationError: there is no such recipe, or a field is missing, unknown or has a value that does not fit.
        WorldError, MapError: the environment cannot be used.
    """
    path = settings_file(given, PACKAGE)
    data = read_settings(path)
    # Before the rest, because without an environment there are no defaults.
    missing = [name for name in ("environment", "training_worlds", "validation_worlds") if name not in data]
    if missing:
        raise ConfigurationError(f"{path}: {', '.join(missing)} is missing")
    # The environment first: what is not said is as its family wants it.
    return with_settings(recipe_for(str(data["environment"])), data, str(path))


def recipe_for(environment: str) -> Recipe:
    """What is recorded and fitted where nothing else is said, for a family of worlds by name; of no worlds yet."""
    collect = collection_of(make(environment))
    # Both numbers are required of a recipe's file; 0 worlds are refused when they are collected.
    return Recipe(environment=environment, training_worlds=0, validation_worlds=0, collect=collect)


def follow(
    recipe: Recipe,
    out: Path,
    processes: int = 1,
    tell: Callable[[Split, Collected], None] = lambda split, collected: None,
    display: Display = Display(),
) -> Trained:
    """Make an estimator from nothing: collect what is missing of the datasets, fit, and do the rounds; or resume.

    Args:
        recipe: what to make.
        out: gets ``training`` and ``validation``, the datasets, and what ``fit`` writes. With rounds these are of the
            last one, and ``round-0`` and so on in it hold those of the stages before.
        processes: explore at the same time.
        tell: called as worlds are explored.
        display: shows how the fits go.

    Returns:
        The best parameters.
    """
    # Each stage has a folder; that of the last one is ``out`` itself.
    folders = [*(out / f"round-{number}" for number in range(len(recipe.rounds))), out]
    worlds = {Split.TRAINING: 0, Split.VALIDATION: 0}
    records: list[Samples] = []
    trained = None
    for number, folder in enumerate(folders):
        stage = _stage(recipe, number, worlds, folders[number - 1] / ESTIMATOR)
        for split, count in stage.worlds.items():
            _collect_of(recipe, stage, split, folder / split.value, processes, partial(tell, split))
            worlds[split] += count
        records.append(read_dataset(folder / Split.TRAINING.value))
        validation = read_dataset(folder / Split.VALIDATION.value)
        initial = folders[number - 1] / ESTIMATOR if number else None
        trained = fit(joined(records), validation, folder, stage.fit, display, initial)
    assert trained is not None
    return trained


@dataclasses.dataclass(frozen=True)
class _Stage:
    """What is collected and fitted at one time: at first, or in a round."""

    worlds: Mapping[Split, int]
    first: Mapping[Split, int]
    collect: CollectConfig
    fit: FitConfig


def _stage(recipe: Recipe, number: int, first: Mapping[Split, int], estimator: Path) -> _Stage:
    """Stage ``number``; from the second on ``estimator`` is what the one before made."""
    if number == 0:
        counts = {split: recipe.worlds(split) for split in first}
        return _Stage(counts, dict(first), recipe.collect, recipe.fit)
    chosen = recipe.rounds[number - 1]
    drives = dataclasses.replace(
        recipe.collect,
        driver=Policy.POTLP.value,
        estimator=str(estimator),
        drives=chosen.drives,
        views_per_world=chosen.views_per_world,
    )
    counts = {Split.TRAINING: chosen.worlds, Split.VALIDATION: chosen.validation_worlds}
    return _Stage(counts, dict(first), drives, dataclasses.replace(recipe.fit, epochs=chosen.epochs))


def _collect_of(
    recipe: Recipe, stage: _Stage, split: Split, folder: Path, processes: int, tell: Callable[[Collected], None]
) -> None:
    config = dataclasses.replace(stage.collect, first_world=stage.first[split])
    collect(make(recipe.environment), recipe.environment, split, stage.worlds[split], folder, config, processes, tell)
