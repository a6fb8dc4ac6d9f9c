"""`potlp map`: what it finds on maps whose doors are known, what it writes, and pictures whose metres are right."""

import errno
import json
import math
import shlex
import warnings
import xml.etree.ElementTree as ElementTree

import jax
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.registry import make
from potlp_jax.environments.ros.cleaning import Cause, clean_map
from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.map_writer import save_map
from potlp_jax.environments.ros.occupancy_map import load_map
from potlp_jax.environments.ros.places import Disc, Places, Polygon, load_places, save_places
from potlp_jax.environments.ros.ros_map import RosMap, RosMapConfig
from potlp_jax.environments.ros.survey import find_passages, survey_map
from potlp_jax.errors import MapError, MapWarning
from potlp_jax.view.map_preview import CUT_OFF, OBSTACLE, REACHED, draw_map, draw_places
from potlp_jax.view.style import area_colour, rgb
from tests.reference.map_files import TWO_ROOMS, occupancy_map, p5, write_map

ORIGIN = (-1.0, 2.0)


def building():
    """Three rooms of 4 m by 4, 4 and 3 m in a row; a door of 0.7 m, then one of 0.3 m. A pixel is 0.05 m."""
    pixels = np.full((100, 240), 205)
    pixels[9:91, 9:233] = 0
    pixels[10:90, 10:90] = pixels[10:90, 91:171] = pixels[10:90, 172:232] = 254
    pixels[40:54, 90] = pixels[60:66, 171] = 254
    pixels[2, 2] = 254
    pixels[30, 30] = 0
    return pixels


def metres(row, col):
    """Centre of a pixel of the building."""
    return ORIGIN[0] + (col + 0.5) * 0.05, ORIGIN[1] + (100 - row - 0.5) * 0.05


@pytest.fixture
def office(tmp_path):
    return write_map(tmp_path, p5(building()), name="office", origin=f"[{ORIGIN[0]}, {ORIGIN[1]}, 0]")


def potlp(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    # Shown where the test fails.
    print(result.output)
    return result


def as_json(*arguments):
    result = potlp(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


# Inspect.


def test_inspect_counts_and_measures(office):
    found = as_json("map", "inspect", office)
    pixels = building()
    assert found["pixels"] == [100, 240]
    assert found["metres"] == [5.0, 12.0]
    assert (found["origin"], found["yaw"], found["mode"]) == ([-1.0, 2.0], 0.0, "trinary")
    for name, grey in (("free", 254), ("occupied", 0), ("unknown", 205)):
        assert found["shares"][name] == pytest.approx((pixels == grey).mean())
    assert (found["components"], found["specks"], found["loose_obstacles"]) == (2, 1, 1)
    assert found["largest"] == pytest.approx(((pixels == 254).sum() - 1) * 0.05**2)
    assert found["open_edge"] == 0
    assert found["free_area"]["mapped"] == pytest.approx((pixels == 254).sum() * 0.05**2)
    areas = list(found["free_area"].values())
    assert areas == sorted(areas, reverse=True)


def test_inspect_finds_the_doors_and_the_room_that_is_cut_off(office):
    found = as_json("map", "inspect", office)
    narrow, wide = found["passages"]
    # In whole pixels, up to one less than the truth.
    assert 0.25 <= narrow["width"] <= 0.3
    assert 0.65 <= wide["width"] <= 0.7
    assert narrow["at"] == pytest.approx(metres(62.5, 171), abs=0.11)
    assert wide["at"] == pytest.approx(metres(46.5, 90), abs=0.11)
    assert (narrow["is_open"], wide["is_open"]) == (False, True)
    assert narrow["area"] == pytest.approx(3 * 4, rel=0.05)
    (part,) = found["cut_off"]
    assert part["at"] == pytest.approx(metres(49.5, 201.5), abs=0.25)
    assert 8 < part["area"] < 12
    assert part["cause"] == "cells"
    assert any(f"{part['area']:.1f} m2" in defect for defect in found["defects"])
    smaller = as_json("map", "inspect", office, "--resolution", "0.05", "--radius", "0.1")
    assert smaller["cut_off"] == []
    assert all(passage["is_open"] for passage in smaller["passages"])
    # Through neither door fits a robot of this radius: rooms are out of reach, but not because of the cells.
    wide_robot = as_json("map", "inspect", office, "--radius", "0.4")["cut_off"]
    assert [part["cause"] for part in wide_robot] == ["radius", "radius"]
    other = as_json("map", "inspect", office, "--start", "{:g},{:g}".format(*metres(50, 200)))
    assert other["reachable_cells"] * 0.04 < 12
    assert other["cut_off"][0]["area"] > 20


def test_inspect_prints_what_it_found(office):
    result = potlp("map", "inspect", office)
    assert result.exit_code == 0
    for part in ("240 x 100 pixels", "12.00 x 5.00 m", "narrowest passages", "closed", "1 specks", "cut off"):
        assert part in result.stdout


def test_free_space_without_a_wall_is_measured():
    free = np.zeros((40, 40), bool)
    free[10:30, 10:40] = True
    image_map = occupancy_map(free, pixel="0.1")
    image_map.occupied[:] = False
    image_map.occupied[9, 9:] = image_map.occupied[9:31, 9] = True
    clean = clean_map(image_map, 0.1, 0.0)
    # The lower side meets unknown space, the right one the image's edge.
    assert survey_map(image_map, clean).open_edge == pytest.approx(3.0 + 2.0)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(0, 6), min_size=1, max_size=4), st.integers(0, 2**32 - 1))
