"""Paired statistics against figures worked out by hand and a plain NumPy bootstrap."""

import dataclasses
import json
import math

import numpy as np
import pytest

from potlp_jax.sweep.statistics import Comparison, TrialResult, attainable_interval, attainable_share
from potlp_jax.types import Status

BUDGET = 1000.0

# Three worlds; sums: known map 55, baseline 100, ours 70.
KNOWN = (10.0, 15.0, 30.0)
BASELINE = (20.0, 20.0, 60.0)
OURS = (15.0, 25.0, 30.0)


def _trials(costs, outcomes=None, status=0):
    outcomes = outcomes or ["satisfied"] * len(costs)
    return [
        TrialResult(cost=cost, outcome=outcome, budget=BUDGET, status=status)
        for cost, outcome in zip(costs, outcomes, strict=True)
    ]


def _results(**ours):
    return {"known-map": _trials(KNOWN), "baseline": _trials(BASELINE), **ours}


def _row(table, policy):
    return next(row for row in table.rows if row.policy == policy)


def test_figures_worked_out_by_hand():
    comparison = Comparison.from_results(_results(ours=_trials(OURS)), resamples=500)
    assert (comparison.worlds, comparison.satisfied.pairs, comparison.satisfied.dropped) == (3, 3, 0)
    row = _row(comparison.satisfied, "ours")
    assert row.mean_cost == pytest.approx(70 / 3)
    assert row.attainable_share == pytest.approx(30 / 45)
    assert row.net_savings == pytest.approx(0.3)
    # 1 - 15/20 = 1/4, 1 - 25/20 = -1/4, 1 - 30/60 = 1/2: mean 1/6, deviations 1/12, -5/12, 4/12.
    assert row.trial_savings == pytest.approx(1 / 6)
    variance = (1 + 25 + 16) / 144 / 2
    assert row.trial_savings_error == pytest.approx(math.sqrt(variance / 3))
    assert row.attainable_low <= row.attainable_share <= row.attainable_high
    floor, reference = _row(comparison.satisfied, "known-map"), _row(comparison.satisfied, "baseline")
    assert (floor.attainable_share, floor.attainable_low, floor.attainable_high) == (1.0, 1.0, 1.0)
    assert (reference.attainable_share, reference.net_savings, reference.trial_savings) == (0.0, 0.0, 0.0)


def test_pair_is_dropped_for_all_policies_and_charged_in_the_second_table():
    results = _results(
        first=_trials(OURS, ["satisfied", "stuck", "satisfied"]),
        second=_trials(OURS, ["satisfied", "satisfied", "budget"]),
    )
    comparison = Comparison.from_results(results, resamples=100)
    assert (comparison.satisfied.pairs, comparison.satisfied.dropped) == (1, 2)
    assert {row.policy: row.mean_cost for row in comparison.satisfied.rows} == {
        "known-map": 10.0,
        "baseline": 20.0,
        "first": 15.0,
        "second": 15.0,
    }
    assert (comparison.charged.pairs, comparison.charged.dropped) == (3, 0)
    assert _row(comparison.charged, "first").mean_cost == pytest.approx((15 + BUDGET + 30) / 3)
    assert _row(comparison.charged, "second").mean_cost == pytest.approx((15 + 25 + BUDGET) / 3)
    assert _row(comparison.charged, "baseline").mean_cost == pytest.approx(100 / 3)
    assert comparison.outcomes["first"] == {"satisfied": 2, "stuck": 1}
    assert comparison.outcomes["second"] == {"budget": 1, "satisfied": 2}


def test_trial_that_lost_something_is_counted_apart_and_not_averaged():
    lossy = _trials(OURS)
    lossy[1] = TrialResult(25.0, "satisfied", BUDGET, int(Status.TREE_OVERFLOW | Status.FALLBACK))
    comparison = Comparison.from_results(_results(ours=lossy), resamples=100)
    assert comparison.flagged == {"known-map": {}, "baseline": {}, "ours": {"fallback": 1, "tree_overflow": 1}}
    assert (comparison.satisfied.pairs, comparison.satisfied.dropped) == (2, 1)
    assert _row(comparison.satisfied, "known-map").mean_cost == 20.0
    # Charging its budget or its cost would average in what its planner would not have done.
    assert (comparison.charged.pairs, comparison.charged.dropped) == (2, 1)
    assert _row(comparison.charged, "ours").mean_cost == pytest.approx((70 - 25) / 2)


def test_status_without_loss_keeps_the_pair():
    comparison = Comparison.from_results(_results(ours=_trials(OURS, status=int(Status.FALLBACK))), resamples=100)
    assert comparison.satisfied.pairs == 3


def _plain_bootstrap(ours, baseline, known_map, resamples, seed):
    """Percentile interval by drawing whole worlds with replacement, one resample at a time."""
    generator = np.random.default_rng(seed)
    shares = []
    for _ in range(resamples):
        drawn = generator.integers(0, len(ours), len(ours))
        saved = sum(baseline[i] - ours[i] for i in drawn)
        shares.append(saved / sum(baseline[i] - known_map[i] for i in drawn))
    return np.percentile(shares, 2.5), np.percentile(shares, 97.5)


