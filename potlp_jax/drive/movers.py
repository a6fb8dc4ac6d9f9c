"""Who moves the robot along a path: nobody of ours, or Nav2."""

import itertools
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from potlp_jax.drive.config import DriveConfig, Mode
from potlp_jax.drive.link import Link
from potlp_jax.drive.messages import make_path

Points = Sequence[tuple[float, float]]
"""Metres of the map's frame."""


@dataclass(frozen=True)
class Ended:
    """How a navigation ended: whether it succeeded, and what was said of it."""

    succeeded: bool
    words: str


@runtime_checkable
class Mover(Protocol):
    """Moves the robot along paths."""

    commands: bool
    """Whether it does so by itself: then it must not take for ever."""

    def begin(self, points: Points, frame_id: str) -> None:
        """Move along a path; the points before the first are done with."""
        ...

    def ended(self) -> Ended | None:
        """How the path that was begun last ended; None while it has not."""
        ...

    def stop(self) -> None:
        """Stop where the robot is; asked once more where it may not have been heard."""
        ...


class Adviser:
    """Commands nothing: the path is published with the decision, and somebody else drives."""

    commands = False

    def begin(self, points: Points, frame_id: str) -> None:
        """Nothing: ``drive.advice`` has published the path."""

    def ended(self) -> Ended | None:
        """Never: where the robot is tells."""
        return None

    def stop(self) -> None:
        """Nothing: it was not started from here."""


class Navigator:
    """Sends goals to Nav2, one at a time."""

    commands = True

    def __init__(self, link: Link, mode: Mode, action: str = "") -> None:
        self._link, self._mode = link, mode
        self._action = action or ("/follow_path" if mode is Mode.FOLLOW else "/navigate_to_pose")
        self._lock, self._numbers = threading.Lock(), itertools.count()
        self._current = -1
        self._end: Ended | None = None
        # Goals whose end was not heard, by number: the robot may still drive to any of them.
        self._sent: dict[int, str] = {}

    def begin(self, points: Points, frame_id: str) -> None:
        """Send a goal. Nav2 gives up the one before for it, without a halt between them."""
        with self._lock:
            number = self._current = next(self._numbers)
            self._end = None
        kind, message = self._goal_message(points, frame_id)
        goal = self._link.send_goal(self._action, kind, message, lambda ok, words: self._done(number, ok, words))
        with self._lock:
            # It may have ended already, also because it was not sent; the goal before is then still on its way.
            if goal and self._end is None:
                self._sent[number] = goal

    def ended(self) -> Ended | None:
        """How the last goal ended."""
        with self._lock:
            return self._end

    def stop(self) -> None:
        """Take back every goal that may be on its way.

        One is forgotten when its end is heard, and not before: while the connection is lost nothing is taken back, nor
        is it where the connection is lost without a sign. To take back what has ended does no harm.
        """
        with self._lock:
            self._current = -1
            goals = tuple(self._sent.values())
        # Without the lock, for the end may be told at once.
        for goal in goals:
            self._link.cancel(self._action, goal)

    def _done(self, number: int, succeeded: bool, words: str) -> None:
        with self._lock:
            self._sent.pop(number, None)
            # Of a goal that was taken back, the end comes late and concerns nobody.
            if number == self._current:
                self._end = Ended(succeeded, words)

    def _goal_message(self, points: Points, frame_id: str) -> tuple[str, dict[str, Any]]:
        path = make_path(points, frame_id)
        if self._mode is Mode.FOLLOW:
            return "nav2_msgs/action/FollowPath", {"path": path, "controller_id": "", "goal_checker_id": ""}
        return "nav2_msgs/action/NavigateToPose", {"pose": path["poses"][-1], "behavior_tree": ""}


def mover_of(config: DriveConfig, link: Link) -> Mover:
    """Who moves the robot by these settings."""
    commanding = config.mode in (Mode.NAVIGATE, Mode.FOLLOW)
    return Navigator(link, config.mode, config.topics.action) if commanding else Adviser()
