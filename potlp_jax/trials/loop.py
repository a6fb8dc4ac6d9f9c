"""Algorithm 1 of Bradley et al. 2021: observe, decide, advance - until the task is satisfied.

``run_trial`` simulates, ``trials.live.run_robot`` drives a robot of somebody else's; both are the same loop, ``drive``.
When a leg stops and when a trial ends is said in ``rules``; what happens after a leg that failed, in ``setbacks``.
"""

import dataclasses
import importlib.metadata
import logging
from collections.abc import Callable, Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, PRNGKeyArray

from potlp_jax.compiling import jit_by_class
from potlp_jax.errors import PotlpError, RobotError, TaskError
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator, identity_of
from potlp_jax.learning.observing import (
    MovesWithMap,
    ObservingEstimator,
    look_step,
    looks_between,
    looks_on_the_way,
    observe_panorama,
)
from potlp_jax.planning.commitment import Intention
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.move import Move, MoveKind
from potlp_jax.planning.policies import Policy, PolicyFunction, decide, named_policy, policy_name
from potlp_jax.precision import in_32_bits
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.trials import rules
from potlp_jax.trials.config import TrialConfig, config_in
from potlp_jax.trials.move_record import decision_of
from potlp_jax.trials.record import Decision, Outcome, RunRecord, Trial, with_closed
from potlp_jax.trials.robot import GrowingRobot, Leg, RemembersItsWay, Robot, SimulatedRobot
from potlp_jax.trials.setbacks import SetbackConfig, Setbacks
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import Cell, path_length

logger = logging.getLogger(__name__)

# Compiled once per policy, configuration and array shapes: no trial after the first compiles anything, but for the
# first that meets more frontiers than the array of subgoals holds.
_decide = jit_by_class(decide, static_argnames=("policy", "config"))
_first_tally = jax.jit(rules.first_tally)
_count_decision = jax.jit(rules.count_decision)
_arrive = jax.jit(rules.arrive, static_argnames="config")
_stop_of = jax.jit(rules.stop_of, static_argnames="config")


@in_32_bits
def run_trial(
    world: World,
    task: Task,
    policy: Policy | PolicyFunction | str,
    key: PRNGKeyArray,
    config: TrialConfig | None = None,
    *,
    environment: str = "",
    world_number: int | None = None,
    arrays: TaskArrays | None = None,
    estimator: TrainedEstimator | Estimator | None = None,
) -> Trial:
    """One trial in simulation, from the world's start to acceptance or failure. The same arguments give the same trial.

    Args:
        world: the true map.
        task: what to do there.
        policy: one of the library's, or a function of one's own (``planning.policies.PolicyFunction``).
        key: drives the search where it samples (``UctConfig``), and the camera's disturbance.
        config: settings; by default those that the world calls for (``World.settings``).
        environment: where the world comes from, for the record.
        world_number: which world of it, for the record.
        arrays: the task's arrays where they shall be padded; by default ``task.arrays``.
        estimator: what the policy asks: one read from a file, or any ``Estimator``. By default ``potlp`` asks the one
            that is shipped for the task's propositions and serves such worlds (``learning.domain``), and a policy of
            one's own asks none.

    Returns:
        The record of the trial.

    Raises:
        PropositionsError: world, task and estimator are not over the same propositions.
        EstimatorError: no estimator is shipped for the task's propositions in such worlds.

    Warns:
        PotlpWarning: the estimator given was made for other worlds.
    """
    # Before anything is compiled, and by the world's own name.
    require_same_propositions(task.propositions, world.propositions, asker=f"the task {task.text!r}")
    policy = named_policy(policy)
    config = rules.config_of(policy, config_in(world, config))
    # One key for everything, and a use of its own for each: disturbing the camera does not change the search.
    robot = SimulatedRobot(world, config, rules.sensing_key(key))
    asked = rules.estimator_of(policy, task.propositions, Domain.of_world(world, config.camera), estimator)
    run = drive(robot, task, policy, key, config, arrays=arrays, estimator=asked, world=world)
    return make_trial(
        run, task, policy, config, asked, world, robot.first_seen, environment=environment, world_number=world_number
    )


class BrokenDriveError(RobotError):
    """A robot broke its side of the contract after the drive had begun. What it had done until then is not lost.

    Attributes:
        run: what the robot did until its last observation; ``unfinished``.
        trial: the record of it, from ``run_robot``; ``drive`` makes none.
    """

    def __init__(self, message: str, run: RunRecord, trial: Trial | None = None) -> None:
        super().__init__(message)
        self.run, self.trial = run, trial


