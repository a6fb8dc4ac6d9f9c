"""Maps of data sets as images: what is encoded is decoded, padding apart."""

import dataclasses

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.errors import DatasetError
from potlp_jax.learning.map_images import decode_view, encode_view, encode_world, without_painting
from potlp_jax.learning.painting import Painting
from potlp_jax.world.grid import belief_from_numpy, make_world, pad_world

EXTENT, SHAPE = (7, 9), (10, 12)
NAMES = tuple(f"p{number}" for number in range(10))


def _world(seed):
    draw = np.random.default_rng(seed)
    occupied = np.pad(draw.random((5, 7)) < 0.3, 1, constant_values=True)
    occupied[1, 1] = False
    letters = np.where(occupied, 0, draw.integers(0, 1 << len(NAMES), EXTENT))
    return pad_world(make_world(occupied, letters, (1, 1), propositions=NAMES), *SHAPE)


def _view(world, seed):
    """A belief that knows some cells, and a painting of random colours on some."""
    draw = np.random.default_rng((seed, 1))
    inside = np.arange(SHAPE[0])[:, None] < EXTENT[0]
    inside = inside & (np.arange(SHAPE[1]) < EXTENT[1])
    known, painted = inside & (draw.random(SHAPE) < 0.6), inside & (draw.random(SHAPE) < 0.5)
    cells = np.where(known, np.asarray(world.occupied).astype(np.int8), np.int8(-1))
    belief = belief_from_numpy(cells, np.where(known, np.asarray(world.letters), 0), 1.0, EXTENT, NAMES)
    colours = draw.integers(0, 256, (2, *SHAPE, 3)) * painted[None, :, :, None]
    distance = np.where(painted, draw.uniform(0, 300, SHAPE), np.inf).astype(np.float32)
    floor, beyond = jnp.asarray(colours.astype(np.uint8))
    return belief, Painting(floor=floor, beyond=beyond, distance=jnp.asarray(distance))


@pytest.mark.parametrize("seed", range(5))
def test_views_come_back_with_their_padding(seed):
    world = _world(seed)
    belief, painting = _view(world, seed)
    found = decode_view(encode_view(belief, painting), encode_world(world), SHAPE)
    assert found.extent == EXTENT
    np.testing.assert_array_equal(found.cells, belief.cells)
    np.testing.assert_array_equal(found.letters, belief.letters)
    np.testing.assert_array_equal(found.floor, painting.floor)
    np.testing.assert_array_equal(found.beyond, painting.beyond)
    np.testing.assert_allclose(found.distance, painting.distance, atol=1 / 64 + 1e-4)
    np.testing.assert_array_equal(found.true_cells, np.asarray(world.occupied).astype(np.int8))
    np.testing.assert_array_equal(found.true_letters, world.letters)


def test_what_a_log_does_not_show_is_unknown():
    world, unseen = _world(0), np.zeros(SHAPE, bool)
    unseen[2, 3] = unseen[4, 1] = True
    view = encode_view(*_view(world, 0))
    found = decode_view(view, encode_world(world, unseen), SHAPE)
    np.testing.assert_array_equal(found.true_cells == -1, unseen)


def test_a_view_without_painting_keeps_what_is_known():
    world = _world(1)
    view = encode_view(*_view(world, 1))
    assert np.any(decode_view(view, encode_world(world), SHAPE).floor)
    found = decode_view(without_painting(view), encode_world(world), SHAPE)
    assert not np.any(found.floor)
    assert not np.any(found.beyond)
    assert np.all(np.isinf(found.distance))
    assert (without_painting(view).cells, without_painting(view).letters) == (view.cells, view.letters)


def test_images_that_are_none_or_of_another_size_are_refused():
    world = _world(2)
    view = encode_view(*_view(world, 2))
    with pytest.raises(DatasetError, match="a map of the dataset"):
        decode_view(dataclasses.replace(view, cells=view.cells[:40]), encode_world(world), SHAPE)
    with pytest.raises(
        DatasetError, match=r"a world of \(7, 9\) cells is larger than the data set's arrays of \(7, 8\)"
    ):
        decode_view(view, encode_world(world), (7, 8))
    other = cv2.imencode(".png", np.zeros((3, 3), np.uint8))[1].tobytes()
    with pytest.raises(DatasetError, match=r"has \(3, 3\) cells; its world has \(7, 9\)"):
        decode_view(dataclasses.replace(view, letters=other), encode_world(world), SHAPE)
