"""What the camera saw, painted on the map: a memory of colours, one for each cell, whatever the number of panoramas.

Every cell that the panorama shows, as far as the belief knows, takes two colours from it: that of the pixel in which
its floor would be seen, and that at eye height in the same direction. Sight is followed along the very column that the
pixel is in: another line to the cell may be free where this one meets the corner of a wall, which would be painted
then. Of a cell that the robot knows to be free the first colour is its floor, of an obstacle the foot of its wall, and
of a cell that is not observed whatever is seen when one looks there: the floor far down a hallway, or the wall that
stands in front of it. Which of these it is, and what haze in between says, is left to the network that reads the
painting. The nearest look at a cell is kept.
"""

import math

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, UInt8

from potlp_jax.world.camera import CameraConfig, floor_rows
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.renderer import obstacle_distances

_HALF_DIAGONAL = math.sqrt(0.5)


@struct.dataclass(kw_only=True)
class Painting:
    """Colours on the map, RGB.

    Attributes:
        floor: of the pixel in which the floor of the cell would be seen; 0 where the cell was never in sight.
        beyond: of the pixel at eye height in the direction of the cell; 0 where it was never in sight.
        distance: in cells, from which they were seen; ``inf`` where the cell was never in sight.
    """

    floor: UInt8[Array, "*batch H W 3"]
    beyond: UInt8[Array, "*batch H W 3"]
    distance: Float32[Array, "*batch H W"]


def blank_painting(height: int, width: int) -> Painting:
    """A painting for a map of this shape on which nothing is painted yet."""
    return Painting(
        floor=jnp.zeros((height, width, 3), jnp.uint8),
        beyond=jnp.zeros((height, width, 3), jnp.uint8),
        distance=jnp.full((height, width), jnp.inf, jnp.float32),
    )


def paint(
    painting: Painting,
    panorama: UInt8[Array, "rows columns 3"],
    belief: BeliefMap,
    cell: Int32[Array, "2"],
    camera: CameraConfig,
) -> Painting:
    """The painting after one more panorama.

    Args:
        painting: what was painted before, of the belief's shape.
        panorama: what the camera saw, in the frame of the map.
        belief: the map after the observation; only obstacles that it knows hide what is behind them.
        cell: where the panorama was taken.
        camera: its geometry; static.

    Returns:
        The painting in which every cell in sight, nearer than ever before, has its colours of this panorama.
    """
    height, width = belief.cells.shape
    rows = (jnp.arange(height, dtype=jnp.int32) - cell[0]).astype(jnp.float32)[:, None]
    columns = (jnp.arange(width, dtype=jnp.int32) - cell[1]).astype(jnp.float32)[None, :]
    distance = jnp.sqrt(rows**2 + columns**2)
    column = column_of(jnp.arctan2(rows, columns), panorama.shape[1])
    row = jnp.clip(jnp.round(floor_rows(camera, distance)).astype(jnp.int32), 0, panorama.shape[0] - 1)
    free_until = obstacle_distances(belief.occupied, cell, camera)[column]
    # An obstacle is met at its side, and may be seen across up to half a diagonal of it.
    in_sight = distance <= free_until + jnp.where(belief.occupied, _HALF_DIAGONAL, 0.0)
    # What pads the map to an array is no part of the building, although nothing that is known hides it.
    inside = (jnp.arange(height)[:, None] < belief.extent[0]) & (jnp.arange(width)[None, :] < belief.extent[1])
    nearer = in_sight & inside & (distance < painting.distance)
    return Painting(
        floor=jnp.where(nearer[:, :, None], panorama[row, column], painting.floor),
        beyond=jnp.where(nearer[:, :, None], panorama[math.floor(camera.horizon), column], painting.beyond),
        distance=jnp.where(nearer, distance, painting.distance),
    )


def column_of(bearing: Float32[Array, "*shape"], columns: int) -> Int32[Array, "*shape"]:
    """The column of a panorama of so many columns that looks along a bearing."""
    # The inverse of ``camera.column_bearings``: column c covers the bearings from 2 pi c / columns - pi to the next.
    turned = bearing * jnp.float32(columns / (2 * math.pi)) + jnp.float32(columns / 2)
    return jnp.floor(turned).astype(jnp.int32) % columns
