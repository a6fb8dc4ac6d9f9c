"""Recipes: everything that makes an estimator, in a file. The shipped estimators' recipes ship with them.

environment: firefighting
training_worlds: 1300           # of the split training
validation_worlds: 60           # of the split validation
collect: {disturbance: {noise: 6}}              # optional: fields of CollectConfig
fit: {epochs: 7, training: {patience: 10}}      # optional: fields of FitConfig
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

from potlp_jax.codec import read_settings, settings_file, with_settings
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.errors import ConfigurationError
from potlp_jax.learning.dataset import read_dataset
from potlp_jax.learning.training import Trained
from potlp_jax.recipes.collection import CollectConfig, Collected, collect, collection_of
from potlp_jax.recipes.fitting import FitConfig, fit
from potlp_jax.recipes.journal import Display

PACKAGE: str = "potlp_jax.recipes"
"""Where the shipped recipes are, as package data."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe:
    """What makes an estimator.

    Attributes:
        environment: name of the family of worlds.
        training_worlds, validation_worlds: how many worlds of these splits are explored.
        collect: what is recorded in them.
        fit: what is fitted to the records.
    """

    environment: str
    training_worlds: int
    validation_worlds: int
    collect: CollectConfig
    fit: FitConfig = FitConfig()

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
    """Make an estimator from nothing: collect what is missing of both datasets, then fit, or resume.

    Args:
        recipe: what to make.
        out: gets ``training`` and ``validation``, the datasets, and what ``fit`` writes.
        processes: explore at the same time.
        tell: called as worlds are explored.
        display: shows how the fit goes.

    Returns:
        The best parameters.
    """
    # Both before the fit: it is refused early if the validation worlds cannot be made.
    generator = make(recipe.environment)
    for split in (Split.TRAINING, Split.VALIDATION):
        collect(
            generator,
            recipe.environment,
            split,
            recipe.worlds(split),
            out / split.value,
            recipe.collect,
            processes,
            partial(tell, split),
        )
    training, validation = (read_dataset(out / split.value) for split in (Split.TRAINING, Split.VALIDATION))
    return fit(training, validation, out, recipe.fit, display)
