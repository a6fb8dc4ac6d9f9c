"""What the robot's camera sees: a panorama of the true world from the middle of a cell.

Walls stand on the obstacles and are ``wall_height`` cells high; the ceiling is flat. Brightness comes from the light of
the free cell that the surface belongs to. White smoke follows the law of Beer and Lambert: a cell of density
``s`` that is crossed over ``l`` cells lets ``exp(-s l)`` of the light through, and what it takes away it replaces by
white, as bright as the light of that cell. Textures repeat in every cell, so that nothing in a picture tells where on
the map it was taken.

One ray a column is followed through the lattice of cells. Because the robot stands in the middle of a cell, the cells
that a ray crosses, where it crosses them, and the piece of floor that a pixel shows are the same for every cell and
world, relative to the robot: they are static tables (``_Rays``, ``_Planes``), and what remains for the device are
gathers and one running product along the rays, until a wall has stopped all of them. Where a row or column looks is in
``camera``.

References:
    Amanatides and Woo, A fast voxel traversal algorithm for ray tracing, Eurographics 1987 (cells crossed by a ray).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, Int32, Shaped, UInt8

from potlp_jax import plugins
from potlp_jax.errors import PluginError
from potlp_jax.native import by_platform, target
from potlp_jax.world.camera import CameraConfig, column_bearings, finer, row_slopes
from potlp_jax.world.grid import World

# The look of the textures; lengths in cells.
_BRICK = 0.5
"""Height and width of a brick."""
_MORTAR = 0.05
"""Half the width of the joint between two bricks."""
_TILE_EDGE = 0.06
"""Half the width of the edge between two tiles of the floor or the ceiling."""
_SKIRTING, _SKIRTING_SHADE = 0.2, 0.7
"""Height of the skirting board, and the share of the wall's brightness that it has."""
_GRAZED = 0.7
"""Brightness of a wall that is seen from the side, of that of one seen from the front: corners show."""

_SOLID = 1 << 30
"""Bit of a cell's packed optics that says obstacle; the highest, so that a comparison tests it."""
_LONGEST_SIGHT = 1e6
"""Distance in cells at which a row on the horizon is taken to meet the floor: farther than any grid."""
_SAMPLES = 6
"""Samples a side of a pixel by which edges of tiles are averaged."""
_BLOCK = 16
"""Steps of all rays that are followed between two tests for rays that still go on."""

# exp(-x) around half the diagonal of a cell, the middle of what can occur (see ``_passed``).
_HALF_DIAGONAL = math.sqrt(0.5)
_TAYLOR = tuple((-1) ** order / math.factorial(order) for order in range(8))
_TAYLOR_AT_ZERO = sum(term * (-_HALF_DIAGONAL) ** order for order, term in enumerate(_TAYLOR))
"""What the polynomial gives without smoke; divided by it, clear air lets exactly all light through."""

_Tables = TypeVar("_Tables", "_Rays", "_Planes")


@dataclasses.dataclass(frozen=True)
class _Rays:
    """Static tables of the rays, one a column, for one camera and one shape of grid.

    Step 0 of a ray is the robot's cell, step ``k`` the ``k``-th cell that it enters. Offsets are flat indices
    relative to the robot's cell. Where a ray has left every grid of this shape its entries mean nothing: the closed
    border of the world stopped it before.
    """

    offset: Int[np.ndarray, "steps columns"]
    """Flat index of the cell."""
    enter: Float[np.ndarray, "steps columns"]
    """Distance at which the ray enters the cell."""
    length: Float[np.ndarray, "steps columns"]
    """Length of the ray inside of the cell, at most a diagonal."""
    along: Float[np.ndarray, "steps columns"]
    """Where on the side through which it enters, 0 to 1."""
    facing: Float[np.ndarray, "steps columns"]
    """Cosine of the angle at which it meets that side."""


@dataclasses.dataclass(frozen=True)
class _Planes:
    """Static tables of floor and ceiling: what a pixel shows where no wall is in front of it."""

    distance: Float[np.ndarray, " rows"]
    """Distance on the map at which the row meets the floor or the ceiling."""
    slope: Float[np.ndarray, " rows"]
    """Tangent of the elevation."""
    step: Int[np.ndarray, "rows columns"]
    """Flat index ``step * columns + column`` into the tables of the rays."""
    inside: Float[np.ndarray, "rows columns"]
    """Length of the sight line in the cell that is shown."""
    shade: Float[np.ndarray, "rows columns"]
    """Brightness of the texture, 1 where no edge of a tile is shown."""


