"""What the robot's camera sees: a panorama of the true world from the middle of a cell.

Geometry. The picture is in the frame of the map; the robot has no heading. Column ``c`` of ``W`` looks along the
bearing ``2 pi (c + 1/2) / W - pi``, where a bearing is ``atan2(row difference, column difference)``: 0 along increasing
columns, growing clockwise on a map that is drawn with row 0 on top. The middle of row ``r`` looks along the elevation
whose tangent is ``-(eye_height / far) sinh((r + 1/2 - horizon) / fold)``, so that a row below the horizon shows the
floor at the distance ``far / sinh((r + 1/2 - horizon) / fold)``. Nearer than ``far`` cells that is a constant ratio
from row to row, beyond it the rows are even in angle: the far floor, where thin smoke and the floors of hallways are
told apart, has many rows.

Walls stand on the obstacles and are ``wall_height`` cells high; the ceiling is flat. Brightness comes from the light of
the free cell that the surface belongs to. White smoke follows the law of Beer and Lambert: a cell of density
``s`` that is crossed over ``l`` cells lets ``exp(-s l)`` of the light through, and what it takes away it replaces by
white, as bright as the light of that cell. Textures repeat in every cell, so that nothing in a picture tells where on
the map it was taken.

Because the robot stands in the middle of a cell, the cells that a ray crosses, where it crosses them, and the piece of
floor that a pixel shows are the same for every cell and world, relative to the robot: they are static tables, and what
is left are gathers and one running product along the rays.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Int32, PRNGKeyArray, UInt8

from potlp_jax.world.grid import World

_SOLID = 1 << 30
_LONGEST_SIGHT = 1e6
_BRICK = 0.5
_MORTAR = 0.05
_TILE_EDGE = 0.06
_SAMPLES = 6
_SKIRTING, _SKIRTING_SHADE = 0.2, 0.7
_GRAZED = 0.7
_HALF_DIAGONAL = math.sqrt(0.5)
_TAYLOR = tuple((-1) ** order / math.factorial(order) for order in range(8))
_TAYLOR_AT_ZERO = sum(term * (-_HALF_DIAGONAL) ** order for order, term in enumerate(_TAYLOR))

_Tables = TypeVar("_Tables", "_Rays", "_Planes")


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """The camera, in cells where a length is meant.

    Attributes:
        height, width: rows and columns of the picture.
        horizon: rows above the horizon.
        far: floor nearer than this is spaced by ratios of distance, floor beyond it by angles.
        fold: rows over which the distance of near floor falls by a factor of e.
        eye_height, wall_height: of the camera, of the walls and the ceiling, above the floor.
        texture: contrast of the textures, 0 (none) to 1; texture_reach: distance at which half of it is left on walls.
        ambient: brightness of what has no light at all, 0 (black) to 1.
        ceiling_colour, smoke_colour: RGB in full light.
    """

    height: int = 128
    width: int = 512
    horizon: float = 48.0
    far: float = 50.0
    fold: float = 16.0
    eye_height: float = 1.5
    wall_height: float = 2.5
    texture: float = 0.16
    texture_reach: float = 5.0
    ambient: float = 0.12
    ceiling_colour: tuple[int, int, int] = (166, 168, 176)
    smoke_colour: tuple[int, int, int] = (250, 250, 250)

    def __post_init__(self) -> None:
        lengths = (self.far, self.fold, self.eye_height, self.texture_reach)
        colours = (*self.ceiling_colour, *self.smoke_colour)
        rules = (
            (self.height >= 1 and self.width >= 4, "height must be at least 1, width at least 4"),
            (
                self.width % 8 == 0,
                f"width must be a multiple of 8, so that no ray meets a corner of cells, found {self.width}",
            ),
            (
                all(math.isfinite(v) and v > 0 for v in lengths),
                "far, fold, eye_height and texture_reach must be positive",
            ),
            (self.eye_height < self.wall_height < math.inf, "the eye must be below the ceiling, wall_height"),
            (math.isfinite(self.horizon), "horizon must be a number of rows"),
            (0 <= self.texture <= 1 and 0 <= self.ambient <= 1, "texture and ambient lie between 0 and 1"),
            (len(colours) == 6 and all(0 <= v <= 255 for v in colours), "a colour is three values of 0 to 255"),
        )
        broken = [message for holds, message in rules if not holds]
        if broken:
            raise ValueError("not a camera: " + "; ".join(broken))


@dataclasses.dataclass(frozen=True)
class Disturbance:
    """What a real camera adds; all zero is nothing.

    Attributes:
        noise: standard deviation of each value, of 255.
        exposure: standard deviation of the logarithm of the picture's brightness.
        colour: the same for each of red, green and blue by itself.
    """

    noise: float = 0.0
    exposure: float = 0.0
    colour: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) and value >= 0 for value in dataclasses.astuple(self)):
            raise ValueError(f"noise, exposure and colour must be finite numbers, 0 or more, found {self}")


@dataclasses.dataclass(frozen=True)
class _Rays:
    """Static tables of the rays, one a column, for one camera and one shape of grid.

    Step 0 of a ray is the robot's cell, step ``k`` the ``k``-th cell that it enters. Offsets are flat indices
    relative to the robot's cell. Where a ray has left every grid of this shape its entries
    mean nothing: an obstacle stopped it.
    """

    offset: Int[np.ndarray, "steps columns"]
    enter: Float[np.ndarray, "steps columns"]
    """Distance at which the ray enters the cell."""
    length: Float[np.ndarray, "steps columns"]
    """Of the ray inside of the cell."""
    along: Float[np.ndarray, "steps columns"]
    """Where on the side through which it enters, 0 to 1."""
    facing: Float[np.ndarray, "steps columns"]
    """Cosine of the angle at which it meets that side."""


@dataclasses.dataclass(frozen=True)
class _Planes:
    """Static tables of floor and ceiling: what a pixel shows where no wall is in front of it."""

    distance: Float[np.ndarray, " rows"]
    slope: Float[np.ndarray, " rows"]
    """Tangent of the elevation."""
    step: Int[np.ndarray, "rows columns"]
    """Flat index ``step * columns + column`` into the tables of the rays."""
    inside: Float[np.ndarray, "rows columns"]
    """Length of the sight line in the cell that is shown."""
    shade: Float[np.ndarray, "rows columns"]
    """Texture."""


class _Walls(NamedTuple):
    """The wall that each column shows."""

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
    """The panorama from the middle of ``cell``, a free cell; RGB, without disturbance. ``config`` is static.

    Only what is in line of sight enters the picture: letters and cells behind walls change no pixel. The world's border
    must be closed, as ``make_world`` leaves it.
    """
    return _batched_renderer(config)(_pack_optics(world, config), _pack_colours(world), cell)


def disturb(
    image: UInt8[Array, "rows columns 3"], key: PRNGKeyArray, config: Disturbance
) -> UInt8[Array, "rows columns 3"]:
    """The picture of a worse camera: another exposure, other colours, sensor noise. ``config`` is static."""
    gain_key, noise_key = jax.random.split(key)
    gains = jax.random.normal(gain_key, (4,), jnp.float32)
    gain = jnp.exp(config.exposure * gains[0] + config.colour * gains[1:])
    noise = config.noise * _bell(noise_key, image.shape) if config.noise else jnp.float32(0)
    values = image.astype(jnp.float32) * gain[None, None, :] + noise
    return jnp.clip(jnp.round(values), 0.0, 255.0).astype(jnp.int32).astype(jnp.uint8)


def _bell(key: PRNGKeyArray, shape: tuple[int, ...]) -> Float32[Array, "..."]:
    """Mean 0, standard deviation 1: sums of four random bytes, near to normal.

    The bytes are a hash of the value's number, seeded by the key: on a CPU the generator of keys would take several
    times as long as the rest of the picture. References: "lowbias32", C. Wellons, Prospecting for hash functions, 2018.
    """
    seeds = jax.random.bits(key, (2,), jnp.uint32)
    words = jax.lax.iota(jnp.uint32, math.prod(shape)).reshape(shape) + seeds[0]
    words = (words ^ (words >> np.uint32(16))) * np.uint32(0x7FEB352D) + seeds[1]
    words = (words ^ (words >> np.uint32(15))) * np.uint32(0x846CA68B)
    words = words ^ (words >> np.uint32(16))
    total = sum(((words >> np.uint32(shift)) & np.uint32(0xFF)).astype(jnp.int32) for shift in (0, 8, 16, 24))
    # A uniform byte has the mean 127.5 and the variance (256^2 - 1) / 12.
    return (jnp.asarray(total).astype(jnp.float32) - 510.0) * math.sqrt(3 / (256**2 - 1))


def bearing(origin: Int32[Array, "2"], target: Int32[Array, "*S 2"]) -> Float32[Array, "*S"]:
    """The bearing of each target, in radians from -pi to pi; 0 for the origin itself."""
    rows = (target[..., 0] - origin[0]).astype(jnp.float32)
    columns = (target[..., 1] - origin[1]).astype(jnp.float32)
    return jnp.arctan2(rows, columns)


def roll_to(image: UInt8[Array, "rows columns 3"], bearing: Float32[Array, ""]) -> UInt8[Array, "rows columns 3"]:
    """The picture rolled by whole columns so that ``bearing`` is in its centre; for people."""
    columns = image.shape[1]
    shift = jnp.round(bearing * (columns / (2 * math.pi))).astype(jnp.int32)
    return jnp.roll(image, -shift, axis=1)


def column_bearings(config: CameraConfig) -> Float[np.ndarray, " columns"]:
    """The bearing along which each column looks."""
    return 2 * math.pi * (np.arange(config.width) + 0.5) / config.width - math.pi


def row_slopes(config: CameraConfig) -> Float[np.ndarray, " rows"]:
    """The tangent of the elevation along which each row looks, positive above the horizon."""
    below = (np.arange(config.height) + 0.5 - config.horizon) / config.fold
    return -config.eye_height / config.far * np.sinh(below)


def rows_at_slopes(config: CameraConfig, slopes: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Row coordinate, 0 in the middle of the first row, at which the tangent of the elevation has each value."""
    return config.horizon + config.fold * np.arcsinh(-slopes * config.far / config.eye_height) - 0.5


