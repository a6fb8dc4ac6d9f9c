"""The robot's panoramic camera: where its rows and columns look, and the disturbances of a real one.

The picture is in the frame of the map; the robot has no heading. Column ``c`` of ``W`` looks along the bearing
``2 pi (c + 1/2) / W - pi``, where a bearing is ``atan2(row difference, column difference)``: 0 along increasing
columns, growing clockwise on a map that is drawn with row 0 on top. The middle of row ``r`` looks along the elevation
whose tangent is ``-(eye_height / far) sinh((r + 1/2 - horizon) / fold)``, so that a row below the horizon shows the
floor at the distance ``far / sinh((r + 1/2 - horizon) / fold)``. Nearer than ``far`` cells that is a constant ratio
from row to row, beyond it the rows are even in angle: the far floor, where thin smoke and the floors of hallways are
told apart, has many rows.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int32, PRNGKeyArray, UInt8

from potlp_jax.checks import COUNT, NOT_NEGATIVE, as_python_numbers, is_whole, require_rules


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """The camera, in cells where a length is meant.

    Attributes:
        height, width: rows and columns of the picture.
        horizon: rows above the horizon.
        far: floor nearer than this is spaced by ratios of distance, floor beyond it by angles.
        fold: rows over which the distance of near floor falls by a factor of e.
        eye_height, wall_height: of the camera, of the walls and the ceiling, above the floor.
        texture: contrast of the textures, 0 (none) to 1; texture_reach: distance at which half of it remains on walls.
        ambient: brightness of what has no light at all, 0 (black) to 1.
        ceiling_colour, smoke_colour: RGB in full light.
        renderer: what draws the picture: empty for ``world.renderer``, otherwise the name of a function of your own,
            as ``module:attribute`` or an entry point in the group ``potlp_jax.cameras``. It gets the world, the cell
            and this configuration, runs inside jit, and returns a picture of ``height`` times ``width`` pixels.
    """

    height: int = 128
    width: int = 512
    # With these three the floor from 20 to 130 cells, where hallways are told apart, has 20 rows; rows of equal angle
    # would give it 3 (the table of distances is in docs/camera.md).
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
    # A name instead of the function, so that records, data sets and other processes mean the same camera.
    renderer: str = ""

    def __post_init__(self) -> None:
        lengths = (self.far, self.fold, self.eye_height, self.texture_reach)
        colours = (*self.ceiling_colour, *self.smoke_colour)
        rules = (
            (
                COUNT.allows(self.height) and COUNT.allows(self.width) and self.width >= 4,
                "height must be at least 1, width at least 4, both whole numbers",
            ),
            # From the middle of a cell all corners lie in directions of rational tangent. Of the bearings that are a
            # rational part of the circle, as those of columns are, only multiples of 45 degrees have one (Niven's
            # theorem), and columns look half a step beside these where their number is a multiple of 8.
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
            (
                len(colours) == 6 and all(is_whole(v) and 0 <= v <= 255 for v in colours),
                "a colour is three whole numbers of 0 to 255",
            ),
        )
        require_rules(rules, "a camera", ValueError)
        as_python_numbers(self)

    def lengths(self, scale: float = 1.0) -> dict[str, float]:
        """The fields that are lengths, by name, in cells that are ``scale`` times smaller."""
        return {name: getattr(self, name) * scale for name in ("far", "eye_height", "wall_height", "texture_reach")}


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
        if not all(NOT_NEGATIVE.allows(value) for value in dataclasses.astuple(self)):
            raise ValueError(f"noise, exposure and colour must be finite numbers, 0 or more, found {self}")
        as_python_numbers(self)


def column_bearings(config: CameraConfig) -> Float[np.ndarray, " columns"]:
    """The bearing along which each column looks, in radians."""
    return 2 * math.pi * (np.arange(config.width) + 0.5) / config.width - math.pi


def row_slopes(config: CameraConfig) -> Float[np.ndarray, " rows"]:
    """The tangent of the elevation along which each row looks, positive above the horizon."""
    below = (np.arange(config.height) + 0.5 - config.horizon) / config.fold
    return -config.eye_height / config.far * np.sinh(below)


def rows_at_slopes(config: CameraConfig, slopes: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Row coordinate, 0 in the middle of the first row, at which the tangent of the elevation has each value."""
    # The inverse of ``row_slopes``; the half row lies between the upper edge of a row and its middle.
    return config.horizon + config.fold * np.arcsinh(-slopes * config.far / config.eye_height) - 0.5


