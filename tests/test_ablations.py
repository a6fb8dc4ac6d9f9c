"""The ablation experiment: what is compared differs in one thing, and its page is made of rows that are known."""

import dataclasses
import itertools
import json

import pytest

from eval.ablations import report
from eval.ablations.report import page, results_of, write_report
from eval.ablations.running import POLICIES, SECONDS
from eval.ablations.variants import DATA_SETS, FAMILY, FIRST, START, VARIANTS
from potlp_jax.codec import settings_from_words, with_settings
from potlp_jax.environments.registry import make
from potlp_jax.learning.panorama_learner import PanoramaOptions
from potlp_jax.recipes.collection import CollectConfig
from potlp_jax.recipes.fitting import ESTIMATOR, FitConfig
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.store import Item, Row
from potlp_jax.types import Status

WHOLE = VARIANTS["whole"]


def fitted(variant):
    return with_settings(FitConfig(), settings_from_words(list(variant.network)), "--set")


@pytest.mark.parametrize("name", [name for name in VARIANTS if name != "whole"])
def test_each_variant_lacks_one_thing(name):
    variant, whole = VARIANTS[name], fitted(WHOLE)
    own = fitted(variant)
    changed = {
        field.name
        for field in dataclasses.fields(variant)
        if getattr(variant, field.name) != getattr(WHOLE, field.name)
    }
    assert changed - {"says"} in ({"data"}, {"network"}, {"epochs"})
    if isinstance(own.network, PanoramaOptions):
        return
    assert own.training == whole.training
    differing = [
        field.name
        for field in dataclasses.fields(own.network)
        if getattr(own.network, field.name) != getattr(whole.network, field.name)
    ]
    assert len(differing) == (changed - {"says"} == {"network"})


def test_data_sets_are_of_different_worlds_and_can_be_collected():
    for data in (*(variant.data for variant in VARIANTS.values()), START.data):
        assert set(data) <= set(DATA_SETS)
    for asked in DATA_SETS.values():
        with_settings(CollectConfig(), settings_from_words(list(asked.settings)), "--set")
        assert asked.driver in (None, FIRST)
    ranges = [(asked.split, range(asked.first, asked.first + asked.worlds)) for asked in DATA_SETS.values()]
    for (split, one), (other_split, other) in itertools.combinations(ranges, 2):
        assert split != other_split or not set(one) & set(other)


def rows_of(potlp_cost):
    """Three worlds of each task: known map 50, baseline 100, the policy what is given."""
    costs = dict(zip(POLICIES, (50.0, 100.0, potlp_cost), strict=True))
    return [
        Row(
            item=Item(FAMILY, task, policy, world),
            outcome="satisfied",
            cost=cost,
            budget=1000.0,
            steps=1,
            decisions=1,
            fallbacks=0,
            status=0,
            key=(0, 0),
            path="",
            configuration="",
            versions={},
            commit="1" * 40,
            seconds=1.0,
            world_digest="",
        )
        for task in make(FAMILY).tasks.values()
        for world in (7000, 7003, 7004)
        for policy, cost in costs.items()
    ]


@pytest.fixture
def finished(tmp_path, monkeypatch):
    """A folder in which three variants and the shipped file are finished."""
    costs = {"whole": 60.0, "no-map": 75.0, "one-epoch": 70.0, "shipped": 55.0}
    for name in costs:
        (tmp_path / "trials" / name).mkdir(parents=True)
        (tmp_path / "trials" / name / RESULTS).touch()
        if name != "shipped":
            (tmp_path / "fits" / name).mkdir(parents=True)
            (tmp_path / "fits" / name / ESTIMATOR).write_bytes(b"1234")
            (tmp_path / "fits" / name / SECONDS).write_text("120.0")
    monkeypatch.setattr(report, "read_rows", lambda folder: rows_of(costs[folder.name]))
    monkeypatch.setattr(report, "audit", lambda rows, generator, split: [])
    figures = {"samples": 10, "brier": 0.1, "skill": 0.75, "auc": 0.9, "calibration_error": 0.01}
    overall = figures | {"success_cost": {"r2": 0.5}, "failure_cost": {"r2": 0.25}}
    (tmp_path / "answers" / "whole" / "own").mkdir(parents=True)
    (tmp_path / "answers" / "whole" / "own" / "evaluation.json").write_text(
        json.dumps({"figures": {"intact": {"overall": overall}}})
    )
    return tmp_path


