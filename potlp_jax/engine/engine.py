"""What an engine is, and the one that works in this process."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol, TypeVar, runtime_checkable

Shared = TypeVar("Shared")
Unit = TypeVar("Unit")
Result = TypeVar("Result")

MOST_KILLED: int = 3
"""Workers that a unit may kill before it is given up."""


@dataclasses.dataclass(frozen=True)
class Broken:
    """In place of a unit's results: it was given up, because every worker that began it died.

    Attributes:
        error: what is known of it.
    """

    error: str


@runtime_checkable
class Engine(Protocol):
    """Runs units of work."""

    @property
    def workers(self) -> int:
        """How many work at the same time, now: they may join and leave."""
        ...

    def run(
        self, work: Callable[[Any, Any], Iterable[Any]], shared: Any, units: Iterable[Any]
    ) -> Iterator[tuple[Any, list[Any] | Broken]]:
        """Do ``work(shared, unit)`` for every unit.

        Args:
            work: a function of a module, so that other processes find it; pure, because a unit whose worker is lost
                runs again elsewhere.
            shared: what all units need; goes to each worker once, and may keep there what is dear to make.
            units: are asked for as workers have room for them.

        Returns:
            Units with some of their results, as they come: one that gives them one by one may come several times, in
            the order of its results, and one that has none comes with an empty list or not at all. A unit that was
            given up comes with ``Broken``.

        Raises:
            Exception: whatever ``work`` raised.
            EngineError: nobody is left who could do the work.
        """
        ...

    def close(self) -> None:
        """Let go of the workers, whatever they do."""
        ...


class Here:
    """Works in this process, on all of its cores, one unit after the other."""

    workers = 1

    def run(
        self, work: Callable[[Shared, Unit], Iterable[Result]], shared: Shared, units: Iterable[Unit]
    ) -> Iterator[tuple[Unit, list[Result] | Broken]]:
        """Do ``work(shared, unit)`` for every unit, in their order.

        Args:
            work: any function; an iterator's results are passed on as soon as they are there.
            shared: the very object that ``work`` is given each time.
            units: asked for one by one, each when the one before is done.

        Yields:
            The unit with one result at a time; a unit without results never comes, and none is ever ``Broken``.

        Raises:
            Exception: whatever ``work`` raised; units after that one are not begun.
        """
        for unit in units:
            for result in work(shared, unit):
                yield unit, [result]

    def close(self) -> None:
        """Nothing was begun."""
