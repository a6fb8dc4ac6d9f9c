"""What is painted on the map, against a loop over cells, and against a rendered room whose colours are known."""

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.learning.painting import Painting, blank_painting, moved_painting, paint
from potlp_jax.world.camera import CameraConfig, column_bearings, floor_rows
from potlp_jax.world.grid import Appearance, BeliefMap, belief_from_numpy, make_world
from potlp_jax.world.renderer import obstacle_distances, render
from potlp_jax.world.sensing import SensorConfig, observe

CAMERA = CameraConfig(height=64, width=128, horizon=24.0, fold=8.0, texture=0.0)
paint_jit = jax.jit(paint, static_argnames=("camera", "glances"))


def _room(rows: int = 14, columns: int = 20) -> np.ndarray:
    occupied = np.ones((rows, columns), bool)
    occupied[1:-1, 1:-1] = False
    occupied[4:9, 8] = True
    return occupied


def _belief(occupied: np.ndarray, unknown_from: int) -> BeliefMap:
    cells = np.where(occupied, BeliefMap.OCCUPIED, BeliefMap.FREE).astype(np.int8)
    cells[:, unknown_from:] = BeliefMap.UNKNOWN
    return belief_from_numpy(cells, np.zeros(cells.shape, np.int32))


def _walk(occupied: np.ndarray, cell: tuple[int, int], bearing: float) -> float:
    """How far one walks from a cell's middle along a bearing before one stands in an obstacle or outside."""
    for step in itertools.count():
        away = step * 1e-3
        row, column = (
            round(at + away * turn) for at, turn in zip(cell, (math.sin(bearing), math.cos(bearing)), strict=True)
        )
        inside = 0 <= row < occupied.shape[0] and 0 <= column < occupied.shape[1]
        if not inside or (occupied[row, column] and (row, column) != cell):
            return away
    raise AssertionError


def _met_by_lines(occupied: np.ndarray, cell: tuple[int, int], bearings: np.ndarray) -> dict[tuple[int, int], set]:
    """By cell the columns whose lines meet it before, or where, they meet an obstacle."""
    found: dict[tuple[int, int], set] = {}
    for column, bearing in enumerate(bearings):
        for step in itertools.count():
            row, at = (
                round(start + step * 1e-3 * turn)
                for start, turn in zip(cell, (math.sin(bearing), math.cos(bearing)), strict=True)
            )
            if not (0 <= row < occupied.shape[0] and 0 <= at < occupied.shape[1]):
                break
            found.setdefault((row, at), set()).add(column)
            if occupied[row, at] and (row, at) != cell:
                break
    return found


def _slow_paint(
    painting: Painting, panorama: np.ndarray, belief: BeliefMap, cell: tuple[int, int], *, glances: bool
) -> Painting:
    """Cell by cell: the column whose bearing is nearest, the row of the floor at the cell's distance."""
    floor, beyond = np.array(painting.floor), np.array(painting.beyond)
    distance, occupied = np.array(painting.distance), np.asarray(belief.occupied)
    bearings = column_bearings(CAMERA)
    met = _met_by_lines(occupied, cell, bearings) if glances else {}
    for row, column in np.ndindex(*distance.shape):
        away = math.hypot(row - cell[0], column - cell[1])
        if away >= distance[row, column]:
            continue
        angle = math.atan2(row - cell[0], column - cell[1])
        apart = np.abs((bearings - angle + math.pi) % (2 * math.pi) - math.pi)
        # On the border of two columns both are as near: the one that begins there.
        nearest = np.flatnonzero(apart <= apart.min() + 1e-6)
        chosen = nearest[-1] if nearest[0] != 0 or len(nearest) == 1 else nearest[0]
        # Of an obstacle its side is seen, at most half a diagonal before its middle.
        if away > _walk(occupied, cell, bearings[chosen]) + (math.sqrt(0.5) if occupied[row, column] else 0.0):
            if (row, column) not in met:
                continue
            # Of two columns that are as far from the bearing the later one.
            turns = [(one - chosen + 64) % 128 - 64 for one in met[row, column]]
            chosen = (chosen + min(turns, key=lambda turn: (abs(turn), turn < 0))) % 128
        line = round(float(floor_rows(CAMERA, jnp.float32(away))))
        floor[row, column] = panorama[min(line, CAMERA.height - 1), chosen]
        beyond[row, column] = panorama[24, chosen]
        distance[row, column] = away
    return Painting(floor=jnp.asarray(floor), beyond=jnp.asarray(beyond), distance=jnp.asarray(distance))


