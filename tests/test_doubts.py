"""What was probably not meant: each kind of doubt where it is due, and none where the task makes sense."""

import jax
import numpy as np
import pytest

from potlp_jax.cli.doubts import of_worlds, surroundings_of, warn_of_sweep
from potlp_jax.environments.registry import make
from potlp_jax.errors import TaskWarning
from potlp_jax.sweep.specification import specification_from_dict
from potlp_jax.task.doubts import Surroundings, find_doubts, structure_of
from potlp_jax.task.shipped import shipped_tasks
from potlp_jax.task.task import Task

NAMES = ("goal", "hazard", "key")
ROOM = Surroundings("the room", (0, 1, 2), (0,))
"""A goal and a hazard, apart, and no key."""


def doubts(text, surroundings=ROOM):
    task = Task.from_formula(text, NAMES)
    return [(doubt.kind, doubt.message) for doubt in find_doubts(task, surroundings, propositions_given=True)]


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("F (goal & hazard)", "together", "no place in the room has goal and hazard together"),
        ("F goal & F key", "nowhere", "key is nowhere in the room"),
        ("!hazard U (goal & key)", "nowhere", "key is nowhere in the room"),
        (
            "goal U hazard",
            "start",
            "'stay in goal until hazard is found' fails at once: in the room the robot starts at",
        ),
        ("F goal | (goal U hazard)", "start", "'stay in goal until hazard is found' fails at once"),
        ("F !goal", "start", "it is satisfied where the robot starts in the room"),
        ("X goal & X hazard", "impossible", "no path satisfies it among what the places of the room hold"),
        ("F (goal & !goal) | F hazard", "constant", "'goal without goal' never holds"),
    ],
)
def test_each_kind(text, kind, message):
    found = doubts(text)
    assert any(kind == one and message in told for one, told in found), found


@pytest.mark.parametrize(
    "text", ["F goal", "!hazard U goal", "F (goal | key)", "F (hazard & !key) & F goal", "!key U goal"]
)
def test_what_makes_sense_gives_no_doubt(text):
    assert doubts(text) == []


def test_a_start_is_doubtful_only_where_every_world_has_it():
    violated = Surroundings("two worlds", (0, 1, 2), (2, 2))
    assert [kind for kind, _ in doubts("!hazard U goal", violated)] == ["start"]
    assert doubts("!hazard U goal", Surroundings("two worlds", (0, 1, 2), (2, 0))) == []


def test_a_word_taken_apart_is_doubtful_where_no_names_were_given():
    task = Task.from_formula("Fire")
    assert [doubt.kind for doubt in find_doubts(task)] == ["operator"]
    assert find_doubts(task, propositions_given=True) == ()


def test_nothing_to_do():
    with pytest.warns(TaskWarning):
        task = Task.from_formula("X goal | X !goal")
    assert [doubt.kind for doubt in find_doubts(task)] == ["nothing to do"]


@pytest.mark.parametrize("name", shipped_tasks())
def test_shipped_tasks_have_a_structure_and_no_doubt(name):
    task = Task.shipped(name)
    assert structure_of(task) is not None
    assert find_doubts(task, propositions_given=True) == ()


def test_a_name_that_is_not_the_automatons_formula_is_not_explained():
    lied = Task.shipped("toy-2").to_hoa().replace("!hazard U goal", "F goal")
    assert Task.from_hoa(lied).text == "F goal"
    assert structure_of(Task.from_hoa(lied)) is None


def test_a_name_about_other_places_is_not_explained():
    """Spot drops a proposition that the language does not depend on, and keeps the formula as the name."""
    text = Task.from_formula("F goal").to_hoa().replace('name: "F goal"', 'name: "F goal | F (goal & cellar)"')
    task = Task.from_hoa(text)
    assert task.text == "F goal | F (goal & cellar)"
    assert structure_of(task) is None
    assert not find_doubts(task, propositions_given=True)


def test_surroundings_are_what_free_cells_of_the_worlds_hold():
    toy = make("toy")
    worlds = [toy.world(number) for number in range(3)]
    found = surroundings_of(toy)
    expected = {int(letter) for world in worlds for letter in np.asarray(world.letters)[~np.asarray(world.occupied)]}
    assert set(found.letters) == expected
    assert found.starts == tuple(int(jax.numpy.asarray(world.letters)[tuple(world.start.tolist())]) for world in worlds)
    assert of_worlds("one", worlds[:1]).starts == found.starts[:1]


def test_a_sweep_says_the_doubts_of_each_task_and_environment(caplog):
    entries = {"environments": ["toy"], "tasks": ["F (goal & hazard)", 1], "policies": ["baseline"], "worlds": 1}
    warn_of_sweep(specification_from_dict(entries, "test"))
    (said,) = caplog.messages
    assert said.startswith("task 'F (goal & hazard)':")