class _Followed(NamedTuple):
    """The rays up to the walls; what comes after the block in which the last ray met one is 0.

    Attributes:
        crossed: packed optics of the cells.
        sight: where a ray enters a cell, the light that comes through and the glow of the smoke (``_pack_sight``).
        first: step of the first obstacle, the last step where there is none.
    """

    crossed: Int32[Array, "steps columns"]
    sight: Int32[Array, "steps columns"]
    first: Int32[Array, " columns"]


class _Walls(NamedTuple):
    """The wall that each column shows.

    Attributes:
        distance: from the robot to the wall.
        colour: packed RGB of its sides.
        brightness: of the free cell in front of it, 0 to 1.
        along: where on the obstacle's side the ray arrives, 0 to 1.
        facing: cosine of the angle between ray and the normal of the side.
        transmission: share of the wall's light that the smoke in front of it lets through.
        glow: white light that this smoke adds, 0 to 1.
    """

    distance: Float32[Array, " columns"]
    colour: Int32[Array, " columns"]
    brightness: Float32[Array, " columns"]
    along: Float32[Array, " columns"]
    facing: Float32[Array, " columns"]
    transmission: Float32[Array, " columns"]
    glow: Float32[Array, " columns"]


def render(
    world: World, cell: Int32[Array, "2"], config: CameraConfig = CameraConfig()
) -> UInt8[Array, "rows columns 3"]:
    """The panorama from the middle of a cell, without disturbance.

    Only what is in line of sight enters the picture: letters and cells behind walls change no pixel.

    Args:
        world: one world; its border must be closed, as ``make_world`` leaves it.
        cell: row and column of a free cell.
        config: the camera; static.

    Returns:
        The picture, RGB.

    Raises:
        PluginError: ``config.renderer`` names a function that cannot be found, or that returns something else.
    """
    if config.renderer:
        return _render_elsewhere(world, cell, config)
    return _batched_renderer(config)(_pack_optics(world, config), _pack_colours(world), cell)


def obstacle_distances(
    occupied: Bool[Array, "H W"], cell: Int32[Array, "2"], config: CameraConfig
) -> Float32[Array, " columns"]:
    """How far each column of a panorama looks: from the middle of a cell to the first obstacle, or out of the array.

    Args:
        occupied: True on obstacles, of the world or of what is known of it.
        cell: where the camera is.
        config: its geometry; static.

    Returns:
        Distances in cells.
    """
    lines = sight_lines(config, *occupied.shape)
    tables = jnp.asarray(lines.offset), jnp.asarray(lines.enter)
    return by_platform("camera", _looked_natively, _looked, occupied, cell, *tables)


class SightLines(NamedTuple):
    """The cells that the columns of a panorama look through one after the other, whatever stands there.

    Attributes:
        offset: flat, from the robot's cell, in the array with a border of one cell.
        enter: at what distance the cell is entered, in cells, growing from step to step.
    """

    offset: Int32[np.ndarray, "steps columns"]
    enter: Float32[np.ndarray, "steps columns"]


def sight_lines(config: CameraConfig, height: int, width: int) -> SightLines:
    """The lines of sight of a panorama in an array of this shape.

    Args:
        config: the camera's geometry.
        height, width: of the array. Beyond it everything hides: lines end in the border.

    Returns:
        A line for each column of the panorama.
    """
    rays, _ = _tables(config, height + 2, width + 2)
    return SightLines(offset=rays.offset, enter=rays.enter)


def _looked_natively(
    occupied: Bool[Array, "H W"],
    cell: Int32[Array, "2"],
    offset: Int32[Array, "steps columns"],
    enter: Float32[Array, "steps columns"],
) -> Float32[Array, " columns"]:
    """In native code (``native/kernels/camera.cc``), by tables of the rays in the array with a border."""
    result = jax.ShapeDtypeStruct(enter.shape[1:], jnp.float32)
    call = jax.ffi.ffi_call(target("obstacle_distances"), result, vmap_method="sequential")
    return call(occupied, cell, offset, enter)


