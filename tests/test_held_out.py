"""Formulas that were held out beside trained ones: shares are means over formulas, in worlds that all have."""

import pytest

from eval.held_out import difference, mean_share, shared_worlds


def trial(known, ours, baseline):
    return {"known-map": known, "potlp": ours, "baseline": baseline}


COSTS = {
    ("F a", 0): trial(50.0, 60.0, 100.0),
    ("F a", 1): trial(10.0, 10.0, 20.0),
    ("F b", 0): trial(0.0, 50.0, 100.0),
    ("F b", 1): trial(0.0, 500.0, 1000.0),
    ("F b", 2): trial(0.0, 500.0, 1000.0),
}


def test_each_formula_counts_alike_whatever_it_costs():
    # Of F a, 50 of 60 are kept; of F b, half.
    assert mean_share(COSTS, ["F a", "F b"], [0, 1]) == pytest.approx((5 / 6 + 1 / 2) / 2)


def test_a_world_that_was_drawn_twice_counts_twice():
    assert mean_share(COSTS, ["F a"], [0, 0, 1]) == pytest.approx(90 / 110)


def test_worlds_are_those_that_all_formulas_have():
    assert shared_worlds(COSTS, ["F a", "F b"]) == [0, 1]
    assert shared_worlds(COSTS, ["F b"]) == [0, 1, 2]
    # As many policies, but not PO-TLP.
    incomplete = {**COSTS, ("F a", 2): {"known-map": 1.0, "baseline": 2.0, "oracle": 1.0}}
    assert shared_worlds(incomplete, ["F a", "F b"]) == [0, 1]


def test_the_difference_is_paired_by_world():
    # Drawn: world 0 twice (.8 and .5), both (5/6 and .5), world 1 twice (1 and .5).
    found, low, high = difference(COSTS, ["F a"], ["F b"], [0, 1])
    assert (found, low, high) == pytest.approx((1 / 3, 0.3, 0.5))
    assert difference(COSTS, ["F a"], ["F a"], [0, 1]) == pytest.approx((0, 0, 0))
