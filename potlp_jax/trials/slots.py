"""One decision of a simulated trial, and the leg to the next, as pure functions over the arrays of one slot or of many.

The decisions are those of ``loop.run_trial`` (Bradley et al. 2021, Algorithm 1) under the same ``rules``; ``batch``
keeps the slots filled.

On a CPU the phases before and after the search work through the slots one by one: their loops end at different times,
and in lockstep all would wait for the slowest. Elsewhere, and with the environment variable ``POTLP_LOCKSTEP`` on a CPU
too, they run in lockstep. The search always does.
"""

import dataclasses
import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Int16, Int32, Key, PRNGKeyArray

from potlp_jax.cache import is_switched_on
from potlp_jax.compiling import jit_by_class
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.observing import (
    ObservingEstimator,
    look_step,
    looks_between,
    looks_on_the_way,
    with_memory,
)
from potlp_jax.planning.estimates import Estimates, Estimator, ask
from potlp_jax.planning.move import Move, MoveKind
from potlp_jax.planning.policies import Policy, PolicyFunction, planned_move, policy_function
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.situation import Situation, assess, planning_problem
from potlp_jax.task.task import TaskArrays
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.robot import first_seen_at_start, follow, initial_belief, photograph
from potlp_jax.trials.rules import (
    Stop,
    Tally,
    arrive,
    count_decision,
    decision_key,
    first_tally,
    overflows,
    planning_key,
    sensing_key,
    stop_of,
)
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import step_length
from potlp_jax.world.sensing import observe

LOCKSTEP: str = "POTLP_LOCKSTEP"
"""Environment variable that makes all phases run in lockstep, unless it is empty or 0: what accelerators do, on a CPU.
"""

EMPTY: int = -2
"""``Tally.outcome`` of a slot without a trial; neither running nor ended."""

OUTGROWN: int = -3
"""``Tally.outcome`` of a trial with more frontiers than its array of subgoals holds: it waits for a longer one."""

Asked = ObservingEstimator | Estimator | None
"""What all slots share of what the policy asks: an estimator, whose memory is that of the beginning, or nothing."""


@struct.dataclass(kw_only=True)
class Scene:
    """What stays as it is during a trial.

    Attributes:
        world: the true map.
        task: arrays of the task.
        planning, sensing: keys of the planner and of the sensors.
    """

    world: World
    task: TaskArrays
    planning: Key[Array, "*batch"]
    sensing: Key[Array, "*batch"]


@struct.dataclass(kw_only=True)
class Progress:
    """What changes during a trial.

    Attributes:
        belief: what is known of the map.
        memory: of the estimator; None where the policy asks none that remembers.
        looked: whether the memory has what the camera saw up to here: a decision that is taken again does not look
            again.
        decided: cells entered until the last decision; -1 before the first.
        first_seen: step at which each cell was first observed.
        cell: where the robot is.
        path: cells so far, ``tally.steps + 1`` of them; what stands behind them means nothing.
        tally: what the rules count.
    """

    belief: BeliefMap
    memory: Any
    looked: Bool[Array, "*batch"]
    decided: Int32[Array, "*batch"]
    first_seen: Int32[Array, "*batch H W"]
    cell: Int32[Array, "*batch 2"]
    path: Int16[Array, "*batch L 2"]
    tally: Tally


def _takes_turns() -> bool:
    return jax.default_backend() == "cpu" and not is_switched_on(LOCKSTEP)


@dataclasses.dataclass(frozen=True)
class Setup:
    """What all trials of a batch share, static under jit.

    Attributes:
        policy: of all trials.
        config: of all trials.
        takes_turns: whether slots go through the phases one by one, or in lockstep.
    """

    policy: Policy | PolicyFunction
    config: TrialConfig
    takes_turns: bool = dataclasses.field(default_factory=_takes_turns)

    @property
    def searches(self) -> bool:
        """Whether the policy is one of those whose searches run together over all slots."""
        return isinstance(self.policy, Policy) and self.policy.searches

    def grown(self) -> "Setup | None":
        """With the next longer array of subgoals, None where it is as long as it may become.

        Nothing in ``Scene`` and ``Progress`` has its length: a trial goes on with either.
        """
        decision = self.config.decision.grown()
        if decision is None:
            return None
        return dataclasses.replace(self, config=dataclasses.replace(self.config, decision=decision))


