"""Policies: from what the robot knows to where it goes next. One jitted function, ``decide``, serves them all.

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
from enum import StrEnum
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, PRNGKeyArray, UInt32

from potlp_jax import plugins
from potlp_jax.errors import PluginError
from potlp_jax.planning.commitment import Intention, apply_commitment, intention_of
from potlp_jax.planning.distances.paths import KnownPath, shortest_path
from potlp_jax.planning.distances.product import (
    distance_table,
    one_letter_successors,
    product_distances,
    product_transitions,
    reachable_cells,
    reachable_states,
)
from potlp_jax.planning.distances.sweeping import Wildcard
from potlp_jax.planning.estimates import Estimates, Estimator, ask
from potlp_jax.planning.history import ActionTerms, action_terms, initial_history
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import Plan, plan_actions
from potlp_jax.planning.search.config import SearchConfig, UctConfig
from potlp_jax.task.task import TaskArrays
from potlp_jax.types import NO_ACTION, NO_STATE, Status, status_array, status_if
from potlp_jax.world.frontiers import FrontierConfig, Subgoals, find_subgoals
from potlp_jax.world.grid import BeliefMap

GROUP: str = "potlp_jax.policies"
"""Entry points of this group are policies of other packages."""


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


class MoveKind:
    """What a move is for; values of ``Move.kind``."""

    NONE = 0
    FINISH = 1
    ACTION = 2
    FRONTIER = 3
    FALLBACK = 4
    OPTIMISTIC = 5


@dataclasses.dataclass(frozen=True)
class DecisionConfig:
    """Settings of a decision. ``path_horizon`` is the number of moves that a decision hands out at most; None means
    ``4 (H + W)``. ``dead_end_factor`` times ``(H + W)`` times the resolution is the cost of a dead end (docs/model.md).
    ``commitment`` is by how much, as a fraction of its expected cost, another action must be cheaper before a robot on
    its way turns to it; 0: at once, as published."""

    frontiers: FrontierConfig = FrontierConfig()
    search: SearchConfig | UctConfig = SearchConfig()
    dead_end_factor: float = 4.0
    commitment: float = 0.15
    path_horizon: int | None = None

    def __post_init__(self) -> None:
        if self.commitment < 0.0:
            raise ValueError(f"commitment is {self.commitment}, must be at least 0")

    def horizon(self, height: int, width: int) -> int:
        """Moves in the path of one decision on a map of this size."""
        return self.path_horizon if self.path_horizon is not None else 4 * (height + width)


@struct.dataclass(kw_only=True)
class Search:
    """What a searching policy considered: the problem's root, its plan and the terms of every action."""

    problem: PlanningProblem
    plan: Plan
    terms: ActionTerms


@struct.dataclass(kw_only=True)
class Move:
    """Where to go next.

    ``kind`` is one of ``MoveKind``; ``target_cell`` and ``target_state`` say where the path leads in the product of
    known space; ``action`` is the planner's choice (``NO_ACTION`` for policies that do not search): that of
    ``search.plan``, or the one that the robot keeps to. ``value`` is the expected cost to go (for policies that do not
    search: the cost of the path, or ``inf`` for NONE). ``subgoals`` are those of the current belief; ``search`` is None
    for policies that do not search. ``intention`` is for the next decision.
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


@struct.dataclass(kw_only=True)
class Situation:
    """Known space as the planner sees it from the robot's product state.

    ``distances[cell, z]`` is the cost from the robot to the cell in state z; ``finish_cell`` and ``finish_state`` the
    nearest accepting product state at cost ``finish_cost`` (``inf`` where acceptance is out of reach).
    """

    belief: BeliefMap
    task: TaskArrays
    cell: Int32[Array, "*batch 2"]
    state: Int32[Array, "*batch"]
    transitions: Int32[Array, "*batch H W Z"]
    distances: Float32[Array, "*batch H W Z"]
    subgoals: Subgoals
    finish_cell: Int32[Array, "*batch 2"]
    finish_state: Int32[Array, "*batch"]
    finish_cost: Float32[Array, "*batch"]


def assess(
    belief: BeliefMap, cell: Int32[Array, "2"], state: Int32[Array, ""], task: TaskArrays, config: FrontierConfig
) -> Situation:
    """Distances, subgoals and the way to acceptance from the robot's product state."""
    # Nothing is left to do after acceptance: without moves of their own, accepting states need no sweep.
    moves = product_transitions(task, belief.letters, belief.free)
    transitions = jnp.where(task.accepting[None, None, :], NO_STATE, moves)
    distances = product_distances(transitions, belief.free, cell[None], state[None], belief.resolution)[0]
    nearest = jnp.min(distances, axis=2)
    reachable = reachable_cells(belief.free, cell, jnp.isfinite(nearest))
    subgoals = find_subgoals(belief, reachable, nearest, config)
    finish = jnp.where(task.accepting[None, None, :], distances, jnp.inf)
    finish_cell, finish_state = _unravel(jnp.argmin(finish.reshape(-1)), finish.shape)
    return Situation(
        belief=belief,
        task=task,
        cell=cell,
        state=state,
        transitions=transitions,
        distances=distances,
        subgoals=subgoals,
        finish_cell=finish_cell,
        finish_state=finish_state,
        finish_cost=jnp.min(finish),
    )


