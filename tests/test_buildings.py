"""Buildings of other formats: what becomes of walls, doors, names and scales, on small files written here."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.registry import make
from potlp_jax.environments.ros.buildings import load_building
from potlp_jax.environments.ros.cleaning import clean_map
from potlp_jax.environments.ros.drawn_maps import MOST_PIXELS, Wall, close_outer_walls, frame_around
from potlp_jax.errors import MapError, MapWarning

TWO_ROOMS = """
levels:
  L1:
    measurements:
    - [0, 1, {distance: [3, 10]}]
    vertices:
    - [0, 0, 0, ""]
    - [200, 0, 0, ""]
    - [200, 100, 0, ""]
    - [0, 100, 0, ""]
    - [100, 0, 0, ""]
    - [100, 40, 0, ""]
    - [100, 60, 0, ""]
    - [100, 100, 0, ""]
    - [20, 20, 0, pantry, {is_parking_spot: [4, true]}]
    - [180, 80, 0, desk]
    - [180, 20, 0, desk]
    walls:
    - [0, 1, {}]
    - [1, 2, {}]
    - [2, 3, {}]
    - [3, 0, {}]
    - [4, 5, {}]
    - [6, 7, {}]
    doors:
    - [5, 6, {name: [1, middle], type: [1, DOOR]}]
    floors:
    - {vertices: [0, 1, 2, 3]}
    lanes:
    - [8, 9, {}]
