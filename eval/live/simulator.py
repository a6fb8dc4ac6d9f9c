"""A robot that is simulated behind a ``Link``: it says what a robot on ROS says, and goes where it is told.

Time is its own, so that a drive of minutes takes no longer than its decisions. Its map grows, shifts its origin and, if
wished, is turned and comes in parts. On a ``Floor`` of text it maps all within its reach, through walls too; in a
``eval.live.building.Building`` it maps what it sees, and has a camera.
"""

import base64
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from eval.live.perturbation import Network
from potlp_jax.drive.inbox import Inbox
from potlp_jax.drive.messages import Message, make_pose, pose_of
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.poses import shortest
from potlp_jax.world.moves import Cell

STEP = 0.1
"""Seconds of a step, and between poses."""

MAP_SECONDS = 0.5
"""Between maps."""

WHOLE_SECONDS = 5.0
"""Between whole maps where updates are sent: a map that was lost is not lost for ever, as a latched one is not."""


PICTURES = "/panorama/compressed"
"""Topic of the panoramas, where there is a camera."""


class Ground(Protocol):
    """Where the robot drives."""

    @property
    def frame(self) -> GridFrame:
        """Where its cells lie in metres, without a turn."""
        ...

    @property
    def walls(self) -> Bool[np.ndarray, "H W"]:
        """True on walls."""
        ...

    @property
    def start(self) -> Cell:
        """Row and column."""
        ...

    def places(self, seen: Bool[np.ndarray, "H W"]) -> dict[str, list[dict[str, Any]]]:
        """Where propositions hold among the cells that were seen, as ``Topics.places`` has them."""
        ...

    def seen_from(self, cell: Cell, reach: int) -> Bool[np.ndarray, "H W"]:
        """What the robot maps from a cell, up to so many cells away."""
        ...

    def picture_from(self, cell: Cell) -> UInt8[np.ndarray, "h w 3"] | None:
        """An equirectangular panorama, RGB, its middle along growing columns; None without a camera."""
        ...


@dataclass(frozen=True)
class Floor:
    """A ``Ground`` of text.

    Attributes:
        rows: of text: ``#`` walls, ``.`` floor, a letter where the proposition that begins with it holds.
        resolution: metres a character.
        propositions: by their first letters.
        start: row and column.
    """

    rows: tuple[str, ...]
    resolution: float
    propositions: tuple[str, ...]
    start: Cell

    @property
    def frame(self) -> GridFrame:
        """Its lower left corner lies in the origin of the map's metres."""
        return GridFrame(len(self.rows), len(self.rows[0]), self.resolution, 0.0, 0.0)

    @property
    def walls(self) -> np.ndarray:
        """True on walls."""
        return np.array([[cell == "#" for cell in row] for row in self.rows])

    def places(self, seen: np.ndarray) -> dict[str, list[dict[str, Any]]]:
        """Where propositions hold among the cells that were seen, as ``Topics.places`` has them."""
        found: dict[str, list[dict[str, Any]]] = {}
        for row, text in enumerate(self.rows):
            for column, letter in enumerate(text):
                name = next((name for name in self.propositions if name[0] == letter), None)
                if name is not None and seen[row, column]:
                    point = list(self.frame.cell_to_metres(row, column))
                    found.setdefault(name, []).append({"point": point, "radius": self.resolution / 4})
        return found

    def seen_from(self, cell: Cell, reach: int) -> Bool[np.ndarray, "H W"]:
        """All within reach, through walls too."""
        (row, column), seen = cell, np.zeros(self.walls.shape, bool)
        seen[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] = True
        return seen

    def picture_from(self, cell: Cell) -> None:
        """There is no camera."""


@dataclass(frozen=True)
class Behaviour:
    """What kind of robot it is.

    Attributes:
        pixels: of its map, along each side of a cell of the ground.
        reach: cells that it maps around it.
        speed: metres a second.
        turns: radians by which its map is turned, growing with each map up to this.
        updates: whether it sends updates after the first map of a size, in place of whole maps.
        failures: so many navigations fail.
        silent: seconds, from and until which nothing is sent.
        obeys: whether it follows the advised path, as where nobody commands it.
    """

    pixels: int = 2
    reach: int = 3
    speed: float = 0.6
    turns: float = 0.0
    updates: bool = False
    failures: int = 0
    silent: tuple[float, float] = (math.inf, math.inf)
    obeys: bool = True


