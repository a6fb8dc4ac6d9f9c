"""Floor plans: each trap of the format on a small plan written here, and the corpora made by others."""

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field

import jax
import networkx
import numpy as np
import pytest
from scipy import ndimage

from potlp_jax.cli.inputs import read_split
from potlp_jax.environments.campus.floor_plan_xml import read_kinds, read_plan
from potlp_jax.environments.campus.floor_plans import FloorPlanConfig, FloorPlans
from potlp_jax.environments.campus.furnishing import NO_ROOM, PEOPLE, Kind, missing_kinds
from potlp_jax.environments.campus.plan_floor import PlanFloor, rasterise
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, default_split, usable_splits, world_key
from potlp_jax.errors import MapError, MapWarning, SpecificationError, TaskError, WorldError
from potlp_jax.sweep.specification import specification_from_dict

CLEAN = {"rooms_lost": 0, "doors_without_point": 0, "doors_unplaced": 0, "doors_narrowed": 0}
USABLE = 25
"""Plans of the corpora that have an office, a laboratory and a classroom under the shipped meaning of the labels."""


@dataclass
class Drawing:
    """A plan to be written; ten pixels a metre unless the scale says otherwise."""

    pixels: str = "9"
    real: str = "90"
    unit: str = "cm"
    count: int = 0
    rooms: list[str] = field(default_factory=list)
    doors: dict[str, list[str]] = field(default_factory=dict)
    segments: dict[str, list[str]] = field(default_factory=dict)

    def room(self, name, label, *corners):
        points = "".join(f'<point x="{x}" y="{y}"/>' for x, y in corners)
        self.rooms.append(
            f'<space id="{name}"><labels><type>R</type><label>{label}</label></labels>'
            f"<bounding_polygon>{points}</bounding_polygon><space_representation>SEGMENTS {name}</space_representation>"
            f"<portals>PORTALS {name}</portals></space>"
        )
        return self

    def box(self, name, label, left, top, right, bottom):
        return self.room(name, label, (left, top), (right, top), (right, bottom), (left, bottom))

    def door(self, rooms, *points, kind="EXPLICIT", features="NORMAL"):
        """One point for both rooms, or one for each; none: the door is mentioned but not drawn."""
        name = f"door-{self.count}"
        self.count += 1
        ids = "".join(f"<id>{room}</id>" for room in rooms)
        portal = f"<portal><linesegment>{name}</linesegment><target>{ids}</target></portal>"
        for index, room in enumerate(rooms):
            self.doors.setdefault(room, []).append(portal)
            for x, y in points[min(index, len(points) - 1)] if points else []:
                self.segments.setdefault(room, []).append(
                    f'<linesegment id="{name}"><point x="{x}" y="{y}"/><point x="{x}" y="{y}"/>'
                    f"<class>PORTAL</class><type>{kind}</type><features>{features}</features></linesegment>"
                )
        return self

    def text(self):
        def fill(match):
            source = self.segments if match[1] == "SEGMENTS" else self.doors
            return "".join(source.get(match[2], []))

        spaces = re.sub(r"(SEGMENTS|PORTALS) ([^<]+)", fill, "".join(self.rooms))
        return (
            f"<building><scale><represented_distance><value>{self.pixels}</value></represented_distance>"
            f"<real_distance><value>{self.real}</value><um>{self.unit}</um></real_distance></scale>"
            f"<floor><spaces>{spaces}</spaces></floor></building>"
        )

    def write(self, folder, name="plan"):
        file = folder / f"{name}.xml"
        file.write_text(self.text())
        return file


def _academic() -> Drawing:
    """A hallway of 20 x 2 m with three rooms of 6 x 5 m above it, walls 0.3 m thick, doors in the middle."""
    drawing = Drawing().box("hall", "CORRIDOR", 0, 53, 200, 73)
    for number, (name, label) in enumerate((("o", "OFFICE"), ("l", "LAB"), ("c", "CLASSROOM"))):
        left = 63 * number
        drawing.box(name, label, left, 0, left + 60, 50)
        drawing.door((name, "hall"), [(left + 30, 50)], [(left + 30, 53)])
    return drawing


def _floor(drawing, folder, resolution=0.5) -> PlanFloor:
    return rasterise(read_plan(drawing.write(folder)), read_kinds(), resolution)