"""
"""Two rooms of 5 m by 5 m, 20 pixels a metre, and a door of 1 m in the wall between them, which ends at its posts."""


@pytest.fixture
def office(tmp_path):
    file = tmp_path / "two.building.yaml"
    file.write_text(TWO_ROOMS.replace("DOOR", "hinged"))
    return file


def test_walls_doors_scale_and_names_of_open_rmf(office):
    read = load_building(office)
    assert read.kind == "Open-RMF level L1"
    assert read.free.sum() * read.frame.resolution**2 == pytest.approx(50, rel=0.1)
    assert read.occupied[read.frame.metres_to_cell(5.0, -1.0)]
    assert read.free[read.frame.metres_to_cell(5.0, -2.5)], "the door is open"
    assert not read.free[read.frame.metres_to_cell(-0.5, -2.5)], "nothing is free outside of the floor"
    assert clean_map(read).cut_off == ()
    assert read.places is not None
    assert {name: [region.centre for region in regions] for name, regions in read.places.propositions} == {
        "pantry": [(1.0, -1.0)],
        "desk": [(9.0, -4.0), (9.0, -1.0)],
    }


def test_doors_of_an_unknown_type_are_closed(office):
    office.write_text(TWO_ROOMS.replace("DOOR", "bricked"))
    with pytest.warns(MapWarning, match="closed: 'middle'"):
        read = load_building(office)
    assert [round(part.area) for part in clean_map(read).cut_off] == pytest.approx([23], abs=3)


def test_walls_may_go_through_the_doors_that_open(office):
    office.write_text(TWO_ROOMS.replace("DOOR", "hinged").replace("    doors:", "    - [4, 7, {}]\n    doors:"))
    assert clean_map(load_building(office)).cut_off == ()


def test_a_closed_door_lets_no_outside_in(office):
    """Without floors, what walls and doors enclose is inside."""
    outer = (
        TWO_ROOMS.replace("DOOR", "bricked").replace("    - [0, 1, {}]\n", "").replace("[5, 6, {name", "[0, 1, {name")
    )
    office.write_text(outer[: outer.index("    floors:")])
    with pytest.warns(MapWarning, match="closed: 'middle'"):
        read = load_building(office)
    assert read.free.sum() * read.frame.resolution**2 == pytest.approx(50, rel=0.1)


def test_metres_and_levels_without_floors(office):
    text = TWO_ROOMS.replace("DOOR", "sliding").replace("levels:", "coordinate_system: cartesian_meters\nlevels:")
    office.write_text(text[: text.index("    floors:")])
    read = load_building(office)
    assert read.frame.resolution == 0.05
    assert read.free[read.frame.metres_to_cell(50, 20)]
    assert not read.free[read.frame.metres_to_cell(-0.5, 20)]


def test_places_of_the_file_that_cannot_be_reached_are_said(office):
    office.write_text(TWO_ROOMS.replace("DOOR", "hinged").replace('[0, 0, 0, ""]', "[0, 0, 0, corner]"))
    with pytest.warns(MapWarning, match="places that the robot cannot reach are left out: corner"):
        generator = make(f"map:{office},level=L1")
    assert generator.propositions == ("pantry", "desk")


def test_the_places_of_the_file_are_the_propositions_of_its_worlds(office):
    generator = make(f"map:{office},level=L1")
    assert generator.propositions == ("pantry", "desk")
    assert set(np.unique(np.asarray(generator.world(0).letters)).tolist()) == {0, 1, 2}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[0, 1, {distance: [3, 10]}]", "[0, 99, {distance: [3, 10]}]", "'99' is no number of one of the 11 vertices"),
        ("measurements:\n    - [0, 1, {distance: [3, 10]}]", "measurements: []", "the scale is not known"),
        ("distance: [3, 10]", "distance: [3, -1]", "both must be positive"),
        ("levels:", "coordinate_system: wgs84\nlevels:", "'wgs84' is not read"),
        ("{vertices: [0, 1, 2, 3]}", "{vertices: [0, 1]}", "three vertices or more"),
        ("[20, 20, 0, pantry, {is_parking_spot: [4, true]}]", "[x, 20]", "is not a finite number"),
    ],
)
def test_what_is_wrong_with_a_building_is_said(office, old, new, message):
    office.write_text(TWO_ROOMS.replace("DOOR", "hinged").replace(old, new))
    with pytest.raises(MapError, match=message.replace("(", r"\(")) as caught:
        load_building(office)
    assert str(office) in str(caught.value)


def test_levels_are_named(office, tmp_path):
    with pytest.raises(MapError, match="there is no level 'L9'; there are: L1"):
        load_building(office, "L9")
    plan = tmp_path / "plan.world"
    plan.write_text(gazebo([]))
    with pytest.raises(MapError, match=r"only a building\.yaml of Open-RMF has levels"):
        load_building(plan, "L1")


def outer_walls(width, height):
    return [box(0, 0, width), box(0, height, width), box(0, 0, height, HALF_PI), box(width, 0, height, HALF_PI)]


@pytest.mark.parametrize("rooms", [1, 3, 4])
def test_rooms_at_a_closed_outer_wall_are_inside(tmp_path, rooms):
    """Rooms of 6 m by 5 m in a row, with doors of 1 m between them."""
    between = [
        wall for room in range(1, rooms) for wall in (box(6 * room, 0, 2, HALF_PI), box(6 * room, 3, 2, HALF_PI))
    ]
    file = tmp_path / "row.world"
    file.write_text(gazebo([*outer_walls(6 * rooms, 5), *between]))
    read = load_building(file)
    assert read.closed_gaps == 0
    assert clean_map(read).cut_off == ()
    assert read.free.sum() * read.frame.resolution**2 == pytest.approx(30 * rooms, rel=0.08)


def test_degrees_and_models_within_models_are_read(tmp_path):
    turned = gazebo([*outer_walls(12, 5), box(6, 0, 2, HALF_PI), box(6, 3, 2, HALF_PI)], "3 -2 0 0 0 0.5")
    inner = "".join([box(0, 0, 2, HALF_PI), box(0, 3, 2, HALF_PI)])
    nested = (
        gazebo(outer_walls(12, 5), "3 -2 0 0 0 28.64788975654116")
        .replace("<pose>3 -2", "<pose degrees='true'>3 -2")
        .replace("</model>", f"<model name='n'><pose>6 0 0 0 0 0</pose>{inner}</model></model>")
    )
    files = tmp_path / "turned.world", tmp_path / "nested.world"
    for file, text in zip(files, (turned, nested), strict=True):
        file.write_text(text)
    expected, found = (load_building(file) for file in files)
    np.testing.assert_array_equal(found.occupied, expected.occupied)
    np.testing.assert_array_equal(found.free, expected.free)


def test_included_files_are_said_to_be_left_out(tmp_path):
    file = tmp_path / "floor.world"
    file.write_text(gazebo([*leaking(), "<include><uri>model://table</uri></include>"]))
    with pytest.warns(MapWarning, match="1 included files are left out"):
        load_building(file)


def box(x, y, length, yaw=0.0, height=2.5, thickness=0.1, roll=0.0):
    """A wall as the floors of KTH have them: the box begins at the pose of its link."""
    return (
        f"<link name='wall'><collision name='c'><geometry><box><size>{length} {thickness} {height}</size></box>"
        f"</geometry><pose>{length / 2} 0 {height / 2} {roll} 0 0</pose></collision>"
        f"<pose>{x} {y} 0 0 0 {yaw}</pose></link>"
    )


def gazebo(links, pose="0 0 0 0 0 0"):
    return (
        f"<sdf version='1.6'><world name='w'><model name='m'><pose>{pose}</pose>{''.join(links)}</model></world></sdf>"
    )


HALF_PI = np.pi / 2


def leaking():
    """Two rooms of 6 m by 5 m with a door between them, and a window of 2 m in the southern wall of the first."""
    return [
        box(0, 0, 2), box(4, 0, 8), box(0, 5, 12), box(0, 0, 5, HALF_PI), box(12, 0, 5, HALF_PI),
        box(6, 0, 2, HALF_PI), box(6, 3, 2, HALF_PI),
    ]  # fmt: skip


@pytest.mark.parametrize("pose", ["0 0 0 0 0 0", "3 -2 0 0 0 0.4"])
def test_windows_of_gazebo_worlds_are_closed_and_doors_are_not(tmp_path, pose):
    file = tmp_path / "floor.world"
    file.write_text(gazebo(leaking(), pose))
    read = load_building(file)
    assert read.closed_gaps == 1
    clean = clean_map(read)
    assert clean.cut_off == ()
    assert read.free.sum() * read.frame.resolution**2 == pytest.approx(60, rel=0.08)


def test_boxes_that_are_in_nobodys_way_are_no_walls(tmp_path):
    file = tmp_path / "floor.world"
    floor = box(6, 0, 5, HALF_PI, height=0.05)
    file.write_text(gazebo([*leaking(), floor, box(1, 1, 3, roll=0.3)]))
    with pytest.warns(MapWarning, match="1 shapes that are no upright boxes are left out"):
        assert load_building(file).closed_gaps == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<sdf/>", "there are no walls"),
        ("<robot/>", "must hold a world of SDF"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><sdf>&b;</sdf>", "declares entities"),
        (gazebo([box(0, 0, 2).replace("<size>2", "<size>two")]), "must be 3 numbers"),
        (gazebo([box(0, 0, 2).replace("<pose>0 0", "<pose relative_to='x'>0 0")]), "relative to a frame by name"),
        (
            gazebo([box(0, 0, 2).replace("<pose>0 0", "<pose rotation_format='quat_xyzw'>0 0")]),
            "'quat_xyzw' is not read",
        ),
        ("<sdf", "valid XML"),
    ],
)
def test_what_is_wrong_with_a_world_is_said(tmp_path, text, message):
    file = tmp_path / "floor.world"
    file.write_text(text)
    with pytest.raises(MapError, match=message):
        load_building(file)


def test_a_gap_that_is_wider_than_a_window_is_not_closed():
    walls = [Wall((0, 0), (2, 0), 0.1), Wall((8, 0), (12, 0), 0.1), Wall((0, 0), (0, 5), 0.1)]
    walls += [Wall((12, 0), (12, 5), 0.1), Wall((0, 5), (12, 5), 0.1)]
    frame = frame_around(Path("plan"), [corner for wall in walls for corner in wall.corners])
    _, closed, free = close_outer_walls(walls, frame)
    assert not closed.any()
    assert not free.any()


def test_large_buildings_have_larger_pixels():
    frame = frame_around(Path("plan"), [(0, 0), (400, 300)])
    assert frame.height * frame.width <= MOST_PIXELS
    assert frame.resolution == 0.1
    with pytest.raises(MapError, match="check the scale"):
        frame_around(Path("plan"), [(0, 0), (1e6, 1e6)])


def test_every_level_has_labels_of_its_own(office):
    text = office.read_text()
    office.write_text(text + text[text.index("  L1:") :].replace("  L1:", "  L2:", 1).replace("pantry", "lab"))
    label = ["map", "label", str(office), "--level", "L1", "--named", "pantry"]
    labelled = CliRunner().invoke(app, label)
    assert labelled.exit_code == 0, labelled.stderr
    assert office.with_suffix(".L1.places.yaml").is_file()
    assert make(f"map:{office},level=L1").propositions == ("pantry",)
    assert make(f"map:{office},level=L2").propositions == ("lab", "desk")


def test_labels_of_no_level_are_said_not_to_be_read(office):
    labelled = CliRunner().invoke(app, ["map", "label", str(office), "--named", "pantry"])
    assert labelled.exit_code == 0, labelled.stderr
    assert make(f"map:{office}").propositions == ("pantry",)
    with pytest.warns(MapWarning, match="belongs to no level and is not read"):
        assert make(f"map:{office},level=L1").propositions == ("pantry", "desk")


def test_every_command_takes_every_format(office, tmp_path):
    world = tmp_path / "floor.world"
    world.write_text(gazebo(leaking()))
    for file in (office, world):
        shown = CliRunner().invoke(app, ["map", "inspect", str(file)])
        assert shown.exit_code == 0, shown.stderr
        assert "plan " in shown.stdout
        picture = tmp_path / "plan.svg"
        drawn = CliRunner().invoke(app, ["map", "preview", str(file), "--out", str(picture)])
        assert drawn.exit_code == 0, drawn.stderr
        out = tmp_path / f"{file.stem}-clean.yaml"
        assert CliRunner().invoke(app, ["map", "clean", str(file), "--out", str(out)]).exit_code == 0
        assert load_building(out).kind == "ROS map"
    labelled = CliRunner().invoke(app, ["map", "label", str(office), "--named", "desk", "--task", "1=F desk"])
    assert labelled.exit_code == 0, labelled.stderr
    assert "desk" in labelled.stdout
    assert make(f"map:{office}").propositions == ("desk",)
    refused = CliRunner().invoke(app, ["map", "label", str(office), "--add", "--named", "attic"])
    assert "names pantry, desk" in refused.stderr


@pytest.mark.parametrize(("name", "level"), [("office", None), ("hotel", "L1"), ("clinic", "L2"), ("triple_H", None)])
def test_demos_of_open_rmf_can_be_moved_in(external_data, name, level):
    read = load_building(external_data / "buildings" / "rmf" / f"{name}.building.yaml", level)
    clean = clean_map(read)
    assert clean.area.reachable > 0.8 * clean.area.resampled


@pytest.mark.parametrize("name", ["50009418", "0510032322", "50052755"])
def test_floors_of_kth_are_closed(external_data, name):
    read = load_building(external_data / "buildings" / "kth" / f"{name}.world")
    edge = np.concatenate([read.free[0], read.free[-1], read.free[:, 0], read.free[:, -1]])
    assert not edge.any()
    assert clean_map(read).area.reachable > 0.4 * clean_map(read).area.resampled


def test_entities_are_found_in_every_encoding(tmp_path):
    file = tmp_path / "floor.world"
    text = "<?xml version='1.0' encoding='UTF-16'?><!DOCTYPE a [<!ENTITY b 'c'>]><sdf>&b;</sdf>"
    file.write_bytes(text.encode("utf-16"))
    with pytest.raises(MapError, match="declares entities"):
        load_building(file)
