"""What the loop of a trial asks of a robot, and the robot that is simulated.

The loop knows a ``Robot`` only: a real one is another class with these three methods (``potlp_jax.logs.replaying`` has
one that follows a log, ``potlp_jax.drive`` one that is reached over the network). ``trials.watching`` checks what a
robot of somebody else's says.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, PRNGKeyArray, UInt8

from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import NEVER_SEEN
from potlp_jax.trials.rules import Knowledge, Stop
from potlp_jax.world.camera import CameraConfig, Disturbance, disturb
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import Cell, as_cell, step_length
from potlp_jax.world.renderer import render
from potlp_jax.world.sensing import SensorConfig, observe


@dataclasses.dataclass(frozen=True)
class Leg:
    """What a robot did on one advance.

    Attributes:
        cells: entered, in order, the start left out.
        ended: the robot will not move again: the log is at its end, the battery is empty, someone took over.
        failure: why the robot could not go on along the path, in words; empty where it could. The target is tried again
            and then set aside for a while (``trials.setbacks``).
    """

    cells: tuple[Cell, ...]
    ended: bool = False
    failure: str = ""


@runtime_checkable
class Robot(Protocol):
    """What the loop asks of a robot: a simulated one, or a real one.

    The map that a robot reports has one shape throughout a trial, unless it is a ``GrowingRobot``. Every cell that it
    enters must be free in the map that it reports next, and its letter known. Cells may be taken back: the latest map
    is what the robot knows.
    """

    def observe(self) -> tuple[BeliefMap, Cell]:
        """The map as it is known now and the robot's cell."""
        ...

    def panorama(self) -> UInt8[Array, "rows columns 3"]:
        """What the camera sees from the robot's cell, in the frame of the map (``world.camera``).

        Asked once before each decision, and only by policies whose estimator takes panoramas.
        """
        ...

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Follow ``path`` through known space, observing at every cell, until it ends or ``stop.is_due``.

        At least one move is made where the path has one: otherwise nothing would change before the next decision. A
        robot that cannot says why (``Leg.failure``). The cells of the leg are those of the map that the path is on.
        """
        ...


@runtime_checkable
class GrowingRobot(Robot, Protocol):
    """A robot whose map may grow on any side between two calls of ``observe``; it loses no row or column."""

    @property
    def origin(self) -> Cell:
        """Row and column of the map's first cell in a lattice that never moves; both may be negative."""
        ...


@runtime_checkable
class RemembersItsWay(Protocol):
    """A robot whose camera also took pictures on its way; what others saw there is not asked."""

    def panorama_before(self, back: int) -> UInt8[Array, "rows columns 3"] | None:
        """What the camera saw on the last advance, ``back`` cells before the robot's cell; None: there is no picture.

        Asked before ``panorama``, from the first cell to the last, and only by policies whose estimator
        ``LooksOnTheWay``.
        """
        ...


@runtime_checkable
class NoticesDoubts(Protocol):
    """A robot that notices what is doubtful about its map or its places, for the record."""

    @property
    def noticed(self) -> Sequence[str]:
        """All of it so far, in words."""
        ...


