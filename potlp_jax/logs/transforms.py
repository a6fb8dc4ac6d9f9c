"""Frames of a robot: where one lies in another over time, as ROS's ``tf`` tells it (REP 105)."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

Edge = tuple[str, str]
"""Parent and child frame."""

Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""


@dataclass
class _Track:
    times: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)
    """x, y, z, and the quaternion x, y, z, w."""


class Transforms:
    """A tree of frames. Transforms between two recorded ones are interpolated; beyond the ends the last one holds."""

    def __init__(self) -> None:
        self._moving: dict[Edge, _Track] = {}
        self._fixed: dict[Edge, tuple[float, ...]] = {}

    def add(self, parent: str, child: str, time: int | None, values: tuple[float, ...]) -> None:
        """Record where one frame lies in another.

        Args:
            parent, child: names of the frames.
            time: in nanoseconds; None: always.
            values: x, y, z, and the quaternion x, y, z, w.
        """
        edge = _name(parent), _name(child)
        if time is None:
            self._fixed[edge] = values
        else:
            # In the order of the file; sorted when it is asked, for messages may come late.
            track = self._moving.setdefault(edge, _Track())
            track.times.append(time)
            track.values.append(values)

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        return {frame for edge in (*self._moving, *self._fixed) for frame in edge}

    def has(self, parent: str, child: str) -> bool:
        """Whether there is a transform of these two frames itself."""
        return (_name(parent), _name(child)) in {*self._moving, *self._fixed}

    def chain(self, parent: str, child: str) -> tuple[tuple[Edge, bool], ...] | None:
        """The edges from one frame to another, and whether each leads to its child; None if nothing connects them."""
        start, goal = _name(parent), _name(child)
        came_from: dict[str, tuple[Edge, bool] | None] = {start: None}
        queue = deque([start])
        while queue:
            frame = queue.popleft()
            for edge in (*self._moving, *self._fixed):
                # Transforms are published from parent to child; a chain may go either way.
                for here, there, down in ((edge[0], edge[1], True), (edge[1], edge[0], False)):
                    if here == frame and there not in came_from:
                        came_from[there] = (edge, down)
                        queue.append(there)
        if goal not in came_from:
            return None
        steps: list[tuple[Edge, bool]] = []
        # Walked back from the goal, hence reversed at the end.
        while (step := came_from[goal]) is not None:
            steps.append(step)
            goal = step[0][0] if step[1] else step[0][1]
        return tuple(reversed(steps))

    def tracks(self, parent: str, child: str) -> dict[Edge, Int64[np.ndarray, "..."]]:
        """When each moving edge between two frames was recorded, in order."""
        moving = [edge for edge, _ in self.chain(parent, child) or () if edge in self._moving]
        return {edge: np.unique(np.array(self._moving[edge].times, np.int64)) for edge in moving}

    def times(self, parent: str, child: str) -> Int64[np.ndarray, "N"]:
        """When the edge between two frames that was recorded most often was recorded, in order; empty if none moves."""
        # Odometry is published faster than localisation corrects it: the fastest edge has the finest times.
        return max(self.tracks(parent, child).values(), key=len, default=np.array([], np.int64))

    def poses(self, parent: str, child: str, times: Int64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 4 4"]:
        """Where one frame lies in another at some times.

        Args:
            parent, child: names of the frames.
            times: in nanoseconds.

        Returns:
            Matrices from the child's coordinates to the parent's.

        Raises:
            KeyError: nothing connects the frames.
        """
        chain = self.chain(parent, child)
        if chain is None:
            raise KeyError(f"nothing connects the frames {parent} and {child}")
        result = np.tile(np.eye(4), (len(times), 1, 1))
        for edge, down in chain:
            values = self._at(edge, times)
            matrices = np.tile(np.eye(4), (len(times), 1, 1))
            matrices[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
            matrices[:, :3, 3] = values[:, :3]
            # A transform maps the child's coordinates to the parent's; upwards it is inverted.
            result = result @ (matrices if down else np.linalg.inv(matrices))
        return result

    def _at(self, edge: Edge, times: Int64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 7"]:
        # A transform that was published both ways moves: the static one is an initial value.
        if edge in self._fixed and edge not in self._moving:
            return np.tile(np.array(self._fixed[edge], np.float64), (len(times), 1))
        track = self._moving[edge]
        # Some nodes publish a transform twice with one stamp; interpolation needs distinct times.
        recorded, first = np.unique(np.array(track.times, np.int64), return_index=True)
        values = np.array(track.values, np.float64)[first]
        # Linear, then normalised by ``Rotation``: between two close turns that is as good as on the sphere.
        values[:, 3:] = _aligned(values[:, 3:])
        # Relative to the first time, so that nanoseconds are not lost in floating point.
        since, wanted = (recorded - recorded[0]).astype(np.float64), (times - recorded[0]).astype(np.float64)
        return np.stack([np.interp(wanted, since, column) for column in values.T], axis=1)


def headings(matrices: Float64[np.ndarray, "N 4 4"], optical: bool) -> Float64[np.ndarray, "N"]:
    """Angle in the parent's plane, counter-clockwise from its x axis, in which a frame looks forward.

    Forward is x, and z for optical frames (REP 103).
    """
    forward = matrices[:, :3, 2 if optical else 0]
    return np.arctan2(forward[:, 1], forward[:, 0])


def quaternion_of(yaw: float) -> Quaternion:
    """The turn by ``yaw`` about the vertical axis."""
    x, y, z, w = Rotation.from_euler("z", yaw).as_quat()
    return float(x), float(y), float(z), float(w)


def yaw_of(quaternion: Quaternion) -> float:
    """The turn about the vertical axis."""
    matrix = Rotation.from_quat(quaternion).as_matrix()
    return float(np.arctan2(matrix[1, 0], matrix[0, 0]))


def _aligned(quaternions: Float64[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 4"]:
    """The same turns, with signs such that neighbours are near each other and may be interpolated."""
    # A quaternion and its negative are the same turn, and the mean of both is none.
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    signs = np.where(np.concatenate([[0], np.cumsum(flips)]) % 2 == 1, -1.0, 1.0)
    return quaternions * signs[:, None]


def _name(frame: str) -> str:
    """ROS 1 names may begin with a slash."""
    return frame.lstrip("/")