@pytest.mark.long
@pytest.mark.parametrize("glances", [False, True])
@pytest.mark.parametrize("unknown_from", [20, 12])
def test_painting_is_what_a_loop_over_cells_paints(unknown_from, glances):
    random = np.random.default_rng(0)
    belief = _belief(_room(), unknown_from)
    fast, slow = blank_painting(14, 20), blank_painting(14, 20)
    for cell in ((3, 3), (10, 5), (2, 7)):
        panorama = random.integers(0, 256, (64, 128, 3)).astype(np.uint8)
        fast = paint_jit(fast, jnp.asarray(panorama), belief, jnp.asarray(cell), CAMERA, glances=glances)
        slow = _slow_paint(slow, panorama, belief, cell, glances=glances)
        np.testing.assert_allclose(fast.distance, slow.distance, rtol=1e-6)
        np.testing.assert_array_equal(fast.beyond, slow.beyond)
        np.testing.assert_array_equal(fast.floor, slow.floor)


def test_columns_look_as_far_as_a_walk_along_their_bearings():
    occupied = _room()
    # Without the outer wall on one side, the array's border ends the sight.
    occupied[:, -1] = False
    for cell in ((3, 3), (10, 5), (4, 9)):
        found = jax.jit(obstacle_distances, static_argnames="config")(jnp.asarray(occupied), jnp.asarray(cell), CAMERA)
        walked = [_walk(occupied, cell, bearing) for bearing in column_bearings(CAMERA)]
        np.testing.assert_allclose(found, walked, atol=2e-3)


def test_the_corner_of_a_wall_does_not_paint_what_it_hides():
    """A grazing look past a corner: seen cells keep their colour when the next look meets the corner."""
    occupied = np.ones((30, 30), bool)
    occupied[1:-1, 15:-1] = occupied[18:24, 1:16] = False
    red, corner = np.zeros((30, 30, 3), np.uint8), np.full((30, 30, 3), (30, 30, 200), np.uint8)
    red[:, :, 0] = 200
    look = Appearance(
        floor_colour=jnp.asarray(red),
        wall_colour=jnp.asarray(corner),
        smoke=jnp.zeros((30, 30)),
        light=jnp.ones((30, 30)),
    )
    world = make_world(occupied, np.zeros(occupied.shape, np.int32), (3, 20), appearance=look)
    belief, painting = BeliefMap.unobserved(world), blank_painting(30, 30)
    for cell in ((3, 20), (3, 19), (3, 18), (3, 17), (3, 16), (3, 15)):
        at = jnp.array(cell)
        belief = observe(belief, world, at, SensorConfig(range_cells=60.0))
        painting = paint_jit(painting, render(world, at, CAMERA), belief, at, CAMERA)
    floor = np.asarray(painting.floor).argmax(axis=2)
    seen = np.isfinite(np.asarray(painting.distance)) & ~occupied
    assert seen[18:24, 1:15].any()
    # Pixels are as high as several cells far away: one at the foot of a wall may show the wall.
    assert (floor[seen] > 0).mean() < 0.01


