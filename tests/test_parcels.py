"""Parcels for two people: on generated floors, and in the named rooms of a map."""

import dataclasses

import jax
import numpy as np
import pytest

from potlp_jax.environments.campus.delivery import Delivery, DeliveryConfig
from potlp_jax.environments.campus.furnishing import PARCELS, Floor, FurnishConfig, Kind, furnish
from potlp_jax.environments.registry import make
from potlp_jax.environments.ros.mapped_rooms import (
    MappedRooms,
    MappedRoomsConfig,
)
from potlp_jax.environments.splits import world_key
from potlp_jax.errors import MapError, MapWarning, SpecificationError, WorldError
from potlp_jax.sweep.specification import specification_from_dict
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig, trial_config_for
from tests.reference.map_files import drawn, p5, write_map

# Three rooms above a hallway; a sign is half a metre.
BUILDING = drawn(
    "#####################",
    "#.....#.....#.......#",
    "#.....#.....#.......#",
    "#.....#.....#.......#",
    "###.#####.######.####",
    "#...................#",
    "#...................#",
    "#####################",
)

ROOMS = """rooms:
  a: [{polygon: [[0.5, 2.0], [3.0, 2.0], [3.0, 3.5], [0.5, 3.5]]}]
  b: [{polygon: [[3.5, 2.0], [6.0, 2.0], [6.0, 3.5], [3.5, 3.5]]}]
  c: [{polygon: [[6.5, 2.0], [10.0, 2.0], [10.0, 3.5], [6.5, 3.5]]}]
"""


@pytest.fixture
def building(tmp_path):
    file = write_map(tmp_path, p5(np.where(np.kron(BUILDING, np.ones((2, 2))), 254, 0)), resolution="0.25")
    (tmp_path / "map.rooms.yaml").write_text(ROOMS)
    return file


def _mapped(file, **options):
    return MappedRooms(MappedRoomsConfig(file, resolution=0.5, radius=0.0, **options))


def _keys(count):
    return [world_key("test", index, "parcels:map") for index in range(count)]


def test_generated_parcels_are_in_two_rooms_that_only_light_tells():
    generator = make("parcels")
    assert generator.propositions == ("document", "package")
    kinds = set()
    for index in range(12):
        world, floor, placement = Delivery.parcels().generate_with_layout(world_key("training", index, "parcels"))
        first, second = placement.rooms.values()
        assert first != second
        kinds |= {floor.kinds[first], floor.kinds[second]}
        light = np.asarray(world.appearance.light)[: floor.rooms.shape[0], : floor.rooms.shape[1]]
        for number, kind in enumerate(floor.kinds):
            if kind is not Kind.HALLWAY:
                assert np.all(light[floor.rooms == number] == (number in (first, second)))
    assert Kind.HALLWAY not in kinds
    assert len(kinds) > 1


def test_all_walls_and_floors_of_parcels_look_alike():
    config = Delivery.parcels().config
    plain = dataclasses.replace(config, furnishing=FurnishConfig(coloured=False, tint=0, tint_noise=0))
    world, floor, _ = Delivery(plain, "parcels", PARCELS).generate_with_layout(jax.random.key(3))
    assert len(set(floor.kinds)) > 1
    # Nor do thick walls, behind which no room is near: real maps have them.
    for colours in (world.appearance.floor_colour, world.appearance.wall_colour):
        assert len(np.unique(np.asarray(colours).reshape(-1, 3), axis=0)) == 1


def test_rooms_of_a_map_are_where_their_polygons_say(building):
    generator = _mapped(building)
    assert generator.name == "parcels:map"
    assert generator.rooms == ("hallway", "a", "b", "c")
    assert np.array_equal(generator.floor.rooms == -1, ~BUILDING)
    assert np.unique(generator.floor.rooms[1:4, 1:6]).tolist() == [1]
    assert np.unique(generator.floor.rooms[1:4, 7:12]).tolist() == [2]
    assert np.unique(generator.floor.rooms[1:4, 13:20]).tolist() == [3]
    assert np.all(generator.floor.rooms[4:7][BUILDING[4:7]] == 0)


