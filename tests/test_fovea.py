"""The patch of pixels around a subgoal, against interpolation in the picture and what a rendered world shows."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.learning.fovea import ABOVE, BAND, BELOW, bands_of, packed, patch, unpacked
from potlp_jax.world.camera import CameraConfig, bearing, floor_rows, rows_at_slopes
from potlp_jax.world.grid import make_world
from potlp_jax.world.renderer import render

pytestmark = pytest.mark.optimised

SHAPE = (64, 128)


def _picture(seed=0):
    return np.random.default_rng(seed).uniform(size=(*SHAPE, 3)).astype(np.float32)


def test_packing_and_unpacking_gives_the_bands():
    bands = bands_of(jnp.asarray(_picture()))
    assert bands.shape == (SHAPE[0] // BAND, SHAPE[1], 3)
    np.testing.assert_allclose(bands[3, 5], _picture()[3 * BAND : 4 * BAND, 5].mean(axis=0), rtol=1e-6)
    squares = packed(bands, 16)
    assert squares.shape == (4, 8, 16 // BAND * 16 * 3)
    np.testing.assert_array_equal(unpacked(squares, 16), bands)
    # The square of a place holds the pixels of that place.
    np.testing.assert_array_equal(squares[1, 2].reshape(16 // BAND, 16, 3), bands[4:8, 32:48])


def test_a_patch_is_what_the_picture_shows_around_the_point():
    """Against interpolation along columns, then along rows, by NumPy."""
    picture = _picture(1)
    bands = picture.reshape(SHAPE[0] // BAND, BAND, SHAPE[1], 3).mean(axis=1)
    middles = np.arange(len(bands)) * BAND + (BAND - 1) / 2
    bearings = np.linspace(-np.pi, np.pi, 23).astype(np.float32)
    rows = np.linspace(-3, 70, 23).astype(np.float32)
    found = np.asarray(patch(jnp.asarray(bands), jnp.asarray(bearings), jnp.asarray(rows), 5))
    assert found.shape == (23, ABOVE + BELOW, 11, 3)
    for angle, row, seen in zip(bearings, rows, found, strict=True):
        columns = (angle + np.pi) * SHAPE[1] / (2 * np.pi) - 0.5 + np.arange(-5, 6)
        levels = row + BAND * (np.arange(-ABOVE, BELOW) + 0.5)
        for channel in range(3):
            across = np.array(
                [np.interp(columns, np.arange(SHAPE[1]), band, period=SHAPE[1]) for band in bands[..., channel]]
            )
            wanted = np.array([np.interp(levels, middles, column) for column in across.T]).T
            np.testing.assert_allclose(seen[..., channel], wanted, atol=2e-3)


def test_floor_rows_are_where_the_camera_sees_the_floor():
    camera = CameraConfig()
    distances = np.array([1.0, 2.5, 10.0, 60.0])
    rows = np.asarray(floor_rows(camera, jnp.asarray(distances, jnp.float32)))
    np.testing.assert_allclose(rows, rows_at_slopes(camera, -camera.eye_height / distances), atol=1e-3)
    assert float(floor_rows(camera, jnp.float32(0.0))) == pytest.approx(rows[0], abs=1e-4)


@pytest.mark.long
def test_the_patch_of_a_cell_shows_that_cell_wherever_it_is():
    """A red floor cell in a large hall: the middle of the patch is red; as it is not where the cell is another one."""
    size, start = 41, (20, 20)
    occupied = np.pad(np.zeros((size - 2, size - 2), bool), 1, constant_values=True)
    for cell in ((20, 26), (14, 17), (31, 32), (29, 12)):
        floor = np.full((size, size, 3), 120, np.uint8)
        floor[cell] = (255, 0, 0)
        world = make_world(occupied, np.zeros((size, size), np.int32), start)
        look = dataclasses.replace(world.appearance, floor_colour=jnp.asarray(floor))
        world = dataclasses.replace(world, appearance=look)
        picture = jnp.asarray(np.asarray(render(world, jnp.asarray(start, jnp.int32))) / np.float32(255), jnp.float32)
        target = jnp.asarray(cell, jnp.int32)
        row = floor_rows(CameraConfig(), jnp.float32(math.dist(start, cell)))
        seen = np.asarray(patch(bands_of(picture), bearing(jnp.asarray(start, jnp.int32), target), row, 8))
        redness = seen[..., 0] - seen[..., 1]
        middle = redness[ABOVE - 1 : ABOVE + 1, 8]
        assert redness.max() > 0.1
        assert middle.max() > 0.5 * redness.max()
        assert redness[:, 0].max() < 0.2 * middle.max()
