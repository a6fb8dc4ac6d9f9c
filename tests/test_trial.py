"""Whole trials on small worlds: every promise of docs/model.md section 7, checked by the independent evaluator."""

import dataclasses
import json
import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.formulas import random_tasks
from potlp_jax.codec import config_from_dict
from potlp_jax.environments.rooms import Rooms
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import PluginError, RecordError
from potlp_jax.files import write_whole
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
from potlp_jax.learning.observing import observe_panorama
from potlp_jax.planning import policies
from potlp_jax.planning.move import MoveKind
from potlp_jax.planning.policies import Policy, decide
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.task.task import Task, TaskSizes
from potlp_jax.trials import loop as trial_module
from potlp_jax.trials import robot
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome, load_trial, record_checksum
from potlp_jax.trials.replay import replay_decision
from potlp_jax.trials.robot import Leg, SimulatedRobot
from potlp_jax.trials.setbacks import SetbackConfig, Setbacks
from potlp_jax.types import NO_STATE, Status
from potlp_jax.verify.audit import problems_of, satisfaction_is_promised
from potlp_jax.view.decisions import task_of
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import BeliefMap, belief_from_numpy, make_world, pad_world
from potlp_jax.world.sensing import SensorConfig
from tests.reference.domains import domain_of

SIZES = TaskSizes(states=6, propositions=3, edges=9, classes=9, compound=3, cubes=3)
CONFIG = TrialConfig(
    sensor=SensorConfig(range_cells=6.0),
    decision=DecisionConfig(
        frontiers=FrontierConfig(max_subgoals=6), search=BestFirstConfig(simulations=200), path_horizon=64
    ),
)

ROOMS = Rooms.toy()
ROOMS_SHAPE = (ROOMS.config.largest, ROOMS.config.largest)
TASKS = random_tasks(10, ROOMS.propositions, SIZES, seed=3)


def _untrained(propositions):
    """A small network of random parameters: promises hold whatever the estimates say."""
    config = NetworkConfig(
        propositions=propositions, first_widths=(4,) * 4, second_widths=(4,) * 8, dense_widths=(8,) * 4
    )
    params = EstimatorNetwork(config).init(jax.random.key(0))
    return TrainedEstimator(
        params=params, config=config, domain=domain_of("rooms"), metadata={}, name="untrained", digest=""
    )


UNTRAINED = _untrained(ROOMS.propositions)


def _run(world, task, policy, seed, config=CONFIG):
    arrays = task.padded(SIZES)
    return run_trial(world, task, policy, jax.random.key(seed), config, arrays=arrays, estimator=UNTRAINED)


@pytest.mark.long
@pytest.mark.parametrize("policy", list(Policy))
def test_trials_keep_their_promises(policy):
    satisfied = 0
    for number, task in enumerate(TASKS):
        world = ROOMS.generate(world_key(Split.VALIDATION, number, "rooms"))
        trial = _run(world, task, policy, number)
        assert problems_of(trial, task, world) == []
        satisfied += trial.outcome is Outcome.SATISFIED
    assert satisfied >= len(TASKS) // 2


def test_an_episode_compiles_nothing_new():
    """After one trial of each policy, another world and another task run with the programs that are there."""
    rules = (trial_module._first_tally, trial_module._arrive, trial_module._stop_of, trial_module._count_decision)
    programs: tuple[Any, ...] = (
        trial_module._decide,
        *rules,
        robot.follow,
        robot._observe,
        robot.photograph,
        observe_panorama,
    )

    def run_all(number):
        for policy in Policy:
            world = ROOMS.generate(world_key(Split.VALIDATION, number, "rooms"))
            _run(world, TASKS[number], policy, number)
        return [program._cache_size() for program in programs]

    assert run_all(0) == run_all(1)


def test_one_compilation_for_all_worlds_and_tasks():
    calls = 0

    def counted(*arguments, **settings):
        nonlocal calls
        calls += 1
        return decide(*arguments, **settings)

    compiled = jax.jit(counted, static_argnames=("policy", "config"))
    for number, task in enumerate(TASKS[:3]):
        world = ROOMS.generate(world_key(Split.VALIDATION, number, "rooms"))
        belief = BeliefMap.revealed(world)
        compiled(
            belief,
            world.start,
            jnp.int32(0),
            task.padded(SIZES),
            None,
            jax.random.key(0),
            policy=Policy.BASELINE,
            config=CONFIG.decision,
        )
    assert calls == 1


