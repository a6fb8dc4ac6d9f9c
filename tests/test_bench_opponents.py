"""The opponents of the benchmarks plan on the same problems, by the same rules, as the library does."""

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.errors import ProblemTooLargeError
from potlp_jax.planning.exact.api import solve_exact
from potlp_jax.planning.history import action_terms, initial_history, step, unpack_bits
from potlp_jax.types import NO_ACTION
from tests.reference.problems import FORMULAS, SIZES, padded_problem, random_fields, random_problem, task_of

MISSING = "the optional extra 'bench' is not installed (pip install -e '.[bench]')"
pytest.importorskip("numba", reason=MISSING)
numba_search = pytest.importorskip("eval.bench.opponents.pouct_numba")

SUBGOALS = 3
TERMS, STEP = jax.jit(action_terms), jax.jit(step)


def searched(problem, simulations, seed=0, **options):
    search = numba_search.NumbaSearch(problem, seed=seed, **options)
    search.run(simulations)
    return search


def bits(words, count):
    return [bool(int(words) >> i & 1) for i in range(count)]


def compare(histories, node, problem, history):
    """Whether node and history know, offer and charge the same; returns the node's actions by the library's index."""
    tree, subgoals = histories.tree, problem.subgoal_count
    conditions, states = problem.task.condition_mask.shape[0], problem.task.state_mask.shape[0]
    masks = tree.masks[node]
    known = [
        [bits(word, conditions) for word in masks[:subgoals]],
        [bits(word, conditions) for word in masks[subgoals : 2 * subgoals]],
        [bits(word, states) for word in masks[2 * subgoals :]],
    ]
    sizes = (conditions, conditions, states)
    for ours, words, size in zip(known, (history.holds, history.fails, history.visited), sizes, strict=True):
        np.testing.assert_array_equal(ours, unpack_bits(words, size))
    rows = list(histories.listed(node))
    index = histories.model.options[histories.tree.links[rows, numba_search.OPTION], numba_search.INDEX]
    theirs = TERMS(problem, history)
    np.testing.assert_array_equal(index, np.flatnonzero(theirs.available))
    for column, values in (
        (numba_search.DISTANCE, theirs.distance),
        (numba_search.PROBABILITY, theirs.success_probability),
        (numba_search.SUCCESS_COST, theirs.success_cost),
        (numba_search.FAILURE_COST, theirs.failure_cost),
    ):
        np.testing.assert_allclose(histories.tree.terms[rows, column], np.asarray(values)[index], rtol=1e-5, atol=1e-5)
    return dict(zip(index.tolist(), rows, strict=True))


@pytest.mark.parametrize("formula", FORMULAS)
def test_rollouts_are_those_of_the_library(formula):
    rng = np.random.default_rng(0)
    seen = 0
    for seed in range(12):
        task = task_of(formula)
        fields = random_fields(task, SUBGOALS, seed, finish_chance=0.1, unreachable=0.2)
        problem = padded_problem(task, fields, SIZES, SUBGOALS + 1)
        histories, history, node = numba_search.Histories(problem), initial_history(problem), 0
        while offered := compare(histories, node, problem, history):
            action = int(rng.choice(list(offered)))
            probability = float(histories.tree.terms[offered[action], numba_search.PROBABILITY])
            success = bool(rng.random() < probability)
            node = histories.follow(node, offered[action], success)
            seen += 1
            if node == numba_search.ACCEPTED:
                break
            history = STEP(problem, history, jnp.int32(action), jnp.asarray(success))
    assert seen > 12


@pytest.mark.parametrize("formula", FORMULAS)
def test_the_search_finds_the_best_action_where_it_looks_long_enough(formula):
    """Mean costs approach the exact ones from above: the search goes on trying what is not best."""
    for seed in range(4):
        problem = random_problem(formula, 2, seed)
        exact, result = solve_exact(problem), searched(problem, 50_000).statistics()
        if exact.action == NO_ACTION:
            assert result.most_visited == NO_ACTION
            continue
        assert exact.q_values[result.most_visited] <= exact.value * 1.03
        assert result.means[result.most_visited] == pytest.approx(exact.q_values[result.most_visited], rel=0.1)


def test_a_search_can_be_continued_and_repeats_with_its_seed():
    problem = random_problem("F a & F b", 3, 0)
    whole, parts, other = searched(problem, 3000), searched(problem, 1000), searched(problem, 3000, seed=1)
    parts.run(2000)
    np.testing.assert_array_equal(whole.statistics().visits, parts.statistics().visits)
    np.testing.assert_array_equal(whole.statistics().means, parts.statistics().means)
    assert np.any(whole.statistics().visits != other.statistics().visits)
    assert whole.statistics().visits.sum() == 3000


