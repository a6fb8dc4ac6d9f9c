"""What a trial leaves behind: outcome, path, word and every decision, as plain host values and JSON.

A record is self-contained: it holds the world, the task (as HOA, so that it is read without Spot) and, per cell, the
step at which the cell was first seen, so that the belief at any step - and with it any decision - can be rebuilt.
"""

import dataclasses
import json
import zlib
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32

from potlp_jax.codec import finite_or_text
from potlp_jax.errors import RecordError
from potlp_jax.types import status_names
from potlp_jax.world.grid import (
    BeliefMap,
    World,
    belief_from_numpy,
    pack_array,
    unpack_array,
    world_from_dict,
    world_to_dict,
)
from potlp_jax.world.moves import Cell

FORMAT = "potlp-trial-2"
NEVER_SEEN: int = -1
"""Entry of ``first_seen`` for a cell that was never observed."""
LOG_PREFIX: str = "log:"
"""How the ``environment`` of a trial begins that was made from a robot's log."""


class Outcome(StrEnum):
    """How a trial ended (docs/model.md section 7); ``UNFINISHED``: the log ended before the task was decided."""

    SATISFIED = "satisfied"
    INFEASIBLE = "infeasible"
    STUCK = "stuck"
    BUDGET = "budget"
    UNFINISHED = "unfinished"


@dataclasses.dataclass(frozen=True)
class ActionRecord:
    """One available action of a decision; costs are in units of the resolution.

    ``index`` is that of ``Plan`` for the task's own arrays, ``s * E + e``, however the trial padded them; ``subgoal``
    is None for the finish action.
    """

    index: int
    subgoal: int | None
    cell: tuple[int, int] | None
    from_state: int | None
    to_state: int | None
    success_probability: float
    success_cost: float
    failure_cost: float
    distance: float
    q_value: float
    visits: int


