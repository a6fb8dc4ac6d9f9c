"""Generated campus buildings: what they are made of; all that is open can be reached, nothing that is closed can."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from scipy import ndimage

from potlp_jax.environments.base import host_generators
from potlp_jax.environments.campus import outlines
from potlp_jax.environments.campus.blocks import Box
from potlp_jax.environments.campus.campus import LARGE, MEDIUM, SMALL, Campus, CampusConfig
from potlp_jax.environments.campus.campus_builder import CampusFloor, CampusStyle, Part
from potlp_jax.environments.campus.furnishing import NO_ROOM, PARCELS, PEOPLE, Kind, missing_kinds
from potlp_jax.environments.campus.furniture import Furniture, put_furniture
from potlp_jax.environments.campus.outlines import LEAST_COURT, Outline, Site, draw_wings, least_height, least_width
from potlp_jax.environments.families import NAMED
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import WorldError
from potlp_jax.planning.policies import Policy
from potlp_jax.recipes.recipe import recipe_for
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome

FLOORS = 60
CONFIGS = {"campus-small": SMALL, "campus-medium": MEDIUM, "campus-large": LARGE}
CORNERS = np.ones((3, 3))


def _key(name: str, index: int, split: Split = Split.TRAINING) -> jax.Array:
    return world_key(split, index, name)


def _floor(name: str, index: int, split: Split = Split.TRAINING) -> CampusFloor:
    floor = make(name).draw_floor(_key(name, index, split))
    assert isinstance(floor, CampusFloor)
    return floor


@pytest.fixture(scope="module")
def floors() -> dict[str, list[CampusFloor]]:
    return {name: [_floor(name, index) for index in range(FLOORS)] for name in CONFIGS}


@pytest.fixture(scope="module")
def every_floor(floors) -> list[CampusFloor]:
    return [floor for found in floors.values() for floor in found]


def _open(floor: CampusFloor) -> np.ndarray:
    return ~floor.occupied & ~np.isin(floor.rooms, sorted(floor.closed))


def test_all_that_is_open_is_one_piece_and_no_closed_room_touches_it(every_floor):
    closed = 0
    for floor in every_floor:
        assert ndimage.label(_open(floor))[1] == 1, (floor.outline, floor.rooms.shape)
        # Not even at a corner: what lies beyond would be seen there.
        for number in floor.closed:
            room = floor.rooms == number
            assert room.any()
            assert not (ndimage.binary_dilation(room, CORNERS) & _open(floor)).any()
            closed += 1
    assert closed > FLOORS


def test_nobody_is_in_a_closed_room_and_everybody_can_be_reached():
    # Most rooms are closed, so that people would be in one if they could.
    closed = dataclasses.replace(SMALL, closed=(0.7, 0.7))
    for name, errand in (("campus-small", PEOPLE), ("campus-small-parcels", PARCELS)):
        generator = Campus(closed, name, errand)
        for index in range(10):
            world, floor, placement = generator.generate_with_layout(_key(name, index))
            reached = ndimage.label(~np.asarray(world.occupied))[0]
            letters = np.asarray(world.letters)
            assert not floor.closed & set(placement.rooms.values())
            assert len(floor.closed) > 0.3 * (len(floor.kinds) - 1)
            for bit in range(len(errand.propositions)):
                places = reached[letters >> bit & 1 == 1]
                assert len(places)
                assert (places == reached[placement.start]).all()
            assert floor.kind_of_cell[placement.start] == Kind.HALLWAY


def test_extents_lie_within_their_bounds_and_fill_them(floors):
    for name, config in CONFIGS.items():
        shapes = np.array([floor.rooms.shape for floor in floors[name]])
        assert (shapes <= config.largest).all()
        assert (shapes[:, 1] >= config.long_side[0]).all()
        # Buildings are drawn from the whole range, not from a part of it.
        low, high = config.long_side
        assert np.quantile(shapes[:, 1], 0.15) < low + 0.35 * (high - low)
        assert np.quantile(shapes[:, 1], 0.85) > low + 0.65 * (high - low)
        for floor in floors[name]:
            ground = np.argwhere(~floor.occupied)
            assert (ground.min(axis=0) >= 1).all()
            assert (ground.max(axis=0) <= np.array(floor.rooms.shape) - 2).all()
    assert max(floor.rooms.shape[1] for floor in floors["campus-large"]) * 0.5 > 200
    assert min(floor.rooms.shape[1] for floor in floors["campus-small"]) * 0.5 < 32


@pytest.mark.parametrize("name", CONFIGS)
def test_worlds_have_one_shape_and_their_own_extent(name):
    generator = make(name)
    worlds = [generator.world(index) for index in range(4)]
    assert {world.shape for world in worlds} == {CONFIGS[name].largest}
    assert len({tuple(np.asarray(world.extent).tolist()) for world in worlds}) > 1
    for index, world in enumerate(worlds):
        assert tuple(np.asarray(world.extent)) == _floor_of_validation(name, index).rooms.shape
        assert not np.asarray(world.occupied)[tuple(np.asarray(world.start))]


def _floor_of_validation(name: str, index: int) -> CampusFloor:
    generator = make(name)
    floor = generator.generate_with_layout(_key(name, index, Split.VALIDATION))[1]
    assert isinstance(floor, CampusFloor)
    return floor


def test_every_building_has_the_rooms_that_tasks_need(every_floor):
    for floor in every_floor:
        assert not missing_kinds(floor, PEOPLE)
        assert not missing_kinds(floor, PARCELS)
        assert len(floor.rooms_of(Kind.HALLWAY)) == 1


@pytest.mark.parametrize("name", CONFIGS)
def test_every_part_occurs(floors, name):
    parts = [part for floor in floors[name] for part in floor.parts]
    assert not set(Part) - set(parts)


def test_every_outline_occurs(floors):
    for name, config in CONFIGS.items():
        assert {floor.outline for floor in floors[name]} <= {outline for outline, _ in config.outlines}
    assert {floor.outline for floor in floors["campus-medium"] + floors["campus-large"]} == set(Outline)


def _pieces(floor: CampusFloor) -> list[np.ndarray]:
    """Obstacles that stand free inside of one room, as cells."""
    labels, count = ndimage.label(floor.occupied, CORNERS)
    found = []
    for number, place in enumerate(ndimage.find_objects(labels), start=1):
        window = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in place)
        ring = floor.rooms[window][ndimage.binary_dilation(labels[window] == number, CORNERS)]
        if len(set(ring.tolist()) - {NO_ROOM}) == 1 and (labels == number).sum() < 40:
            found.append(np.argwhere(labels == number))
    assert count > 0
    return found


def test_parts_can_be_seen_in_the_walls(floors):
    """What a floor says that it has is there: furniture, atria, loops around courts, doors of one cell, dead ends."""
    seen = {name: 0 for name in ("desks in a laboratory", "furniture in a hallway", "atrium", "court", "one-cell door")}
    for floor in floors["campus-medium"]:
        kinds = floor.kind_of_cell
        inside = [kinds[tuple(piece[0] - (1, 0))] for piece in _pieces(floor)]
        seen["desks in a laboratory"] += inside.count(Kind.LAB) >= 4
        seen["furniture in a hallway"] += inside.count(Kind.HALLWAY) >= 4
        # No hallway is wider than eight cells: what has twelve on every side of a cell is no hallway.
        hallway = kinds == Kind.HALLWAY
        seen["atrium"] += bool(ndimage.uniform_filter(hallway.astype(float), 13).max() > 0.85)
        seen["court"] += ndimage.label(np.pad(~hallway, 1, constant_values=True), CORNERS)[1] > 1
        seen["one-cell door"] += any(len(door) == 1 for door in _doors(floor))
    assert all(times >= 5 for times in seen.values()), seen
    assert seen["atrium"] < FLOORS, "most hallways are hallways"
    without = [floor for floor in floors["campus-small"] if not floor.parts & {Part.ATRIUM, Part.OPEN_PLAN}]
    without = [floor for floor in without if Part.LARGE_ROOM not in floor.parts]
    for floor in without:
        kinds = {floor.kind_of_cell[tuple(piece[0] - (1, 0))] for piece in _pieces(floor)}
        assert kinds <= {Kind.HALLWAY, Kind.OTHER}, "only shafts stand free where nothing is furnished"
    assert len(without) > 10


def _doors(floor: CampusFloor) -> list[np.ndarray]:
    labels, count = ndimage.label(floor.doors & ~floor.occupied)
    return [np.argwhere(labels == number) for number in range(1, count + 1)]


def test_doors_of_one_cell_are_passed(floors):
    """Closing any door of one cell cuts nothing off but what is behind it, and opening is what joins the two sides."""
    passed = 0
    for floor in floors["campus-small"][:20]:
        for door in _doors(floor):
            if len(door) > 1:
                continue
            row, column = door[0]
            beside = [(row + 1, column), (row - 1, column)], [(row, column + 1), (row, column - 1)]
            free = [all(not floor.occupied[cell] for cell in pair) for pair in beside]
            # Straight through the wall, with the wall on both sides.
            assert sorted(free) == [False, True]
            passed += 1
    assert passed > 20


def test_a_robot_passes_a_door_of_one_cell():
    narrow = dataclasses.replace(SMALL, narrow_door=(1.0, 1.0), style=CampusStyle(wide_door=0.0))
    generator = Campus(narrow, "campus-small")
    world, floor, _ = generator.generate_with_layout(_key("campus-small", 3))
    doors = [door for door in _doors(floor) if floor.kind_of_cell[tuple(door[0])] != Kind.HALLWAY]
    assert len(doors) > 5
    # Two beside each other count as one here.
    assert np.mean([len(door) == 1 for door in doors]) > 0.8
    trial = run_trial(world, generator.task("1"), Policy.BASELINE, jax.random.key(0))
    assert trial.outcome is Outcome.SATISFIED
    assert {tuple(door[0].tolist()) for door in doors if len(door) == 1} & {
        tuple(cell) for cell in np.array(trial.path)
    }


def test_furniture_leaves_a_way_around_each_piece_and_stands_before_no_door():
    rng = np.random.default_rng(0)
    for how in Furniture:
        rooms = np.full((30, 40), NO_ROOM, np.int32)
        rooms[1:29, 1:39] = 7
        doors = np.zeros(rooms.shape, bool)
        rooms[0, 20], doors[0, 20] = 7, True
        assert put_furniture(rooms, doors, Box(1, 29, 1, 39), how, rng) > 5
        assert ndimage.label(rooms == 7)[1] == 1
        assert (rooms[0:3, 19:22] == 7)[:, 1].all()
        assert (rooms[1, 1:39] == 7).all(), "a ring along the walls stays free"
        pieces = ndimage.label(rooms[1:29, 1:39] == NO_ROOM, CORNERS)[1]
        assert pieces > 5


def test_furniture_that_does_not_fit_is_left_out():
    rooms = np.full((8, 8), NO_ROOM, np.int32)
    rooms[1:4, 1:4] = 2
    before, doors, rng = rooms.copy(), np.zeros(rooms.shape, bool), np.random.default_rng(0)
    assert put_furniture(rooms, doors, Box(1, 4, 1, 4), Furniture.SHELVES, rng) == 0
    assert np.array_equal(rooms, before)


@pytest.mark.parametrize("outline", Outline)
def test_wings_fill_the_site_and_leave_courts(outline):
    depth = (20, 30)
    height, width = least_height(outline, depth[1]), least_width(outline, depth[1])
    for seed, more in enumerate((0, 5, 40)):
        site = Site(height + more, width + 3 * more, depth, (40, 60), 0.5, np.random.default_rng(seed))
        ground = np.zeros((site.height, site.width), int)
        for wing in draw_wings(outline, site):
            assert 0 <= wing.box.top < wing.box.bottom <= site.height
            assert 0 <= wing.box.left < wing.box.right <= site.width
            ground[wing.box.cells] += 1
        for side in (ground[0], ground[-1], ground[:, 0], ground[:, -1]):
            assert side.any()
        assert ndimage.label(ground)[1] == 1
        # Wings share walls at most.
        inner = ndimage.binary_erosion(ground > 1, np.ones((2, 2)))
        assert not inner.any()
        if outline is Outline.RING:
            outside = ndimage.label(np.pad(ground == 0, 1, constant_values=True))[1]
            assert outside >= 2, "a courtyard"


def test_the_least_court_is_kept_between_the_legs_of_a_comb():
    site = Site(90, 3 * 30 + 2 * LEAST_COURT, (30, 30), (40, 60), 0.0, np.random.default_rng(0))
    legs = sorted((wing.box.left, wing.box.right) for wing in draw_wings(Outline.COMB, site) if wing.turned)
    assert len(legs) == 3
    assert min(after[0] - before[1] for before, after in itertools.pairwise(legs)) >= LEAST_COURT


def test_a_key_makes_one_world():
    for name in CONFIGS:
        one, other = (make(name).world(3, Split.TRAINING) for _ in range(2))
        for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            assert np.array_equal(left, right)


def test_buildings_of_the_splits_are_disjoint(floors):
    name = "campus-small"
    walls = [floor.occupied.tobytes() for floor in floors[name]]
    for split in (Split.CALIBRATION, Split.VALIDATION, Split.TEST):
        walls += [_floor(name, index, split).occupied.tobytes() for index in range(20)]
    assert len(set(walls)) == len(walls)


def test_buildings_differ_as_real_ones_do(every_floor):
    """Wide bounds around what docs/results/floors.md publishes of plans and of generated floors."""
    rooms = np.array([len(floor.kinds) - 1 for floor in every_floor])
    low, middle, high = np.quantile(rooms, (0.1, 0.5, 0.9))
    assert 6 <= low <= 18
    assert 25 <= middle <= 50
    assert 60 <= high <= 110
    hallways = [np.mean(floor.kind_of_cell[~floor.occupied] == Kind.HALLWAY) for floor in every_floor]
    assert 0.2 < np.median(hallways) < 0.35
    areas = np.concatenate([np.bincount(floor.rooms[~floor.occupied])[1:] for floor in every_floor]) * 0.25
    assert 18 < np.median(areas) < 40
    assert np.quantile(areas, 0.9) > 3 * np.quantile(areas, 0.5) * 0.8
    free = [np.mean(~floor.occupied) for floor in every_floor]
    assert np.quantile(free, 0.1) < 0.45
    assert np.quantile(free, 0.9) > 0.75


def test_families_have_the_tasks_and_the_look_of_delivery_and_parcels():
    for name in CONFIGS:
        people, parcels = make(name), make(f"{name}-parcels")
        assert (people.name, parcels.name) == (name, f"{name}-parcels")
        assert people.world(0).family == "delivery"
        assert parcels.world(0).family == "parcels"
        assert people.tasks == make("delivery").tasks
        assert parcels.tasks == make("parcels").tasks
    assert {name for name in NAMED if name.startswith("campus")} == {*CONFIGS, *(f"{name}-parcels" for name in CONFIGS)}


def test_what_an_estimator_of_delivery_never_sees_is_held_out_here_too():
    assert recipe_for("campus-small").collect.held_out == recipe_for("delivery").collect.held_out != ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"long_side": (128, 100)}, "increasing order"),
        ({"long_side": (30, 100)}, "long_side"),
        ({"largest": (96, 100)}, "largest"),
        ({"largest": (40, 128)}, "too few rows"),
        ({"wing_depth": (10, 30)}, "wing_depth"),
        ({"deep_wing": (30, 50)}, "deep_wing"),
        ({"row_depth": (4, 20)}, "row_depth"),
        ({"hallway_width": (3, 9)}, "hallway_width"),
        ({"closed": (0.0, 1.5)}, "share"),
        ({"resolution": 0.0}, "resolution"),
        ({"outlines": ((Outline.COMB, 1.0),)}, "no outline fits"),
    ],
)
def test_impossible_configurations_are_refused(change, message):
    with pytest.raises(WorldError, match=message):
        dataclasses.replace(SMALL, **change)


def test_a_building_without_rooms_is_refused():
    config = dataclasses.replace(SMALL, closed=(1.0, 1.0))
    with pytest.raises(WorldError, match="had the rooms that campus-small needs"):
        Campus(config, "campus-small").world(0)


def test_generators_of_other_sizes_are_made_by_hand():
    config = CampusConfig(long_side=(60, 80), largest=(60, 80), wing_depth=(20, 30), outlines=((Outline.L, 1.0),))
    generator = Campus(config, "my-campus")
    (rng,) = host_generators(jax.random.key(0), 1)
    assert generator.build(rng).outline is Outline.L
    assert generator.world(0).shape == (60, 80)
    assert outlines.LEAST_DEEP >= 40
