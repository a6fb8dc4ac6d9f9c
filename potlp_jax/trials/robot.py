"""What the loop of a trial asks of a robot, and the robot that is simulated.

The loop knows a ``Robot`` only; a real robot is another observe and advance.
"""

import dataclasses
import math
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, PRNGKeyArray, UInt8

from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import NEVER_SEEN
from potlp_jax.world.camera import CameraConfig, Disturbance, disturb
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.renderer import render
from potlp_jax.world.sensing import SensorConfig, observe

DIAGONAL: float = math.sqrt(2.0)


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

    def panorama(self) -> UInt8[Array, "rows columns 3"]:
        """What the camera sees from the robot's cell, in the frame of the map (``world.camera``)."""
        ...

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Follow ``path`` through known space, observing at every cell, until it ends or ``stop`` says so."""
        ...


class SimulatedRobot:
    """A robot in a known ``World`` that sees along lines of sight. ``key`` drives what disturbs its camera."""

    def __init__(self, world: World, config: TrialConfig, key: PRNGKeyArray | None = None) -> None:
        self._world = world
        self._config = config
        self._key = jax.random.key(0) if key is None else key
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
        return self._belief, as_cell(self._cell)

    def panorama(self) -> UInt8[Array, "rows columns 3"]:
        """What the camera sees from the robot's cell, disturbed anew after every step."""
        key = jax.random.fold_in(self._key, self._steps)
        return photograph(self._world, self._cell, key, self._config.camera, self._config.disturbance)

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Follow ``path`` through known space, observing at every cell, until it ends or ``stop`` says so."""
        self._belief, self._first_seen, moved = follow(
            self._world, self._belief, self._first_seen, path, jnp.int32(self._steps), stop, self._config.sensor
        )
        moved = int(moved)
        cells = np.asarray(path.cells)[1 : moved + 1]
        self._cell = path.cells[moved]
        self._steps += moved
        return Leg(cells=tuple(as_cell(cell) for cell in cells))


def as_cell(cell: Any) -> tuple[int, int]:
    """Row and column as Python numbers."""
    return int(cell[0]), int(cell[1])


_observe = jax.jit(observe, static_argnames=("config",))


@partial(jax.jit, static_argnames=("camera", "disturbance"))
def photograph(
    world: World, cell: Int32[Array, "2"], key: PRNGKeyArray, camera: CameraConfig, disturbance: Disturbance
) -> UInt8[Array, "rows columns 3"]:
    """What the camera sees from a cell."""
    image = render(world, cell, camera)
    return image if disturbance == Disturbance() else disturb(image, key, disturbance)


@partial(jax.jit, static_argnames=("config",))
def follow(
    world: World,
    belief: BeliefMap,
    first_seen: Int32[Array, "H W"],
    path: KnownPath,
    steps: Int32[Array, ""],
    stop: Stop,
    config: SensorConfig,
) -> tuple[BeliefMap, Int32[Array, "H W"], Int32[Array, ""]]:
    """Move along the path cell by cell, ``steps`` made before.

    Returns the belief, the step at which each cell was first seen, and the moves made. ``config`` is static.
    """
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