@pytest.mark.parametrize("policy", list(Policy))
def test_on_a_revealed_map_every_policy_costs_the_known_map_cost(policy):
    revealed = dataclasses.replace(CONFIG, revealed=True)
    compared = 0
    for number, task in enumerate(TASKS):
        world = ROOMS.generate(world_key(Split.VALIDATION, number, "rooms"))
        known = _run(world, task, Policy.KNOWN_MAP, 0)
        if known.outcome is Outcome.SATISFIED and known.decisions:
            trial = _run(world, task, policy, 0, revealed)
            assert trial.cost == pytest.approx(known.cost, rel=1e-9)
            compared += 1
    assert compared >= 3


def test_padding_the_world_changes_nothing():
    world = ROOMS.generate(world_key(Split.VALIDATION, 1, "rooms"))
    task = TASKS[4]
    small = _run(world, task, Policy.ORACLE, 0)
    height, width = world.shape
    large = _run(pad_world(world, height + 5, width + 7), task, Policy.ORACLE, 0)
    assert small.outcome is Outcome.SATISFIED
    assert large.path == small.path
    assert [decision.choice for decision in large.decisions] == [decision.choice for decision in small.decisions]


def test_the_same_key_gives_the_same_trial_and_records_round_trip(tmp_path):
    world = ROOMS.generate(world_key(Split.VALIDATION, 2, "rooms"))
    first, second = (_run(world, TASKS[0], Policy.ORACLE, 5) for _ in range(2))
    assert first.to_dict() == second.to_dict()
    first.save(tmp_path / "trial.json")
    loaded = load_trial(tmp_path / "trial.json")
    assert json.dumps(loaded.to_dict()) == json.dumps(first.to_dict())
    assert config_from_dict(TrialConfig, loaded.config, "trial record") == CONFIG


def test_a_decision_is_replayed_from_its_record():
    world = ROOMS.generate(world_key(Split.VALIDATION, 3, "rooms"))
    task = next(task for task in TASKS if len(task.edges) >= 2)
    trial = _run(world, task, Policy.ORACLE, 1)
    searched = [decision for decision in trial.decisions if decision.actions]
    assert searched
    decision = searched[-1]
    problem, plan, _ = replay_decision(trial, decision.index)
    problem.check()
    assert int(plan.action) == decision.choice
    for action in decision.actions:
        assert float(plan.q_values[action.index]) == action.q_value
    with pytest.raises(ValueError, match="no decision 9999"):
        replay_decision(trial, 9999)


def test_a_record_of_a_task_without_positive_literals_is_read_again(tmp_path):
    task = Task.from_formula("F !hazard", Toy().propositions, 0)
    trial = run_trial(Toy().world(0), task, Policy.BASELINE, jax.random.key(0))
    trial.save(tmp_path / "trial.json")
    assert load_trial(tmp_path / "trial.json").max_positive_literals == 0


def test_a_decision_is_replayed_with_the_edges_that_were_left_out(tmp_path):
    world = Toy().world(0)
    whole, limited = (Task.from_formula("F goal & F hazard", world.propositions, limit) for limit in (None, 1))
    assert whole.sizes.edges > limited.sizes.edges
    trial = run_trial(world, limited, Policy.ORACLE, jax.random.key(0))
    trial.save(tmp_path / "trial.json")
    read = load_trial(tmp_path / "trial.json")
    assert read.max_positive_literals == task_of(read).max_positive_literals == 1
    decision = next(decision for decision in read.decisions if decision.actions)
    _, plan, _ = replay_decision(read, decision.index)
    found = np.flatnonzero(np.isfinite(np.asarray(plan.q_values)))
    recorded = {action.index: action.q_value for action in decision.actions}
    assert {index: float(plan.q_values[index]) for index in found.tolist()} == recorded
    # Records from before it was kept.
    data = json.loads((tmp_path / "trial.json").read_text())
    del data["max_positive_literals"]
    (tmp_path / "trial.json").write_text(json.dumps({**data, "checksum": record_checksum(data)}))
    before = dataclasses.replace(read, max_positive_literals=None)
    assert load_trial(tmp_path / "trial.json").to_dict() == before.to_dict()


