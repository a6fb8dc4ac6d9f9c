"""ROS maps: the servers' conventions, cleaning against a slow reference, placed propositions, maps made by others."""

import itertools
import math
import warnings
from fractions import Fraction
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline

from potlp_jax.environments.map_server import GridFrame, MapError, MapSettings, MapWarning, OccupancyMap, load_map
from potlp_jax.environments.places import Disc, Places, Polygon, load_places, place_letters
from potlp_jax.environments.ros_map import RosMap, RosMapConfig, clean_map, parse_spec

FIELDS = {
    "image": "map.pgm",
    "resolution": "0.05",
    "origin": "[0, 0, 0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}


def p5(pixels, white=255):
    body = np.asarray(pixels).astype(">u2" if white > 255 else np.uint8).tobytes()
    return f"P5\n# made by a test\n{len(pixels[0])} {len(pixels)}\n{white}\n".encode() + body


def p2(pixels, white=255):
    rows = "\n".join(" ".join(map(str, row)) for row in np.asarray(pixels).tolist())
    return f"P2\n# made by a test\n{len(pixels[0])} {len(pixels)} # width, height\n{white}\n{rows}".encode()


def png(pixels):
    return cv2.imencode(".png", np.asarray(pixels))[1].tobytes()


def write_map(folder, content, name="map", **fields):
    """Writes NAME.yaml and its image; a field of None is left out."""
    values = FIELDS | {"image": f"{name}.pgm"} | fields
    text = "".join(f"{key}: {value}\n" for key, value in values.items() if value is not None)
    (folder / f"{name}.yaml").write_text(text)
    (folder / f"{name}.pgm").write_bytes(content)
    return folder / f"{name}.yaml"


def occupancy_map(free, pixel="1", origin=(0.0, 0.0, 0.0)):
    """A map in memory: True is free, False an obstacle."""
    free = np.asarray(free, dtype=bool)
    resolution = Fraction(pixel)
    map_settings = MapSettings(
        Path("map.yaml"), Path("map.pgm"), resolution, origin, "trinary", False, Fraction(13, 20), Fraction(1, 5)
    )
    frame = GridFrame(*free.shape, float(resolution), *origin)
    return OccupancyMap(map_settings, np.where(free, 0, 100).astype(np.int8), free, ~free, frame)


def drawn(*rows):
    """'.' is free, '#' an obstacle."""
    return np.array([[cell == "." for cell in row] for row in rows])


TWO_ROOMS = drawn(
    "###########",
    "#....#....#",
    "#....#....#",
    "#.........#",
    "#....#....#",
    "###########",
)


# The image and the thresholds.


@pytest.mark.parametrize(
    "content",
    [
        p5([[0, 255, 127], [255, 51, 204]]),
        p2([[0, 255, 127], [255, 51, 204]]),
        p5([[0, 255, 127], [255, 51, 204]]).replace(b"\n3 2\n255\n", b"\n 3#c\n #d\n2\t255 "),
        p5([[0, 5, 2], [5, 1, 4]], white=5),
        p2([[0, 5, 2], [5, 1, 4]], white=5),
        p5([[0, 50000, 25000], [50000, 10000, 40000]], white=50000),
        png(np.array([[0, 255, 127], [255, 51, 204]], np.uint8)),
        png(np.array([[0, 65535, 32639], [65535, 13107, 52428]], np.uint16)),
        png(np.array([[[0, 0, 0], [255] * 3, [127, 100, 154]], [[255] * 3, [153, 0, 0], [204] * 3]], np.uint8)),
    ],
    ids=["P5", "P2", "P5 comments", "P5 of 5", "P2 of 5", "P5 16 bit", "PNG", "PNG 16 bit", "PNG RGB"],
)
def test_every_image_format_gives_the_same_map(tmp_path, content):
    loaded = load_map(write_map(tmp_path, content, occupied_thresh=0.7))
    assert loaded.occupancy.tolist() == [[100, 0, -1], [0, 100, -1]]
    assert loaded.free.tolist() == [[False, True, False], [True, False, False]]
    assert loaded.occupied.tolist() == [[True, False, False], [False, True, False]]


@pytest.mark.filterwarnings("ignore::potlp_jax.environments.map_server.MapWarning")
def test_thresholds_are_exact(tmp_path):
    """50/255 = 0.19608 is not below 0.196, 51/255 = 0.2 is neither above nor below 0.2."""
    content = p5([[0, 203, 204, 205, 206, 255]])
    assert load_map(write_map(tmp_path, content)).occupancy.tolist() == [[100, -1, -1, -1, 0, 0]]
    at_a_fifth = load_map(write_map(tmp_path, content, occupied_thresh="0.2", free_thresh="2.0e-2"))
    assert at_a_fifth.occupancy.tolist() == [[100, 100, -1, -1, -1, 0]]
    free_at_a_fifth = load_map(write_map(tmp_path, content, free_thresh="0.2"))
    assert free_at_a_fifth.occupancy.tolist() == [[100, -1, -1, 0, 0, 0]]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 999), min_size=2, max_size=2, unique=True),
    st.booleans(),
    st.sampled_from(["trinary", "scale"]),
    st.integers(1, 300),
)
def test_every_grey_by_the_definition(tmp_path_factory, thresholds, negate, mode, white):
    low, high = sorted(thresholds)
    pixels = list(range(white + 1))
    fields = {"negate": int(negate), "mode": mode, "free_thresh": f"0.{low:03}", "occupied_thresh": high / 1000}
    file = write_map(tmp_path_factory.mktemp("map"), p5([pixels], white), **fields)
    low, high = Fraction(low, 1000), Fraction(high, 1000)
    expected = []
    for pixel in pixels:
        occupancy = Fraction(pixel if negate else white - pixel, white)
        between = math.floor(99 * (occupancy - low) / (high - low)) if mode == "scale" else -1
        expected.append(100 if occupancy > high else 0 if occupancy < low else between)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MapWarning)
        loaded = load_map(file)
    assert loaded.occupancy.tolist() == [expected]
    occupancies = [Fraction(pixel if negate else white - pixel, white) for pixel in pixels]
    assert loaded.free.tolist() == [[occupancy < low for occupancy in occupancies]]
    assert loaded.occupied.tolist() == [[occupancy > high for occupancy in occupancies]]


