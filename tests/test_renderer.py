"""The renderer against a slow ray caster, and what must hold of any picture."""

import dataclasses
import functools
import itertools
import math

import chex
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.world.camera import CameraConfig, bearing, roll_to
from potlp_jax.world.equirectangular import from_equirectangular
from potlp_jax.world.grid import Appearance, World, make_world, pad_world
from potlp_jax.world.renderer import render
from tests.reference import renderer as reference

SMALL = CameraConfig(height=36, width=64, horizon=13.0, fold=4.5)
PLAIN = dataclasses.replace(SMALL, texture=0.0)

Look = np.ndarray | float | tuple[int, int, int]

look = jax.jit(render, static_argnums=2)


def cell_of(row: int, column: int) -> jax.Array:
    return jnp.asarray(np.array([row, column], np.int32))


def random_world(seed: int, shape: tuple[int, int] = (11, 17), density: float = 0.15) -> World:
    rng = np.random.default_rng(seed)
    occupied = rng.random(shape) < density
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    start = (int(rng.integers(1, shape[0] - 1)), int(rng.integers(1, shape[1] - 1)))
    occupied[start] = False
    appearance = Appearance(
        floor_colour=jnp.asarray(rng.integers(0, 256, (*shape, 3), np.uint8)),
        wall_colour=jnp.asarray(rng.integers(0, 256, (*shape, 3), np.uint8)),
        smoke=jnp.asarray((rng.random(shape) ** 4).astype(np.float32)),
        light=jnp.asarray(rng.random(shape, np.float32)),
    )
    return make_world(occupied, np.zeros(shape, np.int32), start, appearance=appearance)


def room(height: int, width: int, **looks: Look) -> World:
    """An empty room; ``looks`` replaces fields of its plain appearance, a number for the whole field."""
    occupied = np.ones((height, width), bool)
    occupied[1:-1, 1:-1] = False
    return make_world(occupied, np.zeros((height, width), np.int32), (1, 1), appearance=dressed(height, width, **looks))


def dressed(height: int, width: int, **looks: Look) -> Appearance:
    plain = Appearance.plain(height, width)
    changes = {
        name: jnp.broadcast_to(jnp.asarray(value, getattr(plain, name).dtype), getattr(plain, name).shape)
        for name, value in looks.items()
    }
    return dataclasses.replace(plain, **changes)


def assert_alike(found: np.ndarray, wanted: np.ndarray, levels: int, share: float) -> None:
    """At most ``share`` of the pixels differ by more than ``levels`` of 255."""
    assert found.shape == wanted.shape
    apart = np.abs(np.asarray(found).astype(int) - np.asarray(wanted).astype(int)).max(axis=-1)
    assert np.mean(apart > levels) <= share, f"{np.mean(apart > levels):.2%} of the pixels differ, up to {apart.max()}"


@pytest.mark.parametrize("seed", range(6))
def test_a_picture_is_what_the_slow_ray_caster_sees(seed):
    world = random_world(seed, density=0.05 + 0.05 * (seed % 3))
    found = look(world, world.start, SMALL)
    # Light, smoke and transmission are rounded; a pixel on the edge of a joint may fall on either side of it.
    assert_alike(found, reference.render(world, tuple(np.asarray(world.start).tolist()), SMALL), 2, 0.004)


def test_a_picture_of_another_geometry_is_what_the_slow_ray_caster_sees():
    config = CameraConfig(
        height=21, width=40, horizon=10.5, far=8.0, fold=5.0, eye_height=0.7, wall_height=3.1, texture=0.6, ambient=0.4
    )
    world = random_world(7)
    wanted = reference.render(world, tuple(np.asarray(world.start).tolist()), config)
    # The middle row looks along the horizon, where the reference meets no floor.
    assert_alike(look(world, world.start, config), wanted, 2, 0.006)


