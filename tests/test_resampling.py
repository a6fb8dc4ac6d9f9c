"""Maps on cells of another size: against a walk over all cells, and what a building network answers on them."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.building_estimator import BuildingEstimator
from potlp_jax.learning.building_network import BuildingNetwork
from potlp_jax.learning.overlays import overlays_of
from potlp_jax.learning.painting import Painting, blank_painting
from potlp_jax.learning.resampling import cells_in, resampled
from potlp_jax.task.task import Task
from potlp_jax.world.frontiers import FrontierConfig, find_subgoals
from potlp_jax.world.grid import BeliefMap, belief_from_numpy

NAMES = ("goal", "hazard")
CONFIG = BuildingConfig(
    propositions=NAMES,
    image_shape=(64, 128),
    horizon=24.0,
    fold=8.0,
    widths=(4, 4, 4),
    blocks=(0, 0, 0),
    exclusive_within=6.0,
    step=0.5,
)


def _random(shape, seed):
    """A belief and a painting with cells of all kinds, in lumps, so that larger cells are not all mixed."""
    rng = np.random.default_rng(seed)
    lumps = tuple(math.ceil(length / 3) for length in shape)
    cells = np.kron(rng.integers(-1, 2, lumps), np.ones((3, 3), int))[: shape[0], : shape[1]]
    cells = np.where(rng.random(shape) < 0.3, rng.integers(-1, 2, shape), cells).astype(np.int8)
    letters = np.where(cells == BeliefMap.FREE, rng.integers(0, 4, shape) * (rng.random(shape) < 0.2), 0)
    distance = np.where(rng.random(shape) < 0.6, rng.uniform(0, 30, shape), np.inf).astype(np.float32)
    colours = np.where(np.isfinite(distance)[..., None], rng.integers(0, 256, (2, *shape, 3)), 0).astype(np.uint8)
    belief = belief_from_numpy(cells, letters.astype(np.int32), 0.2, propositions=NAMES)
    painting = Painting(floor=jnp.asarray(colours[0]), beyond=jnp.asarray(colours[1]), distance=jnp.asarray(distance))
    return belief, painting


def _slowly(belief, painting, entered, scale):
    """Cell by cell: which cells have their middle in a larger one, and what that one is then."""
    rows, columns = belief.cells.shape
    cells, letters, distance = (np.asarray(layer) for layer in (belief.cells, belief.letters, painting.distance))
    for row in range(math.floor((rows - 0.5) * scale + 1e-4) + 1):
        for column in range(math.floor((columns - 0.5) * scale + 1e-4) + 1):
            parts = [
                (i, j)
                for i in range(rows)
                for j in range(columns)
                if math.floor((i + 0.5) * scale + 1e-4) == row and math.floor((j + 0.5) * scale + 1e-4) == column
            ]
            if not parts:
                parts = [
                    (
                        min(int((row + 0.5) / scale + 1e-4), rows - 1),
                        min(int((column + 0.5) / scale + 1e-4), columns - 1),
                    )
                ]
            kinds = [int(cells[part]) for part in parts]
            if any(part in entered for part in parts):
                kind = 0
            elif 3 * kinds.count(1) >= len(kinds):
                kind = 1
            else:
                kind = -1 if 2 * kinds.count(-1) > len(kinds) else 0
            letter = 0
            for part in parts:
                letter |= int(letters[part])
            painted = [part for part in parts if np.isfinite(distance[part])]
            used = [part for part in painted if cells[part] == kind] or painted
            yield (row, column), kind, letter, used


# 0.4: cells of 0.2 m for a network of 0.5 m. Above 1 the map is the coarser one.
@pytest.mark.parametrize("scale", [0.4, 0.5, 1 / 3, 0.75, 1.25, 2.0])
def test_every_cell_is_what_a_walk_over_its_parts_says(scale):
    shape = (17, 23)
    belief, painting = _random(shape, seed=round(100 * scale))
    entered = jnp.zeros(shape, bool).at[3, 4].set(True).at[16, 22].set(True)
    other, repainted = jax.jit(resampled, static_argnums=3)(belief, painting, entered, scale)
    # The last cell holds the middle of the last one; what lies on a border belongs to the next.
    rows, columns = (int((length - 0.5) * scale + 1e-4) + 1 for length in shape)
    assert other.cells.shape == (rows, columns) == repainted.distance.shape
    assert float(other.resolution) == pytest.approx(0.2 / scale)
    np.testing.assert_array_equal(other.extent, other.cells.shape)
    seen = set()
    for cell, kind, letter, used in _slowly(belief, painting, [(3, 4), (16, 22)], scale):
        seen.add(cell)
        assert (int(other.cells[cell]), int(other.letters[cell])) == (kind, letter), cell
        if not used:
            assert np.isinf(repainted.distance[cell])
            continue
        mean = np.mean([painting.distance[part] for part in used])
        assert float(repainted.distance[cell]) == pytest.approx(mean * scale, rel=1e-5)
        for mine, given in ((repainted.floor, painting.floor), (repainted.beyond, painting.beyond)):
            wanted = np.mean([np.asarray(given[part], float) for part in used], axis=0)
            np.testing.assert_allclose(np.asarray(mine[cell], float), wanted, atol=0.51)
    assert len(seen) == other.cells.size


def test_a_thin_wall_stays_and_a_door_in_it_stays_open():
    cells = np.zeros((20, 40), np.int8)
    for column in range(10, 15):
        walled = cells.copy()
        walled[:, column] = BeliefMap.OCCUPIED
        walled[10:15, column] = BeliefMap.FREE
        belief = belief_from_numpy(walled, np.zeros_like(walled, np.int32), 0.2, propositions=NAMES)
        other, _ = resampled(belief, blank_painting(20, 40), jnp.zeros((20, 40), bool), 0.4)
        there = int(cells_in(jnp.asarray([0, column]), (20, 40), 0.4)[1])
        assert np.asarray(other.cells)[:, there].tolist() == [1, 1, 1, 1, 0, 0, 1, 1]
        assert not np.asarray(other.cells)[:, [there - 1, there + 1]].any()


def _twice(layer):
    return jnp.repeat(jnp.repeat(layer, 2, axis=0), 2, axis=1)


@pytest.mark.long
def test_answers_do_not_depend_on_how_finely_a_map_is_drawn():
    cells = np.full((16, 24), BeliefMap.UNKNOWN, np.int8)
    cells[1:9, 1:13] = BeliefMap.FREE
    cells[0, :14] = cells[9, :10] = BeliefMap.OCCUPIED
    letters = np.zeros(cells.shape, np.int32)
    letters[3, 4] = 2
    belief = belief_from_numpy(cells, letters, 0.5, propositions=NAMES)
    _, painting = _random(cells.shape, seed=5)
    fine = dataclasses.replace(
        belief,
        cells=_twice(belief.cells),
        letters=_twice(belief.letters),
        resolution=jnp.float32(0.25),
        extent=2 * belief.extent,
    )
    on_fine = Painting(
        floor=_twice(painting.floor), beyond=_twice(painting.beyond), distance=2 * _twice(painting.distance)
    )
    params = BuildingNetwork(CONFIG).init(jax.random.key(0))
    params = jax.tree.map(lambda leaf: leaf + 0.05 * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), params)
    asked = BuildingEstimator(params=params, memory=painting, config=CONFIG)
    asked_fine = dataclasses.replace(asked, memory=on_fine, scale=0.5)
    subgoals = find_subgoals(belief, belief.free, jnp.zeros(cells.shape), FrontierConfig(max_subgoals=4))
    subgoals_fine = dataclasses.replace(subgoals, cells=2 * subgoals.cells + 1)
    arrays = Task.from_formula("!hazard U goal", propositions=NAMES).arrays
    answer = jax.jit(lambda eyes, belief, subgoals: eyes(belief, subgoals, arrays))
    said, said_fine = answer(asked, belief, subgoals), answer(asked_fine, fine, subgoals_fine)
    real = np.asarray(subgoals.mask)
    assert real.sum() > 1
    for one, other in zip(jax.tree.leaves(said), jax.tree.leaves(said_fine), strict=True):
        np.testing.assert_allclose(np.asarray(one)[real], np.asarray(other)[real], rtol=1e-4)
    # Without the other cells it would take the building for one of twice the size.
    wrong = answer(dataclasses.replace(asked, memory=on_fine), fine, subgoals_fine)
    assert not np.allclose(np.asarray(said.success_cost)[real], np.asarray(wrong.success_cost)[real], rtol=1e-4)
    shown, shown_fine = overlays_of(asked, belief)[-1], overlays_of(asked_fine, fine)[-1]
    cell = np.repeat(np.repeat(np.asarray(shown.free), 2 * shown.side, 0), 2 * shown.side, 1)
    np.testing.assert_allclose(np.asarray(shown_fine.free), cell[:32, :48], rtol=1e-4)


def test_a_picture_is_painted_where_its_metres_are():
    rng = np.random.default_rng(0)
    panorama = jnp.asarray(rng.integers(1, 256, (64, 128, 3)), jnp.uint8)
    # Nothing is in the way: the same directions are seen on both maps.
    coarse, fine = (
        belief_from_numpy(np.zeros(shape, np.int8), np.zeros(shape, np.int32), size, propositions=NAMES)
        for shape, size in (((15, 15), 0.5), ((31, 31), 0.25))
    )
    asked = BuildingEstimator(params={}, memory=blank_painting(15, 15), config=CONFIG)
    seen = asked.remember(panorama, coarse, jnp.asarray([7, 7])).memory
    on_fine = dataclasses.replace(asked, memory=blank_painting(31, 31), scale=0.5)
    seen_fine = on_fine.remember(panorama, fine, jnp.asarray([15, 15])).memory
    # Cells at the same distance in metres: every other one of the finer map. Nearer than a cell is as at one cell.
    away = np.maximum(*np.abs(np.mgrid[:15, :15] - 7)) > 1
    np.testing.assert_array_equal(np.asarray(seen_fine.floor[1:31:2, 1:31:2])[away], np.asarray(seen.floor)[away])
    np.testing.assert_allclose(seen_fine.distance[1:31:2, 1:31:2], 2 * seen.distance)
