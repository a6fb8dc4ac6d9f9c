"""Worlds are checked and closed; padding, beliefs and the written form lose nothing."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.errors import WorldError
from potlp_jax.world.grid import (
    Appearance,
    BeliefMap,
    World,
    belief_from_numpy,
    make_world,
    pad_world,
    world_from_dict,
    world_to_dict,
)

NAMES = tuple(f"p{bit}" for bit in range(16))


def closed(height: int = 5, width: int = 7) -> np.ndarray:
    occupied = np.ones((height, width), bool)
    occupied[1:-1, 1:-1] = False
    return occupied


def coloured(height: int, width: int, seed: int = 0) -> Appearance:
    rng = np.random.default_rng(seed)
    return Appearance(
        floor_colour=jnp.asarray(rng.integers(0, 256, (height, width, 3), dtype=np.uint8)),
        wall_colour=jnp.asarray(rng.integers(0, 256, (height, width, 3), dtype=np.uint8)),
        smoke=jnp.asarray(rng.random((height, width), np.float32)),
        light=jnp.asarray(rng.random((height, width), np.float32)),
    )


def assert_same(left: World, right: World) -> None:
    for one, other in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_a_closed_world_is_taken_as_it_is():
    letters = np.zeros((5, 7), np.int64)
    letters[2, 3] = 5
    world = make_world(closed(), letters, (1, 1), resolution=0.25, propositions=NAMES[:3])
    np.testing.assert_array_equal(world.occupied, closed())
    np.testing.assert_array_equal(world.letters, letters)
    assert world.start.tolist() == [1, 1]
    assert float(world.resolution) == 0.25
    assert world.shape == (5, 7)


@pytest.mark.parametrize("opening", [(0, 3), (4, 3), (2, 0), (2, 6), (0, 0)])
def test_an_open_border_gets_a_ring_of_obstacles(opening):
    occupied, letters = closed(), np.zeros((5, 7), np.int32)
    occupied[opening] = False
    letters[2, 3] = 1
    look = coloured(5, 7)
    world = make_world(occupied, letters, (2, 3), appearance=look, propositions=NAMES[:1])
    assert world.shape == (7, 9)
    assert np.asarray(world.occupied)[[0, -1]].all()
    assert np.asarray(world.occupied)[:, [0, -1]].all()
    np.testing.assert_array_equal(np.asarray(world.occupied)[1:-1, 1:-1], occupied)
    assert world.start.tolist() == [3, 4]
    assert int(world.letters[3, 4]) == 1
    assert int(world.letters.sum()) == 1
    np.testing.assert_array_equal(np.asarray(world.appearance.smoke)[1:-1, 1:-1], look.smoke)
    np.testing.assert_array_equal(np.asarray(world.appearance.floor_colour)[1:-1, 1:-1], look.floor_colour)
    assert np.asarray(world.appearance.light)[0, 0] == 1.0
    assert np.asarray(world.appearance.smoke)[0, 0] == 0.0


def test_letters_on_obstacles_are_dropped():
    letters = np.full((5, 7), 3)
    world = make_world(closed(), letters, (1, 1), propositions=NAMES[:2])
    np.testing.assert_array_equal(world.letters, np.where(closed(), 0, 3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": (0, 0)}, r"start \(0, 0\) is an obstacle"),
        ({"start": (5, 1)}, r"start \(5, 1\) lies outside of the 5x7 grid"),
        ({"start": (-1, 1)}, "lies outside"),
        ({"letters": np.zeros((5, 6), np.int32)}, "must have one shape"),
        ({"occupied": np.ones((5, 8), bool)}, "must have one shape"),
        ({"letters": np.full((5, 7), -1)}, r"letters of \(\) must lie in 0..0"),
        ({"letters": np.full((5, 7), 4), "propositions": NAMES[:2]}, r"letters of \(p0, p1\) must lie in 0..3"),
        ({"resolution": 0.0}, "resolution must be a positive number"),
        ({"resolution": float("nan")}, "resolution must be a positive number"),
        ({"resolution": float("inf")}, "resolution must be a positive number"),
        ({"appearance": Appearance.plain(5, 6)}, "floor_colour must be uint8"),
    ],
)
def test_bad_worlds_are_refused(change, message):
    arguments = {"occupied": closed(), "letters": np.zeros((5, 7), np.int32), "start": (1, 1), **change}
    with pytest.raises(WorldError, match=message):
        make_world(**arguments)


def test_padding_adds_obstacles_below_and_to_the_right():
    letters = np.zeros((5, 7), np.int32)
    letters[1, 2] = 2
    world = make_world(closed(), letters, (3, 5), 0.5, coloured(5, 7), NAMES[:2])
    padded = pad_world(world, 6, 11)
    assert padded.shape == (6, 11)
    assert padded.extent.tolist() == [5, 7]
    inside = jax.tree.map(lambda leaf: leaf[:5, :7] if leaf.ndim > 1 else leaf, padded)
    assert_same(world, inside)
    assert np.asarray(padded.occupied)[5:].all()
    assert np.asarray(padded.occupied)[:, 7:].all()
    assert int(padded.letters.sum()) == 2
    assert padded.appearance.wall_colour.shape == (6, 11, 3)
    with pytest.raises(WorldError, match="5x7 cells cannot be padded to 4x9"):
        pad_world(world, 4, 9)


def test_beliefs_at_both_ends_of_knowledge():
    letters = np.zeros((5, 7), np.int32)
    letters[2, 2] = 4
    world = make_world(closed(), letters, (1, 1), 0.1, propositions=NAMES[:3])
    nothing, everything = BeliefMap.unobserved(world), BeliefMap.revealed(world)
    assert bool(nothing.unknown.all())
    assert int(nothing.letters.sum()) == 0
    np.testing.assert_array_equal(everything.occupied, closed())
    np.testing.assert_array_equal(everything.free, ~closed())
    np.testing.assert_array_equal(everything.letters, letters)
    assert not bool(everything.unknown.any())
    assert float(nothing.resolution) == float(everything.resolution) == pytest.approx(0.1)
    assert everything.cells.dtype == jnp.int8


def test_beliefs_from_host_arrays():
    cells = np.array([[-1, 0, 1], [0, 0, -1]])
    letters = np.array([[0, 7, 0], [0, 0, 0]], np.int64)
    belief = belief_from_numpy(cells, letters, 2.0, propositions=NAMES[:3])
    with pytest.raises(WorldError, match="name every bit"):
        belief_from_numpy(cells, letters, 2.0, propositions=NAMES[:2])
    np.testing.assert_array_equal(belief.cells, cells)
    assert belief.cells.dtype == jnp.int8
    assert belief.letters.dtype == jnp.int32
    with pytest.raises(WorldError, match="must be -1, 0 or 1"):
        belief_from_numpy(np.array([[2, 0]]), np.zeros((1, 2), int))
    with pytest.raises(WorldError, match="not observed"):
        belief_from_numpy(np.array([[-1, 0]]), np.array([[1, 0]]))
    with pytest.raises(WorldError, match="resolution must be a positive number"):
        belief_from_numpy(np.array([[-1, 0]]), np.array([[0, 0]]), resolution=-1.0)


@pytest.mark.parametrize("shape", [(1, 5), (5, 1), (5,), (6, 6)])
def test_letters_of_a_belief_have_the_shape_of_its_cells(shape):
    with pytest.raises(WorldError, match=r"cells \(5, 5\) and letters .* must have one shape"):
        belief_from_numpy(np.zeros((5, 5), int), np.zeros(shape, int), propositions=NAMES[:1])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 9), st.integers(3, 9), st.sampled_from([1.0, 0.05, 1 / 3]))
def test_a_world_is_read_back_bit_for_bit(seed, height, width, resolution):
    rng = np.random.default_rng(seed)
    occupied = rng.random((height, width)) < 0.4
    occupied[height // 2, width // 2] = False
    letters = rng.integers(0, 2**16, (height, width))
    world = make_world(occupied, letters, (height // 2, width // 2), resolution, coloured(height, width, seed), NAMES)
    world = pad_world(world, 12, 13)
    again = world_from_dict(json.loads(json.dumps(world_to_dict(world), allow_nan=False)))
    assert_same(world, again)
    assert again.propositions == NAMES


@pytest.mark.parametrize("name", ["occupied", "letters", "start", "resolution", "extent", "appearance", "propositions"])
@pytest.mark.parametrize("value", [None, {}, "x", [1], {"shape": [1], "dtype": "<i4", "zlib": "AAAA"}])
def test_damaged_worlds_are_refused(name, value):
    data = world_to_dict(make_world(closed(), np.zeros((5, 7), int), (1, 1)))
    data[name] = value
    with pytest.raises(WorldError):
        world_from_dict(data)
    del data[name]
    with pytest.raises(WorldError, match=name):
        world_from_dict(data)


def test_worlds_stack_and_map():
    worlds = [make_world(closed(), np.full((5, 7), value), (1, 1), propositions=NAMES[:2]) for value in (1, 2)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    beliefs = jax.vmap(BeliefMap.revealed)(stack)
    for index, world in enumerate(worlds):
        np.testing.assert_array_equal(beliefs.letters[index], BeliefMap.revealed(world).letters)
    assert beliefs.free.shape == (2, 5, 7)
