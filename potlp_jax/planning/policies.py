"""Policies: from what the robot knows (``situation``) to where it goes next (``move``).

One jitted function, ``decide``, serves them all.

* ``known_map`` and ``baseline`` finish in known space where they can; otherwise they go to the nearest frontier that
  violates nothing (after Ayala et al. 2013). ``known_map`` is the same rule on a map that is revealed from the start.
* ``optimistic`` takes an unobserved cell to be free and to carry whatever letter suits the task.
* ``potlp`` and ``oracle`` plan with high-level actions (Bradley et al. 2021, Algorithm 1), with estimates from a
  trained network and from the true map.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021.
  Ayala et al., Temporal Logic Motion Planning in Unknown Environments, IROS 2013.
"""

import dataclasses
import functools
from enum import StrEnum
from typing import Any, Protocol, cast, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from potlp_jax import plugins
from potlp_jax.errors import PluginError
from potlp_jax.planning.commitment import Intention, apply_commitment, intention_of
from potlp_jax.planning.distances.paths import KnownPath, shortest_path
from potlp_jax.planning.distances.product import (
    one_letter_successors,
    product_distances,
)
from potlp_jax.planning.distances.sweeping import Wildcard
from potlp_jax.planning.estimates import Estimates, Estimator, ask
from potlp_jax.planning.history import action_terms, initial_history
from potlp_jax.planning.move import Move, MoveKind, Search, move_to
from potlp_jax.planning.problem import PlanningProblem, screen
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.search.plan import Plan
from potlp_jax.planning.situation import (
    DecisionConfig,
    Situation,
    assess,
    cell_and_state,
    nearest_frontier,
    planning_problem,
)
from potlp_jax.precision import in_32_bits
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_ACTION, CellLike, StateLike, Status, status_if
from potlp_jax.world.grid import BeliefMap


class Policy(StrEnum):
    """The planners that a trial can run (docs/model.md section 8)."""

    KNOWN_MAP = "known-map"
    BASELINE = "baseline"
    OPTIMISTIC = "optimistic"
    ORACLE = "oracle"
    POTLP = "potlp"

    @property
    def searches(self) -> bool:
        """Whether it weighs high-level actions, and needs an estimator."""
        return self in (Policy.ORACLE, Policy.POTLP)


@in_32_bits
def decide(
    belief: BeliefMap,
    cell: CellLike,
    state: StateLike,
    task: TaskArrays,
    estimator: Estimator | None,
    key: PRNGKeyArray,
    intention: Intention | None = None,
    *,
    policy: "Policy | PolicyFunction | str",
    config: DecisionConfig,
) -> Move:
    """The next move of ``policy``: pure, for jit and vmap.

    Args:
        belief: what is known of the map.
        cell: the robot's cell, which the belief knows to be free.
        state: the automaton's state, the letter of the robot's cell read.
        task: arrays of the task, ``task.arrays``.
        estimator: answers P_S, R_S and R_F for the policies that ask; None for the others.
        key: for what the policy draws: of the searches ``UctConfig`` alone.
        intention: that of the move before; without one the robot chooses afresh.
        policy: one of the library's, also by its name, or a function of the user's; static.
        config: settings; static.

    Returns:
        The move; its path has length 0 where the target is out of reach. Where cell, state, a letter or the resolution
        is not allowed, ``status`` has ``INVALID`` and the kind is NONE.

    Raises:
        PropositionsError: belief, task and estimator are not over the same propositions.
        ValueError: the policy searches and there is no estimator.
        EstimatesError: the estimator's answer has other shapes than were asked for.
        ProblemError: cell or state are no whole numbers, the task is not its arrays, or an array has another shape.
        PluginError: there is no policy of the name, or the user's returned no move.
    """
    situation = assess(belief, cell, state, task, config.frontiers, config.irrevocable_last)
    estimates = None if estimator is None else ask(estimator, belief, situation.subgoals, task, situation.state)
    situation = situation.with_status_of(estimates)
    intention = Intention.none() if intention is None else intention
    return policy_function(policy)(situation, estimates, key, config, intention)