def _area(found: PlanFloor, room: str) -> float:
    """Square metres, doors left out."""
    floor = found.floor
    cells = (floor.rooms == found.room_ids.index(room)) & ~floor.doors
    return np.count_nonzero(cells) * floor.resolution**2


def _doors(found: PlanFloor) -> list[np.ndarray]:
    """The cells of each door, doors that touch counting as one."""
    parts, count = ndimage.label(found.floor.doors, np.ones((3, 3)))
    return [np.argwhere(parts == number) for number in range(1, count + 1)]


def _is_connected(found: PlanFloor) -> bool:
    return ndimage.label(~found.floor.occupied)[1] == 1


def _losses(found: PlanFloor) -> dict[str, int]:
    return {name: getattr(found.report, name) for name in CLEAN}


def test_rooms_have_their_places_kinds_and_sizes(tmp_path):
    found = _floor(_academic(), tmp_path)
    assert _losses(found) == CLEAN
    assert dict(zip(found.room_ids, found.floor.kinds, strict=True)) == {
        "hall": Kind.HALLWAY,
        "o": Kind.OFFICE,
        "l": Kind.LAB,
        "c": Kind.CLASSROOM,
    }
    for room, x, y in (("hall", 10, 6.3), ("o", 3, 2.5), ("l", 9.3, 2.5), ("c", 15.6, 2.5)):
        cell = found.frame.metres_to_cell(x, -y)
        assert found.room_ids[found.floor.rooms[cell]] == room
    assert _area(found, "hall") == 20 * 2
    assert 0.75 * 30 < _area(found, "o") <= 30
    assert found.floor.occupied[[0, -1]].all()
    assert found.floor.occupied[:, [0, -1]].all()


def test_point_doors_are_opened_through_double_walls(tmp_path):
    found = _floor(_academic(), tmp_path)
    doors = _doors(found)
    assert len(doors) == 3
    for cells, x in zip(sorted(doors, key=lambda cells: cells[0, 1]), (3.0, 9.3, 15.6), strict=True):
        assert len(np.unique(cells[:, 1])) == 2, "0.9 m are two cells"
        middle = np.mean([found.frame.cell_to_metres(*map(int, cell)) for cell in cells], axis=0)
        assert middle == pytest.approx((x, -5.15), abs=0.51)
    assert _is_connected(found)


def test_nothing_but_the_doors_joins_rooms(tmp_path):
    floor = _floor(_academic(), tmp_path).floor
    parts, count = ndimage.label(~floor.occupied & ~floor.doors)
    assert count == 4
    assert all(len(np.unique(floor.rooms[parts == number])) == 1 for number in range(1, count + 1))


@pytest.mark.parametrize("gap", [0, 1, 3, 6, 10])
def test_walls_of_every_thickness(tmp_path, gap):
    """From outlines that share a line to walls of a metre; thin walls are one cell, and the hallway is not narrowed."""
    drawing = Drawing().box("o", "OFFICE", 0, 0, 60, 50).box("hall", "CORRIDOR", 0, 50 + gap, 60, 70 + gap)
    drawing.door(("o", "hall"), [(30, 50)], [(30, 50 + gap)])
    found = _floor(drawing, tmp_path)
    assert _losses(found) == CLEAN
    assert _is_connected(found)
    assert len(_doors(found)) == 1
    assert 10 <= _area(found, "hall") <= 14
    wall = found.floor.occupied[:, 2].nonzero()[0]
    between = wall[(wall > 1) & (wall < len(found.floor.rooms) - 2)]
    assert 1 <= len(between) <= gap / 5 + 1


def test_a_double_door_is_twice_as_wide_and_an_opening_as_wide_as_the_rooms_face_each_other(tmp_path):
    widths = {}
    for name, options in (
        ("single", {}),
        ("double", {"features": "DOUBLE"}),
        ("opening", {"kind": "IMPLICIT"}),
    ):
        drawing = Drawing().box("a", "CORRIDOR", 0, 0, 80, 30).box("b", "CORRIDOR", 20, 30, 80, 60)
        found = _floor(drawing.door(("a", "b"), [(50, 30)], **options), tmp_path)
        assert _losses(found) == CLEAN
        widths[name] = np.count_nonzero(found.floor.doors)
    assert widths == {"single": 2, "double": 4, "opening": 12}