def _looked(
    occupied: Bool[Array, "H W"],
    cell: Int32[Array, "2"],
    offset: Int32[Array, "steps columns"],
    enter: Float32[Array, "steps columns"],
) -> Float32[Array, " columns"]:
    closed = jnp.pad(occupied, 1, constant_values=True)
    base = (cell[0] + 1) * jnp.int32(closed.shape[1]) + cell[1] + 1
    steps, columns = offset.shape
    blocks = _in_blocks(offset)

    def follow_block(state: tuple[Array, Array]) -> tuple[Array, Array]:
        block, first = state
        hides = jnp.take(closed.ravel(), base + blocks[block], mode="clip")
        return block + 1, jnp.minimum(first, _first_in_block(hides, block, steps))

    start = (jnp.int32(0), jnp.full(columns, steps - 1, jnp.int32))
    _, first = jax.lax.while_loop(
        lambda state: (state[0] < blocks.shape[0]) & jnp.any(state[1] == steps - 1), follow_block, start
    )
    return jnp.take_along_axis(enter, first[None], axis=0)[0]


def renderer_of(config: CameraConfig) -> Callable[..., Any]:
    """The function that draws a camera's pictures. Raises PluginError where there is none of the name."""
    return plugins.load(config.renderer, group=plugins.CAMERAS, kind="camera") if config.renderer else render


def _render_elsewhere(world: World, cell: Int32[Array, "2"], config: CameraConfig) -> UInt8[Array, "rows columns 3"]:
    """The picture of a renderer that is not ours."""
    picture = renderer_of(config)(world, cell, config)
    found = getattr(picture, "dtype", type(picture).__name__), getattr(picture, "shape", ())
    wanted = (jnp.uint8, (config.height, config.width, 3))
    # Shapes are known while jit traces, so the check costs nothing later.
    if found != wanted:
        raise PluginError(
            f"camera {config.renderer!r}: its picture is {found[0]}{list(found[1])}, must be uint8{list(wanted[1])}: "
            "the height and width of its CameraConfig, and RGB"
        )
    return picture


def _batched_renderer(config: CameraConfig) -> Callable[..., UInt8[Array, "*batch rows columns 3"]]:
    """``_render`` that takes a batch on a CPU one picture after the other: what one needs fits the cache."""

    def render_one(
        optics: Int32[Array, "H W"], colours: Int32[Array, "H W"], cell: Int32[Array, "2"]
    ) -> UInt8[Array, "rows columns 3"]:
        return _render(optics, colours, cell, config)

    # Without a rule of its own vmap would batch every gather, and XLA would hold the tables of all pictures at once.
    renderer = jax.custom_batching.custom_vmap(render_one)

    def render_batch(axis_size: int, batched: Sequence[bool], *arguments: Array) -> tuple[Array, bool]:
        del axis_size

        def in_turn(*arguments: Array) -> Array:
            # The map runs over the batched arguments alone; the others, such as one world for many cells, are shared.
            def render_next(moving: list[Array]) -> Array:
                remaining = iter(moving)
                return renderer(
                    *(next(remaining) if flag else one for one, flag in zip(arguments, batched, strict=True))
                )

            return jax.lax.map(render_next, [one for one, flag in zip(arguments, batched, strict=True) if flag])

        # An accelerator has threads for all pictures.
        at_once = jax.vmap(render_one, in_axes=tuple(0 if flag else None for flag in batched))
        return jax.lax.platform_dependent(*arguments, cpu=in_turn, default=at_once), True

    renderer.def_vmap(render_batch)
    return renderer


