"""Reading maps as their servers do: images and thresholds, the YAML, metres and cells."""

import math
import re
import warnings
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.occupancy_map import load_map
from potlp_jax.errors import MapError, MapWarning
from tests.reference.map_files import p2, p5, png, write_map

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


@pytest.mark.filterwarnings("ignore::potlp_jax.errors.MapWarning")
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


@pytest.mark.filterwarnings("ignore::potlp_jax.errors.MapWarning")
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
        ({"resolution": "0"}, "resolution: 0 must lie between 0.0001 and 100"),
        ({"resolution": "-0.05"}, "resolution: -0.05 must lie between"),
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
        (png(np.random.default_rng(0).integers(0, 255, (40, 40)).astype(np.uint8))[:800], "is not an image .*damaged"),
        (b"", r"is not an image \(PGM, PNG or BMP\), or is damaged"),
        (b"no image", r"is not an image \(PGM, PNG or BMP\), or is damaged"),
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


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    greys=st.lists(st.integers(0, 255), min_size=1, max_size=6),
    low=st.integers(0, 999),
    gap=st.integers(1, 1000),
    negate=st.booleans(),
    mode=st.sampled_from(["trinary", "scale", "raw"]),
)
@example(greys=[0, 0, 205], low=196, gap=454, negate=False, mode="trinary")
@example(greys=[255, 255, 230, 127], low=196, gap=454, negate=False, mode="trinary")
@example(greys=[205, 230, 254, 0], low=250, gap=400, negate=False, mode="trinary")
def test_advice_on_thresholds_can_be_followed(tmp_path, greys, low, gap, negate, mode):
    fields = {"mode": mode, "negate": int(negate and mode != "raw")}
    fields |= {"free_thresh": low / 1000, "occupied_thresh": min(low + gap, 1000) / 1000}

    def load():
        """What is said of free_thresh; an error is raised."""
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            load_map(write_map(tmp_path, p5([greys]), **fields))
        return " ".join(str(warning.message) for warning in told)

    message = ""
    try:
        told = load()
    except MapError as error:
        message = str(error)
    if message:
        advice = re.search(r"such as free_thresh: ([\d.]+) and occupied_thresh: ([\d.]+)$", message)
        if advice is None:
            assert "no thresholds tell" in message
            assert len({grey for grey in greys if mode != "raw" or grey <= 100}) < 2
            return
        fields |= {"free_thresh": advice[1], "occupied_thresh": advice[2]}
        told = load()
    bounds = re.findall(r"set free_thresh to ([\d.]+) or less", told)
    if bounds:
        fields["free_thresh"] = min(bounds, key=float)
        assert "or less" not in load()


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