def test_passages_are_the_doors(halves, seed):
    """Rooms of 20 by 20 pixels in a row, doors of an odd number of pixels somewhere in the walls between them."""
    rng = np.random.default_rng(seed)
    free = np.zeros((22, 21 * (len(halves) + 1) + 1), bool)
    for room in range(len(halves) + 1):
        free[1:21, 21 * room + 1 : 21 * room + 21] = True
    doors = []
    for wall, half in enumerate(halves, 1):
        row = int(rng.integers(1 + half, 20 - half))
        free[row - half : row + half + 1, 21 * wall] = True
        doors.append((2 * half + 1, row, 21 * wall))
    if rng.random() < 0.5:
        free = free.T
        doors = [(width, col, row) for width, row, col in doors]
    image_map = occupancy_map(free)
    found = find_passages(free, image_map.frame, clean_map(image_map, 1.0, 0.0), widest=15.0, area=300.0)
    assert [passage.width for passage in found] == sorted(width for width, _, _ in doors)
    assert all(passage.is_open for passage in found)
    for passage in found:
        row, col = image_map.frame.metres_to_cell(*passage.at)
        assert any(abs(row - r) <= 2 and abs(col - c) <= 2 for width, r, c in doors if width == passage.width)


def test_a_yaw_that_may_be_in_degrees_is_said(tmp_path):
    file = write_map(tmp_path, p5(building()), origin="[0.0, 0.0, 30.0]")
    assert "is the third number of origin in degrees?" in potlp("map", "inspect", file).stdout.replace("\n", " ")


def test_narrowings_between_small_parts_are_no_passages(office):
    image_map = load_map(office)
    clean = clean_map(image_map)
    assert find_passages(image_map.free, image_map.frame, clean, area=20.0) == ()
    assert len(find_passages(image_map.free, image_map.frame, clean, widest=0.5)) == 1


def test_a_world_on_a_map_with_a_part_cut_off_warns(office, tmp_path):
    places = Places((("a", (Disc(metres(50, 50), 0.5),)),))
    with pytest.warns(
        MapWarning, match=r"cells of 0\.2 m close passages .* cut off [\d.]+ m2 at \[9\.\d+, 4\.\d+\]; use"
    ):
        RosMap(RosMapConfig(office, places))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RosMap(RosMapConfig(office, places, resolution=0.1))
    save_places(places, tmp_path / "office.places.yaml")
    drawn = potlp("map", "preview", office, "--out", tmp_path / "office.png")
    assert drawn.exit_code == 0
    assert " ".join(drawn.stderr.split()).startswith(f"{office}: resolution: cells of 0.2 m close passages")


