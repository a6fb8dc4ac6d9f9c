"""Who may be where on a floor, given what was seen of it: against all placements, one by one."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.environments.campus.delivery import Delivery
from potlp_jax.environments.campus.furnishing import PARCELS, PEOPLE, Errand, Floor, FurnishConfig, Kind, furnish
from potlp_jax.environments.campus.people_posterior import people_posterior
from potlp_jax.environments.splits import world_key
from potlp_jax.errors import WorldError
from potlp_jax.learning.ideal_observer import ideal_observer
from potlp_jax.learning.observing import observe_panorama
from potlp_jax.planning.situation import assess
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig, observe, visible

COUNT = 512
NO_PANORAMA = jnp.zeros((1, 1, 3), jnp.uint8)
look = jax.jit(observe, static_argnames="config")


def floor_of(*kinds):
    """Rooms of three by three cells along a hallway, each with a door."""
    rooms = np.full((7, 4 * len(kinds) + 1), -1, np.int32)
    rooms[1:3, 1:-1] = 0
    doors = np.zeros(rooms.shape, bool)
    for index in range(len(kinds)):
        first = 4 * index + 1
        rooms[4:6, first : first + 3] = index + 1
        rooms[3, first + 1] = index + 1
        doors[3, first + 1] = True
    return Floor(rooms, doors, (Kind.HALLWAY, *kinds), 0.5)


OFFICES = floor_of(Kind.OFFICE, Kind.OFFICE, Kind.LAB, Kind.LAB, Kind.OFFICE, Kind.CLASSROOM)
ANY = floor_of(Kind.OTHER, Kind.OTHER, Kind.OTHER, Kind.OTHER)


def seen_from(floor, errand, seed, cells, range_cells=3.0):
    """A world, the posterior and the belief of a robot that has been in some cells."""
    world, placement = furnish(floor, jax.random.key(seed), errand, FurnishConfig(), floor.rooms.shape)
    posterior = people_posterior(floor, errand, 1, placement.rooms, floor.rooms.shape, jax.random.key(seed), COUNT)
    belief = BeliefMap.unobserved(world)
    for cell in cells:
        at = jnp.asarray(cell, jnp.int32)
        belief = look(belief, world, at, SensorConfig(range_cells=range_cells))
        posterior = posterior.after(at)
    return world, posterior, belief


def placements(floor, errand):
    """Every placement that the generator can draw: middle cells by person, with probability, and the letters."""
    people = list(errand.rooms)

    def place(chosen, rest, probability):
        if not rest:
            yield chosen, probability
            return
        name, *others = rest
        taken = {floor.rooms[cell] for cell in chosen.values()}
        vacant = [room for kind in errand.rooms[name] for room in floor.rooms_of(kind) if room not in taken]
        for room in vacant:
            cells = [tuple(cell) for cell in np.argwhere((floor.rooms == room) & ~floor.doors).tolist()]
            for cell in cells:
                yield from place({**chosen, name: cell}, others, probability / len(vacant) / len(cells))

    for chosen, probability in place({}, people, 1.0):
        letters = np.zeros(floor.rooms.shape, np.int32)
        for bit, name in enumerate(people):
            row, column = chosen[name]
            patch = (slice(row - 1, row + 2), slice(column - 1, column + 2))
            letters[patch] |= np.where(floor.rooms[patch] == floor.rooms[row, column], 1 << bit, 0)
        yield chosen, probability, letters


def expected(floor, errand, world, belief, in_sight):
    """Probability of each letter in each cell, by the placements that contradict nothing that was seen."""
    known, total = ~np.asarray(belief.unknown), 0.0
    chances = np.zeros((len(errand.rooms), *floor.rooms.shape))
    lit = np.asarray(world.appearance.light) > 0
    rooms = {room for room in np.unique(floor.rooms[in_sight]) if room > 0}
    for chosen, probability, letters in placements(floor, errand):
        occupied = {floor.rooms[cell] for cell in chosen.values()}
        agrees = all((room in occupied) == lit[floor.rooms == room].any() for room in rooms)
        if agrees and np.array_equal(letters[known], np.asarray(belief.letters)[known]):
            total += probability
            for bit in range(len(errand.rooms)):
                chances[bit] += probability * ((letters >> bit) & 1)
    return chances / total


@pytest.mark.long
@pytest.mark.parametrize(("floor", "errand"), [(OFFICES, PEOPLE), (ANY, PARCELS)], ids=["people", "parcels"])
@pytest.mark.parametrize(
    ("cells", "reach"),
    [([(1, 2)], 3.0), ([(2, 6), (2, 10)], 3.0), ([(3, 2), (4, 2), (2, 14)], 3.0), ([(2, 2)], 1.0)],
    ids=["one", "two", "inside", "lights alone"],
)
def test_people_are_drawn_as_often_as_all_placements_say(floor, errand, cells, reach):
    for seed in range(6):
        world, posterior, belief = seen_from(floor, errand, seed, cells, reach)
        drawn = jax.jit(lambda posterior, belief: posterior.draw(belief))(posterior, belief)
        assert drawn.agrees
        wanted = expected(floor, errand, world, belief, np.asarray(posterior.evidence))
        found = np.stack([((np.asarray(drawn.letters) >> bit) & 1).mean(axis=0) for bit in range(len(errand.rooms))])
        # Each person's cells to within a few buildings; the second of two is drawn given the first.
        np.testing.assert_allclose(found, wanted, atol=0.06 if errand is PARCELS else 4 / COUNT)
        known = ~np.asarray(belief.unknown)
        np.testing.assert_array_equal(
            np.asarray(drawn.letters)[:, known], np.tile(np.asarray(world.letters)[known], (COUNT, 1))
        )


def test_two_who_share_their_rooms_share_none():
    _, posterior, belief = seen_from(ANY, PARCELS, 0, [(1, 2)], range_cells=1.0)
    # Nothing is known of the lights, which alone might keep them apart.
    blind = dataclasses.replace(posterior, evidence=jnp.zeros_like(posterior.evidence))
    letters = np.asarray(blind.draw(belief).letters)
    for one in letters:
        rooms = [set(ANY.rooms[(one >> bit) & 1 > 0].tolist()) for bit in range(2)]
        assert len(rooms[0]) == len(rooms[1]) == 1
        assert rooms[0] != rooms[1]


def test_people_are_drawn_apart_from_each_other():
    """Where the professor is says nothing of the others: strata are matched at random."""
    _, posterior, belief = seen_from(OFFICES, PEOPLE, 1, [(1, 2)], range_cells=1.0)
    letters = np.asarray(
        dataclasses.replace(posterior, evidence=jnp.zeros_like(posterior.evidence)).draw(belief).letters
    )
    rooms = np.array([[OFFICES.rooms[(one >> bit) & 1 > 0].max() for bit in range(2)] for one in letters])
    for office, lab in itertools.product((1, 2, 5), (3, 4)):
        together = np.mean((rooms[:, 0] == office) & (rooms[:, 1] == lab))
        assert together == pytest.approx(1 / 6, abs=0.06)


def test_what_nobody_built_agrees_with_nothing():
    _, posterior, belief = seen_from(OFFICES, PEOPLE, 2, [(1, 2)])
    assert posterior.draw(belief).agrees
    # A professor in the hallway.
    letters = jnp.where(belief.free, 1, 0).astype(jnp.int32)
    assert not posterior.draw(dataclasses.replace(belief, letters=letters)).agrees


def test_rooms_that_only_some_of_two_share_are_refused():
    errand = Errand({"a": (Kind.OFFICE, Kind.LAB), "b": (Kind.LAB,)}, {})
    with pytest.raises(WorldError, match="kinds of rooms"):
        people_posterior(OFFICES, errand, 1, {"a": 1, "b": 3}, OFFICES.rooms.shape, jax.random.key(0), 4)


def test_the_observer_of_a_generated_floor_answers_between_never_and_always():
    family = Delivery()
    key = world_key("training", 0, family.name)
    world = family.generate(key)
    observer = ideal_observer(family.posterior(key, jax.random.key(0), 8), world)
    at = world.start
    belief = look(BeliefMap.unobserved(world), world, at, SensorConfig(range_cells=40.0))
    observer = observe_panorama(observer, NO_PANORAMA, belief, at)
    everywhere = SensorConfig(range_cells=float(sum(world.shape)))
    np.testing.assert_array_equal(observer.memory, visible(world.occupied, at, everywhere) & ~world.occupied)
    task = world.task("F professor")
    situation = jax.jit(assess, static_argnames="config")(
        belief, at, jnp.int32(task.dfa.initial), task.arrays, FrontierConfig(max_subgoals=8)
    )
    answers = jax.jit(lambda observer, belief, subgoals: observer(belief, subgoals, task.arrays))(
        observer, belief, situation.subgoals
    )
    chances = np.asarray(answers.success_probability)[np.asarray(situation.subgoals.mask)]
    assert answers.status == 0
    assert ((chances >= 0) & (chances <= 1)).all()
    assert ((chances > 0) & (chances < 1)).any()
