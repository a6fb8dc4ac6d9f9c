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
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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

TIMES: str = "times.csv"
"""In the folder of a recipe that is followed: the stage, its step, and how many seconds a run spent on it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Round:
    """Once more: PO-TLP drives through new worlds with what was fitted before, and the fit goes on with all records.

    Attributes:
        worlds, validation_worlds: how many further worlds of the splits it drives through. The validation data of the
            round are its own alone: they are of the states that the estimator meets.
        explored: how many further worlds are recorded as at first. Drives cost much more than exploration, and more
            buildings keep a network from learning those that it has seen by heart.
        views_per_world, drives, pursued: as in ``CollectConfig``.
        epochs: passes over all records of training so far.
    """

    worlds: int
    validation_worlds: int
    explored: int = 0
    pursued: int = CollectConfig.pursued
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
            last one, and ``round-0`` and so on in it hold those of the stages before. ``times.csv`` says how long each
            step took; who resumes finds a line for each run that ended a step, and none for one that was killed.
        processes: explore at the same time.
        tell: called as worlds are explored.
        display: shows how the fits go.

    Returns:
        The best parameters.
    """
    # Each stage has a folder; that of the last one is ``out`` itself.
    folders = [*(out / f"round-{number}" for number in range(len(recipe.rounds))), out]
    records: list[Samples] = []
    trained = None
    for number, (folder, stage) in enumerate(zip(folders, _stages(recipe, folders), strict=True)):
        for part in stage.parts:
            config = dataclasses.replace(part.config, first_world=part.first)
            generator, name = make(recipe.environment), recipe.environment
            with _timed(out, number, part.name):
                into, told = folder / part.name, partial(tell, part.split)
                collect(generator, name, part.split, part.worlds, into, config, processes, told)
        records += [read_dataset(folder / part.name) for part in stage.parts if part.split == Split.TRAINING]
        validation = read_dataset(folder / Split.VALIDATION.value)
        initial = folders[number - 1] / ESTIMATOR if number else None
        with _timed(out, number, "fit"):
            trained = fit(joined(records), validation, folder, stage.fit, display, initial)
    assert trained is not None
    return trained


@contextmanager
def _timed(out: Path, stage: int, step: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    out.mkdir(parents=True, exist_ok=True)
    with (out / TIMES).open("a", encoding="utf-8") as file:
        file.write(f"{stage},{step},{time.perf_counter() - began:.1f}\n")


@dataclasses.dataclass(frozen=True)
class _Part:
    """One collection: its folder's name, the split, the first world and how many, and what is recorded."""

    name: str
    split: Split
    first: int
    worlds: int
    config: CollectConfig


@dataclasses.dataclass(frozen=True)
class _Stage:
    """What is collected and fitted at one time: at first, or in a round."""

    parts: tuple[_Part, ...]
    fit: FitConfig


def _stages(recipe: Recipe, folders: Sequence[Path]) -> Iterator[_Stage]:
    """The stages in order; worlds are counted through all of them, so that none is recorded twice."""
    splits: tuple[Split, ...] = (Split.TRAINING, Split.VALIDATION)
    next_world: dict[Split, int] = dict.fromkeys(splits, recipe.collect.first_world)

    def part(name: str, split: Split, worlds: int, config: CollectConfig) -> _Part:
        first = next_world[split]
        next_world[split] += worlds
        return _Part(name, split, first, worlds, config)

    yield _Stage(tuple(part(split.value, split, recipe.worlds(split), recipe.collect) for split in splits), recipe.fit)
    for number, chosen in enumerate(recipe.rounds):
        driven = dataclasses.replace(
            recipe.collect,
            driver=Policy.POTLP.value,
            estimator=str(folders[number] / ESTIMATOR),
            drives=chosen.drives,
            views_per_world=chosen.views_per_world,
        )
        counts = {Split.TRAINING: chosen.worlds, Split.VALIDATION: chosen.validation_worlds}
        parts = [part(split.value, split, counts[split], driven) for split in splits]
        if chosen.explored:
            changes = {"pursued": chosen.pursued, "views_per_world": chosen.views_per_world}
            explored = dataclasses.replace(recipe.collect, **changes)
            parts.append(part("explored", Split.TRAINING, chosen.explored, explored))
        yield _Stage(tuple(parts), dataclasses.replace(recipe.fit, epochs=chosen.epochs))