def floor_rows(config: CameraConfig, distance: Float32[Array, "*B"]) -> Float32[Array, "*B"]:
    """Row coordinate, 0 in the middle of the first row, in which the floor at a distance in cells is seen.

    Nearer than one cell as at one cell: the robot does not see the floor under itself.
    """
    ratio = jnp.float32(config.far) / jnp.maximum(distance, jnp.float32(1))
    return jnp.float32(config.horizon - 0.5) + jnp.float32(config.fold) * jnp.arcsinh(ratio)


def finer(config: CameraConfig, factor: int) -> CameraConfig:
    """The same view in ``factor`` times as many rows and columns."""
    return dataclasses.replace(
        config,
        height=config.height * factor,
        width=config.width * factor,
        horizon=config.horizon * factor,
        fold=config.fold * factor,
    )


def _batched_renderer(config: CameraConfig) -> Callable[..., UInt8[Array, "*B rows columns 3"]]:
    """``_render`` that takes a batch on a CPU one picture after the other: what one needs fits the cache."""

    def render_one(
        optics: Int32[Array, "H W"], colours: Int32[Array, "H W"], cell: Int32[Array, "2"]
    ) -> UInt8[Array, "rows columns 3"]:
        return _render(optics, colours, cell, config)

    renderer = jax.custom_batching.custom_vmap(render_one)

    def render_batch(axis_size: int, batched: Sequence[bool], *arguments: Array) -> tuple[Array, bool]:
        del axis_size

        def in_turn(*arguments: Array) -> Array:
            def render_next(moving: list[Array]) -> Array:
                left = iter(moving)
                return renderer(*(next(left) if flag else one for one, flag in zip(arguments, batched, strict=True)))

            return jax.lax.map(render_next, [one for one, flag in zip(arguments, batched, strict=True) if flag])

        at_once = jax.vmap(render_one, in_axes=tuple(0 if flag else None for flag in batched))
        return jax.lax.platform_dependent(*arguments, cpu=in_turn, default=at_once), True

    renderer.def_vmap(render_batch)
    return renderer


