"""The fire-fighting buildings that agree with what was seen, and the estimator that answers by them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.environments.firefighting_layout import (
    FirefightingConfig,
    Room,
    Shares,
    building_of,
    hallway_columns,
    hallway_rows,
    layout_of,
    room_columns,
)
from potlp_jax.environments.firefighting_posterior import (
    SIGNS,
    SMOKE_SEEN,
    Evidence,
    code_of,
    draw_buildings,
    draw_noise,
    posterior,
    prior_of,
)
from potlp_jax.environments.splits import world_key
from potlp_jax.learning.ideal_observer import ideal_observer, mean_labels
from potlp_jax.learning.labels import true_labels
from potlp_jax.learning.observing import observe_panorama
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.situation import assess
from potlp_jax.types import Status
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig, observe, visible

CONFIG = FirefightingConfig(
    room_width=4, room_height=9, hallway_length=8, hallway_width=1, hallway_spacing=3, smoke_reach=0.5
)
FAMILY = Firefighting(CONFIG)
WIDE_PATCHES = Firefighting(dataclasses.replace(CONFIG, patch_radius=1, room_width=6))
SENSOR = SensorConfig(range_cells=6.0)
FRONTIERS = FrontierConfig(max_subgoals=6)
assess_jit = jax.jit(assess, static_argnames="config")
draw = jax.jit(draw_buildings)
chances_of = jax.jit(posterior)
answers = jax.jit(lambda estimator, belief, subgoals, task: estimator(belief, subgoals, task))
BITS = {name: 1 << index for index, name in enumerate(Firefighting.propositions)}
NO_PANORAMA = jnp.zeros((1, 1, 3), jnp.uint8)


def _explored(family, index, places):
    """A world, its layout, an observer and a belief after looking around from some places, the start first."""
    key = world_key("training", index, family.name)
    world, layout = family.generate_with_layout(key)
    observer = ideal_observer(family.posterior(key, jax.random.key(index), 64), world)
    belief = BeliefMap.unobserved(world)
    free = np.argwhere(~np.asarray(world.occupied))
    others = free[np.random.default_rng(index).integers(len(free), size=places - 1)] if places > 1 else []
    for cell in [np.asarray(world.start), *others]:
        at = jnp.asarray(cell, jnp.int32)
        belief = observe(belief, world, at, SENSOR)
        observer = observe_panorama(observer, NO_PANORAMA, belief, at)
    return world, layout, observer, belief


def _glimpsed(family, index):
    """As ``_explored``, of a robot that knows its room and a part of the other, and has seen floors of a hallway."""
    world, layout, observer, _ = _explored(family, index, 1)
    revealed = BeliefMap.revealed(world)
    rows, columns = np.indices(world.shape)
    first, last = room_columns(family.config, layout.robot_room)
    hallways = slice(*hallway_columns(family.config))
    known = ((columns >= first) & (columns < last)) | (rows < 3)
    known[1:, hallways] = False
    belief = dataclasses.replace(
        revealed,
        cells=jnp.where(known, revealed.cells, jnp.int8(BeliefMap.UNKNOWN)),
        letters=jnp.where(known, revealed.letters, 0),
    )
    middle = slice(*hallway_rows(family.config, 1))
    in_sight = np.zeros(world.shape, bool)
    in_sight[middle, hallways] = [True, True, True, *[False] * 5]
    in_sight &= ~np.asarray(world.occupied)
    signs = jnp.where(in_sight, observer.prior.truth & SIGNS, 0).astype(jnp.uint8)
    return (
        world,
        layout,
        dataclasses.replace(observer, memory=Evidence(in_sight=jnp.asarray(in_sight), signs=signs)),
        belief,
    )


def _agree(built, belief, evidence):
    """Whether a building contradicts nothing, cell by cell."""
    mapped, in_sight = ~np.asarray(belief.unknown), np.asarray(evidence.in_sight)
    signs = np.where(built.green, 2, 0) | np.where(built.smoke > SMOKE_SEEN, 4, 0)
    return bool(
        (built.occupied == np.asarray(belief.occupied))[mapped].all()
        and (built.letters == np.asarray(belief.letters))[mapped].all()
        and (signs == np.asarray(evidence.signs))[in_sight].all()
    )


@pytest.mark.long
@pytest.mark.parametrize("family", [FAMILY, WIDE_PATCHES, Firefighting.toy()], ids=["cell", "patch", "toy"])
@pytest.mark.parametrize("places", [1, 4])
def test_drawn_buildings_agree_with_all_that_was_seen(family, places):
    for index in range(3):
        world, _, observer, belief = _explored(family, index, places)
        occupied, letters = draw(observer.prior.prior, belief, observer.memory, observer.prior.noise)
        mapped = ~np.asarray(belief.unknown)
        np.testing.assert_array_equal(np.asarray(occupied)[:, mapped], np.tile(world.occupied[mapped], (64, 1)))
        np.testing.assert_array_equal(np.asarray(letters)[:, mapped], np.tile(world.letters[mapped], (64, 1)))
        # Each is a building of the generator, with one patch of each kind.
        side = 2 * family.config.patch_radius + 1
        for name in ("extinguisher", "exit"):
            assert (((np.asarray(letters) & BITS[name]) > 0).sum(axis=(1, 2)) == side**2).all()
        # What the camera alone has shown: the drawn ones have the same tiles and the same smoke there.
        drawn = np.asarray(chances_of(observer.prior.prior, belief, observer.memory)) > 0
        seen = np.asarray(observer.memory.in_sight)
        signs = np.asarray(observer.prior.prior.codes)[drawn][:, seen] & SIGNS
        np.testing.assert_array_equal(signs, np.tile(np.asarray(observer.prior.truth)[seen] & SIGNS, (drawn.sum(), 1)))


def test_the_camera_shows_floors_in_line_of_sight_beyond_the_range_of_the_map():
    world, layout, observer, belief = _explored(FAMILY, 0, 1)
    far = np.asarray(visible(world.occupied, world.start, SensorConfig(range_cells=99.0)) & ~world.occupied)
    np.testing.assert_array_equal(np.asarray(observer.memory.in_sight), far)
    assert (far & np.asarray(belief.unknown)).any()
    signs = code_of(building_of(CONFIG, layout)) & SIGNS
    np.testing.assert_array_equal(np.asarray(observer.memory.signs), np.where(far, signs, 0))


def test_of_a_building_that_is_wholly_mapped_there_is_one():
    for index in range(4):
        world, layout, observer, _ = _explored(FAMILY, index, 1)
        occupied, letters = draw(observer.prior.prior, BeliefMap.revealed(world), observer.memory, observer.prior.noise)
        np.testing.assert_array_equal(np.asarray(occupied), np.tile(world.occupied, (64, 1, 1)))
        np.testing.assert_array_equal(np.asarray(letters), np.tile(world.letters, (64, 1, 1)))
        chances = chances_of(observer.prior.prior, BeliefMap.revealed(world), observer.memory)
        own = code_of(building_of(CONFIG, layout))
        assert np.isclose(chances[np.all(np.asarray(observer.prior.prior.codes) == own, axis=(1, 2))].sum(), 1.0)


@functools.cache
def _rejected(family, room, rounds=20_000):
    """Layouts drawn as the generator draws them, of robots in one room."""
    rng, found = np.random.default_rng(5), []
    for _ in range(rounds):
        shares = Shares(*rng.random(len(Shares._fields)))._replace(side=0.0 if room is Room.LEFT else 0.5)
        found.append(building_of(family.config, layout_of(family.config, shares)))
    return found


@pytest.mark.parametrize("family", [FAMILY, WIDE_PATCHES], ids=["cell", "patch"])
def test_the_prior_has_the_generators_probabilities(family):
    prior = prior_of(family.config, Room.LEFT)
    assert np.isclose(np.asarray(prior.probability).sum(), 1.0)
    drawn = _rejected(family, Room.LEFT, 4000)
    expected = {}
    for code, probability in zip(np.asarray(prior.codes), np.asarray(prior.probability), strict=True):
        expected[code.tobytes()] = expected.get(code.tobytes(), 0.0) + float(probability)
    counts = dict.fromkeys(expected, 0)
    for built in drawn:
        counts[code_of(built).tobytes()] += 1
    for code, probability in expected.items():
        assert abs(counts[code] - 4000 * probability) < 5 * np.sqrt(4000 * probability), probability


@pytest.mark.parametrize(("family", "index"), [(FAMILY, 5), (WIDE_PATCHES, 0), (WIDE_PATCHES, 4)])
def test_draws_are_those_of_rejection(family, index):
    # Of the wide patches a part of the extinguisher has been seen, or of the exit, and may lie in more than one place.
    world, layout, observer, belief = _glimpsed(family, index)
    kept = [built for built in _rejected(family, layout.robot_room, 4000) if _agree(built, belief, observer.memory)]
    assert len(kept) > 60
    noise = draw_noise(jax.random.key(3), 2000, world.shape)
    occupied, letters = (np.asarray(array) for array in draw(observer.prior.prior, belief, observer.memory, noise))
    for bit in BITS.values():
        expected = np.mean([built.letters & bit > 0 for built in kept], axis=0)
        error = np.sqrt(np.maximum(expected * (1 - expected), 1 / len(kept)) / len(kept))
        assert (np.abs((letters & bit > 0).mean(axis=0) - expected) < 5 * error + 0.01).all()
    walls = np.mean([built.occupied for built in kept], axis=0)
    assert np.abs(occupied.mean(axis=0) - walls).max() < 5 * 0.5 / np.sqrt(len(kept))


def test_answers_are_the_mean_labels_of_rejected_buildings():
    world, layout, observer, belief = _glimpsed(FAMILY, 5)
    kept = [built for built in _rejected(FAMILY, layout.robot_room, 4000) if _agree(built, belief, observer.memory)]
    kept = kept[:200]
    task = FAMILY.task("3")
    state = task.arrays.initial
    subgoals = assess_jit(belief, world.start, state, task.arrays, config=FRONTIERS).subgoals

    @jax.jit
    def labels(occupied, letters):
        def label(building):
            given = dataclasses.replace(world, occupied=building[0], letters=building[1])
            return true_labels(given, belief, subgoals, task.arrays)

        return jax.lax.map(label, (occupied, letters))

    slow = labels(jnp.stack([built.occupied for built in kept]), jnp.stack([built.letters for built in kept]))
    found = answers(observer, belief, subgoals, task.arrays)
    real = np.asarray(subgoals.mask)[:, None] & np.asarray(task.arrays.class_mask)[None]
    assert real.sum() > 3
    assert int(found.status) == 0
    success, costs, failures = (
        np.asarray(getattr(slow, name)) for name in ("success_probability", "success_cost", "failure_cost")
    )
    chance = success.mean(axis=0)
    assert 0.05 < chance[real].mean() < 0.95
    np.testing.assert_allclose(found.success_probability[real], chance[real], atol=5 * 0.5 / np.sqrt(len(kept)))
    for values, weight, answer in ((costs, success, found.success_cost), (failures, 1 - success, found.failure_cost)):
        enough = real & (weight.sum(axis=0) > 20)
        assert enough.any()
        mean = (values * weight).sum(axis=0)[enough] / weight.sum(axis=0)[enough]
        error = np.sqrt(((values - values.mean(axis=0)) ** 2).mean(axis=0)[enough] / weight.sum(axis=0)[enough])
        assert (np.abs(np.asarray(answer)[enough] - mean) < 5 * error + 0.3).all()


def test_means_are_of_those_that_succeed_and_of_those_that_fail():
    labels = Estimates(
        success_probability=jnp.array([[[1.0, 0.0, 1.0]], [[0.0, 0.0, 1.0]]]),
        success_cost=jnp.array([[[8.0, 1.0, 4.0]], [[1.0, 1.0, 6.0]]]),
        failure_cost=jnp.array([[[3.0, 5.0, 2.0]], [[7.0, 9.0, 4.0]]]),
    )
    means = mean_labels(labels)
    np.testing.assert_allclose(means.success_probability, [[0.5, 0.0, 1.0]])
    np.testing.assert_allclose(means.success_cost, [[8.0, 1.0, 5.0]])
    np.testing.assert_allclose(means.failure_cost, [[7.0, 7.0, 3.0]])


def test_what_no_building_explains_is_invalid():
    world, _, observer, belief = _explored(FAMILY, 0, 1)
    # Walls everywhere: no building of the generator.
    belief = dataclasses.replace(belief, cells=jnp.full(world.shape, BeliefMap.OCCUPIED, jnp.int8))
    evidence = Evidence(in_sight=jnp.zeros(world.shape, bool), signs=jnp.zeros(world.shape, jnp.uint8))
    assert not np.asarray(chances_of(observer.prior.prior, belief, evidence)).any()
    task = FAMILY.task("3").arrays
    subgoals = assess_jit(belief, world.start, task.initial, task, config=FRONTIERS).subgoals
    assert Status.INVALID in Status(int(answers(observer, belief, subgoals, task).status))