def test_cells_are_painted_from_the_column_that_looks_along_their_bearing():
    height, width, camera = 40, 70, CameraConfig()
    # Each column has a colour of its own, and nothing hides anything.
    panorama = np.zeros((camera.height, camera.width, 3), np.uint8)
    panorama[:, :, 0], panorama[:, :, 1] = np.arange(512) % 256, np.arange(512) // 256
    belief = BeliefMap.unobserved(make_world(_room(height, width), np.zeros((height, width), np.int32), (2, 2)))
    for cell in ((20, 31), (2, 2), (37, 68)):
        painting = paint_jit(blank_painting(height, width), jnp.asarray(panorama), belief, jnp.asarray(cell), camera)
        found = np.asarray(painting.floor, int)
        rows, columns = np.mgrid[:height, :width] - np.reshape(cell, (2, 1, 1))
        expected = np.floor((np.arctan2(rows, columns) + math.pi) * (512 / (2 * math.pi)) + 1e-9).astype(int) % 512
        np.testing.assert_array_equal(found[..., 0] + 256 * found[..., 1], expected)


def test_a_glance_paints_a_door_that_the_robot_passes_and_its_middle_does_not_show():
    """A dark room below a lit hallway, its door two cells deep and seen from aside."""
    occupied = np.ones((16, 30), bool)
    occupied[2:6, 1:-1] = occupied[8:14, 10:20] = occupied[6:8, 15] = False
    light = np.ones(occupied.shape, np.float32)
    light[6:] = 0.0
    look = dataclasses.replace(Appearance.plain(16, 30), light=jnp.asarray(light))
    world = make_world(occupied, np.zeros(occupied.shape, np.int32), (5, 4), appearance=look)
    at = jnp.array([5, 11])
    belief = observe(BeliefMap.unobserved(world), world, at, SensorConfig(range_cells=60.0))
    picture = render(world, at, CAMERA)
    plain, glanced = (
        paint_jit(blank_painting(16, 30), picture, belief, at, CAMERA, glances=glances) for glances in (False, True)
    )
    door = (6, 15)
    assert bool(belief.free[door])
    assert not np.isfinite(plain.distance[door])
    assert np.isfinite(glanced.distance[door])
    # At eye height the far side of the door frame, which has the light of the door.
    assert int(glanced.beyond[door].max()) < 60 < int(glanced.beyond[3, 11].max())
    # What the middle shows stays as it is.
    seen = np.isfinite(np.asarray(plain.distance))
    np.testing.assert_array_equal(np.asarray(glanced.floor)[seen], np.asarray(plain.floor)[seen])
    np.testing.assert_array_equal(np.asarray(glanced.beyond)[seen], np.asarray(plain.beyond)[seen])


def _coloured_world():
    """A room with a green floor on the right, red on the left, and blue walls."""
    occupied = _room()
    floor = np.zeros((14, 20, 3), np.uint8)
    floor[:, :10], floor[:, 10:] = (200, 30, 30), (30, 200, 30)
    look = Appearance(
        floor_colour=jnp.asarray(floor),
        wall_colour=jnp.asarray(np.full((14, 20, 3), (30, 30, 200), np.uint8)),
        smoke=jnp.zeros((14, 20)),
        light=jnp.ones((14, 20)),
    )
    return make_world(occupied, np.zeros(occupied.shape, np.int32), (2, 2), appearance=look)


def test_floors_and_walls_have_their_colours():
    """Beyond the sensor's range too, as far as nothing known stands in between."""
    world = _coloured_world()
    cell = jnp.array([2, 4])
    belief = observe(BeliefMap.unobserved(world), world, cell, SensorConfig(range_cells=6.0))
    assert bool(belief.unknown[2, 15])
    painting = paint_jit(blank_painting(14, 20), render(world, cell, CAMERA), belief, cell, CAMERA)
    floor, beyond = np.asarray(painting.floor).argmax(axis=2), np.asarray(painting.beyond).argmax(axis=2)
    assert floor[2, 6] == floor[1, 8] == 0
    assert floor[2, 13] == floor[2, 15] == 1
    # At eye height there is a wall in every direction.
    assert set(beyond[np.isfinite(painting.distance)].tolist()) == {2}
    # The wall in the middle of the room is known by now, and what it hides stays blank.
    blank = ~np.isfinite(np.asarray(painting.distance))
    assert bool(belief.occupied[5, 8])
    assert blank[7, 12]
    assert not np.asarray(painting.floor)[7, 12].any()


