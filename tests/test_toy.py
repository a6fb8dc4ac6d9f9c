"""The two-room world, with distances worked out by hand.

With door, start, goal and hazard as in ``BY_HAND`` (9 rows, 15 columns, wall in column 7, door in row 4)::

    ###############
    #......#......#
    #......#......#
    #......#......#
    #.S.......H.G.#     start (4, 2), hazard (4, 10), goal (4, 12)
    #......#......#
    #......#......#
    #......#......#
    ###############

- ``F goal``: straight along row 4, ten steps: 10.
- ``!hazard U goal``: ten columns to the right, out of row 4 and back in, diagonally, to pass (4, 10): 8 + 2√2. The door
  itself is passed straight: corners are not cut.
- From (1, 1) to the goal: (4, 6) to (4, 8) is forced. From (1, 1) to (4, 6): three diagonal and two straight steps;
  from there six steps: 8 + 3√2.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.environments.splits import world_key
from potlp_jax.environments.toy import Toy, ToyConfig
from potlp_jax.errors import WorldError
from potlp_jax.planning.distances.product import product_distances, product_transitions
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.world.grid import World

pytestmark = pytest.mark.optimised

BY_HAND = ToyConfig(door_row=4, start=(4, 2), goal=(4, 12), hazard=(4, 10))
GOAL, HAZARD = 1, 2
STRAIGHT = 10.0
AROUND_THE_HAZARD = 8 + 2 * math.sqrt(2)
FROM_THE_CORNER = 8 + 3 * math.sqrt(2)

DRAWING = """
    ###############
    #......#......#
    #......#......#
    #......#......#
    #.S.......H.G.#
    #......#......#
    #......#......#
    #......#......#
    ###############"""


def drawing_of(world: World) -> str:
    letters = np.asarray(world.letters)
    cells = np.where(np.asarray(world.occupied), "#", ".")
    cells[letters == GOAL] = "G"
    cells[letters == HAZARD] = "H"
    cells[tuple(np.asarray(world.start))] = "S"
    return "\n".join("".join(row) for row in cells)


def cost_of(world: World, formula: str) -> float:
    """Cheapest accepting path from the start, by the planner's distances on the true map."""
    return float(known_map_cost(Task.from_formula(formula, Toy.propositions).arrays, world))


@jax.jit
def known_map_cost(task: TaskArrays, world: World) -> jax.Array:
    free = ~world.occupied
    transitions = product_transitions(task, world.letters, free)
    row, column = world.start
    state = task.transitions[task.initial, world.letters[row, column]]
    costs = product_distances(transitions, free, world.start[None], state[None], world.resolution)[0]
    return jnp.min(jnp.where(task.accepting, costs, jnp.inf))


def test_the_world_worked_by_hand_is_drawn_above():
    world = Toy(BY_HAND).generate(jax.random.key(0))
    assert drawing_of(world) == "\n".join(DRAWING.split())
    assert float(world.resolution) == 1.0


def test_distances_by_hand():
    world = Toy(BY_HAND).generate(jax.random.key(0))
    assert cost_of(world, Toy.tasks["1"]) == pytest.approx(STRAIGHT)
    assert cost_of(world, Toy.tasks["2"]) == pytest.approx(AROUND_THE_HAZARD)
    assert cost_of(world, "F hazard") == pytest.approx(8)
    corner = world.replace(start=jnp.asarray(np.array([1, 1], np.int32)))
    assert cost_of(corner, Toy.tasks["1"]) == pytest.approx(FROM_THE_CORNER)
    on_goal = world.replace(start=jnp.asarray(np.array([4, 12], np.int32)))
    assert cost_of(on_goal, Toy.tasks["1"]) == 0


def test_drawn_worlds_have_the_plan_and_differ():
    worlds = [Toy().generate(world_key("training", index, Toy.name)) for index in range(40)]
    assert len({drawing_of(world) for world in worlds}) == 40
    for world in worlds:
        assert world.shape == (9, 15)
        occupied, letters = np.asarray(world.occupied), np.asarray(world.letters)
        assert (~occupied[:, 7]).sum() == 1
        assert not occupied[1:-1, 1:7].any()
        assert not occupied[1:-1, 8:-1].any()
        assert sorted(letters[letters > 0].tolist()) == [GOAL, HAZARD]
        assert (np.argwhere(letters > 0)[:, 1] > 7).all()
        assert int(world.start[1]) < 7
        door = int(np.argmin(occupied[:, 7]))
        assert letters[door, 8] != HAZARD


def test_both_tasks_can_be_satisfied_in_every_world():
    smallest = Toy(ToyConfig(height=5, width=9))
    costs = []
    for index in range(30):
        world = smallest.generate(world_key("training", index, Toy.name))
        costs.append([cost_of(world, formula) for formula in Toy.tasks.values()])
    assert np.isfinite(costs).all()
    assert all(free <= avoiding for free, avoiding in costs)


def test_the_same_key_gives_the_same_world():
    key = world_key("test", 3, Toy.name)
    assert drawing_of(Toy().generate(key)) == drawing_of(Toy().generate(key))


def test_fixing_one_thing_leaves_the_others():
    key = world_key("training", 0, Toy.name)
    free, fixed = Toy().generate(key), Toy(ToyConfig(start=(7, 1))).generate(key)
    assert fixed.start.tolist() == [7, 1]
    np.testing.assert_array_equal(free.letters, fixed.letters)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"start": (4, 9)}, r"the start of the toy world cannot be at \(4, 9\)"),
        ({"goal": (4, 2)}, "the goal"),
        ({"door_row": 0}, "the door"),
        ({"door_row": 4, "hazard": (4, 8)}, "the hazard"),
        ({"goal": (2, 9), "hazard": (2, 9)}, "the hazard"),
        ({"width": 14}, "odd width"),
        ({"height": 4}, "height >= 5"),
    ],
)
def test_bad_configurations_are_refused(config, message):
    with pytest.raises(WorldError, match=message):
        Toy(ToyConfig(**config)).generate(jax.random.key(0))