@partial(jit_by_class, static_argnames=("setup",))
def begin(world: World, arrays: TaskArrays, key: PRNGKeyArray, memory: Any, *, setup: Setup) -> tuple[Scene, Progress]:
    """A trial before its first decision; what is visible from the start is known.

    Args:
        world: the true map, padded to the batch's shape.
        arrays: of the task, padded to the batch's sizes.
        key: of the trial.
        memory: of an estimator that has seen nothing yet, or None.
        setup: of the batch; static.

    Returns:
        What stays and what changes. The trial may have ended already, where its first letter decides the task.
    """
    config = setup.config
    # As ``SimulatedRobot`` does, in the same order.
    belief = observe(initial_belief(world, config), world, world.start, config.sensor)
    height, width = world.shape
    # The budget is checked between legs only, and a leg is no longer than the horizon; diagonal moves are fewer.
    length = math.ceil(config.budget_factor * (height + width)) + 2 + config.decision.horizon(height, width)
    progress = Progress(
        belief=belief,
        memory=memory,
        looked=jnp.bool_(False),
        decided=jnp.int32(-1),
        first_seen=first_seen_at_start(belief),
        cell=world.start,
        path=jnp.zeros((length, 2), jnp.int16).at[0].set(world.start.astype(jnp.int16)),
        tally=first_tally(belief, world.start, arrays),
    )
    scene = Scene(world=world, task=arrays, planning=planning_key(key), sensing=sensing_key(key))
    return scene, _arrive(scene, progress, jnp.bool_(False), config)


def _arrive(scene: Scene, progress: Progress, gave_up: Bool[Array, ""], config: TrialConfig) -> Progress:
    tally = arrive(progress.tally, progress.belief, progress.cell, scene.task, gave_up, config)
    return dataclasses.replace(progress, tally=tally)


def step(scene: Scene, asked: Asked, setup: Setup, progress: Progress) -> Progress:
    """One decision, and the leg to the next, in every slot whose trial is running.

    Args:
        scene: of all slots.
        asked: what the slots share of what the policy asks.
        setup: of the batch; static.
        progress: of all slots.

    Returns:
        The progress; that of slots which are not running is unchanged. A trial whose frontiers were too many for the
        array of subgoals has not gone anywhere and is ``OUTGROWN``, if ``setup.grown()`` can take it.
    """
    # The library's searches have a kernel that takes all slots at once; any other policy is asked slot by slot.
    if setup.searches:
        return _search_together(scene, asked, setup, progress)
    return _each(setup, partial(_decide_alone, setup, asked), progress, scene)


def _search_together(scene: Scene, asked: Asked, setup: Setup, progress: Progress) -> Progress:
    """As ``policies.search_move``, with the searches of all slots in one kernel."""
    decision = setup.config.decision

    def prepare(progress: Progress, scene: Scene) -> tuple[Any, ...]:
        memory, situation, estimates, key = _consider(setup, asked, progress, scene)
        running = progress.tally.running
        problem = _phase(running, partial(planning_problem, config=decision), situation, estimates)
        return memory, situation, problem, key

    memory, situation, problem, keys = _each(setup, prepare, progress, scene)
    # ``plan_actions`` turns this vmap into one kernel with a batch axis: its loop ends when the last slot is done.
    plans = jax.vmap(lambda problem, key: plan_actions(problem, key, decision.search))(problem, keys)

    def act(progress: Progress, scene: Scene, *considered: Any) -> Progress:
        tally = progress.tally
        move = _phase(tally.running, partial(planned_move, config=decision), *considered, tally.intention)
        return _advance_unless_outgrown(setup, progress, scene, move)

    # Intentions come from the progress, not from the search: commitment is applied when the plan is carried out.
    return _each(setup, act, dataclasses.replace(progress, memory=memory), scene, situation, problem, plans)


