"""Worlds on ROS maps: cleaning against a slow reference, and the family of worlds."""

import math
from fractions import Fraction

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.environments.ros.cleaning import clean_map
from potlp_jax.environments.ros.occupancy_map import load_map
from potlp_jax.environments.ros.places import Disc, Places
from potlp_jax.environments.ros.ros_map import RosMap, RosMapConfig, parse_spec
from potlp_jax.errors import MapError
from tests.reference.map_files import PLACES, TWO_ROOMS, drawn, occupancy_map, p5, write_map

# Cleaning.


def slow_clean(free, ratio, radius):
    """By the definition, pixel by pixel: {(row from the bottom, column)} of the largest component."""
    height, width = free.shape
    bottom_up = free[::-1]
    reach = math.ceil(radius)

    def is_blocked(row, col):
        return not (0 <= row < height and 0 <= col < width and bottom_up[row, col])

    def is_inflated(row, col):
        return any(
            dr * dr + dc * dc <= radius * radius and is_blocked(row + dr, col + dc)
            for dr in range(-reach, reach + 1)
            for dc in range(-reach, reach + 1)
        )

    def shares_area(cell, pixel):
        return cell * ratio < pixel + 1 and pixel < (cell + 1) * ratio

    cells = set()
    for row in range(math.ceil(height / ratio)):
        for col in range(math.ceil(width / ratio)):
            pixels = [
                (i, j)
                for i in range(height + 6)
                for j in range(width + 6)
                if shares_area(row, i) and shares_area(col, j)
            ]
            if not any(is_blocked(*pixel) or is_inflated(*pixel) for pixel in pixels):
                cells.add((row, col))
    components = []
    while cells:
        component, todo = set(), [cells.pop()]
        while todo:
            row, col = todo.pop()
            component.add((row, col))
            for neighbour in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
                if neighbour in cells:
                    cells.remove(neighbour)
                    todo.append(neighbour)
        components.append(component)
    return components


@settings(max_examples=50, deadline=None)
@given(
    st.integers(4, 12),
    st.integers(4, 12),
    st.sampled_from(["1", "1.5", "2", "2.3", "3"]),
    st.sampled_from(["0", "1", "1.2", "1.5"]),
    st.integers(0, 2**32 - 1),
)
def test_cleaning_equals_the_definition(height, width, ratio, radius, seed):
    free = np.random.default_rng(seed).random((height, width)) > 0.1
    components = slow_clean(free, Fraction(ratio), Fraction(radius))
    image_map = occupancy_map(free, pixel="0.1", origin=(3.0, -2.0, 0.0))
    size = float(Fraction(ratio) / 10)
    if not components:
        with pytest.raises(MapError, match="nothing is left free"):
            clean_map(image_map, size, float(Fraction(radius) / 10))
        return
    clean = clean_map(image_map, size, float(Fraction(radius) / 10))
    found = set()
    for row, col in np.argwhere(clean.free).tolist():
        x, y = clean.frame.cell_to_metres(row, col)
        found.add((round((y + 2) / size - 0.5), round((x - 3) / size - 0.5)))
    assert found in components
    assert len(found) == max(map(len, components))
    assert not clean.free[[0, -1]].any()
    assert not clean.free[:, [0, -1]].any()
    assert clean.free[[1, -2]].any(axis=1).all()
    assert clean.free[:, [1, -2]].any(axis=0).all()


def test_a_wall_one_pixel_thin_survives_and_a_door_stays_open():
    free = np.ones((40, 60), dtype=bool)
    free[:, 29] = False
    closed = clean_map(occupancy_map(free, pixel="0.05"), 0.35, 0.0)
    assert closed.frame.width * 0.35 < 2.3  # one of two rooms
    free[12:24, 29] = True  # 0.6 m: stays open with the defaults, wherever it lies
    for shift in range(4):
        both = clean_map(occupancy_map(np.roll(free, shift, axis=0), pixel="0.05"))
        assert both.frame.width * 0.2 > 2.6


def test_unknown_is_an_obstacle(tmp_path):
    loaded = load_map(write_map(tmp_path, p5([[254, 254, 205, 254], [254, 254, 205, 0]]), resolution=1))
    assert clean_map(loaded, 1.0, 0.0).free.tolist() == [[False] * 4, *[[False, True, True, False]] * 2, [False] * 4]


