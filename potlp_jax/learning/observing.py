"""What estimators that remember have in common: a trial shows them panoramas, a decision asks them what they know.

The panorama network (``learning.estimator``) and the building network (``learning.building_estimator``) are two; one of
your own is a pytree with the same fields and methods.
"""

import dataclasses
from typing import Any, Protocol, TypeVar, cast, runtime_checkable

from jaxtyping import Array, Int32, UInt8

from potlp_jax.compiling import jit_by_class
from potlp_jax.planning.estimates import Estimates, Estimator
from potlp_jax.task.task import TaskArrays
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap


@runtime_checkable
class ObservingEstimator(Protocol):
    """An ``Estimator`` that a trial shows what the camera sees: a dataclass that is a pytree.

    Attributes:
        memory: a pytree of arrays, all that changes when something is observed. In a batch of trials each slot has its
            own, and the rest of the estimator is shared.
    """

    memory: Any

    def encode(self, panorama: UInt8[Array, "rows columns 3"]) -> Any:
        """What is to be remembered of a panorama; does not depend on the memory."""
        ...

    def remember(self, seen: Any, belief: BeliefMap, cell: Int32[Array, "2"]) -> "ObservingEstimator":
        """The estimator after an observation.

        Args:
            seen: what ``encode`` made of the panorama.
            belief: the map after the observation.
            cell: where the panorama was taken.

        Returns:
            The same estimator with another memory.
        """
        ...

    def __call__(self, belief: BeliefMap, subgoals: Subgoals, task: TaskArrays) -> Estimates: ...


@runtime_checkable
class AnswersFromPanoramas(Protocol):
    """An estimator whose answers about a subgoal come from one of the panoramas that it was shown."""

    def observations(self, subgoals: Subgoals) -> Int32[Array, " S"]:
        """Number of that panorama for each subgoal, counted from 0 as they were shown; anything where masked. Pure.

        Records keep it for estimators that do not look on the way: a panorama is then that of a decision.
        """
        ...


@runtime_checkable
class LooksOnTheWay(Protocol):
    """An estimator that may be shown what the camera sees on the way; others are shown the panoramas of decisions."""

    @property
    def looks_on_the_way(self) -> bool:
        """Whether it is; the same throughout a trial."""
        ...


@runtime_checkable
class MovesWithMap(Protocol):
    """An estimator that keeps what it remembers where a robot's map outgrows its array; others begin anew there."""

    def moved(self, shape: tuple[int, int], rows: int, columns: int) -> "MovesWithMap":
        """The same estimator for another array of the same map.

        Args:
            shape: rows and columns of that array.
            rows, columns: of it that lie above and to the left of the one before (``world.grid.moved_layer``).

        Returns:
            The estimator; it knows nothing of cells that the array before did not have.
        """
        ...


def looks_on_the_way(estimator: Any) -> bool:
    """Whether an estimator is shown what the camera sees on the way from one decision to the next."""
    return isinstance(estimator, LooksOnTheWay) and estimator.looks_on_the_way


_Count = TypeVar("_Count", int, Int32[Array, ""])


def looks_between(before: _Count, now: _Count, every: int) -> _Count:
    """How often the camera looks on the way, on host or device; this and ``look_step`` alone say when it does.

    Args:
        before, now: cells entered until one decision and until the next, at which it looks in any case.
        every: number of cells, as ``TrialConfig.look_every``.

    Returns:
        The number of looks between; none if it is below 1.
    """
    return (now - before - 1) // every if every else 0 * now


def look_step(before: _Count, number: _Count, every: int) -> _Count:
    """After how many cells entered it looks for time ``number``, counted from 0, after ``before`` and a decision.

    Args:
        before: cells entered until the decision.
        number: of the look, below ``looks_between``.
        every: number of cells, as ``TrialConfig.look_every``.

    Returns:
        Cells entered since the trial's beginning.
    """
    return before + (number + 1) * every


_Observing = TypeVar("_Observing", bound=ObservingEstimator)


@jit_by_class
def observe_panorama(
    estimator: _Observing, panorama: UInt8[Array, "rows columns 3"], belief: BeliefMap, cell: Int32[Array, "2"]
) -> _Observing:
    """The estimator after a panorama.

    Args:
        estimator: before it.
        panorama: red, green and blue, 0 to 255.
        belief: the map after the observation.
        cell: from where it was taken.

    Returns:
        The estimator that remembers it, too.
    """
    # A typing.Self would say that the class stays; checks at run time cannot read it in a protocol.
    return cast(_Observing, estimator.remember(estimator.encode(panorama), belief, cell))


def observations_of(estimator: Estimator | None, subgoals: Subgoals) -> Int32[Array, " S"] | None:
    """Which panorama the estimates of each subgoal come from; None where no single one does."""
    return _observations(estimator, subgoals) if isinstance(estimator, AnswersFromPanoramas) else None


@jit_by_class
def _observations(estimator: AnswersFromPanoramas, subgoals: Subgoals) -> Int32[Array, " S"]:
    return estimator.observations(subgoals)


def with_memory(estimator: _Observing, memory: Any) -> _Observing:
    """The same estimator with another memory."""
    return dataclasses.replace(cast(Any, estimator), memory=memory)
