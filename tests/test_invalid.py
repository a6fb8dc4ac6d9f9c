"""Inputs that the model does not allow: nothing is planned with them, and no other row of a batch is harmed."""

import contextlib
import copy
import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.registry import make
from potlp_jax.errors import ProblemError
from potlp_jax.native import libraries
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.move import Move, MoveKind
from potlp_jax.planning.policies import decide
from potlp_jax.planning.problem import PlanningProblem, enumerate_actions, screen
from potlp_jax.planning.search.api import plan_actions, search
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.loop import run_trial
from potlp_jax.types import NO_ACTION, NO_STATE, NO_SUBGOAL, Status
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap, belief_from_numpy
from tests.reference.problems import random_problem, task_of

TASK = "F a & F b"
SEARCHES = (BestFirstConfig(simulations=60), UctConfig(simulations=60))
SUBGOALS = 3

# An array, an index of a real entry, and a value that may not be there.
WRONG = [
    ("success_probability", (0, 0), 1.5),
    ("success_probability", (1, 2), -0.1),
    ("success_probability", (0, 1), np.nan),
    ("success_cost", (0, 0), np.nan),
    ("success_cost", (1, 1), np.inf),
    ("success_cost", (1, 1), 3e38),
    ("success_cost", (0, 3), 0.0),
    ("success_cost", (0, 3), -2.0),
    ("failure_cost", (1, 0), np.nan),
    ("failure_cost", (0, 0), np.inf),
    ("failure_cost", (0, 0), -1.0),
    ("travel", (SUBGOALS, 0, 1, 0), np.nan),
    ("travel", (0, 1, 1, 1), -3.0),
    ("travel", (0, 1, 1, 1), -np.inf),
    ("finish", (SUBGOALS, 0), np.nan),
    ("finish", (1, 2), -0.5),
    ("dead_end_cost", (), np.nan),
    ("dead_end_cost", (), 0.0),
    ("dead_end_cost", (), np.inf),
    ("dfa_state", (), 99),
    ("dfa_state", (), -1),
]


@cache
def valid_problem() -> PlanningProblem:
    """Two real subgoals of three."""
    problem = random_problem(TASK, SUBGOALS, seed=0)
    return dataclasses.replace(problem, subgoal_mask=jnp.array([True, True, False]))


def with_arrays(arrays, **wrong):
    """A problem, or a task, with other arrays, past the checks of annotations that run in tests alone."""
    changed = copy.copy(arrays)
    for name, array in wrong.items():
        object.__setattr__(changed, name, array)
    return changed


def of_shape(problem: PlanningProblem, name: str, shape: tuple[int, ...]) -> PlanningProblem:
    """A problem with an array of another shape."""
    return with_arrays(problem, **{name: jnp.ones(shape, getattr(problem, name).dtype)})


def stack(problems: list[PlanningProblem]) -> PlanningProblem:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)


def with_value(problem: PlanningProblem, name: str, index: tuple[int, ...], value: float) -> PlanningProblem:
    return dataclasses.replace(problem, **{name: getattr(problem, name).at[index].set(value)})


@cache
def searches_of_one():
    return {config: jax.jit(plan_actions, static_argnames="config") for config in SEARCHES}


def plan(problem: PlanningProblem, config: BestFirstConfig | UctConfig):
    return searches_of_one()[config](problem, jax.random.key(0), config)


@pytest.mark.parametrize("config", SEARCHES, ids=lambda config: config.kind)
@pytest.mark.parametrize(("name", "index", "value"), WRONG)
def test_an_invalid_problem_has_no_action_in_either_search(name, index, value, config):
    found = plan(with_value(valid_problem(), name, index, value), config)
    assert Status(int(found.status)) == Status.INVALID
    assert (int(found.action), int(found.subgoal)) == (NO_ACTION, NO_SUBGOAL)
    assert (int(found.from_state), int(found.to_state)) == (NO_STATE, NO_STATE)
    assert float(found.value) == np.inf
    assert bool(jnp.all(jnp.isinf(found.q_values)))
    assert not np.any(found.visits)


