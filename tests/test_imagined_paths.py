"""Paths on imagined squares, against Dijkstra's algorithm on their sides, and what follows from them in buildings."""

import functools
import heapq

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.learning import square_ways
from potlp_jax.learning.imagined_paths import (
    OF_GOAL,
    OF_WAY,
    PROSPECTS,
    Outlook,
    outlook,
    outlook_of_first,
    prospects,
    scenery,
)
from potlp_jax.learning.squares import EAST, NORTH, PASSAGES, SOUTH, SQUARE, WEST, true_squares
from potlp_jax.world.grid import BeliefMap

_outlook = jax.jit(outlook)
NAMES = ("goal", "hazard")
SHARE, DISTANCE, SEEN = 2, 4, 5


def side_of(row: int, column: int, side: int) -> tuple[str, int, int]:
    """One name for a side that two squares share."""
    return {
        WEST: ("upright", row, column),
        EAST: ("upright", row, column + 1),
        NORTH: ("level", row, column),
        SOUTH: ("level", row + 1, column),
    }[side]


def cheapest(start: dict[tuple[str, int, int], float], closed: np.ndarray) -> dict[tuple[str, int, int], float]:
    """Dijkstra's algorithm; ``closed``: chance by row, column and passage, infinite where none is."""
    found: dict[tuple[str, int, int], float] = {}
    heap = [(cost, side) for side, cost in start.items()]
    heapq.heapify(heap)
    links: dict[tuple[str, int, int], list[tuple[tuple[str, int, int], float]]] = {}
    for row, column, passage in np.ndindex(*closed.shape):
        ends = [side_of(row, column, side) for side in PASSAGES[passage]]
        length = 4.0 if passage < 2 else 2.8
        cost = length + 600.0 * float(closed[row, column, passage])
        for one, other in (ends, ends[::-1]):
            links.setdefault(one, []).append((other, cost))
    while heap:
        cost, side = heapq.heappop(heap)
        if side in found:
            continue
        found[side] = cost
        for other, step in links.get(side, []):
            if np.isfinite(step) and other not in found:
                heapq.heappush(heap, (cost + step, other))
    return found