def _decide_alone(setup: Setup, asked: Asked, progress: Progress, scene: Scene) -> Progress:
    """Decide in one slot, with whatever function the policy is, and go."""
    memory, situation, estimates, key = _consider(setup, asked, progress, scene)
    tally, config = progress.tally, setup.config.decision

    def decide(situation: Situation, estimates: Estimates | None, key: PRNGKeyArray, intention: Any) -> Move:
        return policy_function(setup.policy)(situation, estimates, key, config, intention)

    move = _phase(tally.running, decide, situation, estimates, key, tally.intention)
    return _advance_unless_outgrown(setup, dataclasses.replace(progress, memory=memory), scene, move)


def _advance_unless_outgrown(setup: Setup, progress: Progress, scene: Scene, move: Move) -> Progress:
    """Go, but for trials whose decision is to be taken again with a longer array of subgoals."""
    # Decided when tracing: where arrays cannot grow the decision stands as it is.
    if setup.grown() is not None:
        tally = progress.tally
        outgrown = tally.running & overflows(move)
        outcome = jnp.where(outgrown, OUTGROWN, tally.outcome).astype(jnp.int8)
        # Not running any more, so that ``advance`` leaves it where it is.
        progress = dataclasses.replace(
            progress, looked=progress.looked | outgrown, tally=dataclasses.replace(tally, outcome=outcome)
        )
    return advance(setup, progress, scene, move)


def _each(setup: Setup, function: Any, *batches: Any) -> Any:
    """Apply to every slot: one by one, or in lockstep."""
    if setup.takes_turns:
        return jax.lax.map(lambda row: function(*row), batches)
    return jax.vmap(function)(*batches)


def _phase(running: Bool[Array, ""], function: Any, *arguments: Any) -> Any:
    """The result of a phase of a decision, zeros where the trial is not running: idle slots cost nothing on a CPU.

    The branch also keeps phases apart. XLA's CPU compiler otherwise merges one into the loops of the next, and computes
    it there many times: a whole decision took three times as long as its phases.
    """

    structure: Any = None

    def leaves_of(*arguments: Any) -> list[Array]:
        nonlocal structure
        leaves, structure = jax.tree.flatten(function(*arguments))
        return leaves

    # Compiled together, so that it is traced once for its shapes and the branch.
    phase = jax.jit(leaves_of)
    blank = jax.eval_shape(phase, *arguments)
    leaves = jax.lax.cond(running, phase, lambda *_: [_zeros(leaf) for leaf in blank], *arguments)
    return jax.tree.unflatten(structure, leaves)


def _zeros(leaf: Any) -> Array:
    # A key has no zero; any key will do for a result that nobody reads.
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jax.random.key(0), leaf.shape)
    return jnp.zeros(leaf.shape, leaf.dtype)


def _consider(
    setup: Setup, asked: Asked, progress: Progress, scene: Scene
) -> tuple[Any, Situation, Estimates | None, PRNGKeyArray]:
    """What every policy is given: the situation, and estimates where it asks for them."""
    # Panoramas first: an estimator answers from what can be seen here too.
    running, decision = progress.tally.running, setup.config.decision
    looks = isinstance(asked, ObservingEstimator)
    memory = _memory_after_looking(setup, asked, progress, scene) if looks else progress.memory
    situation = _phase(
        running,
        partial(assess, config=decision.frontiers, irrevocable_last=decision.irrevocable_last),
        progress.belief,
        progress.cell,
        progress.tally.state,
        scene.task,
    )
    # Known when tracing: a policy without an estimator has no such phase in its program.
    estimates = None
    if _estimator(setup, asked, memory, scene) is not None:

        def estimate(progress: Progress, subgoals: Subgoals, scene: Scene) -> Estimates:
            estimator = _estimator(setup, asked, progress.memory, scene)
            assert estimator is not None
            return ask(estimator, progress.belief, subgoals, scene.task, progress.tally.state)

        estimates = _phase(running, estimate, dataclasses.replace(progress, memory=memory), situation.subgoals, scene)
        situation = situation.with_status_of(estimates)
    # As in the loop: by the number of the decision.
    return memory, situation, estimates, decision_key(scene.planning, progress.tally.decisions)