@pytest.mark.filterwarnings("ignore::potlp_jax.environments.map_server.MapWarning")
def test_alpha_is_averaged_in_trinary_mode_and_means_unknown_in_scale_mode(tmp_path):
    # blue, green, red, alpha; black and opaque has the mean 63.75 (occupancy 0.75), black and clear 0.
    pixels = np.array([[[0, 0, 0, 255], [0, 0, 0, 0], [255] * 4, [255, 255, 255, 100], [120] * 3 + [255]]], np.uint8)
    trinary = load_map(write_map(tmp_path, png(pixels), occupied_thresh=0.8))
    assert trinary.occupancy.tolist() == [[-1, 100, 0, 0, -1]]
    scale = load_map(write_map(tmp_path, png(pixels), mode="scale", occupied_thresh=0.8, free_thresh=0.1))
    assert scale.occupancy.tolist() == [[100, -1, 0, -1, math.floor(99 * (135 / 255 - 0.1) / 0.7)]]
    assert scale.free.tolist() == [[False, False, True, False, False]]
    assert scale.occupied.tolist() == [[True, False, False, False, False]]


def test_raw_pixels_are_occupancies(tmp_path):
    loaded = load_map(write_map(tmp_path, p5([[0, 19, 20, 65, 66, 100, 101, 205, 255]]), mode="raw"))
    assert loaded.occupancy.tolist() == [[0, 19, 20, 65, 66, 100, -1, -1, -1]]
    assert loaded.free.tolist() == [[True, True, False, False, False, False, False, False, False]]
    assert loaded.occupied.tolist() == [[False, False, False, False, True, True, False, False, False]]


# The YAML.


def test_yaml_as_robots_write_it(tmp_path):
    write_map(tmp_path, p5([[0, 254]]))
    (tmp_path / "map.yaml").write_bytes(
        b"\xef\xbb\xbfimage: map.pgm\r\nresolution: 0.050000\r\norigin: [-8.325, -46.575, 0.0]  #lower-left pixel\r\n"
        b"negate: false\r\noccupied_thresh: .65\r\nfree_thresh: 1.96e-1 # older\r\nmode: trinary\r\n"
    )
    loaded = load_map(tmp_path / "map.yaml")
    assert loaded.frame == GridFrame(1, 2, 0.05, -8.325, -46.575, 0.0)
    assert loaded.settings.free_thresh == Fraction(196, 1000)


