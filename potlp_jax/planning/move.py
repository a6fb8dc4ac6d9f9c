"""The answer of a decision: where the robot goes next, and what is recorded with it."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, UInt32

from potlp_jax.planning.commitment import Intention
from potlp_jax.planning.distances.paths import KnownPath, shortest_path
from potlp_jax.planning.history import ActionTerms
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.plan import Plan
from potlp_jax.planning.situation import DecisionConfig, Situation
from potlp_jax.precision import in_32_bits
from potlp_jax.types import NO_ACTION, Status, status_array, status_if
from potlp_jax.world.frontiers import Subgoals


class MoveKind:
    """What a move is for; values of ``Move.kind``."""

    # Nowhere to go.
    NONE = 0
    # To acceptance, through known space.
    FINISH = 1
    # To the subgoal of a high-level action.
    ACTION = 2
    # To the nearest frontier, by a policy that does not search.
    FRONTIER = 3
    # To the nearest frontier, because no high-level action is available or the estimates are invalid.
    FALLBACK = 4
    # Along the path that would be shortest if the unobserved suited the task.
    OPTIMISTIC = 5


@struct.dataclass(kw_only=True)
class Search:
    """What a policy that searches considered.

    Attributes:
      problem: the planning problem of the decision.
      plan: what the search found, before the commitment to an earlier choice is applied.
      terms: D, P_S, R_S and R_F of every action at the root; no action is available where the problem is invalid.
    """

    problem: PlanningProblem
    plan: Plan
    terms: ActionTerms


@struct.dataclass(kw_only=True)
class Move:
    """Where to go next.

    Attributes:
      kind: one of ``MoveKind``.
      target_cell: cell to which the path leads.
      target_state: state of the automaton there.
      action: the high-level action that is carried out: that of ``search.plan``, or the one that the robot is committed
        to; ``NO_ACTION`` for policies that do not search.
      value: expected cost to go, inf where it is not known because the inputs are invalid; for policies that do not
        search the cost of the path, inf for NONE.
      path: through known space, at most ``DecisionConfig.horizon`` moves of it.
      subgoals: of the current belief.
      search: what was considered; None for policies that do not search.
      intention: for the next decision.
      status: bits of ``types.Status``.
    """

    kind: Int32[Array, "*batch"]
    target_cell: Int32[Array, "*batch 2"]
    target_state: Int32[Array, "*batch"]
    action: Int32[Array, "*batch"]
    value: Float32[Array, "*batch"]
    path: KnownPath
    subgoals: Subgoals
    search: Search | None
    intention: Intention
    status: UInt32[Array, "*batch"]


@in_32_bits
def move_to(
    situation: Situation,
    config: DecisionConfig,
    kind: Int32[Array, ""],
    target_cell: Int32[Array, "2"],
    target_state: Int32[Array, ""],
    value: Float32[Array, ""],
    action: Int32[Array, ""] | None = None,
    search: Search | None = None,
    intention: Intention | None = None,
    status: UInt32[Array, ""] | None = None,
) -> Move:
    """The move to a product state in known space: the shortest path there, and what goes into the record.

    Args:
        situation: of the decision.
        config: settings; ``config.path_horizon`` limits the path.
        kind: one of ``MoveKind``; NONE stays where the robot is.
        target_cell: where to go; a known free cell.
        target_state: the automaton's state in which to arrive there, such that its distance is finite: in
            ``situation.all_distances`` for FINISH, otherwise in ``situation.distances``.
        value: what the policy expects the task to cost from here; for the record.
        action: index of the chosen action, where the policy searches.
        search: what it considered, where it searches.
        intention: for the next decision.
        status: bits to report beside those of the situation.

    Returns:
        The move; its path has length 0 where the target is out of reach. NONE where the situation is not valid.
    """
    kind = jnp.where(situation.is_valid, kind, MoveKind.NONE)
    # The path of a robot that stays leads to where it is, so that its length is 0.
    goes = kind != MoveKind.NONE
    cell = jnp.where(goes, target_cell, situation.cell).astype(jnp.int32)
    state = jnp.where(goes, target_state, situation.state).astype(jnp.int32)
    path = shortest_path(
        *situation.moves_for(kind == MoveKind.FINISH),
        situation.belief.free,
        situation.cell,
        situation.state,
        cell,
        state,
        horizon=config.horizon(*situation.belief.cells.shape),
        resolution=situation.belief.resolution,
    )
    # What was cut off among the subgoals, or forgotten by the estimator, concerns every move that was chosen here.
    bits = status_array() if status is None else status
    # What a search found stays beside its move, also where the robot stays: it is what the task costs by it.
    cost = value if search is not None else jnp.where(goes, value, jnp.inf)
    return Move(
        kind=kind.astype(jnp.int32),
        target_cell=cell,
        target_state=state,
        action=jnp.int32(NO_ACTION) if action is None else action,
        value=cost,
        path=path,
        subgoals=situation.subgoals,
        search=search,
        intention=Intention.none() if intention is None else intention,
        status=bits | situation.status | status_if(~goes, Status.NO_FRONTIER),
    )
