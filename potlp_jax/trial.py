"""Algorithm 1 of Bradley et al. 2021: observe, decide, advance - until the task is satisfied.

The loop knows a ``Robot`` only; the simulator is one, and a real robot is another observe and advance.
"""

import dataclasses
import importlib.metadata
import math
from collections import Counter
from collections.abc import Mapping
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, PRNGKeyArray

from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.history import ActionTerms
from potlp_jax.planning.policies import DecisionConfig, Move, MoveKind, Policy, assess, decide, planning_problem
from potlp_jax.planning.pouct import Plan, search_tree
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.product import KnownPath
from potlp_jax.planning.search_graph import SearchConfig, SearchMode, Tree
from potlp_jax.records import NEVER_SEEN, ActionRecord, Decision, Outcome, Trial
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.types import NO_ACTION
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.sensing import SensorConfig, observe

DIAGONAL: float = math.sqrt(2.0)
STUCK_REPEATS: int = 3
"""Decisions in the same cell, state and map after which a trial counts as stuck."""


@dataclasses.dataclass(frozen=True)
class TrialConfig:
    """Settings of a trial (MODEL.md section 7).

    ``replan_distance`` is in cells; ``budget_factor`` times the map's ``height + width`` cells may be travelled;
    ``revealed`` starts from the whole map.
    """

    decision: DecisionConfig = DecisionConfig()
    sensor: SensorConfig = SensorConfig()
    replan_distance: float = 4.0
    budget_factor: float = 20.0
    revealed: bool = False


@struct.dataclass(kw_only=True)
class Stop:
    """When a robot that follows a path hands back control.

    ``replan_distance`` (cells) applies once the map has changed since the decision: while nothing new is known there
    is nothing to decide, and keeping to the target is what makes every policy reach it (liveness).
    ``budget`` is what may still be travelled, in cells. ``is_frontier`` tells that the target is one, so that the
    robot stops when nothing unobserved is left beside it.
    """

    replan_distance: Float32[Array, "*batch"]
    budget: Float32[Array, "*batch"]
    is_frontier: Bool[Array, "*batch"]


@dataclasses.dataclass(frozen=True)
class Leg:
    """Cells entered on one advance, in order, the start left out."""

    cells: tuple[tuple[int, int], ...]


