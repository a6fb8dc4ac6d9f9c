"""A simulated robot that wanders through a building by simple rules, for collecting views.

It pursues one task after the other: it finishes in known space where it can, and otherwise goes to a frontier that can
be reached without violating the task, the nearest or a random one, until the frontier is gone. So its poses are like
those of planners with other estimates: early and late in tasks, at the mouths of hallways and inside of them, on the
way to what is known and back. Nothing is learned or searched.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32

from potlp_jax.checks import NOT_NEGATIVE, POSITIVE, SHARE, require_fields
from potlp_jax.errors import DatasetError
from potlp_jax.learning.questions import LARGEST
from potlp_jax.learning.scenes import Pose
from potlp_jax.planning.distances.paths import KnownPath, shortest_path
from potlp_jax.planning.situation import Situation, assess
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.robot import SimulatedRobot
from potlp_jax.trials.rules import Stop
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import Cell, as_cell, path_length
from potlp_jax.world.sensing import SensorConfig

_HORIZON = 24
"""Moves before the next pose at most, so that there are poses along a way on which nothing new is seen."""

# Tasks drawn before it is given up that one of them leads anywhere: as many as the pool of a world has.
_TASKS_TRIED = 12


@dataclasses.dataclass(frozen=True)
class ExplorerConfig:
    """How the robot wanders; distances in cells.

    Attributes:
        random_frontier: how often a frontier is drawn, instead of taking the nearest.
        replan_distance: travelled, at least, between poses while the map changes.
        travel_factor: times the sum of the map's sides is travelled at most.
        sensor: the mapping sensor.
        frontiers: which components of the frontier it may choose from.
    """

    random_frontier: float = 0.5
    replan_distance: float = 4.0
    travel_factor: float = 6.0
    sensor: SensorConfig = SensorConfig()
    frontiers: FrontierConfig = FrontierConfig()

    def __post_init__(self) -> None:
        """Raises DatasetError on values that make no explorer."""
        require_fields(self, ("random_frontier",), SHARE, DatasetError)
        require_fields(self, ("replan_distance",), NOT_NEGATIVE, DatasetError)
        require_fields(self, ("travel_factor",), POSITIVE, DatasetError)


class Explorer:
    """Wanders through one world. ``tasks``, over its propositions, are those it pursues, drawn with ``rng``."""

    def __init__(
        self, world: World, tasks: Sequence[Task], rng: np.random.Generator, config: ExplorerConfig = ExplorerConfig()
    ) -> None:
        for task in tasks:
            require_same_propositions(task.propositions, world.propositions, asker=f"the task {task.text!r}")
        self._robot = SimulatedRobot(world, TrialConfig(sensor=config.sensor))
        self._limit = config.travel_factor * float(np.sum(world.extent))
        self._tasks, self._rng, self._config = tasks, rng, config
        self._frontier: Cell | None = None
        self._take_task(int(world.letters[tuple(world.start.tolist())]))

    def poses(self) -> Iterator[Pose]:
        """Poses in order, the start first, until nothing can be reached any more or the limit has been travelled."""
        # The same observe and advance as in a trial, so that poses are where a planner would decide.
        step, travelled, way = 0, 0.0, ()
        while True:
            belief, cell = self._robot.observe()
            yield Pose(belief=belief, cell=cell, step=step, travelled=travelled, way=way)
            chosen = self._choose(belief, cell) if travelled < self._limit else None
            if chosen is None:
                return
            situation, target, target_state = chosen
            path = _path(situation, jnp.asarray(target, jnp.int32), jnp.int32(target_state))
            stop = Stop(
                replan_distance=jnp.float32(self._config.replan_distance),
                budget=jnp.float32(self._limit - travelled),
                is_frontier=jnp.asarray(target == self._frontier and bool(_ends_at(path, target))),
            )
            cells = self._robot.advance(path, stop).cells
            # Without a move the loop would not end.
            assert cells, f"a path from {cell} to {target} has no moves"
            letters = np.asarray(self._robot.observe()[0].letters)
            self._read([int(letters[entered]) for entered in cells])
            step, way = step + len(cells), cells[:-1]
            travelled += path_length([cell, *cells])

    def _take_task(self, letter: int) -> None:
        """A task that is not decided where the robot stands."""
        for _ in range(_TASKS_TRIED):
            self._task = self._tasks[int(self._rng.integers(len(self._tasks)))]
            self._state = int(self._task.dfa.transitions[self._task.dfa.initial, letter])
            if not self._is_decided():
                break
        # Padded to one size for all tasks: what is compiled for one serves the others.
        sizes = dataclasses.replace(LARGEST, propositions=len(self._task.propositions))
        self._arrays = self._task.padded(sizes)
        self._frontier = None

    def _is_decided(self) -> bool:
        return bool(self._task.dfa.accepting[self._state] | self._task.dfa.trap[self._state])

    def _read(self, letters: list[int]) -> None:
        for letter in letters:
            self._state = int(self._task.dfa.transitions[self._state, letter])

    def _choose(self, belief: BeliefMap, cell: Cell) -> tuple[Situation, Cell, int] | None:
        """Where to go, in which state of the task; None if no task that was tried leads anywhere."""
        for _ in range(_TASKS_TRIED):
            if not self._is_decided():
                situation = _assess(
                    belief, jnp.asarray(cell, jnp.int32), jnp.int32(self._state), self._arrays, self._config.frontiers
                )
                # A task that can be finished in known space is finished, as every policy does.
                if np.isfinite(situation.finish_cost):
                    return situation, as_cell(situation.finish_cell), int(situation.finish_state)
                distances = np.asarray(situation.distances)
                self._frontier = self._choose_frontier(situation, distances)
                if self._frontier is not None:
                    # In whichever state of the task the frontier is nearest.
                    return situation, self._frontier, int(np.argmin(distances[self._frontier]))
            self._take_task(int(belief.letters[cell]))
        return None

    def _choose_frontier(self, situation: Situation, distances: np.ndarray) -> Cell | None:
        """The frontier pursued so far while it is one, otherwise another that can be reached."""
        # A robot that keeps to its target gets to the ends of hallways and not only to their mouths.
        subgoals = situation.subgoals
        kept = self._frontier
        if kept is not None and subgoals.frontier[kept] and np.isfinite(distances[kept].min()):
            return kept
        cells = np.asarray(subgoals.cells)[np.asarray(subgoals.mask)]
        cells = cells[np.isfinite(distances[cells[:, 0], cells[:, 1]].min(axis=1))]
        if not len(cells):
            return None
        # Subgoals are ordered by distance: the first is the nearest.
        nearest = self._rng.random() >= self._config.random_frontier
        return as_cell(cells[0 if nearest else int(self._rng.integers(len(cells)))])


@partial(jax.jit, static_argnames="frontiers")
def _assess(
    belief: BeliefMap, cell: Int32[Array, "2"], state: Int32[Array, ""], task, frontiers: FrontierConfig
) -> Situation:
    # Data are of every branch of a task, also of those that turn out to lead nowhere.
    return assess(belief, cell, state, task, frontiers, irrevocable_last=False)


@jax.jit
def _path(situation: Situation, target: Int32[Array, "2"], target_state: Int32[Array, ""]) -> KnownPath:
    return shortest_path(
        situation.distances,
        situation.transitions,
        situation.belief.free,
        situation.cell,
        situation.state,
        target,
        target_state,
        horizon=_HORIZON,
        resolution=situation.belief.resolution,
    )


def _ends_at(path: KnownPath, target: Cell) -> bool:
    return as_cell(np.asarray(path.cells)[int(path.length)]) == target
