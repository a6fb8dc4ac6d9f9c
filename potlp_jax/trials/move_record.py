"""What a move leaves in the record: a ``Decision`` in plain host values."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.learning.observing import looks_on_the_way, observations_of
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.history import ActionTerms
from potlp_jax.planning.move import Move, MoveKind
from potlp_jax.trials.record import ActionRecord, Decision
from potlp_jax.types import NO_ACTION
from potlp_jax.world.moves import Cell, as_cell

KIND_NAMES: Mapping[int, str] = MappingProxyType(
    {value: name.lower() for name, value in vars(MoveKind).items() if name.isupper()}
)
"""What records call the kinds of moves: ``Decision.kind``."""


def decision_of(
    move: Move,
    estimator: Estimator | None,
    key: PRNGKeyArray,
    *,
    index: int,
    step: int,
    cell: Cell,
    state: int,
) -> Decision:
    """The record of one decision.

    Args:
        move: what was decided.
        estimator: what was asked, which knows from which panoramas it answered.
        key: of the decision.
        index: number of the decision in its trial, from 0.
        step: moves made before.
        cell: where the robot stood.
        state: the automaton's state there.

    Returns:
        The decision with everything that the search considered.
    """
    kind = int(move.kind)
    goes = kind != MoveKind.NONE
    # Paths have a fixed length on the device; behind ``length`` they repeat the target.
    path = np.asarray(move.path.cells)[: int(move.path.length) + 1]
    return Decision(
        index=index,
        step=step,
        cell=cell,
        state=state,
        key=tuple(int(word) for word in jax.random.key_data(key)),
        kind=KIND_NAMES[kind],
        # The action that is carried out; ``preferred`` is the one that the search found.
        choice=_recorded_index(move, int(move.action)),
        target=as_cell(move.target_cell) if goes else None,
        target_state=int(move.target_state) if goes else None,
        value=float(move.value),
        fallback=kind == MoveKind.FALLBACK,
        status=int(move.status),
        subgoals=tuple(as_cell(subgoal) for subgoal in np.asarray(move.subgoals.cells)[np.asarray(move.subgoals.mask)]),
        actions=_action_records(move),
        path=tuple(as_cell(entry) for entry in path),
        observations=_observations(estimator, move),
        preferred=None if move.search is None else _recorded_index(move, int(move.search.plan.action)),
    )


def _observations(estimator: Estimator | None, move: Move) -> tuple[int, ...]:
    """Per subgoal, the decision whose panorama its estimates come from; there is one panorama per decision."""
    # What was seen on the way has no number among the decisions: such answers come from no single panorama of theirs.
    if looks_on_the_way(estimator):
        return ()
    # A subgoal may be out of sight from here and be known from an earlier panorama.
    numbers = observations_of(estimator, move.subgoals)
    return () if numbers is None else tuple(np.asarray(numbers)[np.asarray(move.subgoals.mask)].tolist())


def _recorded_index(move: Move, action: int) -> int | None:
    """Index of an action in the task's own arrays: records do not depend on how a trial padded its edges."""
    if action == NO_ACTION or move.search is None:
        return None
    # Padded edges lengthen each subgoal's row of actions; finish, after the last row, is renumbered likewise.
    edge_mask = np.asarray(move.search.problem.task.edge_mask)
    subgoal, edge = divmod(action, len(edge_mask))
    return subgoal * int(np.sum(edge_mask)) + edge


def _action_records(move: Move) -> tuple[ActionRecord, ...]:
    """The available actions at the root, as the search saw them."""
    if move.search is None:
        return ()
    edges, cells = np.asarray(move.search.problem.task.edges), np.asarray(move.subgoals.cells)
    # Whole arrays are fetched once: an array on the device read number by number would be fetched as often.
    terms = {
        field.name: np.asarray(getattr(move.search.terms, field.name)) for field in dataclasses.fields(ActionTerms)
    }
    q_values, visits = np.asarray(move.search.plan.q_values), np.asarray(move.search.plan.visits)
    records = []
    # Nothing is recorded of actions that cannot be taken: most of subgoals times edges.
    for index in np.flatnonzero(terms["available"]):
        subgoal, edge = divmod(int(index), len(edges))
        # The last action, beyond all pairs of subgoal and edge, is to finish in known space.
        finish = subgoal == len(cells)
        recorded = _recorded_index(move, int(index))
        assert recorded is not None
        records.append(
            ActionRecord(
                index=recorded,
                subgoal=None if finish else subgoal,
                cell=None if finish else as_cell(cells[subgoal]),
                from_state=None if finish else int(edges[edge, 0]),
                to_state=None if finish else int(edges[edge, 1]),
                success_probability=float(terms["success_probability"][index]),
                success_cost=float(terms["success_cost"][index]),
                failure_cost=float(terms["failure_cost"][index]),
                distance=float(terms["distance"][index]),
                q_value=float(q_values[index]),
                visits=int(visits[index]),
            )
        )
    return tuple(records)