@runtime_checkable
class PolicyFunction(Protocol):
    """What a policy is: from a situation to a move. Any function of this signature can be given to ``run_trial``,
    ``run_robot`` and ``run_batch`` in place of a ``Policy``.

    It is traced by jit, and by vmap in batches: pure, without Python branches on array values. It is a static argument,
    so that a function that is made anew for every trial is compiled anew for every trial.

    Args:
        situation: belief, task, robot's cell and automaton state, subgoals, distances in known space and the nearest
            end of the task in it.
        estimates: P_S, R_S and R_F of the subgoals in ``situation.subgoals``; None where the trial has no estimator.
        key: of this decision; for whatever the policy draws.
        config: settings.
        intention: ``Move.intention`` of the decision before.

    Returns:
        The move; ``move_to`` makes one from a target.
    """

    def __call__(
        self,
        situation: Situation,
        estimates: Estimates | None,
        key: PRNGKeyArray,
        config: DecisionConfig,
        intention: Intention,
        /,
    ) -> Move: ...


def policy_function(policy: Policy | PolicyFunction | str) -> PolicyFunction:
    """The function of a policy: that of the name, or the function itself."""
    policy = named_policy(policy)
    # A user's function is called like the library's own: there is one signature.
    if not isinstance(policy, Policy):
        return functools.partial(_reported_move, policy)
    if policy.searches:
        return search_move
    return lambda situation, _estimates, _key, config, _intention: direct_move(situation, policy, config)


def _reported_move(policy: PolicyFunction, situation: Situation, *arguments: Any) -> Move:
    """The move of a user's function with the bits of its situation, also where it was not made by ``move_to``."""
    move = policy(situation, *arguments)
    if not isinstance(move, Move):
        raise PluginError(
            f"policy {policy_name(policy)} returned {type(move).__name__}, expected a Move, as planning.move.move_to "
            "makes it"
        )
    move = dataclasses.replace(move, status=move.status | situation.status)
    return _unless_impossible(situation, move)


def _unless_impossible(situation: Situation, move: Move) -> Move:
    """A user's move; none, flagged INVALID, where its path is no path: simulators believe it, and robots would."""
    path, free = move.path, situation.belief.free
    (row, column), (next_row, next_column) = path.cells[:-1].T, path.cells[1:].T
    step = jnp.maximum(jnp.abs(next_row - row), jnp.abs(next_column - column))
    is_inside = jnp.all((path.cells[1:] >= 0) & (path.cells[1:] < jnp.array(free.shape, jnp.int32)[None]), axis=1)
    # Diagonally past no obstacle's corner.
    passes = free[next_row, next_column] & free[row, next_column] & free[next_row, column]
    leads = (path.states[1:] >= 0) & (
        situation.all_transitions[next_row, next_column, path.states[:-1]] == path.states[1:]
    )
    is_made = jnp.arange(step.shape[0], dtype=jnp.int32) < path.length
    begins = jnp.all(path.cells[0] == situation.cell) & (path.states[0] == situation.state)
    possible = begins & (path.length <= step.shape[0])
    possible &= jnp.all(~is_made | ((step == 1) & is_inside & passes & leads))
    stays = KnownPath(
        cells=jnp.broadcast_to(situation.cell, path.cells.shape),
        states=jnp.broadcast_to(situation.state, path.states.shape),
        length=jnp.int32(0),
        cost=jnp.float32(jnp.inf),
    )
    return dataclasses.replace(
        move,
        kind=jnp.where(possible, move.kind, MoveKind.NONE),
        path=jax.tree.map(lambda mine, other: jnp.where(possible, mine, other), path, stays),
        status=move.status | status_if(~possible, Status.INVALID),
    )


def direct_move(situation: Situation, policy: Policy, config: DecisionConfig) -> Move:
    """The move of a policy that does not search.

    Args:
        situation: known space, assessed from the robot's product state.
        policy: ``optimistic``; every other one moves as the baseline does.
        config: ``path_horizon`` is what matters here.

    Returns:
        The move; it has the kind NONE where there is none.
    """
    if policy is not Policy.OPTIMISTIC:
        return _finish_or_frontier(situation, config)
    return _unless_withheld(situation, _optimistic(situation, config), config)


