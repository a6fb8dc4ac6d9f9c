"""Status bits: each is set by what its description says, and reaches the trial, its record and the report."""

import dataclasses
import functools
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.environments.registry import make
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.move import Move
from potlp_jax.planning.policies import Policy, decide, policy_function
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.sweep.rows import trial_row
from potlp_jax.sweep.statistics import UNRELIABLE, Comparison, TrialResult
from potlp_jax.sweep.store import Item, Store
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import load_trial
from potlp_jax.trials.rules import count_decision, first_tally
from potlp_jax.types import Status, status_array
from potlp_jax.view.comparisons import flag_lines, unreliable_lines
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap, belief_from_numpy

ROOT = Path(__file__).parents[1]
BITS = [bit for bit in Status if bit]
ALL = functools.reduce(Status.__or__, BITS)
WORLD = make("toy").world(0)
# Two things to find, so that plans have several steps.
TASK = WORLD.task("F goal & F hazard")
DEFAULT = DecisionConfig(search=BestFirstConfig(simulations=30))


def corridor(drawing: str) -> BeliefMap:
    """Cells of one row between walls: free (.), a wall (#) or unobserved (?)."""
    meaning = {".": BeliefMap.FREE, "#": BeliefMap.OCCUPIED, "?": BeliefMap.UNKNOWN}
    row = [meaning[cell] for cell in drawing]
    wall = [BeliefMap.OCCUPIED] * len(row)
    cells = np.array([wall, row, wall], np.int8)
    return belief_from_numpy(cells, np.zeros(cells.shape, np.int32), propositions=WORLD.propositions)


@functools.partial(jax.jit, static_argnames="config")
def decision(belief: BeliefMap, state, chance, status, config: DecisionConfig) -> Move:
    """PO-TLP in the middle of the corridor, where every question has the same answer."""

    def answer(belief, subgoals, task):
        shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
        return Estimates(
            success_probability=jnp.full(shape, chance),
            success_cost=jnp.full(shape, jnp.float32(5.0)),
            failure_cost=jnp.full(shape, jnp.float32(5.0)),
            status=status,
        )

    middle = jnp.array([1, belief.cells.shape[1] // 2], jnp.int32)
    return decide(belief, middle, state, TASK.arrays, answer, jax.random.key(0), policy=Policy.POTLP, config=config)


def move_with(
    drawing: str = "?.......?",
    state: int = TASK.dfa.initial,
    chance: float = 0.5,
    status: Status = Status.OK,
    config: DecisionConfig = DEFAULT,
) -> Move:
    return decision(corridor(drawing), jnp.int32(state), jnp.float32(chance), status_array(status), config)


def searching(**settings: int) -> DecisionConfig:
    return dataclasses.replace(DEFAULT, search=dataclasses.replace(DEFAULT.search, **settings))


SCENES = {
    Status.OK: {},
    Status.SUBGOAL_OVERFLOW: {"config": dataclasses.replace(DEFAULT, frontiers=FrontierConfig(max_subgoals=1))},
    Status.TREE_OVERFLOW: {"config": searching(tree_capacity=2)},
    Status.DEPTH_OVERFLOW: {"config": searching(max_depth=1)},
    Status.VIEW_OVERFLOW: {"status": Status.VIEW_OVERFLOW},
    # Nothing is left to do.
    Status.ACCEPTING_ROOT: {"state": int(np.flatnonzero(TASK.dfa.accepting)[0])},
    # Without chances the robot still goes to a frontier, if there is one.
    Status.DEAD_END | Status.FALLBACK: {"chance": 0.0},
    Status.DEAD_END | Status.NO_FRONTIER: {"drawing": "#.......#"},
    Status.INVALID | Status.FALLBACK: {"chance": np.nan},
    Status.INVALID | Status.NO_FRONTIER: {"state": 99},
}


@pytest.mark.parametrize(("expected", "scene"), SCENES.items(), ids=lambda value: str(getattr(value, "name", "")))
def test_a_decision_sets_the_bits_that_its_situation_calls_for(expected, scene):
    assert Status(int(move_with(**scene).status)) == expected


def test_every_bit_has_a_situation_that_sets_it():
    assert functools.reduce(Status.__or__, SCENES) == ALL


def test_a_bit_of_one_decision_stays_with_the_trial():
    tally = first_tally(corridor("........."), jnp.array([1, 1], jnp.int32), TASK.arrays)
    for number, scene in enumerate((SCENES[Status.VIEW_OVERFLOW], {}, SCENES[Status.DEAD_END | Status.FALLBACK])):
        tally = count_decision(tally, move_with(**scene))
        assert int(tally.decisions) == number + 1
        assert int(tally.status) & Status.VIEW_OVERFLOW
    assert Status(int(tally.status)) == Status.VIEW_OVERFLOW | Status.DEAD_END | Status.FALLBACK
    assert int(tally.fallbacks) == 1


def test_every_bit_is_kept_in_the_record(tmp_path):
    trial = run_trial(WORLD, WORLD.task("F goal"), Policy.BASELINE, jax.random.key(0))
    for bit in BITS:
        flagged = dataclasses.replace(
            trial, status=int(bit), decisions=tuple(dataclasses.replace(d, status=int(bit)) for d in trial.decisions)
        )
        flagged.save(tmp_path / "trial.json")
        assert json.loads((tmp_path / "trial.json").read_text())["status"] == [str(bit.name).lower()]
        read = load_trial(tmp_path / "trial.json")
        assert (read.status, {d.status for d in read.decisions}) == (bit, {bit})


def flagging(situation, estimates, key, config, intention):
    """The baseline's decisions with every bit set."""
    move = policy_function(Policy.BASELINE)(situation, estimates, key, config, intention)
    return dataclasses.replace(move, status=move.status | status_array(ALL))


def test_every_bit_of_a_batch_reaches_the_row_in_the_store(tmp_path):
    key, task = jax.random.key(0), WORLD.task("F goal")
    (finished,) = run_batch([Start(WORLD, task.arrays, key)], flagging, TrialConfig())
    assert finished.status == ALL
    item = Item("toy", "F goal", "mine", 0)
    store = Store(tmp_path / "results.sqlite")
    try:
        store.finish([trial_row(item, finished, WORLD, key, TrialConfig(), {})])
        (row,) = store.rows()
    finally:
        store.close()
    assert row.status == ALL


@pytest.mark.parametrize("bit", BITS, ids=lambda bit: bit.name)
def test_every_bit_is_in_the_report_and_wrong_trials_in_no_mean(bit):
    def trials(*statuses: int) -> list[TrialResult]:
        return [TrialResult(10.0, "satisfied", 100.0, status) for status in statuses]

    results = {"known-map": trials(0, 0), "baseline": trials(0, 0), "potlp": trials(0, int(bit))}
    comparison = Comparison.from_results(results, resamples=50)
    wrong = bit in UNRELIABLE
    assert comparison.flagged["potlp"] == {str(bit.name).lower(): 1}
    assert comparison.satisfied.pairs == (1 if wrong else 2)
    assert comparison.charged.pairs == comparison.satisfied.pairs
    assert len(unreliable_lines(comparison)) == wrong
    (line,) = flag_lines(comparison)
    assert str(bit.name).lower().replace("_", " ") in line
    assert ("left out of costs and savings" in line) == wrong
    assert wrong == (bit in (Status.TREE_OVERFLOW, Status.DEPTH_OVERFLOW, Status.INVALID))


def test_the_help_explains_the_bits_that_exist():
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    assert set(re.findall(r"^\| `([A-Z_]+)` \|", page, re.M)) == {bit.name for bit in BITS}
