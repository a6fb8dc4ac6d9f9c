"""Panoramas that the robot remembers, and in which of them each cell was last seen (docs/model.md section 6).

An observation adds one panorama, as the features of the network's first stage: they are computed once, whatever is
asked of them later. The number of slots is fixed: a new observation takes the slot of one that no frontier refers to
any more.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.types import NO_SUBGOAL, Status, status_array, status_if
from potlp_jax.world.frontiers import Subgoals, frontier_cells
from potlp_jax.world.grid import BeliefMap, moved_layer
from potlp_jax.world.sensing import SensorConfig, visible

NO_OBSERVATION: int = -1
"""Number of the observation where there is none."""


@struct.dataclass(kw_only=True)
class PanoramaMemory:
    """Observations are numbered from 0 in the order in which they were taken.

    Attributes:
        features: of each remembered panorama, by slot.
        cells: where it was taken.
        observation: its number, ``NO_OBSERVATION`` where the slot is empty.
        observation_of_cell: number of the last observation in which the cell was in line of sight, otherwise
            ``NO_OBSERVATION``.
        count: observations so far.
        status: ``VIEW_OVERFLOW`` once a panorama was dropped to which a frontier still referred.
    """

    features: Float32[Array, "*batch V rows columns F"]
    cells: Int32[Array, "*batch V 2"]
    observation: Int32[Array, "*batch V"]
    observation_of_cell: Int32[Array, "*batch H W"]
    count: Int32[Array, "*batch"]
    status: UInt32[Array, "*batch"]


def empty_memory(capacity: int, feature_shape: tuple[int, int, int], height: int, width: int) -> PanoramaMemory:
    """A memory in which nothing has been observed yet.

    Args:
        capacity: slots.
        feature_shape: rows, columns and channels of the features of a panorama (``NetworkConfig.feature_shape``).
        height, width: of the map's array.

    Returns:
        A memory with all slots empty.
    """
    return PanoramaMemory(
        features=jnp.zeros((capacity, *feature_shape), jnp.float32),
        cells=jnp.zeros((capacity, 2), jnp.int32),
        observation=jnp.full((capacity,), NO_OBSERVATION, jnp.int32),
        observation_of_cell=jnp.full((height, width), NO_OBSERVATION, jnp.int32),
        count=jnp.int32(0),
        status=status_array(),
    )


def remember(
    memory: PanoramaMemory, features: Float32[Array, "rows columns F"], belief: BeliefMap, cell: Int32[Array, "2"]
) -> PanoramaMemory:
    """The memory after an observation from ``cell``.

    A cell counts as in line of sight where the line runs through cells that are known to be free: the camera has no
    limit of range, and what lies unobserved in between may hide it.

    Args:
        memory: what was observed before.
        features: of the new panorama, from the network's first stage.
        belief: the map after the observation.
        cell: where the panorama was taken.

    Returns:
        The memory with the panorama in it, under the number ``memory.count``. Its status has ``VIEW_OVERFLOW`` if a
        frontier referred to the panorama that had to go.
    """
    height, width = belief.cells.shape
    # The longest line of sight on the grid is shorter than the sum of its sides.
    everywhere = SensorConfig(range_cells=float(height + width))
    in_sight = visible(~belief.free, cell, everywhere) & belief.free
    observation_of_cell = jnp.where(in_sight, memory.count, memory.observation_of_cell)
    # Only frontiers are asked about, so only what shows a frontier must be kept.
    frontier = frontier_cells(belief, belief.free)
    needed = _referred_to(memory.observation, jnp.where(frontier, observation_of_cell, NO_OBSERVATION).reshape(-1))
    # Of the others the oldest goes; an empty slot has number -1 and is older than any. Adding the count puts those that
    # are needed after all that are not, still by age.
    place = jnp.argmin(jnp.where(needed, memory.observation + memory.count + 1, memory.observation))
    return PanoramaMemory(
        features=memory.features.at[place].set(features),
        cells=memory.cells.at[place].set(cell),
        observation=memory.observation.at[place].set(memory.count),
        observation_of_cell=observation_of_cell,
        count=memory.count + 1,
        status=memory.status | status_if(needed[place], Status.VIEW_OVERFLOW),
    )


def moved_memory(memory: PanoramaMemory, shape: tuple[int, int], rows: int, columns: int) -> PanoramaMemory:
    """The memory for another array of the same map (``world.grid.moved_layer``): nothing is forgotten within it."""
    return dataclasses.replace(
        memory,
        cells=memory.cells + jnp.array([[rows, columns]], jnp.int32),
        observation_of_cell=moved_layer(memory.observation_of_cell, shape, rows, columns, NO_OBSERVATION),
    )


def _referred_to(observations: Int32[Array, " V"], wanted: Int32[Array, " N"]) -> Bool[Array, " V"]:
    """Which of the remembered observations, by slot, are among the wanted ones."""
    # A search in the sorted numbers: comparing every slot with every cell of the map would take V * N bytes.
    order = jnp.argsort(observations)
    found = jnp.minimum(jnp.searchsorted(observations[order], wanted), observations.shape[0] - 1)
    same = (observations[order][found] == wanted) & (wanted != NO_OBSERVATION)
    return jnp.zeros(observations.shape, bool).at[order[found]].max(same)


def observation_of_subgoals(memory: PanoramaMemory, subgoals: Subgoals) -> Int32[Array, " S"]:
    """Number of the observation that shows each subgoal: the last in which a cell of its frontier was in line of sight.

    The last observation of all where none was, or where that one is no longer remembered; ``NO_OBSERVATION`` where
    masked.
    """
    count = subgoals.mask.shape[0]
    # Cells that are on no frontier go to one row more, which is dropped.
    component = jnp.where(subgoals.component == NO_SUBGOAL, count, subgoals.component)
    last = jnp.full((count + 1,), NO_OBSERVATION, jnp.int32).at[component].max(memory.observation_of_cell)[:count]
    kept = jnp.any(memory.observation[None, :] == last[:, None], axis=1) & (last != NO_OBSERVATION)
    # The last panorama shows at least the direction of the subgoal, which is better than no answer.
    return jnp.where(subgoals.mask, jnp.where(kept, last, memory.count - 1), NO_OBSERVATION)


def slots_of_observations(memory: PanoramaMemory, observations: Int32[Array, " S"]) -> Int32[Array, " S"]:
    """Where in memory the observations of these numbers are; 0 for ``NO_OBSERVATION``."""
    same = (memory.observation[None, :] == observations[:, None]) & (observations != NO_OBSERVATION)[:, None]
    return jnp.argmax(same, axis=1).astype(jnp.int32)
