"""How many frontiers are open after a short walk through a hallway, and what arrays of each size cost a robot."""

import statistics
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int32

from eval.floor_statistics.sources import generator_of
from potlp_jax.environments.base import host_generators
from potlp_jax.environments.campus.furnishing import PEOPLE, Floor, FurnishConfig, Kind, furnish
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.building_network import building_operations
from potlp_jax.learning.painting import blank_painting, paint
from potlp_jax.planning.situation import assess
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.frontiers import FrontierConfig, find_subgoals
from potlp_jax.world.grid import Appearance, BeliefMap, World, make_world
from potlp_jax.world.moves import Cell
from potlp_jax.world.renderer import render
from potlp_jax.world.sensing import SensorConfig, observe

_WALK = 20.0
"""Metres of the walk."""
_STEP = 4
"""Cells between observations."""
_REPEATS = 9


def frontiers_after_walk(floor: Floor, shape: tuple[int, int], index: int) -> int:
    """Components of the frontier after a walk of 20 m through hallways.

    Args:
        floor: the building.
        shape: rows and columns of the arrays, the same for all floors, so that one program serves them.
        index: number of the floor, by which the walk is drawn.

    Returns:
        How many there are, those of one cell included.
    """
    # Plans stand upright at times.
    rooms = floor.rooms if floor.rooms.shape[0] <= shape[0] else floor.rooms.T
    (rng,) = host_generators(jax.random.key(index), 1)
    path = _walk(np.isin(rooms, floor.rooms_of(Kind.HALLWAY)), rng, round(_WALK / floor.resolution))
    missing = [(0, size - found) for size, found in zip(shape, rooms.shape, strict=True)]
    occupied = np.pad(rooms < 0, missing, constant_values=True)
    world = make_world(occupied, np.zeros(shape, np.int32), path[0], floor.resolution, Appearance.plain(*shape), ())
    belief = BeliefMap.unobserved(world)
    for cell in (*path[::_STEP], path[-1]):
        belief = _observe(belief, world, jnp.asarray(np.array(cell, np.int32)))
    return int(_count_frontiers(belief))


def _walk(hallway: Bool[np.ndarray, "H W"], rng: np.random.Generator, steps: int) -> list[Cell]:
    """The shortest path from a hallway cell, drawn uniformly, to one so many steps away, or to the farthest."""
    row, column = np.argwhere(hallway)[rng.integers(np.count_nonzero(hallway))].tolist()
    came_from: dict[Cell, Cell] = {(row, column): (row, column)}
    # Cells in the order in which they are reached, with their distance.
    reached = [((row, column), 0)]
    last = reached[0][0]
    for last, distance in reached:
        if distance >= steps:
            break
        row, column = last
        for cell in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
            if hallway[cell] and cell not in came_from:
                came_from[cell] = last
                reached.append((cell, distance + 1))
    path = [last]
    while came_from[path[-1]] != path[-1]:
        path.append(came_from[path[-1]])
    return path[::-1]


_observe = jax.jit(partial(observe, config=SensorConfig()))


@jax.jit
def _count_frontiers(belief: BeliefMap) -> Int32[Array, ""]:
    # Which of them is nearest does not matter here.
    distance = jnp.zeros(belief.cells.shape, jnp.float32)
    return jnp.sum(find_subgoals(belief, belief.free, distance, FrontierConfig(max_subgoals=256, min_size=1)).mask)


def array_costs(families: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """What arrays of each family's size cost where one and the same small building lies in them.

    Args:
        families: names of families by the name of their row.

    Returns:
        By row: ``shape``, milliseconds of a core by phase, bytes of a painted belief, and operations of
        the building network's first stage.
    """
    small = generator_of("campus-small")
    floor = next(
        floor
        for index in range(100)
        if max((floor := small.draw_floor(world_key(Split.TRAINING, index, small.name))).rooms.shape) <= 80
    )
    costs = {}
    for name, family in families.items():
        config, shape = trial_config_for(generator_of(family)), generator_of(family).world(0).shape
        world, _ = furnish(floor, jax.random.key(0), PEOPLE, FurnishConfig(), shape)
        network = BuildingConfig(propositions=PEOPLE.propositions)
        costs[name] = {
            "shape": list(shape),
            "milliseconds": _phases(world, config),
            # Cells and letters of the belief; two colours and a distance of the painting.
            "bytes": shape[0] * shape[1] * (1 + 4 + 6 + 4),
            "first_stage_operations": building_operations(network, *shape)[0],
        }
    return costs


def _phases(world: World, config: TrialConfig) -> dict[str, float]:
    camera, task = CameraConfig(), world.task(PEOPLE.tasks["1"])
    blank, state = BeliefMap.unobserved(world), jnp.int32(task.dfa.initial)
    milliseconds: dict[str, float] = {}

    def measure(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        compiled = jax.jit(function)
        result = jax.block_until_ready(compiled(*arguments))
        milliseconds[name] = 1e3 * _core_seconds(lambda: jax.block_until_ready(compiled(*arguments)))
        return result

    belief = measure("observe", partial(observe, config=config.sensor), blank, world, world.start)
    measure("assess", partial(assess, config=config.decision.frontiers), belief, world.start, state, task.arrays)
    panorama = measure("render", partial(render, config=camera), world, world.start)
    measure("paint", partial(paint, camera=camera), blank_painting(*world.shape), panorama, belief, world.start)
    return milliseconds


def _core_seconds(run: Callable[[], Any]) -> float:
    """What a run takes of a core, whatever else the machine does: the median of nine, of four runs each."""
    seconds = []
    for _ in range(_REPEATS):
        begin = time.process_time()
        for _ in range(4):
            run()
        seconds.append((time.process_time() - begin) / 4)
    return statistics.median(seconds)
