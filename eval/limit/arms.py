"""What is compared: the planner with different answers, in the same worlds; one trial of each is a row."""

import dataclasses
import enum
import functools
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from typing import Any

from eval.limit.mixed import mixed
from potlp_jax.environments import base
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator, estimator_for, identity_of
from potlp_jax.learning.ideal_observer import ideal_observer
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.rows import source_commit, trial_budget
from potlp_jax.sweep.specification import configuration_hash
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.trials.loop import run_trial, versions
from potlp_jax.trials.record import Outcome, Trial
from potlp_jax.trials.rules import first_estimator, trial_key
from potlp_jax.verify.audit import problems_of
from potlp_jax.world.grid import World, world_digest


class Arm(enum.StrEnum):
    """A policy with its estimates, from those that know most to those that know least."""

    KNOWN_MAP = Policy.KNOWN_MAP.value
    ORACLE = Policy.ORACLE.value
    IDEAL_OBSERVER = "ideal-observer"
    TRUE_CHANCES = "true-chances"
    TRUE_COSTS = "true-costs"
    POTLP = Policy.POTLP.value
    BASELINE = Policy.BASELINE.value

    @property
    def policy(self) -> Policy:
        """By what it plans."""
        own = (Policy.KNOWN_MAP, Policy.BASELINE, Policy.ORACLE)
        return next((policy for policy in own if policy.value == self.value), Policy.POTLP)

    @property
    def asks_trained(self) -> bool:
        """Whether the trained estimator has a part in it."""
        return self in (Arm.TRUE_CHANCES, Arm.TRUE_COSTS, Arm.POTLP)


_KEY = ("environment", "split", "task", "world", "arm", "identity", "world_digest")

REFERENCES = (Arm.KNOWN_MAP, Arm.BASELINE)
"""What shares of the attainable savings are measured from."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """What all trials have in common.

    Attributes:
        generator, split: where the worlds come from.
        tasks: by the name that the family gives them.
        given: the trained estimator; None: the one that is shipped for the worlds.
        buildings: that the ideal observer draws at a decision.
        settings: of the trials; None: those of the family.
    """

    generator: base.Generator
    split: Split
    tasks: Sequence[str]
    given: TrainedEstimator | Estimator | None
    buildings: int
    settings: TrialConfig | None = None

    @functools.cached_property
    def config(self) -> TrialConfig:
        """The settings of all trials."""
        return trial_config_for(self.generator) if self.settings is None else self.settings

    @property
    def arms(self) -> list[Arm]:
        """Those that the family's worlds can have: an ideal observer needs one that says what they can be."""
        # A family that does not has the method of the base class, which refuses.
        says = type(self.generator).posterior is not base.Generator.posterior
        return [arm for arm in Arm if arm is not Arm.IDEAL_OBSERVER or says]

    @functools.cached_property
    def padded(self) -> dict[str, tuple[Task, TaskArrays]]:
        """The tasks, with arrays of one size: one compilation serves all."""
        found = {name: self.generator.task(name) for name in self.tasks}
        sizes = functools.reduce(lambda one, other: one.union(other), (task.sizes for task in found.values()))
        return {name: (task, task.padded(sizes)) for name, task in found.items()}

    def world(self, number: int) -> World:
        """World ``number`` of the split."""
        return _world(self.generator, self.split, number)

    @functools.cached_property
    def trained(self) -> TrainedEstimator | Estimator:
        """The estimator that was given, or the one that is shipped."""
        if self.given is not None and not isinstance(self.given, TrainedEstimator):
            return self.given
        here = Domain.of_world(self.world(0), self.config.camera)
        return estimator_for(self.generator.propositions, here, self.given)

    def identity(self, arm: Arm) -> str:
        """What an arm's answers come from, beside the true map; a row of another identity is another trial."""
        asked = f"{self.buildings} buildings" if arm is Arm.IDEAL_OBSERVER else ""
        asked = identity_of(self.trained) if arm.asks_trained else asked
        return asked if self.settings is None else f"{asked}, settings {configuration_hash(self.settings)}"

    def key(self, task: str, number: int, arm: Arm) -> tuple[Any, ...]:
        """What tells a row from others (``key_of``)."""
        # Two maps may have one name.
        digest = world_digest(self.world(number))
        return (self.generator.name, self.split.value, task, number, arm.value, self.identity(arm), digest)

    def row(self, task: str, number: int, arm: Arm) -> dict[str, Any]:
        """Run a trial, audit it, and say how it went."""
        began = time.perf_counter()
        trial = self.run(task, number, arm)
        seconds = time.perf_counter() - began
        return dict(zip(_KEY, self.key(task, number, arm), strict=True)) | {
            "outcome": trial.outcome.value,
            "cost": trial.cost,
            "budget": trial_budget(self.world(number), self.config.budget_factor),
            "status": trial.status,
            "decisions": len(trial.decisions),
            "fallbacks": sum(decision.fallback for decision in trial.decisions),
            "seconds": seconds,
            "problems": problems_of(trial, self.padded[task][0], self.world(number)),
            "versions": versions(),
            "commit": source_commit(),
        }

    def run(self, name: str, number: int, arm: Arm) -> Trial:
        """One trial of an arm."""
        (task, arrays), world = self.padded[name], self.world(number)
        return run_trial(
            world,
            task,
            arm.policy,
            trial_key(number),
            self.config,
            environment=f"{self.generator.name}/{self.split.value}",
            world_number=number,
            arrays=arrays,
            estimator=self._asked(arm, world, number),
        )

    def _asked(self, arm: Arm, world: World, number: int) -> TrainedEstimator | Estimator | None:
        """What the arm asks in a trial."""
        if arm is Arm.IDEAL_OBSERVER:
            return self._observer(number)
        if not arm.asks_trained:
            return None
        shape, resolution = world.shape, float(world.resolution)
        own = first_estimator(Policy.POTLP, self.trained, shape, resolution, self.config.panoramas, None)
        assert own is not None
        truth = TrueMapEstimator(world=world)
        return {Arm.TRUE_CHANCES: mixed(truth, own), Arm.TRUE_COSTS: mixed(own, truth)}.get(arm, self.trained)

    def _observer(self, number: int) -> Estimator:
        key = world_key(self.split, number, self.generator.name)
        return ideal_observer(self.generator.posterior(key, trial_key(number), self.buildings), self.world(number))


