"""A connection by rosbridge: JSON over a websocket, so that no ROS is needed here. The only module that knows roslibpy.

References:
    rosbridge v2.0 protocol specification (RobotWebTools/rosbridge_suite).
"""

from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from potlp_jax.drive.messages import Message
from potlp_jax.errors import RobotError

PORT: int = 9090
"""Of rosbridge, unless another is given."""

CONNECT_SECONDS: int = 10


class RosbridgeLink:
    """A connection by ``roslibpy``, which connects again by itself when it is lost."""

    def __init__(self, url: str) -> None:
        """Connect.

        Args:
            url: ``ws://HOST:PORT``, ``wss://HOST:PORT``, ``HOST:PORT`` or ``HOST``.

        Raises:
            RobotError: roslibpy is not installed, the address is none, or nobody answers there.
        """
        try:
            import roslibpy
        except ImportError as error:
            raise RobotError("roslibpy is not installed: pip install 'potlp-jax[drive]'") from error
        host, port, secure = parse_url(url)
        self._library = roslibpy
        self._ros = roslibpy.Ros(host, port, is_secure=secure)
        self._topics: dict[str, Any] = {}
        self._actions: dict[str, Any] = {}
        try:
            self._ros.run(timeout=CONNECT_SECONDS)
        except Exception as error:
            # It goes on trying, and has no way to stop before it is connected: when it is, it closes.
            self._ros.on_ready(self._ros.close)
            raise RobotError(
                f"nobody answers at {host}:{port}: start rosbridge on the robot (ros2 launch rosbridge_server "
                "rosbridge_websocket_launch.xml), and look at address and firewall"
            ) from error

    @property
    def is_connected(self) -> bool:
        """Whether the robot can be reached now."""
        return bool(self._ros.is_connected)

    def subscribe(self, topic: str, kind: str, callback: Callable[[Message], None]) -> None:
        """Call back with each message of a topic, and go on when a lost connection is back.

        Args:
            topic, kind: name and type. A topic has one subscription: a second one is ignored.
            callback: is called from the thread of roslibpy, which hears nothing until it returns.
        """
        self._topic(topic, kind).subscribe(callback)

    def publish(self, topic: str, kind: str, message: dict[str, Any]) -> None:
        """Publish a message, or drop it while the connection is lost.

        Args:
            topic, kind: name and type.
            message: JSON-able values. The topic is latched: rosbridge keeps the last one for those that subscribe
                later.
        """
        # While the connection is lost roslibpy would keep what is published, and send old advice later.
        if self.is_connected:
            self._topic(topic, kind).publish(self._library.Message(message))

    def send_goal(self, action: str, kind: str, goal: dict[str, Any], done: Callable[[bool, str], None]) -> str:
        """Send an action's goal; while the connection is lost it is not sent, and has failed at once.

        Args:
            action, kind: name and type. An action of this name keeps the type that it was first used with.
            goal: the message, JSON-able values.
            done: told whether ROS calls the goal succeeded, and in words how it ended; from the thread of roslibpy,
                and never where the connection is lost before the result has come.

        Returns:
            The id that rosbridge knows the goal by, for ``cancel``; empty for a goal that was not sent.
        """
        # roslibpy would keep the goal, and start the robot with it later, whatever has been decided since.
        if not self.is_connected:
            done(False, f"{action} was not asked: the connection is lost")
            return ""
        client = self._actions.setdefault(action, self._library.ActionClient(self._ros, action, kind))

        def ended(result: Message) -> None:
            status = result["status"]
            done(status == self._library.GoalStatus.SUCCEEDED, f"{action} ended as {status.name.lower()}")

        return client.send_goal(self._library.Goal(goal), ended, lambda _feedback: None, ended)

    def cancel(self, action: str, goal: str) -> None:
        """Take a goal back; while the connection is lost nothing is sent."""
        if self.is_connected and action in self._actions:
            self._actions[action].cancel_goal(goal)

    def close(self) -> None:
        """End the connection. The thread of roslibpy goes on: it can be started but once in a process."""
        self._ros.close()

    def _topic(self, name: str, kind: str) -> Any:
        return self._topics.setdefault(name, self._library.Topic(self._ros, name, kind, latch=True))


def parse_url(url: str) -> tuple[str, int, bool]:
    """Host, port, and whether the connection is encrypted. Raises RobotError."""
    parts = urlsplit(url if "://" in url else f"ws://{url}")
    try:
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise RobotError(f"{url!r} is no address: {error}; give HOST:PORT") from error
    if not host or parts.scheme not in ("ws", "wss"):
        raise RobotError(f"{url!r} is no address; give HOST, HOST:PORT or ws://HOST:PORT")
    return host, PORT if port is None else port, parts.scheme == "wss"
