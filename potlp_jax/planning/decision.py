"""A decision from estimates that are already there: for callers who bring their own estimator, or their own map.

``policies.decide`` asks an estimator in the middle of a decision. Here the decision is cut in two pure functions, so
that whatever happens in between is the caller's: ``frontier_subgoals`` says where estimates are wanted, and
``decide_from_estimates`` takes them. Both run under jit, vmap and scan.

Belief and task carry the names of their propositions, and are refused where these differ. What cannot be checked is
what the caller alone knows: whether the letters of a belief were written with the names that it was given, and whether
column ``c`` of the estimates answers outcome class ``c`` of this task.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int32, PRNGKeyArray

from potlp_jax.errors import ProblemError
from potlp_jax.planning.commitment import Intention
from potlp_jax.planning.estimates import Estimates, check_shapes
from potlp_jax.planning.move import Move
from potlp_jax.planning.policies import search_move
from potlp_jax.planning.shapes import require_shapes
from potlp_jax.planning.situation import DecisionConfig, assess, is_in_map
from potlp_jax.precision import in_32_bits, whole_numbers
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_SUBGOAL, UNREACHABLE, CellLike, StateLike, Status, status_array, status_if
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap


@in_32_bits
def frontier_subgoals(
    belief: BeliefMap,
    cell: CellLike,
    state: StateLike,
    task: TaskArrays,
    config: DecisionConfig = DecisionConfig(),
) -> Subgoals:
    """The subgoals of a belief, nearest first by product distance from the robot (docs/model.md section 6).

    For ``jax.jit``, with ``config`` static: without it parts are compiled anew in every call.

    Args:
      belief: what is known of the map.
      cell: the robot's cell, which the belief knows to be free.
      state: the automaton's state, the letter of the robot's cell read.
      task: arrays of the task.
      config: ``config.frontiers`` is what matters here.

    Returns:
      Where estimates are wanted.

    Raises:
      PropositionsError: belief and task are not over the same propositions.
      ProblemError: cell or state are no whole numbers, the task is not its arrays, or an array has another shape.
    """
    return assess(belief, cell, state, task, config.frontiers, config.irrevocable_last).subgoals


def subgoals_at(cells: Int32[Array, "S 2"], mask: Bool[Array, " S"], height: int, width: int) -> Subgoals:
    """Subgoals of the caller's own: known free cells where the robot may leave known space.

    What only the library's own search for frontiers knows (sizes, distances, components) is left empty.

    Args:
      cells: row and column of each.
      mask: True where a subgoal is real.
      height: rows of the map.
      width: its columns.

    Returns:
      The subgoals.

    Raises:
      ProblemError: the cells are no whole numbers, or cells and mask are not of as many subgoals.
    """
    cells = whole_numbers(cells, "cells", ProblemError)
    count = mask.shape[0]
    require_shapes({"mask": (mask, (count,)), "cells": (cells, (count, 2))}, "the mask has one entry a subgoal")
    return Subgoals(
        cells=cells,
        mask=mask,
        size=mask.astype(jnp.int32),
        distance=jnp.full(count, UNREACHABLE, jnp.float32),
        component=jnp.full((height, width), NO_SUBGOAL, jnp.int32),
        frontier=jnp.zeros((height, width), bool),
        status=status_array(),
    )


@in_32_bits
def decide_from_estimates(
    belief: BeliefMap,
    subgoals: Subgoals,
    estimates: Estimates,
    task: TaskArrays,
    cell: CellLike,
    state: StateLike,
    key: PRNGKeyArray,
    config: DecisionConfig = DecisionConfig(),
    intention: Intention | None = None,
) -> Move:
    """The next move of PO-TLP (Bradley et al. 2021, Algorithm 1): choice and path target.

    Pure; jit with ``config`` static. With the subgoals of ``frontier_subgoals`` and the estimates of an estimator the
    move is that of ``policies.decide`` with the same estimator and key.

    Args:
      belief: what is known of the map.
      subgoals: where the robot may leave known space: ``cells`` and ``mask`` matter. ``frontier_subgoals`` finds
        them, or they are the caller's own, by ``subgoals_at``.
      estimates: P_S, R_S and R_F for these subgoals, in their order.
      task: arrays of the task.
      cell: the robot's cell, which the belief knows to be free.
      state: the automaton's state, the letter of the robot's cell read.
      key: drives the search where it samples (``UctConfig``).
      config: settings; ``config.frontiers`` counts where no action is available and the robot falls back on the
        nearest frontier.
      intention: ``Move.intention`` of the decision before, for ``config.commitment``; without one the robot chooses
        afresh.

    Returns:
      The move, with what the search considered. Where an input holds a value that is not allowed (an estimate of a real
      subgoal and class, a real subgoal outside of the map, a cell that is not free, the state, a letter, the
      resolution), ``status`` has ``INVALID`` and ``action`` is ``NO_ACTION``. With wrong estimates alone the move is
      that of the baseline, which asks none; otherwise there is none.

    Raises:
      EstimatesError: an array of the estimates has another shape than ``[S, C]``.
      ProblemError: another argument has a wrong shape.
      PropositionsError: belief and task are not over the same propositions.
    """
    # Assessed again, although the caller may have called `frontier_subgoals`: arrays in between are the caller's.
    situation = assess(belief, cell, state, task, config.frontiers, config.irrevocable_last)
    require_shapes({"subgoals.cells": (subgoals.cells, (*subgoals.mask.shape, 2))}, "the mask has one entry a subgoal")
    check_shapes(estimates, subgoals.mask.shape[0], task.class_mask.shape[0])
    # The frontiers themselves stay those of the belief: they count where no action is available.
    given = dataclasses.replace(situation.subgoals, cells=subgoals.cells, mask=subgoals.mask)
    # Outside of the map an index would be clamped, and the distances of another cell be taken for those of the subgoal.
    outside = status_if(jnp.any(subgoals.mask & ~is_in_map(subgoals.cells, belief)), Status.INVALID)
    situation = dataclasses.replace(situation, subgoals=given, status=situation.status | outside)
    return search_move(situation.with_status_of(estimates), estimates, key, config, intention)