def test_an_opening_follows_a_boundary_that_is_not_straight(tmp_path):
    drawing = Drawing().room("a", "CORRIDOR", (0, 0), (100, 0), (100, 60), (0, 20))
    drawing.room("b", "CORRIDOR", (0, 20), (100, 60), (100, 90), (0, 90))
    found = _floor(drawing.door(("a", "b"), [(50, 40)], kind="IMPLICIT"), tmp_path)
    open_columns = (~found.floor.occupied).sum(axis=0)
    assert (open_columns[2:-2] >= 16).all(), "no wall of the boundary is left"


@pytest.mark.parametrize("degrees", [15, 30, 45, 60, 80])
def test_doors_in_oblique_walls(tmp_path, degrees):
    turn = complex(math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))

    def turned(*points):
        return [((point * turn).real, (point * turn).imag) for point in points]

    drawing = Drawing().room("o", "OFFICE", *turned(0, 60, 60 + 50j, 50j))
    drawing.room("hall", "HALL", *turned(53j, 60 + 53j, 60 + 90j, 90j))
    drawing.door(("o", "hall"), turned(30 + 50j), turned(30 + 53j))
    found = _floor(drawing, tmp_path)
    assert found.report.doors_unplaced == found.report.rooms_lost == 0
    assert _is_connected(found)
    assert len(_doors(found)) == 1


def test_a_door_in_a_corner_stays_in_its_wall(tmp_path):
    drawing = Drawing().box("o", "OFFICE", 0, 0, 40, 40).box("hall", "CORRIDOR", 0, 40, 80, 60)
    found = _floor(drawing.door(("o", "hall"), [(40, 40)]), tmp_path)
    assert _losses(found) == CLEAN
    assert _is_connected(found)


def test_rooms_without_doors_are_walled_up_and_counted(tmp_path):
    drawing = _academic().box("lonely", "OFFICE", 0, 80, 50, 120)
    found = _floor(drawing, tmp_path)
    assert "lonely" not in found.room_ids
    assert found.report.rooms_without_door == found.report.rooms_lost == 1
    assert found.floor.occupied[found.frame.metres_to_cell(2.5, -10.0)]
    assert "1 rooms without door" in str(found.report)


def test_the_largest_part_of_a_plan_that_falls_apart_is_kept(tmp_path):
    drawing = (
        _academic().box("x", "OFFICE", 0, 80, 50, 120).box("y", "LAB", 50, 80, 90, 120).door(("x", "y"), [(50, 99)])
    )
    found = _floor(drawing, tmp_path)
    assert set(found.room_ids) == {"hall", "o", "l", "c"}
    assert (found.report.rooms_cut_off, found.report.rooms_lost) == (2, 2)
    assert _is_connected(found)


def test_doors_that_are_not_drawn_or_not_between_their_rooms_are_counted(tmp_path):
    drawing = _academic().door(("o", "l")).door(("o", "c"), [(30, 20)])
    found = _floor(drawing, tmp_path)
    assert (found.report.doors, found.report.doors_without_point, found.report.doors_unplaced) == (5, 1, 1)
    assert len(_doors(found)) == 3


def test_rooms_too_narrow_for_the_resolution_are_counted(tmp_path):
    drawing = _academic().box("slit", "CLOSET", 0, 73, 2, 120).door(("slit", "hall"), [(1, 73)])
    found = _floor(drawing, tmp_path)
    assert found.report.rooms_without_cells == 1
    assert "slit" not in found.room_ids


def test_where_outlines_overlap_the_smaller_room_is_kept_whole(tmp_path):
    drawing = Drawing().box("closet", "CLOSET", 20, 10, 50, 40).box("hall", "HALL", 0, 0, 100, 100)
    found = _floor(drawing.door(("hall", "closet"), [(50, 25)]), tmp_path)
    assert found.floor.rooms[found.frame.metres_to_cell(3.5, -2.5)] == found.room_ids.index("closet")
    assert _losses(found) == CLEAN
    assert _is_connected(found)


def test_a_folder_of_plans_has_one_name_from_wherever_it_is_written(tmp_path, monkeypatch):
    (tmp_path / "plans").mkdir()
    _academic().write(tmp_path / "plans", "school")
    names = {make(f"floorplan:{tmp_path / 'plans'}").name}
    monkeypatch.chdir(tmp_path / "plans")
    assert names | {make("floorplan:.").name, make("floorplan:../plans").name} == {"floorplan:plans"}


