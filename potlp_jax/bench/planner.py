"""The planner's parts measured one by one: search, distances, and the whole decision by phase."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Int32

from potlp_jax.bench.memory import tree_memory
from potlp_jax.bench.problems import family_problem
from potlp_jax.bench.timing import Timing, compile_call
from potlp_jax.environments.registry import make
from potlp_jax.environments.rooms import Rooms, RoomsConfig
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.planning.distances.paths import shortest_path
from potlp_jax.planning.distances.product import grid_distances, product_distances, product_transitions
from potlp_jax.planning.estimates import Estimator, ask
from potlp_jax.planning.move import Move, MoveKind
from potlp_jax.planning.policies import Policy, decide
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import plan_actions, search
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig, Situation, assess, planning_problem
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.types import NO_STATE
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.sensing import SensorConfig, observe

OBSERVATIONS: int = 3
"""Cells from which a scene has been observed: enough for several frontiers, few enough to leave most unknown."""


@struct.dataclass(kw_only=True)
class Scene:
    """A robot in the middle of a task: what it knows, and the answers to what it does not.

    Attributes:
      belief: what has been observed so far.
      cell: the robot's cell.
      state: the automaton's state, the letter of the robot's cell read.
      task: arrays of the task.
      estimator: the true map's.
    """

    belief: BeliefMap
    cell: Int32[Array, "*batch 2"]
    state: Int32[Array, "*batch"]
    task: TaskArrays
    estimator: Estimator


def make_scene(
    world: World, task: Task, sensor: SensorConfig = SensorConfig(), observations: int = OBSERVATIONS
) -> Scene:
    """A scene in a world: observed from the start, then each time from the farthest cell that known space reaches.

    Args:
        world: the truth.
        task: of the world's propositions.
        sensor: with which the robot observes.
        observations: how many there are, at least 1.

    Returns:
        The robot at the cell of the last observation, the automaton in the state after that cell's letter.
    """
    belief, cell = observe(BeliefMap.unobserved(world), world, world.start, sensor), world.start
    for _ in range(observations - 1):
        cost = np.asarray(grid_distances(belief.free, cell, belief.resolution))
        farthest = np.unravel_index(np.argmax(np.where(np.isfinite(cost), cost, -1.0)), cost.shape)
        cell = jnp.asarray(farthest, jnp.int32)
        belief = observe(belief, world, cell, sensor)
    # The word up to here is left out: only where the robot stands matters to what a decision takes.
    letter = int(belief.letters[cell[0], cell[1]])
    return Scene(
        belief=belief,
        cell=cell,
        state=jnp.int32(task.dfa.transitions[task.dfa.initial, letter]),
        task=task.arrays,
        estimator=TrueMapEstimator(world=world),
    )


def make_world(environment: str, size: int, index: int = 0) -> World:
    """A world of the validation split.

    Args:
        environment: a registered name.
        size: side of a floor of ``rooms`` in cells; other environments ignore it.
        index: number of the world in its split.

    Returns:
        The world.
    """
    # Validation, so that measuring never opens a world of the test split.
    generator = Rooms(RoomsConfig(smallest=size, largest=size)) if environment == "rooms" else make(environment)
    return generator.generate(world_key(Split.VALIDATION, index, generator.name))


def family_batch(family: str, subgoals: int, count: int) -> PlanningProblem:
    """The first tuning problems of a benchmark family, stacked along a leading axis.

    Args:
        family: a key of ``problems.FAMILIES``.
        subgoals: S of each.
        count: how many.

    Returns:
        The problems, each field with the leading axis ``count``.
    """
    problems = [family_problem(family, subgoals, "tuning", index) for index in range(count)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)


@dataclasses.dataclass(frozen=True)
class SearchRow:
    """A batch of searches.

    ``simulations`` were asked for per search, ``simulations_run`` were run in all (a search may end early);
    ``mean_depth`` is the number of actions that a simulation takes, on average, None where the tree does not count.
    """

    family: str
    subgoals: int
    actions: int
    states: int
    batch: int
    simulations: int
    simulations_run: int
    tree_bytes: int
    batch_tree_bytes: int
    mean_depth: float | None
    simulations_per_s: float
    searches_per_s: float
    timing: Timing


def measure_search(family: str, subgoals: int, batch: int, config: BestFirstConfig, repeats: int) -> SearchRow:
    """Search the first tuning problems of a family in lockstep.

    Args:
        family: a key of ``problems.FAMILIES``.
        subgoals: S of each problem.
        batch: number of problems.
        config: settings of the search.
        repeats: timed runs.

    Returns:
        Shapes, memory and times.
    """
    # The kernel takes a leading batch axis, so the batch is searched as ``vmap`` would have it.
    problems, keys = family_batch(family, subgoals, batch), jax.random.split(jax.random.key(0), batch)
    tree_bytes = tree_memory(family_problem(family, subgoals, "tuning", 0), config).total
    call = compile_call(search, problems, keys, config, static_argnums=2)
    timing = call.timing(repeats)
    # Searches end early where nothing is left to decide, so the rate is by simulations that were run.
    _, tree = call.run()
    simulations = int(np.asarray(tree.simulations).sum())
    return SearchRow(
        family=family,
        subgoals=subgoals,
        actions=problems.action_count,
        states=problems.task.transitions.shape[-2],
        batch=batch,
        simulations=config.simulations,
        simulations_run=simulations,
        tree_bytes=tree_bytes,
        batch_tree_bytes=batch * tree_bytes,
        mean_depth=mean_depth(getattr(tree, "steps", None), tree.simulations),
        simulations_per_s=simulations / timing.run_s,
        searches_per_s=batch / timing.run_s,
        timing=timing,
    )


def mean_depth(steps: ArrayLike | None, simulations: ArrayLike) -> float | None:
    """Actions per simulation, over all trees: one ends at acceptance, at a dead end or at a new node.

    ``steps`` are the actions that a tree's simulations took in all, None where it does not count them.
    """
    return None if steps is None else float(np.asarray(steps).sum() / max(np.asarray(simulations).sum(), 1))


@dataclasses.dataclass(frozen=True)
class DistanceRow:
    """Shortest paths from ``sources`` product states to every cell in every state.

    ``reached`` is the share of product states that the average source reaches.
    """

    height: int
    width: int
    states: int
    sources: int
    reached: float
    ms_per_source: float
    timing: Timing


def measure_distances(scene: Scene, sources: int, repeats: int) -> DistanceRow:
    """Distances on the true map of the scene, from the robot and cells drawn at random, in its state.

    Args:
        scene: a scene with the true map's estimator.
        sources: number of cells, the robot's included.
        repeats: timed runs.

    Returns:
        Sizes and times.
    """
    world = world_of(scene)
    known = BeliefMap.revealed(world)
    moves = product_transitions(scene.task, known.letters, known.free)
    # As in a decision: nothing is left to do after acceptance.
    transitions = jnp.where(scene.task.accepting[None, None, :], NO_STATE, moves)
    # Sources that reach nothing would be solved at once and make the mean look good.
    reachable = np.isfinite(np.asarray(grid_distances(known.free, scene.cell, known.resolution)))
    cells = _spread(reachable, np.asarray(scene.cell), sources)
    states = jnp.broadcast_to(scene.state, (sources,))
    arguments = (transitions, known.free, jnp.asarray(cells, jnp.int32), states, known.resolution)
    call = compile_call(product_distances, *arguments)
    timing = call.timing(repeats)
    height, width, count = transitions.shape
    return DistanceRow(
        height=height,
        width=width,
        states=count,
        sources=sources,
        reached=float(np.isfinite(np.asarray(call.run())).mean()),
        ms_per_source=1e3 * timing.run_s / sources,
        timing=timing,
    )


def _spread(mask: Bool[np.ndarray, "H W"], first: Int32[np.ndarray, "2"], count: int) -> Int32[np.ndarray, "N 2"]:
    """``first`` and cells drawn evenly, always the same, from those where the mask is True."""
    # Row-major order and a fixed seed: two versions of the library solve the same sources.
    cells = np.argwhere(mask)
    drawn = np.random.default_rng(0).integers(len(cells), size=count - 1)
    return np.concatenate([first[None], cells[drawn]]).astype(np.int32)


def world_of(scene: Scene) -> World:
    """The world that the scene is in. Raises ValueError where its estimator is not the true map's."""
    if not isinstance(scene.estimator, TrueMapEstimator):
        raise ValueError("the scene's estimator is not the true map's: there is no world to measure distances in")
    return scene.estimator.world


