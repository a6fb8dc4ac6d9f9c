"""What is asked of a connection to a robot: the rest of this package knows no network."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from potlp_jax.drive.messages import Message


@runtime_checkable
class Link(Protocol):
    """A connection. Methods may be called from any thread, and callbacks come from any."""

    def subscribe(self, topic: str, kind: str, callback: Callable[[Message], None]) -> None:
        """Call back with each message of a topic.

        Args:
            topic: its name on the robot.
            kind: its type as ROS writes it, such as ``nav_msgs/OccupancyGrid``.
            callback: is given each message as rosbridge writes it in JSON (``drive.messages``); it may be called from
                another thread, and messages may come late, twice or out of order.
        """
        ...

    def publish(self, topic: str, kind: str, message: dict[str, Any]) -> None:
        """Publish a message; the last one is kept for those that subscribe later.

        Args:
            topic: its name on the robot.
            kind: its type as ROS writes it, such as ``std_msgs/String``.
            message: JSON-able values, without a stamp: ROS takes that for "now".
        """
        ...

    def send_goal(self, action: str, kind: str, goal: dict[str, Any], done: Callable[[bool, str], None]) -> str:
        """Send an action's goal.

        Args:
            action, kind: its name and type, such as ``/navigate_to_pose`` and ``nav2_msgs/action/NavigateToPose``.
            goal: the message.
            done: told once whether the goal was reached, and in words how it ended.

        Returns:
            What ``cancel`` knows the goal by.
        """
        ...

    def cancel(self, action: str, goal: str) -> None:
        """Take a goal back, where the robot can be reached; one that has ended is left alone."""
        ...

    @property
    def is_connected(self) -> bool:
        """Whether the robot can be reached now."""
        ...

    def close(self) -> None:
        """End the connection."""
        ...