def _render(
    optics: Int32[Array, "H W"], colours: Int32[Array, "H W"], cell: Int32[Array, "2"], config: CameraConfig
) -> UInt8[Array, "rows columns 3"]:
    """The picture of one cell, from the cells' packed optics and colours."""
    rays, planes = _tables(config, *optics.shape)
    base = cell[0] * jnp.int32(optics.shape[1]) + cell[1]
    # Indices outside of the grid belong to steps behind the closed border; any cell will do for them.
    followed = _follow(optics.ravel(), base, rays)
    walls = _find_walls(followed, colours.ravel(), base, rays)
    # A sight line that would meet floor or ceiling only behind the wall shows the wall.
    is_wall = planes.distance[:, None] >= walls.distance[None, :]
    shown = jnp.take(followed.crossed.ravel(), planes.step, mode="clip")
    transmission, glow = _see_planes(shown, followed.sight, planes)
    transmission = jnp.where(is_wall, walls.transmission[None, :], transmission)
    glow = jnp.where(is_wall, walls.glow[None, :], glow)
    shade = jnp.where(is_wall, _shade_walls(walls, planes, config), _brightness(shown) * planes.shade)
    colour = jnp.where(is_wall, walls.colour[None, :], _plane_colours(colours.ravel(), base, rays, planes, config))
    return _develop(colour, shade * transmission, glow, config)


def _develop(
    colour: Int32[Array, "rows columns"],
    share: Float32[Array, "rows columns"],
    glow: Float32[Array, "rows columns"],
    config: CameraConfig,
) -> UInt8[Array, "rows columns 3"]:
    """The share of each surface's colour that arrives, and the smoke's."""
    pixels = jnp.zeros(colour.shape, jnp.int32)
    for shift, out, smoke in zip((16, 8, 0), (0, 8, 16), config.smoke_colour, strict=True):
        value = _channel(colour, shift) * share + smoke * glow
        pixels = pixels | ((jnp.minimum(value, 255.0) + 0.5).astype(jnp.int32) << out)
    # Four bytes at once: on a CPU conversions to bytes are slow. The first byte is the lowest, hence red's shift is 0.
    return jax.lax.bitcast_convert_type(pixels, jnp.uint8)[..., :3]


def _pack_optics(world: World, config: CameraConfig) -> Int32[Array, "H W"]:
    """Bit 30: an obstacle. Bits 8 to 23: density of smoke, of 65,535. Bits 0 to 7: brightness, of 255."""
    # One integer a cell: the rays' gather, the largest of a picture, is then made once and not three times.
    appearance = world.appearance
    smoke = jnp.round(jnp.clip(appearance.smoke, 0.0, 1.0) * 65535.0).astype(jnp.int32)
    brightness = config.ambient + (1 - config.ambient) * jnp.clip(appearance.light, 0.0, 1.0)
    packed = (smoke << 8) | jnp.round(brightness * 255.0).astype(jnp.int32)
    return jnp.where(world.occupied, packed | _SOLID, packed)


def _pack_colours(world: World) -> Int32[Array, "H W"]:
    """RGB of an obstacle's sides or of a free cell's floor: red in bits 16 to 23, then green, then blue."""
    appearance = world.appearance
    colour = jnp.where(world.occupied[..., None], appearance.wall_colour, appearance.floor_colour).astype(jnp.int32)
    return (colour[..., 0] << 16) | (colour[..., 1] << 8) | colour[..., 2]


def _smoke(optics: Int32[Array, "*shape"]) -> Float32[Array, "*shape"]:
    """Density of the smoke, 0 to 1 per cell travelled through."""
    # The mask drops the obstacle's bit, which lies above.
    return ((optics >> 8) & 0xFFFF).astype(jnp.float32) * (1 / 65535)


def _brightness(optics: Int32[Array, "*shape"]) -> Float32[Array, "*shape"]:
    """Brightness of a cell, 0 to 1."""
    return (optics & 0xFF).astype(jnp.float32) * (1 / 255)


def _passed(optics: Int32[Array, "*shape"], length: Float32[Array, "*shape"]) -> Float32[Array, "*shape"]:
    """``exp(-density * length)`` to five digits; a sight line is at most a diagonal long inside of a cell.

    A Taylor polynomial around half a diagonal, which a CPU computes three times faster than the exponential function.
    """
    depth = _smoke(optics) * length - _HALF_DIAGONAL
    # Horner's scheme, from the highest order down.
    value = jnp.full_like(depth, _TAYLOR[-1] / _TAYLOR_AT_ZERO)
    for term in _TAYLOR[-2::-1]:
        value = value * depth + term / _TAYLOR_AT_ZERO
    return jnp.minimum(value, 1.0)