@pytest.mark.parametrize(("pixels", "real", "unit", "factor"), [("18", "90", "cm", 2), ("9", "1.8", "m", 0.5)])
def test_the_scale_is_the_files(tmp_path, pixels, real, unit, factor):
    plain, scaled = _academic(), _academic()
    scaled.pixels, scaled.real, scaled.unit = pixels, real, unit
    one, other = read_plan(plain.write(tmp_path)), read_plan(scaled.write(tmp_path, "scaled"))
    assert other.rooms[0].area == pytest.approx(one.rooms[0].area / factor**2)


def test_worlds_on_a_plan_are_delivery_worlds(tmp_path):
    file = _academic().write(tmp_path, "school")
    generator = make(f"floorplan:{file}")
    assert isinstance(generator, FloorPlans)
    assert generator.name == "floorplan:school"
    assert generator.tasks["1"] == "F professor & F grad & F undergrad"
    starts = set()
    for index in range(5):
        world, found, placement = generator.generate_with_layout(world_key(Split.TEST, index, generator.name))
        starts.add(placement.start)
        letters = np.asarray(world.letters)
        for bit, (name, (kind,)) in enumerate(PEOPLE.rooms.items()):
            assert {found.floor.kinds[room] for room in found.floor.rooms[letters == 1 << bit]} == {kind}
            assert np.asarray(world.appearance.light)[placement.cells[name]] == 1.0
        assert float(world.resolution) == 0.5
    assert len(starts) > 1


def test_a_folder_is_many_buildings_of_one_shape_and_tells_what_it_leaves_out(tmp_path):
    _academic().write(tmp_path, "a")
    _academic().box("more", "CLASSROOM", 0, 75, 90, 140).door(("more", "hall"), [(40, 74)]).write(tmp_path, "b")
    Drawing().box("hall", "CORRIDOR", 0, 0, 99, 99).write(tmp_path, "c")
    (tmp_path / "d.xml").write_text("<building>")
    with pytest.warns(MapWarning, match=r"2 of 4 plans are left out: c\.xml, d\.xml"):
        generator = FloorPlans(FloorPlanConfig(tmp_path))
    assert [floor.name for floor in generator.floors] == ["a", "b"]
    assert set(generator.left_out) == {"c.xml", "d.xml"}
    keys = [world_key(Split.TEST, index, generator.name) for index in range(20)]
    assert {generator.building(key).name for key in keys} == {"a", "b"}
    worlds = [generator.generate_with_layout(key) for key in keys[:6]]
    assert len({world.shape for world, _, _ in worlds}) == 1
    assert {tuple(np.asarray(world.extent)) for world, _, _ in worlds} == {
        floor.floor.rooms.shape for floor in generator.floors
    }
    for (world, found, _), key in zip(worlds, keys, strict=False):
        assert found is generator.building(key)
        rows, columns = found.floor.rooms.shape
        assert np.array_equal(np.asarray(world.occupied)[:rows, :columns], found.floor.occupied)


def _without_lab(folder, name="plan", label="GYM"):
    """The plan with a room of another kind in the place of the laboratory."""
    drawing = _academic()
    drawing.rooms = [room.replace("LAB", label) for room in drawing.rooms]
    return drawing.write(folder, name)


def test_a_plan_is_used_for_every_task_whose_places_it_has(tmp_path):
    generator = FloorPlans.from_spec(f"floorplan:{_without_lab(tmp_path)}")
    assert generator.propositions == PEOPLE.propositions
    for possible in ("F undergrad", "F professor & F undergrad", "F grad | F undergrad", "!grad U professor"):
        assert generator.task(possible).text == possible
    message = r"(?s)plan\.xml: .*plan has no room for grad; it has professor, undergrad\. Its labels: CLASSROOM, CORR"
    for impossible in ("1", "F grad", "F (grad & X professor)", "delivery-1"):
        with pytest.raises(TaskError, match=message):
            generator.task(impossible)