def decide(
    belief: BeliefMap,
    cell: Int32[Array, "2"],
    state: Int32[Array, ""],
    task: TaskArrays,
    estimator: Estimator | None,
    key: PRNGKeyArray,
    intention: Intention | None = None,
    *,
    policy: "Policy | PolicyFunction",
    config: DecisionConfig,
) -> Move:
    """The next move of ``policy``: pure, for jit and vmap.

    Args:
        belief: what is known of the map.
        cell: the robot's cell.
        state: the automaton's state, the letter of the robot's cell read.
        task: arrays of the task.
        estimator: answers P_S, R_S and R_F for the policies that ask; None for the others.
        key: drives the search.
        intention: that of the move before; without one the robot chooses afresh.
        policy: one of the library's or a function of the user's; static.
        config: settings; static.

    Returns:
        The move; its path has length 0 where the target is out of reach.

    Raises:
        ValueError: the policy searches and there is no estimator.
    """
    situation = assess(belief, cell, state, task, config.frontiers)
    estimates = None if estimator is None else ask(estimator, belief, situation.subgoals, task, state)
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


def policy_function(policy: Policy | PolicyFunction) -> PolicyFunction:
    """The function of a policy: that of the name, or the function itself."""
    if not isinstance(policy, Policy):
        return policy
    if policy.searches:
        return search_move
    return lambda situation, _estimates, _key, config, _intention: direct_move(situation, policy, config)


def direct_move(situation: Situation, policy: Policy, config: DecisionConfig) -> Move:
    """The move of a policy that does not search."""
    return _optimistic(situation, config) if policy is Policy.OPTIMISTIC else _finish_or_frontier(situation, config)


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
    found = plugins.load(policy, group=GROUP, kind="policy", known=list(Policy))
    if not callable(found):
        raise PluginError(f"policy {policy!r}: {type(found).__name__} is no function (PolicyFunction)")
    return found


def policy_name(policy: Policy | PolicyFunction) -> str:
    """What a policy is called in records: its name, or ``module:attribute`` of a function."""
    if isinstance(policy, Policy):
        return policy.value
    return plugins.reference_of(policy)


def planning_problem(situation: Situation, estimates: Estimates, config: DecisionConfig) -> PlanningProblem:
    """The dense problem of a situation: travel through known space, and what lies beyond each subgoal."""
    task, subgoals = situation.task, situation.subgoals
    travel, finish = _subgoal_travel(situation, estimates)
    at_subgoals = situation.distances[subgoals.cells[:, 0], subgoals.cells[:, 1]]
    at_robot = jnp.arange(task.transitions.shape[0])[:, None, None] == situation.state
    robot_travel = jnp.where(at_robot & subgoals.mask[None, :, None], at_subgoals[None], jnp.inf)
    robot_finish = jnp.where(at_robot[:, 0, 0], situation.finish_cost, jnp.inf)
    belief = situation.belief
    size = jnp.sum(belief.extent).astype(jnp.float32)
    return PlanningProblem.from_arrays(
        task,
        travel=jnp.concatenate([travel, robot_travel[None]]),
        finish=jnp.concatenate([finish, robot_finish[None]]),
        success_probability=estimates.success_probability,
        success_cost=estimates.success_cost,
        failure_cost=estimates.failure_cost,
        dfa_state=situation.state,
        subgoal_mask=subgoals.mask,
        dead_end_cost=config.dead_end_factor * size * belief.resolution,
    )