def _render(
    optics: Int32[Array, "H W"], colours: Int32[Array, "H W"], cell: Int32[Array, "2"], config: CameraConfig
) -> UInt8[Array, "rows columns 3"]:
    rays, planes = _tables(config, *optics.shape)
    base = cell[0] * jnp.int32(optics.shape[1]) + cell[1]
    crossed = jnp.take(optics.ravel(), base + rays.offset, mode="clip")
    sight = _pass_smoke(crossed, rays)
    walls = _find_walls(crossed, sight, colours.ravel(), base, rays)
    is_wall = planes.distance[:, None] >= walls.distance[None, :]
    shown = jnp.take(crossed.ravel(), planes.step, mode="clip")
    transmission, glow = _see_planes(shown, sight, planes)
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
    # Four bytes at once: on a CPU conversions to bytes are slow. The first byte is the lowest.
    return jax.lax.bitcast_convert_type(pixels, jnp.uint8)[..., :3]


def _pack_optics(world: World, config: CameraConfig) -> Int32[Array, "H W"]:
    """Bit 30: an obstacle. Bits 8 to 23: density of smoke, of 65,535. Bits 0 to 7: brightness, of 255."""
    look = world.appearance
    smoke = jnp.round(jnp.clip(look.smoke, 0.0, 1.0) * 65535.0).astype(jnp.int32)
    brightness = config.ambient + (1 - config.ambient) * jnp.clip(look.light, 0.0, 1.0)
    packed = (smoke << 8) | jnp.round(brightness * 255.0).astype(jnp.int32)
    return jnp.where(world.occupied, packed | _SOLID, packed)


