"""The ideal observer beside a table: shares and gains are those of the rows; rows that do not belong are refused."""

import pytest

from eval.limit.beside import compare, markdown, observed_costs
from potlp_jax.types import Status

TASK = "F a"


def row(world, arm, cost, **other):
    known = {"outcome": "satisfied", "status": 0, "problems": []}
    return {"task": "1", "world": world, "arm": arm, "cost": cost, **known, **other}


def rows_of(world, known, observer, baseline):
    return [row(world, "known-map", known), row(world, "ideal-observer", observer), row(world, "baseline", baseline)]


def table_of(known, oracle, ours, baseline):
    return {"known-map": known, "oracle": oracle, "potlp": ours, "baseline": baseline}


ROWS = [*rows_of(0, 50.0, 60.0, 100.0), *rows_of(1, 50.0, 50.0, 100.0), *rows_of(2, 10.0, 10.0, 20.0)]
TABLE = {
    (TASK, 0): table_of(50.0, 50.0, 80.0, 100.0),
    (TASK, 1): table_of(50.0, 60.0, 70.0, 100.0),
    (TASK, 9): table_of(1.0, 2.0, 3.0, 4.0),
}


def test_worlds_that_both_have_are_compared():
    found = compare(TABLE, observed_costs(ROWS, {"1": TASK}), TASK)
    assert found["worlds"] == 2
    # Of 100 to be saved the oracle keeps 90, the observer 90, PO-TLP 50.
    assert found["share"]["oracle"][0] == pytest.approx(0.9)
    assert found["share"]["ideal-observer"][0] == pytest.approx(0.9)
    assert found["share"]["potlp"][0] == pytest.approx(0.5)
    assert found["gain"][0] == pytest.approx(0.4)
    assert found["mean_cost"]["ideal-observer"] == pytest.approx(55.0)
    assert (
        "| 1 | 2 | 90.0 % (80 to 100) | 90.0 % (80 to 100) | 50.0 % (40 to 60) | +40.0 (+40.0 to +40.0) |"
        in markdown({"1": found})
    )


def test_a_world_without_success_or_with_an_arm_missing_is_left_out():
    rows = [
        *rows_of(0, 50.0, 60.0, 100.0)[:2],
        row(0, "baseline", 100.0, outcome="stuck"),
        *rows_of(1, 5.0, 6.0, 9.0)[1:],
    ]
    assert observed_costs(rows, {"1": TASK}) == {}
    cut_short = [row | {"status": int(Status.TREE_OVERFLOW)} for row in rows_of(0, 50.0, 60.0, 100.0)]
    assert observed_costs(cut_short, {"1": TASK}) == {}


def test_potlp_is_the_tables_own():
    others = [row(0, "potlp", 51.0), row(0, "oracle", 99.0)]
    found, alone = (compare(TABLE, observed_costs(rows, {"1": TASK}), TASK) for rows in ([*ROWS, *others], ROWS))
    assert found == alone


def test_what_does_not_belong_together_is_refused():
    with pytest.raises(SystemExit, match=r"baseline costs 100\.0 in the table, and 99\.0 beside"):
        compare(TABLE, observed_costs(rows_of(0, 50.0, 60.0, 99.0), {"1": TASK}), TASK)
    with pytest.raises(SystemExit, match="no world is in both"):
        compare(TABLE, observed_costs(ROWS[6:], {"1": TASK}), TASK)
    with pytest.raises(SystemExit, match="two rows with other costs"):
        observed_costs([*ROWS, row(0, "ideal-observer", 61.0)], {"1": TASK})
    with pytest.raises(SystemExit, match="an illegal move"):
        observed_costs([row(0, "known-map", 1.0, problems=["an illegal move"])], {"1": TASK})