def test_a_nearer_look_replaces_one_from_afar_and_a_farther_one_does_not():
    belief = _belief(_room(), 20)
    far, near = (np.full((64, 128, 3), value, np.uint8) for value in (10, 90))
    first = paint_jit(blank_painting(14, 20), jnp.asarray(far), belief, jnp.array([2, 2]), CAMERA)
    both = paint_jit(first, jnp.asarray(near), belief, jnp.array([2, 15]), CAMERA)
    assert np.asarray(both.floor)[2, 14, 0] == 90
    assert np.asarray(both.floor)[2, 3, 0] == 10
    again = paint_jit(both, jnp.asarray(far), belief, jnp.array([2, 2]), CAMERA)
    np.testing.assert_array_equal(again.floor, both.floor)


@pytest.mark.parametrize("horizon", [-3.0, 24.0, 200.0])
def test_a_picture_without_a_horizon_gives_its_nearest_row(horizon):
    camera = CameraConfig(height=64, width=128, horizon=horizon, fold=8.0)
    panorama = np.zeros((64, 128, 3), np.uint8)
    panorama[:, :, 0] = np.arange(64)[:, None]
    at = jnp.array([3, 3])
    painting = paint_jit(blank_painting(14, 20), jnp.asarray(panorama), _belief(_room(), 20), at, camera)
    seen = np.isfinite(np.asarray(painting.distance))
    assert set(np.asarray(painting.beyond)[seen][:, 0].tolist()) == {int(np.clip(horizon, 0, 63))}


def test_a_panorama_of_another_size_than_the_camera_s_is_refused():
    with pytest.raises(ValueError, match=r"shape \(64, 64, 3\), must be \(64, 128, 3\)"):
        paint(
            blank_painting(14, 20), jnp.zeros((64, 64, 3), jnp.uint8), _belief(_room(), 20), jnp.array([3, 3]), CAMERA
        )


def test_a_map_that_outgrows_its_array_keeps_what_was_painted_on_it():
    """Against a painting that had the larger array from the start, where both have cells."""
    rng, (top, left) = np.random.default_rng(4), (3, 5)
    small = _belief(_room(), unknown_from=15)
    pad = ((top, 2), (left, 4))
    large = belief_from_numpy(
        np.pad(np.asarray(small.cells), pad, constant_values=BeliefMap.UNKNOWN), np.pad(np.asarray(small.letters), pad)
    )
    found, wanted = blank_painting(*small.cells.shape), blank_painting(*large.cells.shape)
    for cell in ((3, 3), (10, 12)):
        panorama = jnp.asarray(rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3), np.uint8))
        found = paint_jit(found, panorama, small, jnp.array(cell, jnp.int32), camera=CAMERA)
        there = jnp.array([cell[0] + top, cell[1] + left], jnp.int32)
        wanted = paint_jit(wanted, panorama, large, there, camera=CAMERA)
    found = moved_painting(found, large.cells.shape, top, left)
    had = np.s_[top : top + small.cells.shape[0], left : left + small.cells.shape[1]]
    for one, other, nothing in zip(
        jax.tree.leaves(found),
        jax.tree.leaves(wanted),
        jax.tree.leaves(blank_painting(*large.cells.shape)),
        strict=True,
    ):
        np.testing.assert_array_equal(one[had], other[had])
        rest = np.ones(large.cells.shape, bool)
        rest[had] = False
        np.testing.assert_array_equal(np.asarray(one)[rest], np.asarray(nothing)[rest])
    assert np.isfinite(np.asarray(found.distance)).sum() > 100
