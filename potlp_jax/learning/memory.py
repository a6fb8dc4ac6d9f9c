"""Panoramas that the robot remembers, and in which of them each cell was last seen (docs/model.md section 6).

A look adds one panorama, as the features of the network's first stage: they are computed once, whatever is asked of
them later. Memory is fixed: a new look takes the place of one that no frontier refers to any more.
"""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.types import NO_SUBGOAL, Status, status_array, status_if
from potlp_jax.world.frontiers import Subgoals, frontier_cells
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig, visible

NO_LOOK: int = -1
"""Number of the look where there is none."""


@struct.dataclass(kw_only=True)
class Views:
    """Looks are numbered from 0 in the order in which they were taken.

    Attributes:
        features: of each remembered panorama, by its place in memory.
        cells: where it was taken.
        look: its number, ``NO_LOOK`` where the place is empty.
        look_of_cell: number of the last look in which the cell was in line of sight, else ``NO_LOOK``.
        count: looks so far.
        status: ``VIEW_OVERFLOW`` once a panorama was dropped to which a frontier still referred.
    """

    features: Float32[Array, "*batch V rows columns F"]
    cells: Int32[Array, "*batch V 2"]
    look: Int32[Array, "*batch V"]
    look_of_cell: Int32[Array, "*batch H W"]
    count: Int32[Array, "*batch"]
    status: UInt32[Array, "*batch"]


def no_views(capacity: int, feature_shape: tuple[int, int, int], height: int, width: int) -> Views:
    """An empty memory of ``capacity`` panoramas on a grid of this size."""
    return Views(
        features=jnp.zeros((capacity, *feature_shape), jnp.float32),
        cells=jnp.zeros((capacity, 2), jnp.int32),
        look=jnp.full((capacity,), NO_LOOK, jnp.int32),
        look_of_cell=jnp.full((height, width), NO_LOOK, jnp.int32),
        count=jnp.int32(0),
        status=status_array(),
    )


def remember(
    views: Views, features: Float32[Array, "rows columns F"], belief: BeliefMap, cell: Int32[Array, "2"]
) -> Views:
    """The memory after a look from ``cell``.

    A cell counts as in line of sight where the line runs through cells that are known to be free: the camera has no
    limit of range, and what lies unobserved in between may hide it.
    """
    height, width = belief.cells.shape
    everywhere = SensorConfig(range_cells=float(height + width))
    in_sight = visible(~belief.free, cell, everywhere) & belief.free
    look_of_cell = jnp.where(in_sight, views.count, views.look_of_cell)
    # Of the looks that no frontier refers to the oldest makes room; an empty place is older than any.
    frontier = frontier_cells(belief, belief.free)
    needed = _referred_to(views.look, jnp.where(frontier, look_of_cell, NO_LOOK).reshape(-1))
    place = jnp.argmin(jnp.where(needed, views.look + views.count + 1, views.look))
    return Views(
        features=views.features.at[place].set(features),
        cells=views.cells.at[place].set(cell),
        look=views.look.at[place].set(views.count),
        look_of_cell=look_of_cell,
        count=views.count + 1,
        status=views.status | status_if(needed[place], Status.VIEW_OVERFLOW),
    )


def _referred_to(looks: Int32[Array, " V"], wanted: Int32[Array, " N"]) -> Bool[Array, " V"]:
    """Which of the remembered looks, by place, are among the wanted ones."""
    order = jnp.argsort(looks)
    found = jnp.minimum(jnp.searchsorted(looks[order], wanted), looks.shape[0] - 1)
    same = (looks[order][found] == wanted) & (wanted != NO_LOOK)
    return jnp.zeros(looks.shape, bool).at[order[found]].max(same)


def look_of_subgoals(views: Views, subgoals: Subgoals) -> Int32[Array, " S"]:
    """Number of the look that shows each subgoal: the last in which a cell of its frontier was in line of sight.

    The last look of all where none was, or where that one is no longer remembered; ``NO_LOOK`` where masked.
    """
    count = subgoals.mask.shape[0]
    component = jnp.where(subgoals.component == NO_SUBGOAL, count, subgoals.component)
    last = jnp.full((count + 1,), NO_LOOK, jnp.int32).at[component].max(views.look_of_cell)[:count]
    kept = jnp.any(views.look[None, :] == last[:, None], axis=1) & (last != NO_LOOK)
    return jnp.where(subgoals.mask, jnp.where(kept, last, views.count - 1), NO_LOOK)


def places_of_looks(views: Views, looks: Int32[Array, " S"]) -> Int32[Array, " S"]:
    """Where in memory the looks of these numbers are; 0 for ``NO_LOOK``."""
    same = (views.look[None, :] == looks[:, None]) & (looks != NO_LOOK)[:, None]
    return jnp.argmax(same, axis=1).astype(jnp.int32)