def test_eager_equals_jit_and_vmap_equals_a_loop():
    worlds = [random_world(seed) for seed in range(3)]
    cells = jnp.stack([world.start for world in worlds])
    single = np.stack([look(world, cell, SMALL) for world, cell in zip(worlds, cells, strict=True)])
    np.testing.assert_array_equal(render(worlds[0], cells[0], SMALL), single[0])
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    batch = jax.jit(jax.vmap(functools.partial(render, config=SMALL)))
    np.testing.assert_array_equal(batch(together, cells), single)


def test_vmap_over_cells_and_over_worlds_apart():
    worlds = [random_world(seed, density=0.0) for seed in range(2)]
    cells = jnp.asarray(np.array([[1, 1], [5, 9], [9, 15]], np.int32))
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    by_cell = jax.vmap(functools.partial(render, config=SMALL), in_axes=(None, 0))
    pictures = jax.jit(jax.vmap(by_cell, in_axes=(0, None)))(together, cells)
    for i, world in enumerate(worlds):
        for j in range(3):
            np.testing.assert_array_equal(pictures[i, j], look(world, cells[j], SMALL))


def test_a_batch_can_be_lowered_for_an_accelerator():
    world = random_world(0)
    batch = jax.jit(jax.vmap(lambda cell: render(world, cell, SMALL)))
    exported = jax.export.export(batch, platforms=["cuda"])(jnp.stack([world.start] * 4))
    assert exported.out_avals[0].shape == (4, SMALL.height, SMALL.width, 3)


def test_clear_air_hides_nothing_over_a_long_way():
    # The middle row looks along the horizon; the end wall is met at a right angle, and only along the bearing 0.
    config = dataclasses.replace(PLAIN, height=3, horizon=1.5, width=4096)
    picture = np.asarray(look(room(3, 400, wall_colour=255), cell_of(1, 1), config))
    assert picture[1, 2048].tolist() == [255, 255, 255]


def test_one_trace_for_all_worlds_and_cells():
    traced = jax.jit(chex.assert_max_traces(render, n=1), static_argnums=2)
    for seed in range(3):
        world = random_world(seed)
        traced(world, world.start, SMALL)