def named_policy(policy: Policy | PolicyFunction | str) -> Policy | PolicyFunction:
    """The policy of a name, or the function itself.

    Args:
        policy: a function; or the name of one of the library's policies; or ``module:attribute``, or an entry point in
            the group ``potlp_jax.policies``, of a function.

    Returns:
        One of the library's policies, or a function.

    Raises:
        PluginError: there is none of the name, or it is no function.
    """
    if not isinstance(policy, str):
        return policy
    # ``known_map`` is as good as ``known-map``.
    own = policy.strip().replace("_", "-")
    if own in list(Policy):
        return Policy(own)
    found = plugins.load(policy, group=plugins.POLICIES, kind="policy", known=list(Policy))
    if not isinstance(found, PolicyFunction):
        raise PluginError(f"policy {policy!r}: {type(found).__name__} is no function (PolicyFunction)")
    # Its signature is checked when it is called.
    return cast(PolicyFunction, found)


def policy_name(policy: Policy | PolicyFunction) -> str:
    """What a policy is called in records: its name, or ``module:attribute`` of a function."""
    if isinstance(policy, Policy):
        return policy.value
    return plugins.reference_of(policy)


def _finish_or_frontier(situation: Situation, config: DecisionConfig) -> Move:
    """The baseline: finish in known space where possible, otherwise the nearest frontier that violates nothing."""
    # Distances are those of the product, in which no path violates the task: traps are left out of it.
    frontier_cell, frontier_state, frontier_cost = nearest_frontier(situation)
    finishes = jnp.isfinite(situation.finish_cost)
    value = jnp.where(finishes, situation.finish_cost, frontier_cost)
    kind = jnp.where(finishes, MoveKind.FINISH, jnp.where(jnp.isfinite(value), MoveKind.FRONTIER, MoveKind.NONE))
    target_cell = jnp.where(finishes, situation.finish_cell, frontier_cell)
    target_state = jnp.where(finishes, situation.finish_state, frontier_state)
    return move_to(situation, config, kind, target_cell, target_state, value)


def search_move(
    situation: Situation,
    estimates: Estimates | None,
    key: PRNGKeyArray,
    config: DecisionConfig,
    intention: Intention | None = None,
) -> Move:
    """PO-TLP (Bradley et al. 2021, Algorithm 1): search, and go toward the chosen action's subgoal.

    Args:
        situation: known space, assessed from the robot's product state.
        estimates: P_S, R_S and R_F of the situation's subgoals.
        key: drives the search where it samples (``UctConfig``).
        config: settings.
        intention: that of the decision before; None without one.

    Returns:
        The move; toward the nearest frontier where no action is available, that of the baseline where the estimates
        are invalid.

    Raises:
        ValueError: there are no estimates.
        ProblemError: an array of the estimates has another shape than subgoals and classes.
    """
    if estimates is None:
        raise ValueError("a policy that searches needs an estimator")
    problem = planning_problem(situation, estimates, config)
    plan = plan_actions(problem, key, config.search)
    return planned_move(situation, problem, plan, Intention.none() if intention is None else intention, config)


def planned_move(
    situation: Situation, problem: PlanningProblem, plan: Plan, intention: Intention, config: DecisionConfig
) -> Move:
    """The move that carries out the plan of a situation's problem, or the action that the robot is committed to.

    Args:
        situation: known space, assessed from the robot's product state.
        problem: posed by the situation.
        plan: found for the problem.
        intention: that of the decision before.
        config: ``commitment`` and ``path_horizon`` matter.

    Returns:
        The move.
    """
    # What the search found is recorded as found; the commitment is applied to what the robot does.
    task, subgoals = situation.task, situation.subgoals
    screened, invalid = screen(problem)
    search = Search(problem=problem, plan=plan, terms=action_terms(screened, initial_history(screened)))
    plan = apply_commitment(plan, intention, situation.state, subgoals, task, jnp.float32(config.commitment))

    # Without an available action the estimates say that the task is impossible. They may be wrong, so the robot
    # explores as the baseline would, and the move is flagged. Where they are invalid it does the same; then known space
    # may already hold the end of the task, which needs no estimates.
    frontier_cell, frontier_state, frontier_cost = nearest_frontier(situation)
    finishes = plan.action == subgoals.mask.shape[0] * task.edge_mask.shape[0]
    # A task that is done needs none either.
    finishes |= (invalid | task.accepting[situation.state]) & jnp.isfinite(situation.finish_cost)
    acts = (plan.action != NO_ACTION) & ~finishes
    falls_back = (plan.action == NO_ACTION) & jnp.isfinite(frontier_cost)
    kind = jnp.where(falls_back, MoveKind.FALLBACK, jnp.where(acts, MoveKind.ACTION, MoveKind.NONE))
    kind = jnp.where(finishes, MoveKind.FINISH, kind)
    target_cell = jnp.where(acts, subgoals.cells[jnp.maximum(plan.subgoal, 0)], frontier_cell)
    target_cell = jnp.where(finishes, situation.finish_cell, target_cell)
    target_state = jnp.where(acts, plan.from_state, frontier_state)
    target_state = jnp.where(finishes, situation.finish_state, target_state)
    status = plan.status | status_if(kind == MoveKind.FALLBACK, Status.FALLBACK)
    return move_to(
        situation,
        config,
        kind,
        target_cell,
        target_state,
        plan.value,
        action=plan.action,
        search=search,
        intention=intention_of(plan, situation.state, subgoals, task),
        status=status,
    )


