"""The limit of estimates: mixed estimators, and what the report makes of rows."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from eval.limit.arms import Arm, Experiment, key_of, missing_rows
from eval.limit.mixed import mixed
from eval.limit.report import markdown, page, results_of
from eval.limit.rows import read_rows
from eval.limit.running import run
from eval.limit.worst import Loss, cause_of, worst_of
from eval.limit.worst import results_of as worst_results
from eval.provenance import lines_of
from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.environments.firefighting_layout import (
    FirefightingConfig,
)
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.environments.toy import Toy
from potlp_jax.learning.observing import observe_panorama
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.policies import Policy, direct_move
from potlp_jax.planning.situation import assess
from potlp_jax.sweep.store import Item, Row
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome
from potlp_jax.types import Status
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig, observe

CONFIG = FirefightingConfig(
    room_width=4, room_height=9, hallway_length=8, hallway_width=1, hallway_spacing=3, smoke_reach=0.5
)
FAMILY = Firefighting(CONFIG)
SENSOR = SensorConfig(range_cells=6.0)
FRONTIERS = FrontierConfig(max_subgoals=6)
assess_jit = jax.jit(assess, static_argnames="config")
NO_PANORAMA = jnp.zeros((1, 1, 3), jnp.uint8)


@struct.dataclass(kw_only=True)
class Counting:
    """Answers with how many panoramas it has seen, times a factor."""

    memory: jax.Array
    factor: jax.Array

    def encode(self, panorama):
        return jnp.int32(1)

    def remember(self, seen, belief, cell):
        return dataclasses.replace(self, memory=self.memory + seen)

    def __call__(self, belief, subgoals, task):
        value = jnp.broadcast_to(
            self.factor * self.memory.astype(jnp.float32), (subgoals.mask.shape[0], task.class_mask.shape[0])
        )
        return Estimates(
            success_probability=value / (1.0 + value), success_cost=value, failure_cost=2 * value, status=jnp.uint32(4)
        )


def _counting(factor):
    return Counting(memory=jnp.int32(0), factor=jnp.float32(factor))


@struct.dataclass(kw_only=True)
class Decided:
    """Observes nothing; the first class is impossible, the last one certain, of the others nobody knows."""

    def __call__(self, belief, subgoals, task):
        shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
        chance = jnp.full(shape, 0.5).at[:, 0].set(0.0).at[:, -1].set(1.0)
        return Estimates(
            success_probability=chance, success_cost=jnp.full(shape, 50.0), failure_cost=jnp.full(shape, 9.0)
        )


def _answers(estimator):
    world = FAMILY.world(0, "training")
    belief = observe(BeliefMap.unobserved(world), world, world.start, SENSOR)
    task = FAMILY.task("3").arrays
    subgoals = assess_jit(belief, world.start, task.initial, task, config=FRONTIERS).subgoals
    for _ in range(3):
        estimator = observe_panorama(estimator, NO_PANORAMA, belief, world.start)
    return estimator(belief, subgoals, task)


def test_a_mixture_takes_each_part_from_the_right_one():
    found = _answers(mixed(_counting(1.0), _counting(10.0)))
    np.testing.assert_allclose(found.success_probability, 3 / 4)
    np.testing.assert_allclose(found.success_cost, 30.0)
    np.testing.assert_allclose(found.failure_cost, 60.0)
    assert int(found.status) == 4


def test_costs_that_the_second_cannot_have_are_the_firsts():
    found = _answers(mixed(_counting(1.0), Decided()))
    np.testing.assert_allclose(found.success_probability, 3 / 4)
    np.testing.assert_allclose(found.success_cost[:, 0], 3.0)
    np.testing.assert_allclose(found.success_cost[:, 1:], 50.0)
    np.testing.assert_allclose(found.failure_cost[:, :-1], 9.0)
    np.testing.assert_allclose(found.failure_cost[:, -1:], 6.0)
    other = _answers(mixed(Decided(), _counting(1.0)))
    np.testing.assert_allclose(other.success_probability[:, 0], 0.0)
    np.testing.assert_allclose(other.success_cost, 3.0)


@pytest.mark.long
def test_a_mixture_is_a_pytree_that_goes_through_batches():
    # Each slot has the memories of both parts, and they count on their own.
    task = FAMILY.task("4")
    worlds = [FAMILY.generate(world_key("training", index, FAMILY.name)) for index in range(2)]
    estimator = mixed(_counting(0.5), _counting(4.0))
    starts = [Start(world, task.arrays, jax.random.key(0), name=name) for name, world in enumerate(worlds)]
    together = {trial.name: trial for trial in run_batch(starts, by_count, slots=2, estimator=estimator)}
    for name, world in enumerate(worlds):
        alone = run_trial(world, task, by_count, jax.random.key(0), estimator=estimator)
        assert alone.outcome is Outcome.SATISFIED
        assert len(alone.decisions) > 2
        assert [tuple(cell) for cell in together[name].path.tolist()] == list(alone.path)


def by_count(situation, estimates, key, config, intention):
    """The baseline's move in the first decisions; later one that does without frontiers, as the estimates say."""
    few = jnp.max(estimates.failure_cost) < 20.0
    moves = [direct_move(situation, policy, config) for policy in (Policy.BASELINE, Policy.OPTIMISTIC)]
    return jax.tree.map(lambda one, other: jnp.where(few, one, other), *moves)


