"""Settings chosen on validation worlds: the grid, rows that are kept, the comparison, the page."""

import dataclasses
import json

import numpy as np
import pytest

from eval.fair_settings.choosing import chosen_settings, compare, interval, results
from eval.fair_settings.confirming import confirm
from eval.fair_settings.report import write_report
from eval.fair_settings.running import CONFIRMING, ROWS, read_rows, run
from eval.fair_settings.settings import changes_of, grid, setting_of
from potlp_jax.codec import with_settings
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import world_key
from potlp_jax.errors import ConfigurationError
from potlp_jax.sweep.specification import specification_from_dict
from potlp_jax.trials.config import TrialConfig, trial_config_for
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.rules import trial_key
from potlp_jax.types import Status


def test_the_grid_has_every_combination_once_and_the_default_first():
    default = TrialConfig()
    own = setting_of(default)
    assert own == (2, 4.0, 0.15)
    assert grid("baseline", default, (1, 2), (4.0, 8.0), (0.0,)) == [
        (2, 4.0, 0.15),
        (1, 4.0, 0.15),
        (1, 8.0, 0.15),
        (2, 8.0, 0.15),
    ]
    searched = grid("potlp", default, (1, 2), (4.0, 8.0), (0.0,))
    assert searched[0] == own
    assert len(searched) == len(set(searched)) == 8
    assert setting_of(with_settings(default, changes_of((3, 9.0, 0.4)))) == (3, 9.0, 0.4)


def _row(setting, world, cost, task="1", outcome="satisfied"):
    known = {"is_default": setting == (2, 4.0, 0.15), "budget": 100.0, "status": 0, "estimator": None}
    return {"setting": list(setting), "task": task, "world": world, "cost": cost, "outcome": outcome, **known}


def test_a_better_setting_is_chosen_and_one_that_may_be_luck_is_not():
    default, other = (2, 4.0, 0.15), (1, 4.0, 0.15)
    possible = {("1", world) for world in range(40)}
    usual = [_row(default, world, 20.0 + world) for world in range(40)]
    better = [_row(other, world, 18.0 + world) for world in range(40)]
    found = compare([*usual, *better], possible)
    assert found["best"] == list(other)
    assert found["settings"][0]["difference"] == pytest.approx(-2.0)
    assert found["trials"] == found["worlds"] == 40
    lucky = [_row(other, world, (0.0 if world == 7 else 20.0) + world) for world in range(40)]
    found = compare([*usual, *lucky], possible)
    assert found["best"] == list(other)
    assert found["chosen"] == list(default)


def test_the_best_is_chosen_where_other_worlds_confirm_it():
    default, other = (2, 4.0, 0.15), (1, 4.0, 0.15)
    others = range(CONFIRMING, CONFIRMING + 40)
    possible = {("1", world) for world in (*range(40), *others)}
    rows = [_row(default, world, 20.0) for world in (*range(40), *others)]
    rows += [_row(other, world, 18.0) for world in range(40)]
    # As long as it has not run there nobody knows.
    found = compare(rows, possible)
    assert (found["best"], found["confirmed"], found["chosen"]) == (list(other), None, list(default))
    for cost, chosen in ((19.0, other), (21.0, default)):
        found = compare([*rows, *(_row(other, world, cost) for world in others)], possible)
        assert found["chosen"] == list(chosen)
        assert found["confirmed"]["difference"] == pytest.approx(cost - 20.0)
        # What chose it is what it was.
        assert found["settings"][0]["difference"] == pytest.approx(-2.0)
        assert found["trials"] == found["worlds"] == 40


def test_trials_that_were_cut_short_choose_nothing_and_estimators_are_not_mixed():
    default, other = (2, 4.0, 0.15), (1, 4.0, 0.15)
    possible = {("1", world) for world in range(9)}
    rows = [_row(default, world, 20.0) for world in range(9)]
    cut_short = [_row(other, world, 1.0) | {"status": int(Status.TREE_OVERFLOW)} for world in range(9)]
    assert compare([*rows, *cut_short], possible)["best"] == list(default)
    of_another = [_row(other, 0, 1.0) | {"estimator": "b"}]
    named = [row | {"policy": "potlp", "environment": "toy"} for row in (*rows, *of_another)]
    with pytest.raises(ConfigurationError, match="potlp in toy was run with several estimators, None, b"):
        compare(named, possible)


