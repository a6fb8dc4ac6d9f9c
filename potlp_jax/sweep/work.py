"""The work of a sweep in units: pure, the same wherever it runs, and without a store.

A unit is a few worlds of one environment with all tasks, for one policy: its trials run as one batch
(``trials.batch``), in which a trial that has ended makes room for the next. Or it is the question in which of a few
worlds a task is possible.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from functools import cached_property, lru_cache
from typing import Any

import jax

from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import world_key
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator, named_estimator
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy, named_policy
from potlp_jax.sweep.rows import trial_row
from potlp_jax.sweep.specification import Specification
from potlp_jax.sweep.store import POSSIBLE, Item, Row
from potlp_jax.task.task import Task, TaskArrays, TaskSizes
from potlp_jax.trials.batch import Finished, Start, run_batch
from potlp_jax.trials.loop import run_trial, versions
from potlp_jax.trials.record import Outcome, Trial
from potlp_jax.trials.rules import estimator_of, trial_key
from potlp_jax.world.grid import World, world_digest

# All policies visit the worlds of a unit soon after each other, and making one may take a second.
_WORLDS_KEPT = 32


@dataclasses.dataclass(frozen=True)
class Unit:
    """Trials of one environment and policy; of the policy ``POSSIBLE`` worlds to examine, with one task.

    Attributes:
        items: at least one.
    """

    items: tuple[Item, ...]

    def pieces(self) -> tuple["Unit", ...]:
        """One unit for each item."""
        return tuple(Unit((item,)) for item in self.items)


@dataclasses.dataclass(frozen=True)
class Examined:
    """Whether a world's task is possible: ``item`` has the policy ``POSSIBLE``."""

    item: Item
    possible: bool


def was_possible(trial: Finished | Trial) -> bool:
    """Whether a task is possible in a world, by the trial there of the policy that knows the map from the start."""
    # One whose known path is longer than the budget is possible all the same, and is charged as any other.
    return trial.outcome is not Outcome.INFEASIBLE


class Work:
    """What a sweep's trials have in common, and how a unit of them is done.

    It goes to other processes, which make worlds and programs anew and keep them.
    """

    def __init__(self, specification: Specification, estimator: TrainedEstimator | Estimator | None = None) -> None:
        self.specification = specification
        name = specification.estimator
        # The estimator itself, because another machine may not have its file.
        self._estimator = estimator if estimator is not None or name is None else named_estimator(name)
        # The caches are this object's own: a family that is defined anew under the same name, as in a notebook, is not
        # mistaken for the old one.
        self._generator = lru_cache(maxsize=None)(make)
        self._world = lru_cache(maxsize=_WORLDS_KEPT)(self._make_world)

    def __reduce__(self) -> tuple[Any, ...]:
        return Work, (self.specification, self._estimator)

    def do(self, unit: Unit) -> Iterator[Row | Examined]:
        """The results of a unit, as they come."""
        environment, policy = unit.items[0].environment, unit.items[0].policy
        if policy == POSSIBLE:
            yield from self.examined(unit.items)
        else:
            yield from self.rows(unit.items, environment, policy)

    def examined(self, items: Iterable[Item]) -> Iterator[Examined]:
        """Whether the planner that knows the map finds a way; the items are of one environment."""
        items = list(items)
        for item, trial in self._trials(items, items[0].environment, Policy.KNOWN_MAP):
            yield Examined(item, was_possible(trial))

    def rows(self, items: Iterable[Item], environment: str, policy: str) -> Iterator[Row]:
        """The rows of trials of one environment and policy, as they end.

        Args:
            items: of that environment and policy.
            environment: by its name.
            policy: by its name.

        Returns:
            A row for each item, in the order in which they end.
        """
        config = self.specification.config_of(policy)
        asked = self.asked(environment, policy)
        for item, trial in self._trials(items, environment, policy):
            world = self._world(environment, item.world)
            # Made again, or from the cache: a batch returns arrays of its own and not the world.
            yield trial_row(item, trial, world, self._key(item.world), config, versions(asked))

    def _trials(self, items: Iterable[Item], environment: str, policy: str) -> Iterator[tuple[Item, Finished]]:
        def start(item: Item) -> Start:
            world = self._world(environment, item.world)
            return Start(world, self._tasks[environment, item.task][1], self._key(item.world), name=item)

        asked = self.asked(environment, policy)
        for trial in run_batch(map(start, items), policy, self.specification.config_of(policy), estimator=asked):
            # A batch hands back the name that `start` gave, whatever it is.
            assert isinstance(trial.name, Item)
            yield trial.name, trial

    def trial(self, item: Item) -> Trial:
        """The whole record of a trial, run or made again."""
        task, arrays = self._tasks[item.environment, item.task]
        return run_trial(
            self._world(item.environment, item.world),
            task,
            item.policy,
            self._key(item.world),
            self.specification.config_of(item.policy),
            environment=f"{item.environment}/{self.specification.split.value}",
            world_number=item.world,
            arrays=arrays,
            estimator=self.asked(item.environment, item.policy),
        )

    def is_of(self, row: Row) -> bool:
        """Whether a row's world is the one that its number means today."""
        return row.world_digest == world_digest(self._world(row.item.environment, row.item.world))

    def generator(self, environment: str) -> Generator:
        """The family of worlds of a name."""
        return self._generator(environment)

    def asked(self, environment: str, policy: str) -> TrainedEstimator | Estimator | None:
        """What a policy asks in the worlds of an environment; None where it asks nothing."""
        # Worlds of a family are alike in what decides whether an estimator serves them: the first stands for all.
        world = self._world(environment, self.specification.first_world)
        here = Domain.of_world(world, self.specification.config.camera)
        return estimator_of(named_policy(policy), world.propositions, here, self._estimator)

    def _make_world(self, environment: str, number: int) -> World:
        generator = self._generator(environment)
        return generator.generate(world_key(self.specification.split, number, generator.name))

    def _key(self, world: int) -> jax.Array:
        """Of all trials in a world: it makes no world, and folded by name it serves planning and sensing."""
        return trial_key(world, self.specification.seed)

    @cached_property
    def _tasks(self) -> dict[tuple[str, str], tuple[Task, TaskArrays]]:
        """Tasks by environment and formula, padded per environment to one size: one compilation serves all."""
        tasks = {
            (cell.environment, cell.task): self.specification.task_of(cell, self._generator(cell.environment))
            for cell in self.specification.cells
        }
        # Sizes differ by environment at most: maps have other shapes there, so that programs differ anyway.
        sizes: dict[str, TaskSizes] = {}
        for (environment, _), task in tasks.items():
            sizes[environment] = sizes.get(environment, task.sizes).union(task.sizes)
        return {key: (task, task.padded(sizes[key[0]])) for key, task in tasks.items()}


def do(work: Work, unit: Unit) -> Iterator[Row | Examined]:
    """``Work.do``, as engines want it: a function of a module."""
    return work.do(unit)