def _pack_colours(world: World) -> Int32[Array, "H W"]:
    """RGB of an obstacle's sides or of a free cell's floor."""
    look = world.appearance
    colour = jnp.where(world.occupied[..., None], look.wall_colour, look.floor_colour).astype(jnp.int32)
    return (colour[..., 0] << 16) | (colour[..., 1] << 8) | colour[..., 2]


def _smoke(optics: Int32[Array, "*D"]) -> Float32[Array, "*D"]:
    return ((optics >> 8) & 0xFFFF).astype(jnp.float32) * (1 / 65535)


def _brightness(optics: Int32[Array, "*D"]) -> Float32[Array, "*D"]:
    return (optics & 0xFF).astype(jnp.float32) * (1 / 255)


def _passed(optics: Int32[Array, "*D"], length: Float32[Array, "*D"]) -> Float32[Array, "*D"]:
    """``exp(-density * length)`` to five digits; a sight line is at most a diagonal long inside of a cell.

    A Taylor polynomial around half a diagonal, which a CPU computes three times faster than the exponential function.
    """
    depth = _smoke(optics) * length - _HALF_DIAGONAL
    value = jnp.full_like(depth, _TAYLOR[-1] / _TAYLOR_AT_ZERO)
    for term in _TAYLOR[-2::-1]:
        value = value * depth + term / _TAYLOR_AT_ZERO
    return jnp.minimum(value, 1.0)


def _pass_smoke(crossed: Int32[Array, "steps columns"], rays: _Rays) -> Int32[Array, "steps columns"]:
    """Where each ray enters each cell: the light that comes through and the glow of the smoke, see ``_pack_sight``."""

    def cross(state, cell):
        transmission, glow = state
        optics, length = cell
        after = transmission * _passed(optics, length)
        return (after, glow + (transmission - after) * _brightness(optics)), _pack_sight(transmission, glow)

    clear = jnp.ones(crossed.shape[1:], jnp.float32)
    return jax.lax.scan(cross, (clear, jnp.zeros_like(clear)), (crossed, jnp.asarray(rays.length)))[1]


def _pack_sight(transmission: Float32[Array, "*D"], glow: Float32[Array, "*D"]) -> Int32[Array, "*D"]:
    """Bits 16 to 30: transmission, of 32,767. Bits 0 to 15: glow, of 65,535."""
    high = (transmission * 32767.0 + 0.5).astype(jnp.int32)
    return (high << 16) | (jnp.minimum(glow, 1.0) * 65535.0 + 0.5).astype(jnp.int32)


def _unpack_sight(packed: Int32[Array, "*D"]) -> tuple[Float32[Array, "*D"], Float32[Array, "*D"]]:
    transmission = (packed >> 16).astype(jnp.float32) * (1 / 32767)
    return transmission, (packed & 0xFFFF).astype(jnp.float32) * (1 / 65535)


def _find_walls(
    crossed: Int32[Array, "steps columns"],
    sight: Int32[Array, "steps columns"],
    colours: Int32[Array, " cells"],
    base: Int32[Array, ""],
    rays: _Rays,
) -> _Walls:
    steps, columns = crossed.shape
    step = jnp.arange(steps, dtype=jnp.int32)[:, None]
    first = jnp.min(jnp.where(crossed >= _SOLID, step, jnp.int32(steps - 1))[1:], axis=0)
    at = first * jnp.int32(columns) + jnp.arange(columns, dtype=jnp.int32)
    before = jnp.take(crossed.ravel(), at - jnp.int32(columns), mode="clip")
    transmission, glow = _unpack_sight(jnp.take(sight.ravel(), at, mode="clip"))
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
    odd = jnp.floor(course * 0.5) * 2 != jnp.floor(course)
    along = walls.along[None, :] * (1 / _BRICK) + jnp.where(odd, 0.5, 0.0)
    joint = jnp.maximum(_off_middle(course), _off_middle(along)) > 0.5 - _MORTAR / _BRICK
    contrast = config.texture / (1 + jnp.square(walls.distance * (1 / config.texture_reach)))
    shade = walls.brightness * (_GRAZED + (1 - _GRAZED) * walls.facing)
    return (
        shade[None, :]
        * jnp.where(joint, 1 - contrast[None, :], 1.0)
        * jnp.where(height < _SKIRTING, _SKIRTING_SHADE, 1.0)
    )