@runtime_checkable
class Robot(Protocol):
    """What the loop asks of a robot: a simulated one, or a real one."""

    def observe(self) -> tuple[BeliefMap, tuple[int, int]]:
        """The map as it is known now and the robot's cell."""
        ...

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Follow ``path`` through known space, observing at every cell, until it ends or ``stop`` says so."""
        ...


class SimulatedRobot:
    """A robot in a known ``World`` that sees along lines of sight."""

    def __init__(self, world: World, config: TrialConfig) -> None:
        self._world = world
        self._config = config
        self._cell = world.start
        self._steps = 0
        start = BeliefMap.revealed(world) if config.revealed else BeliefMap.unobserved(world)
        self._belief = _observe(start, world, world.start, config.sensor)
        self._first_seen = jnp.where(self._belief.unknown, NEVER_SEEN, 0).astype(jnp.int32)

    @property
    def first_seen(self) -> Int32[np.ndarray, "H W"]:
        """Step at which each cell was first observed, ``NEVER_SEEN`` where it was not."""
        return np.asarray(self._first_seen)

    def observe(self) -> tuple[BeliefMap, tuple[int, int]]:
        """The map as it is known now and the robot's cell."""
        return self._belief, _cell(self._cell)

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Follow ``path`` through known space, observing at every cell, until it ends or ``stop`` says so."""
        self._belief, self._first_seen, moved = _follow(
            self._world, self._belief, self._first_seen, path, jnp.int32(self._steps), stop, self._config.sensor
        )
        moved = int(moved)
        cells = np.asarray(path.cells)[1 : moved + 1]
        self._cell = path.cells[moved]
        self._steps += moved
        return Leg(cells=tuple(_cell(cell) for cell in cells))


def run_trial(
    world: World,
    task: Task,
    policy: Policy | str,
    key: PRNGKeyArray,
    config: TrialConfig | None = None,
    *,
    environment: str = "",
    seed: int | None = None,
    arrays: TaskArrays | None = None,
) -> Trial:
    """One trial of ``policy`` in ``world``, from its start to acceptance or failure.

    ``key`` drives the planner's search; the same arguments give the same trial. ``arrays`` are the task's device
    arrays where they shall be padded (default: ``task.arrays``). ``environment`` and ``seed`` go into the record.
    """
    policy = Policy(policy)
    config = TrialConfig() if config is None else config
    if policy is Policy.KNOWN_MAP:
        config = dataclasses.replace(config, revealed=True)
    estimator = TrueMapEstimator(world=world) if policy is Policy.ORACLE else None
    robot = SimulatedRobot(world, config)
    loop = Loop(robot, task, arrays if arrays is not None else task.arrays, policy, estimator, key, config)
    outcome = loop.run()
    return Trial(
        outcome=outcome,
        cost=loop.travelled * float(world.resolution),
        path=tuple(loop.path),
        word=tuple(loop.word),
        states=tuple(loop.states),
        decisions=tuple(loop.decisions),
        first_seen=robot.first_seen,
        world=world,
        task_text=task.text,
        task_hoa=task.to_hoa(),
        propositions=task.propositions,
        policy=policy.value,
        environment=environment,
        seed=seed,
        status=loop.status,
        config=dataclasses.asdict(config),
        versions=versions(),
    )


class Loop:
    """Observe, decide, advance: the state of a running trial. Distances in here are in cells."""

    def __init__(
        self,
        robot: Robot,
        task: Task,
        arrays: TaskArrays,
        policy: Policy,
        estimator: Estimator | None,
        key: PRNGKeyArray,
        config: TrialConfig,
    ) -> None:
        self._robot, self._task, self._arrays = robot, task, arrays
        self._policy, self._estimator, self._config = policy, estimator, config
        # The trial's key is folded by name, so that no policy's draws depend on another use of the key.
        self._key = jax.random.fold_in(key, _PLANNING)
        self._visits: Counter[tuple[tuple[int, int], int, int]] = Counter()
        belief, cell = robot.observe()
        letter = int(belief.letters[cell])
        self.travelled = 0.0
        self.path: list[tuple[int, int]] = [cell]
        self.word: list[int] = [letter]
        self.states: list[int] = [int(task.dfa.transitions[task.dfa.initial, letter])]
        self.decisions: list[Decision] = []
        self.status = 0

    def run(self) -> Outcome:
        """Loop until the task is satisfied or cannot go on."""
        while True:
            belief, cell = self._robot.observe()
            outcome = self._ended(belief, cell)
            if outcome is not None:
                return outcome
            move = self._decide(belief, cell)
            if int(move.kind) == MoveKind.NONE:
                return Outcome.INFEASIBLE
            self._advance(belief, move)

    def _ended(self, belief: BeliefMap, cell: tuple[int, int]) -> Outcome | None:
        state = self.states[-1]
        if self._task.dfa.accepting[state]:
            return Outcome.SATISFIED
        if self._task.dfa.trap[state]:
            return Outcome.INFEASIBLE
        if self.travelled >= self._budget(belief):
            return Outcome.BUDGET
        situation = (cell, state, int(jnp.sum(~belief.unknown)))
        self._visits[situation] += 1
        return Outcome.STUCK if self._visits[situation] >= STUCK_REPEATS else None

    def _budget(self, belief: BeliefMap) -> float:
        return self._config.budget_factor * float(np.sum(belief.extent))

    def _decide(self, belief: BeliefMap, cell: tuple[int, int]) -> Move:
        index = len(self.decisions)
        key = jax.random.fold_in(self._key, index)
        move = _decide(
            belief,
            jnp.asarray(cell, jnp.int32),
            jnp.int32(self.states[-1]),
            self._arrays,
            self._estimator,
            key,
            policy=self._policy,
            config=self._config.decision,
        )
        self.decisions.append(_decision_record(move, index, len(self.path) - 1, cell, self.states[-1], key))
        self.status |= int(move.status)
        return move

    def _advance(self, belief: BeliefMap, move: Move) -> None:
        kind = int(move.kind)
        stop = Stop(
            replan_distance=jnp.float32(self._config.replan_distance),
            budget=jnp.float32(self._budget(belief) - self.travelled),
            is_frontier=jnp.asarray(kind in (MoveKind.ACTION, MoveKind.FRONTIER, MoveKind.FALLBACK)),
        )
        leg = self._robot.advance(move.path, stop)
        letters = np.asarray(self._robot.observe()[0].letters)
        for cell in leg.cells:
            letter = int(letters[cell])
            row_step, column_step = cell[0] - self.path[-1][0], cell[1] - self.path[-1][1]
            self.travelled += DIAGONAL if row_step and column_step else 1.0
            self.path.append(cell)
            self.word.append(letter)
            self.states.append(int(self._task.dfa.transitions[self.states[-1], letter]))


_KIND_NAMES = {
    MoveKind.NONE: "none",
    MoveKind.FINISH: "finish",
    MoveKind.ACTION: "action",
    MoveKind.FRONTIER: "frontier",
    MoveKind.FALLBACK: "fallback",
    MoveKind.OPTIMISTIC: "optimistic",
}


def _decision_record(
    move: Move, index: int, step: int, cell: tuple[int, int], state: int, key: PRNGKeyArray
) -> Decision:
    kind = int(move.kind)
    subgoals = np.asarray(move.subgoals.cells)[np.asarray(move.subgoals.mask)]
    path = np.asarray(move.path.cells)[: int(move.path.length) + 1]
    goes = kind != MoveKind.NONE
    return Decision(
        index=index,
        step=step,
        cell=cell,
        state=state,
        key=tuple(int(word) for word in jax.random.key_data(key)),
        kind=_KIND_NAMES[kind],
        choice=None if int(move.action) == NO_ACTION else _unpadded_index(move, int(move.action)),
        target=_cell(move.target_cell) if goes else None,
        target_state=int(move.target_state) if goes else None,
        value=float(move.value),
        fallback=kind == MoveKind.FALLBACK,
        status=int(move.status),
        subgoals=tuple(_cell(subgoal) for subgoal in subgoals),
        actions=_action_records(move),
        path=tuple(_cell(entry) for entry in path),
    )


def _unpadded_index(move: Move, action: int) -> int:
    """Index of an action in the task's own arrays: records do not depend on padded edges."""
    assert move.search is not None
    edge_mask = np.asarray(move.search.problem.task.edge_mask)
    subgoal, edge = divmod(action, len(edge_mask))
    return subgoal * int(np.sum(edge_mask)) + edge