def test_a_part_that_nothing_joins_on_the_map_is_named_and_painted(tmp_path):
    """Half of the building: the door between the second room and the third is walled up."""
    pixels = building()
    pixels[60:66, 171] = 0
    file = write_map(tmp_path, p5(pixels), name="office", origin=f"[{ORIGIN[0]}, {ORIGIN[1]}, 0]")
    found = as_json("map", "inspect", file)
    (part,) = found["cut_off"]
    assert part["cause"] == "map"
    assert part["area"] == pytest.approx(found["free_area"]["resampled"] - found["free_area"]["reachable"])
    assert any("not connected with the rest on the map itself" in defect for defect in found["defects"])
    with pytest.warns(MapWarning, match=rf"no free space joins {part['area']:.1f} m2 at .* with the rest"):
        RosMap(RosMapConfig(file, Places((("a", (Disc(metres(50, 50), 0.5),)),))))
    assert potlp("map", "preview", file, "--out", tmp_path / "office.png").exit_code == 0
    with Image.open(tmp_path / "office.png") as image:
        colours = {colour: count for count, colour in image.convert("RGB").getcolors(1 << 20)}
    # As pink as the other rooms are blue.
    share = part["area"] / found["free_area"]["resampled"]
    pink, blue = colours[rgb(CUT_OFF)], colours[rgb(REACHED)]
    assert pink / (pink + blue) == pytest.approx(share, abs=0.03)


# Clean.


@pytest.mark.parametrize(("resolution", "radius", "yaw"), [(0.2, 0.1, 0.0), (0.13, 0.07, 0.0), (0.05, 0.0, 0.7)])
def test_a_cleaned_map_is_read_back_as_the_same_world(tmp_path, resolution, radius, yaw):
    file = write_map(tmp_path, p5(building()), origin=f"[-1.3, 2.7, {yaw}]")
    out = tmp_path / "out" / "clean.yaml"
    told = as_json("map", "clean", file, "--out", out, "--resolution", resolution, "--radius", radius)
    before = clean_map(load_map(file), resolution, radius)
    assert told["reachable_cells"] == before.free.sum()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = load_map(out)
    assert np.array_equal(again.free, before.free)
    assert np.array_equal(again.occupied, ~before.free)
    assert again.frame == before.frame
    after = clean_map(again, resolution, 0.0)
    assert np.array_equal(after.free, before.free)
    corner, other = (clean.frame.cell_to_metres(0, 0) for clean in (before, after))
    assert corner == pytest.approx(other)


def test_a_cleaned_map_is_a_ros_map(office, tmp_path):
    out = tmp_path / "clean.yaml"
    result = potlp("map", "clean", office, "--out", out)
    assert result.exit_code == 0
    assert "m2 free on the map" in result.stdout
    assert "cut off" in result.stdout
    fields = yaml.safe_load(out.read_text())
    assert set(fields) == {"image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"}
    assert (fields["mode"], fields["resolution"], fields["negate"]) == ("trinary", 0.2, 0)
    with Image.open(tmp_path / fields["image"]) as image:
        assert image.mode == "L"
        assert set(np.unique(np.asarray(image)).tolist()) == {0, 254}
        size = image.size
    # Two rooms of 4 m with a wall of a pixel between them, less than a cell at each side, and the ring.
    assert 8.05 / 0.2 - 3 <= size[0] - 2 <= 8.05 / 0.2
    assert 4.0 / 0.2 - 2 <= size[1] - 2 <= 4.0 / 0.2


