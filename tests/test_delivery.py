"""Generated academic floors: who is where, what is lit, that all can be reached, how different floors are."""

import dataclasses
import heapq
import itertools
import math
from collections import deque

import jax
import numpy as np
import pytest
from scipy import ndimage

from potlp_jax.environments.campus.delivery import Delivery, DeliveryConfig
from potlp_jax.environments.campus.furnishing import (
    NO_ROOM,
    PEOPLE,
    Floor,
    FurnishConfig,
    Kind,
    furnish,
    missing_kinds,
)
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import WorldError
from potlp_jax.planning.policies import Policy
from potlp_jax.task.shipped import shipped_tasks
from potlp_jax.task.task import Task
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome
from potlp_jax.world.grid import world_digest
from potlp_jax.world.settings import NO_SETTINGS

GENERATOR = Delivery()
FLOORS = 80
WORLDS = 25


def _key(index: int, split: Split = Split.TRAINING) -> jax.Array:
    return world_key(split, index, GENERATOR.name)


@pytest.fixture(scope="module")
def floors() -> list[Floor]:
    return [GENERATOR.draw_floor(_key(index)) for index in range(FLOORS)]


@pytest.fixture(scope="module")
def worlds():
    return [GENERATOR.generate_with_layout(_key(index)) for index in range(WORLDS)]


def _reached(occupied: np.ndarray, start: tuple[int, int]) -> np.ndarray:
    """Flood fill."""
    reached, queue = np.zeros(occupied.shape, bool), deque([start])
    reached[start] = True
    while queue:
        row, column = queue.popleft()
        for cell in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
            if not occupied[cell] and not reached[cell]:
                reached[cell] = True
                queue.append(cell)
    return reached


def _hallways(floor: Floor) -> np.ndarray:
    return np.isin(floor.rooms, floor.rooms_of(Kind.HALLWAY))


def _loops(floor: Floor) -> int:
    """Pieces of what is no hallway that hallways go all the way around."""
    rest = np.pad(~_hallways(floor), 1, constant_values=True)
    return ndimage.label(rest, np.ones((3, 3)))[1] - 1


def _dead_ends(hall: np.ndarray) -> int:
    """Ends of hallways: stretches of 3 to 6 hallway cells with walls in front and on both sides, two rows deep."""
    ends = 0
    for turned in range(4):
        cells = np.pad(np.rot90(hall, turned), 2)
        for row in range(2, len(cells) - 2):
            starts = np.flatnonzero(cells[row] & ~np.roll(cells[row], 1))
            for start in starts:
                stop = start + int(np.argmin(cells[row, start:]))
                behind = cells[row + 1, start - 1 : stop + 1]
                straight = behind[1:-1].all() and not behind[0] and not behind[-1]
                ends += 3 <= stop - start <= 6 and not cells[row - 1, start:stop].any() and bool(straight)
    return ends


def test_people_are_in_rooms_of_their_kind(worlds):
    for world, floor, placement in worlds:
        letters = np.asarray(world.letters)[: floor.rooms.shape[0], : floor.rooms.shape[1]]
        assert np.asarray(world.letters).sum() == letters.sum(), "nobody is in the padding"
        for bit, name in enumerate(PEOPLE.propositions):
            cells = letters >> bit & 1 == 1
            rooms = np.unique(floor.rooms[cells])
            assert rooms.tolist() == [placement.rooms[name]]
            assert floor.kinds[rooms[0]] in PEOPLE.rooms[name]
            assert cells[placement.cells[name]]
            assert 1 <= np.count_nonzero(cells) <= 9
        assert np.unique(letters).tolist() == [0, 1, 2, 4]


def test_everybody_is_everywhere_sometimes():
    """In one building, people and start move with the key; every room of the right kind is taken at some time."""
    floor = Delivery.toy().draw_floor(_key(0))
    seen = {name: set() for name in PEOPLE.propositions}
    starts = set()
    for index in range(60):
        _, placement = furnish(floor, _key(index), PEOPLE, FurnishConfig(), floor.rooms.shape)
        starts.add(placement.start)
        assert floor.kind_of_cell[placement.start] == Kind.HALLWAY
        for name, room in placement.rooms.items():
            seen[name].add(room)
    assert len(starts) > 20
    for name, rooms in seen.items():
        assert rooms == set(floor.rooms_of(PEOPLE.rooms[name][0])) or len(rooms) > 8


def test_light_is_on_where_somebody_is_and_in_hallways(worlds):
    for world, floor, placement in worlds:
        light = np.asarray(world.appearance.light)
        for number, kind in enumerate(floor.kinds):
            found = light[: floor.rooms.shape[0], : floor.rooms.shape[1]][floor.rooms == number]
            occupied = number in placement.rooms.values()
            expected = 1.0 if occupied else placement.hallway_light if kind is Kind.HALLWAY else 0.0
            np.testing.assert_allclose(found, expected, rtol=1e-6)
        assert 0.6 <= placement.hallway_light <= 1.0
    assert len({placement.hallway_light for _, _, placement in worlds}) > 10


