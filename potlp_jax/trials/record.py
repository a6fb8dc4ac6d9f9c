"""What a trial leaves behind: outcome, path, word and every decision, as plain host values and JSON.

A record is self-contained: it holds the world, the task (as HOA, so that it is read without Spot) and, per cell, the
step at which the cell was first seen, so that the belief at any step - and with it any decision - can be rebuilt.
"""

import dataclasses
import json
import zlib
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int32

from potlp_jax.checks import WHOLE
from potlp_jax.codec import config_from_dict, finite_or_text
from potlp_jax.errors import PotlpError, RecordError
from potlp_jax.files import read_json, reading, short, write_whole
from potlp_jax.task.propositions import check_propositions, require_same_propositions
from potlp_jax.types import status_names, status_of
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

FORMAT = "potlp-trial-3"
NEVER_SEEN: int = -1
"""Entry of ``first_seen`` for a cell that was never observed."""
LOG_PREFIX: str = "log:"
"""How the ``environment`` of a trial begins that was made from a robot's log."""
ROBOT_PREFIX: str = "robot:"
"""How the ``environment`` of a trial begins that a robot drove (``trials.live``)."""


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
        set_aside: cells that counted as obstacles in this decision, because the robot had failed to get there or past
            them (``trials.setbacks``).
        failure: why the robot could not carry the decision out, in its words; empty where it could.
        extent: rows and columns by which dead ends were counted; None: those of the world.
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
    set_aside: tuple[tuple[int, int], ...] = ()
    failure: str = ""
    extent: tuple[int, int] | None = None

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