Listener = Callable[[Decision, BeliefMap], None]
"""Is told each decision before it is carried out, and the map that it was planned on."""


@in_32_bits
def drive(
    robot: Robot,
    task: Task,
    policy: Policy | PolicyFunction | str,
    key: PRNGKeyArray,
    config: TrialConfig | None = None,
    *,
    arrays: TaskArrays | None = None,
    estimator: TrainedEstimator | Estimator | None = None,
    world: World | None = None,
    setbacks: SetbackConfig | None = None,
    listener: Listener | None = None,
) -> RunRecord:
    """Drive a robot, a simulated or a real one, until the task is satisfied or cannot go on.

    Args:
        robot: observes and advances.
        task: what to do.
        policy: one of the library's, or a function of one's own (``planning.policies.PolicyFunction``).
        key: drives the search where it samples (``UctConfig``).
        config: settings; the sensor and the camera are the simulator's and matter not here.
        arrays: the task's arrays where they shall be padded; by default ``task.arrays``.
        estimator: what the policy asks, as in ``run_trial``. What worlds without a true map look like is not known: no
            shipped estimator serves them, and one is asked on request only.
        world: the true map, where it is known; only the policy ``oracle`` asks it.
        setbacks: what to do after a leg that failed.
        listener: is told each decision before it is carried out.

    Returns:
        How it ended, the path that was taken and every decision. What the robot did after the task was decided is left
        out.

    Raises:
        PropositionsError: the robot's map, task, estimator and ``world`` are not over the same propositions.
        EstimatorError: no estimator is shipped for the task's propositions in such a world.
        PotlpError: the policy is ``oracle`` and there is no ``world``, or ``known-map`` and nothing is ``revealed``.
        TaskError: ``arrays`` are those of another task.
        BrokenDriveError: the robot raised ``RobotError`` after its first observation.
    """
    policy = named_policy(policy)
    config = TrialConfig() if config is None else config
    # It would drive as the baseline does, and be recorded under a name that promises the least possible cost.
    if policy is Policy.KNOWN_MAP and not config.revealed:
        raise PotlpError("the policy known-map knows all from the start, and this robot does not: choose another")
    # Nothing is asked of the robot's map but its names and shape: the loop observes for itself.
    belief, cell = robot.observe()
    require_same_propositions(
        task.propositions, belief.propositions, asker=f"the task {task.text!r}", knower="the robot's map"
    )
    resolution = float(belief.resolution)
    here = Domain.of_robot(resolution) if world is None else Domain.of_world(world, config.camera)
    asked = rules.estimator_of(policy, task.propositions, here, estimator)
    if arrays is not None:
        _require_arrays_of(task, arrays)

    def first_estimator(shape: tuple[int, int]) -> Estimator | None:
        # An estimator that remembers where it was needs to know how large the map is.
        return rules.first_estimator(policy, asked, shape, resolution, config.panoramas, world)

    loop = _Loop(
        robot,
        task,
        task.arrays if arrays is None else arrays,
        policy,
        first_estimator,
        key,
        config,
        Setbacks(SetbackConfig() if setbacks is None else setbacks),
        listener,
    )
    return loop.run(belief, cell)


def _require_arrays_of(task: Task, arrays: TaskArrays) -> None:
    """Raise where the arrays, whatever their padding, are not those of the task's automaton and propositions."""
    require_same_propositions(
        task.propositions, arrays.propositions, asker=f"the task {task.text!r}", knower="the arrays given with it"
    )
    dfa, (states, letters) = task.dfa, task.dfa.transitions.shape
    same = (
        np.array_equal(np.asarray(arrays.transitions)[:states, :letters], dfa.transitions)
        and np.array_equal(np.asarray(arrays.accepting)[:states], dfa.accepting)
        and int(arrays.initial) == dfa.initial
    )
    if not same:
        raise TaskError(f"the arrays are not those of the task {task.text!r}: give task.padded(sizes), or none")


