"""One decision of a trial, and the way to the next, as pure functions over the arrays of one slot or of many.

The decisions are those of ``trial.run_trial`` (Bradley et al. 2021, Algorithm 1); ``batch`` keeps the slots filled.

On a CPU the phases before and after the search work through the slots one by one: their loops end at different times,
and in lockstep all would wait for the slowest. Elsewhere they run in lockstep. The search always does.
"""

import dataclasses
import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int8, Int16, Int32, Key, PRNGKeyArray, UInt32

from potlp_jax.learning.estimator import NetworkEstimator
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.memory import Views, remember
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig, Params
from potlp_jax.planning.commitment import Intention
from potlp_jax.planning.estimates import Estimates, Estimator, ask
from potlp_jax.planning.policies import (
    Move,
    MoveKind,
    Policy,
    Situation,
    assess,
    direct_move,
    planned_move,
    planning_problem,
)
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.task.task import TaskArrays
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import STUCK_REPEATS, planning_key, sensing_key
from potlp_jax.trials.record import NEVER_SEEN, Outcome
from potlp_jax.trials.robot import DIAGONAL, Stop, follow, photograph
from potlp_jax.types import status_array
from potlp_jax.world.frontiers import Subgoals
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.sensing import observe

OUTCOMES: tuple[Outcome, ...] = tuple(Outcome)
"""What ``Progress.outcome`` is an index into."""

_SATISFIED, _INFEASIBLE, _STUCK, _BUDGET = (
    OUTCOMES.index(outcome) for outcome in (Outcome.SATISFIED, Outcome.INFEASIBLE, Outcome.STUCK, Outcome.BUDGET)
)
_RUNNING = -1

EMPTY: int = -2
"""``Progress.outcome`` of a slot without a trial."""


@struct.dataclass(kw_only=True)
class Scene:
    """What stays as it is during a trial."""

    world: World
    task: TaskArrays
    planning: Key[Array, "*batch"]
    sensing: Key[Array, "*batch"]


@struct.dataclass(kw_only=True)
class Progress:
    """What changes. ``views`` are those of a policy that looks, else None.

    The robot has made ``straight + diagonal`` moves, ``path`` holds its cells up to there. ``visits`` counts, per cell
    and state, the decisions taken there since ``known`` cells are known. ``outcome`` is an index into the outcomes,
    or says that the trial is running or the slot empty.
    """

    belief: BeliefMap
    views: Views | None
    first_seen: Int32[Array, "*batch H W"]
    cell: Int32[Array, "*batch 2"]
    state: Int32[Array, "*batch"]
    straight: Int32[Array, "*batch"]
    diagonal: Int32[Array, "*batch"]
    path: Int16[Array, "*batch L 2"]
    visits: Int8[Array, "*batch H W Z"]
    known: Int32[Array, "*batch"]
    decisions: Int32[Array, "*batch"]
    fallbacks: Int32[Array, "*batch"]
    status: UInt32[Array, "*batch"]
    outcome: Int8[Array, "*batch"]
    intention: Intention

    @property
    def steps(self) -> Int32[Array, "*batch"]:
        """Moves made."""
        return self.straight + self.diagonal

    @property
    def travelled(self) -> Float32[Array, "*batch"]:
        """Cells travelled."""
        return self.straight.astype(jnp.float32) + self.diagonal.astype(jnp.float32) * jnp.float32(DIAGONAL)

    @property
    def running(self) -> Bool[Array, "*batch"]:
        """Whether the trial goes on."""
        return self.outcome == _RUNNING


@dataclasses.dataclass(frozen=True)
class Rules:
    """What all trials of a batch share, static under jit. ``network`` is None for policies that do not look."""

    policy: Policy
    config: TrialConfig
    network: NetworkConfig | None