class Worlds:
    """An experiment without trials: the task is possible in worlds of even number."""

    tasks = ("1", "2")

    def __init__(self, identity=""):
        self.identity, self.ran = identity, []

    def key(self, task, number, arm):
        return ("toy", "test", task, number, arm.value, self.identity if arm.asks_trained else "", f"digest {number}")

    def row(self, task, number, arm):
        self.ran.append((task, number, arm))
        names = ("environment", "split", "task", "world", "arm", "identity", "world_digest")
        possible = number % 2 == 0
        outcome = Outcome.SATISFIED if possible else Outcome.INFEASIBLE
        return dict(zip(names, self.key(task, number, arm), strict=True)) | {"outcome": outcome.value, "cost": 1.0}


def test_a_run_goes_on_where_it_was_stopped(tmp_path):
    file = tmp_path / "out" / "trials.jsonl"
    arms = [Arm.POTLP]
    whole = list(missing_rows(Worlds(), arms, 2, []))
    assert {(row["task"], row["world"]) for row in whole if row["arm"] == Arm.POTLP} == {
        (task, number) for task in ("1", "2") for number in (0, 2)
    }
    assert {row["world"] for row in whole if row["arm"] == Arm.KNOWN_MAP} == {0, 1, 2}
    file.parent.mkdir()
    # Cut off in the middle of a line.
    text = "".join(json.dumps(row) + "\n" for row in whole[:5])
    file.write_text(text + json.dumps(whole[5])[:20])
    rest = Worlds()
    run(file, rest, arms, 2)
    assert [key_of(row) for row in read_rows(file)] == [key_of(row) for row in whole]
    assert len(rest.ran) == len(whole) - 5
    run(file, rest, arms, 2)
    assert len(rest.ran) == len(whole) - 5
    # Another estimator: what asks it runs again, and nothing else.
    other = Worlds("another")
    run(file, other, arms, 2)
    assert {arm for *_, arm in other.ran} == {Arm.POTLP}


def _row(arm, world, cost, **changes):
    return {
        "environment": "firefighting",
        "split": "test",
        "task": "1",
        "world": world,
        "arm": arm.value,
        "identity": "net 1" if arm.asks_trained else "",
        "outcome": "satisfied",
        "cost": cost,
        "budget": 1000.0,
        "status": 0,
        "decisions": 10,
        "fallbacks": 0,
        "seconds": 5.0,
        "problems": [],
        "versions": {},
        "commit": "1" * 40,
        **changes,
    }


