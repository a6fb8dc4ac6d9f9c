"""Recipes: everything that makes an estimator, in a file. Some ship, one by the name of each shipped estimator.

environment: firefighting
training_worlds: 1300           # of the split training
validation_worlds: 60           # of the split validation
collect: {disturbance: {noise: 6}}              # optional: fields of CollectConfig
fit: {epochs: 7, training: {patience: 10}}      # optional: fields of FitConfig
beside:                         # optional: training worlds of other families that look alike
  - {environment: campus-small, share: 0.5}
rounds:                         # optional: PO-TLP drives with what was fitted, and all is fitted again
  - {worlds: 300, validation_worlds: 20, epochs: 4}
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from potlp_jax.checks import POSITIVE, require_fields
from potlp_jax.codec import read_settings, settings_file, with_settings
from potlp_jax.engine.opening import open_engine
from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import ConfigurationError
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.dataset_reading import joined, read_dataset
from potlp_jax.learning.domain import unit_of
from potlp_jax.learning.training import Trained
from potlp_jax.planning.policies import Policy
from potlp_jax.recipes.collection import CollectConfig, Collected, collect, collection_of, whole_shards
from potlp_jax.recipes.fitting import ESTIMATOR, FitConfig, fit
from potlp_jax.recipes.journal import Display
from potlp_jax.recipes.times import TIMES, Times

PACKAGE: str = "potlp_jax.recipes"
"""Where the shipped recipes are, as package data."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Explored:
    """Worlds that are recorded in a round as at first, by the robot that wanders.

    Drives cost much more than exploration, and more buildings keep a network from learning those that it has seen by
    heart.

    Attributes:
        worlds: how many further worlds of the split.
        pursued: as in ``CollectConfig``.
        views_per_world, spacing: as in ``CollectConfig``; None: as in the round. Few views close to each other are of
            the first steps, where a trial chooses among all that there is, and cost little.
    """

    worlds: int = 0
    pursued: int = CollectConfig.pursued
    views_per_world: int | None = None
    spacing: tuple[float, float] | None = None

    def of_round(self, collect: CollectConfig) -> CollectConfig:
        """What is recorded, in a round that records this in its drives."""
        return _where_said(collect, self, ("views_per_world", "spacing"), pursued=self.pursued)