def test_missing_thresholds_get_defaults_under_which_saved_unknown_stays_unknown(tmp_path):
    file = write_map(tmp_path, p5([[0, 205, 254]]), occupied_thresh=None, free_thresh=None, negate=None, mode=None)
    with pytest.warns(MapWarning, match=r"map\.yaml: (free|occupied)_thresh: is missing; using 0\.") as warned:
        loaded = load_map(file)
    assert len(warned) == 2
    assert loaded.occupancy.tolist() == [[100, -1, 0]]


def test_unknown_key_warns(tmp_path):
    with pytest.warns(MapWarning, match=r"map\.yaml: freethresh: unknown, ignored; known are image"):
        load_map(write_map(tmp_path, p5([[0, 254]]), freethresh=0.2))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"image": None}, "image: is missing"),
        ({"image": '""'}, "image: '' must be the name of an image"),
        ({"image": "[a, b]"}, "image: .* must be the name of an image"),
        ({"resolution": None}, "resolution: is missing"),
        ({"resolution": "0"}, "resolution: 0 must be positive"),
        ({"resolution": "-0.05"}, "resolution: -0.05 must be positive"),
        ({"resolution": ".nan"}, r"resolution: '\.nan' is not a finite number"),
        ({"resolution": "five"}, "resolution: 'five' is not a finite number"),
        ({"resolution": "[0.05]"}, "resolution: .* is not a finite number"),
        ({"origin": None}, "origin: is missing"),
        ({"origin": "[0, 0]"}, r"origin: .* must be a list \[x, y, yaw\]"),
        ({"origin": "[0, 0, inf]"}, "origin: 'inf' is not a finite number"),
        ({"origin": "0"}, r"origin: '0' must be a list \[x, y, yaw\]"),
        ({"negate": "2"}, "negate: '2' must be one of 0, 1"),
        ({"mode": "binary"}, "mode: 'binary' must be one of trinary, scale, raw"),
        ({"occupied_thresh": "65"}, "occupied_thresh: 65.0 must lie between 0 and 1"),
        ({"free_thresh": "-0.1"}, "free_thresh: -0.1 must lie between 0 and 1"),
        ({"free_thresh": "NaN"}, "free_thresh: 'NaN' is not a finite number"),
        ({"free_thresh": "0.65"}, "occupied_thresh: 0.65 must be larger than free_thresh, 0.65"),
        ({"mode": "raw", "negate": 1}, "negate: ROS 1 inverts raw pixels and ROS 2 does not"),
        ({"origin": "[0, 0, 0]\norigin: [1, 0, 0]"}, "(?s)is not valid YAML: key 'origin' is given twice.*line 4"),
        ({"origin": "[0, 0"}, "is not valid YAML"),
        ({"[1, 2]": "3"}, "(?s)is not valid YAML:.*unhashable key"),
    ],
)
def test_bad_fields_are_named(tmp_path, fields, message):
    with pytest.raises(MapError, match=message) as caught:
        load_map(write_map(tmp_path, p5([[0, 254]]), **fields))
    assert str(tmp_path / "map.yaml") in str(caught.value)


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "42"])
def test_yaml_that_is_no_mapping(tmp_path, text):
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(MapError, match="must hold lines of the form 'key: value'"):
        load_map(tmp_path / "map.yaml")


def test_yaml_that_is_not_there(tmp_path):
    with pytest.raises(MapError, match=r"none\.yaml: cannot be read \(No such file"):
        load_map(tmp_path / "none.yaml")