def _subgoal_travel(
    situation: Situation, estimates: Estimates
) -> tuple[Float32[Array, "S Z S Z"], Float32[Array, "S Z"]]:
    """Costs from each subgoal in each state, after re-entering the subgoal's cell (docs/model.md section 5)."""
    task, subgoals = situation.task, situation.subgoals
    count, states = subgoals.mask.shape[0], task.transitions.shape[0]
    reentered = situation.transitions[subgoals.cells[:, 0], subgoals.cells[:, 1]]
    # Rollouts leave a subgoal only after an action there, so one where nothing can succeed needs no table; nor does
    # a state that no re-entry leads to from where the automaton can still get, or an accepting one.
    promising = subgoals.mask & jnp.any(estimates.success_probability > 0.0, axis=1)
    own = jnp.arange(states, dtype=jnp.int32)
    ahead = jnp.where(reachable_states(task, situation.state)[None], reentered, NO_STATE)
    needed = jnp.any(ahead[:, :, None] == own[None, None, :], axis=1) & promising[:, None] & ~task.accepting[None]
    sources = jnp.where(needed, own[None, :], NO_STATE)
    travel, finish = distance_table(
        situation.transitions,
        situation.belief.free,
        task.accepting,
        jnp.repeat(subgoals.cells, states, axis=0),
        sources.reshape(-1),
        subgoals.cells,
        situation.belief.resolution,
    )
    travel = jnp.where(subgoals.mask[None, :, None], travel, jnp.inf).reshape(count, states, count, states)
    finish = finish.reshape(count, states)
    subgoal = jnp.arange(count)[:, None]
    exists = reentered != NO_STATE
    # An accepting re-entry satisfies the task at once: nothing is left to pay.
    accepted = exists & task.accepting[reentered]
    finish = jnp.where(exists, jnp.where(accepted, 0.0, finish[subgoal, reentered]), jnp.inf)
    return jnp.where(exists[:, :, None, None], travel[subgoal, reentered], jnp.inf), finish


def _finish_or_frontier(situation: Situation, config: DecisionConfig) -> Move:
    """The baseline: finish in known space where possible, else the nearest frontier that violates nothing."""
    frontier_cell, frontier_state, frontier_cost = _nearest_frontier(situation)
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

    ``estimates`` are those of the situation's subgoals. Where no action is available: the nearest frontier.
    """
    if estimates is None:
        raise ValueError("a policy that searches needs an estimator")
    problem = planning_problem(situation, estimates, config)
    plan = plan_actions(problem, key, config.search)
    return planned_move(situation, problem, plan, Intention.none() if intention is None else intention, config)


def planned_move(
    situation: Situation, problem: PlanningProblem, plan: Plan, intention: Intention, config: DecisionConfig
) -> Move:
    """The move that carries out the plan of a situation's problem, or keeps to what the robot is on its way to."""
    task, subgoals = situation.task, situation.subgoals
    search = Search(problem=problem, plan=plan, terms=action_terms(problem, initial_history(problem)))
    plan = apply_commitment(plan, intention, situation.state, subgoals, task, jnp.float32(config.commitment))

    frontier_cell, frontier_state, frontier_cost = _nearest_frontier(situation)
    finishes = plan.action == subgoals.mask.shape[0] * task.edge_mask.shape[0]
    acts = (plan.action != NO_ACTION) & ~finishes
    falls_back = (plan.action == NO_ACTION) & jnp.isfinite(frontier_cost)
    kind = jnp.where(falls_back, MoveKind.FALLBACK, jnp.where(acts, MoveKind.ACTION, MoveKind.NONE))
    kind = jnp.where(finishes, MoveKind.FINISH, kind)
    target_cell = jnp.where(acts, subgoals.cells[jnp.maximum(plan.subgoal, 0)], frontier_cell)
    target_cell = jnp.where(finishes, situation.finish_cell, target_cell)
    target_state = jnp.where(acts, plan.from_state, frontier_state)
    target_state = jnp.where(finishes, situation.finish_state, target_state)
    status = plan.status | status_if(falls_back, Status.FALLBACK)
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
    wildcard = Wildcard(cells=belief.unknown, successors=one_letter_successors(task))
    free = belief.free | belief.unknown
    distances = product_distances(
        situation.transitions, free, situation.cell[None], situation.state[None], belief.resolution, wildcard
    )[0]
    accepted = jnp.where(task.accepting[None, None, :], distances, jnp.inf)
    target_cell, target_state = _unravel(jnp.argmin(accepted.reshape(-1)), accepted.shape)
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
    known = _cut_before_unobserved(path, belief)
    kind = jnp.where(jnp.isfinite(path.cost), MoveKind.OPTIMISTIC, MoveKind.NONE)
    kind = jnp.where(jnp.isfinite(situation.finish_cost) & (known.length == path.length), MoveKind.FINISH, kind)
    return Move(
        kind=kind.astype(jnp.int32),
        target_cell=known.cells[known.length],
        target_state=known.states[known.length],
        action=jnp.int32(NO_ACTION),
        value=path.cost,
        path=known,
        subgoals=situation.subgoals,
        search=None,
        intention=Intention.none(),
        status=situation.subgoals.status | status_if(kind == MoveKind.NONE, Status.NO_FRONTIER),
    )


