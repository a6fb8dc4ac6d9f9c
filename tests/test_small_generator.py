"""An estimator without campus buildings beside the recipe's own: as many buildings, and worlds paired."""

import dataclasses
import json

import numpy as np
import pytest

from eval.delivery import WITHOUT_ORACLE
from eval.savings import pairs_of, write_specification
from eval.small_generator import CAMPUS, SMALL, compare, markdown, without_campus
from potlp_jax.codec import json_copy
from potlp_jax.recipes.recipe import read_recipe
from potlp_jax.sweep.store import Item, Row
from potlp_jax.types import Status


def row(world, policy, cost, outcome="satisfied", status=0):
    item = Item(environment="delivery", task="F professor", world=world, policy=policy)
    return Row(item, outcome, cost, 999.0, 1, 1, 0, status, (0, 0), "", "", {}, "", 0.0, "")


def rows_of(world, known, ours, baseline):
    return [row(world, "known-map", known), row(world, "potlp", ours), row(world, "baseline", baseline)]


def test_as_many_small_floors_stand_in_place_of_campus_buildings():
    recipe = read_recipe("delivery")
    small = without_campus(recipe)
    assert recipe.beside
    assert (small.beside, small.rounds) == ((), ())
    # 2,400 floors, 240 buildings of a tenth and 120 of a twentieth.
    assert small.training_worlds == 2760
    assert (small.fit, small.collect) == (recipe.fit, recipe.collect)


def test_the_recipe_can_be_written_and_read(tmp_path):
    file = tmp_path / "recipe.yaml"
    small = without_campus(read_recipe("delivery"))
    file.write_text(json.dumps(json_copy(dataclasses.asdict(small))))
    assert read_recipe(file) == small


def test_an_estimator_is_named_beside_where_the_command_is_given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.npz").touch()
    for given, written in (("own.npz", str(tmp_path / "own.npz")), ("firefighting", "firefighting")):
        file = write_specification(tmp_path / "trials", {"worlds": 1, "estimator": given})
        assert json.loads(file.read_text()) == {"worlds": 1, "estimator": written}
    assert json.loads(write_specification(tmp_path / "trials", {"worlds": 1}).read_text()) == {"worlds": 1}


def test_pairs_have_every_policy_satisfied_and_reliable():
    rows = [
        *rows_of(0, 1.0, 2.0, 3.0),
        *rows_of(1, 1.0, 2.0, 3.0)[:2],
        *rows_of(2, 1.0, 2.0, 3.0)[:2],
        row(2, "baseline", 3.0, outcome="stuck"),
        *rows_of(3, 1.0, 2.0, 3.0)[:2],
        row(3, "baseline", 3.0, status=int(Status.TREE_OVERFLOW)),
    ]
    assert pairs_of(rows, WITHOUT_ORACLE) == {0: {"known-map": 1.0, "baseline": 3.0, "potlp": 2.0}}


def test_arms_are_compared_in_the_worlds_of_both(monkeypatch):
    monkeypatch.setattr("eval.small_generator.audit", lambda rows, generator, split: [])
    campus = [*rows_of(0, 50.0, 60.0, 100.0), *rows_of(1, 50.0, 60.0, 100.0), *rows_of(2, 1.0, 9.0, 9.0)]
    small = [*rows_of(0, 50.0, 80.0, 100.0), *rows_of(1, 50.0, 60.0, 100.0)]
    found = compare("delivery", {CAMPUS: campus, SMALL: small})
    assert (found["worlds"], found["buildings"], found["audited"]) == (2, 2, 15)
    # Of 100 to be saved the one keeps 80, the other 60.
    assert found["share"][CAMPUS] == pytest.approx([0.8, 0.8, 0.8])
    assert found["share"][SMALL] == pytest.approx([0.6, 0.4, 0.8])
    assert found["gain"] == pytest.approx([0.2, 0.0, 0.4])
    assert np.isclose(found["mean_cost"][SMALL], 70.0)
    assert (
        "| generated | 2 in 2 buildings | 50 | 100 | 80.0 (80 to 80) % | 60.0 (40 to 80) % | +20.0 (+0 to +40) |"
        in (markdown({"generated": found}))
    )