def test_where_the_image_is_looked_for(tmp_path):
    there = tmp_path / "images"
    there.mkdir()
    content = p5([[0, 254]])
    (there / "office.pgm").write_bytes(content)
    for image in ("images/office.pgm", there / "office.pgm"):
        assert load_map(write_map(tmp_path, content, image=image)).settings.image == there / "office.pgm"
    moved = write_map(tmp_path, content, image="/robot/maps/map.pgm")
    with pytest.warns(MapWarning, match=r"image: /robot/maps/map\.pgm does not exist; using .*map\.pgm"):
        assert load_map(moved).settings.image == tmp_path / "map.pgm"
    lost = write_map(tmp_path, content, image="/robot/maps/lost.pgm")
    with pytest.raises(MapError, match=r"image: /robot/maps/lost\.pgm does not exist, nor does .*/lost\.pgm; put"):
        load_map(lost)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (p5([[0, 254], [254, 0]])[:-1], "is cut short: 3 of 2 x 2 = 4 pixels"),
        (p5([[0, 300], [300, 0]], white=300)[:-1], "is cut short: 3 of 2 x 2 = 4 pixels"),
        (p2([[0, 254], [254, 0]])[:-2], "is cut short: 3 of 2 x 2 = 4 pixels"),
        (b"P5\n2 2\n", "has no valid PGM header"),
        (b"P5\n0 2\n255\n", "has an invalid PGM header: 0 x 2 pixels"),
        (b"P5\n1 1\n70000\n00", "maximum 70000"),
        (p2([[0, 300]]), "has a pixel of 300, above its maximum 255"),
        (p2([["0", "black"]]), "has a pixel that is no number"),
        (png(np.random.default_rng(0).integers(0, 255, (40, 40)).astype(np.uint8))[:800], "cannot be decoded"),
        (b"", "cannot be decoded"),
        (b"no image", "cannot be decoded"),
    ],
)
def test_broken_images(tmp_path, content, message):
    with pytest.raises(MapError, match=message) as caught:
        load_map(write_map(tmp_path, content))
    assert str(tmp_path / "map.pgm") in str(caught.value)


def test_no_obstacle_and_nothing_free(tmp_path):
    with pytest.raises(
        MapError, match=r"occupied_thresh: 0\.65 leaves no obstacle in map\.pgm.* 127 \(occupancy 0\.502\)"
    ):
        load_map(write_map(tmp_path, p5([[255, 255, 230, 127]])))
    with pytest.raises(MapError, match=r"free_thresh: 0\.196 leaves nothing free in map\.pgm"):
        load_map(write_map(tmp_path, p5([[0, 0, 205]])))


def test_warns_of_unknown_that_becomes_free(tmp_path):
    pixels = [[0] * 10 + [254] * 60 + [205] * 30]
    with pytest.warns(
        MapWarning, match=r"free_thresh: 0\.25 makes 30 pixels of value 205 free \(30\.0 %.*to 0\.196 or"
    ):
        load_map(write_map(tmp_path, p5(pixels), free_thresh=0.25))
    mended = write_map(tmp_path, p5(pixels), free_thresh=0.196)
    # Not the savers' grey, but an area as large as the free one.
    other = write_map(tmp_path, p5([[0] * 10 + [255] * 40 + [230] * 50]), name="other")
    with pytest.warns(MapWarning, match=r"makes 50 pixels of value 230 free .* to 0\.098 or less"):
        load_map(other)
    inverted = write_map(tmp_path, p5([[255] * 10 + [0] * 40 + [25] * 50]), name="inverted", negate=1)
    with pytest.warns(MapWarning, match=r"makes 50 pixels of value 25 free .* to 0\.098 or less"):
        load_map(inverted)
    shades = write_map(tmp_path, p5([[0] * 10 + [255] * 40 + [254] * 40 + [253] * 10]), name="shades")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_map(mended)
        load_map(shades)


# Metres and cells.


def test_first_row_is_the_top_of_the_map():
    frame = GridFrame(height=3, width=4, resolution=0.5, x=10.0, y=20.0)
    assert frame.metres_to_cell(10.1, 20.1) == (2, 0)
    assert frame.metres_to_cell(11.9, 21.4) == (0, 3)
    assert frame.cell_to_metres(0, 3) == pytest.approx((11.75, 21.25))
    assert frame.metres_to_cell(9.9, 20.1) == (2, -1)
    assert not frame.contains(2, -1)
    assert not frame.contains(3, 0)
    # On an edge: the cell of larger x and y, though 0.15 / 0.05 is 2.9999999999999996 in floating point.
    assert GridFrame(10, 10, 0.05, 0.0, 0.0).metres_to_cell(0.15, 0.15) == (6, 3)