@dataclasses.dataclass(frozen=True)
class PhaseRow:
    """One phase of a decision, or all of it (``whole``), each compiled as a program of its own."""

    phase: str
    per_s: float
    timing: Timing


class Phases:
    """Measures one phase after the other; each may be fed with what those before it returned."""

    def __init__(self, repeats: int) -> None:
        self.rows: list[PhaseRow] = []
        self._repeats = repeats

    def measure(self, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Add a row for the phase and return what it computes."""
        # Arguments that are configuration are closed over by ``function``, so everything here is an array.
        call = compile_call(function, *arguments)
        timing = call.timing(self._repeats)
        self.rows.append(PhaseRow(phase=name, per_s=1.0 / timing.run_s, timing=timing))
        return call.run()


def measure_decision(
    scene: Scene, config: DecisionConfig, repeats: int, policy: Policy = Policy.ORACLE
) -> list[PhaseRow]:
    """The phases of PO-TLP's decision in their order, each fed with the results of those before, then the whole.

    * assess: distances from the robot, frontiers, subgoals
    * estimates: the answers of the scene's estimator (the true map's) for every subgoal and outcome class
    * travel: distances between subgoals, as a planning problem
    * search: graph search over histories
    * path: through known space to the target

    Args:
        scene: where the robot is, and who answers.
        config: settings of the decision.
        repeats: timed runs of each phase.
        policy: whose decision the whole is; the phases are the same for all that search.

    Returns:
        A row for each phase, then one for the whole. Phases are programs of their own, so they add up to more.
    """
    key = jax.random.key(0)
    phases = Phases(repeats)
    situation = phases.measure(
        "assess",
        lambda belief, cell, state, task: assess(belief, cell, state, task, config.frontiers, config.irrevocable_last),
        scene.belief,
        scene.cell,
        scene.state,
        scene.task,
    )
    estimates = phases.measure(
        "estimates",
        ask,
        scene.estimator,
        scene.belief,
        situation.subgoals,
        scene.task,
        scene.state,
    )
    problem = phases.measure(
        "travel", lambda situation, estimates: planning_problem(situation, estimates, config), situation, estimates
    )
    phases.measure("search", lambda problem, key: plan_actions(problem, key, config.search), problem, key)

    # One program, in which XLA may share work between phases that the rows above count twice. The path's target is the
    # whole decision's, so the whole is measured before the last phase and reported after it.
    move = phases.measure("whole", lambda scene, key: _decide(scene, key, policy, config), scene, key)
    phases.measure("path", lambda situation, move: _path(situation, move, config), situation, move)
    *parts, all_of_it, path = phases.rows
    return [*parts, path, all_of_it]


def _decide(scene: Scene, key: Array, policy: Policy, config: DecisionConfig) -> Move:
    """The whole decision in a scene."""
    return decide(
        scene.belief,
        scene.cell,
        scene.state,
        scene.task,
        scene.estimator,
        key,
        policy=policy,
        config=config,
    )


def _path(situation: Situation, move: Move, config: DecisionConfig) -> Any:
    """The last phase: from the robot to the move's target."""
    return shortest_path(
        *situation.moves_for(move.kind == MoveKind.FINISH),
        situation.belief.free,
        situation.cell,
        situation.state,
        move.target_cell,
        move.target_state,
        horizon=config.horizon(*situation.belief.cells.shape),
        resolution=situation.belief.resolution,
    )


def as_dict(row: SearchRow | DistanceRow | PhaseRow) -> dict[str, Any]:
    """A row, JSON-able, its timing flattened into it."""
    # Rows have no field in common with ``Timing``.
    fields = {field.name: getattr(row, field.name) for field in dataclasses.fields(row) if field.name != "timing"}
    return {**fields, **row.timing.as_dict()}