@dataclasses.dataclass(frozen=True)
class Decision:
    """One decision: where the robot stood, what it considered, what it chose.

    Attributes:
        index: number of the decision, from 0.
        step: index into the trial's path.
        cell, state: where the robot stood, and the automaton's state there.
        key: words of the decision's random key.
        kind: ``"action"`` (toward a subgoal), ``"finish"`` (acceptance in known space), ``"frontier"`` (nearest
            frontier: the baseline's move), ``"fallback"`` (the same as liveness rule of a planner without available
            action), ``"optimistic"`` or ``"none"``.
        choice: index of the chosen action; None unless the policy searches.
        target, target_state: where the path leads; None where there is no move.
        value: expected cost from here, as the policy sees it.
        fallback: whether ``kind`` is ``"fallback"``.
        status: bits of ``Status``.
        subgoals: cells of the subgoals, in their order.
        actions: those that were available; empty unless the policy searches.
        path: the part of the known-space path that may be executed before the next decision, from ``cell`` on.
        observations: per subgoal, the decision at which the panorama was taken that its estimates come from; empty
            where none is used.
        preferred: index of the action that the search found best. The robot commits to its former target unless that
            one is cheaper by enough, so that ``choice`` may differ. None unless the policy searches.
    """

    index: int
    step: int
    cell: tuple[int, int]
    state: int
    key: tuple[int, ...]
    kind: str
    choice: int | None
    target: tuple[int, int] | None
    target_state: int | None
    value: float
    fallback: bool
    status: int
    subgoals: tuple[tuple[int, int], ...]
    actions: tuple[ActionRecord, ...]
    path: tuple[tuple[int, int], ...]
    observations: tuple[int, ...] = ()
    preferred: int | None = None

    @property
    def overruled(self) -> ActionRecord | None:
        """The action that the search found best, where the robot's commitment overruled it; otherwise None."""
        if self.preferred is None or self.preferred == self.choice:
            return None
        return next(action for action in self.actions if action.index == self.preferred)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunRecord:
    """What a robot did for a task: all that is known of it without the true map.

    Attributes:
        outcome: how it ended.
        cost: length of the path in the unit of the map's resolution.
        path: cells in order, the start first.
        word: letter of each cell of the path.
        states: the automaton's state after reading each letter of the word.
        decisions: all that were taken, in order.
        status: bits of ``Status`` of all decisions.
    """

    outcome: Outcome
    cost: float
    path: tuple[Cell, ...]
    word: tuple[int, ...]
    states: tuple[int, ...]
    decisions: tuple[Decision, ...]
    status: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trial(RunRecord):
    """A finished trial: a run, with the true map and all that it was made with.

    Attributes:
        first_seen: index into ``path`` at which each cell was first observed, or ``NEVER_SEEN``.
        world: the true map.
        task_text, task_hoa, propositions: the task, also as an automaton, so that it is read without Spot.
        policy: a name, or ``module:attribute`` of a function.
        environment, seed: where the world comes from.
        config: the settings, as ``dataclasses.asdict`` makes them.
        versions: of what the figures depend on.
    """

    first_seen: Int32[np.ndarray, "H W"]
    world: World
    task_text: str
    task_hoa: str
    propositions: tuple[str, ...]
    policy: str
    environment: str
    seed: int | None
    config: Mapping[str, Any]
    versions: Mapping[str, str]

    def belief_at(self, step: int) -> BeliefMap:
        """The belief after observing from ``path[step]``."""
        return belief_seen_by(self.world, self.first_seen, step)

    def summary(self) -> dict[str, Any]:
        """The figures of the trial without its arrays."""
        return {
            "outcome": str(self.outcome),
            "cost": self.cost,
            "steps": len(self.path) - 1,
            "decisions": len(self.decisions),
            "fallbacks": sum(decision.fallback for decision in self.decisions),
            "policy": self.policy,
            "task": self.task_text,
            "environment": self.environment,
            "world": self.seed,
            "status": list(status_names(self.status)),
        }

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values; infinite costs become the string ``"inf"``."""
        data = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if field.name not in ("decisions", "first_seen", "world")
        }
        data["outcome"] = str(self.outcome)
        # Arrays are packed; everything else is readable JSON.
        data["decisions"] = [dataclasses.asdict(decision) for decision in self.decisions]
        data["first_seen"] = pack_array(self.first_seen)
        data["world"] = world_to_dict(self.world)
        return finite_or_text({"format": FORMAT, **data})

    def save(self, path: Path) -> None:
        """Write the record as JSON."""
        path.write_text(json.dumps(self.to_dict(), allow_nan=False))


def belief_seen_by(world: World, first_seen: Int32[np.ndarray, "H W"], step: int) -> BeliefMap:
    """The belief of a robot that saw each cell first at step ``first_seen`` (or ``NEVER_SEEN``), after ``step``."""
    # One number per cell stands for all beliefs of a trial: known space only grows.
    seen = (first_seen != NEVER_SEEN) & (first_seen <= step)
    # What is observed is observed rightly: the sensor is exact (docs/model.md section 7).
    truth = np.where(np.asarray(world.occupied), BeliefMap.OCCUPIED, BeliefMap.FREE)
    cells = np.where(seen, truth, BeliefMap.UNKNOWN)
    letters = np.where(seen, np.asarray(world.letters), 0)
    # The extent is known from the start, whatever the padding: budget and dead ends are counted by it.
    height, width = (int(size) for size in world.extent)
    return belief_from_numpy(cells, letters, float(world.resolution), (height, width))


def load_trial(path: Path) -> Trial:
    """Read a record written by ``Trial.save``. Raises RecordError where the file is not one."""
    try:
        data = json.loads(path.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RecordError(f"{path}: cannot be read as a trial record: {error}") from error
    # Another format is told apart from damage: the remedies differ.
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise RecordError(f"{path}: not a trial record of format {FORMAT!r} (found {found!r}); run `potlp run` again")
    try:
        return _trial_from_dict(data)
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        raise RecordError(f"{path}: the trial record is damaged: {error!r}") from error


def _trial_from_dict(data: Mapping[str, Any]) -> Trial:
    values = {field.name: data[field.name] for field in dataclasses.fields(Trial)}
    values["outcome"] = Outcome(data["outcome"])
    values["cost"] = float(data["cost"])
    values["path"] = _cells(data["path"])
    values["word"] = tuple(data["word"])
    values["states"] = tuple(data["states"])
    values["propositions"] = tuple(data["propositions"])
    values["decisions"] = tuple(_decision_from_dict(decision) for decision in data["decisions"])
    values["first_seen"] = unpack_array(data["first_seen"])
    # Lists become tuples throughout: records are compared, and used as keys.
    values["world"] = world_from_dict(data["world"])
    return Trial(**values)


def _decision_from_dict(data: Mapping[str, Any]) -> Decision:
    values = dict(data)
    values["cell"] = tuple(data["cell"])
    values["target"] = None if data["target"] is None else tuple(data["target"])
    values["key"] = tuple(data["key"])
    values["value"] = float(data["value"])
    values["subgoals"] = _cells(data["subgoals"])
    values["path"] = _cells(data["path"])
    values["observations"] = tuple(data["observations"])
    values["actions"] = tuple(_action_from_dict(action) for action in data["actions"])
    # An index that points nowhere would fail later, in a picture or a page, far from the file.
    listed = {action.index for action in values["actions"]}
    for name in ("choice", "preferred"):
        if values[name] is not None and values[name] not in listed:
            raise ValueError(f"decision {values['index']}: {name} {values[name]} is none of its actions")
    return Decision(**values)


def _action_from_dict(data: Mapping[str, Any]) -> ActionRecord:
    values = dict(data)
    values["cell"] = None if data["cell"] is None else tuple(data["cell"])
    # Infinite costs are written as text, which ``float`` reads back.
    for name in ("success_probability", "success_cost", "failure_cost", "distance", "q_value"):
        values[name] = float(data[name])
    return ActionRecord(**values)


def _cells(rows: list[list[int]]) -> tuple[tuple[int, int], ...]:
    return tuple((int(row), int(column)) for row, column in rows)
