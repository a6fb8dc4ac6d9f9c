"""A decision for whoever drives or watches: as JSON, as a path, and as markers for RViz and Foxglove."""

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int

from potlp_jax.codec import finite_or_null
from potlp_jax.drive.link import Link
from potlp_jax.drive.messages import make_path, make_pose
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.task.task import Task
from potlp_jax.task.words import state_words
from potlp_jax.trials.record import Decision
from potlp_jax.types import status_names
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.moves import Cell

Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, 0 to 1."""

_FRONTIER, _CHOSEN, _ASIDE = (0.2, 0.4, 0.9, 0.9), (0.1, 0.7, 0.2, 1.0), (0.8, 0.2, 0.2, 0.6)
# In the colours' order of the pictures would be nicer; RViz shows these well on grey maps.
_PLACES: tuple[Colour, ...] = ((0.9, 0.5, 0.1, 0.7), (0.1, 0.7, 0.7, 0.7), (0.7, 0.3, 0.8, 0.7), (0.7, 0.7, 0.1, 0.7))

# Of visualization_msgs/Marker.
_ADD, _DELETE_ALL, _LINES, _CUBES, _SPHERES, _TEXT = 0, 3, 4, 6, 7, 9


class Advertiser:
    """Publishes decisions under a prefix: ``decision``, ``path``, ``markers`` and ``state``."""

    def __init__(self, link: Link, prefix: str, task: Task, frame_of: Callable[[], tuple[GridFrame, str]]) -> None:
        """Publish over a link.

        Args:
            link: to the robot.
            prefix: of the topics.
            task: of the decisions.
            frame_of: where the map of the decisions lies, and the name of its frame.
        """
        self._link, self._prefix, self._task, self._frame_of = link, prefix, task, frame_of

    def advise(self, decision: Decision, belief: BeliefMap) -> None:
        """Publish a decision, and what it was planned on as far as it is shown."""
        frame, frame_id = self._frame_of()
        points = [frame.cell_to_metres(*cell) for cell in decision.path]
        advice = decision_to_json(decision, self._task, frame, frame_id)
        self._link.publish(f"{self._prefix}/decision", "std_msgs/String", {"data": json.dumps(advice, allow_nan=False)})
        self._link.publish(f"{self._prefix}/path", "nav_msgs/Path", make_path(points, frame_id))
        markers = make_markers(decision, belief, frame, frame_id)
        self._link.publish(f"{self._prefix}/markers", "visualization_msgs/MarkerArray", {"markers": markers})

    def say(self, state: str, text: str) -> None:
        """Publish how the drive is doing: a word, and words."""
        data = json.dumps({"state": state, "task": self._task.text, "text": text})
        self._link.publish(f"{self._prefix}/state", "std_msgs/String", {"data": data})


def decision_to_json(decision: Decision, task: Task, frame: GridFrame, frame_id: str) -> dict[str, Any]:
    """A decision with its table of actions, in metres.

    Args:
        decision: to be told.
        task: of the decision.
        frame: where its cells lie.
        frame_id: the map's frame.

    Returns:
        JSON-able values; costs that are infinite are null.
    """

    def metres(cell: Cell | None) -> list[float] | None:
        return None if cell is None else [round(value, 4) for value in frame.cell_to_metres(*cell)]

    return finite_or_null(
        {
            "index": decision.index,
            "task": task.text,
            "state": decision.state,
            "state_words": state_words(task, decision.state),
            "kind": decision.kind,
            "frame_id": frame_id,
            "robot": metres(decision.cell),
            "target": metres(decision.target),
            "expected_cost": decision.value,
            "status": list(status_names(decision.status)),
            "set_aside": [metres(cell) for cell in decision.set_aside],
            "actions": [
                {
                    "subgoal": metres(action.cell),
                    "from_state": action.from_state,
                    "to_state": action.to_state,
                    "success_probability": action.success_probability,
                    "success_cost": action.success_cost,
                    "failure_cost": action.failure_cost,
                    "distance": action.distance,
                    "expected_cost": action.q_value,
                    "chosen": action.index == decision.choice,
                }
                for action in sorted(decision.actions, key=lambda action: (action.q_value, action.index))
            ],
        }
    )


def make_markers(decision: Decision, belief: BeliefMap, frame: GridFrame, frame_id: str) -> list[dict[str, Any]]:
    """A ``visualization_msgs/MarkerArray``: frontiers, the path, the target, what is set aside, places of propositions.

    Args:
        decision: to be shown.
        belief: what it was planned on.
        frame: where its cells lie.
        frame_id: the map's frame.

    Returns:
        The markers; the first one takes away those of the decision before.
    """
    letters = np.asarray(belief.letters)
    aside = np.array(decision.set_aside, int).reshape(-1, 2)
    groups: list[tuple[str, int, Colour, Int[np.ndarray, "N 2"]]] = [
        ("frontiers", _SPHERES, _FRONTIER, np.array(decision.subgoals, int).reshape(-1, 2)),
        ("path", _LINES, _CHOSEN, np.array(decision.path, int).reshape(-1, 2)),
        ("set aside", _CUBES, _ASIDE, aside),
    ]
    for bit, name in enumerate(belief.propositions):
        groups.append((name, _CUBES, _PLACES[bit % len(_PLACES)], np.argwhere((letters >> bit) & 1)))
    markers: list[dict[str, Any]] = [{"header": {"frame_id": frame_id}, "action": _DELETE_ALL}]
    for number, (name, kind, colour, cells) in enumerate(groups):
        # A line of one point is none, and RViz warns of it.
        if len(cells) > (kind == _LINES):
            points = [frame.cell_to_metres(int(row), int(column)) for row, column in cells]
            markers.append(_marker(number, name, kind, colour, points, frame, frame_id))
    if decision.target is not None:
        text = f"{decision.kind}: {decision.value:.1f}"
        at = frame.cell_to_metres(*decision.target)
        markers.append(_marker(len(groups), "target", _TEXT, _CHOSEN, [at], frame, frame_id) | {"text": text})
    return markers


def _marker(
    number: int,
    name: str,
    kind: int,
    colour: Colour,
    points: Sequence[tuple[float, float]],
    frame: GridFrame,
    frame_id: str,
) -> dict[str, Any]:
    red, green, blue, opacity = colour
    size = frame.resolution * (0.3 if kind == _LINES else 2.0 if kind in (_SPHERES, _TEXT) else 1.0)
    # A text stands at its pose; what consists of points has them in the frame itself.
    x, y = points[0] if kind == _TEXT else (0.0, 0.0)
    return {
        "header": {"frame_id": frame_id},
        "ns": name,
        "id": number,
        "type": kind,
        "action": _ADD,
        "pose": make_pose(x, y, 0.0),
        "scale": {"x": size, "y": size, "z": size},
        "color": {"r": red, "g": green, "b": blue, "a": opacity},
        "points": [] if kind == _TEXT else [{"x": x, "y": y, "z": 0.0} for x, y in points],
    }