@pytest.mark.parametrize("seed", range(6))
def test_ways_equal_those_of_dijkstra(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # Without the tolerance that saves sweeps.
    monkeypatch.setattr(square_ways, "_GAIN", 0.0)
    random = np.random.default_rng(seed)
    rows, columns, lanes = int(random.integers(2, 7)), int(random.integers(2, 9)), 3
    closed = random.choice([0.0, 0.0, 0.3, 1.0, np.inf], (rows, columns, len(PASSAGES), lanes))
    begins = random.random((rows, columns, lanes)) < 0.1
    start = square_ways.ways_to_sides(jnp.where(jnp.asarray(begins), 2.0, jnp.inf))
    chances = [jnp.asarray(closed[..., passage, :], jnp.float32) for passage in range(len(PASSAGES))]
    ways = jax.jit(square_ways.cheapest_ways)(start, chances)
    for lane in range(lanes):
        of_lane = {
            side_of(row, column, side): 2.0
            for row, column in np.argwhere(begins[:, :, lane]).tolist()
            for side in range(4)
        }
        wanted = cheapest(of_lane, closed[:, :, :, lane])
        for name, found in (("upright", ways.upright), ("level", ways.level)):
            cost = np.asarray(found.cost[:, :, lane])
            for row, column in np.ndindex(*cost.shape):
                assert cost[row, column] == pytest.approx(wanted.get((name, row, column), np.inf), rel=1e-5)
            # A length can be walked: what is left of the cost without the obstacles.
            length = np.asarray(found.length[:, :, lane])[np.isfinite(cost)]
            assert np.all(length >= 2.0 - 1e-2)


def belief_of(cells: np.ndarray, letters: np.ndarray) -> BeliefMap:
    """A belief with these cells."""
    return BeliefMap(
        cells=jnp.asarray(cells, jnp.int8),
        letters=jnp.asarray(letters, jnp.int32),
        resolution=jnp.float32(1.0),
        extent=jnp.asarray(cells.shape, jnp.int32),
        propositions=NAMES,
    )


@functools.cache
def house() -> tuple[np.ndarray, np.ndarray]:
    """Two hallways side by side, of which the upper is closed by a wall of one cell; behind them a hall with a goal."""
    cells = np.full((20, 40), BeliefMap.OCCUPIED, np.int8)
    cells[1:-1, 1:8] = cells[1:-1, 30:-1] = BeliefMap.FREE
    cells[3:6, 8:30] = cells[13:16, 8:30] = BeliefMap.FREE
    cells[3:6, 22] = BeliefMap.OCCUPIED
    letters = np.zeros(cells.shape, np.int32)
    letters[10, 36] = 1
    return cells, letters


def left_part(cells: np.ndarray) -> np.ndarray:
    """What is seen of the house from its left room: the room and where both hallways begin."""
    seen = np.zeros(cells.shape, bool)
    seen[:, :10] = True
    return seen


def beyond(cells: np.ndarray, letters: np.ndarray, seen: np.ndarray, places: list[tuple[int, int]]) -> Outlook:
    """The outlook from some places of a building that is imagined as it is; the hazard is avoided."""
    return _outlook(*asked(cells, letters, seen, places))


def asked(cells: np.ndarray, letters: np.ndarray, seen: np.ndarray, places: list[tuple[int, int]], own_within: int = 0):
    """What ``beyond`` asks."""
    belief = belief_of(np.where(seen, cells, BeliefMap.UNKNOWN), np.where(seen, letters, 0))
    _, imagined = true_squares(jnp.asarray(cells), jnp.asarray(letters), len(NAMES))
    stay = jnp.tile(jnp.array([[0, -1]], jnp.int8), (len(places), 1))
    return scenery(belief, imagined, own_within), jnp.asarray(places, jnp.int32), stay


@pytest.mark.long
@pytest.mark.parametrize("count", [0, 1, 16, 17, 20])
def test_the_first_lanes_have_the_outlook_that_they_have_together(count) -> None:
    cells, letters = house()
    scene, subgoals, stay = asked(cells, letters, left_part(cells), [(row % 18 + 1, 9) for row in range(20)])
    found = jax.jit(outlook_of_first)(jnp.int32(count), scene, subgoals, stay)
    for some, every in zip(jax.tree.leaves(found), jax.tree.leaves(_outlook(scene, subgoals, stay)), strict=True):
        assert np.any(np.asarray(every) != 0, axis=tuple(range(1, every.ndim))).all()
        np.testing.assert_allclose(some[:count], every[:count], rtol=1e-5, atol=1e-5)
        assert not np.asarray(some[count:]).any()


def test_a_goal_is_reached_through_the_open_hallway_alone() -> None:
    cells, letters = house()
    seen = left_part(cells)
    found = beyond(cells, letters, seen, [(4, 9), (14, 9)])
    assert found.goal[0, 0, SHARE] == 0.0
    assert found.goal[1, 0, SHARE] == 1.0
    # About 21 cells of hallway, and 6 or 7 in the hall.
    length = 10 * np.expm1(float(found.goal[1, 0, DISTANCE]))
    assert 24 <= length <= 36


def test_what_is_avoided_closes_a_hallway() -> None:
    cells, letters = house()
    letters = letters.copy()
    letters[13:16, 20] = 2
    seen = left_part(cells)
    found = beyond(cells, letters, seen, [(14, 9)])
    assert found.goal[0, 0, SHARE] == 0.0


def test_a_goal_that_was_seen_counts_where_a_way_comes_out_by_another_frontier() -> None:
    cells, letters = house()
    seen = left_part(cells)
    # Seen from afar, as through a fire.
    seen[8:12, 30:39] = True
    found = beyond(cells, letters, seen, [(14, 9), (4, 9)])
    assert found.goal[0, 0, SEEN] == 1.0
    assert found.goal[1, 0, SEEN] == 0.0


def test_a_way_does_not_come_back_by_its_own_frontier() -> None:
    cells, letters = house()
    letters = np.zeros_like(letters)
    letters[10, 3] = 1
    seen = left_part(cells)
    found = beyond(cells, letters, seen, [(14, 9)])
    assert found.goal[0, 0, SEEN] == 0.0


@pytest.mark.parametrize("gap", [6, 10, 30])
def test_a_gap_is_open_from_both_sides(gap: int) -> None:
    # One hallway, of which all was seen but a piece in its middle; the goal is at one of its ends.
    cells = np.full((8, 64), BeliefMap.OCCUPIED, np.int8)
    cells[2:6, 1:-1] = BeliefMap.FREE
    first = 32 - gap // 2
    seen = np.ones(cells.shape, bool)
    seen[2:6, first : first + gap] = False
    ends = [(3, first - 1), (3, first + gap)]
    for goal, frontier in (((4, 60), 0), ((4, 3), 1)):
        letters = np.zeros(cells.shape, np.int32)
        letters[goal] = 1
        assert float(beyond(cells, letters, seen, ends).goal[frontier, 0, SEEN]) == 1.0
        # By their distance alone the frontiers of a small gap cannot be told apart.
        within = _outlook(*asked(cells, letters, seen, ends, own_within=2))
        assert float(within.goal[frontier, 0, SEEN]) == (gap >= 10)


def test_a_frontier_beside_a_subgoals_own_is_not_reached_without_a_way() -> None:
    # Two doors of a hallway into two rooms that only the hallway joins, of which one was looked into a little farther;
    # the goal is in the hallway.
    cells = np.full((24, 28), BeliefMap.OCCUPIED, np.int8)
    cells[1:6, 1:-1] = cells[8:-1, 1:11] = cells[8:-1, 13:-1] = BeliefMap.FREE
    cells[6:8, 8:11] = cells[6:8, 13:16] = BeliefMap.FREE
    letters = np.zeros(cells.shape, np.int32)
    letters[2, 2] = 1
    seen = np.zeros(cells.shape, bool)
    seen[:8] = seen[:10, 13:16] = True
    doors = [(7, 9), (9, 14)]
    assert np.asarray(beyond(cells, letters, seen, doors).goal[:, 0, SEEN]).tolist() == [0.0, 0.0]
    # Where a doorway joins the rooms there is one.
    cells[16:20, 11:13] = BeliefMap.FREE
    assert np.asarray(beyond(cells, letters, seen, doors).goal[:, 0, SEEN]).tolist() == [1.0, 1.0]


def test_a_long_frontier_is_its_own_however_far_it_goes() -> None:
    # A hall of which one half was seen, so that its frontier is as long as the hall is wide.
    cells = np.full((44, 24), BeliefMap.OCCUPIED, np.int8)
    cells[1:-1, 1:-1] = BeliefMap.FREE
    letters = np.zeros(cells.shape, np.int32)
    letters[40, 4] = 1
    seen = np.zeros(cells.shape, bool)
    seen[:, :10] = True
    ends = [(3, 9), (40, 9)]
    assert np.asarray(beyond(cells, letters, seen, ends).goal[:, 0, SEEN]).tolist() == [0.0, 0.0]
    within = _outlook(*asked(cells, letters, seen, ends, own_within=2))
    assert float(within.goal[0, 0, SEEN]) == 1.0


def test_a_subgoal_beside_the_frontier_has_the_frontier_that_it_is_near() -> None:
    # As on a map of other cells.
    cells, letters = house()
    letters = np.zeros_like(letters)
    letters[10, 3] = 1
    found = beyond(cells, letters, left_part(cells), [(14, 9), (14, 8), (14, 7)])
    assert np.asarray(found.goal[:, 0, SEEN]).tolist() == [0.0, 0.0, 0.0]


def test_a_goal_before_a_wall_is_not_reached_from_behind_it() -> None:
    cells, letters = house()
    letters = np.zeros_like(letters)
    # Beside the wall at column 22, in the same squares.
    letters[3:6, 21] = 1
    seen = left_part(cells)
    before, behind = np.asarray(beyond(cells, letters, seen, [(4, 9), (14, 9)]).goal[:, 0, SHARE])
    assert before == 1.0
    assert behind == 0.0


def test_prospects_of_several_propositions_are_the_worst() -> None:
    lanes = Outlook(
        way=jnp.ones((3, OF_WAY)),
        goal=jnp.stack([jnp.tile(jnp.arange(OF_GOAL, dtype=jnp.float32), (3, 1)), jnp.full((3, OF_GOAL), 2.5)], axis=1),
    )
    both, one, none = prospects(lanes, jnp.array([[1, 1], [1, 0], [0, -1]], jnp.int8))
    assert both.shape == (PROSPECTS,)
    assert both[OF_WAY:-1].tolist() == [0.0, 1.0, 2.0, 2.5, 4.0, 2.5, 6.0]
    assert one[OF_WAY:-1].tolist() == list(range(OF_GOAL))
    assert none[OF_WAY:].tolist() == [0.0] * (OF_GOAL + 1)


def test_squares_are_four_cells() -> None:
    # Lengths of steps are written down for squares of this side.
    assert SQUARE == 4