def test_what_is_written_whole_may_go_into_a_pipe():
    code = "from pathlib import Path; from potlp_jax.files import write_whole; write_whole(Path('/dev/stdout'), 'all')"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout == b"all"


def test_what_is_written_whole_stays_writable_for_those_it_is_shared_with(tmp_path):
    path = tmp_path / "labels.yaml"
    path.write_text("before")
    path.chmod(0o664)
    write_whole(path, "after")
    assert path.read_text() == "after"
    assert stat.S_IMODE(path.stat().st_mode) == 0o664


def test_what_is_written_whole_may_have_as_long_a_name_as_a_file_may(tmp_path):
    # In UTF-8 a letter of two bytes, so that the beginning is cut within one.
    path = tmp_path / ("x" + "ü" * 127)
    write_whole(path, "all")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["all"]


def test_a_record_that_cannot_be_written_leaves_the_one_before(tmp_path, monkeypatch):
    path = tmp_path / "trial.json"
    trial = _run(ROOMS.generate(world_key(Split.VALIDATION, 0, "rooms")), TASKS[0], Policy.BASELINE, 0)
    trial.save(path)
    before = path.read_text()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", full)
        with pytest.raises(OSError, match="No space left"):
            dataclasses.replace(trial, notes=("another",)).save(path)
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]
    # Where there is no file to be replaced it is written to, and a link stays one.
    trial.save(Path(os.devnull))
    assert not Path(os.devnull).is_file()
    link = tmp_path / "link.json"
    link.symlink_to(path)
    dataclasses.replace(trial, notes=("another",)).save(link)
    assert link.is_symlink()
    assert load_trial(path).notes == ("another",)


def test_a_record_names_status_bits(tmp_path):
    trial = _run(ROOMS.generate(world_key(Split.VALIDATION, 0, "rooms")), TASKS[0], Policy.BASELINE, 0)
    bits = Status.SUBGOAL_OVERFLOW | Status.FALLBACK
    decisions = (dataclasses.replace(trial.decisions[0], status=int(bits)), *trial.decisions[1:])
    dataclasses.replace(trial, status=int(bits), decisions=decisions).save(tmp_path / "trial.json")
    data = json.loads((tmp_path / "trial.json").read_text())
    assert data["status"] == data["decisions"][0]["status"] == ["subgoal_overflow", "fallback"]
    read = load_trial(tmp_path / "trial.json")
    assert read.status == read.decisions[0].status == bits
    data["status"] = ["overflow"]
    (tmp_path / "trial.json").write_text(json.dumps(data))
    with pytest.raises(RecordError, match="damaged"):
        load_trial(tmp_path / "trial.json")


def test_damaged_records_are_refused(tmp_path):
    path = tmp_path / "trial.json"
    with pytest.raises(RecordError, match="cannot be read"):
        load_trial(path)
    path.write_text("[]")
    with pytest.raises(RecordError, match="not a trial record"):
        load_trial(path)
    path.write_text(json.dumps({"format": "potlp-trial-1"}))
    with pytest.raises(RecordError, match=r"found 'potlp-trial-1'\); run `potlp run` again"):
        load_trial(path)
    path.write_text(json.dumps({"format": "potlp-trial-3"}))
    with pytest.raises(RecordError, match="its checksum differs"):
        load_trial(path)
    world = ROOMS.generate(world_key(Split.VALIDATION, 0, "rooms"))
    data = _run(world, TASKS[0], Policy.ORACLE, 0).to_dict()
    # A value that could be true: the checksum alone tells.
    path.write_text(json.dumps({**data, "cost": data["cost"] + 1, "checksum": record_checksum(data)}))
    with pytest.raises(RecordError, match="damaged, or was changed by hand"):
        load_trial(path)
    data["decisions"][0]["preferred"] = 999
    path.write_text(json.dumps({**data, "checksum": record_checksum(data)}))
    with pytest.raises(RecordError, match="preferred 999 is none of its actions"):
        load_trial(path)


