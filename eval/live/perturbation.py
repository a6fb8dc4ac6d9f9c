"""What a network and a robot's clock do to messages: delay, loss, duplicates, another order, and jumps."""

import heapq
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

SECOND = 1_000_000_000
"""Nanoseconds."""


@dataclass(frozen=True)
class Perturbation:
    """How badly messages fare.

    Attributes:
        delay: seconds, at most; drawn for each message, so that a long one changes the order.
        loss, duplicates: shares of the messages.
        jumps: share of the poses that lie somewhere else.
        garbage: share of the messages that arrive damaged.
        restart: seconds after which the robot's clock begins anew, once; None: never.
    """

    delay: float = 0.0
    loss: float = 0.0
    duplicates: float = 0.0
    jumps: float = 0.0
    garbage: float = 0.0
    restart: float | None = None

    @classmethod
    def drawn(cls, random: np.random.Generator) -> "Perturbation":
        """One of each kind, or of several at once."""

        def some(most: float) -> float:
            return float(random.uniform(0, most)) if random.random() < 0.7 else 0.0

        restart = float(random.uniform(5, 30)) if random.random() < 0.2 else None
        return cls(some(1.0), some(0.4), some(0.4), some(0.05), some(0.1), restart)


class Network:
    """Messages on their way."""

    def __init__(self, perturbation: Perturbation, random: np.random.Generator) -> None:
        self._perturbation, self._random = perturbation, random
        self._under_way: list[tuple[float, int, str, dict[str, Any]]] = []
        self._numbers = itertools.count()

    def stamp(self, now: float) -> dict[str, int]:
        """The stamp that the robot's clock gives."""
        restart = self._perturbation.restart
        # A day later than it is: the clock of a robot counts from some other moment.
        shown = now + 86_400 if restart is None or now < restart else now - restart
        nanoseconds = round(shown * SECOND)
        return {"sec": nanoseconds // SECOND, "nanosec": nanoseconds % SECOND}

    def send(self, now: float, topic: str, message: dict[str, Any]) -> None:
        """Put a message on its way; it may never arrive, or twice."""
        settings, random = self._perturbation, self._random
        if random.random() < settings.loss:
            return
        if random.random() < settings.garbage:
            message = _damaged(message, random)
        for _ in range(2 if random.random() < settings.duplicates else 1):
            due = now + float(random.uniform(0, settings.delay))
            heapq.heappush(self._under_way, (due, next(self._numbers), topic, message))

    def jump(self) -> tuple[float, float]:
        """Metres by which a pose is somewhere else."""
        if self._random.random() >= self._perturbation.jumps:
            return 0.0, 0.0
        x, y = self._random.uniform(-20, 20, 2)
        return float(x), float(y)

    def arrived(self, now: float) -> Iterator[tuple[str, dict[str, Any]]]:
        """Messages that are due."""
        while self._under_way and self._under_way[0][0] <= now:
            _, _, topic, message = heapq.heappop(self._under_way)
            yield topic, message


def _damaged(message: dict[str, Any], random: np.random.Generator) -> dict[str, Any]:
    """A message in which something is not what its type says."""
    names = sorted(message)
    name = names[int(random.integers(len(names)))]
    wrong = [None, "x", -1, [], {}, float("nan"), [1, 2, 3], {"secs": "a"}]
    return {**message, name: wrong[int(random.integers(len(wrong)))]}