def test_shares_and_points_are_those_of_the_rows(finished):
    found = results_of(finished, ["own"])
    assert list(found["variants"]) == ["whole", "no-map", "one-epoch", "shipped"]
    assert found["worlds"] == [7000, 7003, 7004]
    assert report.mean_share(found["variants"]["whole"]) == pytest.approx(0.8)
    assert found["variants"]["whole"]["tasks"]["1"]["beside"] is None
    assert found["variants"]["no-map"]["tasks"]["3"]["beside"] == pytest.approx([-30.0] * 3)
    assert found["variants"]["shipped"]["tasks"]["2"]["beside"] == pytest.approx([10.0] * 3)
    text = page(found, ["own"], "ablations")
    assert "| **whole**: nothing left out | 2.0 | 80.0 % (80 to 80) |" in text
    assert "| no-map | -30.0 (-30 to -30) |" in text
    assert "| whole | own | 10 | 0.750 | 0.900 | 0.010 | 0.50 | 0.25 |" in text
    assert f"{4 * 4 * 3 * 3} trials were audited: 0 problems" in text


def test_trials_that_gave_up_or_were_cut_short_gain_nothing(finished, monkeypatch):
    def read_rows(folder):
        rows = rows_of(60.0 if folder.name == "whole" else 55.0)
        # Cheap, because it gave up; and cheap, because the search had no memory left.
        given_up = {"outcome": "stuck", "cost": 1.0} if folder.name == "no-map" else {}
        spoilt = [
            dataclasses.replace(row, **given_up) if (row.item.policy, row.item.world) == (POLICIES[-1], 7000) else row
            for row in rows
        ]
        cut = int(Status.TREE_OVERFLOW) if folder.name == "no-map" else 0
        return [dataclasses.replace(row, status=cut) if row.item.world == 7003 else row for row in spoilt]

    monkeypatch.setattr(report, "read_rows", read_rows)
    # The third world alone is left: 5 of 50 gained.
    assert results_of(finished, ["own"])["variants"]["no-map"]["tasks"]["3"]["beside"] == pytest.approx([10.0] * 3)


def test_a_second_fit_is_told_beside_the_first(finished):
    """Bold is what both fits tell from none, with the same sign."""
    found = results_of(finished, ["own"])
    before = json.loads(json.dumps(found))
    tasks = before["variants"]["no-map"]["tasks"]
    tasks["2"]["beside"], tasks["3"]["beside"], tasks["4"]["beside"] = [-8, -12, 2], [9, 4, 12], [-8, -12, -2]
    del before["variants"]["one-epoch"]
    beside = finished / "first.json"
    beside.write_text(json.dumps(before))
    text = page(found, ["own"], "ablations", beside)
    assert (
        "| no-map | **-30, -30** | -30, -8 | -30, +9 | **-30, -8** |\n\n<!-- made: ablations.json, first.json -->"
        in text
    )
    assert text.count("| one-epoch |") == 1
    assert "second fit" not in page(found, ["own"], "ablations")


def test_the_report_is_three_files(finished):
    write_report(finished, ["own"], finished / "ablations")
    assert json.loads((finished / "ablations.json").read_text())["audited"] == 144
    assert (finished / "ablations.png").read_bytes().startswith(b"\x89PNG")
    assert "commit: `1111111`" in (finished / "ablations.md").read_text()