@pytest.mark.parametrize(("name", "index", "value"), WRONG)
def test_an_invalid_problem_enumerates_no_action(name, index, value):
    assert bool(jnp.any(enumerate_actions(valid_problem())))
    assert not bool(jnp.any(enumerate_actions(with_value(valid_problem(), name, index, value))))


@pytest.mark.parametrize(("name", "index", "value"), WRONG)
def test_the_host_names_the_value_that_the_search_refuses(name, index, value):
    """One set of rules: what one of them lets pass, the other must not refuse."""
    problem = with_value(valid_problem(), name, index, value)
    assert bool(screen(problem)[1])
    with pytest.raises(ProblemError, match=name):
        problem.check()


@pytest.mark.parametrize("config", SEARCHES, ids=lambda config: config.kind)
def test_absent_entries_may_hold_anything(config):
    """``subgoal_mask`` is False for the third subgoal: none of its rows and columns counts."""
    problem = valid_problem()
    absent = SUBGOALS - 1
    filled = dataclasses.replace(
        problem,
        travel=problem.travel.at[absent].set(jnp.nan).at[:, :, absent].set(-1.0),
        finish=problem.finish.at[absent].set(jnp.nan),
        success_probability=problem.success_probability.at[absent].set(jnp.nan),
        success_cost=problem.success_cost.at[absent].set(-jnp.inf),
        failure_cost=problem.failure_cost.at[absent].set(jnp.nan),
    )
    filled.check()
    wanted, found = plan(problem, config), plan(filled, config)
    assert int(wanted.action) != NO_ACTION
    for field in dataclasses.fields(wanted):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(wanted, field.name), field.name)


@pytest.mark.parametrize("config", SEARCHES, ids=lambda config: config.kind)
def test_invalid_rows_of_a_batch_leave_the_others_as_they_are(config):
    good = [
        dataclasses.replace(random_problem(TASK, SUBGOALS, seed), subgoal_mask=jnp.ones(3, bool)) for seed in range(3)
    ]
    bad = [with_value(good[0], name, index, value) for name, index, value in WRONG[:3]]
    keys = jax.vmap(jax.random.key)(jnp.zeros(6, jnp.uint32))
    # Good and bad in turn; and the same batch with good ones in place of the bad.
    mixed = stack([problem for pair in zip(good, bad, strict=True) for problem in pair])
    clean = stack([problem for each in good for problem in (each, each)])
    for run in (
        jax.jit(lambda problems: search(problems, keys, config)[0]),
        jax.jit(jax.vmap(lambda problem: plan_actions(problem, keys[0], config))),
    ):
        found, wanted = run(mixed), run(clean)
        assert [Status(int(status)) for status in found.status[1::2]] == [Status.INVALID] * 3
        assert np.all(found.action[1::2] == NO_ACTION)
        for field in dataclasses.fields(found):
            rows = getattr(found, field.name)[::2], getattr(wanted, field.name)[::2]
            np.testing.assert_array_equal(*rows, field.name)


@pytest.mark.parametrize(
    ("name", "shape", "expected"),
    [
        ("success_probability", (3, 1), r"\(3, 5\)"),
        ("success_cost", (1, 5), r"\(3, 5\)"),
        ("failure_cost", (5,), r"\(3, 5\)"),
        ("travel", (3, 4, 3, 4), r"\(4, 4, 3, 4\)"),
        ("finish", (4, 1), r"\(4, 4\)"),
        ("dfa_state", (1,), r"\(\)"),
        ("dead_end_cost", (3,), r"\(\)"),
        ("subgoal_mask", (), r"\('S',\)"),
    ],
)
def test_shapes_are_checked_when_the_search_is_traced(name, shape, expected):
    """[S, 1] would broadcast to the same answer for every class."""
    wrong = of_shape(valid_problem(), name, shape)
    message = rf"{name} has shape \({', '.join(map(str, shape))},?\), expected {expected}"
    with pytest.raises(ProblemError, match=message):
        jax.eval_shape(lambda key: plan_actions(wrong, key), jax.random.key(0))