def test_turning_the_world_by_a_quarter_rolls_the_picture_by_a_quarter():
    world = random_world(3)
    row, column = np.asarray(world.start).tolist()
    turn = functools.partial(np.rot90, k=-1)
    appearance = jax.tree.map(lambda field: jnp.asarray(turn(np.asarray(field)).copy()), world.appearance)
    turned = make_world(
        turn(np.asarray(world.occupied)).copy(),
        np.zeros((17, 11), np.int32),
        (column, world.shape[0] - 1 - row),
        appearance=appearance,
    )
    rolled = np.roll(np.asarray(look(world, world.start, SMALL)), SMALL.width // 4, axis=1)
    assert_alike(look(turned, turned.start, SMALL), rolled, 1, 0.004)


def test_padding_the_world_changes_no_pixel():
    world = random_world(4)
    padded = pad_world(world, 19, 23)
    assert_alike(look(padded, padded.start, SMALL), look(world, world.start, SMALL), 0, 0.0)


def test_smoke_hides_by_the_law_of_beer_and_lambert():
    density = 0.04
    world = room(13, 60, floor_colour=0, wall_colour=0, smoke=density)
    picture = np.asarray(look(world, cell_of(6, 1), PLAIN))
    column = SMALL.width // 2
    turn = 1 / math.cos(reference.bearing_of(column, SMALL))
    checked = 0
    for row in range(math.ceil(SMALL.horizon), SMALL.height):
        distance = SMALL.eye_height / -reference.slope_of(row, SMALL)
        if distance < 57.5 * turn:
            expected = SMALL.smoke_colour[0] * (1 - math.exp(-density * distance))
            assert abs(int(picture[row, column, 0]) - expected) <= 1
            checked += 1
    assert checked >= 15
    below = picture[math.ceil(SMALL.horizon) :, column, 0].astype(int)
    assert (np.diff(below) <= 0).all()
    assert below[0] > 200 > 30 > below[-1]


def test_more_smoke_makes_a_dark_scene_brighter_everywhere():
    pictures = [
        np.asarray(look(room(9, 30, floor_colour=30, wall_colour=40, smoke=smoke), cell_of(4, 6), SMALL)).astype(int)
        for smoke in (0.0, 0.02, 0.1, 0.4, 1.0)
    ]
    for less, more in itertools.pairwise(pictures):
        assert (more >= less).all()
        assert (more > less).mean() > 0.5


def two_rooms(door: bool, **looks: Look) -> World:
    """A room of 8 columns on each side of the wall in column 9; the door is in row 5."""
    occupied = np.ones((11, 19), bool)
    occupied[1:-1, 1:-1] = False
    occupied[:, 9] = True
    occupied[5, 9] = not door
    return make_world(occupied, np.zeros((11, 19), np.int32), (5, 2), appearance=dressed(11, 19, **looks))


def test_a_lit_room_is_seen_through_its_door_from_a_dark_one():
    light = np.zeros((11, 19), np.float32)
    light[:, 10:] = 1.0
    opened = np.asarray(look(two_rooms(True, light=light), cell_of(5, 2), PLAIN)).astype(int)
    closed = np.asarray(look(two_rooms(False, light=light), cell_of(5, 2), PLAIN)).astype(int)
    brightest_dark = PLAIN.ambient * 205
    assert closed.max() <= brightest_dark + 1
    lit = opened.max(axis=(0, 2)) > 2 * brightest_dark
    columns = np.flatnonzero(lit)
    # The far room is lit from column 10 on; it is seen between the posts of a door one cell wide, seven cells away.
    bearings = np.array([reference.bearing_of(column, PLAIN) for column in range(PLAIN.width)])
    np.testing.assert_array_equal(
        columns, np.flatnonzero(np.abs(np.tan(bearings)) * 7.5 < 0.5 * (np.cos(bearings) > 0))
    )
    np.testing.assert_array_equal(opened[:, ~lit], closed[:, ~lit])


def test_what_is_behind_a_closed_wall_changes_no_pixel():
    rng = np.random.default_rng(0)
    seen = look(two_rooms(False), cell_of(5, 2), SMALL)
    fields = {
        "floor_colour": rng.integers(0, 256, (11, 19, 3), np.uint8),
        "wall_colour": rng.integers(0, 256, (11, 19, 3), np.uint8),
        "smoke": rng.random((11, 19), np.float32),
        "light": rng.random((11, 19), np.float32),
    }
    plain = Appearance.plain(11, 19)
    for name, values in fields.items():
        values[:, :10] = np.asarray(getattr(plain, name))[:, :10]
    other = two_rooms(False, **fields)
    np.testing.assert_array_equal(look(other, cell_of(5, 2), SMALL), seen)
    assert (
        np.asarray(look(other, cell_of(5, 12), SMALL)) != np.asarray(look(two_rooms(False), cell_of(5, 12), SMALL))
    ).any()


@pytest.mark.parametrize("seed", range(3))
def test_cells_that_no_ray_enters_and_letters_change_no_pixel(seed):
    world = random_world(seed, (15, 25), density=0.12)
    row, column = np.asarray(world.start).tolist()
    hidden = ~reference.cells_seen(world, (row, column), SMALL)
    assert 0.1 < hidden.mean() < 0.95
    other = random_world(seed + 100, (15, 25), density=0.6)
    appearance = jax.tree.map(
        lambda mine, theirs: jnp.where(hidden.reshape(hidden.shape + (1,) * (mine.ndim - 2)), theirs, mine),
        world.appearance,
        other.appearance,
    )
    changed = dataclasses.replace(
        world,
        occupied=jnp.where(hidden, other.occupied, world.occupied),
        letters=jnp.full_like(world.letters, 3),
        appearance=appearance,
    )
    assert bool((changed.occupied != world.occupied).any())
    np.testing.assert_array_equal(look(changed, world.start, SMALL), look(world, world.start, SMALL))


def test_the_smallest_world_and_the_corners_of_a_large_one():
    one_cell = room(3, 3, wall_colour=(200, 0, 0), floor_colour=(0, 200, 0))
    picture = np.asarray(look(one_cell, cell_of(1, 1), PLAIN))
    middle = picture[int(PLAIN.horizon)]
    assert (middle[:, 0] >= 140).all()
    assert (middle[:, 1:] == 0).all()
    long = room(4, 90)
    for row, column in ((1, 1), (1, 88), (2, 1), (2, 88)):
        wanted = reference.render(long, (row, column), SMALL)
        assert_alike(look(long, cell_of(row, column), SMALL), wanted, 2, 0.004)


@pytest.mark.parametrize("target", [(10, 16), (2, 10), (10, 3), (17, 8), (3, 3)])
def test_a_thing_stands_at_its_bearing(target):
    world = room(21, 21)
    occupied = np.asarray(world.occupied).copy()
    occupied[target] = True
    colour = np.asarray(world.appearance.wall_colour).copy()
    colour[target] = (255, 0, 0)
    world = make_world(occupied, np.zeros((21, 21), np.int32), (10, 10), appearance=dressed(21, 21, wall_colour=colour))
    config = CameraConfig(texture=0.0)
    picture = look(world, cell_of(10, 10), config)
    towards = bearing(cell_of(10, 10), cell_of(*target))
    assert float(towards) == pytest.approx(math.atan2(target[0] - 10, target[1] - 10), abs=1e-6)
    red = np.asarray(roll_to(picture, towards))[int(config.horizon), :, 1] == 0
    columns = np.flatnonzero(red)
    assert len(columns) > 5
    assert abs(columns.mean() + 0.5 - config.width / 2) <= 1.5


def coloured_room() -> World:
    """Walls of eight colours and a striped floor, so that a picture that is turned or mirrored is told apart."""
    rows, columns = np.indices((13, 17))
    palette = np.array([[220, 40, 40], [40, 200, 60], [50, 60, 220], [220, 210, 60]], np.uint8)
    walls = palette[(rows > 6) * 2 + (columns > 8)]
    return room(13, 17, wall_colour=walls, floor_colour=palette[columns // 4 % 4] // 2)


@pytest.mark.parametrize(("field", "height"), [(math.pi, 256), (2.6, 208)])
def test_an_equirectangular_picture_is_mapped_to_the_panorama(field, height):
    world = coloured_room()
    source = reference.render_equirectangular(world, (4, 6), PLAIN, (height, 256), field)
    found = from_equirectangular(source, PLAIN, vertical_field=field)
    # Pixels on the edge between two colours are mixed by the sampling.
    assert_alike(found, np.asarray(look(world, cell_of(4, 6), PLAIN)), 16, 0.2)
    turned = from_equirectangular(np.roll(source, -64, axis=1), PLAIN, yaw=math.pi / 2, vertical_field=field)
    np.testing.assert_array_equal(turned, found)
    mirrored = from_equirectangular(source[:, ::-1].copy(), PLAIN, vertical_field=field)
    assert np.mean(np.abs(mirrored.astype(int) - found.astype(int)).max(axis=-1) > 16) > 0.3


def test_rows_beyond_the_field_repeat_the_outermost():
    source = np.repeat(np.arange(40, 240, 2, dtype=np.uint8)[:, None, None], 200, axis=1).repeat(3, axis=2)
    found = from_equirectangular(source, SMALL, vertical_field=0.5)
    assert (found[-1] == 238).all()
    assert (found[0] == 40).all() == (math.atan(reference.slope_of(0, SMALL)) > 0.25)


def test_bad_pictures_and_fields_are_refused():
    with pytest.raises(ValueError, match=r"uint8\[h, w, 3\]"):
        from_equirectangular(np.zeros((0, 4, 3), np.uint8), SMALL)
    with pytest.raises(ValueError, match="vertical_field"):
        from_equirectangular(np.zeros((4, 8, 3), np.uint8), SMALL, vertical_field=3.5)