def _action_records(move: Move) -> tuple[ActionRecord, ...]:
    """The available actions at the root, as the search saw them."""
    if move.search is None:
        return ()
    edges, cells = np.asarray(move.search.problem.task.edges), np.asarray(move.subgoals.cells)
    terms = {
        field.name: np.asarray(getattr(move.search.terms, field.name)) for field in dataclasses.fields(ActionTerms)
    }
    q_values, visits = np.asarray(move.search.plan.q_values), np.asarray(move.search.plan.visits)
    records = []
    for index in np.flatnonzero(terms["available"]):
        subgoal, edge = divmod(int(index), len(edges))
        finish = subgoal == len(cells)
        records.append(
            ActionRecord(
                index=_unpadded_index(move, int(index)),
                subgoal=None if finish else subgoal,
                cell=None if finish else _cell(cells[subgoal]),
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


def _cell(cell: Any) -> tuple[int, int]:
    return int(cell[0]), int(cell[1])


def versions() -> dict[str, str]:
    """Versions of what a trial's figures depend on."""
    return {name: importlib.metadata.version(name) for name in ("potlp-jax", "jax", "numpy")}


def trial_config_from_dict(data: Mapping[str, Any]) -> TrialConfig:
    """The configuration that a record keeps, as ``dataclasses.asdict`` wrote it."""
    decision = data["decision"]
    return TrialConfig(
        **{
            **data,
            "sensor": SensorConfig(**data["sensor"]),
            "decision": DecisionConfig(
                **{
                    **decision,
                    "frontiers": FrontierConfig(**decision["frontiers"]),
                    "search": SearchConfig(**{**decision["search"], "mode": SearchMode(decision["search"]["mode"])}),
                }
            ),
        }
    )


_PLANNING = 1
"""Name under which the trial's key is folded for the planner."""

_decide = jax.jit(decide, static_argnames=("policy", "config"))
_observe = jax.jit(observe, static_argnames=("config",))


@partial(jax.jit, static_argnames=("config",))
def _follow(
    world: World,
    belief: BeliefMap,
    first_seen: Int32[Array, "H W"],
    path: KnownPath,
    steps: Int32[Array, ""],
    stop: Stop,
    config: SensorConfig,
) -> tuple[BeliefMap, Int32[Array, "H W"], Int32[Array, ""]]:
    """Move along the path cell by cell; returns the belief, when each cell was first seen, and the moves made."""
    known_before = jnp.sum(~belief.unknown)
    propositions_before = _propositions_seen(belief)
    target = path.cells[path.length]

    def goes_on(carry):
        belief, _, moved, travelled = carry
        changed = jnp.sum(~belief.unknown) > known_before
        due = changed & (travelled >= stop.replan_distance)
        surprised = (_propositions_seen(belief) & ~propositions_before) != 0
        gone = stop.is_frontier & ~_beside_unobserved(belief, target)
        stopped = due | surprised | gone | (travelled >= stop.budget)
        return (moved < path.length) & ((moved == 0) | ~stopped)

    def step(carry):
        belief, first_seen, moved, travelled = carry
        here, there = path.cells[moved], path.cells[moved + 1]
        # On a map that holds no secret there is nothing to look for.
        look = partial(observe, world=world, cell=there, config=config)
        belief = jax.lax.cond(jnp.any(belief.unknown), look, lambda belief: belief, belief)
        first_seen = jnp.where((first_seen == NEVER_SEEN) & ~belief.unknown, steps + moved + 1, first_seen)
        diagonal = jnp.all(here != there)
        return belief, first_seen, moved + 1, travelled + jnp.where(diagonal, DIAGONAL, 1.0).astype(jnp.float32)

    start = (belief, first_seen, jnp.int32(0), jnp.float32(0.0))
    belief, first_seen, moved, _ = jax.lax.while_loop(goes_on, step, start)
    return belief, first_seen, moved


def _propositions_seen(belief: BeliefMap) -> Int32[Array, ""]:
    """Bits of the propositions that hold at some observed cell."""
    return jax.lax.reduce(belief.letters, np.int32(0), jax.lax.bitwise_or, (0, 1))


def _beside_unobserved(belief: BeliefMap, cell: Int32[Array, "2"]) -> Bool[Array, ""]:
    """Whether a 4-neighbour of the cell is unobserved; outside of the array counts as unobserved."""
    padded = jnp.pad(belief.unknown, 1, constant_values=True)
    row, column = cell[0] + 1, cell[1] + 1
    return padded[row - 1, column] | padded[row + 1, column] | padded[row, column - 1] | padded[row, column + 1]


def replay_decision(trial: Trial, index: int) -> tuple[PlanningProblem, Plan, Tree]:
    """Search again as in decision ``index`` of a recorded trial: its problem, plan and searched tree.

    Raises ValueError where the trial has no such decision or its policy does not search.
    """
    if not 0 <= index < len(trial.decisions):
        raise ValueError(f"the trial has decisions 0 to {len(trial.decisions) - 1}; there is no decision {index}")
    if trial.policy != Policy.ORACLE:
        raise ValueError(f"policy {trial.policy!r} does not search: its decisions have no tree")
    decision = trial.decisions[index]
    task = Task.from_hoa(trial.task_hoa, propositions=trial.propositions).arrays
    config = trial_config_from_dict(trial.config)
    problem = _replayed_problem(
        trial.belief_at(decision.step),
        jnp.asarray(decision.cell, jnp.int32),
        jnp.int32(decision.state),
        task,
        TrueMapEstimator(world=trial.world),
        config.decision,
    )
    key = jax.random.wrap_key_data(jnp.asarray(decision.key, jnp.uint32))
    plan, tree = search_tree(problem, key, config.decision.search)
    return problem, plan, tree


@partial(jax.jit, static_argnames=("config",))
def _replayed_problem(
    belief: BeliefMap,
    cell: Int32[Array, "2"],
    state: Int32[Array, ""],
    task: TaskArrays,
    estimator: Estimator,
    config: DecisionConfig,
) -> PlanningProblem:
    situation = assess(belief, cell, state, task, config.frontiers)
    return planning_problem(situation, estimator(belief, situation.subgoals, task), config)
