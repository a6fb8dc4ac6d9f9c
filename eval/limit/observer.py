"""Estimators of the experiment: the ideal observer, and one that takes P_S and the costs from two others."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Int32, PRNGKeyArray, UInt8

from eval.limit.buildings import (
    OCCUPIED,
    SIGNS,
    Evidence,
    Noise,
    Prior,
    code_of,
    draw_buildings,
    draw_noise,
    posterior,
    prior_of,
)
from potlp_jax.environments.firefighting import Firefighting, FirefightingLayout, building_of
from potlp_jax.learning.labels import true_labels
from potlp_jax.learning.observing import ObservingEstimator, looks_on_the_way, with_memory
from potlp_jax.planning.estimates import Estimates, Estimator
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import Status, status_if
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.sensing import SensorConfig, visible


@struct.dataclass(kw_only=True)
class IdealObserver:
    """Answers with the means of the true labels over buildings that agree with all that was seen.

    What was seen: the map, and the tiles and the smoke of every floor cell that has been in line of sight from where a
    panorama was taken, at any distance. It looks on the way, as the trained estimator of buildings does.

    Attributes:
        memory: what the camera showed so far.
        prior: what can be built.
        noise: of the buildings that are drawn.
        truth: codes of the building in which the robot is; read for what is in line of sight, and for nothing else.
        blank: a world of the building's size, which is filled with what is drawn.
    """

    memory: Evidence
    prior: Prior
    noise: Noise
    truth: UInt8[Array, "H W"]
    blank: World

    @property
    def looks_on_the_way(self) -> bool:
        """Always."""
        return True

    def encode(self, panorama: UInt8[Array, "rows columns 3"]) -> None:
        """Nothing: what is in sight is taken from the building, not from pixels."""

    def remember(self, seen: None, belief: BeliefMap, cell: Int32[Array, "2"]) -> "IdealObserver":
        """The observer after a panorama from ``cell``."""
        occupied = self.truth & OCCUPIED > 0
        # The longest line of sight on the grid is shorter than the sum of its sides.
        everywhere = SensorConfig(range_cells=float(sum(occupied.shape)))
        in_sight = self.memory.in_sight | (visible(occupied, cell, everywhere) & ~occupied)
        signs = jnp.where(in_sight, self.truth & SIGNS, 0).astype(jnp.uint8)
        return dataclasses.replace(self, memory=Evidence(in_sight=in_sight, signs=signs))

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
        """Estimates of every real (subgoal, class); ``INVALID`` where no building agrees with what was seen."""
        occupied, letters = draw_buildings(self.prior, belief, self.memory, self.noise)

        def label(building: tuple[Array, Array]) -> Estimates:
            world = dataclasses.replace(self.blank, occupied=building[0], letters=building[1])
            return true_labels(world, belief, subgoals, task)

        # One after the other: labels of one building keep a core busy.
        means = mean_labels(jax.lax.map(label, (occupied, letters)))
        agrees = jnp.sum(posterior(self.prior, belief, self.memory)) > 0.0
        return dataclasses.replace(means, status=status_if(~agrees, Status.INVALID))


def ideal_observer(
    generator: Firefighting, world: World, layout: FirefightingLayout, key: PRNGKeyArray, count: int
) -> IdealObserver:
    """An observer that has seen nothing yet.

    Args:
        generator: that built the world.
        world: in which the robot is.
        layout: of the world.
        key: of the noise.
        count: how many buildings are drawn at a decision.

    Returns:
        The observer of one trial.
    """
    truth = code_of(building_of(generator.config, layout))
    # What the robot does not know must not come in by the world that is filled with what is drawn.
    blank = dataclasses.replace(world, occupied=jnp.ones_like(world.occupied), letters=jnp.zeros_like(world.letters))
    return IdealObserver(
        memory=Evidence(in_sight=jnp.zeros(world.shape, bool), signs=jnp.zeros(world.shape, jnp.uint8)),
        prior=prior_of(generator.config, layout.robot_room),
        noise=draw_noise(key, count, world.shape),
        truth=jnp.asarray(truth),
        blank=blank,
    )


def mean_labels(labels: Estimates) -> Estimates:
    """Means of labels that have one axis more in front: R_S of those that succeed, R_F of those that fail (Eq. 3).

    Where none succeeds, R_S is the least of the labels' R_S, and where none fails R_F the mean of all: P_S is 0 or 1,
    and neither is used.
    """
    success = labels.success_probability
    succeeded, failed = jnp.sum(success, axis=0), jnp.sum(1.0 - success, axis=0)
    success_cost = jnp.sum(success * labels.success_cost, axis=0) / jnp.maximum(succeeded, 1.0)
    failure_cost = jnp.sum((1.0 - success) * labels.failure_cost, axis=0) / jnp.maximum(failed, 1.0)
    return Estimates(
        success_probability=jnp.mean(success, axis=0),
        success_cost=jnp.where(succeeded > 0.0, success_cost, jnp.min(labels.success_cost, axis=0)),
        failure_cost=jnp.where(failed > 0.0, failure_cost, jnp.mean(labels.failure_cost, axis=0)),
    )


@struct.dataclass(kw_only=True)
class MixedEstimator:
    """P_S of one estimator with the costs of another. Either may observe.

    An estimator that is certain has one cost alone: no R_S of what it takes for impossible, and no R_F of what it takes
    for certain (true labels have an R_F there, of a failure that cannot be). There the costs are those of the first.

    Attributes:
        chances, costs: as they were at the start of the trial.
        memory: what each of them remembers; None of one that does not observe.
    """

    chances: Any
    costs: Any
    memory: tuple[Any, Any]

    @property
    def looks_on_the_way(self) -> bool:
        """Whether one of them does; the other is shown the same."""
        return any(looks_on_the_way(part) for part in (self.chances, self.costs))

    def encode(self, panorama: UInt8[Array, "rows columns 3"]) -> tuple[Any, Any]:
        """What each of them is to remember of a panorama."""
        return _encode(self.chances, panorama), _encode(self.costs, panorama)

    def remember(self, seen: tuple[Any, Any], belief: BeliefMap, cell: Int32[Array, "2"]) -> "MixedEstimator":
        """Both after a panorama."""
        after = (_memory(_remember(part, one, belief, cell)) for part, one in zip(self._parts(), seen, strict=True))
        return dataclasses.replace(self, memory=tuple(after))

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
        """The estimates of both, joined; with the status of both."""
        first, second = (part(belief, subgoals, task) for part in self._parts())
        given = [found.status for found in (first, second) if found.status is not None]
        return Estimates(
            success_probability=first.success_probability,
            success_cost=jnp.where(second.success_probability > 0.0, second.success_cost, first.success_cost),
            failure_cost=jnp.where(second.success_probability < 1.0, second.failure_cost, first.failure_cost),
            status=functools.reduce(jnp.bitwise_or, given) if given else None,
        )

    def _parts(self) -> tuple[Estimator, Estimator]:
        """Both with what they remember now."""
        first, second = self.memory
        return _with(self.chances, first), _with(self.costs, second)


def mixed(chances: Estimator, costs: Estimator) -> MixedEstimator:
    """An estimator with the P_S of one and the R_S and R_F of another, both at the start of a trial."""
    return MixedEstimator(chances=chances, costs=costs, memory=(_memory(chances), _memory(costs)))


def _memory(part: Estimator) -> Any:
    return part.memory if isinstance(part, ObservingEstimator) else None


def _with(part: Estimator, memory: Any) -> Estimator:
    return with_memory(part, memory) if isinstance(part, ObservingEstimator) else part


def _encode(part: Estimator, panorama: UInt8[Array, "rows columns 3"]) -> Any:
    return part.encode(panorama) if isinstance(part, ObservingEstimator) else None


def _remember(part: Estimator, seen: Any, belief: BeliefMap, cell: Int32[Array, "2"]) -> Estimator:
    return part.remember(seen, belief, cell) if isinstance(part, ObservingEstimator) else part