def test_no_corner_is_cut():
    clean = clean_map(occupancy_map(drawn("..##", "..##", "##..")), 1.0, 0.0)
    assert clean.free.sum() == 4


def test_the_component_of_the_start_is_kept():
    free = drawn("...#..", "...#..", "...#..")
    assert clean_map(occupancy_map(free), 1.0, 0.0).free.sum() == 9
    small = clean_map(occupancy_map(free), 1.0, 0.0, start=(4.5, 0.5))
    assert small.free.sum() == 6
    assert small.frame.metres_to_cell(4.5, 0.5) == (3, 1)
    with pytest.raises(MapError, match=r"start: \[3\.5, 0\.5\] is blocked.* nearest free cell is at \[\d\.50, 0\.50\]"):
        clean_map(occupancy_map(free), 1.0, 0.0, start=(3.5, 0.5))
    with pytest.raises(MapError, match=r"start: \[-1, 0\.5\] is outside of the map.* \[0\.50, 0\.50\]"):
        clean_map(occupancy_map(free), 1.0, 0.0, start=(-1.0, 0.5))


@pytest.mark.parametrize(
    ("resolution", "radius", "message"),
    [
        (0.5, 0.0, "resolution: 0.5 m a cell is finer than the map's 1.0 m a pixel"),
        (1e9, 0.0, "resolution: 1000000000.0 m a cell is more than the map has"),
        (math.nan, 0.0, "resolution: nan is not a finite number of metres"),
        (1.0, -1.0, "radius: -1.0 is not a finite number of metres"),
        (1.0, math.inf, "radius: inf is not a finite number of metres"),
        (1.0, 300.0, "nothing is left free with cells of 1.0 m and a radius of 300.0 m"),
    ],
)
def test_impossible_sizes(resolution, radius, message):
    with pytest.raises(MapError, match=message):
        clean_map(occupancy_map(TWO_ROOMS), resolution, radius)


def test_yaw_is_honoured_by_the_whole_map():
    """The same building in a turned frame: every place is found again."""
    yaw, corner = 3.14, (25.9, 48.5)
    straight = clean_map(occupancy_map(TWO_ROOMS), 1.0, 0.0)
    turned = clean_map(occupancy_map(TWO_ROOMS, origin=(*corner, yaw)), 1.0, 0.0)
    assert np.array_equal(straight.free, turned.free)
    cos, sin = math.cos(yaw), math.sin(yaw)
    for x, y in ((1.5, 1.5), (5.5, 2.5), (9.5, 4.5)):
        there = corner[0] + cos * x - sin * y, corner[1] + sin * x + cos * y
        assert turned.frame.metres_to_cell(*there) == straight.frame.metres_to_cell(x, y)


# The family of worlds.


@pytest.fixture
def two_rooms(tmp_path):
    """`TWO_ROOMS` on disk, a pixel a metre, with places beside it."""
    file = write_map(tmp_path, p5(np.where(TWO_ROOMS, 254, 0)), resolution=1)
    (tmp_path / "map.places.yaml").write_text(PLACES)
    return file


def test_worlds_differ_in_their_start_alone(two_rooms):
    family = RosMap.from_spec(f"map:{two_rooms},resolution=1,radius=0")
    assert family.propositions == ("document", "package")
    assert family.tasks == {"1": "F document & F package"}
    worlds = [family.generate(jax.random.key(seed)) for seed in range(60)]
    assert np.array_equal(worlds[0].occupied, ~TWO_ROOMS)
    assert float(worlds[0].resolution) == 1.0
    letters = np.zeros(TWO_ROOMS.shape, dtype=np.int32)
    letters[4, 1] = 1
    letters[3:5, 8:10] = 2
    letters[1, 9] = 2
    assert np.array_equal(worlds[0].letters, letters)
    starts = [tuple(np.asarray(world.start).tolist()) for world in worlds]
    assert all(TWO_ROOMS[start] for start in starts)
    assert len(set(starts)) > 25  # of 33 cells
    assert starts == [tuple(np.asarray(family.generate(jax.random.key(seed)).start).tolist()) for seed in range(60)]
    assert all(np.array_equal(world.letters, letters) for world in worlds)