class _Loop:
    """Observe, decide, advance: the state of a running trial on the host."""

    def __init__(
        self,
        robot: Robot,
        task: Task,
        arrays: TaskArrays,
        policy: Policy | PolicyFunction,
        first_estimator: Callable[[tuple[int, int]], Estimator | None],
        key: PRNGKeyArray,
        config: TrialConfig,
        setbacks: Setbacks,
        listener: Listener | None,
    ) -> None:
        self._robot, self._dfa, self._arrays = robot, task.dfa, arrays
        self._policy, self._first_estimator, self._config = policy, first_estimator, config
        # Apart from the trial's: only what depends on the array of subgoals is compiled anew when that grows.
        self._decision_config = config.decision
        self._setbacks, self._listener = setbacks, listener
        self._key = rules.planning_key(key)
        self._path: list[Cell] = []
        self._word: list[int] = []
        self._states: list[int] = []
        self._decisions: list[Decision] = []
        self._origin, self._shift, self._has_moved_map = (0, 0), (0, 0), False

    def run(self, belief: BeliefMap, cell: Cell) -> RunRecord:
        """Loop until the task is satisfied or cannot go on.

        Args:
            belief: what the robot knows at first.
            cell: where it is.

        Returns:
            What it did.

        Raises:
            BrokenDriveError: the robot raised ``RobotError``.
        """
        self._begin(belief, cell)
        # The observation that all else is told on: one that fails changes nothing.
        self._belief = belief
        try:
            return self._run(cell)
        except RobotError as error:
            raise BrokenDriveError(str(error), self._result(Outcome.UNFINISHED, self._belief)) from error

    def _run(self, cell: Cell) -> RunRecord:
        # Algorithm 1 ends at acceptance; budget, repetition and a robot that ends are ours (docs/model.md section 7).
        belief = self._belief
        gave_up, leg = False, Leg(cells=())
        while True:
            at = jnp.asarray(cell, jnp.int32)
            self._tally = _arrive(self._tally, belief, at, self._arrays, jnp.asarray(gave_up), config=self._config)
            if not bool(self._tally.running):
                return self._result(rules.OUTCOMES[int(self._tally.outcome)], belief)
            # Asked only now: the last cells of a log may well decide the task.
            if leg.ended:
                return self._result(Outcome.UNFINISHED, belief)
            if self._setbacks.is_stuck:
                return self._result(Outcome.STUCK, belief)
            move = self._decide(belief, cell)
            leg = self._robot.advance(move.path, _stop_of(move, self._tally, belief, config=self._config))
            known_before = belief
            belief, cell = self._robot.observe()
            self._belief = belief
            cells = self._follow_map(known_before, belief, leg.cells)
            self._after(leg, cells, move, belief)
            gave_up = self._gave_up(leg, move, known_before, belief)

    def _begin(self, belief: BeliefMap, cell: Cell) -> None:
        self._tally = _first_tally(belief, jnp.asarray(cell, jnp.int32), self._arrays)
        self._estimator = self._first_estimator(_shape(belief))
        self._origin = _origin(self._robot)
        self._path.append(cell)
        self._word.append(int(belief.letters[cell]))
        self._states.append(int(self._tally.state))

    def _decide(self, belief: BeliefMap, cell: Cell) -> Move:
        index = len(self._decisions)
        # By the number of the decision: the same whatever was drawn before it.
        at, key = jnp.asarray(cell, jnp.int32), rules.decision_key(self._key, index)
        # Before the decision, so that its estimates know what can be seen from here.
        if isinstance(self._estimator, ObservingEstimator):
            self._look_back(belief)
            self._estimator = observe_panorama(self._estimator, self._robot.panorama(), belief, at)
        # The robot's own cell is free, whatever was set aside.
        closed = tuple(entry for entry in self._setbacks.closed_at(index, belief) if entry != cell)
        planned_on = with_closed(belief, closed)
        move = self._decide_on(planned_on, at, key)
        step, state = len(self._path) - 1, self._states[-1]
        decision = decision_of(move, self._estimator, key, index=index, step=step, cell=cell, state=state)
        self._decisions.append(dataclasses.replace(decision, set_aside=closed))
        logger.debug("decision %d in cell %s, automaton state %d", index, cell, state)
        if self._listener is not None:
            self._listener(self._decisions[-1], planned_on)
        return move

    def _decide_on(self, belief: BeliefMap, cell: Int32[Array, "2"], key: PRNGKeyArray) -> Move:
        """Decide, with a longer array of subgoals where the frontiers are more than it holds."""
        while True:
            move = _decide(
                belief,
                cell,
                self._tally.state,
                self._arrays,
                self._estimator,
                key,
                self._tally.intention,
                policy=self._policy,
                config=self._decision_config,
            )
            grown = self._decision_config.grown() if bool(rules.overflows(move)) else None
            if grown is None:
                return move
            # Kept for the rest of the trial: where there were many frontiers once there are many again.
            self._decision_config = grown
            logger.debug("more frontiers than subgoals: deciding again with %d", grown.frontiers.max_subgoals)

    def _look_back(self, belief: BeliefMap) -> None:
        """Show the estimator what the camera saw on the way here from the decision before."""
        robot = self._robot
        if not (self._decisions and looks_on_the_way(self._estimator) and isinstance(robot, RemembersItsWay)):
            return
        before, now, every = self._decisions[-1].step, len(self._path) - 1, self._config.look_every
        for number in range(looks_between(before, now, every)):
            step = look_step(before, number, every)
            seen = robot.panorama_before(now - step)
            # A real robot's pictures are few; one of its own will come.
            if seen is not None:
                cell = jnp.asarray(self._path[step], jnp.int32)
                # By the map as it is known now: what was mapped since hides what is behind it, too.
                self._estimator = observe_panorama(cast(ObservingEstimator, self._estimator), seen, belief, cell)

    def _after(self, leg: Leg, cells: tuple[Cell, ...], move: Move, belief: BeliefMap) -> None:
        """Count a leg, where the robot really went and whether it failed; ``cells`` are those of the map now."""
        self._tally = _count_decision(self._tally, move)
        # From the record, which is on the map as it is now.
        decision = self._decisions[-1]
        if cells != decision.path[1 : len(cells) + 1]:
            # A robot that went elsewhere is not committed to what was chosen.
            self._tally = dataclasses.replace(self._tally, intention=Intention.none())
        elif self._has_moved_map:
            self._tally = dataclasses.replace(self._tally, intention=self._moved(move.intention))
        self._enter(cells, belief)
        if leg.failure:
            self._fail(leg, decision, belief)
        elif cells:
            self._setbacks.went_well()

    def _fail(self, leg: Leg, decision: Decision, belief: BeliefMap) -> None:
        """Record a failed leg, and set its target aside where it was not the first."""
        self._decisions[-1] = dataclasses.replace(decision, failure=leg.failure)
        target = decision.path[-1]
        aside = self._setbacks.failed(target, belief, decision.index, moved=bool(leg.cells))
        logger.warning(
            "decision %d: %s; the target %s is %s",
            decision.index,
            leg.failure,
            target,
            "set aside for a while" if aside else "tried again",
        )
        # To decide again in the same place is what a retry is, and no sign of a cycle. No map knows as few cells.
        self._tally = dataclasses.replace(self._tally, known=jnp.int32(-1))
        if aside:
            self._tally = dataclasses.replace(self._tally, intention=Intention.none())

    def _gave_up(self, leg: Leg, move: Move, before: BeliefMap, belief: BeliefMap) -> bool:
        """Whether the policy knows no move, and nothing will change that."""
        # Without a move a simulated robot stays, and the task is infeasible. A robot in a log goes on, and there may be
        # a move again later.
        if int(move.kind) != MoveKind.NONE or leg.cells or leg.ended or leg.failure:
            return False
        if self._setbacks.release():
            self._tally = dataclasses.replace(self._tally, known=jnp.int32(-1))
            return False
        # A simulated robot hands out the same map again; that of a real one may have changed while it stood.
        return before is belief or _same_map(before, belief)

    def _follow_map(self, before: BeliefMap, belief: BeliefMap, cells: tuple[Cell, ...]) -> tuple[Cell, ...]:
        """Carry all cells that are remembered to the map as it is now; returns those of the leg there."""
        origin = _origin(self._robot)
        rows, columns = self._origin[0] - origin[0], self._origin[1] - origin[1]
        self._has_moved_map = bool(rows or columns) or _shape(before) != _shape(belief)
        if not self._has_moved_map:
            return cells
        self._origin, self._shift = origin, (rows, columns)
        self._path = list(shifted_cells(self._path, rows, columns))
        self._decisions = [shifted_decision(decision, rows, columns) for decision in self._decisions]
        self._setbacks.shift(rows, columns)
        # Visits begin anew, as whenever the map has changed.
        visits = jnp.zeros((*_shape(belief), self._tally.visits.shape[2]), jnp.int8)
        self._tally = dataclasses.replace(self._tally, visits=visits, known=jnp.int32(-1))
        if isinstance(self._estimator, MovesWithMap):
            # It is what it was, with another memory.
            self._estimator = cast(Estimator, self._estimator.moved(_shape(belief), rows, columns))
        elif isinstance(self._estimator, ObservingEstimator):
            logger.warning("the map has outgrown its array: the estimator forgets what it saw on the former one")
            self._estimator = self._first_estimator(_shape(belief))
        return shifted_cells(cells, rows, columns)

    def _moved(self, intention: Intention) -> Intention:
        """An intention on the map as it is now."""
        return dataclasses.replace(intention, cell=intention.cell + jnp.asarray(self._shift, jnp.int32))

    def _enter(self, cells: tuple[Cell, ...], belief: BeliefMap) -> None:
        """Read the letters of the cells entered, up to where they decide the task."""
        # All at once after the leg: what was entered has been observed, and letters do not change.
        letters = np.asarray(belief.letters)
        straight, diagonal = int(self._tally.straight), int(self._tally.diagonal)
        for cell in cells:
            state = self._states[-1]
            if self._dfa.accepting[state] or self._dfa.trap[state]:
                break
            # Where the robot really went, which need not be where it was told to go.
            is_diagonal = cell[0] != self._path[-1][0] and cell[1] != self._path[-1][1]
            straight, diagonal = straight + (not is_diagonal), diagonal + is_diagonal
            letter = int(letters[cell])
            self._path.append(cell)
            self._word.append(letter)
            self._states.append(int(self._dfa.transitions[state, letter]))
        self._tally = dataclasses.replace(
            self._tally,
            state=jnp.int32(self._states[-1]),
            straight=jnp.int32(straight),
            diagonal=jnp.int32(diagonal),
        )

    def _result(self, outcome: Outcome, belief: BeliefMap) -> RunRecord:
        return RunRecord(
            outcome=outcome,
            cost=path_length(self._path) * float(belief.resolution),
            path=tuple(self._path),
            word=tuple(self._word),
            states=tuple(self._states),
            decisions=tuple(self._decisions),
            status=int(self._tally.status),
        )