COSTS = {Arm.KNOWN_MAP: 100.0, Arm.TRUE_CHANCES: 120.0, Arm.TRUE_COSTS: 210.0, Arm.POTLP: 180.0, Arm.BASELINE: 200.0}


def test_shares_and_what_each_part_brings(tmp_path):
    rows = [_row(arm, world, cost) for world in range(4) for arm, cost in COSTS.items()]
    # A world in which an arm is missing is compared for none; an impossible one has a row of the known map alone.
    rows += [_row(Arm.POTLP, 9, 1.0), _row(Arm.KNOWN_MAP, 8, 1.0, outcome="infeasible")]
    results = results_of(rows, {"1": "F a"})
    table = results["tables"]["1"]
    assert table["world_numbers"] == [0, 1, 2, 3]
    assert table["costs"]["potlp"] == [180.0] * 4
    shares = {row["policy"]: row["attainable_share"] for row in table["satisfied"]["rows"]}
    assert {arm: round(share, 9) for arm, share in shares.items()} == {
        "known-map": 1.0,
        "true-chances": 0.8,
        "true-costs": -0.1,
        "potlp": 0.2,
        "baseline": 0.0,
    }
    assert np.isclose(table["gains"]["true-chances"]["gain"], 0.6)
    assert np.isclose(table["gains"]["true-chances"]["low"], 0.6)
    assert np.isclose(table["gains"]["true-costs"]["gain"], -0.3)
    data = tmp_path / "limit.json"
    data.write_text(json.dumps(results))
    text = page(results, data)
    assert "true P_S add 60.0 points and true R_S and R_F take 30.0 points" in text
    assert "Of these differences true P_S in task 1, true R_S and R_F in task 1 alone can be told from none." in text
    wide = {"gain": 0.6, "low": -0.1, "high": 0.9}
    table = {**results["tables"]["1"], "gains": {"true-chances": wide, "true-costs": wide}}
    assert "none of true P_S or of true R_S and R_F can be told from none." in page(
        {**results, "tables": {"1": table}}, data
    )
    assert lines_of(text, tmp_path) == text
    assert text.count("<!-- made: limit.json -->\n*Made by") == 2
    assert page(json.loads(data.read_text()), data) == text
    assert "| 20.0 % (20 to 20) |" in text
    assert "| +60.0 (+60 to +60) |" in text
    # Of floors the observer has the plan; the command is the one that was given.
    given = {**results["provenance"], "command": "python -m eval.limit --out x --as-it-is --worlds 5"}
    floors = page({**results, "environment": "delivery", "provenance": given}, data)
    assert "# The limit of estimates: delivery" in floors
    assert "```sh\npython -m eval.limit --out x --worlds 5\n```" in floors
    # Without PO-TLP there is nothing that gains are over.
    without = results_of([row for row in rows if row["arm"] != Arm.POTLP], {"1": "F a"})
    assert markdown(without).count("| task |") == 1
    # One building has no interval.
    assert "| 20.0 % (no interval) |" in page(results_of(rows[:5], {"1": "F a"}), data)


def test_a_trial_that_does_not_end_is_in_no_gain():
    rows = [_row(arm, world, cost) for world in range(3) for arm, cost in COSTS.items()]
    rows += [
        _row(arm, 3, 7 * cost, outcome="budget" if arm is Arm.POTLP else "satisfied") for arm, cost in COSTS.items()
    ]
    table = results_of(rows, {"1": "F a"})["tables"]["1"]
    assert table["satisfied"]["pairs"] == 3
    assert np.isclose(table["gains"]["true-chances"]["gain"], 0.6)