def test_a_start_that_violates_is_infeasible_without_a_move():
    letters = np.zeros((5, 5), np.int32)
    letters[2, 2] = 2
    letters[1, 1] = 1
    world = make_world(
        np.pad(np.zeros((3, 3), bool), 1, constant_values=True), letters, (2, 2), propositions=("a", "b")
    )
    task = world.task("!b U a")
    trial = run_trial(world, task, Policy.BASELINE, jax.random.key(0), CONFIG)
    assert trial.outcome is Outcome.INFEASIBLE
    assert trial.cost == 0.0
    assert len(trial.path) == 1
    assert problems_of(trial, task, world) == []


def test_a_start_that_satisfies_costs_nothing():
    letters = np.zeros((5, 5), np.int32)
    letters[2, 2] = 1
    world = make_world(np.pad(np.zeros((3, 3), bool), 1, constant_values=True), letters, (2, 2), propositions=("a",))
    trial = run_trial(world, world.task("F a"), Policy.ORACLE, jax.random.key(0), CONFIG)
    assert (trial.outcome, trial.cost, trial.decisions) == (Outcome.SATISFIED, 0.0, ())


def test_a_task_that_this_world_cannot_fulfil_ends_infeasible():
    nothing = np.zeros((5, 5), np.int32)
    occupied = np.pad(np.zeros((3, 3), bool), 1, constant_values=True)
    world = make_world(occupied, nothing, (2, 2), propositions=ROOMS.propositions)
    task = world.task("F a")
    trial = _run(pad_world(world, *ROOMS_SHAPE), task, Policy.BASELINE, 0)
    assert trial.outcome is Outcome.INFEASIBLE
    assert not satisfaction_is_promised(trial, task)
    assert trial.status & Status.NO_FRONTIER


def test_a_small_budget_ends_the_trial():
    world = ROOMS.generate(world_key(Split.VALIDATION, 2, "rooms"))
    config = dataclasses.replace(CONFIG, budget_factor=0.1)
    task = Task.from_formula("F(a & F(b & F c))", propositions=ROOMS.propositions)
    trial = _run(world, task, Policy.BASELINE, 0, config)
    assert trial.outcome is Outcome.BUDGET
    assert 0.1 * float(np.sum(world.extent)) <= trial.cost <= 0.1 * float(np.sum(world.extent)) + 2.0


def test_more_subgoals_than_the_array_holds_are_flagged_and_lose_nothing():
    config = dataclasses.replace(
        CONFIG, decision=dataclasses.replace(CONFIG.decision, frontiers=FrontierConfig(max_subgoals=1, most_subgoals=1))
    )
    flagged = 0
    for number in range(3):
        world = ROOMS.generate(world_key(Split.VALIDATION, number, "rooms"))
        trial = _run(world, TASKS[number], Policy.ORACLE, number, config)
        assert problems_of(trial, TASKS[number], world) == []
        flagged += bool(trial.status & Status.SUBGOAL_OVERFLOW)
    assert flagged > 0


_decide = jax.jit(decide, static_argnames=("policy", "config"))


def _decision_in(rows, formula, policy, shape=(6, 12), **settings):
    """Decide on a drawing: # wall, . free, s robot, letters a and b, ? unobserved; walls are added up to ``shape``."""
    art = np.full(shape, "#")
    art[: len(rows), : len(rows[0])] = [list(row) for row in rows]
    known = art != "?"
    cells = np.where(known, np.where(art == "#", BeliefMap.OCCUPIED, BeliefMap.FREE), BeliefMap.UNKNOWN)
    letters = (art == "a") * 1 + (art == "b") * 2
    arrays = Task.from_formula(formula, propositions=("a", "b", "c")).padded(SIZES)
    cell = jnp.asarray(np.argwhere(art == "s")[0], jnp.int32)
    config = dataclasses.replace(CONFIG.decision, **settings)
    belief = belief_from_numpy(cells, letters, propositions=("a", "b", "c"))
    return _decide(belief, cell, jnp.int32(0), arrays, None, jax.random.key(0), policy=policy, config=config)


def test_a_frontier_at_the_edge_of_the_map_is_one():
    move = _decision_in(["####", "#s..", "####"], "F a", Policy.BASELINE, shape=(3, 4))
    assert int(move.kind) == MoveKind.FRONTIER
    assert move.target_cell.tolist() == [1, 3]


