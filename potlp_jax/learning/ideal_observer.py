"""The ideal observer: an estimator that knows how buildings are made, and answers by all that its robot may be in.

It is the limit of what an estimator can know. In training its answers can be the labels (``recipes.collection``): means
in place of the answers of the one building in which the robot is, which depend on much that nobody can see. A network
that minimises the loss comes to the same answers with either, and sooner with the means, which have less noise.
"""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Int32, UInt8

from potlp_jax.environments.posterior import Posterior
from potlp_jax.learning.labels import labels_in
from potlp_jax.planning.estimates import Estimates
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import Status, status_if
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap, World


@struct.dataclass(kw_only=True)
class IdealObserver:
    """Answers with the means of the true labels over buildings that agree with all that was seen.

    It looks on the way, as the trained estimator of buildings does.

    Attributes:
        memory: what the camera showed so far.
        prior: what the building can be to a robot that has seen nothing.
        blank: a world of the building's size, which is filled with what is drawn.
        nearest: whether in each building only the nearest ways to a class count (``labels.nearest_ways``).
    """

    memory: Any
    prior: Posterior
    blank: World
    nearest: bool = struct.field(pytree_node=False, default=False)

    @property
    def looks_on_the_way(self) -> bool:
        """Always."""
        return True

    @property
    def posterior(self) -> Posterior:
        """What the building can be, given what the camera showed so far."""
        return dataclasses.replace(cast(Any, self.prior), evidence=self.memory)

    def encode(self, panorama: UInt8[Array, "rows columns 3"]) -> None:
        """Nothing: what is in sight is taken from the building, not from pixels."""

    def remember(self, seen: None, belief: BeliefMap, cell: Int32[Array, "2"]) -> "IdealObserver":
        """The observer after a panorama from ``cell``."""
        return dataclasses.replace(self, memory=self.posterior.after(cell).evidence)

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates:
        """Estimates of every real (subgoal, class); ``INVALID`` where no building agrees with what was seen."""
        drawn = self.posterior.draw(belief)

        def label(building: tuple[Array, Array]) -> Estimates:
            world = dataclasses.replace(self.blank, occupied=building[0], letters=building[1])
            return labels_in(world, belief, subgoals, task, nearest=self.nearest)

        # One after the other: labels of one building keep a core busy.
        means = mean_labels(jax.lax.map(label, (drawn.occupied, drawn.letters)))
        return dataclasses.replace(means, status=status_if(~drawn.agrees, Status.INVALID))


def ideal_observer(posterior: Posterior, world: World, *, nearest: bool = False) -> IdealObserver:
    """An observer of a world.

    Args:
        posterior: what the world can be to a robot that has seen nothing (``Generator.posterior``).
        world: in which the robot is.
        nearest: as ``IdealObserver.nearest``.

    Returns:
        The observer of one trial, or of one drive.
    """
    # What the robot does not know must not come in by the world that is filled with what is drawn.
    blank = dataclasses.replace(world, occupied=jnp.ones_like(world.occupied), letters=jnp.zeros_like(world.letters))
    return IdealObserver(memory=posterior.evidence, prior=posterior, blank=blank, nearest=nearest)


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