def test_clean_writes_over_no_map(office, tmp_path):
    before = office.read_bytes(), office.with_suffix(".pgm").read_bytes()
    link = tmp_path / "other" / ".." / "office.yaml"
    (tmp_path / "other").mkdir()
    for out in (office, link):
        result = potlp("map", "clean", office, "--out", out)
        assert result.exit_code == 2
        assert "would overwrite the map itself" in result.stderr
    assert before == (office.read_bytes(), office.with_suffix(".pgm").read_bytes())
    clean = tmp_path / "clean.yaml"
    assert potlp("map", "clean", office, "--out", clean).exit_code == 0
    # Mended by hand, say.
    clean.with_suffix(".pgm").write_bytes(b"mine")
    result = potlp("map", "clean", office, "--out", clean)
    assert (result.exit_code, "exists: remove it" in result.stderr) == (2, True)
    assert clean.with_suffix(".pgm").read_bytes() == b"mine"
    result = potlp("map", "clean", office, "--out", tmp_path / "other.png")
    assert result.exit_code == 2
    assert "must end in .yaml" in result.stderr
    with pytest.raises(MapError, match=r"must end in \.yaml"):
        save_map(tmp_path / "clean", TWO_ROOMS, occupancy_map(TWO_ROOMS).frame)


@pytest.mark.parametrize("name", ["floor #2", "a: b", "[x]", "- 2", 'the "old" \\ wing', "étage 😀"])
def test_a_map_of_any_name_is_read_back(tmp_path, name):
    file = tmp_path / f"{name}.yaml"
    frame = occupancy_map(TWO_ROOMS).frame
    image = save_map(file, TWO_ROOMS, frame)
    read = load_map(file)
    assert (read.settings.image, read.frame) == (image, frame)
    # Other programs read it as plain YAML.
    assert yaml.safe_load(file.read_text("utf-8"))["image"] == image.name


# Label.


def test_labels_are_found_by_the_environment(office, tmp_path):
    kitchen, lab = metres(50, 50), metres(50, 140)
    corners = (metres(80, 100), metres(80, 120), metres(60, 120))
    room = " ".join(f"{x:g},{y:g}" for x, y in corners)
    told = as_json(
        *("map", "label", office, "--place", "kitchen={:g},{:g}".format(*kitchen)),
        *("--place", "lab={:g}, {:g}, 1".format(*lab), "--room", f"lab={room}"),
        *("--start", "0,5", "--task", "both=F kitchen & F lab"),
    )
    assert told["file"] == str(tmp_path / "office.places.yaml")
    with pytest.warns(MapWarning, match="cut off"):
        family = make(f"map:{office}")
    assert family.propositions == ("kitchen", "lab")
    assert family.tasks == {"both": "F kitchen & F lab"}
    world = family.generate(jax.random.key(0))
    letters = np.asarray(world.letters)
    assert letters[family.metres_to_cell(*kitchen)] == 1
    assert letters[family.metres_to_cell(*lab)] == 2
    assert letters[family.metres_to_cell(*metres(73, 115))] == 2
    assert told["cells"] == {"kitchen": int((letters & 1).sum()), "lab": int((letters >> 1 & 1).sum())}
    assert tuple(np.asarray(world.start).tolist()) == family.metres_to_cell(0, 5)


def test_labels_are_added_to(office, tmp_path):
    out = tmp_path / "labels" / "mine.yaml"
    assert potlp("map", "label", office, "--place", "a=0,5", "--out", out, "--task", "1=F a").exit_code == 0
    again = potlp("map", "label", office, "--place", "b=1,5", "--out", out)
    assert again.exit_code == 2
    assert "mine.yaml exists: --add adds to it" in again.stderr
    assert (
        potlp("map", "label", office, "--add", "--place", "a=1,6,0.3", "--place", "b=5,5", "--out", out).exit_code == 0
    )
    labels = load_places(out)
    assert labels.propositions == (
        ("a", (Disc((0.0, 5.0), 0.5), Disc((1.0, 6.0), 0.3))),
        ("b", (Disc((5.0, 5.0), 0.5),)),
    )
    assert (labels.start, labels.tasks) == (None, (("1", "F a"),))


def test_places_are_written_as_they_are_read(tmp_path):
    places = Places(
        (
            ("a", (Disc((0.1 + 0.2, -1e-7), 0.5), Polygon(((0, 0), (2.5, 0), (1 / 3, 4))))),
            ("b & c", (Disc((1, 2), 0),)),
        ),
        start=(-3.25, 7.0),
        tasks=(("1", 'F a & F "b & c"'), ("yes", "F a")),
        source=str(tmp_path / "labels.yaml"),
    )
    save_places(places, tmp_path / "labels.yaml")
    assert load_places(tmp_path / "labels.yaml") == places