def _optimistic(situation: Situation, config: DecisionConfig) -> Move:
    """Shortest path to acceptance if unobserved cells were free and carried any letter that violates nothing."""
    belief, task = situation.belief, situation.task
    # One letter per unobserved cell, whichever helps most; letters that lead to a trap do not exist for the path.
    wildcard = Wildcard(cells=belief.unknown, successors=one_letter_successors(task))
    free = belief.free | belief.unknown
    distances = product_distances(
        situation.transitions, free, situation.cell[None], situation.state[None], belief.resolution, wildcard
    )[0]
    accepted = jnp.where(task.accepting[None, None, :], distances, jnp.inf)
    target_cell, target_state = cell_and_state(jnp.argmin(accepted.reshape(-1)), accepted.shape)
    # Where no move follows from the inputs the path leads to where the robot is, as that of `move_to` does.
    target_cell = jnp.where(situation.is_valid, target_cell, situation.cell)
    target_state = jnp.where(situation.is_valid, target_state, situation.state)
    path = shortest_path(
        distances,
        situation.transitions,
        free,
        situation.cell,
        situation.state,
        target_cell,
        target_state,
        horizon=config.horizon(*belief.cells.shape),
        resolution=belief.resolution,
        wildcard=wildcard,
    )
    # The robot follows the path while its cells are known, and decides again with what it sees from there.
    known = _cut_before_unobserved(path, belief)
    kind = jnp.where(jnp.isfinite(path.cost), MoveKind.OPTIMISTIC, MoveKind.NONE)
    # A path that needs nothing unobserved ends the task.
    kind = jnp.where(jnp.isfinite(situation.finish_cost) & (known.length == path.length), MoveKind.FINISH, kind)
    kind = jnp.where(situation.is_valid, kind, MoveKind.NONE)
    return Move(
        kind=kind.astype(jnp.int32),
        target_cell=known.cells[known.length],
        target_state=known.states[known.length],
        action=jnp.int32(NO_ACTION),
        value=jnp.where(kind == MoveKind.NONE, jnp.inf, path.cost),
        path=known,
        subgoals=situation.subgoals,
        search=None,
        intention=Intention.none(),
        status=situation.status | status_if(kind == MoveKind.NONE, Status.NO_FRONTIER),
    )


def _unless_withheld(situation: Situation, move: Move, config: DecisionConfig) -> Move:
    """The optimistic move; that of the baseline where it relied on a move that is withheld.

    A path through unobserved cells alone may be longer than the known one to acceptance, or not exist, because
    irrevocable moves are withheld from it.
    """
    if not config.irrevocable_last:
        return move
    # Infinite on both sides: no path, known or hoped for. A frontier may be left nevertheless.
    beaten = jnp.any(situation.task.irrevocable) & (situation.finish_cost <= move.value)
    return jax.lax.cond(beaten, lambda: _finish_or_frontier(situation, config), lambda: move)


def _cut_before_unobserved(path: KnownPath, belief: BeliefMap) -> KnownPath:
    """The part of a path before its first unobserved cell: a path never enters one (docs/model.md section 7)."""
    # The first cell is the robot's own: it remains, also where no move is valid because it has not been observed.
    hidden = belief.unknown[path.cells[:, 0], path.cells[:, 1]]
    index = jnp.arange(hidden.shape[0], dtype=jnp.int32)
    first_hidden = jnp.min(jnp.where(hidden, index, path.length + 1))
    length = jnp.minimum(path.length, jnp.maximum(first_hidden - 1, 0))
    kept = jnp.minimum(index, length)
    return dataclasses.replace(path, cells=path.cells[kept], states=path.states[kept], length=length)