def shifted_cells(cells: Sequence[Cell], rows: int, columns: int) -> tuple[Cell, ...]:
    """The same cells on a map with so many rows and columns more above and to the left."""
    return tuple((row + rows, column + columns) for row, column in cells)


def shifted_decision(decision: Decision, rows: int, columns: int) -> Decision:
    """The same decision on a map with so many rows and columns more above and to the left."""

    def shift(cell: Cell | None) -> Cell | None:
        return None if cell is None else (cell[0] + rows, cell[1] + columns)

    return dataclasses.replace(
        decision,
        cell=(decision.cell[0] + rows, decision.cell[1] + columns),
        target=shift(decision.target),
        subgoals=shifted_cells(decision.subgoals, rows, columns),
        actions=tuple(dataclasses.replace(action, cell=shift(action.cell)) for action in decision.actions),
        path=shifted_cells(decision.path, rows, columns),
        set_aside=shifted_cells(decision.set_aside, rows, columns),
    )


def _shape(belief: BeliefMap) -> tuple[int, int]:
    height, width = belief.cells.shape
    return height, width


def _origin(robot: Robot) -> Cell:
    """Where the robot's map begins."""
    return robot.origin if isinstance(robot, GrowingRobot) else (0, 0)


def _same_map(before: BeliefMap, belief: BeliefMap) -> bool:
    return np.array_equal(before.cells, belief.cells) and np.array_equal(before.letters, belief.letters)


