"""What is measured of floors, against floors drawn by hand."""

import numpy as np
import pytest

from eval.floor_statistics.exploring import frontiers_after_walk
from eval.floor_statistics.page import page_of
from eval.floor_statistics.shape import dead_ends, shape_of
from eval.floor_statistics.sheet import draw_sheet, picture_of
from eval.floor_statistics.walls import gazebo_sides, traffic_editor_sides
from potlp_jax.environments.campus.furnishing import Floor, Kind

LEGEND = {"#": -1, ".": 0}
RING = """
################
#..............#
#..............#
#..##########..#
#..#111#2222#..#
#..#111dd222#..#
#..#111#2222#..#
#..##d####D##..#
#..............#
#..............#
#####d##########
#33333#44444444#
#33333#44444444#
################
"""
"""A loop of hallway around rooms 1 and 2, which are joined; 3 has a door to the hallway and 4 is closed."""


def _floor(text: str = RING, side: float = 1.0) -> Floor:
    rows = text.split()
    # Doors belong to the room behind them: those in row 7 to rooms 1 and 2, that below the hallway to 3.
    doors = np.array([[letter in "dD" for letter in row] for row in rows])
    numbers = np.array([[LEGEND.get(letter, 0) if letter in "#.dD" else int(letter) for letter in row] for row in rows])
    numbers[7, 5], numbers[7, 10], numbers[10, 5], numbers[5, 7:9] = 1, 2, 3, 2
    kinds = (Kind.HALLWAY, Kind.OFFICE, Kind.LAB, Kind.OTHER, Kind.CLASSROOM)
    return Floor(numbers.astype(np.int32), doors, kinds, side, frozenset({4}))


def test_figures_of_a_floor_drawn_by_hand():
    found = shape_of(_floor())
    assert (found.long_side, found.short_side) == (14.0, 12.0)
    # 28 cells above, 28 below, 5 rows of 4 between.
    hallway = 28 + 28 + 20
    assert found.room_areas == (10.0, 14.0, 11.0, 16.0)
    assert found.area == hallway + 51
    assert found.free == pytest.approx(found.area / (14 * 12))
    assert found.hallway_share == pytest.approx(hallway / found.area)
    assert found.rooms == 4
    assert found.longest_hallway == 14.0
    assert found.hallway_width == 2.0
    # Room 4 is closed, and none of those that have a door.
    assert sorted(found.doors) == [1, 2, 2]
    assert found.doors_per_room == pytest.approx(5 / 3)
    assert found.room_loops == 1
    assert found.hallway_loops == 1
    assert found.dead_ends == 0
    assert found.middle_room == 12.5


def test_lengths_scale_with_the_cells():
    found, half = shape_of(_floor()), shape_of(_floor(side=0.5))
    assert half.long_side == found.long_side / 2
    assert half.area == found.area / 4
    assert half.longest_hallway == found.longest_hallway / 2
    assert half.doors == found.doors


def test_hallways_that_touch_are_one():
    """A plan's corridor and its lobby, two spaces of the file, are no rooms with a door between them."""
    floor = _floor()
    floor.rooms[1:10, 13:15] = 5
    parted = Floor(floor.rooms, floor.doors, (*floor.kinds, Kind.HALLWAY), 1.0, floor.closed)
    assert shape_of(parted) == shape_of(_floor())


def test_ends_of_hallways():
    hallway = np.zeros((20, 20), bool)
    hallway[8:11, 2:18] = True
    assert dead_ends(hallway, 1.0) == 2
    hallway[2:8, 10:13] = True
    assert dead_ends(hallway, 1.0) == 3
    # A hall is no hallway that ends.
    hallway[11:18, 4:14] = True
    assert dead_ends(hallway, 1.0) == 3
    # With cells of 0.2 m the hallways are too narrow to be any, and the hall is 2 m wide.
    assert dead_ends(hallway, 0.2) == 1