def test_the_baseline_goes_round_what_violates():
    # The nearest frontier lies beyond the hazard b, the other one is free.
    move = _decision_in(["#########", "??.s.b.?#", "#########"], "!b U a", Policy.BASELINE)
    assert move.target_cell.tolist() == [1, 2]
    blocked = _decision_in(["#########", "###s.b.?#", "#########"], "!b U a", Policy.BASELINE)
    assert int(blocked.kind) == MoveKind.NONE
    assert int(blocked.status) & Status.NO_FRONTIER


def test_the_baseline_finishes_as_soon_as_it_can():
    move = _decision_in(["########", "?.s...a#", "########"], "F a", Policy.BASELINE)
    assert int(move.kind) == MoveKind.FINISH
    assert move.target_cell.tolist() == [1, 6]
    assert float(move.value) == 4.0


def test_the_optimist_heads_for_the_unobserved():
    # Three steps to an unobserved cell that may be the goal; the known one is farther.
    rows = ["##########", "?..s.....a", "##########"]
    move = _decision_in(rows, "F a", Policy.OPTIMISTIC)
    assert move.target_cell.tolist() == [1, 1]
    assert float(move.value) == 3.0
    path = np.asarray(move.path.cells)[: int(move.path.length) + 1]
    assert path.tolist() == [[1, 3], [1, 2], [1, 1]]


def test_small_components_are_gone_to_when_nothing_else_is_left():
    # The larger frontier is out of reach behind the hazard: the dropped one is not forgotten.
    rows = ["########", "#s.b..??", "#.#b..??", "#?######"]
    move = _decision_in(rows, "!b U a", Policy.BASELINE, frontiers=FrontierConfig(max_subgoals=6, min_size=2))
    assert int(move.kind) == MoveKind.FRONTIER
    assert move.target_cell.tolist() == [2, 1]


def test_decide_under_vmap_equals_a_loop():
    worlds = [ROOMS.generate(world_key(Split.VALIDATION, number, "rooms")) for number in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    arrays = TASKS[1].padded(SIZES)

    def move_in(world, decide):
        belief = BeliefMap.revealed(world)
        told = {"policy": Policy.BASELINE, "config": CONFIG.decision}
        move = decide(belief, world.start, jnp.int32(0), arrays, None, jax.random.key(0), **told)
        return move.kind, move.target_cell, move.value, move.path.cells

    together = jax.jit(jax.vmap(lambda world: move_in(world, decide)))(stacked)
    for index, world in enumerate(worlds):
        for one, many in zip(move_in(world, _decide), together, strict=True):
            np.testing.assert_array_equal(np.asarray(one), np.asarray(many)[index])


def test_a_robot_that_goes_elsewhere_is_on_its_way_to_nothing():
    world, task = ROOMS.generate(world_key(Split.VALIDATION, 0, "rooms")), TASKS[0]
    robot = SimulatedRobot(world, CONFIG, jax.random.key(0))

    class StayingRobot:
        observe, panorama = robot.observe, robot.panorama

        def advance(self, path, stop):
            return Leg(cells=(robot.observe()[1],))

    for follower, stays in ((StayingRobot(), True), (robot, False)):
        estimator = TrueMapEstimator(world=world)
        loop = trial_module._Loop(
            follower,
            task,
            task.padded(SIZES),
            Policy.ORACLE,
            lambda shape, asked=estimator: asked,
            jax.random.key(0),
            CONFIG,
            Setbacks(SetbackConfig()),
            None,
        )
        belief, cell = robot.observe()
        loop._begin(belief, cell)
        move = loop._decide(belief, cell)
        assert int(move.intention.state) == int(loop._tally.state)
        leg = follower.advance(move.path, trial_module._stop_of(move, loop._tally, belief, config=CONFIG))
        loop._after(leg, leg.cells, move, robot.observe()[0])
        expected = NO_STATE if stays else int(move.intention.state)
        assert int(loop._tally.intention.state) == expected


def test_an_oracle_without_estimator_is_refused():
    with pytest.raises(ValueError, match="needs an estimator"):
        _decision_in(["#####", "#s..?", "#####"], "F a", Policy.ORACLE)


def test_policies_are_named_in_one_place():
    assert {policy.value for policy in policies.Policy} == {"known-map", "baseline", "optimistic", "oracle", "potlp"}
    with pytest.raises(PluginError, match="unknown policy 'wizard'"):
        _run(ROOMS.world(0), TASKS[0], "wizard", 0)