def make_trial(
    run: RunRecord,
    task: Task,
    policy: Policy | PolicyFunction,
    config: TrialConfig,
    estimator: TrainedEstimator | Estimator | None,
    world: World,
    first_seen: Int32[np.ndarray, "H W"],
    *,
    environment: str,
    world_number: int | None,
) -> Trial:
    """The record of a run whose true map is known.

    Args:
        run: from ``run_robot``.
        task, policy, config, estimator: what it was made with.
        world: the true map.
        first_seen: index into the path at which each cell was first observed, or ``NEVER_SEEN``.
        environment: where the world comes from.
        world_number: which world of it.

    Returns:
        The trial.
    """
    return Trial(
        **{field.name: getattr(run, field.name) for field in dataclasses.fields(RunRecord)},
        first_seen=first_seen,
        world=world,
        task_text=task.text,
        task_hoa=task.to_hoa(),
        propositions=task.propositions,
        policy=policy_name(policy),
        environment=environment,
        world_number=world_number,
        config=dataclasses.asdict(config),
        versions=versions(estimator),
        max_positive_literals=task.max_positive_literals,
    )


def versions(estimator: TrainedEstimator | Estimator | None = None) -> dict[str, str]:
    """Versions of what a trial's figures depend on; with the estimator's identity where it asked one."""
    # What can change a figure: the planner, its numerics, and NumPy's generators that draw worlds.
    libraries = {name: importlib.metadata.version(name) for name in ("potlp-jax", "jax", "numpy")}
    return libraries if estimator is None else libraries | {"estimator": identity_of(estimator)}