@pytest.mark.parametrize(
    ("row", "col"), [(30, 90), (95, 50), (50, 200), (-40, 50)], ids=["wall", "unknown", "cut", "out"]
)
def test_a_point_out_of_reach_is_refused_and_the_proposed_one_is_not(office, row, col):
    x, y = metres(row, col)
    refused = potlp("map", "label", office, "--place", f"goal={x:g},{y:g}")
    assert refused.exit_code == 2
    assert "propositions: goal: the robot cannot reach" in refused.stderr
    assert not office.with_suffix(".places.yaml").exists()
    nearer = refused.stderr.split("can reach is at [")[1].split("]")[0].replace(" ", "")
    assert potlp("map", "label", office, "--place", f"goal={nearer}").exit_code == 0
    clean = clean_map(load_map(office))
    (region,) = load_places(office.with_suffix(".places.yaml")).propositions[0][1]
    free = [clean.frame.cell_to_metres(*cell) for cell in np.argwhere(clean.free).tolist()]
    assert math.dist(region.centre, (x, y)) <= min(math.dist(cell, (x, y)) for cell in free) + 0.01


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "nothing to label: give a --place or a --room"),
        (("--place", "0,5"), "write --place NAME=X,Y[,RADIUS]"),
        (("--place", "a="), "write --place NAME=X,Y[,RADIUS]"),
        (("--place", "a=0"), "give x and y in metres"),
        (("--place", "a=0,five"), "are no numbers joined by commas"),
        (("--place", "a=0,nan"), "are no numbers joined by commas"),
        (("--place", "a=0,5,-1"), "a radius of -1 m is negative"),
        (("--room", "a=0,5 1,5"), "give three corners or more"),
        (("--room", "a=0,5 1,5 1"), "give three corners or more"),
        (("--room", "a=50,50 51,50 51,51"), "lies outside of the map's reachable part"),
        (("--place", "a=0,5", "--start", "0"), "give x and y in metres: 1.5,2"),
        (("--place", "a=0,5", "--start", "-1,2"), "start: [-1, 2] is blocked"),
        (("--place", "a=0,5", "--task", "F a"), "write --task NAME=FORMULA"),
        (("--place", "a=0,5", "--task", "1=F b"), "unknown proposition"),
        (("--place", "a=0,5", "--task", "1=G a"), "co-safe"),
        (("--place", "a=0,5", "--add"), "office.places.yaml: cannot be read"),
        (("--place", "a=0,5", "--resolution", "0.01"), "finer than the map's 0.05 m a pixel"),
        (tuple(f"--place=p{i}=0,5" for i in range(17)), "at most 16"),
    ],
)
def test_bad_labels_are_one_message_and_write_nothing(office, options, message):
    result = potlp("map", "label", office, *options)
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert not office.with_suffix(".places.yaml").exists()


# Preview.


def colours_at(figure, points):
    """What the picture shows at points in metres."""
    figure.canvas.draw()
    image = np.asarray(figure.canvas.buffer_rgba())
    spots = np.round(figure.axes[0].transData.transform(points)).astype(int)
    return [tuple(image[image.shape[0] - 1 - up, across, :3].tolist()) for across, up in spots]


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_everything_is_drawn_where_it_is(tmp_path, yaw):
    file = write_map(tmp_path, p5(building()), origin=f"[-1.3, 2.7, {yaw}]")
    frame = load_map(file).frame
    near, far = frame.cell_to_metres(50, 50), frame.cell_to_metres(50, 140)
    places = Places((("near", (Disc(near, 0.6),)), ("far", (Disc(far, 0.6),))), start=frame.cell_to_metres(75, 75))
    with pytest.warns(MapWarning, match="cut off"):
        family = RosMap(RosMapConfig(file, places))
    figure = draw_places(family, family.generate(jax.random.key(0)), "a map")
    there = {(50, 60): area_colour(0), (50, 150): area_colour(1), (15, 85): REACHED, (20, 90): OBSTACLE}
    there[20, 220] = CUT_OFF
    shown = colours_at(figure, [frame.cell_to_metres(*pixel) for pixel in there])
    assert shown == [rgb(colour) for colour in there.values()]
    axes = figure.axes[0]
    (start,) = (line for line in axes.lines if line.get_marker() == "o")
    assert np.allclose(np.ravel(start.get_xydata()), places.start)
    (bar,) = (line for line in axes.lines if line.get_linewidth() == 3)
    length = float(np.ptp(np.asarray(bar.get_xdata())))
    assert f"{length:g} m" in [text.get_text() for text in axes.texts]
    assert {"near", "far"} <= {text.get_text() for text in axes.texts}


