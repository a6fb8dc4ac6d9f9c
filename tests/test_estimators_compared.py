"""``eval.estimators``: the stages of a recipe with their minutes, and what is shown of a comparison."""

import pytest

from eval.estimators import draw, lines, stages
from potlp_jax.recipes.recipe import TIMES


def _table(share):
    row = {
        "policy": "potlp",
        "mean_cost": 10.0,
        "net_savings": 0.2,
        "attainable_share": share,
        "attainable_low": share - 0.1,
        "attainable_high": share + 0.05,
        "trial_savings": 0.1,
        "trial_savings_error": 0.02,
    }
    return {"satisfied": {"rows": [row]}}


@pytest.fixture
def found():
    def entry(minutes, skill, share):
        tables = {"1": _table(share), "2": _table(share / 2)}
        return {"minutes": minutes, "skill": skill, "tables": tables, "seconds_per_decision": 0.0124}

    return {"estimators": {"round 0": entry(12.0, 0.5, 0.6), "round 1": entry(40.4, None, 0.8)}}


def test_a_stage_costs_what_was_spent_up_to_it_over_all_runs(tmp_path):
    (tmp_path / TIMES).write_text("0,training,30.0\n0,validation,6.0\n0,training,0.5\n0,fit,23.5\n1,fit,60.0\n")
    found = stages(tmp_path)
    assert {name: seconds for name, (_, seconds) in found.items()} == {"round 0": 60.0, "round 1": 120.0}
    assert [file.relative_to(tmp_path).as_posix() for file, _ in found.values()] == [
        "round-0/estimator.npz",
        "estimator.npz",
    ]


def test_a_line_has_every_task_and_leaves_open_what_was_not_measured(found):
    head, _, first, second = lines(found)
    assert head == "| estimator | minutes | skill | task 1 | task 2 | ms a decision |"
    assert first == "| round 0 | 12 | 0.500 | 60.0 % (50 to 65) | 30.0 % (20 to 35) | 12 |"
    assert second == "| round 1 | 40 |  | 80.0 % (70 to 85) | 40.0 % (30 to 45) | 12 |"


def test_shares_are_drawn_over_minutes(found, tmp_path):
    draw(found, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 5000