def test_yaw_turns_about_the_lower_left_corner():
    frame = GridFrame(height=2, width=3, resolution=1.0, x=5.0, y=5.0, yaw=math.pi / 2)
    # The columns run up, the rows (from the bottom) to the left.
    assert frame.metres_to_cell(4.5, 5.5) == (1, 0)
    assert frame.metres_to_cell(4.5, 7.5) == (1, 2)
    assert frame.metres_to_cell(3.5, 5.5) == (0, 0)
    assert frame.cell_to_metres(0, 2) == pytest.approx((3.5, 7.5))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.floats(0.02, 2),
    st.floats(-60, 60),
    st.floats(-60, 60),
    st.floats(-7, 7),
    st.data(),
)
def test_centres_return_to_their_cells_also_in_a_window(height, width, resolution, x, y, yaw, data):
    frame = GridFrame(height, width, resolution, x, y, yaw)
    row, col = data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1))
    top, left = data.draw(st.integers(-3, row)), data.draw(st.integers(-3, col))
    assert frame.metres_to_cell(*frame.cell_to_metres(row, col)) == (row, col)
    window = frame.window(top, left, height, width)
    assert window.cell_to_metres(row - top, col - left) == pytest.approx(frame.cell_to_metres(row, col), abs=1e-6)


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
        (math.nan, 0.0, "resolution: nan is not a finite number of metres"),
        (1.0, -1.0, "radius: -1.0 is not a finite number of metres"),
        (1.0, math.inf, "radius: inf is not a finite number of metres"),
        (1.0, 300.0, "nothing is left free with cells of 1.0 m and a radius of 300.0 m"),
    ],
)
def test_impossible_sizes(resolution, radius, message):
    with pytest.raises(MapError, match=message):
        clean_map(occupancy_map(TWO_ROOMS), resolution, radius)


# Places.


def cells_of(region, free=TWO_ROOMS):
    free = np.asarray(free)
    places = Places((("goal", (region,)),))
    return set(map(tuple, np.argwhere(place_letters(places, free, occupancy_map(free).frame)).tolist()))


def test_a_disc_holds_centres_within_its_radius_but_reaches_through_no_wall():
    assert cells_of(Disc((2.5, 2.5), 1.0)) == {(3, 2), (2, 2), (4, 2), (3, 1), (3, 3)}
    assert cells_of(Disc((2.9, 2.9), 0.0)) == {(3, 2)}
    assert cells_of(Disc((4.5, 4.5), 2.0)) == {(1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)}
    # A point in a wall counts for the side that is nearest to it.
    assert cells_of(Disc((5.4, 4.5), 1.0)) == {(1, 4)}
    assert cells_of(Disc((5.6, 4.5), 1.0)) == {(1, 6)}


def test_a_polygon_holds_the_free_cells_whose_centre_is_inside():
    l_shape = Polygon(((1, 1), (7, 1), (7, 3), (3, 3), (3, 5), (1, 5)))
    inside = {(row, col) for row in (1, 2) for col in (1, 2)} | {(row, col) for row in (3, 4) for col in range(1, 7)}
    assert cells_of(l_shape) == {cell for cell in inside if TWO_ROOMS[cell]}
    assert cells_of(Polygon(l_shape.vertices[::-1])) == cells_of(l_shape)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(-5, 60), st.integers(-5, 60)), min_size=3, max_size=7), st.floats(-4, 4))
def test_polygons_agree_with_another_implementation(vertices, yaw):
    """Winding numbers, also in a turned frame; centres on a side are left out."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    local = [(x / 10 + 0.0137 * (i + 1), y / 10 + 0.0071 * (i + 1) ** 2) for i, (x, y) in enumerate(vertices)]
    region = Polygon(tuple((cos * x - sin * y, sin * x + cos * y) for x, y in local))
    frame = GridFrame(6, 6, 1.0, 0.0, 0.0, yaw)
    covered = region.covers(np.ones((6, 6), dtype=bool), frame)
    for row in range(6):
        for col in range(6):
            angles = [math.atan2(y - (5.5 - row), x - (col + 0.5)) for x, y in local]
            turns = [(b - a + math.pi) % (2 * math.pi) - math.pi for a, b in itertools.pairwise([*angles, angles[0]])]
            if all(math.pi - abs(turn) > 1e-3 for turn in turns):
                assert covered[row, col] == (round(sum(turns) / (2 * math.pi)) % 2 == 1)


def test_letters_of_several_propositions():
    places = Places((("a", (Disc((1.5, 1.5), 0), Disc((2.5, 1.5), 0))), ("b", (Disc((2.5, 1.5), 1),))))
    letters = place_letters(places, TWO_ROOMS, occupancy_map(TWO_ROOMS).frame)
    assert letters.dtype == np.int32
    assert {cell: int(letters[cell]) for cell in ((4, 1), (4, 2), (4, 3), (3, 2), (1, 1))} == {
        (4, 1): 3,
        (4, 2): 3,
        (4, 3): 2,
        (3, 2): 2,
        (1, 1): 0,
    }


@pytest.mark.parametrize(
    ("region", "message"),
    [
        (
            Disc((50, 50), 0.5),
            r"goal: point \[50\.00, 50\.00\] with radius 0\.5 lies outside.*nearest.* at \[9\.50, 4\.50\]",
        ),
        (Disc((5.5, 4.5), 0.4), "covers no cell that the robot can reach; the nearest cell it can reach is at"),
        (Polygon(((5, 3), (6, 3), (6, 5), (5, 5))), "polygon .* covers no cell that the robot can reach"),
        (Polygon(((1, 1), (1.2, 1), (1.2, 1.2))), "lies outside of the map's reachable part"),
    ],
)
def test_a_place_that_no_robot_reaches_is_named(region, message):
    with pytest.raises(MapError, match=message):
        cells_of(region)


PLACES = """propositions:
  document: [{point: [1.5, 1.5], radius: 0.5}]
  package: [{polygon: [[8, 1], [10, 1], [10, 3], [8, 3]]}, {point: [9.5, 4.5], radius: 0}]