class SimulatedLink:
    """A ``Link`` to the simulated robot. ``step`` lets time pass."""

    def __init__(self, floor: Ground, behaviour: Behaviour, network: Network) -> None:
        self._floor, self._behaviour, self._network = floor, behaviour, network
        self._walls = floor.walls
        self._seen = np.zeros(self._walls.shape, bool)
        self._mapped_from: Cell | None = None
        self._x, self._y = floor.frame.cell_to_metres(*floor.start)
        self._way: list[tuple[float, float]] = []
        self._done: Callable[[bool, str], None] | None = None
        self._failures = behaviour.failures
        self._sent: tuple[int, ...] = ()
        self._subscribers: dict[str, Callable[[Message], None]] = {}
        self.time, self._next_map, self._next_whole = 0.0, 0.0, 0.0
        self.published: list[tuple[str, str, Any]] = []
        self.goals: list[str] = []
        self.cancelled: list[str] = []
        self.delivered: list[tuple[str, Message]] = []
        self.is_connected = True

    def clock(self) -> float:
        """Seconds of the simulation."""
        return self.time

    def subscribe(self, topic: str, kind: str, callback: Callable[[Message], None]) -> None:
        """Call back with each message of a topic."""
        self._subscribers[topic] = callback

    def publish(self, topic: str, kind: str, message: dict[str, Any]) -> None:
        """Keep a message, and follow an advised path."""
        self.published.append((topic, kind, message))
        if topic == "/potlp/path" and self._behaviour.obeys and not self.goals:
            self._way = [pose_of(entry)[:2] for entry in message["poses"]][1:]

    def send_goal(self, action: str, kind: str, goal: dict[str, Any], done: Callable[[bool, str], None]) -> str:
        """Begin to move to a pose, or along a path."""
        name = f"goal {len(self.goals)}"
        self.goals.append(name)
        # A goal in place of another ends that one.
        self._end(False, "preempted")
        self._done = done
        if "path" in goal:
            self._way = [pose_of(entry)[:2] for entry in goal["path"]["poses"]]
        else:
            self._way = self._plan(pose_of(goal["pose"])[:2])
        return name

    def cancel(self, action: str, goal: str) -> None:
        """Stop."""
        self.cancelled.append(goal)
        self._way = []
        self._end(False, "canceled")

    def close(self) -> None:
        """Nothing is open."""

    def ask_for(self, formula: str) -> None:
        """Somebody publishes another task."""
        self._network.send(self.time, "/potlp/task", {"data": formula})

    def step(self, seconds: float) -> None:
        """Move, map and say so, in steps."""
        for _ in range(max(1, round(seconds / STEP))):
            self.time += STEP
            self._move()
            self._map()
            quiet_from, quiet_until = self._behaviour.silent
            if not quiet_from <= self.time < quiet_until:
                self._tell()
            for topic, message in self._network.arrived(self.time):
                self.delivered.append((topic, message))
                if topic in self._subscribers:
                    self._subscribers[topic](message)

    def _move(self) -> None:
        if self._way and self._done is not None and self._failures > 0:
            self._failures -= 1
            self._way = []
            self._end(False, "ended as aborted")
        left = self._behaviour.speed * STEP
        while self._way and left > 0:
            x, y = self._way[0]
            distance = math.hypot(x - self._x, y - self._y)
            share = min(1.0, left / distance) if distance else 1.0
            self._x, self._y = self._x + share * (x - self._x), self._y + share * (y - self._y)
            left -= distance
            if share == 1.0:
                self._way.pop(0)
        if not self._way:
            self._end(True, "ended as succeeded")

    def _end(self, succeeded: bool, words: str) -> None:
        done, self._done = self._done, None
        if done is not None:
            done(succeeded, words)

    def _plan(self, goal: tuple[float, float]) -> list[tuple[float, float]]:
        frame = self._floor.frame
        here, there = frame.metres_to_cell(self._x, self._y), frame.metres_to_cell(*goal)
        return [frame.cell_to_metres(*cell) for cell in shortest(~self._walls, here, there)] if here != there else []

    def _map(self) -> None:
        cell = self._floor.frame.metres_to_cell(self._x, self._y)
        # From one cell the same is seen all the time.
        if cell != self._mapped_from:
            self._seen |= self._floor.seen_from(cell, self._behaviour.reach)
            self._mapped_from = cell

    def _tell(self) -> None:
        header = {"stamp": self._network.stamp(self.time), "frame_id": "map"}
        jump_x, jump_y = self._network.jump()
        pose = make_pose(self._x + jump_x, self._y + jump_y, 0.0)
        transform = {"translation": pose["position"], "rotation": pose["orientation"]}
        moved = {"header": header, "child_frame_id": "base_link", "transform": transform}
        self._network.send(self.time, "/tf", {"transforms": [moved]})
        if self.time >= self._next_map:
            self._next_map += MAP_SECONDS
            self._tell_map(header)
            places = {"data": json.dumps(self._floor.places(self._seen))}
            self._network.send(self.time, "/potlp/places", places)
            # Pictures are large: a robot takes none that nobody asked for.
            if PICTURES in self._subscribers:
                self._tell_picture(header)

    def _tell_picture(self, header: dict[str, Any]) -> None:
        picture = self._floor.picture_from(self._floor.frame.metres_to_cell(self._x, self._y))
        if picture is not None:
            _, encoded = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 95])
            data = base64.b64encode(encoded.tobytes()).decode()
            self._network.send(self.time, PICTURES, {"header": header, "format": "jpeg", "data": data})

    def _tell_map(self, header: dict[str, Any]) -> None:
        known = np.argwhere(self._seen)
        (top, left), (bottom, right) = known.min(axis=0), known.max(axis=0)
        cells = np.where(self._walls, 100, 0)
        shown = np.where(self._seen, cells, -1)[top : bottom + 1, left : right + 1]
        pixels = np.kron(shown, np.ones((self._behaviour.pixels, self._behaviour.pixels), int))
        part = self._floor.frame.window(int(top), int(left), int(bottom - top) + 1, int(right - left) + 1)
        size = part.resolution / self._behaviour.pixels
        box = (int(top), int(left), int(bottom), int(right))
        if self._behaviour.updates and box == self._sent and self.time < self._next_whole:
            height, width = pixels.shape
            update = {"header": header, "x": 0, "y": 0, "width": width, "height": height, "data": _flat(pixels)}
            self._network.send(self.time, "/map_updates", update)
            return
        self._sent, self._next_whole = box, self.time + WHOLE_SECONDS
        # A little turned about its own corner: pixels then say what lies up to some centimetres beside them.
        yaw = self._behaviour.turns * min(1.0, self.time / 20)
        info = {
            "height": pixels.shape[0],
            "width": pixels.shape[1],
            "resolution": size,
            "origin": make_pose(part.x, part.y, yaw),
        }
        self._network.send(self.time, "/map", {"header": header, "info": info, "data": _flat(pixels)})


def _flat(pixels: np.ndarray) -> list[int]:
    # ROS counts rows from the bottom.
    return pixels[::-1].ravel().tolist()


class SteppedInbox(Inbox):
    """An inbox that lets the simulation's time pass where another would wait."""

    def __init__(self, link: SimulatedLink, *arguments: Any) -> None:
        super().__init__(*arguments, clock=link.clock)
        self._link = link

    def wait(self, seconds: float) -> None:
        """Until so many seconds have passed in the simulation."""
        self._link.step(seconds)


FLOOR = Floor(
    rows=(
        "###############",
        "#......#......#",
        "#......#..f...#",
        "#.............#",
        "#......#......#",
        "#......#.....e#",
        "###############",
    ),
    resolution=0.4,
    propositions=("fire", "exit"),
    start=(1, 1),
)
"""Two rooms, a fire and an exit."""


def topics_published(link: SimulatedLink) -> Sequence[str]:
    """Names of the topics on which something was published."""
    return sorted({topic for topic, _, _ in link.published})
