"""The distribution of tasks: what is drawn is a task that asks for something, never a held-out one, and diverse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import world_key
from potlp_jax.learning.labels import true_labels
from potlp_jax.learning.questions import (
    HELD_OUT,
    LARGEST,
    TaskDistribution,
    draw_questions,
    language,
    question_sheet,
    questions_of,
    random_formula,
)
from potlp_jax.planning.distances.product import grid_distances
from potlp_jax.task.formula import parse_formula
from potlp_jax.task.task import Task
from potlp_jax.world.frontiers import FrontierConfig, find_subgoals
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig, observe
from tests.reference.labels import true_label

SIGMA = Firefighting.propositions


def _draw(count, distribution=None, seed=0):
    distribution = TaskDistribution(SIGMA) if distribution is None else distribution
    rng = np.random.default_rng(seed)
    return [distribution.draw(rng) for _ in range(count)]


def test_every_task_asks_for_something_and_fits():
    for task in _draw(80):
        first = task.dfa.transitions[task.dfa.initial, 0]
        assert not task.dfa.accepting[first]
        assert not task.dfa.trap[first]
        assert len(task.classes) > 0
        assert LARGEST.covers(task.sizes)


def test_the_same_seed_draws_the_same_tasks():
    assert [task.text for task in _draw(20)] == [task.text for task in _draw(20)]
    assert [task.text for task in _draw(20)] != [task.text for task in _draw(20, seed=1)]


def test_a_held_out_language_is_never_drawn_however_it_is_written():
    frequent = ("F exit", "F alarm", "F fire", "F extinguisher")
    drawn = {language(task) for task in _draw(100)}
    # Written otherwise than the templates do.
    rewritten = [f"true U {text[2:]}" for text in frequent]
    assert drawn & {language(Task.from_formula(text, SIGMA)) for text in rewritten}
    kept = _draw(100, TaskDistribution(SIGMA, rewritten))
    assert not {language(task) for task in kept} & {language(Task.from_formula(text, SIGMA)) for text in frequent}


@pytest.mark.parametrize("family", HELD_OUT)
def test_held_out_formulas_are_tasks_of_the_family_and_none_of_its_own(family):
    generator = make(family)
    held_out = {language(Task.from_formula(text, generator.propositions)) for text in HELD_OUT[family]}
    own = {language(Task.from_formula(text, generator.propositions)) for text in generator.tasks.values()}
    assert len(held_out) == len(HELD_OUT[family])
    assert not held_out & own


def test_where_everything_is_held_out_nothing_can_be_drawn():
    with pytest.raises(ValueError, match="leave none"):
        TaskDistribution(("a",), ["F a"]).draw(np.random.default_rng(0))


@pytest.mark.parametrize(
    "sigma",
    [
        ("Goal",),
        ("a", "b"),
        ("U", "big room", "x"),
        ("küche", "Fußweg", "出口"),
        ("true", "False", "xor", "first_match"),
        ('5" pipe', "a\\b", "it's", "R2.D2"),
    ],
)
def test_names_of_any_kind_can_be_drawn(sigma):
    rng = np.random.default_rng(0)
    for _ in range(30):
        assert parse_formula(random_formula(rng, sigma), sigma).propositions == sigma


def test_classes_are_diverse():
    rng = np.random.default_rng(0)
    tasks = _draw(60)
    questions = [question for _ in range(60) for question in draw_questions(rng, tasks, 8, 4)]
    assert {question.phi_stay.count(-1) for question in questions} >= {0, 1, 2, 3}
    assert {question.phi_go.count(1) for question in questions} >= {1, 2}
    assert {question.phi_go.count(-1) for question in questions} >= {0, 1, 2}
    for index in range(len(SIGMA)):
        assert any(question.phi_go[index] == 1 for question in questions)
        assert any(question.phi_stay[index] == -1 for question in questions)
    single = [question.phi_go.count(1) == 1 for question in questions]
    assert np.mean(single) > 0.5


def test_questions_of_a_view_are_distinct_and_share_staying_sets():
    rng = np.random.default_rng(1)
    tasks = _draw(12)
    for _ in range(30):
        questions = draw_questions(rng, tasks, 6, 3)
        assert 0 < len(questions) <= 6
        assert len({(question.phi_stay, question.phi_go) for question in questions}) == len(questions)
        assert len({question.stay for question in questions}) <= 3
        for question in questions:
            task = next(task for task in tasks if task.text == question.task)
            assert tuple(task.classes[question.outcome_class]) == (question.phi_stay, question.phi_go)


@jax.jit
def _first_look(world):
    belief = observe(BeliefMap.unobserved(world), world, world.start, SensorConfig(range_cells=14.0))
    distance = grid_distances(belief.free, world.start, belief.resolution)
    return belief, find_subgoals(belief, jnp.isfinite(distance), distance, FrontierConfig(max_subgoals=4))


def test_labels_of_a_sheet_equal_the_reference():
    world = Firefighting.toy().generate(world_key("validation", 3, "firefighting"))
    belief, subgoals = _first_look(world)
    tasks = [Task.from_formula(text, SIGMA) for text in Firefighting.tasks.values()]
    questions = list({(q.phi_stay, q.phi_go): q for task in tasks for q in questions_of(task)}.values())
    stays = len({question.stay for question in questions})
    found = jax.jit(true_labels)(world, belief, subgoals, question_sheet(questions, len(questions) + 2, stays + 1))
    free, letters, observed = ~np.asarray(world.occupied), np.asarray(world.letters), ~np.asarray(belief.unknown)
    probability, real = np.asarray(found.success_probability), int(subgoals.mask.sum())
    assert real >= 2
    for s in range(real):
        own, cell = np.asarray(subgoals.component) == s, np.asarray(subgoals.cells[s])
        for c, question in enumerate(questions):
            stay, go = set(np.flatnonzero(question.stay).tolist()), set(np.flatnonzero(question.go).tolist())
            frontier = np.asarray(subgoals.frontier)
            expected = true_label(free, letters, observed, frontier, own, cell, stay, go)
            assert probability[s, c] == expected[0]
            if expected[0]:
                assert float(found.success_cost[s, c]) == pytest.approx(expected[1], rel=1e-5)
            assert float(found.failure_cost[s, c]) == pytest.approx(expected[2], rel=1e-5)
    assert 0 < probability.sum() < len(questions) * real
    assert not probability[:, len(questions) :].any()


def test_a_sheet_that_is_too_small():
    questions = questions_of(Task.from_formula("F alarm & F exit", SIGMA))
    with pytest.raises(ValueError, match="do not fit"):
        question_sheet(questions, len(questions) - 1, 4)
    with pytest.raises(ValueError, match="do not fit"):
        question_sheet(questions, 8, 2)
    with pytest.raises(ValueError, match="do not fit"):
        question_sheet((), 8, 2)