@dataclasses.dataclass(frozen=True)
class Correction:
    """What a cell was taken for in some decisions, where ``first_seen`` and the world say otherwise.

    Attributes:
        cell: row and column.
        first, until: the first of these decisions, and the first one after them.
        value: of ``BeliefMap.cells``.
        letter: of the cell; 0 where it was not observed.
    """

    cell: tuple[int, int]
    first: int
    until: int
    value: int
    letter: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trial(RunRecord):
    """A finished trial: a run, with the true map and all that it was made with.

    Of a robot that drove where nobody knows the true map, the world is what the robot knew at the end; what it never
    observed is an obstacle there.

    Attributes:
        first_seen: index into ``path`` at which each cell was first observed, or ``NEVER_SEEN``.
        world: the true map.
        corrections: what a robot had seen wrongly and took back later; none in simulation, where seeing is perfect.
        notes: what was noticed about the robot, in words.
        task_text, task_hoa, propositions: the task, also as an automaton, so that it is read without Spot.
        policy: a name, or ``module:attribute`` of a function.
        environment, world_number: where the world comes from; None where it has no number.
        config: the settings, as ``dataclasses.asdict`` makes them.
        versions: of what the figures depend on.
        max_positive_literals: of the task (``Task.max_positive_literals``); None in records from before it was kept.
    """

    first_seen: Int32[np.ndarray, "H W"]
    world: World
    task_text: str
    task_hoa: str
    propositions: tuple[str, ...]
    policy: str
    environment: str
    world_number: int | None
    config: Mapping[str, Any]
    versions: Mapping[str, str]
    corrections: tuple[Correction, ...] = ()
    notes: tuple[str, ...] = ()
    max_positive_literals: int | None = None

    def belief_at(self, step: int) -> BeliefMap:
        """The belief after observing from ``path[step]``."""
        return belief_seen_by(self.world, self.first_seen, step)

    def belief_of(self, decision: Decision) -> BeliefMap:
        """What the robot knew at a decision; ``planned_on`` is what it planned with."""
        belief = self.belief_at(decision.step)
        corrected = [entry for entry in self.corrections if entry.first <= decision.index < entry.until]
        if not corrected and decision.extent is None:
            return belief
        cells, letters = np.array(belief.cells), np.array(belief.letters)
        for entry in corrected:
            cells[entry.cell], letters[entry.cell] = entry.value, entry.letter
        rows, columns = np.asarray(belief.extent).tolist() if decision.extent is None else decision.extent
        return belief_from_numpy(cells, letters, float(belief.resolution), (rows, columns), belief.propositions)

    def planned_on(self, decision: Decision) -> BeliefMap:
        """What a decision was planned with: what the robot knew, and what was set aside closed."""
        return with_closed(self.belief_of(decision), decision.set_aside)

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
            "world": self.world_number,
            "status": list(status_names(self.status)),
        }

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values; infinite costs become the string ``"inf"``."""
        data = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if field.name not in ("decisions", "first_seen", "corrections", "world")
        }
        data["outcome"] = str(self.outcome)
        # Arrays are packed; everything else is readable JSON.
        data["decisions"] = [_decision_to_dict(decision) for decision in self.decisions]
        data["status"] = list(status_names(self.status))
        data["first_seen"] = pack_array(self.first_seen)
        data["corrections"] = pack_array(_correction_rows(self.corrections))
        data["world"] = world_to_dict(self.world)
        return finite_or_text({"format": FORMAT, **data})

    def save(self, path: Path) -> None:
        """Write the record as JSON: whole, or not at all. An earlier record is replaced once the new one is on disk."""
        data = self.to_dict()
        write_whole(path, json.dumps({**data, "checksum": record_checksum(data)}, allow_nan=False))


def belief_seen_by(world: World, first_seen: Int32[np.ndarray, "H W"], step: int) -> BeliefMap:
    """The belief of a robot that saw each cell first at step ``first_seen`` (or ``NEVER_SEEN``), after ``step``.

    Args:
        world: what is true.
        first_seen: step at which each cell was seen first.
        step: cells entered until the moment that is asked about.

    Returns:
        The map as it was known then.
    """
    # One number per cell stands for all beliefs of a trial: known space only grows.
    seen = (first_seen != NEVER_SEEN) & (first_seen <= step)
    # What is observed is observed rightly: the sensor is exact (docs/model.md section 7).
    truth = np.where(np.asarray(world.occupied), BeliefMap.OCCUPIED, BeliefMap.FREE)
    cells = np.where(seen, truth, BeliefMap.UNKNOWN)
    letters = np.where(seen, np.asarray(world.letters), 0)
    # The extent is known from the start, whatever the padding: budget and dead ends are counted by it.
    height, width = (int(size) for size in world.extent)
    return belief_from_numpy(cells, letters, float(world.resolution), (height, width), world.propositions)


def with_closed(belief: BeliefMap, cells: Sequence[Cell]) -> BeliefMap:
    """The belief with some cells taken for obstacles."""
    # As it was, where there are none: nothing is copied from the device for most decisions. By NumPy otherwise, for the
    # number of cells would be compiled.
    if not cells:
        return belief
    at = tuple(np.array(cells, np.int32).T)
    values, letters = np.array(belief.cells), np.array(belief.letters)
    values[at], letters[at] = BeliefMap.OCCUPIED, 0
    return dataclasses.replace(belief, cells=jnp.asarray(values), letters=jnp.asarray(letters))


def _correction_rows(corrections: Sequence[Correction]) -> Int32[np.ndarray, "N 6"]:
    # One array: a noisy map has thousands of them.
    rows = [(*entry.cell, entry.first, entry.until, entry.value, entry.letter) for entry in corrections]
    return np.array(rows, np.int32).reshape(-1, 6)


def _corrections(rows: Int32[np.ndarray, "N 6"]) -> tuple[Correction, ...]:
    return tuple(Correction((row, column), *rest) for row, column, *rest in rows.tolist())


def record_checksum(data: Mapping[str, Any]) -> int:
    """Of the values of a record, whatever the order of its entries and the spaces between them."""
    said = {name: value for name, value in data.items() if name != "checksum"}
    return zlib.crc32(json.dumps(said, sort_keys=True).encode())


def load_trial(path: Path) -> Trial:
    """Read a record written by ``Trial.save``. Raises RecordError where the file is not one, or was changed."""
    data = read_json(path, RecordError, "a trial record")
    # Another format is told apart from damage: the remedies differ.
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise RecordError(
            f"{path}: not a trial record of format {FORMAT!r} (found {short(found)}); run `potlp run` again"
        )
    # A flipped bit in a number is a number: only the checksum tells that another robot was somewhere else.
    with reading(path, RecordError, "a trial record"):
        checksum = record_checksum(data)
    if data.get("checksum") != checksum:
        raise RecordError(f"{path}: the trial record is damaged, or was changed by hand: its checksum differs")
    try:
        with reading(path, RecordError, "a trial record"):
            return _trial_from_dict(data)
    except RecordError:
        raise
    # What is wrong with a world, a task or its propositions says so, but not in which file.
    except PotlpError as error:
        raise RecordError(f"{path}: the trial record is damaged: {error}") from error


def _decision_to_dict(decision: Decision) -> dict[str, Any]:
    # Names, as everywhere that people read; a number would have to be looked up in the program.
    return {**dataclasses.asdict(decision), "status": list(status_names(decision.status))}


def _trial_from_dict(data: Mapping[str, Any]) -> Trial:
    # Records from before the limit was kept have none.
    data = {"max_positive_literals": None, **data}
    values = {field.name: data[field.name] for field in dataclasses.fields(Trial)}
    values["outcome"] = Outcome(data["outcome"])
    values["cost"] = float(data["cost"])
    values["path"] = _cells(data["path"])
    values["word"] = tuple(data["word"])
    values["states"] = tuple(data["states"])
    values["status"] = status_of(data["status"])
    values["propositions"] = check_propositions(data["propositions"])
    values["decisions"] = tuple(
        _decision_from_dict(decision, f"decision {index}") for index, decision in enumerate(data["decisions"])
    )
    values["first_seen"] = unpack_array(data["first_seen"])
    values["corrections"] = _corrections(unpack_array(data["corrections"]))
    values["notes"] = tuple(data["notes"])
    # Lists become tuples throughout: records are compared, and used as keys.
    values["world"] = world_from_dict(data["world"])
    require_same_propositions(values["propositions"], values["world"].propositions, remedy="run the trial again")
    trial = Trial(**values)
    _check(trial)
    return trial


def _check(trial: Trial) -> None:
    """Refuse values that no trial has, and that would fail later, in a picture or a page. Raises ValueError."""
    for name in ("task_text", "task_hoa", "policy", "environment"):
        if not isinstance(getattr(trial, name), str):
            raise ValueError(f"{name} is no text")
    if not (isinstance(trial.config, Mapping) and isinstance(trial.versions, Mapping)):
        raise ValueError("config and versions are no mappings")
    if not (trial.max_positive_literals is None or WHOLE.allows(trial.max_positive_literals)):
        raise ValueError("max_positive_literals is no whole number from 0")
    if not all(type(number) is int and number >= 0 for number in (*trial.word, *trial.states)):
        raise ValueError("word and states are no numbers from 0")
    if not len(trial.path) == len(trial.word) == len(trial.states) > 0:
        raise ValueError("path, word and states have other lengths than each other, or none")
    height, width = trial.world.shape
    if not all(0 <= row < height and 0 <= column < width for row, column in trial.path):
        raise ValueError("the path leaves the map")
    if trial.first_seen.shape != trial.world.shape or trial.first_seen.dtype != np.int32:
        raise ValueError("first_seen is not of the map's shape")
    if not all(0 <= decision.step < len(trial.path) for decision in trial.decisions):
        raise ValueError("a decision is not on the path")
    closed = [cell for decision in trial.decisions for cell in decision.set_aside]
    if not all(0 <= row < height and 0 <= column < width for row, column in (*closed, *_cells_of(trial.corrections))):
        raise ValueError("a cell that was corrected, or set aside, is not on the map")


def _cells_of(corrections: Sequence[Correction]) -> list[Cell]:
    return [entry.cell for entry in corrections]


def _decision_from_dict(data: Mapping[str, Any], where: str) -> Decision:
    values = dict(data)
    values["cell"] = tuple(data["cell"])
    values["target"] = None if data["target"] is None else tuple(data["target"])
    values["key"] = tuple(data["key"])
    values["value"] = float(data["value"])
    values["status"] = status_of(data["status"])
    values["subgoals"] = _cells(data["subgoals"])
    values["path"] = _cells(data["path"])
    values["observations"] = tuple(data["observations"])
    values["set_aside"] = _cells(data["set_aside"])
    values["extent"] = None if data["extent"] is None else tuple(data["extent"])
    values["actions"] = tuple(_action_from_dict(action) for action in data["actions"])
    # An index that points nowhere would fail later, in a picture or a page, far from the file.
    listed = {action.index for action in values["actions"]}
    for name in ("choice", "preferred"):
        if values[name] is not None and values[name] not in listed:
            raise ValueError(f"decision {values['index']}: {name} {values[name]} is none of its actions")
    # By the types that the classes state, at every depth.
    values["actions"] = [dataclasses.asdict(action) for action in values["actions"]]
    return config_from_dict(Decision, values, where)


def _action_from_dict(data: Mapping[str, Any]) -> ActionRecord:
    values = dict(data)
    values["cell"] = None if data["cell"] is None else tuple(data["cell"])
    # Infinite costs are written as text, which ``float`` reads back.
    for name in ("success_probability", "success_cost", "failure_cost", "distance", "q_value"):
        values[name] = float(data[name])
    return ActionRecord(**values)


def _cells(rows: list[list[int]]) -> tuple[tuple[int, int], ...]:
    return tuple((int(row), int(column)) for row, column in rows)