def test_walls_have_the_colour_of_the_rooms_beside_them():
    config = DeliveryConfig(smallest=(36, 48), largest=(48, 64), furnishing=FurnishConfig(tint=0, tint_noise=0))
    world, floor, _ = Delivery(config).generate_with_layout(_key(3))
    colours, kinds = np.asarray(world.appearance.wall_colour), floor.kind_of_cell
    by_kind: dict[Kind, set[tuple[int, ...]]] = {}
    for row, column in np.argwhere(floor.occupied):
        near = kinds[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        if near.max() != NO_ROOM:
            by_kind.setdefault(Kind(int(near.max())), set()).add(tuple(colours[row, column].tolist()))
    assert set(by_kind) >= {Kind.OFFICE, Kind.LAB, Kind.CLASSROOM, Kind.HALLWAY}
    assert all(len(found) == 1 for found in by_kind.values())
    assert len(set.union(*by_kind.values())) == len(by_kind)


def test_every_room_can_be_reached_from_the_start(worlds):
    for world, floor, placement in worlds:
        occupied = np.asarray(world.occupied)
        assert (_reached(occupied, placement.start) == ~occupied).all()
        assert set(np.unique(floor.rooms)) == {NO_ROOM, *range(len(floor.kinds))}
        assert tuple(np.asarray(world.start)) == placement.start


def test_doors_join_the_room_they_belong_to_with_another(floors):
    for floor in floors[:40]:
        parts, count = ndimage.label(floor.doors)
        for number in range(1, count + 1):
            part = parts == number
            around = ndimage.binary_dilation(part) & ~part & ~floor.occupied
            assert len(set(floor.rooms[around]) | set(floor.rooms[part])) >= 2
        assert not (_hallways(floor) & floor.doors).any()


def test_worlds_have_one_shape_and_their_own_extent(worlds):
    extents = {tuple(np.asarray(world.extent).tolist()) for world, _, _ in worlds}
    assert {world.shape for world, _, _ in worlds} == {GENERATOR.config.largest}
    assert len(extents) > WORLDS // 2
    for world, floor, _ in worlds:
        rows, columns = np.asarray(world.extent)
        assert (rows, columns) == floor.rooms.shape
        occupied = np.asarray(world.occupied).copy()
        occupied[1 : rows - 1, 1 : columns - 1] = True
        assert occupied.all()
        assert float(world.resolution) == GENERATOR.config.resolution


def test_floors_vary_as_real_ones_do(floors):
    loops = np.array([_loops(floor) for floor in floors])
    dead_ends = np.array([_dead_ends(_hallways(floor)) for floor in floors])
    rooms = np.array([len(floor.kinds) - 1 for floor in floors])
    assert (loops == 0).mean() > 0.1
    assert (loops >= 2).mean() > 0.1
    assert (dead_ends == 0).mean() < 0.2
    assert (dead_ends >= 4).mean() > 0.2
    assert np.quantile(rooms, 0.9) > 1.5 * np.quantile(rooms, 0.1)
    inner = [
        not (ndimage.binary_dilation(floor.rooms == number) & _hallways(floor)).any()
        for floor in floors[:30]
        for number in range(1, len(floor.kinds))
    ]
    assert 0.02 < np.mean(inner) < 0.4, "some rooms lie behind other rooms, most do not"
    for kind, low, high in ((Kind.OFFICE, 4, 60), (Kind.LAB, 15, 120), (Kind.CLASSROOM, 20, 130)):
        areas = np.array(
            [0.25 * np.count_nonzero(floor.rooms == number) for floor in floors for number in floor.rooms_of(kind)]
        )
        assert low < areas.min()
        assert areas.max() < high
        assert np.quantile(areas, 0.9) > 1.8 * np.quantile(areas, 0.1), "square metres"


def test_hallways_are_one_piece(floors):
    for floor in floors:
        assert ndimage.label(_hallways(floor))[1] == 1
        assert not missing_kinds(floor, PEOPLE)


def test_the_dead_end_counter_counts_dead_ends():
    hall = np.zeros((20, 20), bool)
    hall[8:12, 2:18] = True
    assert _dead_ends(hall) == 2
    hall[2:8, 10:13] = True
    assert _dead_ends(hall) == 3
    hall[0:20, 0:2] = True
    assert _dead_ends(hall) == 2


def test_a_key_makes_one_world():
    for index in range(3):
        one, other = Delivery().generate(_key(index)), Delivery().generate(_key(index))
        for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            assert np.array_equal(left, right)


def test_buildings_of_the_splits_are_disjoint(floors):
    buildings = [floor.occupied.tobytes() for floor in floors]
    for split in (Split.CALIBRATION, Split.VALIDATION, Split.TEST):
        buildings += [GENERATOR.draw_floor(_key(index, split)).occupied.tobytes() for index in range(20)]
    assert len(set(buildings)) == len(buildings)


def test_light_and_colours_move_no_wall_and_nobody():
    plain = DeliveryConfig(furnishing=FurnishConfig(hallway_light=(0.0, 0.0), tint=0, tint_noise=0))
    for index in range(3):
        one, other = Delivery(plain).generate(_key(index)), GENERATOR.generate(_key(index))
        assert np.array_equal(one.occupied, other.occupied)
        assert np.array_equal(one.letters, other.letters)
        assert not np.array_equal(one.appearance.wall_colour, other.appearance.wall_colour)


def _grid_costs(occupied: np.ndarray, initial: dict[tuple[int, int], float], side: float) -> np.ndarray:
    """Dijkstra on the 8-connected grid without corner cutting, from cells that begin with a cost."""
    costs = np.full(occupied.shape, np.inf)
    queue = [(cost, cell) for cell, cost in initial.items()]
    heapq.heapify(queue)
    while queue:
        cost, (row, column) = heapq.heappop(queue)
        if cost >= costs[row, column]:
            continue
        costs[row, column] = cost
        for down, right in itertools.product((-1, 0, 1), repeat=2):
            if not (occupied[row + down, column] or occupied[row, column + right]):
                cell = row + down, column + right
                if not occupied[cell] and costs[cell] == np.inf:
                    heapq.heappush(queue, (cost + side * math.hypot(down, right), cell))
    return costs


def test_known_map_finds_the_shortest_round():
    generator = Delivery.toy()
    task = Task.from_formula(generator.tasks["1"], generator.propositions)
    for index in range(2):
        world, _, placement = generator.generate_with_layout(_key(index))
        occupied, letters = np.asarray(world.occupied), np.asarray(world.letters)
        best = math.inf
        for order in itertools.permutations(range(3)):
            costs = _grid_costs(occupied, {placement.start: 0.0}, 0.5)
            for bit in order:
                cells = [tuple(cell) for cell in np.argwhere(letters == 1 << bit)]
                costs = _grid_costs(occupied, {cell: costs[cell] for cell in cells}, 0.5)
            best = min(best, float(min(costs[cell] for cell in cells)))
        trial = run_trial(world, task, Policy.KNOWN_MAP, jax.random.key(index))
        assert trial.outcome is Outcome.SATISFIED
        assert trial.cost == pytest.approx(best, rel=1e-4)


def test_the_family_is_found_by_name_and_its_task_is_shipped():
    generator = make("delivery")
    assert generator.propositions == ("professor", "grad", "undergrad")
    assert generator.tasks["1"] == "F professor & F grad & F undergrad" == shipped_tasks()["delivery-1"]
    assert Task.shipped("delivery-1").propositions == generator.propositions


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"smallest": (100, 72)}, "largest"),
        ({"smallest": (10, 72)}, "at least 24"),
        ({"resolution": 0.0}, "resolution"),
        ({"door_width": 4}, "door_width"),
        ({"row_depth": 5}, "row_depth"),
        ({"outdoors": 1.5}, "probability"),
    ],
)
def test_impossible_configurations_are_refused(change, message):
    with pytest.raises(WorldError, match=message):
        DeliveryConfig(**change)


