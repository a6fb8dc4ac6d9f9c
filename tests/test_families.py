"""Benchmark problems: reproducible, of one shape a family, on maps where distances are distances."""

from functools import cache

import jax
import numpy as np
import pytest

from potlp_jax.bench.problems import FAMILIES, SUBGOAL_COUNTS, family_problem, random_metric
from potlp_jax.planning.problem import enumerate_actions
from potlp_jax.task.task import Task


def leaves(problem):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(problem)]


@cache
def task_of(family, split="test", index=0):
    spec = FAMILIES[family]
    return Task.from_formula(spec.formula(split, index), spec.propositions, spec.max_positive_literals)


@pytest.mark.parametrize("family", FAMILIES)
def test_equal_arguments_give_equal_problems(family):
    for ours, again in zip(*(leaves(family_problem(family, 4, "test", 2)) for _ in range(2)), strict=True):
        np.testing.assert_array_equal(ours, again)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_argument_matters(family):
    """No two instances share their geometry, whatever split, index or S (here compared over the smaller S)."""
    arguments = [(s, split, i) for s in (2, 4) for split in ("tuning", "test") for i in range(4)]
    first_ways = {np.asarray(family_problem(family, *a).success_cost)[0].tobytes() for a in arguments}
    assert len(first_ways) == len(arguments)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("subgoals", SUBGOAL_COUNTS)
def test_equal_shapes(family, subgoals):
    shapes = {tuple(leaf.shape for leaf in leaves(family_problem(family, subgoals, "tuning", i))) for i in range(3)}
    assert len(shapes) == 1


@pytest.mark.parametrize("family", FAMILIES)
def test_sizes_are_no_larger_than_needed(family):
    spec, needed = FAMILIES[family], None
    for split in ("tuning", "test"):
        for index in range(len(spec.formulas)):
            sizes = task_of(family, split, index).sizes
            needed = sizes if needed is None else needed.union(sizes)
    assert spec.sizes == needed


def test_random_tasks_differ_between_splits_and_have_2_to_8_states():
    splits = [{FAMILIES["random"].formula(split, i) for i in range(21)} for split in ("tuning", "test")]
    assert not splits[0] & splits[1]
    assert all(len(own) == 21 for own in splits)
    for split in ("tuning", "test"):
        tasks = [task_of("random", split, i) for i in range(21)]
        assert {task.dfa.num_states for task in tasks} == set(range(2, 9))
        assert len({task.dfa.transitions.tobytes() for task in tasks}) == 21


def test_tasks_of_several_cubes():
    assert all(task_of("cubes", index=i).sizes.compound for i in range(len(FAMILIES["cubes"].formulas)))


@pytest.mark.parametrize("seed", range(5))
def test_ways_are_a_metric(seed):
    way = random_metric(9, np.random.default_rng(seed))
    np.testing.assert_array_equal(way, way.T)
    assert ((way == 0) == np.eye(9, dtype=bool)).all()
    assert (way[:, None, :] <= way[:, :, None] + way[None, :, :] + 1e-9).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_travel_obeys_the_triangle_inequality_in_the_product(family):
    """Going on from subgoal s in state z' is leaving s from there: never cheaper than going straight.

    Entering s again reads its letter once more, so this holds where the letter keeps z'.
    """
    for index in range(6):
        problem = family_problem(family, 4, "test", index)
        travel, finish = np.asarray(problem.travel, float), np.asarray(problem.finish, float)
        own = np.arange(4)
        stays = travel[own, :, own, :][:, np.arange(travel.shape[1]), np.arange(travel.shape[1])] == 0
        first = np.where(stays[None, None], travel, np.inf)
        onward = (first[..., None, None] + travel[:4][None, None]).min(axis=(2, 3))
        assert (travel <= onward + 1e-3).all()
        assert (finish <= (first + finish[:4][None, None]).min(axis=(2, 3)) + 1e-3).all()


def test_travel_mostly_keeps_the_state():
    keeps = []
    for index in range(30):
        problem = family_problem("three-single", 4, "tuning", index)
        finite = np.isfinite(np.asarray(problem.travel))
        keeps.append(not (finite & ~np.eye(8, dtype=bool)[None, :, None, :]).any())
    assert 0.4 < np.mean(keeps) < 0.95


@pytest.mark.long
@pytest.mark.parametrize("family", FAMILIES)
def test_there_is_mostly_a_choice(family):
    counts, finishes = [], []
    for index in range(12):
        problem = family_problem(family, 4, "tuning", index)
        finish = bool(np.isfinite(np.asarray(problem.finish)[4, int(problem.dfa_state)]))
        counts.append(int(np.asarray(enumerate_actions(problem)).sum()) + finish)
        finishes.append(finish)
    assert np.mean(np.array(counts) >= 2) >= 0.9
    assert np.mean(finishes) <= 0.6


def test_estimates_are_uncertain_and_consistent():
    chances = []
    for index in range(30):
        problem = family_problem("three-joint", 4, "tuning", index)
        chance, task = np.asarray(problem.success_probability), problem.task
        implies = np.asarray(task.implies)
        assert (chance[:, :, None] <= np.where(implies, chance[:, None, :], 1.0)).all()
        chances.append(chance)
    spread = np.concatenate(chances)
    assert (spread < 1.0).all()
    assert 0.0 < (spread == 0.0).mean() < 0.3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nothing", 2, "test", 0), "no family 'nothing'; there are: find, "),
        (("find", 0, "test", 0), "subgoals is 0"),
        (("find", 2, "test", -1), "index -1"),
    ],
)
def test_unknown_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        family_problem(*arguments)
