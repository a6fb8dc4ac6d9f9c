"""Trials as a pure environment with ``reset`` and ``step``: for agents that learn where to explore.

``TaskEnv`` follows the convention of jumanji: ``reset(key)`` and ``step(state, action)`` both return the next state
and a ``TimeStep``. They are pure, may be wrapped in ``jax.jit`` and ``jax.vmap``, and do not reset by themselves.

One step is one decision of a trial (docs/model.md section 7): the robot follows a path through known space to a
frontier, observing at every cell, until the next decision is due. An agent that takes the planner's choices makes the
planner's trial.

Reward. Minus the cost travelled, in the unit of ``World.resolution``; the rewards of an episode that satisfies the task
add up to minus the trial's cost. An episode that ends otherwise also pays ``UNSATISFIED`` times the size of the map:
otherwise an agent would learn that the cheapest episode is to get stuck at once.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from enum import IntEnum

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, Int32, PRNGKeyArray

from potlp_jax.environments.base import Generator
from potlp_jax.environments.splits import Split
from potlp_jax.errors import TaskError, WorldError
from potlp_jax.planning.move import Move, MoveKind, move_to
from potlp_jax.planning.policies import Policy, direct_move
from potlp_jax.planning.situation import Situation, assess
from potlp_jax.precision import in_32_bits
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig, config_in
from potlp_jax.trials.record import Outcome
from potlp_jax.trials.rules import OUTCOMES, RUNNING
from potlp_jax.trials.slots import Progress, Scene, Setup, advance, begin
from potlp_jax.world.grid import World

OUTCOME_NAMES: Mapping[int, str] = {RUNNING: "running"} | {
    number: outcome.value for number, outcome in enumerate(OUTCOMES)
}
"""What ``TimeStep.extras["outcome"]`` says."""

UNSATISFIED: float = 4.0
"""Times ``(H + W)`` times the resolution: what an episode pays that ends without acceptance. More than most trials
cost, whatever a planner is told to expect of its dead ends (``DecisionConfig.dead_end_factor``)."""

_INFEASIBLE, _SATISFIED, _BUDGET = (
    OUTCOMES.index(outcome) for outcome in (Outcome.INFEASIBLE, Outcome.SATISFIED, Outcome.BUDGET)
)


class StepType(IntEnum):
    """Values of ``TimeStep.step_type``, as in dm_env and jumanji."""

    FIRST = 0
    MID = 1
    LAST = 2


@struct.dataclass(kw_only=True)
class Observation:
    """What the robot knows when it decides. Entries that are masked are 0.

    Attributes:
        cells: the belief's cells: -1 unobserved, 0 free, 1 occupied.
        letters: the letter of each observed cell.
        position: the robot's cell.
        state: of the automaton.
        subgoals: cells of the frontiers, nearest first.
        subgoal_mask: True on real subgoals.
        distances: ``[s, z]`` is the cost to subgoal ``s``, arriving in automaton state ``z``; 0 where unreachable.
        finish_distance: cost to satisfy the task in known space; 0 where that is not possible.
        action_mask: True on actions that can be taken.
    """

    cells: Int8[Array, "*batch H W"]
    letters: Int32[Array, "*batch H W"]
    position: Int32[Array, "*batch 2"]
    state: Int32[Array, "*batch"]
    subgoals: Int32[Array, "*batch S 2"]
    subgoal_mask: Bool[Array, "*batch S"]
    distances: Float32[Array, "*batch S Z"]
    finish_distance: Float32[Array, "*batch"]
    action_mask: Bool[Array, "*batch A"]


@struct.dataclass(kw_only=True)
class TimeStep:
    """What an agent gets back, with the fields of jumanji's.

    Attributes:
        step_type: one of ``StepType``.
        reward: of the step just made; 0 on the first and after the last.
        discount: 0 where the episode has ended, 1 while it runs and where only the budget ended it (truncation).
        observation: on which the next action is based.
        extras: ``cost`` travelled so far and ``outcome`` (``OUTCOME_NAMES``).
    """

    step_type: Int8[Array, "*batch"]
    reward: Float32[Array, "*batch"]
    discount: Float32[Array, "*batch"]
    observation: Observation
    extras: dict[str, Array]

    def last(self) -> Bool[Array, "*batch"]:
        """Whether the episode has ended."""
        return self.step_type == StepType.LAST


@struct.dataclass(kw_only=True)
class EnvState:
    """The hidden state: the true world and the task, the trial's progress, known space as it was assessed, and whether
    a failure has been paid for.
    """

    scene: Scene
    progress: Progress
    situation: Situation
    paid: Bool[Array, "*batch"]


class TaskEnv:
    """One task in a set of worlds.

    Actions are counted as the planner counts them (``types``): ``s * E + e`` goes to subgoal ``s``, arriving in the
    state in which edge ``e`` begins; ``S * E`` finishes in known space. One more, ``S * E + 1``, is the baseline's
    move: finish where possible, otherwise to the nearest frontier. An action that is masked makes no move.

    Attributes:
        worlds: stacked along a leading axis; an episode draws one.
        task: what is to be done.
        config: settings of the trial; what concerns policies and cameras has no effect. The array of subgoals does not
            grow: of more frontiers than ``max_subgoals`` the nearest are actions.
        num_actions: S * E + 2.
    """

    @in_32_bits
    def __init__(self, worlds: Sequence[World], task: Task, config: TrialConfig | None = None) -> None:
        """Stack the worlds.

        Args:
            worlds: of one family and shape (``grid.pad_world``).
            task: over the worlds' propositions.
            config: default: what the worlds call for.

        Raises:
            PropositionsError: a world has other propositions than the task.
            TaskError: every word satisfies the task.
            WorldError: there is no world, or two differ in shape, family or settings.
        """
        if not worlds:
            raise WorldError("there is no world to begin an episode in: give at least one")
        for world in worlds:
            require_same_propositions(task.propositions, world.propositions, asker=f"the task {task.text!r}")
        if task.dfa.accepting[task.dfa.initial]:
            raise TaskError(f"there is nothing to do for {task.text!r}: every word satisfies it")
        first = worlds[0]
        for number, world in enumerate(worlds):
            if (world.shape, world.family, world.settings) != (first.shape, first.family, first.settings):
                raise WorldError(
                    f"world {number} is of the family {world.family!r} and has {world.shape} cells, the first is of "
                    f"{first.family!r} and has {first.shape}: give worlds of one family with the same settings, and "
                    "of one shape (world.grid.pad_world)"
                )
        self.worlds: World = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
        self.task = task
        self.config: TrialConfig = config_in(worlds[0], config)
        # Of the arrays, which have one even where nothing can be attempted (``X X goal``): it is masked.
        self._edges = task.sizes.edges
        # What the planner calls A - 1: all pairs of a subgoal and an edge come first.
        self._finish = self.config.decision.frontiers.max_subgoals * self._edges
        # No policy decides here; the setup only carries the rules of a leg.
        self._setup = Setup(policy=Policy.BASELINE, config=self.config)

    @classmethod
    def of_family(
        cls,
        generator: Generator,
        task: str | int | Task = 1,
        worlds: Sequence[int] = range(16),
        split: Split | str = Split.TRAINING,
    ) -> "TaskEnv":
        """A task in some worlds of a family.

        Args:
            generator: see ``potlp_jax.make``.
            task: number of the family's task, a formula over its propositions, or a task.
            worlds: their numbers. All are made now and kept on the device.
            split: from which they are taken.

        Returns:
            The environment, with the settings that the family calls for.
        """
        # Worlds are made on the host; what is compiled only picks one of them.
        made = [generator.world(index, split) for index in worlds]
        return cls(made, task if isinstance(task, Task) else generator.task(task))

    @property
    def num_actions(self) -> int:
        """Entries of ``Observation.action_mask``."""
        return self._finish + 2

    @in_32_bits
    def reset(self, key: PRNGKeyArray) -> tuple[EnvState, TimeStep]:
        """Begin an episode in a world drawn by ``key``."""
        # The key makes nothing but this choice: worlds are deterministic, and so is everything that follows.
        index = jax.random.randint(key, (), 0, self.worlds.occupied.shape[0])
        return self.reset_in(jax.tree.map(lambda leaf: leaf[index], self.worlds))

    @in_32_bits
    def reset_in(self, world: World) -> tuple[EnvState, TimeStep]:
        """Begin an episode in this world. Its shape must be that of the others, for one compilation to serve all."""
        # A trial draws for its planner and its camera alone, and an episode has neither.
        scene, progress = begin(world, self.task.arrays, jax.random.key(0), None, setup=self._setup)
        state = self._assessed(scene, progress, paid=jnp.bool_(False))
        # Even an episode that cannot be won has a first step, as dm_env has it.
        return state, self._time_step(state, jnp.int8(StepType.FIRST), jnp.float32(0.0))

    @in_32_bits
    def step(self, state: EnvState, action: Int32[Array, ""]) -> tuple[EnvState, TimeStep]:
        """Take an action.

        Args:
            state: as ``reset`` or ``step`` returned it. After the end of its episode it stays as it is.
            action: index of an action. Where it is masked the robot stays; an agent that insists ends stuck.

        Returns:
            The next state, and what the agent gets.
        """
        before = state.progress
        progress = advance(self._setup, before, state.scene, self._move(state.situation, action))
        after = self._assessed(state.scene, progress, state.paid)
        resolution = state.scene.world.resolution
        # From counts of moves, so that the sum over an episode does not depend on how it was cut into legs.
        reward = -(after.progress.tally.travelled - before.tally.travelled) * resolution
        tally = after.progress.tally
        # Paid once, by the first step after the end: an episode may have ended before its first.
        failed = ~tally.running & (tally.outcome != _SATISFIED)
        reward = reward - jnp.where(failed & ~state.paid, _cost_of_failure(state.scene.world), 0.0)
        after = dataclasses.replace(after, paid=state.paid | failed)
        kind = jnp.where(tally.running, StepType.MID, StepType.LAST).astype(jnp.int8)
        return after, self._time_step(after, kind, reward)

    def _assessed(self, scene: Scene, progress: Progress, paid: Bool[Array, ""]) -> EnvState:
        """The state with known space assessed; where no action is left the task is infeasible."""
        decision = self.config.decision
        situation = assess(
            progress.belief,
            progress.cell,
            progress.tally.state,
            scene.task,
            decision.frontiers,
            decision.irrevocable_last,
        )
        # Assessed once, for this observation and for the next move: distances are most of a step's work.
        nowhere = progress.tally.running & ~jnp.any(self._action_mask(situation))
        outcome = jnp.where(nowhere, jnp.int8(_INFEASIBLE), progress.tally.outcome)
        tally = dataclasses.replace(progress.tally, outcome=outcome)
        progress = dataclasses.replace(progress, tally=tally)
        return EnvState(scene=scene, progress=progress, situation=situation, paid=paid)

    def _distances(self, situation: Situation) -> Float32[Array, "S Z"]:
        """To each subgoal in each state, inf where there is no way; padded subgoals included."""
        subgoals = situation.subgoals
        # Masked subgoals point at cell (0, 0), whatever is there.
        found = situation.distances[subgoals.cells[:, 0], subgoals.cells[:, 1]]
        return jnp.where(subgoals.mask[:, None], found, jnp.inf)

    def _action_mask(self, situation: Situation) -> Bool[Array, " A"]:
        task = situation.task
        # An edge can be attempted from where the robot can arrive in the state in which the edge begins.
        reached = jnp.isfinite(self._distances(situation)[:, task.edges[:, 0]]) & task.edge_mask[None, :]
        finishes = jnp.isfinite(situation.finish_cost)
        explores = direct_move(situation, Policy.BASELINE, self.config.decision).kind != MoveKind.NONE
        return jnp.concatenate([reached.reshape(-1), jnp.stack([finishes, explores])])

    def _move(self, situation: Situation, action: Int32[Array, ""]) -> Move:
        """The move that carries out an action."""
        task, subgoals = situation.task, situation.subgoals
        nearest = direct_move(situation, Policy.BASELINE, self.config.decision)
        goes = action < self._finish
        # Indices of the last two actions, and of any that do not exist, are clipped; what they look up is not used.
        subgoal, edge = jnp.divmod(jnp.clip(action, 0, self._finish - 1), self._edges)
        finishes = action == self._finish
        cell = jnp.where(goes, subgoals.cells[subgoal], nearest.target_cell)
        cell = jnp.where(finishes, situation.finish_cell, cell)
        target = jnp.where(goes, task.edges[edge, 0], nearest.target_state)
        target = jnp.where(finishes, situation.finish_state, target)
        kind = jnp.where(goes, MoveKind.ACTION, jnp.where(finishes, MoveKind.FINISH, nearest.kind))
        exists = (action >= 0) & (action < self.num_actions)
        allowed = exists & self._action_mask(situation)[jnp.clip(action, 0, self.num_actions - 1)]
        # Not NONE, which ends the trial as infeasible: the robot stays where it is and may choose again.
        cell, target = jnp.where(allowed, cell, situation.cell), jnp.where(allowed, target, situation.state)
        return move_to(situation, self.config.decision, kind, cell, target, jnp.float32(0.0))

    def _time_step(self, state: EnvState, step_type: Int8[Array, ""], reward: Float32[Array, ""]) -> TimeStep:
        tally = state.progress.tally
        # A budget is no part of the task: what could still have been earned is not 0 (gymnasium calls it truncation).
        goes_on = tally.running | (tally.outcome == _BUDGET)
        cost = tally.travelled * state.scene.world.resolution
        return TimeStep(
            step_type=step_type,
            reward=reward,
            discount=goes_on.astype(jnp.float32),
            observation=self._observation(state),
            extras={"cost": cost, "outcome": tally.outcome},
        )

    def _observation(self, state: EnvState) -> Observation:
        situation, progress = state.situation, state.progress
        distances, finish = self._distances(situation), situation.finish_cost
        return Observation(
            cells=progress.belief.cells,
            letters=progress.belief.letters,
            position=progress.cell,
            state=progress.tally.state,
            subgoals=situation.subgoals.cells,
            subgoal_mask=situation.subgoals.mask,
            # Networks do not take infinities; the mask says which entries mean something.
            distances=jnp.where(jnp.isfinite(distances), distances, 0.0),
            finish_distance=jnp.where(jnp.isfinite(finish), finish, 0.0),
            # After the end there is nothing to choose.
            action_mask=self._action_mask(situation) & progress.tally.running,
        )


def _cost_of_failure(world: World) -> Float32[Array, ""]:
    return UNSATISFIED * jnp.sum(world.extent).astype(jnp.float32) * world.resolution