def test_letters_mean_the_same_where_somebody_has_no_room(tmp_path):
    generator = FloorPlans.from_spec(f"floorplan:{_without_lab(tmp_path)}")
    for index in range(3):
        world, found, placement = generator.generate_with_layout(world_key(Split.TEST, index, generator.name))
        letters = np.asarray(world.letters)
        assert set(np.unique(letters)) == {0, 0b001, 0b100}
        assert {found.floor.kinds[room] for room in found.floor.rooms[letters == 0b100]} == {Kind.CLASSROOM}
        assert set(placement.rooms) == {"professor", "undergrad"}


def test_rooms_whose_label_nobody_explained_are_rooms(tmp_path):
    with pytest.warns(MapWarning, match="no kind is given for AQUARIUM: rooms of no particular kind"):
        generator = FloorPlans(FloorPlanConfig(_without_lab(tmp_path, label="AQUARIUM")))
    found = generator.floors[0]
    assert dict(zip(found.room_ids, found.floor.kinds, strict=True))["l"] is Kind.OTHER
    assert _area(found, "l") > 0.75 * 30
    assert generator.task("F undergrad")
    with pytest.raises(TaskError, match="no room for grad"):
        generator.task("F grad")


def test_a_folder_takes_tasks_that_some_plan_can_do_and_leaves_out_what_lacks_what_it_needs(tmp_path):
    _academic().write(tmp_path, "a")
    _without_lab(tmp_path, "b")
    both = FloorPlans.from_spec(f"floorplan:{tmp_path}")
    assert [floor.present for floor in both.floors] == [PEOPLE.propositions, ("professor", "undergrad")]
    assert both.task("1")
    with pytest.warns(MapWarning, match=r"1 of 2 plans are left out: b\.xml"):
        generator = FloorPlans.from_spec(f"floorplan:{tmp_path},needs=grad+professor")
    assert [floor.name for floor in generator.floors] == ["a"]
    with pytest.raises(MapError, match="no room of kind lab can be reached, for grad"):
        FloorPlans.from_spec(f"floorplan:{tmp_path / 'b.xml'},needs=grad")


def test_many_lost_rooms_are_a_warning(tmp_path):
    drawing = _academic().box("x", "OFFICE", 0, 80, 20, 100).box("y", "OFFICE", 30, 80, 50, 100)
    with pytest.warns(MapWarning, match="has lost many of its rooms: 6 rooms, 3 doors, 2 rooms without door"):
        FloorPlans(FloorPlanConfig(drawing.write(tmp_path)))


def test_resolution_and_meaning_of_labels_can_be_chosen(tmp_path):
    drawing = _academic()
    drawing.rooms = [room.replace("LAB", "Aquarium") for room in drawing.rooms]
    file, kinds = drawing.write(tmp_path), tmp_path / "kinds.yaml"
    kinds.write_text("hallway: [CORRIDOR]\noffice: [OFFICE]\nlab: [aquarium]\nclassroom: [CLASSROOM]\n")
    generator = make(f"floorplan:{file},kinds={kinds},resolution=0.25")
    assert isinstance(generator, FloorPlans)
    assert generator.floors[0].floor.resolution == 0.25
    assert Kind.LAB in generator.floors[0].floor.kinds


def test_floor_plans_are_test_data():
    assert usable_splits("floorplan:school") == (Split.TEST,)
    assert default_split("floorplan:school") is Split.TEST
    assert default_split("delivery") is Split.VALIDATION
    assert world_key(Split.TEST, 3, "floorplan:school") is not None
    for split in set(Split) - {Split.TEST}:
        with pytest.raises(WorldError, match=f"{split} worlds cannot be drawn"):
            world_key(split, 3, "floorplan:school")


def test_the_command_line_and_sweeps_know_that_plans_are_test_data(tmp_path):
    environment = f"floorplan:{_academic().write(tmp_path)}"
    generator = make(environment)
    assert read_split(None, generator) is Split.TEST
    assert read_split(None, make("delivery")) is Split.VALIDATION
    with pytest.raises(WorldError, match="test data"):
        read_split("training", generator)
    sweep = {"environments": [environment], "tasks": [1], "policies": ["baseline"], "worlds": 2}
    with pytest.raises(SpecificationError, match=r"split: .*test data"):
        specification_from_dict(sweep, "sweep.yaml")
    assert specification_from_dict({**sweep, "split": "test"}, "sweep.yaml").split is Split.TEST


