"""Propositions on a map: discs, polygons, letters, and the file that places them."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.environments.ros.grid_frame import GridFrame
from potlp_jax.environments.ros.places import (
    Disc,
    Places,
    Polygon,
    free_cell_beside,
    load_places,
    place_letters,
)
from potlp_jax.errors import MapError
from tests.reference.map_files import PLACES, TWO_ROOMS, occupancy_map


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


UNSEEN, OPEN, WALL = -1, 0, 1


def rough_beside(region, middle, cells, frame):
    """Free cells beside a region in walls, with their distances in metres: the slow twin of ``free_cell_beside``."""
    every = itertools.product(range(cells.shape[0]), range(cells.shape[1]))
    own = set(map(tuple, np.argwhere(region.covers(np.ones(cells.shape, bool), frame)).tolist()))
    if not own or any(cells[cell] != WALL for cell in own):
        return {}
    return {
        (row, column): math.dist(middle, frame.cell_to_metres(row, column))
        for row, column in every
        if cells[row, column] == OPEN and any(max(abs(row - r), abs(column - c)) == 1 for r, c in own)
    }


@given(st.integers(0, 10**6))
@settings(max_examples=200, deadline=None)
def test_a_region_in_walls_is_met_in_the_nearest_free_cell_beside_it(seed):
    random = np.random.default_rng(seed)
    frame = GridFrame(7, 8, 0.4, *random.uniform(-1, 1, 2).tolist(), float(random.uniform(-3, 3)))
    cells = random.choice([UNSEEN, OPEN, WALL, WALL, WALL, WALL, WALL, WALL], (7, 8))
    inside = frame.cell_to_metres(*random.integers(-1, 8, 2).tolist())
    x, y = (value + float(random.uniform(-0.2, 0.2)) for value in inside)
    size = float(random.choice([0.1, 0.5]))
    corners = ((x, y), (x + size, y), (x, y + size))
    regions = ((Disc((x, y), size), (x, y)), (Polygon(corners), tuple(np.mean(corners, axis=0).tolist())))
    for region, middle in regions:
        wanted = rough_beside(region, middle, cells, frame)
        found = free_cell_beside(region, cells == OPEN, cells == WALL, frame)
        assert (found is None) == (not wanted)
        # Of two that are equally far either will do.
        assert found is None or wanted[found] <= min(wanted.values()) + 1e-6