def test_only_pairs_count_and_a_trial_without_success_costs_its_budget():
    default, other, early = (2, 4.0, 0.15), (4, 4.0, 0.15), (1, 4.0, 0.15)
    rows = [_row(default, world, 10.0 + world) for world in range(3)]
    rows += [_row(other, 0, 12.0), _row(other, 1, 3.0, outcome="stuck"), _row(other, 2, 12.0), _row(other, 3, 0.0)]
    rows += [_row(early, 0, 1.0)]
    found = compare(rows, {("1", world) for world in range(4)})
    entries = {tuple(entry["setting"]): entry for entry in found["settings"]}
    assert entries[other]["trials"] == found["trials"] == 3
    assert entries[other]["mean_cost"] == pytest.approx((12.0 + 100.0 + 12.0) / 3)
    assert entries[other]["difference"] == pytest.approx((2.0 + 89.0 + 0.0) / 3)
    assert entries[other]["unsatisfied"] == 1
    # Far better where it was tried, but not tried everywhere.
    assert entries[early]["difference"] == pytest.approx(-9.0)
    assert found["best"] == found["chosen"] == list(default)
    # Where the task is impossible nobody is judged.
    assert compare(rows, {("1", 0)})["best"] == list(early)


def test_worlds_are_resampled_with_all_of_their_tasks():
    draw = np.random.default_rng(1)
    shifts = draw.normal(0.0, 1.0, 50)
    alone = interval(shifts, np.arange(50))
    # The same number four times in each world says no more than once.
    assert interval(np.repeat(shifts, 4), np.repeat(np.arange(50), 4)) == pytest.approx(alone)
    error = shifts.std() / np.sqrt(50)
    assert alone == pytest.approx((shifts.mean() - 1.96 * error, shifts.mean() + 1.96 * error), abs=0.25 * error)


@pytest.mark.long
def test_a_family_is_run_goes_on_where_it_was_killed_and_is_reported(tmp_path):
    toy = make("toy")
    values = ((), (2.0,), ())
    run(toy, ["baseline"], 3, tmp_path, values, tasks=["2"])
    rows = read_rows(tmp_path)
    # The known map once, the baseline with its default and with another distance.
    assert len(rows) == 3 * 3
    row = next(row for row in rows if row["policy"] == "baseline" and row["setting"][1] == 2.0 and row["world"] == 1)
    config = dataclasses.replace(trial_config_for(toy), replan_distance=2.0)
    world = toy.generate(world_key("validation", 1, "toy"))
    alone = run_trial(world, toy.task("2"), "baseline", trial_key(1), config)
    assert (row["cost"], row["outcome"]) == (alone.cost, str(alone.outcome))
    lines = (tmp_path / ROWS).read_text().splitlines(keepends=True)
    (tmp_path / ROWS).write_text("".join(lines[:-2]) + lines[-1][:20])
    run(toy, ["baseline"], 3, tmp_path, values, tasks=["2"])
    again = read_rows(tmp_path)
    assert len(again) == 9
    assert sorted(map(json.dumps, again)) == sorted(map(json.dumps, rows))
    # The default is the best: there is nothing to confirm.
    confirm(toy, ["baseline"], 2, tmp_path, tasks=["2"])
    assert len(read_rows(tmp_path)) == 9
    # Were the other one cheaper, both would run where nothing was chosen.
    other = tmp_path / "other"
    other.mkdir()
    cheaper = [row | {"cost": row["cost"] - (row["setting"][1] == 2.0)} for row in rows]
    (other / ROWS).write_text("".join(json.dumps(row) + "\n" for row in cheaper))
    confirm(toy, ["baseline"], 2, other, tasks=["2"])
    added = [row for row in read_rows(other) if row["policy"] == "baseline"][6:]
    assert {(row["setting"][1], row["world"]) for row in added} == {
        (distance, CONFIRMING + number) for distance in (2.0, 4.0) for number in range(2)
    }
    write_report(tmp_path, tmp_path / "fair")
    found = results(tmp_path)["families"]["toy"]
    assert found["policies"]["baseline"]["worlds"] == 3
    page = (tmp_path / "fair.md").read_text()
    assert "| toy | baseline | 3 | `min_size` 2, `replan_distance` 4 |" in page
    assert page.count("<!-- made: fair.json -->\n*Made by command: ") == 2
    # What was chosen is what a sweep takes.
    chosen = chosen_settings(tmp_path / "fair.json", "toy")
    swept = {"environments": ["toy"], "tasks": [2], "policies": ["baseline"], "worlds": 1, "policy_settings": chosen}
    specification = specification_from_dict(swept, "here")
    assert list(setting_of(specification.config_of("baseline"))) == found["policies"]["baseline"]["chosen"]