class SimulatedRobot:
    """A robot in a known ``World`` that sees along lines of sight."""

    def __init__(self, world: World, config: TrialConfig, key: PRNGKeyArray | None = None) -> None:
        """Put the robot at the world's start.

        Args:
            world: the true map.
            config: the sensor, the camera and whether the map is revealed.
            key: drives what disturbs the camera.
        """
        self._world = world
        self._config = config
        self._key = jax.random.key(0) if key is None else key
        self._cell = world.start
        self._steps = 0
        self._way: tuple[Cell, ...] = ()
        # What can be seen from the start counts as seen at step 0.
        self._belief = _observe(initial_belief(world, config), world, world.start, config.sensor)
        self._first_seen = first_seen_at_start(self._belief)

    @property
    def first_seen(self) -> Int32[np.ndarray, "H W"]:
        """Step at which each cell was first observed, ``NEVER_SEEN`` where it was not."""
        return np.asarray(self._first_seen)

    def observe(self) -> tuple[BeliefMap, Cell]:
        """The map as it is known now and the robot's cell."""
        return self._belief, as_cell(self._cell)

    def panorama(self) -> UInt8[Array, "rows columns 3"]:
        """What the camera sees from the robot's cell, disturbed anew after every step."""
        return self._photograph(self._cell, self._steps)

    def panorama_before(self, back: int) -> UInt8[Array, "rows columns 3"]:
        """What the camera saw on the last advance, ``back`` cells before the robot's cell."""
        return self._photograph(np.asarray(self._way[-1 - back], np.int32), self._steps - back)

    def _photograph(self, cell: Int32[Array | np.ndarray, "2"], step: int) -> UInt8[Array, "rows columns 3"]:
        config = self._config
        return photograph_after(self._world, cell, self._key, np.int32(step), config.camera, config.disturbance)

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Follow ``path`` through known space, observing at every cell, until it ends or ``stop.is_due``."""
        self._belief, self._first_seen, moved = follow(
            self._world, self._belief, self._first_seen, path, jnp.int32(self._steps), stop, self._config.sensor
        )
        # The one number that the host needs of a leg; beliefs stay on the device.
        moved = int(moved)
        cells = np.asarray(path.cells)[1 : moved + 1]
        # Kept on the device: the next photograph and observation need it there.
        self._cell = path.cells[moved]
        self._steps += moved
        self._way = tuple(as_cell(cell) for cell in cells)
        return Leg(cells=self._way)


def initial_belief(world: World, config: TrialConfig) -> BeliefMap:
    """What a simulated robot knows before its first observation."""
    return BeliefMap.revealed(world) if config.revealed else BeliefMap.unobserved(world)


def first_seen_at_start(belief: BeliefMap) -> Int32[Array, "H W"]:
    """Step at which each cell was first observed, after the observation at the start."""
    return jnp.where(belief.unknown, NEVER_SEEN, 0).astype(jnp.int32)


_observe = jax.jit(observe, static_argnames=("config",))


@partial(jax.jit, static_argnames=("camera", "disturbance"))
def photograph(
    world: World, cell: Int32[Array, "2"], key: PRNGKeyArray, camera: CameraConfig, disturbance: Disturbance
) -> UInt8[Array, "rows columns 3"]:
    """What the camera sees from a cell.

    Args:
        world: the true map.
        cell: where the camera stands.
        key: drives the disturbance; unused where there is none.
        camera: size and optics; static.
        disturbance: of the picture; static.

    Returns:
        RGB, the columns by bearing in the frame of the map.
    """
    image = render(world, cell, camera)
    # The disturbance is static: a camera without one compiles no random draws.
    return image if disturbance == Disturbance() else disturb(image, key, disturbance)


@partial(jax.jit, static_argnames=("camera", "disturbance"))
def photograph_after(
    world: World,
    cell: Int32[Array | np.ndarray, "2"],
    key: PRNGKeyArray,
    step: Int32[Array, ""] | np.int32,
    camera: CameraConfig,
    disturbance: Disturbance,
) -> UInt8[Array, "rows columns 3"]:
    """What the camera sees after so many moves, as ``photograph``.

    Args:
        world, cell, camera, disturbance: as there.
        key: of all pictures of a trial or a drive.
        step: number of moves made.

    Returns:
        RGB, the columns by bearing in the frame of the map.
    """
    # By the number of moves, as in a batch: a panorama depends on where it was taken, not on how many were.
    return photograph(world, jnp.asarray(cell), jax.random.fold_in(key, step), camera, disturbance)


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
    """Move along a path cell by cell, observing, until it ends or ``stop.is_due``.

    Args:
        world: the true map.
        belief: what is known at the start of the path.
        first_seen: step at which each cell was first observed, ``NEVER_SEEN`` where it was not.
        path: through known space, from the robot's cell on.
        steps: moves made before.
        stop: when to stop early.
        config: the sensor; static.

    Returns:
        The belief, the step at which each cell was first observed, and the number of moves made.
    """
    # At the decision, not at each cell: the leg stops for what is new since then.
    before = Knowledge.of(belief)
    target = path.cells[path.length]

    def goes_on(carry):
        belief, _, moved, travelled = carry
        stopped = stop.is_due(before, belief, target, travelled)
        # The first move is always made: a robot that stood still would decide the same again.
        return (moved < path.length) & ((moved == 0) | ~stopped)

    def step(carry):
        belief, first_seen, moved, travelled = carry
        here, there = path.cells[moved], path.cells[moved + 1]
        # On a map that is wholly known there is nothing to observe.
        observed = partial(observe, world=world, cell=there, config=config)
        belief = jax.lax.cond(jnp.any(belief.unknown), observed, lambda belief: belief, belief)
        # Steps count from the start of the trial; the cell just entered is number ``steps + moved + 1``.
        first_seen = jnp.where((first_seen == NEVER_SEEN) & ~belief.unknown, steps + moved + 1, first_seen)
        return belief, first_seen, moved + 1, travelled + step_length(here, there)

    start = (belief, first_seen, jnp.int32(0), jnp.float32(0.0))
    belief, first_seen, moved, _ = jax.lax.while_loop(goes_on, step, start)
    return belief, first_seen, moved