def _cut_before_unobserved(path: KnownPath, belief: BeliefMap) -> KnownPath:
    """The part of a path before its first unobserved cell: a path never enters one (docs/model.md section 7)."""
    hidden = belief.unknown[path.cells[:, 0], path.cells[:, 1]]
    index = jnp.arange(hidden.shape[0], dtype=jnp.int32)
    first_hidden = jnp.min(jnp.where(hidden, index, path.length + 1))
    length = jnp.minimum(path.length, first_hidden - 1)
    kept = jnp.minimum(index, length)
    return dataclasses.replace(path, cells=path.cells[kept], states=path.states[kept], length=length)


def _nearest_frontier(situation: Situation) -> tuple[Int32[Array, "2"], Int32[Array, ""], Float32[Array, ""]]:
    """Nearest subgoal by product distance; where none can be reached, nearest frontier cell of any component."""
    cells, kept = situation.subgoals.cells, situation.subgoals.mask
    by_subgoal = jnp.full(situation.distances.shape, jnp.inf, jnp.float32)
    rows, columns = cells[:, 0], cells[:, 1]
    at_subgoals = jnp.where(kept[:, None], situation.distances[rows, columns], jnp.inf)
    by_subgoal = by_subgoal.at[rows, columns].min(at_subgoals)
    by_cell = jnp.where(situation.subgoals.frontier[:, :, None], situation.distances, jnp.inf)
    cost = jnp.where(jnp.isfinite(jnp.min(by_subgoal)), by_subgoal, by_cell)
    cell, state = _unravel(jnp.argmin(cost.reshape(-1)), cost.shape)
    return cell, state, jnp.min(cost)


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
        target_state: the automaton's state in which to arrive there, such that ``situation.distances`` is finite.
        value: what the policy expects the task to cost from here; for the record.
        action: index of the chosen action, where the policy searches.
        search: what it considered, where it searches.
        intention: for the next decision.
        status: bits to report beside those of the subgoals.

    Returns:
        The move; its path has length 0 where the target is out of reach.
    """
    goes = kind != MoveKind.NONE
    cell = jnp.where(goes, target_cell, situation.cell).astype(jnp.int32)
    state = jnp.where(goes, target_state, situation.state).astype(jnp.int32)
    path = shortest_path(
        situation.distances,
        situation.transitions,
        situation.belief.free,
        situation.cell,
        situation.state,
        cell,
        state,
        horizon=config.horizon(*situation.belief.cells.shape),
        resolution=situation.belief.resolution,
    )
    bits = status_array() if status is None else status
    return Move(
        kind=kind.astype(jnp.int32),
        target_cell=cell,
        target_state=state,
        action=jnp.int32(NO_ACTION) if action is None else action,
        value=value,
        path=path,
        subgoals=situation.subgoals,
        search=search,
        intention=Intention.none() if intention is None else intention,
        status=bits | situation.subgoals.status | status_if(~goes, Status.NO_FRONTIER),
    )


def _unravel(index: Int32[Array, ""], shape: tuple[int, ...]) -> tuple[Int32[Array, "2"], Int32[Array, ""]]:
    """Cell and state of an index into a flattened [H, W, Z] array."""
    _, width, states = shape
    index = index.astype(jnp.int32)
    return jnp.stack([index // (width * states), (index // states) % width]), index % states


decide_jit = jax.jit(decide, static_argnames=("policy", "config"))
"""``decide`` compiled: one compilation per policy, configuration and array shapes."""
