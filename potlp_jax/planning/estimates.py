"""What an estimator answers: how each outcome class fares beyond each subgoal."""

from typing import Protocol, runtime_checkable

from flax import struct
from jaxtyping import Array, Float32

from potlp_jax.task.task import TaskArrays
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap


@struct.dataclass(kw_only=True)
class Estimates:
    """P_S, R_S and R_F of Bradley et al. 2021, Eq. 3, once per (subgoal, outcome class).

    Costs are in the unit of the map's resolution. ``success_cost`` is positive everywhere, also where
    ``success_probability`` is 0 and it means nothing.
    """

    success_probability: Float32[Array, "*batch S C"]
    success_cost: Float32[Array, "*batch S C"]
    failure_cost: Float32[Array, "*batch S C"]


@runtime_checkable
class Estimator(Protocol):
    """A pytree that can be called inside jit: the true map, or a network with its parameters."""

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates: ...