@partial(jax.jit, static_argnames="rules")
def begin(
    world: World, arrays: TaskArrays, key: PRNGKeyArray, views: Views | None, *, rules: Rules
) -> tuple[Scene, Progress]:
    """A trial before its first decision; what is visible from the start is known."""
    config = rules.config
    blank = BeliefMap.revealed(world) if config.revealed else BeliefMap.unobserved(world)
    belief = observe(blank, world, world.start, config.sensor)
    height, width = world.shape
    moves = math.ceil(config.budget_factor * (height + width)) + 2 + config.decision.horizon(height, width)
    letter = belief.letters[world.start[0], world.start[1]]
    progress = Progress(
        belief=belief,
        views=views,
        first_seen=jnp.where(belief.unknown, NEVER_SEEN, 0).astype(jnp.int32),
        cell=world.start,
        state=arrays.transitions[arrays.initial, letter],
        straight=jnp.int32(0),
        diagonal=jnp.int32(0),
        path=jnp.zeros((moves, 2), jnp.int16).at[0].set(world.start.astype(jnp.int16)),
        visits=jnp.zeros((height, width, arrays.transitions.shape[0]), jnp.int8),
        known=jnp.int32(0),
        decisions=jnp.int32(0),
        fallbacks=jnp.int32(0),
        status=status_array(),
        outcome=jnp.int8(_RUNNING),
        intention=Intention.none(),
    )
    scene = Scene(world=world, task=arrays, planning=planning_key(key), sensing=sensing_key(key))
    return scene, _arrive(scene, progress, config)


def _arrive(scene: Scene, progress: Progress, config: TrialConfig) -> Progress:
    """At the place of a decision: whether the trial ends here (docs/model.md section 7); in the order of ``Loop``."""
    known = jnp.sum(~progress.belief.unknown, dtype=jnp.int32)
    visits = jnp.where(known == progress.known, progress.visits, 0).astype(jnp.int8)
    visits = visits.at[progress.cell[0], progress.cell[1], progress.state].add(jnp.int8(1))
    stuck = visits[progress.cell[0], progress.cell[1], progress.state] >= STUCK_REPEATS
    outcome = jnp.where(stuck, _STUCK, _RUNNING)
    outcome = jnp.where(progress.travelled >= _budget(scene, config), _BUDGET, outcome)
    outcome = jnp.where(scene.task.trap[progress.state], _INFEASIBLE, outcome)
    outcome = jnp.where(scene.task.accepting[progress.state], _SATISFIED, outcome)
    return dataclasses.replace(progress, visits=visits, known=known, outcome=outcome.astype(jnp.int8))


def _budget(scene: Scene, config: TrialConfig) -> Float32[Array, ""]:
    """Cells that may be travelled."""
    return jnp.float32(config.budget_factor) * jnp.sum(scene.world.extent).astype(jnp.float32)


def step(scene: Scene, params: Params | None, rules: Rules, progress: Progress) -> Progress:
    """One decision, and the way to the next, in every slot whose trial is running."""
    decision = rules.config.decision
    if not rules.policy.searches:
        return _each(partial(_decide_directly, rules), progress, scene)
    views, situation, problem, keys = _each(partial(_consider, rules, params), progress, scene)
    plans = jax.vmap(lambda problem, key: plan_actions(problem, key, decision.search))(problem, keys)

    def act(progress: Progress, scene: Scene, *thoughts: Any) -> Progress:
        move = _phase(progress.running, partial(planned_move, config=decision), *thoughts, progress.intention)
        return advance(rules, progress, scene, move)

    return _each(act, dataclasses.replace(progress, views=views), scene, situation, problem, plans)


def _each(function: Any, *batches: Any) -> Any:
    """Apply to every slot: one by one on a CPU, else in lockstep."""
    if jax.default_backend() == "cpu":
        return jax.lax.map(lambda row: function(*row), batches)
    return jax.vmap(function)(*batches)


