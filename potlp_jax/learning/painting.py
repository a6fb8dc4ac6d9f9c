"""What the camera saw, painted on the map: a memory of colours, one for each cell, whatever the number of panoramas.

Every cell that the panorama shows, as far as the belief knows, takes two colours from it: that of the pixel in which
its floor would be seen, and that at eye height in the same direction. Sight is followed along the very column that the
pixel is in: another line to the cell may be free where this one meets the corner of a wall, which would be painted
then. Of a cell that the robot knows to be free the first colour is its floor, of an obstacle the foot of its wall, and
of a cell that is not observed whatever is seen when one looks there: the floor far down a hallway, or the wall that
stands in front of it. Which of these it is, and what haze in between says, is left to the network that reads the
painting. The nearest look at a cell is kept.

That line goes to the middle of a cell, and of a door that one passes the middle is hidden until one stands before it:
in the floors of the family ``delivery`` three quarters of the cells that a robot is asked about are such. With
``glances`` a cell whose middle is hidden takes its colours from the line of sight nearest to it that meets the cell
anywhere, the first obstacle of the line included. What the pixel shows then is the cell or what stands right behind
it, in the same light.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt8

from potlp_jax.native import by_platform, target
from potlp_jax.world.camera import CameraConfig, rows_at_slopes
from potlp_jax.world.grid import BeliefMap, moved_layer
from potlp_jax.world.renderer import SightLines, obstacle_distances, sight_lines

_HALF_DIAGONAL = math.sqrt(0.5)

# More columns than a panorama has: no line meets the cell.
_HIDDEN = 1 << 20

# Entries of the table of looks (``_looks``).
_COLUMNS, _ON_BORDER, _ROW_SHIFT = (1 << 15) - 1, 1 << 15, 16


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


def moved_painting(painting: Painting, shape: tuple[int, int], rows: int, columns: int) -> Painting:
    """The painting for another array of the same map (``world.grid.moved_layer``), blank where that is larger."""
    return Painting(
        floor=moved_layer(painting.floor, shape, rows, columns, 0),
        beyond=moved_layer(painting.beyond, shape, rows, columns, 0),
        distance=moved_layer(painting.distance, shape, rows, columns, jnp.inf),
    )


def paint(
    painting: Painting,
    panorama: UInt8[Array, "rows columns 3"],
    belief: BeliefMap,
    cell: Int32[Array, "2"],
    camera: CameraConfig,
    *,
    glances: bool = True,
) -> Painting:
    """The painting after one more panorama.

    Args:
        painting: what was painted before, of the belief's shape.
        panorama: what the camera saw, in the frame of the map.
        belief: the map after the observation; only obstacles that it knows hide what is behind them.
        cell: where the panorama was taken.
        camera: its geometry; static.
        glances: whether to paint cells of which a part alone is in sight, too, as doors are that one passes; static.

    Returns:
        The painting in which every cell in sight, nearer than ever before, has its colours of this panorama.

    Raises:
        ValueError: the panorama is not as large as the camera's, or the painting not as the belief.
    """
    # The kernel reads pixels by numbers of the camera.
    if panorama.shape != (camera.height, camera.width, 3):
        raise ValueError(
            f"the panorama has shape {panorama.shape}, must be {(camera.height, camera.width, 3)}: the camera's"
        )
    # Nor does it look where an array ends.
    for name in ("floor", "beyond", "distance"):
        found = getattr(painting, name).shape[:2]
        if found != belief.cells.shape:
            raise ValueError(
                f"the painting's {name} has {found} cells and the belief {belief.cells.shape}: begin with "
                "blank_painting of the belief's shape, and move it where that grows (moved_painting)"
            )
    looks = jnp.asarray(_looks(camera, *belief.cells.shape))
    free_until = obstacle_distances(belief.occupied, cell, camera)
    lines = sight_lines(camera, *belief.cells.shape) if glances else _no_lines(camera)
    seen_through = jnp.asarray(lines.offset), jnp.asarray(lines.enter)
    known = (panorama, belief.occupied, cell, belief.extent, free_until, looks, *seen_through)
    # A camera may look up or down so far that its picture has no horizon.
    horizon = min(max(math.floor(camera.horizon), 0), camera.height - 1)
    ways = (functools.partial(way, horizon=horizon) for way in (_painted_natively, _painted))
    floor, beyond, distance = by_platform("camera", *ways, painting.floor, painting.beyond, painting.distance, *known)
    return Painting(floor=floor, beyond=beyond, distance=distance)


_Layers = tuple[UInt8[Array, "H W 3"], UInt8[Array, "H W 3"], Float32[Array, "H W"]]


def _painted_natively(
    floor: UInt8[Array, "H W 3"],
    beyond: UInt8[Array, "H W 3"],
    distance: Float32[Array, "H W"],
    *known: Array,
    horizon: int,
) -> _Layers:
    """In native code (``native/kernels/camera.cc``)."""
    layers = (floor, beyond, distance)
    results = [jax.ShapeDtypeStruct(layer.shape, layer.dtype) for layer in layers]
    # In place: only cells that are seen nearer than ever are written.
    aliases = {number: number for number in range(len(layers))}
    call = jax.ffi.ffi_call(target("paint"), results, vmap_method="sequential", input_output_aliases=aliases)
    floor, beyond, distance = call(*layers, *known, horizon=np.int64(horizon))
    return floor, beyond, distance


def _painted(
    floor: UInt8[Array, "H W 3"],
    beyond: UInt8[Array, "H W 3"],
    distance: Float32[Array, "H W"],
    panorama: UInt8[Array, "rows columns 3"],
    occupied: Bool[Array, "H W"],
    cell: Int32[Array, "2"],
    extent: Int32[Array, "2"],
    free_until: Float32[Array, " columns"],
    looks: Int32[Array, "H W"],
    offset: Int32[Array, "steps columns"],
    enter: Float32[Array, "steps columns"],
    *,
    horizon: int,
) -> _Layers:
    height, width = occupied.shape
    rows, columns = jnp.arange(height, dtype=jnp.int32), jnp.arange(width, dtype=jnp.int32)
    down, right = rows - cell[0], columns - cell[1]
    away = jnp.sqrt(jnp.square(down)[:, None].astype(jnp.float32) + jnp.square(right)[None, :].astype(jnp.float32))
    look = looks[jnp.minimum(jnp.abs(down), height - 1)][:, jnp.minimum(jnp.abs(right), width - 1)]
    column = _column_of(look, down[:, None], right[None, :], panorama.shape[1])
    # An obstacle is met at its side, and may be seen across up to half a diagonal of it.
    in_sight = away <= free_until[column] + jnp.where(occupied, jnp.float32(_HALF_DIAGONAL), 0.0)
    if offset.shape[0]:
        turn = _turn_to_glance(column, cell, offset, enter, free_until)
        column = jnp.where(in_sight, column, (column + turn) % panorama.shape[1])
        in_sight = in_sight | (turn != _HIDDEN)
    # What pads the map to an array is no part of the building, although nothing that is known hides it.
    inside = (rows[:, None] < extent[0]) & (columns[None, :] < extent[1])
    nearer = in_sight & inside & (away < distance)
    return (
        jnp.where(nearer[:, :, None], panorama[look >> _ROW_SHIFT, column], floor),
        jnp.where(nearer[:, :, None], panorama[horizon, column], beyond),
        jnp.where(nearer, away, distance),
    )


def _turn_to_glance(
    column: Int32[Array, "H W"],
    cell: Int32[Array, "2"],
    offset: Int32[Array, "steps columns"],
    enter: Float32[Array, "steps columns"],
    free_until: Float32[Array, " columns"],
) -> Int32[Array, "H W"]:
    """By how many columns to turn from a cell's bearing to the nearest line that meets it before the sight ends."""
    (height, width), count = column.shape, free_until.shape[0]
    there = (cell[0] + 1) * jnp.int32(width + 2) + cell[1] + 1 + offset
    row, at = there // (width + 2) - 1, there % (width + 2) - 1
    # The first obstacle is met, at its side, where the sight ends.
    met = (enter <= free_until[None]) & (row >= 0) & (row < height) & (at >= 0) & (at < width)
    flat = jnp.where(met, row * width + at, height * width)
    turn = jnp.arange(count, dtype=jnp.int32)[None] - jnp.take(column.ravel(), flat, mode="clip")
    turn = (turn + count // 2) % count - count // 2
    # By how far, and of two that are as far the later one first: 0, 1, -1, 2, -2, ...
    rank = 2 * jnp.abs(turn) - jnp.where(turn > 0, 1, 0)
    nearest = jnp.full(height * width, _HIDDEN, jnp.int32).at[flat.ravel()].min(rank.ravel(), mode="drop")
    nearest = nearest.reshape(height, width)
    found = jnp.where(nearest % 2 == 1, (nearest + 1) // 2, -(nearest // 2))
    return jnp.where(nearest == _HIDDEN, _HIDDEN, found)


def _column_of(
    look: Int32[Array, "H W"], down: Int32[Array, "H 1"], right: Int32[Array, "1 W"], columns: int
) -> Int32[Array, "H W"]:
    """The column that looks at each cell: the quadrant of the table, mirrored to the others."""
    turn = look & _COLUMNS
    # The other way round a bearing within a column is in the column before; one on the border of two is in the later.
    back = turn + jnp.where(look & _ON_BORDER, 0, 1)
    below = jnp.where(right >= 0, columns // 2 + turn, (columns - back) % columns)
    return jnp.where(down >= 0, below, jnp.where(right >= 0, columns // 2 - back, turn))


def _no_lines(camera: CameraConfig) -> SightLines:
    nothing = (0, camera.width)
    return SightLines(offset=np.zeros(nothing, np.int32), enter=np.zeros(nothing, np.float32))


@functools.lru_cache(maxsize=32)
def _looks(camera: CameraConfig, height: int, width: int) -> Int32[np.ndarray, "H W"]:
    """Where a panorama shows the floor of cells by their offset from the robot, in the quadrant of growing rows and
    columns: bits 0 to 14 columns from the bearing 0, bit 15 whether the cell's bearing is the border of two columns,
    from bit 16 on the row."""
    down, right = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    turn = np.arctan2(down, right) * (camera.width / (2 * math.pi))
    # Of the borders between columns those at multiples of 45 degrees alone meet the middle of cells (``CameraConfig``).
    on_border = (down == 0) | (right == 0) | (down == right)
    whole = np.where(on_border, np.round(turn), np.floor(turn)).astype(np.int32)
    # Nearer than one cell as at one cell: the robot does not see the floor under itself.
    slope = -camera.eye_height / np.maximum(np.hypot(down, right), 1.0)
    row = np.clip(np.round(rows_at_slopes(camera, slope)), 0, camera.height - 1).astype(np.int32)
    return whole | np.where(on_border, _ON_BORDER, 0).astype(np.int32) | (row << _ROW_SHIFT)