tasks:
  "1": F document & F package
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("start: [1, 1]\n", "propositions: is missing or empty"),
        ("propositions: {}\n", "propositions: is missing or empty"),
        ("propositions: {a: []}\n", "propositions: a: must be a list of regions"),
        ("propositions: {a: {point: [1, 1], radius: 1}}\n", "propositions: a: must be a list of regions"),
        ("propositions: {a: [{point: [1, 1]}]}\n", "propositions: a: .* is no region; write"),
        ("propositions: {a: [{point: [1, 1], radius: 1, r: 2}]}\n", "is no region"),
        ("propositions: {a: [{point: [1], radius: 1}]}\n", r"a: point: .* must be a list \[x, y\]"),
        ("propositions: {a: [{point: [1, .nan], radius: 1}]}\n", "a: point: '.nan' is not a finite number"),
        ("propositions: {a: [{point: [1, 1], radius: -1}]}\n", "a: radius: -1 must not be negative"),
        ("propositions: {a: [{polygon: [[1, 1], [2, 2]]}]}\n", "a: polygon: needs three vertices"),
        (PLACES + "strat: [1, 1]\n", "strat: unknown key 'strat'; known are propositions, start, tasks"),
        (PLACES + "start: here\n", r"start: 'here' must be a list \[x, y\]"),
        (PLACES.replace("package", "document"), "key 'document' is given twice"),
        (PLACES.replace("F document & F package", "''"), "tasks: must map names to formulas"),
        ("propositions:\n" + "".join(f"  p{i}: [{{point: [1, 1], radius: 1}}]\n" for i in range(17)), "at most 16"),
    ],
)
def test_bad_places_are_named(tmp_path, text, message):
    (tmp_path / "bad.places.yaml").write_text(text)
    with pytest.raises(MapError, match=message) as caught:
        load_places(tmp_path / "bad.places.yaml")
    assert "bad.places.yaml" in str(caught.value)


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
    with pytest.raises(MapError, match=r"map\.places\.yaml does not exist, and a map has no propositions") as caught:
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


# Maps made by others.


def load_labels(folder, floor):
    doors = yaml.safe_load((folder / f"maps/labels/gdc_{floor}_doors.yaml").read_text())
    rooms = yaml.safe_load((folder / f"maps/labels/gdc_{floor}_locations.yaml").read_text())
    outlines = {
        name: Outline(np.reshape(polygon, (-1, 2)))
        for name, polygon in zip(rooms["locations"], rooms["polygons"], strict=True)
    }
    return [(approach["from"], approach["point"][:2]) for door in doors for approach in door["approach"]], outlines


FLOORS = [("gdc_floor2", "2", 22), ("gdc_3ne", "3ne", 48)]


@pytest.mark.parametrize(("name", "floor", "count"), FLOORS)
def test_both_sides_of_every_door_lie_in_their_rooms(external_data, name, floor, count):
    frame = load_map(external_data / f"maps/{name}.yaml").frame
    approaches, outlines = load_labels(external_data, floor)

    def hits(flip):
        cells = [(room, frame.metres_to_cell(*point)) for room, point in approaches]
        rows = [(room, frame.height - 1 - row if flip else row, col) for room, (row, col) in cells]
        return sum(bool(outlines[room].contains_point((col + 0.5, row + 0.5))) for room, row, col in rows)

    assert len(approaches) == count
    assert hits(flip=False) == count
    assert hits(flip=True) <= count // 4