def _memory_after_looking(setup: Setup, asked: Asked, progress: Progress, scene: Scene) -> Any:
    """What the estimator remembers after what the camera saw on the way here, where it is shown that, and from here."""
    assert isinstance(asked, ObservingEstimator)
    config, before, now = setup.config, progress.decided, progress.tally.steps
    every = config.look_every if looks_on_the_way(asked) else 0
    between = jnp.maximum(looks_between(before, now, every), 0)

    def look(number: Int32[Array, ""], memory: Any) -> Any:
        step = jnp.where(number < between, look_step(before, number, every), now)
        cell = progress.path[step].astype(jnp.int32)
        # As ``SimulatedRobot.panorama``.
        key = jax.random.fold_in(scene.sensing, step)
        seen = asked.encode(photograph(scene.world, cell, key, config.camera, config.disturbance))
        return with_memory(asked, memory).remember(seen, progress.belief, cell).memory

    # A loop of no turns where there is nothing to look at: a branch would copy the memory.
    looks = progress.tally.running & ~progress.looked
    return jax.lax.fori_loop(0, jnp.where(looks, between + 1, 0), look, progress.memory)


def _estimator(setup: Setup, asked: Asked, memory: Any, scene: Scene) -> Estimator | None:
    """What the policy asks in one slot."""
    # Decided when tracing: each slot has its own map, its own memory, or shares what it asks.
    if setup.policy is Policy.ORACLE:
        return TrueMapEstimator(world=scene.world)
    return with_memory(asked, memory) if isinstance(asked, ObservingEstimator) else asked


def advance(setup: Setup, progress: Progress, scene: Scene, move: Move) -> Progress:
    """Follow a move's path until the next decision is due, and see whether the trial ends there.

    Args:
        setup: of the batch; static.
        progress: of one slot.
        scene: of the slot.
        move: what was decided.

    Returns:
        The progress; unchanged where the trial is not running.
    """
    config = setup.config
    stop = stop_of(move, progress.tally, progress.belief, config)

    def go(progress: Progress, scene: Scene, move: Move, stop: Stop) -> Progress:
        belief, first_seen, moved = follow(
            scene.world, progress.belief, progress.first_seen, move.path, progress.tally.steps, stop, config.sensor
        )
        went = _went(progress, move, belief, first_seen, moved)
        return _arrive(scene, went, (move.kind == MoveKind.NONE) & (moved == 0), config)

    # The memory is not touched; in the branch it would be copied.
    memory, without = progress.memory, dataclasses.replace(progress, memory=None)
    went = jax.lax.cond(progress.tally.running, go, lambda progress, *_: progress, without, scene, move, stop)
    return dataclasses.replace(went, memory=memory)


def _went(
    progress: Progress, move: Move, belief: BeliefMap, first_seen: Int32[Array, "H W"], moved: Int32[Array, ""]
) -> Progress:
    """After ``moved`` moves along the move's path."""
    # The simulated robot goes where the path does, so that moves and states are read from it.
    cells, tally = move.path.cells, progress.tally
    # Over the whole path at once; moves that were not made are masked.
    diagonal = (step_length(cells[:-1], cells[1:]) > 1.0) & (jnp.arange(cells.shape[0] - 1) < moved)
    diagonals = jnp.sum(diagonal, dtype=jnp.int32)
    # What is written beyond the moves made is overwritten by the next ones.
    path = jax.lax.dynamic_update_slice(progress.path, cells[1:].astype(jnp.int16), (tally.steps + 1, 0))
    counted = count_decision(tally, move)
    return dataclasses.replace(
        progress,
        belief=belief,
        looked=jnp.bool_(False),
        decided=tally.steps,
        first_seen=first_seen,
        cell=cells[moved],
        path=path,
        tally=dataclasses.replace(
            counted,
            state=move.path.states[moved],
            straight=tally.straight + moved - diagonals,
            diagonal=tally.diagonal + diagonals,
        ),
    )