def test_impossible_furnishings_are_refused(floors):
    with pytest.raises(WorldError, match="hallway_light"):
        FurnishConfig(hallway_light=(0.9, 0.1))
    with pytest.raises(WorldError, match="does not fit"):
        furnish(floors[0], _key(0), PEOPLE, FurnishConfig(), (10, 10))
    floor = Floor(np.zeros((4, 4), np.int32), np.zeros((4, 4), bool), (Kind.HALLWAY,), 0.5)
    with pytest.raises(WorldError, match="office, lab, classroom"):
        furnish(floor, _key(0), PEOPLE, FurnishConfig(), (4, 4))


def test_floors_without_rooms_are_refused():
    with pytest.raises(WorldError, match="had the rooms that delivery needs"):
        Delivery(DeliveryConfig(smallest=(36, 48), largest=(40, 56), outdoors=1.0)).generate(_key(0))


@pytest.mark.parametrize(
    ("name", "digests"),
    [
        ("delivery", ("59528ef547b1cae1", "01d9aff45eee9fc7", "bdfb1f479f643ef2")),
        ("parcels", ("60ecb88a37b9773e", "4672f5fc31158cd9", "212f79d6b20bc4fd")),
    ],
)
def test_worlds_stay_what_published_results_refer_to(name, digests):
    """The shipped estimators learned from these worlds, and results name them by their numbers."""
    splits = (Split.TRAINING, Split.VALIDATION, Split.TEST)
    worlds = [make(name).generate(world_key(split, index, name)) for index, split in enumerate(splits)]
    # Settings of trials are no part of what is drawn.
    assert tuple(world_digest(dataclasses.replace(world, settings=NO_SETTINGS)) for world in worlds) == digests
