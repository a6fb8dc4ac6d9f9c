"""What changed between two tables of trials."""

import csv
import gzip

import pytest

from eval.gains import changes, costs_of, gain, worlds_of_both
from potlp_jax.types import Status


def _table(file, potlp, outcome="satisfied", status=""):
    """Two worlds of a task: known map 10, baseline 30, and PO-TLP as given; one more world of another task."""
    with gzip.open(file, "wt", newline="") as lines:
        writer = csv.writer(lines)
        writer.writerow(["task", "policy", "world", "outcome", "cost", "status"])
        for world, cost in enumerate(potlp):
            for policy, value in (("known-map", 10), ("baseline", 30), ("potlp", cost)):
                writer.writerow(["F a", policy, world, outcome if world == 0 else "satisfied", value, status])
        writer.writerow(["F b", "baseline", 0, "satisfied", 7, ""])
    return costs_of(file)


@pytest.fixture
def tables(tmp_path):
    return _table(tmp_path / "before.csv.gz", (20, 30)), _table(tmp_path / "after.csv.gz", (22, 16, 5))


def test_costs_are_compared_in_the_worlds_of_both(tables):
    assert list(changes(*tables)) == [("baseline", 3, 0, 0), ("known-map", 2, 0, 0), ("potlp", 2, 1, 1)]


def test_a_gain_is_of_what_can_be_saved(tables):
    # 12 cells cheaper in all, of 2 times 20; a draw has one of the worlds twice, or both.
    found, low, high = gain(*tables, "F a")
    assert found == pytest.approx(12 / 40)
    assert (low, high) == pytest.approx((-2 / 20, 14 / 20))


def test_trials_without_success_and_those_that_were_cut_short_are_in_no_gain(tmp_path, tables):
    stuck = _table(tmp_path / "stuck.csv.gz", (1, 16), outcome="stuck")
    assert worlds_of_both(tables[0], stuck, "F a") == [("F a", 1)]
    assert gain(tables[0], stuck, "F a")[0] == pytest.approx(14 / 20)
    cut_short = _table(tmp_path / "cut.csv.gz", (1, 16), status="tree_overflow")
    assert worlds_of_both(tables[0], cut_short, "F a") == worlds_of_both(*tables, "F b") == []
    # 0.1 wrote the bits as a number.
    numbered = _table(tmp_path / "numbers.csv.gz", (1, 16), status=int(Status.TREE_OVERFLOW))
    assert worlds_of_both(tables[0], numbered, "F a") == []
    assert worlds_of_both(tables[0], _table(tmp_path / "fine.csv.gz", (1, 16), status="0"), "F a")
    assert worlds_of_both(tables[0], _table(tmp_path / "grew.csv.gz", (1, 16), status="dead_end fallback"), "F a")


def test_the_way_back_loses_what_was_gained(tables):
    before, after = tables
    assert gain(after, before, "F a")[0] == pytest.approx(-12 / 40)


@pytest.mark.parametrize("policy", ["baseline", "known-map"])
def test_shares_of_other_savings_are_not_compared(tables, policy):
    before, after = tables
    after["F a", 1][policy] += 1.0
    with pytest.raises(ValueError, match=f"{policy} costs otherwise in world 1 of task F a"):
        gain(before, after, "F a")