def _phase(running: Bool[Array, ""], function: Any, *arguments: Any) -> Any:
    """The result of a phase of a decision, zeros where the trial is not running: idle slots cost nothing on a CPU.

    The branch also keeps phases apart. XLA's CPU compiler else merges one into the loops of the next, and computes it
    there many times: a whole decision took three times as long as its phases.
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
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jax.random.key(0), leaf.shape)
    return jnp.zeros(leaf.shape, leaf.dtype)


def _decide_directly(rules: Rules, progress: Progress, scene: Scene) -> Progress:
    """Decide without a search, and go."""
    situation = _assess(rules, progress, scene)
    move = _phase(
        progress.running,
        lambda situation: direct_move(situation, rules.policy, rules.config.decision),
        situation,
    )
    return advance(rules, progress, scene, move)


def _assess(rules: Rules, progress: Progress, scene: Scene) -> Situation:
    return _phase(
        progress.running,
        partial(assess, config=rules.config.decision.frontiers),
        progress.belief,
        progress.cell,
        progress.state,
        scene.task,
    )


def _consider(
    rules: Rules, params: Params | None, progress: Progress, scene: Scene
) -> tuple[Views | None, Situation, PlanningProblem, PRNGKeyArray]:
    """All of a decision that comes before the search."""
    views = None if rules.network is None else _look(rules, rules.network, params, progress, scene)
    situation = _assess(rules, progress, scene)

    def estimate(progress: Progress, subgoals: Subgoals, scene: Scene) -> Estimates:
        estimator = _estimator(rules, params, progress.views, scene)
        return ask(estimator, progress.belief, subgoals, scene.task, progress.state)

    seeing = dataclasses.replace(progress, views=views)
    estimates = _phase(progress.running, estimate, seeing, situation.subgoals, scene)
    problem = _phase(progress.running, partial(planning_problem, config=rules.config.decision), situation, estimates)
    return views, situation, problem, jax.random.fold_in(scene.planning, progress.decisions)


def _look(rules: Rules, network: NetworkConfig, params: Params | None, progress: Progress, scene: Scene) -> Views:
    """What is remembered after a look from here."""
    config, running = rules.config, progress.running
    key = jax.random.fold_in(scene.sensing, progress.steps)
    camera = partial(photograph, camera=config.camera, disturbance=config.disturbance)
    panorama = _phase(running, camera, scene.world, progress.cell, key)
    features = _phase(running, EstimatorNetwork(network).encode, params, panorama)
    views = progress.views
    assert views is not None
    # Not a phase of its own: a branch would copy the memory.
    return remember(views, features, progress.belief, progress.cell)


def _estimator(rules: Rules, params: Params | None, views: Views | None, scene: Scene) -> Estimator:
    """What the policy asks."""
    if rules.network is None or views is None or params is None:
        return TrueMapEstimator(world=scene.world)
    return NetworkEstimator(params=params, views=views, config=rules.network)


def advance(rules: Rules, progress: Progress, scene: Scene, move: Move) -> Progress:
    """Follow the move's path until the next decision is due, and see whether the trial ends there."""
    config = rules.config
    stop = Stop(
        replan_distance=jnp.float32(config.replan_distance),
        budget=_budget(scene, config) - progress.travelled,
        is_frontier=(move.kind == MoveKind.ACTION)
        | (move.kind == MoveKind.FRONTIER)
        | (move.kind == MoveKind.FALLBACK),
    )

    def go(progress: Progress, scene: Scene, move: Move, stop: Stop) -> Progress:
        belief, first_seen, moved = follow(
            scene.world, progress.belief, progress.first_seen, move.path, progress.steps, stop, config.sensor
        )
        went = _went(progress, move, belief, first_seen, moved)
        arrived = _arrive(scene, went, config)
        nowhere = move.kind == MoveKind.NONE
        return dataclasses.replace(arrived, outcome=jnp.where(nowhere, jnp.int8(_INFEASIBLE), arrived.outcome))

    # The views are not touched; in the branch they would be copied.
    views, blind = progress.views, dataclasses.replace(progress, views=None)
    went = jax.lax.cond(progress.running, go, lambda progress, *_: progress, blind, scene, move, stop)
    return dataclasses.replace(went, views=views)


def _went(
    progress: Progress, move: Move, belief: BeliefMap, first_seen: Int32[Array, "H W"], moved: Int32[Array, ""]
) -> Progress:
    """After ``moved`` moves along the move's path."""
    cells = move.path.cells
    diagonal = jnp.all(cells[1:] != cells[:-1], axis=1) & (jnp.arange(cells.shape[0] - 1) < moved)
    diagonals = jnp.sum(diagonal, dtype=jnp.int32)
    # What is written beyond the moves made is overwritten by the next ones.
    path = jax.lax.dynamic_update_slice(progress.path, cells[1:].astype(jnp.int16), (progress.steps + 1, 0))
    return dataclasses.replace(
        progress,
        belief=belief,
        first_seen=first_seen,
        cell=cells[moved],
        state=move.path.states[moved],
        straight=progress.straight + moved - diagonals,
        diagonal=progress.diagonal + diagonals,
        path=path,
        decisions=progress.decisions + 1,
        fallbacks=progress.fallbacks + (move.kind == MoveKind.FALLBACK).astype(jnp.int32),
        status=progress.status | move.status,
        intention=move.intention,
    )