@pytest.mark.parametrize(("name", "floor", "count"), FLOORS)
def test_every_door_of_a_mapped_room_stays_open_on_the_cleaned_map(external_data, name, floor, count):
    image_map = load_map(external_data / f"maps/{name}.yaml")
    clean = clean_map(image_map)
    approaches, outlines = load_labels(external_data, floor)
    closed = {room for room, point in approaches if not clean.free[clean.frame.metres_to_cell(*point)]}
    # The robot never entered these two rooms: their pixels are unknown.
    assert closed == ({"l3_402", "l3_404"} if floor == "3ne" else set())
    for room in closed:
        point = next(point for name, point in approaches if name == room)
        assert image_map.occupancy[image_map.frame.metres_to_cell(*point)] == -1
    mapped = {room for room, _ in approaches} - closed
    centres = [clean.frame.cell_to_metres(row, col) for row, col in np.argwhere(clean.free)[::5].tolist()]
    pixels = np.array([image_map.frame.metres_to_cell(*centre)[::-1] for centre in centres]) + 0.5
    assert all(outlines[room].contains_points(pixels).sum() > 4 for room in mapped)


@pytest.mark.parametrize(("name", "rooms", "reached"), [("kth_50052752", 22, 22), ("kth_50010535_PLAN1", 72, 71)])
def test_rooms_of_plans_stay_connected(external_data, name, rooms, reached):
    """Rooms above 4 m2, by the plan's labels; in the one that is lost the doorway is narrower than 0.6 m."""
    image_map = load_map(external_data / f"maps/{name}.yaml")
    labels = cv2.imread(str(external_data / f"maps/labels/{name}_rooms.png"), cv2.IMREAD_UNCHANGED)
    numbers, sizes = np.unique(labels[image_map.free], return_counts=True)
    large = set(numbers[sizes * 0.05**2 > 4].tolist())
    clean = clean_map(image_map)
    centres = [clean.frame.cell_to_metres(row, col) for row, col in np.argwhere(clean.free)[::5].tolist()]
    found = {int(labels[image_map.frame.metres_to_cell(*centre)]) for centre in centres}
    assert len(large) == rooms
    assert len(large & found) == reached


@pytest.mark.parametrize(
    ("name", "resolution", "radius", "shape"),
    [
        ("gdc_3ne", 0.4, 0.0, (55, 217)),
        ("gdc_floor2", 0.3, 0.1, (194, 256)),
        ("intel_lab", 0.25, 0.1, (228, 227)),
        ("uma_rooms", 0.2, 0.1, (67, 73)),
        ("sarmis_home", 0.1, 0.1, (120, 122)),
        ("levine_lobby", 0.2, 0.1, (163, 94)),
        ("kth_50052752", 0.2, 0.1, (62, 195)),
        ("kth_50010535_PLAN1", 0.4, 0.0, (75, 257)),
    ],
)
def test_real_maps_become_worlds(external_data, name, resolution, radius, shape):
    file = external_data / f"maps/{name}.yaml"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        walls = load_map(file)
    clean = clean_map(walls, resolution, radius)
    assert clean.free.shape == shape
    cells = np.argwhere(clean.free).tolist()
    first, last = (clean.frame.cell_to_metres(*cells[i]) for i in (0, -1))
    places = Places((("a", (Disc(first, 0.5),)), ("b", (Disc(last, 0.5),))))
    world = RosMap(RosMapConfig(file, places, resolution, radius)).generate(jax.random.key(0))
    assert np.array_equal(world.occupied, ~clean.free)
    assert set(np.unique(world.letters).tolist()) == {0, 1, 2}
    # No free cell lies on an obstacle pixel: the map's own walls are all there.
    centres = [walls.frame.cell_to_metres(row, col) for row, col in np.argwhere(walls.occupied)[::97].tolist()]
    there = [clean.frame.metres_to_cell(*centre) for centre in centres]
    assert not any(clean.free[cell] for cell in there if clean.frame.contains(*cell))