def _where_said(collect: CollectConfig, part: Any, names: Sequence[str], **changes: Any) -> CollectConfig:
    """A collection with the fields of ``part`` that are not None, and with further changes."""
    said = {name: value for name in names if (value := getattr(part, name)) is not None}
    return dataclasses.replace(collect, **said, **changes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Round:
    """Once more: PO-TLP drives through new worlds with what was fitted before, and the fit goes on with all records.

    Attributes:
        worlds, validation_worlds: how many further worlds of the splits it drives through. The validation data of the
            round are its own alone: they are of the states that the estimator meets.
        explored: worlds that are recorded beside those of the drives.
        views_per_world, drives: as in ``CollectConfig``.
        posterior, look_every, spacing: as in ``CollectConfig``; None: as in the recipe's own collection.
        alone: whether records of the stages before are left from here on, as worth less: of other states, or with
            labels of single buildings where those of the round are means.
        epochs: passes over all records of training so far that are not left.
    """

    worlds: int
    validation_worlds: int
    explored: Explored = Explored()
    views_per_world: int = 24
    drives: int = 2
    posterior: int | None = None
    look_every: int | None = None
    spacing: tuple[float, float] | None = None
    alone: bool = False
    epochs: int = 4

    def of_collection(self, collect: CollectConfig) -> CollectConfig:
        """What a round records: as ``collect`` does where the round says nothing else."""
        return _where_said(collect, self, ("posterior", "look_every", "spacing"), views_per_world=self.views_per_world)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Beside:
    """Another family of worlds, from which an estimator learns as well; validation has none of them.

    Attributes:
        environment: its name; what the worlds look like and what there is to find must be as in the recipe's own.
        share: training worlds of it for each of the recipe's own, when they are explored and when they are driven.
    """

    environment: str
    share: float

    def __post_init__(self) -> None:
        require_fields(self, ["share"], POSITIVE, ConfigurationError)

    def worlds(self, own: int, per_shard: int) -> int:
        """How many training worlds of it stand beside ``own`` of the recipe's, in whole shards."""
        return math.ceil(own * self.share / per_shard) * per_shard


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe:
    """What makes an estimator.

    Attributes:
        environment: name of the family of worlds.
        training_worlds, validation_worlds: how many worlds of these splits are explored.
        collect: what is recorded in them.
        fit: what is fitted to the records.
        rounds: are made after that, in order.
        beside: other families, training worlds of which are recorded as well, in every stage.
    """

    environment: str
    training_worlds: int
    validation_worlds: int
    collect: CollectConfig
    fit: FitConfig = FitConfig()
    rounds: tuple[Round, ...] = ()
    beside: tuple[Beside, ...] = ()

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
    recipe = with_settings(recipe_for(str(data["environment"])), data, str(path))
    _require_alike(recipe, str(path))
    return recipe


def _require_alike(recipe: Recipe, where: str) -> None:
    """Before anything is collected: data sets that differ in this cannot be joined."""
    named = Counter(chosen.environment for chosen in recipe.beside)
    # Of each there is one folder in a stage.
    if twice := [environment for environment, count in named.items() if count > 1]:
        raise ConfigurationError(
            f"{where}: {twice[0]} stands beside {recipe.environment} twice: give one share for both"
        )
    own = make(recipe.environment)
    for chosen in recipe.beside:
        other = make(chosen.environment)
        mine, its = ((generator.family or generator.name, generator.propositions) for generator in (own, other))
        if mine != its:
            raise ConfigurationError(
                f"{where}: {chosen.environment} cannot stand beside {recipe.environment}: its worlds are of "
                f"{its[0]} with {', '.join(its[1])}, and not of {mine[0]} with {', '.join(mine[1])}"
            )
        mine, its = _resolution(own), _resolution(other)
        if mine != its:
            raise ConfigurationError(
                f"{where}: {chosen.environment} cannot stand beside {recipe.environment}: its cells measure {its:g} "
                f"{unit_of(its)}, and not {mine:g} {unit_of(mine)}"
            )


def _resolution(generator: Generator) -> float:
    """The side of a cell, which all worlds of a family share, as data sets have it."""
    return float(generator.generate(world_key(Split.TRAINING, 0, generator.name)).resolution)


def recipe_for(environment: str) -> Recipe:
    """What is recorded and fitted where nothing else is said, for a family of worlds by name; of no worlds yet."""
    collect = collection_of(make(environment))
    # Both numbers are required of a recipe's file; 0 worlds are refused when they are collected.
    return Recipe(environment=environment, training_worlds=0, validation_worlds=0, collect=collect)


def follow(
    recipe: Recipe,
    out: Path,
    processes: int | None = 1,
    cluster: str | None = None,
    tell: Callable[[Split, Collected], None] = lambda split, collected: None,
    display: Display = Display(),
) -> Trained:
    """Make an estimator from nothing: collect what is missing of the datasets, fit, and do the rounds; or resume.

    Args:
        recipe: what to make.
        out: gets ``training`` and ``validation``, the datasets, and what ``fit`` writes. With rounds these are of the
            last one, and ``round-0`` and so on in it hold those of the stages before. ``times.csv`` says how long each
            step took, in all runs together.
        processes, cluster: where worlds are explored and driven through (``engine.opening.open_engine``).
        tell: called as worlds are explored.
        display: shows how the fits go.

    Returns:
        The best parameters.
    """
    # Each stage has a folder; that of the last one is ``out`` itself.
    folders = [*(out / f"round-{number}" for number in range(len(recipe.rounds))), out]
    records: list[Samples] = []
    times = Times(out / TIMES)
    trained = None
    # All of them before anything is collected: what is wrong with a round is said at once, and not hours later.
    stages = list(_stages(recipe, folders))
    for number, (folder, stage) in enumerate(zip(folders, stages, strict=True)):
        # Let go of before the fit, which wants all cores and their memory.
        with open_engine(processes, cluster) as engine:
            for part in stage.parts:
                config = dataclasses.replace(part.config, first_world=part.first)
                into, told = folder / part.name, partial(tell, part.split)
                with times.of(number, part.name):
                    generator = make(part.environment)
                    collect(generator, part.environment, part.split, part.worlds, into, config, engine, told)
        if stage.alone:
            records.clear()
        records += [read_dataset(folder / part.name) for part in stage.parts if part.split == Split.TRAINING]
        validation = read_dataset(folder / Split.VALIDATION.value)
        initial = folders[number - 1] / ESTIMATOR if number else None
        with times.of(number, "fit"):
            trained = fit(joined(records), validation, folder, stage.fit, display, initial)
    assert trained is not None
    return trained


@dataclasses.dataclass(frozen=True)
class _Part:
    """One collection: its folder's name, the worlds' family and split, the first and how many, and what is recorded."""

    name: str
    environment: str
    split: Split
    first: int
    worlds: int
    config: CollectConfig


@dataclasses.dataclass(frozen=True)
class _Stage:
    """What is collected and fitted at one time: at first, or in a round."""

    parts: tuple[_Part, ...]
    fit: FitConfig
    alone: bool = False


class _Parts:
    """Makes the parts of a recipe; worlds are counted through all stages, so that none is recorded twice."""

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        self._usual_sensor = collection_of(make(recipe.environment)).explorer.sensor
        self._taken: Counter[tuple[str, Split]] = Counter()

    def of_own(self, name: str, split: Split, worlds: int, config: CollectConfig) -> _Part:
        """Of the recipe's own family."""
        return self._part(name, self._recipe.environment, split, worlds, config)

    def of_others(self, name: str, worlds: int, config: CollectConfig) -> Iterator[_Part]:
        """Training worlds of the families beside it, where there are so many of its own."""
        for chosen in self._recipe.beside:
            # Subgoals and the sensor as the trials of the family have them; a sensor that the recipe names is for all.
            usual = collection_of(make(chosen.environment))
            named = config.explorer.sensor != self._usual_sensor
            sensor = config.explorer.sensor if named else usual.explorer.sensor
            explorer = dataclasses.replace(config.explorer, frontiers=usual.frontiers, sensor=sensor)
            own = dataclasses.replace(config, frontiers=usual.frontiers, explorer=explorer)
            count = chosen.worlds(worlds, config.worlds_per_shard)
            yield self._part(f"{name}-{chosen.environment}", chosen.environment, Split.TRAINING, count, own)

    def _part(self, name: str, environment: str, split: Split, worlds: int, config: CollectConfig) -> _Part:
        first = self._recipe.collect.first_world + self._taken[environment, split]
        self._taken[environment, split] += worlds
        whole_shards(worlds, config.worlds_per_shard)
        return _Part(name, environment, split, first, worlds, config)


def _stages(recipe: Recipe, folders: Sequence[Path]) -> Iterator[_Stage]:
    """The stages in order."""
    training, validation = Split.TRAINING, Split.VALIDATION
    parts = _Parts(recipe)

    def recorded(config: CollectConfig, worlds: int, validation_worlds: int) -> Iterator[_Part]:
        yield parts.of_own(training.value, training, worlds, config)
        yield parts.of_own(validation.value, validation, validation_worlds, config)
        yield from parts.of_others(training.value, worlds, config)

    yield _Stage(tuple(recorded(recipe.collect, recipe.training_worlds, recipe.validation_worlds)), recipe.fit)
    for number, chosen in enumerate(recipe.rounds):
        own = chosen.of_collection(recipe.collect)
        estimator = str(folders[number] / ESTIMATOR)
        driven = dataclasses.replace(own, driver=Policy.POTLP.value, estimator=estimator, drives=chosen.drives)
        collected = list(recorded(driven, chosen.worlds, chosen.validation_worlds))
        if chosen.explored.worlds:
            explored = chosen.explored.of_round(own)
            collected.append(parts.of_own("explored", training, chosen.explored.worlds, explored))
            collected.extend(parts.of_others("explored", chosen.explored.worlds, explored))
        yield _Stage(tuple(collected), dataclasses.replace(recipe.fit, epochs=chosen.epochs), chosen.alone)