def test_thin_walls_survive_in_the_picture_of_a_large_map():
    free = np.ones((300, 2900), bool)
    free[0] = free[-1] = free[:, 0] = free[:, -1] = False
    free[:, 1601] = False
    image_map = occupancy_map(free, pixel="0.05")
    figure = draw_map(image_map, clean_map(image_map, 1.0, 0.0), "large")
    x, y = image_map.frame.cell_to_metres(150, 1601)
    assert rgb(OBSTACLE) in colours_at(figure, [(x + offset, y) for offset in (-0.1, -0.05, 0.0, 0.05, 0.1)])


def test_preview_writes_pictures(office, tmp_path):
    plain = potlp("map", "preview", office, "--out", tmp_path / "plain.svg")
    assert plain.exit_code == 0
    labels = tmp_path / "labels.yaml"
    assert potlp("map", "label", office, "--place", "kitchen=0,5", "--out", labels).exit_code == 0
    assert potlp("map", "preview", office, "--labels", labels, "--out", tmp_path / "labelled.svg").exit_code == 0

    def words(file):
        return ["".join(node.itertext()) for node in ElementTree.parse(file).iter("{http://www.w3.org/2000/svg}text")]

    # With a rim of white: beneath the area of the part there are walls.
    assert "stroke: #ffffff; stroke-width: 2.5" in (tmp_path / "plain.svg").read_text("utf-8")
    for part in ("x (m)", "y (m)", "2 m", "reachable", "cut off, 10 m² in all"):
        assert part in words(tmp_path / "plain.svg")
    assert "kitchen" in words(tmp_path / "labelled.svg")
    assert "kitchen" not in words(tmp_path / "plain.svg")
    refused = potlp("map", "preview", office, "--out", tmp_path / "picture.docx")
    assert refused.exit_code == 2
    assert "docx" in refused.stderr


def test_a_map_of_specks_alone_is_drawn(tmp_path):
    small = np.zeros((10, 10), bool)
    small[1:9, 1:9] = True
    save_map(tmp_path / "small.yaml", small, GridFrame(10, 10, 0.05, 0.0, 0.0, 0.0))
    drawn = potlp("map", "preview", tmp_path / "small.yaml", "--radius", "0", "--out", tmp_path / "small.png")
    assert drawn.exit_code == 0, drawn.stderr
    assert (tmp_path / "small.png").stat().st_size


def test_labels_that_cannot_be_written_leave_those_of_before(office, tmp_path, monkeypatch):
    labels = tmp_path / "labels.yaml"
    assert potlp("map", "label", office, "--place", "a=0,5", "--out", labels).exit_code == 0
    before = labels.read_text("utf-8")

    def full(_descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("potlp_jax.files.os.fsync", full)
    assert potlp("map", "label", office, "--add", "--place", "b=6,5", "--out", labels).exit_code != 0
    assert labels.read_text("utf-8") == before
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith("labels")] == ["labels.yaml"]


@pytest.mark.parametrize("name", ["küche", "my room", "U", "xor", "it's", "Fire"])
def test_the_next_command_works_for_names_of_any_kind(office, tmp_path, name):
    labelled = potlp(
        "map", "label", office, "--place", f"{name}=0,5", "--place", "b=6,5", "--out", tmp_path / "my labels.yaml"
    )
    (hint,) = (line for line in labelled.stdout.splitlines() if line.startswith("next: "))
    command, *rest = shlex.split(hint.removeprefix("next: "))
    assert (command, rest[0], rest[2]) == ("potlp", "run", "--task")
    world = make(rest[1])
    assert world.task(rest[3]).propositions == (name, "b")