def _changed(old, new, count=-1):
    return lambda text: text.replace(old, new, count)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text[:-20], "not valid XML"),
        (lambda text: "<buildingtype/>", "must hold a building"),
        (_changed("</building>", "<floor/></building>"), "there are 2"),
        (_changed("<um>cm</um>", "<um>feet</um>"), "'feet' must be one of cm, m, mm"),
        (_changed("<value>9</value>", "<value>0</value>"), "must be positive"),
        (_changed("<value>9</value>", ""), "represented_distance: None is not a finite number"),
        (_changed("<value>9</value>", "<value>0.01</value>"), "check the scale"),
        (_changed('x="60"', 'x="nan"'), "space o: bounding_polygon: 'nan' is not a finite number"),
        (_changed('id="l"', 'id="o"'), "space o: the id is given twice"),
        (_changed("<label>LAB</label>", ""), "space l: has no label"),
        (_changed("CORRIDOR", "CLOSET"), "no room of kind hallway can be reached, where the robot could start"),
        (
            lambda text: text.replace("LAB", "GYM").replace("OFFICE", "GYM").replace("CLASSROOM", "GYM"),
            "no room of kind office, lab, classroom can be reached, for professor, grad, undergrad. The labels are: "
            "CORRIDOR, GYM",
        ),
        (_changed("<id>o</id>", "<id>ghost</id>"), "must join two rooms, found \\['ghost', 'hall'\\]"),
        (_changed('<point x="60" y="0"/><point x="60" y="50"/>', ""), "has 2 points"),
        (lambda text: re.sub(r"<space .*</space>", "", text), "has no rooms"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path, change, message):
    file = tmp_path / "plan.xml"
    text = change(_academic().text())
    assert text != _academic().text()
    file.write_text(text)
    with pytest.raises(MapError, match=message) as error:
        FloorPlans(FloorPlanConfig(file))
    assert str(file) in str(error.value)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("floorplan:", "names no plan"),
        ("floorplan:nowhere.xml", "nowhere.xml: cannot be read"),
        ("floorplan:plan.xml,colour=red", "colour=red: is no option"),
        ("floorplan:plan.xml,resolution=fine", "resolution: could not convert"),
        ("floorplan:PLAN,resolution=0", "0.0 is not a positive number"),
        ("floorplan:PLAN,resolution=9", "nothing is left|no room of kind"),
        ("floorplan:PLAN,kinds=KINDS", "kitchen: is no kind of room; choose from: hallway, other, office"),
        ("floorplan:FOLDER", "no plan can be used"),
        ("floorplan:EMPTY", "holds no .xml file"),
        ("floorplan:PLAN,needs=professor+dean", "needs: 'dean' is none of professor, grad, undergrad"),
    ],
)
def test_what_is_wrong_with_a_name_is_said(tmp_path, spec, message):
    (tmp_path / "kinds.yaml").write_text("kitchen: [CANTEEN]\n")
    (tmp_path / "empty").mkdir()
    (tmp_path / "folder").mkdir()
    Drawing().box("hall", "CORRIDOR", 0, 0, 99, 99).write(tmp_path / "folder")
    for word, name in (("PLAN", "plan.xml"), ("KINDS", "kinds.yaml"), ("FOLDER", "folder"), ("EMPTY", "empty")):
        spec = spec.replace(word, str(tmp_path / name))
    _academic().write(tmp_path)
    with pytest.raises(MapError, match=message):
        make(spec)


def test_a_label_has_one_meaning(tmp_path):
    file = tmp_path / "kinds.yaml"
    file.write_text("office: [ROOM]\nlab: [room]\n")
    with pytest.raises(MapError, match="'room' is listed under another kind"):
        read_kinds(file)
    file.write_text("office: ROOM\n")
    with pytest.raises(MapError, match="must be a list of labels"):
        read_kinds(file)


# What others made


@pytest.fixture(scope="module")
def corpus(external_data):
    files = sorted((external_data / "floorplans").glob("*/*.xml"))
    plans = [read_plan(file) for file in files]
    return files, plans, [rasterise(plan, read_kinds(), 0.5) for plan in plans]


@pytest.mark.long
def test_every_plan_of_the_corpora_is_read_whole(corpus):
    files, plans, _ = corpus
    assert len(files) == 42
    for file, plan in zip(files, plans, strict=True):
        text = file.read_text("utf-8")
        assert len(plan.rooms) == len(re.findall(r"<space id=", text))
        portals = ElementTree.fromstring(text).iter("portal")
        named = {(p.findtext("linesegment"), frozenset(i.text for i in p.iter("id"))) for p in portals}
        assert len(plan.doors) == len(named)