def test_quirk_ascii_image(external_data, tmp_path):
    image = external_data / "maps/quirks/columbia_P2_ascii.pgm"
    loaded = load_map(write_map(tmp_path, b"", image=image))
    assert loaded.free.shape == (350, 435)
    tokens = [line.split("#")[0] for line in image.read_text().splitlines()]
    values = np.array(" ".join(tokens[1:]).split()[3:], dtype=int).reshape(350, 435)
    assert np.array_equal(loaded.free, 1000 * (255 - values) < 196 * 255)
    assert np.array_equal(loaded.occupied, 100 * (255 - values) > 65 * 255)
    assert clean_map(loaded).free.sum() > 500


def test_quirk_no_pixel_dark_enough(external_data, tmp_path):
    image = external_data / "maps/quirks/intel_map_no_black.png"
    with pytest.raises(MapError, match=r"leaves no obstacle.*255 .*230 .*127 .occupancy 0.502"):
        load_map(write_map(tmp_path, b"", image=image, resolution=0.1))
    with pytest.warns(MapWarning, match=r"pixels of value 230 free .* set free_thresh to 0\.098 or less"):
        load_map(write_map(tmp_path, b"", image=image, resolution=0.1, occupied_thresh=0.4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = load_map(write_map(tmp_path, b"", image=image, resolution=0.1, occupied_thresh=0.4, free_thresh=0.05))
    assert clean_map(loaded).free.sum() > 30000


def test_quirk_unknown_that_is_free(external_data):
    with pytest.warns(
        MapWarning, match=r"0.25 makes 83631 pixels of value 205 free .34.3 %.* set free_thresh to 0.196"
    ):
        loaded = load_map(external_data / "maps/quirks/pal_office_freethresh025.yaml")
    assert not (loaded.occupancy == -1).any()


def test_quirk_inline_comment(external_data, tmp_path):
    quirk = external_data / "maps/quirks/UMA_236_inline_comment.yaml"
    with pytest.raises(MapError, match=r"image: .*UMA_236\.pgm does not exist; put the image there"):
        load_map(quirk)
    (tmp_path / "copy.yaml").write_bytes(quirk.read_bytes())
    (tmp_path / "UMA_236.pgm").write_bytes(p5([[0, 254]]))
    assert load_map(tmp_path / "copy.yaml").frame == GridFrame(1, 2, 0.05, -8.325, -46.575, 0.0)


def test_quirk_absolute_path(external_data, tmp_path):
    quirk = external_data / "maps/quirks/movecare_map_absolute_path.yaml"
    with pytest.raises(
        MapError, match=r"image: /home/.*movecare_map\.pgm does not exist, nor does .*quirks/movecare_map"
    ):
        load_map(quirk)
    (tmp_path / "copy.yaml").write_bytes(quirk.read_bytes())
    (tmp_path / "movecare_map.pgm").write_bytes(p5([[0, 254]]))
    with pytest.warns(MapWarning, match="does not exist; using"):
        assert load_map(tmp_path / "copy.yaml").settings.image == tmp_path / "movecare_map.pgm"


def test_quirk_yaw(external_data, tmp_path):
    quirk = external_data / "maps/quirks/stata_yaw314.yaml"
    with pytest.raises(MapError, match=r"image: .*basement_fixed\.png does not exist"):
        load_map(quirk)
    (tmp_path / "copy.yaml").write_bytes(quirk.read_bytes())
    pixels = np.full((100, 200), 255, np.uint8)
    pixels[:50, 100:] = 0
    (tmp_path / "basement_fixed.png").write_bytes(png(pixels))
    loaded = load_map(tmp_path / "copy.yaml")
    clean = clean_map(loaded)
    # Turned by nearly half a turn, the map lies to the lower left of its origin, its dark top right corner farthest.
    lower_left, dark = (25.9 - 1, 48.5 - 1), (25.9 - 0.0504 * 150, 48.5 - 0.0504 * 75)
    assert clean.free[clean.frame.metres_to_cell(*lower_left)]
    assert loaded.occupied[loaded.frame.metres_to_cell(*dark)]
    assert not clean.free[clean.frame.metres_to_cell(*dark)]
    x, y = 0.0504 * 150, 0.0504 * 20
    there = 25.9 + math.cos(3.14) * x - math.sin(3.14) * y, 48.5 + math.sin(3.14) * x + math.cos(3.14) * y
    assert loaded.frame.metres_to_cell(*there) in {(79, 150), (80, 150), (79, 149), (80, 149)}
    assert clean.free[clean.frame.metres_to_cell(*there)]
