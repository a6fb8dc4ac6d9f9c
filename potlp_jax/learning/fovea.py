"""The pixels around a subgoal at full resolution: around the point of the panorama where its cell meets the floor.

The bearing of a subgoal says the column, and its distance the row, because the camera's height above the floor is
known. A door down a hallway is a few columns wide and as many rows high: the convolutions' features are too coarse to
tell it from the wall beside it, and wherever it stands, it is in the middle of this patch.

The panorama is kept as **bands**, means over ``BAND`` rows, at full width; a patch reaches ``ABOVE`` bands above the
point, where what lies beyond it is seen, and ``BELOW`` bands below.
"""

import functools
import math

import jax.numpy as jnp
from jaxtyping import Array, Float32

BAND: int = 4
"""Rows of pixels in a band."""

# What lies beyond a subgoal is seen above the point where it meets the floor; below it there is floor alone.
ABOVE: int = 8
BELOW: int = 4


def bands_of(pixels: Float32[Array, "*B rows columns 3"]) -> Float32[Array, "*B bands columns 3"]:
    """The panorama in bands."""
    *batch, rows, columns, colours = pixels.shape
    return jnp.mean(pixels.reshape(*batch, rows // BAND, BAND, columns, colours), axis=-3)


def packed(bands: Float32[Array, "*B bands columns 3"], side: int) -> Float32[Array, "*B rows columns_out packed"]:
    """The bands as channels of squares of ``side`` pixels, so that they travel with features of that size."""
    *batch, count, columns, colours = bands.shape
    high = side // BAND
    squares = bands.reshape(*batch, count // high, high, columns // side, side, colours)
    return jnp.moveaxis(squares, -4, -3).reshape(*batch, count // high, columns // side, high * side * colours)


def unpacked(squares: Float32[Array, "rows columns packed"], side: int) -> Float32[Array, "bands columns_out 3"]:
    """The bands again, of one panorama."""
    rows, columns, _ = squares.shape
    high = side // BAND
    bands = jnp.moveaxis(squares.reshape(rows, columns, high, side, 3), 2, 1)
    return bands.reshape(rows * high, columns * side, 3)


def patch(
    bands: Float32[Array, "bands columns 3"], bearing: Float32[Array, "*B"], row: Float32[Array, "*B"], reach: int
) -> Float32[Array, "*B patch_rows patch_columns 3"]:
    """What one panorama shows around points, ``ABOVE + BELOW`` bands of ``2 * reach + 1`` columns each.

    By linear interpolation; around the whole circle, and as at the edge above the first band and below the last.

    Args:
        bands: the panorama, its centre looking along bearing 0.
        bearing: of the points, in radians.
        row: of the points, in rows of pixels, 0 in the middle of the first.
        reach: columns on each side; static.

    Returns:
        The patch of each point, the point in its middle column and on the border of the bands above and below.
    """
    around = jnp.vectorize(functools.partial(_patch_at, bands, reach), signature="(),()->(r,c,d)")
    return around(bearing, row)


def _patch_at(
    bands: Float32[Array, "bands columns 3"], reach: int, bearing: Float32[Array, ""], row: Float32[Array, ""]
) -> Float32[Array, "patch_rows patch_columns 3"]:
    count, columns, _ = bands.shape
    across = bearing * jnp.float32(columns / (2 * math.pi)) + jnp.float32((columns - 1) / 2)
    across = across + jnp.arange(-reach, reach + 1, dtype=jnp.float32)
    # The middle of the first band lies (BAND - 1) / 2 rows below the middle of the first row; the point lies on the
    # border between the bands above and below.
    down = (row - jnp.float32((BAND - 1) / 2)) / BAND + jnp.arange(-ABOVE, BELOW, dtype=jnp.float32) + 0.5
    # Bilinear: a point between pixels moves the patch by parts of a pixel, so that mirroring the panorama mirrors it.
    left, top = jnp.floor(across), jnp.floor(down)
    right_share, lower_share = (across - left)[None, :, None], (down - top)[:, None, None]
    sides = [(left.astype(jnp.int32) + step)[None, :] % columns for step in (0, 1)]
    levels = [jnp.clip(top.astype(jnp.int32) + step, 0, count - 1)[:, None] for step in (0, 1)]
    upper, lower = (
        (1 - right_share) * bands[level, sides[0]] + right_share * bands[level, sides[1]] for level in levels
    )
    return (1 - lower_share) * upper + lower_share * lower
