"""An estimator of the experiment that takes P_S and the costs from two others."""

import dataclasses
import functools
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Int32, UInt8

from potlp_jax.learning.observing import ObservingEstimator, looks_on_the_way, with_memory
from potlp_jax.planning.estimates import Estimates, Estimator
from potlp_jax.task.task import TaskArrays
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap


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
