"""The rules of a trial one by one: when a robot stops to decide, and when a trial ends."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome
from potlp_jax.trials.rules import OUTCOMES, RUNNING, Knowledge, Stop, arrive, budget, first_tally
from potlp_jax.world.grid import BeliefMap, belief_from_numpy, make_world

PROPOSITIONS = ("goal", "hazard")
TASK = Task.from_formula("!hazard U goal", PROPOSITIONS)
CONFIG = TrialConfig(replan_distance=4.0)
TARGET = jnp.array([1, 4])


def _belief(unknown=((1, 5),), goal=None):
    """A corridor of five cells with walls around; what lies beyond its right end is not known."""
    cells = np.full((3, 7), BeliefMap.OCCUPIED, np.int8)
    cells[1, 1:5] = BeliefMap.FREE
    for cell in unknown:
        cells[cell] = BeliefMap.UNKNOWN
    letters = np.zeros((3, 7), np.int32)
    if goal is not None:
        letters[goal] = 1
    return belief_from_numpy(cells, letters, 1.0, (3, 7), PROPOSITIONS)


def _due(now, before=None, travelled=1.0, budget=100.0, is_frontier=True):
    stop = Stop(
        replan_distance=jnp.float32(CONFIG.replan_distance),
        budget=jnp.float32(budget),
        is_frontier=jnp.bool_(is_frontier),
    )
    known = Knowledge.of(_belief() if before is None else before)
    return bool(stop.is_due(known, now, TARGET, jnp.float32(travelled)))


def test_nothing_new_is_no_reason_to_decide_however_far_the_robot_goes():
    assert not _due(_belief())
    assert not _due(_belief(), travelled=99.0)


def test_a_changed_map_is_worth_a_decision_after_some_cells():
    less = _belief(unknown=((1, 5), (0, 0)))
    assert not _due(_belief(), less, travelled=3.9)
    assert _due(_belief(), less, travelled=4.0)


def test_a_proposition_seen_for_the_first_time_is_decided_on_at_once():
    assert _due(_belief(goal=(1, 3)))
    assert not _due(_belief(goal=(1, 3)), _belief(goal=(1, 2)))


def test_a_frontier_without_anything_unobserved_beside_it_has_nothing_to_show():
    closed = _belief(unknown=((0, 0),))
    assert _due(closed, closed)
    # Elsewhere the robot goes for what is known.
    assert not _due(closed, closed, is_frontier=False)


def test_where_the_horizon_cuts_the_way_the_robot_goes_on_as_if_it_did_not():
    """A hallway to and fro, one cell wide: the way back from its end is longer than the horizon."""
    occupied = np.ones((14, 15), bool)
    occupied[1:-1:2, 1:-1] = False
    for turn, row in enumerate(range(2, 12, 2)):
        occupied[row, 13 if turn % 2 else 1] = False
    letters = np.zeros((14, 15), np.int32)
    letters[1, 13] = 1
    world = make_world(occupied, letters, (11, 1), propositions=("goal",))
    task, horizon = world.task("F goal"), 5
    whole, cut = (
        run_trial(
            world, task, "baseline", jax.random.key(0), TrialConfig(decision=DecisionConfig(path_horizon=longest))
        )
        for longest in (None, horizon)
    )
    np.testing.assert_array_equal(cut.path, whole.path)
    assert len(cut.decisions) > len(whole.decisions)
    assert len(cut.decisions) <= len(whole.decisions) + len(cut.path) // horizon


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dead_end_factor", 0.0),
        ("dead_end_factor", float("inf")),
        ("commitment", -0.1),
        ("commitment", float("nan")),
        ("path_horizon", 0),
    ],
)
def test_settings_of_decisions_that_make_no_sense_are_named(name, value):
    with pytest.raises(ValueError, match=f"{name} is "):
        DecisionConfig(**{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("budget_factor", 0.0),
        ("budget_factor", float("nan")),
        ("budget_factor", float("inf")),
        ("replan_distance", -1.0),
        ("panoramas", 0),
        ("look_every", -1),
    ],
)
def test_settings_of_trials_that_make_no_sense_are_named(name, value):
    with pytest.raises(ValueError, match=f"{name} is "):
        TrialConfig(**{name: value})


def test_the_budget_ends_a_leg():
    assert _due(_belief(), budget=2.0, travelled=2.0)
    assert not _due(_belief(), budget=2.0, travelled=1.5)


def _tally(**changes):
    tally = first_tally(_belief(), jnp.array([1, 1]), TASK.arrays)
    return dataclasses.replace(tally, **{name: jnp.int32(value) for name, value in changes.items()})


def _arrive(tally, belief=None, *, gave_up=False):
    cell = jnp.array([1, 1])
    return arrive(tally, _belief() if belief is None else belief, cell, TASK.arrays, jnp.bool_(gave_up), CONFIG)


def _outcome(tally):
    return None if int(tally.outcome) == RUNNING else OUTCOMES[int(tally.outcome)]


def test_the_third_visit_of_a_cell_in_one_state_and_map_is_the_last():
    tally = _tally()
    for visit in range(3):
        tally = _arrive(tally)
        assert _outcome(tally) == (Outcome.STUCK if visit == 2 else None)


def test_on_another_map_visits_begin_anew():
    belief, more = _belief(unknown=((1, 5), (0, 0))), _belief()
    tally = _arrive(_arrive(_tally(), belief), belief)
    tally = _arrive(tally, more)
    assert _outcome(tally) is None
    assert int(tally.visits[1, 1, tally.state]) == 1


STATES = {"accepting": int(np.argmax(TASK.dfa.accepting)), "trap": int(np.argmax(TASK.dfa.trap))}


@pytest.mark.parametrize(
    ("state", "spent", "gave_up", "outcome"),
    [
        (None, False, False, None),
        (None, True, False, Outcome.BUDGET),
        (None, False, True, Outcome.INFEASIBLE),
        # What was reached counts, though the budget is spent.
        ("accepting", True, False, Outcome.SATISFIED),
        ("accepting", False, False, Outcome.SATISFIED),
        ("trap", True, False, Outcome.INFEASIBLE),
    ],
)
def test_the_strongest_reason_to_end_is_what_counts(state, spent, gave_up, outcome):
    cells = int(np.ceil(float(budget(_belief(), CONFIG)))) if spent else 0
    tally = _tally(straight=cells, **({} if state is None else {"state": STATES[state]}))
    assert _outcome(_arrive(tally, gave_up=gave_up)) == outcome