def _off_middle(values: Float32[Array, "*D"]) -> Float32[Array, "*D"]:
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
    above = int(np.sum(planes.slope >= 0))
    floor = jnp.take(colours, base + rays.offset.ravel()[planes.step[above:]], mode="clip")
    red, green, blue = config.ceiling_colour
    ceiling = jnp.full((above, config.width), (red << 16) | (green << 8) | blue, jnp.int32)
    return jnp.concatenate([ceiling, floor])


def _channel(colour: Int32[Array, "*D"], shift: int) -> Float32[Array, "*D"]:
    return ((colour >> shift) & 0xFF).astype(jnp.float32)


@functools.lru_cache(maxsize=32)
def _tables(config: CameraConfig, height: int, width: int) -> tuple[_Rays, _Planes]:
    """The static tables for grids of ``height`` x ``width`` cells, computed in double precision."""
    looks = column_bearings(config)
    rays = _trace(looks, height, width)
    return _as_float32(rays), _as_float32(_cut_planes(config, looks, rays))


def _trace(looks: Float[np.ndarray, " columns"], height: int, width: int) -> _Rays:
    """Follow the rays through the lattice until they have crossed as many lines as a grid of this size has."""
    down, right = np.sin(looks), np.cos(looks)
    row_lines = (np.arange(height - 1) + 0.5)[:, None] / np.abs(down)
    column_lines = (np.arange(width - 1) + 0.5)[:, None] / np.abs(right)
    crossings = np.concatenate([row_lines, column_lines])
    order = np.argsort(crossings, axis=0, kind="stable")
    nothing = np.zeros((1, len(looks)))
    enter = np.concatenate([nothing, np.take_along_axis(crossings, order, axis=0)])
    by_row = np.concatenate([nothing, order < height - 1])
    rows = np.cumsum(by_row, axis=0) * np.sign(down)
    # The robot's own cell counts as neither.
    columns = (np.cumsum(1 - by_row, axis=0) - 1) * np.sign(right)
    across = np.where(by_row == 1, enter * right - columns, enter * down - rows)
    return _Rays(
        offset=(rows * width + columns).astype(np.int32),
        enter=enter,
        length=np.minimum(np.diff(enter, axis=0, append=enter[-1:]), math.sqrt(2)),
        along=across + 0.5,
        facing=np.where(by_row == 1, np.abs(down), np.abs(right)),
    )


def _cut_planes(config: CameraConfig, looks: Float[np.ndarray, " columns"], rays: _Rays) -> _Planes:
    """Where the sight lines of the pixels meet the floor and the ceiling."""
    distance = _plane_distances(config)
    step = np.stack([np.searchsorted(column, distance, side="right") - 1 for column in rays.enter.T], axis=1)
    columns = np.arange(len(looks))
    return _Planes(
        distance=distance,
        slope=row_slopes(config),
        step=(step * len(looks) + columns).astype(np.int32),
        inside=np.minimum(distance[:, None] - rays.enter[step, columns], math.sqrt(2)),
        shade=1 - config.texture * _tile_edges(config),
    )


def _plane_distances(config: CameraConfig) -> Float[np.ndarray, " rows"]:
    """How far away, on the map, each row meets the floor or the ceiling; at most ``_LONGEST_SIGHT``."""
    slopes = row_slopes(config)
    gap = np.where(slopes < 0, config.eye_height, config.wall_height - config.eye_height)
    return gap / np.maximum(np.abs(slopes), gap / _LONGEST_SIGHT)


def _tile_edges(config: CameraConfig) -> Float[np.ndarray, "rows columns"]:
    """Share of each pixel of floor or ceiling that shows the edge of a tile; a tile is a cell."""
    fine = finer(config, _SAMPLES)
    looks, distance = column_bearings(fine), _plane_distances(fine)[:, None]
    across, along = (np.abs((distance * part(looks) + 0.5) % 1.0 - 0.5) for part in (np.sin, np.cos))
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