def test_the_worst_trials_are_those_that_lose_most():
    def row(task, world, policy, cost):
        item = Item("firefighting", task, policy, world)
        return Row(item, "satisfied", float(cost), 99.0, 1, 1, 0, 0, (1, 2), "p", "c", {}, "", 0.0, "d")

    rows = [
        row(task, world, policy, cost)
        for task, world, costs in (("F a", 0, (10, 30, 12)), ("F a", 1, (10, 30, 25)), ("F b", 0, (5, 45, 15)))
        for policy, cost in zip(("known-map", "baseline", "potlp"), costs, strict=True)
    ]
    # One that gave up early was not cheap.
    stuck = [
        dataclasses.replace(row("F c", 0, policy, cost), outcome=outcome)
        for policy, cost, outcome in (
            ("known-map", 10, "satisfied"),
            ("baseline", 30, "satisfied"),
            ("potlp", 3, "stuck"),
        )
    ]
    (loss,) = worst_of(stuck, {"3": "F c"}, 5)
    assert (loss.potlp, loss.lost) == (99.0, 89.0)
    found = worst_of(rows, {"1": "F a", "2": "F b"}, 2)
    assert [(loss.task, loss.world, loss.lost) for loss in found] == [("1", 1, 15), ("2", 0, 10)]
    # Of all that is to be saved in the task, 40 cells in either.
    assert [round(loss.points, 6) for loss in found] == [37.5, 25.0]


def test_a_trial_with_other_answers_that_gives_up_cures_nothing():
    loss = Loss(task="1", world=0, known_map=10.0, baseline=300.0, potlp=200.0, points=1.0)
    stuck = _row(Arm.TRUE_CHANCES, 0, 40.0, outcome="stuck", world_digest="a")
    costs = _row(Arm.TRUE_COSTS, 0, 12.0, world_digest="a")
    (trial,) = worst_results([loss], [stuck, costs], "cells")["trials"]
    assert (trial["costs"]["true-chances"], trial["cause"]) == (1000.0, "R_S and R_F")
    cut_short = {**costs, "status": int(Status.TREE_OVERFLOW)}
    (trial,) = worst_results([loss], [stuck, cut_short], "cells")["trials"]
    assert (list(trial["costs"]), trial["cause"]) == (["true-chances"], "more than one answer")


def test_where_nothing_can_be_compared_the_page_says_so(tmp_path):
    rows = [_row(arm, 0, 100.0) for arm in COSTS]
    results = results_of(rows, {"1": "F a", "2": "F b"})
    (tmp_path / "limit.json").write_text(json.dumps(results))
    text = page(results, tmp_path / "limit.json")
    assert "Task 1: no world to compare, or nothing to be saved." in text
    assert "Task 2: no world to compare, or nothing to be saved." in text


def test_trials_in_other_worlds_of_one_name_are_other_trials():
    def key(seed):
        class Other(Toy):
            def draw(self, key):
                return super().draw(jax.random.fold_in(key, seed))

        return Experiment(Other(), Split.TEST, ("1",), None, 8).key("1", 0, Arm.BASELINE)

    assert key(0)[:-1] == key(1)[:-1]
    assert key(0) != key(1)


@pytest.mark.parametrize(
    ("costs", "cause"),
    [
        ((10, 20, 12, 30, 19), "P_S"),
        ((10, 20, 18, 12, 19), "R_S and R_F"),
        ((10, 20, 19, 19, 12), "several answers at once"),
        ((10, 20, 19, 19, 19), "not to be seen"),
    ],
)
def test_a_cause_is_what_cures_at_least_half_of_a_loss(costs, cause):
    known, potlp, chances, true_costs, ideal = costs
    loss = Loss(task="1", world=0, known_map=known, baseline=30, potlp=potlp, points=1.0)
    found = {Arm.TRUE_CHANCES: chances, Arm.TRUE_COSTS: true_costs, Arm.IDEAL_OBSERVER: ideal}
    assert cause_of(loss, found) == cause
    # Of a family without an ideal observer nobody knows what all answers together could do.
    del found[Arm.IDEAL_OBSERVER]
    unknown = ("several answers at once", "not to be seen")
    assert cause_of(loss, found) == ("more than one answer" if cause in unknown else cause)