def test_shapes_of_a_batch_are_checked_with_its_axis():
    problems = jax.tree.map(lambda leaf: leaf[None].repeat(2, axis=0), valid_problem())
    wrong = of_shape(problems, "success_probability", (2, 3, 1))
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    with pytest.raises(ProblemError, match=r"success_probability has shape \(2, 3, 1\), expected \(2, 3, 5\)"):
        jax.eval_shape(lambda keys: search(wrong, keys), keys)
    with pytest.raises(ProblemError, match=r"subgoal_mask has shape \(2, 3\), expected \(3, 'S'\)"):
        jax.eval_shape(lambda problems: search(problems, jax.vmap(jax.random.key)(jnp.arange(3))), problems)


@pytest.mark.parametrize(
    ("name", "kind", "expected"),
    [
        ("travel", jnp.int32, "float32"),
        ("success_probability", jnp.float16, "float32"),
        ("dead_end_cost", jnp.bfloat16, "float32"),
        ("subgoal_mask", jnp.int32, "bool"),
        ("dfa_state", jnp.uint8, "int32"),
    ],
)
def test_types_are_checked_as_shapes_are(name, kind, expected):
    """The search's kernel reads memory by the type that an array should have."""
    wrong = with_arrays(valid_problem(), **{name: getattr(valid_problem(), name).astype(kind)})
    assert_refused(wrong, f"{name} has the type {jnp.dtype(kind)}, expected {expected}")


def assert_refused(wrong, message):
    """By its own check, and by a search while tracing."""
    with pytest.raises(ProblemError, match=message):
        wrong.check()
    with pytest.raises(ProblemError, match=message):
        jax.eval_shape(lambda key: plan_actions(wrong, key), jax.random.key(0))


def test_what_is_no_array_is_refused():
    with pytest.raises(ProblemError, match="dfa_state is of type int; give an array"):
        with_arrays(valid_problem(), dfa_state=0).check()


@pytest.mark.parametrize(
    ("name", "array", "found", "expected"),
    [
        ("edges", jnp.zeros((4, 2), jnp.int32), r"shape \(4, 2\)", r"\(5, 2\): E = 5"),
        ("accepting", jnp.zeros(3, bool), r"shape \(3,\)", r"\(4,\): Z = 4"),
        ("implies", jnp.zeros((5, 4), bool), r"shape \(5, 4\)", r"\(5, 5\): M = 5, M = 5"),
        ("condition_classes", jnp.zeros(5, jnp.int32), r"shape \(5,\)", r"\('M', 'K'\)"),
        ("edge_condition", jnp.zeros(5, jnp.int8), "the type int8", "int32"),
    ],
)
def test_the_arrays_of_the_task_are_checked(name, array, found, expected):
    wrong = with_arrays(valid_problem(), task=with_arrays(valid_problem().task, **{name: array}))
    assert_refused(wrong, f"task.{name} has {found}, expected {expected}")


def test_a_batch_has_tasks_and_one_problem_has_one():
    problems = jax.tree.map(lambda leaf: leaf[None].repeat(2, axis=0), valid_problem())
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    shared = with_arrays(problems, task=valid_problem().task)
    with pytest.raises(ProblemError, match=r"task.state_mask has shape \(4,\), expected \(2, 'Z'\)"):
        search(shared, keys)
    several = with_arrays(valid_problem(), task=problems.task)
    for refuse in (several.check, lambda: plan_actions(several, keys[0])):
        with pytest.raises(ProblemError, match=r"task.state_mask has shape \(2, 4\), expected \('Z',\)"):
            refuse()


def known_map(rows: list[str], letter: int = 0, resolution: float = 1.0) -> BeliefMap:
    """A belief: ``.`` free, ``#`` occupied, ``?`` unknown, with a letter at (1, 2)."""
    meaning = {".": BeliefMap.FREE, "#": BeliefMap.OCCUPIED, "?": BeliefMap.UNKNOWN}
    cells = np.array([[meaning[mark] for mark in row] for row in rows], np.int8)
    known = belief_from_numpy(cells, np.zeros(cells.shape, np.int32), propositions=("a", "b"))
    # Past the checks of what makes a belief on the host.
    return dataclasses.replace(known, letters=known.letters.at[1, 2].set(letter), resolution=jnp.float32(resolution))