def floor_rows(config: CameraConfig, distance: Float32[Array, "*shape"]) -> Float32[Array, "*shape"]:
    """Row coordinate, 0 in the middle of the first row, in which the floor at a distance in cells is seen.

    Nearer than one cell as at one cell: the robot does not see the floor under itself.
    """
    ratio = jnp.float32(config.far) / jnp.maximum(distance, jnp.float32(1))
    return jnp.float32(config.horizon - 0.5) + jnp.float32(config.fold) * jnp.arcsinh(ratio)


def finer(config: CameraConfig, factor: int) -> CameraConfig:
    """The same view in ``factor`` times as many rows and columns."""
    # ``far`` is a length on the map and stays; whatever counts rows grows.
    return dataclasses.replace(
        config,
        height=config.height * factor,
        width=config.width * factor,
        horizon=config.horizon * factor,
        fold=config.fold * factor,
    )


def bearing(origin: Int32[Array, "2"], target: Int32[Array, "*shape 2"]) -> Float32[Array, "*shape"]:
    """The bearing of each target, in radians from -pi to pi; 0 for the origin itself."""
    rows = (target[..., 0] - origin[0]).astype(jnp.float32)
    columns = (target[..., 1] - origin[1]).astype(jnp.float32)
    return jnp.arctan2(rows, columns)


def roll_to(image: UInt8[Array, "rows columns 3"], bearing: Float32[Array, ""]) -> UInt8[Array, "rows columns 3"]:
    """The picture rolled by whole columns so that ``bearing`` is in its centre; for people."""
    # The middle of a picture looks along bearing 0, so the shift is the bearing itself, in columns.
    columns = image.shape[1]
    shift = jnp.round(bearing * (columns / (2 * math.pi))).astype(jnp.int32)
    return jnp.roll(image, -shift, axis=1)


def disturb(
    image: UInt8[Array, "rows columns 3"], key: PRNGKeyArray, config: Disturbance
) -> UInt8[Array, "rows columns 3"]:
    """The picture of a worse camera: another exposure, other colours, sensor noise.

    Args:
        image: the undisturbed picture, RGB.
        key: consumed; equal keys give equal disturbances.
        config: how strong they are; static.

    Returns:
        The disturbed picture, clipped to 0..255.
    """
    gain_key, noise_key = jax.random.split(key)
    # Gain 0 is the exposure, which the three channels share; gains 1 to 3 are the colours' own.
    gains = jax.random.normal(gain_key, (4,), jnp.float32)
    gain = jnp.exp(config.exposure * gains[0] + config.colour * gains[1:])
    # The configuration is static: without noise none is computed.
    noise = config.noise * _bell(noise_key, image.shape) if config.noise else jnp.float32(0)
    values = image.astype(jnp.float32) * gain[None, None, :] + noise
    return jnp.clip(jnp.round(values), 0.0, 255.0).astype(jnp.int32).astype(jnp.uint8)


def _bell(key: PRNGKeyArray, shape: tuple[int, ...]) -> Float32[Array, "..."]:
    """Mean 0, standard deviation 1: sums of four random bytes, near to normal.

    The bytes are a hash of the value's number, seeded by the key: on a CPU the generator of keys would take several
    times as long as the rest of the picture.

    References: "lowbias32", C. Wellons, Prospecting for hash functions, 2018.
    """
    seeds = jax.random.bits(key, (2,), jnp.uint32)
    words = jax.lax.iota(jnp.uint32, math.prod(shape)).reshape(shape) + seeds[0]
    # The multipliers are lowbias32's. The second seed is added between its rounds, so that two pictures whose first
    # seeds are close do not show shifted copies of one noise.
    words = (words ^ (words >> np.uint32(16))) * np.uint32(0x7FEB352D) + seeds[1]
    words = (words ^ (words >> np.uint32(15))) * np.uint32(0x846CA68B)
    words = words ^ (words >> np.uint32(16))
    total = sum(((words >> np.uint32(shift)) & np.uint32(0xFF)).astype(jnp.int32) for shift in (0, 8, 16, 24))
    # A uniform byte has the mean 127.5 and the variance (256^2 - 1) / 12.
    return (jnp.asarray(total).astype(jnp.float32) - 510.0) * math.sqrt(3 / (256**2 - 1))
