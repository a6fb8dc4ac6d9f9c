"""Every bit of ``Status`` is set by something, and reaches the trial, the record, the sweep's row and the report."""

import ast
import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

import potlp_jax
from potlp_jax.environments.splits import Split
from potlp_jax.environments.toy import Toy
from potlp_jax.planning.policies import Policy, policy_function
from potlp_jax.sweep.rows import trial_row
from potlp_jax.sweep.statistics import UNRELIABLE, Comparison, TrialResult
from potlp_jax.sweep.store import Item, Store
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import load_trial
from potlp_jax.types import Status, status_names, status_of
from potlp_jax.view.comparisons import loss_lines
from potlp_jax.world.sensing import SensorConfig

BITS = [bit for bit in Status if bit is not Status.OK]
TOY = Toy()
WORLD = TOY.world(0, Split.VALIDATION)
TASK = TOY.task(1)
CONFIG = TrialConfig(sensor=SensorConfig(range_cells=5.0))
ALL = int(np.bitwise_or.reduce([int(bit) for bit in BITS]))


def _flagging(situation, estimates, key, config, intention):
    """The baseline's decisions with every bit set."""
    move = policy_function(Policy.BASELINE)(situation, estimates, key, config, intention)
    return dataclasses.replace(move, status=move.status | np.uint32(ALL))


@pytest.fixture(scope="module")
def trial():
    return run_trial(WORLD, TASK, _flagging, jax.random.key(0), CONFIG)


@pytest.mark.parametrize("bit", BITS, ids=lambda bit: bit.name)
def test_something_sets_the_bit(bit):
    """Named where bits are made; a table of bits to look at, as the statistics have, does not count."""
    makers = {"status_if", "status_of_rows", "status_array"}
    package = Path(potlp_jax.__file__).parent
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in makers:
                named = {part.attr for part in ast.walk(node) if isinstance(part, ast.Attribute)}
                if bit.name in named:
                    return
    pytest.fail(f"{bit.name} is promised, and nothing sets it")


def test_every_bit_of_a_decision_reaches_the_trial_and_its_record(trial, tmp_path):
    assert trial.status == ALL
    trial.save(tmp_path / "trial.json")
    loaded = load_trial(tmp_path / "trial.json")
    assert loaded.status == ALL
    assert loaded.decisions[0].status == ALL
    assert set(loaded.summary()["status"]) == {bit.name.lower() for bit in BITS}
    assert status_of(status_names(ALL)) == ALL


def test_every_bit_of_a_batch_reaches_the_row_in_the_store(tmp_path):
    key = jax.random.key(0)
    (finished,) = run_batch([Start(WORLD, TASK.arrays, key)], _flagging, CONFIG)
    assert finished.status == ALL
    item = Item("toy", "F goal", "mine", 0)
    store = Store(tmp_path / "results.sqlite")
    try:
        assert store.claim([item], 1) == [item]
        store.finish([trial_row(item, finished, WORLD, key, CONFIG, {})])
        (row,) = store.rows()
    finally:
        store.close()
    assert row.status == ALL


@pytest.mark.parametrize("bit", BITS, ids=lambda bit: bit.name)
def test_every_bit_is_counted_in_the_report(bit):
    def results(status):
        return [TrialResult(10.0, "satisfied", 100.0), TrialResult(10.0, "satisfied", 100.0, status)]

    found = Comparison.from_results({"known-map": results(0), "baseline": results(0), "ours": results(int(bit))})
    name = bit.name.lower()
    assert found.losses["ours"] == {name: 1}
    (line,) = loss_lines(found)
    assert f"1 trials with {name.replace('_', ' ')}" in line
    is_left_out = bool(bit & UNRELIABLE)
    assert ("left out" in line) == is_left_out
    assert found.satisfied.pairs == (1 if is_left_out else 2)