def decided(belief: BeliefMap, cell: tuple[int, int], policy: str, state: int = 0) -> Move:
    estimator = jax.tree_util.Partial(answering_half) if policy == "potlp" else None
    config = DecisionConfig(frontiers=FrontierConfig(max_subgoals=2), search=BestFirstConfig(simulations=20))
    arrays, key = task_of(TASK).arrays, jax.random.key(0)
    compiled = jax.jit(decide, static_argnames=("policy", "config"))
    return compiled(belief, jnp.array(cell), jnp.int32(state), arrays, estimator, key, policy=policy, config=config)


def answering_half(belief, subgoals, task):
    shape = subgoals.mask.shape[0], task.class_mask.shape[0]
    return Estimates(
        success_probability=jnp.full(shape, 0.5), success_cost=jnp.ones(shape), failure_cost=jnp.ones(shape)
    )


@pytest.mark.long
@pytest.mark.parametrize("kernels", ["native", "twins"])
@pytest.mark.parametrize("mark", ["#", "?"])
@pytest.mark.parametrize("policy", ["baseline", "optimistic", "potlp"])
def test_no_move_is_made_from_a_cell_that_is_not_free(policy, mark, kernels):
    """A path back to such a cell is never found: the kernel said so, its twin looked for it without end."""
    belief = known_map(["#######", f"#..{mark}..?", "#######"])
    with libraries.twin_only() if kernels == "twins" else contextlib.nullcontext():
        move = decided(belief, (1, 3), policy)
    assert int(move.status) & int(Status.INVALID)
    assert (int(move.kind), int(move.path.length), float(move.value)) == (MoveKind.NONE, 0, np.inf)
    assert tuple(np.asarray(move.target_cell)) == (1, 3)
    assert not int(decided(known_map(["#######", "#.....?", "#######"]), (1, 3), policy).status) & int(Status.INVALID)


@pytest.mark.parametrize("policy", ["baseline", "optimistic"])
@pytest.mark.parametrize(
    ("letter", "resolution", "state"),
    [(9, 1.0, 0), (0, -1.0, 0), (0, 0.0, 0), (0, np.nan, 0), (0, np.inf, 0), (0, 1.0, 99)],
)
def test_a_robot_that_does_not_know_where_to_go_stays(letter, resolution, state, policy):
    belief = known_map(["#######", "#.....?", "#######"], letter, resolution)
    move = decided(belief, (1, 3), policy, state)
    assert int(move.status) & int(Status.INVALID)
    assert (int(move.kind), int(move.path.length), float(move.value)) == (MoveKind.NONE, 0, np.inf)
    assert tuple(np.asarray(move.target_cell)) == (1, 3)


def answering_nan(belief, subgoals, task):
    """An estimator whose network is broken."""
    nothing = jnp.full((subgoals.mask.shape[0], task.class_mask.shape[0]), jnp.nan)
    return Estimates(success_probability=nothing, success_cost=nothing, failure_cost=nothing)


@pytest.mark.long
def test_a_trial_of_a_broken_network_is_flagged_and_its_decisions_say_why(tmp_path):
    world = make("toy").world(0)
    task, key = world.task("!hazard U goal"), jax.random.key(0)
    estimator = jax.tree_util.Partial(answering_nan)
    trial = run_trial(world, task, "potlp", key, estimator=estimator)
    (row,) = run_batch([Start(world, task.arrays, key)], "potlp", estimator=estimator)
    assert trial.status & row.status & Status.INVALID
    assert (row.outcome, row.status, row.fallbacks) == (
        trial.outcome,
        trial.status,
        sum(d.fallback for d in trial.decisions),
    )
    (number, *_) = [d.index for d in trial.decisions if d.status & Status.INVALID]
    trial.save(tmp_path / "trial.json")
    explained = CliRunner().invoke(app, ["explain", f"{tmp_path}:{number}"])
    assert explained.exit_code == 0
    assert "not allowed" in " ".join(explained.stdout.split())
    assert "does not search" not in explained.stdout
    drawn = CliRunner().invoke(app, ["explain", f"{tmp_path}:{number}", "--out", str(tmp_path / "tree.png")])
    assert drawn.exit_code == 2
    assert "not allowed" in " ".join(drawn.stderr.split())
    assert not (tmp_path / "tree.png").exists()
