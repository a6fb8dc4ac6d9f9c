"""Algorithm 1 of Bradley et al. 2021: observe, decide, advance - until the task is satisfied.

The loop knows a ``Robot`` only; the simulator is one, and a real robot is another observe and advance.
"""

import dataclasses
import importlib.metadata
import logging
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.learning.estimator import NetworkEstimator, TrainedEstimator, estimator_for, look
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.memory import look_of_subgoals
from potlp_jax.planning.commitment import Intention
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.history import ActionTerms
from potlp_jax.planning.policies import Move, MoveKind, Policy, decide
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.trials.record import ActionRecord, Decision, Outcome, Trial
from potlp_jax.trials.robot import DIAGONAL, Robot, SimulatedRobot, Stop, as_cell
from potlp_jax.types import NO_ACTION
from potlp_jax.world.grid import BeliefMap, World

logger = logging.getLogger(__name__)

STUCK_REPEATS: int = 3
"""Decisions in the same cell, state and map after which a trial counts as stuck."""


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
    estimator: TrainedEstimator | None = None,
) -> Trial:
    """One trial of ``policy`` in ``world``, from its start to acceptance or failure.

    Without ``config`` the settings are those that the world calls for (``World.settings``).

    ``key`` drives the planner's search and the camera's disturbance; the same arguments give the same trial. ``arrays``
    are the task's device arrays where they shall be padded (default: ``task.arrays``). ``environment`` and ``seed`` go
    into the record. ``estimator`` is for the policy ``potlp``; by default the shipped one for the task's propositions.

    Raises:
        CheckpointError: the estimator knows other propositions than the task, or none is shipped for them.
    """
    policy = Policy(policy)
    config = trial_config_for(world) if config is None else config
    if policy is Policy.KNOWN_MAP:
        config = dataclasses.replace(config, revealed=True)
    robot = SimulatedRobot(world, config, sensing_key(key))
    trained = estimator_for(task.propositions, estimator) if policy is Policy.POTLP else None
    eyes = _first_estimator(policy, world, trained)
    loop = Loop(robot, task, arrays if arrays is not None else task.arrays, policy, eyes, key, config)
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
        versions=versions(trained),
    )


def _first_estimator(policy: Policy, world: World, trained: TrainedEstimator | None) -> Estimator | None:
    """What a policy that searches asks at the first decision, nothing seen yet."""
    if policy is Policy.ORACLE:
        return TrueMapEstimator(world=world)
    return None if trained is None else trained.start(*world.shape)


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
        self._key = planning_key(key)
        self._intention = Intention.none()
        self._visits: Counter[tuple[tuple[int, int], int, int]] = Counter()
        belief, cell = robot.observe()
        letter = int(belief.letters[cell])
        self._diagonal = 0
        self.path: list[tuple[int, int]] = [cell]
        self.word: list[int] = [letter]
        self.states: list[int] = [int(task.dfa.transitions[task.dfa.initial, letter])]
        self.decisions: list[Decision] = []
        self.status = 0

    @property
    def travelled(self) -> float:
        """Cells travelled. From counts, so that the sum does not depend on the order of the moves."""
        return len(self.path) - 1 - self._diagonal + self._diagonal * DIAGONAL

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
        if isinstance(self._estimator, NetworkEstimator):
            self._estimator = look(self._estimator, self._robot.panorama(), belief, jnp.asarray(cell, jnp.int32))
        move = _decide(
            belief,
            jnp.asarray(cell, jnp.int32),
            jnp.int32(self.states[-1]),
            self._arrays,
            self._estimator,
            key,
            self._intention,
            policy=self._policy,
            config=self._config.decision,
        )
        self._intention = move.intention
        looks = _looks_of(self._estimator, move)
        self.decisions.append(_decision_record(move, index, len(self.path) - 1, cell, self.states[-1], key, looks))
        self.status |= int(move.status)
        logger.debug("decision %d in cell %s, automaton state %d", index, cell, self.states[-1])
        return move

    def _advance(self, belief: BeliefMap, move: Move) -> None:
        kind = int(move.kind)
        stop = Stop(
            replan_distance=jnp.float32(self._config.replan_distance),
            budget=jnp.float32(self._budget(belief) - self.travelled),
            is_frontier=jnp.asarray(kind in (MoveKind.ACTION, MoveKind.FRONTIER, MoveKind.FALLBACK)),
        )
        leg = self._robot.advance(move.path, stop)
        planned = np.asarray(move.path.cells)[1 : len(leg.cells) + 1]
        if leg.cells != tuple(as_cell(cell) for cell in planned):
            # As in a log: a robot that went elsewhere is not on its way to what was chosen.
            self._intention = Intention.none()
        letters = np.asarray(self._robot.observe()[0].letters)
        for cell in leg.cells:
            letter = int(letters[cell])
            row_step, column_step = cell[0] - self.path[-1][0], cell[1] - self.path[-1][1]
            self._diagonal += bool(row_step and column_step)
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
    move: Move,
    index: int,
    step: int,
    cell: tuple[int, int],
    state: int,
    key: PRNGKeyArray,
    looks: tuple[int, ...],
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
        target=as_cell(move.target_cell) if goes else None,
        target_state=int(move.target_state) if goes else None,
        value=float(move.value),
        fallback=kind == MoveKind.FALLBACK,
        status=int(move.status),
        subgoals=tuple(as_cell(subgoal) for subgoal in subgoals),
        actions=_action_records(move),
        path=tuple(as_cell(entry) for entry in path),
        looks=looks,
        preferred=_preferred(move),
    )


def _preferred(move: Move) -> int | None:
    """Index of the action that the search found, in the task's own arrays."""
    if move.search is None or int(move.search.plan.action) == NO_ACTION:
        return None
    return _unpadded_index(move, int(move.search.plan.action))


def _looks_of(estimator: Estimator | None, move: Move) -> tuple[int, ...]:
    """Per subgoal, the look that its estimates come from; there is one look per decision."""
    if not isinstance(estimator, NetworkEstimator):
        return ()
    looks = np.asarray(_look_numbers(estimator.views, move.subgoals))[np.asarray(move.subgoals.mask)]
    return tuple(int(look) for look in looks)


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


def versions(estimator: TrainedEstimator | None = None) -> dict[str, str]:
    """Versions of what a trial's figures depend on; with the estimator's identity where it looked with one."""
    libraries = {name: importlib.metadata.version(name) for name in ("potlp-jax", "jax", "numpy")}
    return libraries if estimator is None else libraries | {"estimator": estimator.identity}


def trial_key(world: int, seed: int = 0) -> PRNGKeyArray:
    """The key of every policy's trial in world number ``world``, in a sweep or alone; ``seed`` gives other draws."""
    return jax.random.fold_in(jax.random.key(seed), world)


def planning_key(key: PRNGKeyArray) -> PRNGKeyArray:
    """What a trial's key becomes for the planner: folded by name, so that no draw depends on another use of the key."""
    return jax.random.fold_in(key, 1)


def sensing_key(key: PRNGKeyArray) -> PRNGKeyArray:
    """What a trial's key becomes for the sensors."""
    return jax.random.fold_in(key, 2)


_decide = jax.jit(decide, static_argnames=("policy", "config"))
_look_numbers = jax.jit(look_of_subgoals)