# All of it.


def test_from_a_map_to_a_trial(office, tmp_path):
    clean = tmp_path / "clean.yaml"
    assert potlp("map", "clean", office, "--out", clean).exit_code == 0
    labelled = potlp("map", "label", clean, "--place", "a=0,5", "--place", "b=6,5", "--start", "2,3", "--radius", "0")
    assert labelled.exit_code == 0
    (hint,) = (line for line in labelled.stdout.splitlines() if line.startswith("next: "))
    assert hint == f"next: potlp run map:{clean},radius=0 --task 'F a & F b'"
    trial = as_json("run", f"map:{clean},radius=0", "--task", "F a & F b", "--policy", "baseline")
    assert trial["outcome"] == "satisfied"
    # Metres: not shorter than from the start to the nearer place and on to the edge of the other.
    assert 6.0 - 2 * 0.5 < trial["cost"] < 25


@pytest.mark.parametrize(
    "arguments",
    [("inspect",), ("clean", "--out", "new.yaml"), ("label", "--place", "a=1,1"), ("preview", "--out", "a.png")],
)
def test_a_map_that_is_not_there(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = potlp("map", arguments[0], "missing.yaml", *arguments[1:])
    assert result.exit_code == 2
    assert "missing.yaml: cannot be read" in result.stderr
    assert list(tmp_path.iterdir()) == []


# Maps made by others.


@pytest.mark.parametrize("name", ["uma_rooms", "sarmis_home", "kth_50052752"])
def test_real_maps_go_all_the_way(external_data, tmp_path, name):
    file = external_data / f"maps/{name}.yaml"
    found = as_json("map", "inspect", file)
    assert found["passages"]
    assert found["defects"]
    out = tmp_path / "clean.yaml"
    assert as_json("map", "clean", file, "--out", out)["reachable_cells"] == found["reachable_cells"]
    clean = load_map(out)
    x, y = clean.frame.cell_to_metres(*np.argwhere(clean.free)[7].tolist())
    labels = tmp_path / "labels.yaml"
    assert potlp("map", "label", file, "--place", f"goal={x:.3f},{y:.3f}", "--out", labels).exit_code == 0
    picture = tmp_path / "map.png"
    assert potlp("map", "preview", file, "--labels", labels, "--out", picture).exit_code == 0
    with Image.open(picture) as image:
        colours = {colour for _, colour in image.convert("RGB").getcolors(1 << 20)}
    assert rgb(area_colour(0)) in colours


def test_what_the_cells_cut_off_on_a_large_map(external_data):
    image_map = load_map(external_data / "maps/gdc_floor2.yaml")
    assert not [part for part in clean_map(image_map, 0.2, 0.1).cut_off if part.cause is Cause.CELLS]
    coarse = [part for part in clean_map(image_map, 0.4, 0.1).cut_off if part.cause is Cause.CELLS]
    # The room in the south-east and the loop of corridors behind it.
    assert coarse[0].area > 50
    assert 5 < coarse[0].at[0] < 26
    assert -14 < coarse[0].at[1] < 1


def test_inspect_names_a_threshold_that_is_wrong(external_data):
    found = as_json("map", "inspect", external_data / "maps/quirks/pal_office_freethresh025.yaml")
    assert "set free_thresh to 0.196 or less" in found["defects"][0]


@pytest.mark.parametrize(
    "words",
    ["map label . --place a=1,2", "map preview . --out x.png", "run parcels:.", "run map:.", "map inspect ."],
)
def test_a_folder_in_place_of_a_file_is_named(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, words.split())
    assert (result.exit_code, "is a folder" in result.output) == (2, True), result.output


def test_a_clean_map_needs_a_name(office):
    result = potlp("map", "clean", office, "--out", ".")
    assert (result.exit_code, "--out . is a folder" in result.output) == (2, True), result.output