def test_rooms_of_the_corpora_that_doors_connect_are_connected_on_the_grid(corpus):
    """The graph of rooms and doors as the files have it, against what can be reached on the grid."""
    lost = expected = 0
    for _, plan, found in zip(*corpus, strict=True):
        graph = networkx.Graph(door.rooms for door in plan.doors if door.points)
        largest = max(networkx.connected_components(graph), key=len)
        lost += len(largest - set(found.room_ids))
        expected += len(largest)
        assert _is_connected(found), plan.file.name
        assert found.report.rooms_lost == len(plan.rooms) - len(found.room_ids)
    assert expected > 1500
    assert lost <= 0.005 * expected


def test_doors_of_the_corpora_join_their_rooms(corpus):
    total = missing = 0
    for _, plan, found in zip(*corpus, strict=True):
        numbers = {room: number for number, room in enumerate(found.room_ids)}
        cells = found.floor.rooms
        touching = set()
        for one, other in ((cells[:-1], cells[1:]), (cells[:, :-1], cells[:, 1:])):
            differ = (one != other) & (one != NO_ROOM) & (other != NO_ROOM)
            touching |= {frozenset(pair) for pair in zip(one[differ].tolist(), other[differ].tolist(), strict=True)}
        assert cells.max() == len(found.room_ids) - 1
        for door in plan.doors:
            if set(door.rooms) <= set(numbers) and door.points:
                total += 1
                missing += frozenset(numbers[room] for room in door.rooms) not in touching
        joined = {frozenset(numbers.get(room, NO_ROOM) for room in door.rooms) for door in plan.doors}
        assert touching <= joined, plan.file.name
    assert total > 1700
    assert missing <= 0.005 * total


def test_rooms_of_the_corpora_keep_their_size(corpus):
    """Walls cost area; what is more is rounding to whole cells."""
    shares = []
    for _, plan, found in zip(*corpus, strict=True):
        outlines = {room.id: room.area for room in plan.rooms}
        shares += [_area(found, room) / outlines[room] for room in found.room_ids if outlines[room] > 10]
    assert 0.75 < np.median(shares) < 1.0
    assert np.quantile(shares, 0.05) > 0.5
    assert np.quantile(shares, 0.98) < 1.15, "a hallway of 1.3 m is three cells wide"


def test_enough_plans_of_the_corpora_have_all_kinds_of_rooms(corpus):
    assert sum(not missing_kinds(found.floor, PEOPLE) for found in corpus[2]) == USABLE


def test_a_folder_of_the_corpora_becomes_buildings(external_data):
    with pytest.warns(MapWarning, match=r"1 of 12 plans are left out: 324-Elm-Furn-Plan\.xml"):
        generator = make(f"floorplan:{external_data / 'floorplans' / 'office'},needs=professor+grad+undergrad")
    assert isinstance(generator, FloorPlans)
    assert len(generator.floors) == 11
    world, found, placement = generator.generate_with_layout(world_key(Split.TEST, 0, generator.name))
    parts, _ = ndimage.label(~np.asarray(world.occupied))
    assert parts[placement.start] > 0
    assert all(parts[cell] == parts[placement.start] for cell in placement.cells.values())
    assert found.floor.kinds[found.floor.rooms[placement.cells["professor"]]] is Kind.OFFICE
    again = generator.generate(world_key(Split.TEST, 0, generator.name))
    assert all(map(np.array_equal, jax.tree.leaves(world), jax.tree.leaves(again)))


@pytest.mark.long
def test_plans_of_the_corpora_load_with_the_places_that_they_have(external_data):
    """No plan is refused for want of some kind of room, and each does what it has places for."""
    files = sorted((external_data / "floorplans").glob("*/*.xml"))
    loaded = [FloorPlans(FloorPlanConfig(file)) for file in files]
    complete = [generator for generator in loaded if not generator.floors[0].absent]
    assert len(complete) == USABLE
    for generator in loaded:
        for name in PEOPLE.propositions:
            if name in generator.floors[0].present:
                assert generator.task(f"F {name}")
            else:
                with pytest.raises(TaskError, match=f"no room for {name}; it has "):
                    generator.task(f"F {name}")