def test_untried_actions_come_first():
    problem = random_problem("F a & F b", 3, 0)
    available = np.flatnonzero(TERMS(problem, initial_history(problem)).available)
    visits = searched(problem, len(available)).statistics().visits
    np.testing.assert_array_equal(visits[available], np.ones(len(available)))


def test_too_large_a_task_is_refused():
    task = SimpleNamespace(condition_classes=np.zeros((65, 1), int), state_mask=np.ones(2, bool))
    with pytest.raises(ValueError, match="65 conditions"):
        numba_search.model_of(cast(Any, SimpleNamespace(task=task)))


def test_pomdp_py_agrees_with_numba():
    """The same algorithm on the same histories, other random numbers: means agree as far as sampling goes."""
    pytest.importorskip("pomdp_py", reason=MISSING)
    from eval.bench.opponents.pomdp_py_search import PomdpPySearch

    for formula in ("F a & F b", "F(a & (b | c))"):
        problem = random_problem(formula, 2, 1)
        exact = solve_exact(problem)
        search = PomdpPySearch(problem, seed=0)
        search.run(10)
        search.run(9_990)
        theirs, ours = search.statistics(), searched(problem, 10_000).statistics()
        # pomdp-py's first simulation makes the root and tries nothing.
        assert theirs.visits.sum() == 9_999
        np.testing.assert_array_equal(np.isfinite(theirs.means), np.isfinite(ours.means))
        assert theirs.means[theirs.most_visited] == pytest.approx(ours.means[ours.most_visited], rel=0.05)
        assert exact.q_values[theirs.most_visited] <= exact.value * 1.05
        assert theirs.nodes == pytest.approx(ours.nodes, rel=0.2)


def test_mctx_finds_the_best_action():
    pytest.importorskip("mctx", reason=MISSING)
    from eval.bench.opponents.mctx_search import mctx_plan

    problems = [random_problem("F a & F b", 2, seed) for seed in range(4)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        plan = mctx_plan(batch, jax.random.key(0), simulations=400)
    regrets = []
    for row, problem in enumerate(problems):
        exact = solve_exact(problem)
        np.testing.assert_array_equal(np.asarray(plan.visits[row]) > 0, np.isfinite(exact.q_values))
        assert int(plan.visits[row].sum()) == 400
        regrets.append(exact.q_values[int(plan.action[row])] / exact.value - 1.0)
    assert np.mean(regrets) < 0.05


def test_regret_is_the_excess_over_the_least_q():
    from eval.bench.regret import Truth

    truth = Truth(np.array([3.0, 5.0, np.inf]), 3.0, 3.0, 1.0, True)
    assert (truth.regret(0), truth.regret(1), truth.regret(NO_ACTION)) == (0.0, 2.0, np.inf)
    assert truth.scale == 2.0


def test_truth_out_of_reach_is_an_interval_around_the_best_known(tmp_path, monkeypatch):
    from eval.bench import regret

    def too_large(problem, seconds):
        raise ProblemTooLargeError("too large")

    problem = random_problem("F a & F b", 2, 1)
    monkeypatch.setattr(regret, "solve_exact", too_large)
    truth, exact = regret.truth_of(problem, tmp_path / "truth.npz", 10.0), solve_exact(problem)
    assert not truth.exact
    assert truth.lower <= exact.value * (1 + 1e-9)
    assert exact.value <= truth.upper * (1 + 1e-9)
    np.testing.assert_allclose(truth.q_values.min(), exact.value, rtol=1e-5)


def test_the_truth_is_kept_for_the_same_problem_only(tmp_path):
    from eval.bench.regret import truth_of

    first, second = random_problem("F a & F b", 2, 1), random_problem("F a & F b", 2, 2)
    path = tmp_path / "truth.npz"
    for problem in (first, first, second):
        truth = truth_of(problem, path, 10.0)
        np.testing.assert_allclose(truth.q_values, solve_exact(problem).q_values)


def test_every_instance_is_answered_by_its_own_row():
    """More instances than fit at once, and a last group that is not full."""
    from eval.bench import regret

    problems = [random_problem("F a & F b", 2, seed) for seed in range(5)]
    costs = [10 + index for index in range(5)]
    numbered = [
        dataclasses.replace(problem, dead_end_cost=jnp.float32(cost))
        for problem, cost in zip(problems, costs, strict=True)
    ]
    for rows in (1, 2, 3, 5):
        _, actions = regret._in_batches(
            lambda batch, keys: np.asarray(batch.dead_end_cost) + keys, numbered, np.arange(5), rows
        )
        assert actions.tolist() == [cost + index for index, cost in enumerate(costs)]
    answers = list(regret.numba_pouct(problems, [10, 3000]))
    assert [(name, budget) for name, budget, *_ in answers][:2] == [("po-uct-numba", 10), ("po-uct-numba", 3000)]
    assert answers[1][3] == [
        searched(problem, 3000, seed).statistics().most_visited for seed, problem in enumerate(problems)
    ]