def _follow(optics: Int32[Array, " cells"], base: Int32[Array, ""], rays: _Rays) -> _Followed:
    """Follow all rays, block by block, until each has met an obstacle."""
    steps, columns = rays.offset.shape
    blocks = -(-steps // _BLOCK)
    offsets, lengths = (_in_blocks(table) for table in (rays.offset, rays.length))

    def cross(state: tuple[Array, Array], cell: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        transmission, glow = state
        optics, length = cell
        after = transmission * _passed(optics, length)
        # What the cell takes away it replaces by white, as bright as the cell, seen through the smoke in front of it.
        return (after, glow + (transmission - after) * _brightness(optics)), _pack_sight(transmission, glow)

    def follow_block(state: tuple[Any, ...]) -> tuple[Any, ...]:
        block, light, crossed, sight, first = state
        # Indices outside of the grid belong to steps behind the closed border; any cell will do for them.
        entered = jnp.take(optics, base + offsets[block], mode="clip")
        light, seen = jax.lax.scan(cross, light, (entered, lengths[block]))
        first = jnp.minimum(first, _first_in_block(entered >= _SOLID, block, steps))
        return block + 1, light, crossed.at[block].set(entered), sight.at[block].set(seen), first

    clear, nothing = jnp.ones(columns, jnp.float32), jnp.zeros((blocks, _BLOCK, columns), jnp.int32)
    start = (jnp.int32(0), (clear, jnp.zeros_like(clear)), nothing, nothing, jnp.full(columns, steps - 1, jnp.int32))
    _, _, crossed, sight, first = jax.lax.while_loop(
        lambda state: (state[0] < blocks) & jnp.any(state[4] == steps - 1), follow_block, start
    )
    flat = (blocks * _BLOCK, columns)
    return _Followed(crossed=crossed.reshape(flat), sight=sight.reshape(flat), first=first)


def _in_blocks(table: Shaped[Array | np.ndarray, "steps columns"]) -> Shaped[Array, "K block columns"]:
    """A table of the rays in blocks of ``_BLOCK`` steps; what fills up the last one is 0."""
    steps, columns = table.shape
    return jnp.pad(table, ((0, -steps % _BLOCK), (0, 0))).reshape(-1, _BLOCK, columns)


def _first_in_block(
    solid: Bool[Array, "block columns"], block: Int32[Array, ""], steps: int
) -> Int32[Array, " columns"]:
    """The first step of a block at which each ray meets an obstacle, the last of all steps where it meets none."""
    step = block * _BLOCK + jnp.arange(_BLOCK, dtype=jnp.int32)[:, None]
    # Step 0 is the robot's own cell, which hides nothing.
    return jnp.min(jnp.where(solid & (step > 0), step, jnp.int32(steps - 1)), axis=0)


def _pack_sight(transmission: Float32[Array, "*shape"], glow: Float32[Array, "*shape"]) -> Int32[Array, "*shape"]:
    """Bits 16 to 30: transmission, of 32,767. Bits 0 to 15: glow, of 65,535."""
    # Bit 31 stays 0: the number is not negative, and unpacking needs no mask for the upper half.
    high = (transmission * 32767.0 + 0.5).astype(jnp.int32)
    return (high << 16) | (jnp.minimum(glow, 1.0) * 65535.0 + 0.5).astype(jnp.int32)


def _unpack_sight(packed: Int32[Array, "*shape"]) -> tuple[Float32[Array, "*shape"], Float32[Array, "*shape"]]:
    """Transmission and glow, as ``_pack_sight`` stores them."""
    transmission = (packed >> 16).astype(jnp.float32) * (1 / 32767)
    return transmission, (packed & 0xFFFF).astype(jnp.float32) * (1 / 65535)


def _find_walls(followed: _Followed, colours: Int32[Array, " cells"], base: Int32[Array, ""], rays: _Rays) -> _Walls:
    """The first obstacle on each ray, and what the smoke in front of it does."""
    columns = rays.offset.shape[1]
    at = followed.first * jnp.int32(columns) + jnp.arange(columns, dtype=jnp.int32)
    # A wall is lit by the free cell in front of it, which the ray crossed one step before.
    before = jnp.take(followed.crossed.ravel(), at - jnp.int32(columns), mode="clip")
    transmission, glow = _unpack_sight(jnp.take(followed.sight.ravel(), at, mode="clip"))
    colour = jnp.take(colours, base + jnp.take(rays.offset.ravel(), at, mode="clip"), mode="clip")
    return _Walls(
        distance=jnp.take(rays.enter.ravel(), at, mode="clip"),
        colour=colour,
        brightness=_brightness(before),
        along=jnp.take(rays.along.ravel(), at, mode="clip"),
        facing=jnp.take(rays.facing.ravel(), at, mode="clip"),
        transmission=transmission,
        glow=glow,
    )


def _shade_walls(walls: _Walls, planes: _Planes, config: CameraConfig) -> Float32[Array, "rows columns"]:
    """Brightness of a wall's pixels: the light in front of it, the angle at which it is met, bricks and a skirting."""
    height = config.eye_height + walls.distance[None, :] * planes.slope[:, None]
    # No joint at the height of the eye, where it would stay a joint all the way to the horizon.
    course = height * (1 / _BRICK) + 0.5
    # Every second course is shifted by half a brick.
    odd = jnp.floor(course * 0.5) * 2 != jnp.floor(course)
    along = walls.along[None, :] * (1 / _BRICK) + jnp.where(odd, 0.5, 0.0)
    joint = jnp.maximum(_off_middle(course), _off_middle(along)) > 0.5 - _MORTAR / _BRICK
    # Joints fade with distance, before they become thinner than a pixel and flicker.
    contrast = config.texture / (1 + jnp.square(walls.distance * (1 / config.texture_reach)))
    shade = walls.brightness * (_GRAZED + (1 - _GRAZED) * walls.facing)
    return (
        shade[None, :]
        * jnp.where(joint, 1 - contrast[None, :], 1.0)
        * jnp.where(height < _SKIRTING, _SKIRTING_SHADE, 1.0)
    )


def _off_middle(values: Float32[Array, "*shape"]) -> Float32[Array, "*shape"]:
    """Distance of the fraction from one half."""
    return jnp.abs(values - jnp.floor(values) - 0.5)


def _see_planes(
    shown: Int32[Array, "rows columns"], sight: Int32[Array, "steps columns"], planes: _Planes
) -> tuple[Float32[Array, "rows columns"], Float32[Array, "rows columns"]]:
    """Transmission and glow of the smoke in front of the pixels of floor and ceiling."""
    entered, glow = _unpack_sight(jnp.take(sight.ravel(), planes.step, mode="clip"))
    transmission = entered * _passed(shown, jnp.asarray(planes.inside))
    return transmission, glow + (entered - transmission) * _brightness(shown)


def _plane_colours(
    colours: Int32[Array, " cells"], base: Int32[Array, ""], rays: _Rays, planes: _Planes, config: CameraConfig
) -> Int32[Array, "rows columns"]:
    """The ceiling's colour above the horizon, each cell's floor below it."""
    # Rows come from top to bottom, so those of the ceiling are the first.
    above = int(np.sum(planes.slope >= 0))
    floor = jnp.take(colours, base + rays.offset.ravel()[planes.step[above:]], mode="clip")
    red, green, blue = config.ceiling_colour
    ceiling = jnp.full((above, config.width), (red << 16) | (green << 8) | blue, jnp.int32)
    return jnp.concatenate([ceiling, floor])


def _channel(colour: Int32[Array, "*shape"], shift: int) -> Float32[Array, "*shape"]:
    """One of the three colours, 0 to 255."""
    return ((colour >> shift) & 0xFF).astype(jnp.float32)


@functools.lru_cache(maxsize=32)
def _tables(config: CameraConfig, height: int, width: int) -> tuple[_Rays, _Planes]:
    """The static tables for grids of ``height`` x ``width`` cells, computed in double precision."""
    # Double, because the order of two crossings that nearly coincide decides which cells a ray enters.
    bearings = column_bearings(config)
    rays = _trace(bearings, height, width)
    return _as_float32(rays), _as_float32(_cut_planes(config, bearings, rays))


def _trace(bearings: Float[np.ndarray, " columns"], height: int, width: int) -> _Rays:
    """Follow the rays through the lattice until they have crossed as many lines as a grid of this size has."""
    # From the middle of a cell a ray crosses the lines between rows at distances (i + 1/2) / |sin|, those between
    # columns at (j + 1/2) / |cos|. Merged in order of distance they are the cells that the ray enters, one at a time:
    # it meets no corner (see ``CameraConfig``) and is parallel to no line.
    down, right = np.sin(bearings), np.cos(bearings)
    row_lines = (np.arange(height - 1) + 0.5)[:, None] / np.abs(down)
    column_lines = (np.arange(width - 1) + 0.5)[:, None] / np.abs(right)
    crossings = np.concatenate([row_lines, column_lines])
    order = np.argsort(crossings, axis=0, kind="stable")
    nothing = np.zeros((1, len(bearings)))
    enter = np.concatenate([nothing, np.take_along_axis(crossings, order, axis=0)])
    # Indices below ``height - 1`` are crossings of lines between rows: these were put first.
    by_row = np.concatenate([nothing, order < height - 1])
    rows = np.cumsum(by_row, axis=0) * np.sign(down)
    # The robot's own cell counts as neither.
    columns = (np.cumsum(1 - by_row, axis=0) - 1) * np.sign(right)
    # Where on the side, from its middle: the coordinate along it at the crossing, less the cell's own.
    across = np.where(by_row == 1, enter * right - columns, enter * down - rows)
    return _Rays(
        offset=(rows * width + columns).astype(np.int32),
        enter=enter,
        # The last step has no next crossing; no ray gets there in a closed world.
        length=np.minimum(np.diff(enter, axis=0, append=enter[-1:]), math.sqrt(2)),
        along=across + 0.5,
        facing=np.where(by_row == 1, np.abs(down), np.abs(right)),
    )


def _cut_planes(config: CameraConfig, bearings: Float[np.ndarray, " columns"], rays: _Rays) -> _Planes:
    """Where the sight lines of the pixels meet the floor and the ceiling."""
    distance = _plane_distances(config)
    # The cell in which a pixel's sight line ends is the last that its column's ray has entered by that distance.
    step = np.stack([np.searchsorted(column, distance, side="right") - 1 for column in rays.enter.T], axis=1)
    columns = np.arange(len(bearings))
    return _Planes(
        distance=distance,
        slope=row_slopes(config),
        step=(step * len(bearings) + columns).astype(np.int32),
        inside=np.minimum(distance[:, None] - rays.enter[step, columns], math.sqrt(2)),
        shade=1 - config.texture * _tile_edges(config),
    )


def _plane_distances(config: CameraConfig) -> Float[np.ndarray, " rows"]:
    """How far away, on the map, each row meets the floor or the ceiling; at most ``_LONGEST_SIGHT``."""
    slopes = row_slopes(config)
    # Height between the eye and the plane that the row meets: the floor below the horizon, the ceiling above it.
    gap = np.where(slopes < 0, config.eye_height, config.wall_height - config.eye_height)
    return gap / np.maximum(np.abs(slopes), gap / _LONGEST_SIGHT)


def _tile_edges(config: CameraConfig) -> Float[np.ndarray, "rows columns"]:
    """Share of each pixel of floor or ceiling that shows the edge of a tile; a tile is a cell."""
    fine = finer(config, _SAMPLES)
    bearings, distance = column_bearings(fine), _plane_distances(fine)[:, None]
    # Distance from the middle of the tile, along rows and columns; the robot stands in the middle of one.
    across, along = (np.abs((distance * part(bearings) + 0.5) % 1.0 - 0.5) for part in (np.sin, np.cos))
    edge = np.maximum(across, along) > 0.5 - _TILE_EDGE
    return edge.reshape(config.height, _SAMPLES, config.width, _SAMPLES).mean(axis=(1, 3))


def _as_float32(tables: _Tables) -> _Tables:
    """The same with every table of real numbers in single precision."""
    return dataclasses.replace(
        tables,
        **{
            field.name: values.astype(np.float32)
            for field in dataclasses.fields(tables)
            if np.issubdtype((values := getattr(tables, field.name)).dtype, np.floating)
        },
    )