def test_a_start_in_metres_is_kept(two_rooms):
    places = two_rooms.with_name("map.places.yaml")
    places.write_text(PLACES + "start: [7.2, 3.9]\n")
    family = RosMap.from_spec(f"map:{two_rooms},resolution=1,radius=0")
    for seed in range(3):
        assert np.asarray(family.generate(jax.random.key(seed)).start).tolist() == [2, 7]
    assert family.metres_to_cell(7.2, 3.9) == (2, 7)
    assert family.cell_to_metres(2, 7) == pytest.approx((7.5, 3.5))
    places.write_text(PLACES + "start: [0.5, 0.5]\n")
    with pytest.raises(MapError, match=r"map\.places\.yaml: start: \[0\.5, 0\.5\] is blocked"):
        RosMap.from_spec(f"map:{two_rooms},resolution=1,radius=0")


def test_a_place_beyond_a_wall_is_refused(tmp_path):
    free = TWO_ROOMS.copy()
    free[3, 5] = False
    file = write_map(tmp_path, p5(np.where(free, 254, 0)), resolution=1)
    (tmp_path / "map.places.yaml").write_text(PLACES + "start: [1.5, 2.5]\n")
    with pytest.raises(MapError, match=r"propositions: package: polygon .* lies outside of the map's reachable part"):
        RosMap(RosMapConfig(file, resolution=1.0, radius=0.0))


def test_cells_keep_their_metres_through_crop_and_resampling(tmp_path):
    """A room in the corner of a large map with an odd ratio of resolutions."""
    pixels = np.full((200, 300), 205)
    pixels[20:81, 150:271] = 0
    pixels[21:80, 151:270] = 254
    file = write_map(tmp_path, p5(pixels), origin="[-7.3, 11.9, 0.3]")
    desk = (0.05 * 215, 0.05 * (200 - 45))
    x = -7.3 + math.cos(0.3) * desk[0] - math.sin(0.3) * desk[1]
    y = 11.9 + math.sin(0.3) * desk[0] + math.cos(0.3) * desk[1]
    places = Places((("desk", (Disc((x, y), 0.0),)),), start=(x, y))
    family = RosMap(RosMapConfig(file, places, resolution=0.13, radius=0.1))
    world = family.generate(jax.random.key(0))
    start = tuple(np.asarray(world.start).tolist())
    assert np.argwhere(world.letters).tolist() == [list(start)]
    assert math.dist(family.cell_to_metres(*start), (x, y)) <= 0.13 * math.sqrt(0.5)
    row, col = family.image_map.frame.metres_to_cell(*family.cell_to_metres(*start))
    assert abs(row - 45) <= 2
    assert abs(col - 215) <= 2
    assert family.clean.frame.height == pytest.approx((59 - 4) / 2.6 + 2, abs=2)


def test_without_places_the_message_holds_an_example_that_works(tmp_path):
    file = write_map(tmp_path, p5(np.where(TWO_ROOMS, 254, 0)), resolution=1, origin="[-3, 5, 0]")
    config = RosMapConfig(file, resolution=1.0, radius=0.0)
    with pytest.raises(MapError, match=r"map\.places\.yaml does not exist, and the map itself does not name") as caught:
        RosMap(config)
    (tmp_path / "map.places.yaml").write_text(str(caught.value).split("for instance\n")[1])
    assert RosMap(config).propositions == ("document", "package")
    with pytest.raises(MapError, match=r"other\.yaml: cannot be read"):
        RosMap(RosMapConfig(file, str(tmp_path / "other.yaml")))


def test_specifications():
    assert parse_spec("map:a/b.yaml") == RosMapConfig("a/b.yaml")
    config = RosMapConfig("b.yaml", "c.yaml", 0.4, 0.0)
    assert parse_spec("map:b.yaml,radius=0,resolution=0.4,places=c.yaml") == config


@pytest.mark.parametrize(
    "spec",
    ["a.yaml", "map:", "map:a.yaml,size=2", "map:a.yaml,radius", "map:a.yaml,radius=1,radius=2", "map:a,radius=x"],
)
def test_bad_specifications(spec):
    with pytest.raises(MapError, match=r"write map:FILE\.yaml\[,places=FILE\]"):
        parse_spec(spec)