def test_interval_equals_a_plain_bootstrap_of_pairs():
    generator = np.random.default_rng(7)
    known_map = generator.uniform(50, 150, 40)
    baseline = known_map * generator.uniform(1.1, 2.0, 40)
    ours = known_map + (baseline - known_map) * generator.uniform(0.0, 1.2, 40)
    low, high = attainable_interval(ours, baseline, known_map, resamples=20_000, seed=1)
    expected_low, expected_high = _plain_bootstrap(ours, baseline, known_map, 20_000, seed=2)
    # Monte Carlo error of a 2.5 % quantile at 20,000 resamples is about 3 % of the interval's half width.
    tolerance = 0.06 * (expected_high - expected_low) / 2
    assert low == pytest.approx(expected_low, abs=tolerance)
    assert high == pytest.approx(expected_high, abs=tolerance)
    # Without pairing the worlds' different sizes would dominate and the interval be far wider.
    shuffled = generator.permutation(40)
    loose_low, loose_high = attainable_interval(ours[shuffled], baseline, known_map, resamples=2_000, seed=1)
    assert loose_high - loose_low > 1.5 * (high - low)


def test_interval_is_reproducible():
    arrays = (np.array(OURS), np.array(BASELINE), np.array(KNOWN))
    assert attainable_interval(*arrays, seed=3) == attainable_interval(*arrays, seed=3)


def test_nothing_to_attain_is_undefined_not_infinite():
    same = np.array(KNOWN)
    assert math.isnan(attainable_share(same + 1, same, same))
    assert all(map(math.isnan, attainable_interval(same + 1, same, same, resamples=50)))


def test_no_interval_where_too_many_resamples_have_nothing_to_attain():
    # Only the first of three worlds leaves anything to attain: 8 of 27 resamples miss it.
    known_map, baseline = np.array([10.0, 10.0, 10.0]), np.array([20.0, 10.0, 10.0])
    ours = np.array([15.0, 10.0, 10.0])
    assert attainable_share(ours, baseline, known_map) == 0.5
    assert all(map(math.isnan, attainable_interval(ours, baseline, known_map, resamples=500)))


def test_no_pair_left_and_one_pair_left():
    stuck = Comparison.from_results(_results(ours=_trials(OURS, ["stuck"] * 3)), resamples=50)
    row = _row(stuck.satisfied, "ours")
    assert stuck.satisfied.pairs == 0
    assert math.isnan(row.mean_cost)
    assert math.isnan(row.attainable_share)
    single = Comparison.from_results(
        {"known-map": _trials([1.0]), "baseline": _trials([2.0]), "ours": _trials([1.5])}, resamples=50
    )
    row = _row(single.satisfied, "ours")
    assert (row.attainable_share, row.trial_savings) == (0.5, 0.25)
    assert math.isnan(row.attainable_low)
    assert math.isnan(row.trial_savings_error)


def test_baseline_that_has_nothing_to_walk():
    comparison = Comparison.from_results(
        {"known-map": _trials([0.0, 1.0]), "baseline": _trials([0.0, 2.0]), "ours": _trials([0.0, 1.0])}, resamples=50
    )
    assert _row(comparison.satisfied, "ours").trial_savings == 0.25


def test_json_has_no_nan():
    comparison = Comparison.from_results(_results(ours=_trials(OURS, ["stuck"] * 3)), resamples=50)
    data = json.loads(json.dumps(comparison.to_dict(), allow_nan=False))
    assert data["satisfied"]["rows"][0]["mean_cost"] is None
    assert data["outcomes"]["ours"] == {"stuck": 3}


def test_unpaired_or_missing_policies_are_refused():
    with pytest.raises(ValueError, match="known-map"):
        Comparison.from_results({"baseline": _trials(BASELINE)})
    with pytest.raises(ValueError, match="unequally many"):
        Comparison.from_results(_results(ours=_trials(OURS[:2])))


def test_trials_of_one_cluster_are_no_independent_trials():
    """Every trial four times over, in clusters of four, says no more than once."""

    def compared(times, clusters=None):
        results = {
            "known-map": _trials(np.tile(KNOWN, times)),
            "baseline": _trials(np.tile(BASELINE, times)),
            "ours": _trials(np.tile(OURS, times)),
        }
        return _row(Comparison.from_results(results, clusters=clusters, resamples=500).satisfied, "ours")

    once, clustered, apart = compared(1), compared(4, ["x", "y", "z"] * 4), compared(4)
    assert dataclasses.astuple(clustered)[1:] == pytest.approx(dataclasses.astuple(once)[1:])
    assert apart.trial_savings_error < 0.6 * once.trial_savings_error
    assert apart.attainable_high - apart.attainable_low < once.attainable_high - once.attainable_low


def test_clusters_that_are_dropped_leave_no_trace():
    results = _results(ours=_trials(OURS, ["satisfied", "stuck", "satisfied"]))
    row = _row(Comparison.from_results(results, clusters=["a", "b", "c"], resamples=100).satisfied, "ours")
    assert row.trial_savings == pytest.approx(3 / 8)
    # Deviations 1/8 and -1/8.
    assert row.trial_savings_error == pytest.approx(1 / 8)
    with pytest.raises(ValueError, match="2 clusters are named for 3 worlds"):
        Comparison.from_results(results, clusters=["a", "b"])