def test_parcels_of_a_map_take_every_pair_of_rooms_and_are_lit(building):
    generator, pairs = _mapped(building), set()
    for key in _keys(60):
        world, placement = generator.generate_with_layout(key)
        letters, rooms = np.asarray(world.letters), generator.floor.rooms
        pairs.add((placement.rooms["document"], placement.rooms["package"]))
        for bit, name in enumerate(generator.propositions):
            assert np.unique(rooms[letters >> bit & 1 == 1]).tolist() == [placement.rooms[name]]
        light = np.asarray(world.appearance.light)
        lit = np.unique(rooms[light == 1.0]).tolist()
        assert set(placement.rooms.values()) <= set(lit)
        assert np.all(light[np.isin(rooms, list({1, 2, 3} - set(placement.rooms.values())))] == 0)
        assert rooms[placement.start] == 0
    assert len(pairs) == 6
    for formula in generator.tasks.values():
        Task.from_formula(formula, generator.propositions)


def test_trials_on_a_map_see_as_in_the_worlds_that_were_learned_from(building):
    same = MappedRooms(MappedRoomsConfig(building, resolution=DeliveryConfig().resolution, radius=0.0))
    learned_from, narrow = (trial_config_for(make(family)) for family in ("parcels", "campus-small-parcels"))
    # Decisions are those of floors with doors as narrow, what is seen that of the floors that were learned from.
    expected = dataclasses.replace(learned_from, decision=narrow.decision, panoramas=narrow.panoramas)
    assert trial_config_for(same) == expected
    fine = MappedRooms(MappedRoomsConfig(building, resolution=DeliveryConfig().resolution / 2, radius=0.0))
    config = trial_config_for(fine)
    assert config.camera.wall_height == TrialConfig().camera.wall_height * 2
    assert config.replan_distance == TrialConfig().replan_distance * 2


def test_rooms_that_cannot_be_reached_are_named(building):
    file = building.with_name("other.yaml")
    file.write_text(ROOMS + "  d: [{polygon: [[20, 2], [22, 2], [22, 3], [20, 3]]}]\n")
    with pytest.warns(MapWarning, match=r"less than 2 m2 of d;"):
        assert _mapped(building, rooms=file).left_out == ("d",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rooms:\n  a: [{polygon: [[0.5, 2], [3, 2], [3, 3.5], [0.5, 3.5]]}]\n", "two rooms and a hallway"),
        ("rooms: {}\n", "is missing or empty"),
        ("room: {a: []}\n", "unknown key 'room'"),
        ("rooms: {a: [{polygon: [[0, 0], [1, 1]]}]}\n", "three vertices"),
    ],
)
def test_wrong_rooms_are_refused(building, text, message):
    building.with_name("map.rooms.yaml").write_text(text)
    with pytest.raises(MapError, match=message):
        _mapped(building)


def test_real_buildings_are_for_testing_alone(building):
    generator = make(f"parcels:{building},resolution=0.5,radius=0")
    with pytest.raises(WorldError, match="test data"):
        world_key("training", 0, generator.name)
    with pytest.raises(MapError, match="write parcels:FILE"):
        make(f"parcels:{building},size=3")


def test_two_rooms_of_a_kind_are_needed_where_two_things_are():
    rooms = np.array([[0, 0, 0, -1, 1, 1]], np.int32)
    floor = Floor(rooms, np.zeros(rooms.shape, bool), (Kind.HALLWAY, Kind.OTHER), 0.5)
    with pytest.raises(WorldError, match="too few rooms of kind other or office"):
        furnish(floor, jax.random.key(0), PARCELS, FurnishConfig(), rooms.shape)


def test_a_sweep_takes_what_the_environment_needs_and_the_file_says():
    data = {"environments": ["delivery"], "tasks": [1], "policies": ["baseline"], "worlds": 2}
    config = specification_from_dict(data, "here").config
    assert config == trial_config_for(make("delivery")) != TrialConfig()
    changed = {**data, "settings": {"decision": {"search": {"simulations": 9}}}}
    decision = specification_from_dict(changed, "here").config.decision
    assert (decision.search.simulations, decision.frontiers) == (9, config.decision.frontiers)
    few = {**data, "settings": {"decision": {"frontiers": {"max_subgoals": 5}}}}
    assert specification_from_dict(few, "here").config.decision.frontiers.max_subgoals == 5


def test_environments_that_need_different_settings_are_swept_apart(building):
    names = [f"parcels:{building},radius=0,resolution={resolution}" for resolution in (0.5, 0.25)]
    data = {"environments": names, "tasks": [1], "policies": ["baseline"], "worlds": 2, "split": "test"}
    with pytest.raises(SpecificationError, match="need different settings"):
        specification_from_dict(data, "here")