@functools.lru_cache(maxsize=2)
def _world(generator: base.Generator, split: Split, number: int) -> World:
    # All trials in a world come together, so that it need not be made for each.
    return generator.world(number, split)


def key_of(row: dict[str, Any]) -> tuple[Any, ...]:
    """As ``Experiment.key``, of a row that was written."""
    return tuple(row.get(name) for name in _KEY)


def missing_rows(
    experiment: Experiment, arms: Sequence[Arm], worlds: int, found: Sequence[dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """The rows that are not among those found, of each task's first worlds in which it is possible.

    The arms of a world come together, so that what is finished can be compared at any time.

    Args:
        experiment: what all trials have in common.
        arms: to be compared; known map and baseline are always run.
        worlds: of each task.
        found: rows of former runs.

    Yields:
        Each row as soon as its trial has ended.
    """
    known = {key_of(row): row for row in found}
    # The one that knows the map first: it tells whether the task is possible at all.
    others = [arm for arm in Arm if (arm in arms or arm in REFERENCES) and arm is not Arm.KNOWN_MAP]
    last = dict.fromkeys(experiment.tasks, -1)
    for task in list(experiment.tasks) * worlds:
        last[task] = number = yield from _next_possible(experiment, task, last[task] + 1, known)
        for arm in others:
            if experiment.key(task, number, arm) not in known:
                yield experiment.row(task, number, arm)


def _next_possible(
    experiment: Experiment, task: str, number: int, known: Mapping[tuple[Any, ...], Mapping[str, Any]]
) -> Generator[dict[str, Any], None, int]:
    """The first world from ``number`` on in which the task is possible; yields the rows that it takes to find it."""
    row = known.get(experiment.key(task, number, Arm.KNOWN_MAP))
    if row is None:
        row = experiment.row(task, number, Arm.KNOWN_MAP)
        yield dict(row)
    if row["outcome"] == Outcome.SATISFIED.value:
        return number
    return (yield from _next_possible(experiment, task, number + 1, known))
