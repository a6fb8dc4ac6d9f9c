"""Decisions phase by phase, as ``eval.bench.decision`` times them, are those of whole trials."""

import pytest

from eval.bench.decision import asked_by, decisions_of, measure, phases_of, table_of, whole_trials
from eval.bench.trials import starts
from potlp_jax.planning.policies import Policy
from potlp_jax.trials import rules
from potlp_jax.trials.batch import run_batch
from potlp_jax.trials.config import config_in
from potlp_jax.trials.slots import Setup


@pytest.fixture(scope="module")
def trials():
    return starts(1)[:1]


def setup_of(policy, trials):
    config = rules.config_of(policy, config_in(trials[0].world, None))
    return Setup(policy=policy, config=config), asked_by(policy, trials[0], config)


@pytest.mark.long
@pytest.mark.parametrize("policy", [Policy.POTLP, Policy.ORACLE, Policy.BASELINE])
def test_phases_take_the_decisions_of_a_trial(policy, trials):
    decisions = list(decisions_of(trials[0], *setup_of(policy, trials)))
    (trial,) = run_batch(trials, policy, slots=1)
    assert len(decisions) == trial.decisions > 3
    end = decisions[-1]["advance"]
    assert int(end.tally.steps) == len(trial.path) - 1
    assert end.cell.tolist() == trial.path[-1].tolist()


@pytest.mark.long
def test_what_is_measured_is_in_the_table(trials):
    setup, asked = setup_of(Policy.BASELINE, trials)
    rows = measure(setup, asked, trials, seconds=0.01)
    assert [row["phase"] for row in rows] == [phase.name for phase in phases_of(setup)]
    assert all(row["ms"] > 0 for row in rows)
    found = {"baseline": {"phases": rows, "trials": whole_trials(trials, Policy.BASELINE, 1)}}
    lines = table_of(found).splitlines()
    # Each phase, all of them together, and whole trials in two ways, below the head.
    assert len(lines) == 2 + len(rows) + 1 + 2
    whole = sum(row["ms"] for row in rows if not row["part_of"])
    assert lines[-3] == f"| baseline | all phases | {whole:.3f} | | | |"