def test_frontiers_are_counted_from_the_hallway():
    # A frontier remains at doors through which no look went, and around corners.
    counts = {frontiers_after_walk(_floor(), (24, 24), index) for index in range(4)}
    assert counts <= set(range(1, 8))
    assert frontiers_after_walk(_floor(), (24, 24), 0) == frontiers_after_walk(_floor(), (24, 24), 0)


def _link(x, y, yaw, length):
    return (
        f"<link><collision><geometry><box><size>{length} 0.1 2.5</size></box></geometry><pose>{length / 2} 0 1.25 0 0 0"
        f"</pose></collision><pose>{x} {y} 0 0 0 {yaw}</pose></link>"
    )


def test_sides_of_gazebo_walls(tmp_path):
    ground = "<link><collision><geometry><plane><size>100 100</size></plane></geometry></collision></link>"
    walls = _link(0, 0, 0, 30) + _link(30, 0, 1.57079632679, 12)
    file = tmp_path / "a.world"
    file.write_text(f"<sdf><world><model>{ground}</model><model>{walls}</model></world></sdf>")
    assert gazebo_sides(file) == pytest.approx((30.0, 12.0))


def test_sides_of_a_building_of_the_traffic_editor(tmp_path):
    file = tmp_path / "a.building.yaml"
    file.write_text(
        """
levels:
  L1:
    measurements: [[0, 1, {distance: [3, 5.0]}]]
    vertices: [[0, 0, 0, ""], [100, 0, 0, ""], [100, 400, 0, ""], [9000, 9000, 0, "charger"]]
    walls: [[0, 1, {}], [1, 2, {}]]
  L2:
    vertices: [[0, 0, 0, ""]]
    walls: []
"""
    )
    assert traffic_editor_sides(file) == {"L1": pytest.approx((20.0, 5.0))}


def test_the_picture_tells_rooms_doors_and_outdoors(tmp_path):
    floor = _floor(RING.strip() + "\n" + "\n".join(["#" * 16] * 3))
    image = picture_of(floor)
    assert (
        len({tuple(image[cell]) for cell in ((1, 1), (4, 4), (4, 9), (11, 1), (11, 8), (7, 5), (0, 0), (16, 0))}) == 8
    )
    assert tuple(image[16, 0]) == (255, 255, 255), "outdoors"
    draw_sheet([("generated", [floor] * 3), ("real", [_floor()] * 4)], tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_the_page_has_a_column_for_every_group():
    names = ("plans", "generated", "delivery", "plans to 64 m", "small", "plans from 64 m", "medium", "large")
    first = ["long_side", "short_side", "area", "free", "rooms", "room_areas", "middle_room", "hallway_share"]
    others = [
        "longest_hallway",
        "hallway_width",
        "doors_per_room",
        "room_loops",
        "hallway_loops",
        "dead_ends",
        "frontiers",
    ]
    measures = {name: [1.0, 2.0, 3.0] for name in first} | {name: [0.0, 25.0, 1234.0] for name in others}
    shares = {"small": {"atrium": 0.25}, "large": {"atrium": 0.5, "shaft": 1.0}}
    groups = {name: {"floors": 7, "measures": measures, "shares": shares.get(name, {})} for name in names}
    times = {"observe": 1.0, "assess": 2.0, "paint": 3.0}
    cost = {"shape": [96, 128], "milliseconds": times, "bytes": 2e6, "first_stage_operations": 3e9}
    slower = {**cost, "milliseconds": {name: 10 * time for name, time in times.items()}}
    sides = {"floors": 2, "long_side": [1, 2, 3], "short_side": [1, 2, 3]}
    page = page_of({"groups": groups, "walls": {"KTH campus": sides}, "costs": {"small": cost, "large": slower}})
    assert "| rooms | 1, 2, 3 | 1, 2, 3 | 1, 2, 3 |" in page
    assert "| shaft | 0 | 100 |" in page
    assert "KTH campus (2)" in page
    assert "cost 10 times as much" in page
