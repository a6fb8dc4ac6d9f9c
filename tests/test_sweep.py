"""Sweeps: the specification's errors, the store under several processes and kills, rows, tables and export."""

import contextlib
import csv
import dataclasses
import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

from eval.faults.kills import process_start, workers_of
from eval.limit.arms import Arm
from eval.limit.worst import experiment_of
from eval.real_maps.__main__ import exchange
from eval.savings import compare_first, decisions_of, table_lines
from potlp_jax.cli import app
from potlp_jax.cli.report import _notable, page_title
from potlp_jax.cli.sweep import _Reporter
from potlp_jax.codec import shipped_settings
from potlp_jax.engine.engine import Broken, Here
from potlp_jax.engine.writer import only_writer
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import MAX_INDEX, Split, world_key
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import (
    ConfigurationError,
    EngineError,
    EstimatorError,
    PotlpError,
    StoreError,
    SweepError,
    WorldError,
)
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.ending import ENDED, KEPT, ending_when_asked
from potlp_jax.sweep.results import charged_cost, pair_rows, read_results, remarks_on_worlds, world_of
from potlp_jax.sweep.rows import path_text, read_path, source_commit
from potlp_jax.sweep.runner import RESULTS, Progress, Sweep, run_sweep
from potlp_jax.sweep.specification import (
    _environment,
    configuration_hash,
    own_settings,
    read_specification,
    specification_from_dict,
    specification_from_store,
)
from potlp_jax.sweep.store import Item, Row, Store
from potlp_jax.sweep.work import Examined, Work
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import load_trial
from potlp_jax.trials.rules import trial_key
from potlp_jax.types import Status
from potlp_jax.view.report_page import Cell, Shown, report_page
from potlp_jax.view.style import policy_styles
from tests.reference.browser import BROWSER, dump_page

SMALL = {"environments": ["toy"], "tasks": [2], "policies": ["optimistic"], "worlds": 3, "first_world": 5}


def _specification(**changes):
    return specification_from_dict({**SMALL, **changes}, "here")


def _row(item, cost=1.0):
    return Row(
        item=item,
        outcome="satisfied",
        cost=cost,
        budget=100.0,
        steps=3,
        decisions=2,
        fallbacks=0,
        status=0,
        key=(0, 2**32 - 1),
        path="2,3:70",
        configuration="abc",
        versions={"jax": "1"},
        commit="",
        seconds=0.5,
        world_digest="0123456789abcdef",
    )


ITEMS = [Item("toy", "F goal", "baseline", world) for world in range(10)]


def test_known_map_and_baseline_always_run_and_numbers_become_formulas():
    specification = _specification()
    assert specification.policies == (Policy.KNOWN_MAP, Policy.BASELINE, Policy.OPTIMISTIC)
    assert [cell.task for cell in specification.cells] == [make("toy").tasks["2"]]


def test_settings_reach_every_depth():
    specification = _specification(settings={"replan_distance": 7, "decision": {"search": {"simulations": 9}}})
    assert specification.config.replan_distance == 7.0
    assert specification.config.decision.search.simulations == 9
    assert specification.config.budget_factor == _specification().config.budget_factor


OWN = {"baseline": {"replan_distance": 9, "decision": {"frontiers": {"min_size": 5}}}}


def test_a_policy_may_have_settings_of_its_own():
    specification = _specification(settings={"replan_distance": 7, "budget_factor": 3}, policy_settings=OWN)
    own, common = specification.config_of("baseline"), specification.config_of("optimistic")
    assert (own.replan_distance, own.decision.frontiers.min_size, own.budget_factor) == (9.0, 5, 3.0)
    assert common == specification.config
    assert (common.replan_distance, common.decision.frontiers.min_size) == (7.0, 2)
    data = json.loads(json.dumps(specification.to_dict()))
    assert specification_from_store(data) == specification
    assert own_settings(data) == {
        "baseline": "decision.frontiers.min_size was 2, is 5, replan_distance was 7.0, is 9.0"
    }
    assert "policy_settings" not in _specification().to_dict()
    same = _specification(settings={"replan_distance": 7}, policy_settings={"baseline": {"replan_distance": 7}})
    assert own_settings(same.to_dict()) == {}


@pytest.mark.long
def test_trials_of_a_policy_have_its_settings_and_a_sweep_with_others_is_another(tmp_path):
    sweep = Sweep(_specification(policy_settings={"baseline": {"replan_distance": 2}}), tmp_path)
    sweep.run(Here(), lambda progress: None)
    hashes = {row.item.policy: row.configuration for row in sweep.store.rows()}
    common = configuration_hash(sweep.specification.config)
    assert hashes["optimistic"] == hashes["known-map"] == common
    assert hashes["baseline"] == configuration_hash(sweep.specification.config_of("baseline")) != common
    (row,) = [row for row in sweep.store.rows() if row.item.policy == "baseline" and row.item.world == 5]
    world, task = make("toy").generate(world_key("validation", 5, "toy")), make("toy").task(2)
    config = dataclasses.replace(sweep.specification.config, replan_distance=2.0)
    alone = run_trial(world, task, "baseline", trial_key(5), config)
    np.testing.assert_array_equal(read_path(row.path), alone.path)
    assert list(sweep.trial(row.item).path) == list(alone.path)
    told = _potlp("sweep", "show", tmp_path)
    assert "settings of baseline: replan_distance was 4.0, is 2.0" in told.stdout
    with pytest.raises(StoreError, match=r"specification: policy_settings was .*, is null"):
        Sweep(_specification(), tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policy_settings": ["baseline"]}, "policy_settings: give settings by policy"),
        ({"policy_settings": {"potlp": {}}}, "policy_settings: 'potlp' is none of the policies: known-map, baseline"),
        ({"policy_settings": {"baseline": {"replan": 3}}}, "policy_settings: baseline: unknown field 'replan'"),
        ({"policy_settings": {"baseline": {"sensor": {}}}}, "baseline: sensor is the same for all policies"),
        ({"policy_settings": {"baseline": {"budget_factor": 2}}}, "baseline: budget_factor is the same for all"),
        ({"worlds": 0}, "worlds: give a whole number of at least 1, found 0"),
        ({"worlds": True}, "worlds"),
        ({"polices": ["baseline"]}, "unknown entry 'polices'"),
        ({"policies": ["best"]}, "policies: unknown policy 'best'; choose"),
        ({"policies": "baseline"}, "policies: give a list"),
        ({"split": "exam"}, "unknown split 'exam'"),
        ({"tasks": [17]}, "toy has no task 17"),
        ({"tasks": [1, "F goal"]}, "is there twice"),
        ({"environments": ["mars"]}, "mars"),
        ({"tasks": ["F ("]}, "F \\("),
        ({"settings": {"replan": 3}}, "settings: unknown field 'replan'"),
        ({"settings": {"decision": {"search": {"simulations": "many"}}}}, "settings.decision.search.simulations"),
        ({"settings": {"decision": {"frontiers": {"max_subgoals": 0}}}}, "settings.decision.frontiers: .*at least 1"),
        ({"settings": {"revealed": 1}}, "settings.revealed: give true or false, found 1"),
        ({"settings": {"decision": {"search": {"mode": "guess"}}}}, "settings.decision.search: unknown field 'mode'"),
        ({"settings": {"decision": {"search": {"kind": "guess"}}}}, "settings.decision.search"),
    ],
)
def test_wrong_entries_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        _specification(**changes)


def test_files_that_are_no_specification_are_named(tmp_path):
    for text, message in (
        ("[1, 2", "is not valid YAML"),
        ("- a", "give a mapping"),
        ("worlds: 3", "environments is missing"),
    ):
        (tmp_path / "sweep.yaml").write_text(text)
        with pytest.raises(ConfigurationError, match=rf"sweep\.yaml: .*{message}"):
            read_specification(tmp_path / "sweep.yaml")


@pytest.mark.parametrize("name", ["firefighting", "firefighting-held-out"])
def test_shipped_sweeps_are_found_by_name_and_can_be_run(name):
    assert name in shipped_settings("potlp_jax.sweep")
    specification = read_specification(name)
    assert Policy.POTLP in specification.policies
    with pytest.raises(ConfigurationError, match="neither a file nor one of those that are shipped: firefighting"):
        read_specification("fire-fighting")


def test_rows_come_back_as_they_were_written(tmp_path):
    store = Store(tmp_path / "a.sqlite")
    row = _row(ITEMS[0], cost=0.1 + 0.2)
    store.finish([row])
    assert Store(tmp_path / "a.sqlite").rows() == [row]
    assert store.items() == {ITEMS[0]}


def test_a_trial_that_is_run_twice_must_give_the_same_row(tmp_path):
    store = Store(tmp_path / "a.sqlite")
    row = _row(ITEMS[0], cost=0.1 + 0.2)
    store.finish([row])
    store.finish([dataclasses.replace(row, seconds=9.0)])
    assert store.rows() == [row]
    for change in ({"cost": 0.3}, {"path": "2,3:71"}, {"versions": {"jax": "2"}}):
        with pytest.raises(
            StoreError, match=rf"baseline in world 0 was run twice with different .*{next(iter(change))}"
        ):
            store.finish([_row(ITEMS[1]), dataclasses.replace(row, **change)])
    # All or nothing.
    assert store.rows() == [row]


def test_what_was_given_up_is_kept_until_it_is_to_be_tried_again(tmp_path):
    store = Store(tmp_path / "a.sqlite")
    store.set_broken(ITEMS[2], "it died")
    store.set_broken(ITEMS[1], "it died too")
    assert Store(tmp_path / "a.sqlite", read_only=True).broken() == {ITEMS[1]: "it died too", ITEMS[2]: "it died"}
    store.forget_broken()
    assert store.broken() == {}
    assert store.count() == 0


def test_a_store_of_another_sweep_is_refused_by_name(tmp_path):
    Sweep(_specification(), tmp_path)
    Sweep(_specification(), tmp_path)
    with pytest.raises(StoreError, match="worlds was 3, is 2"):
        Sweep(_specification(worlds=2), tmp_path)
    with pytest.raises(StoreError, match="specification: first_world was 5, is 1, worlds was 3, is 4"):
        Sweep(_specification(worlds=4, first_world=1), tmp_path)
    with pytest.raises(StoreError, match="worlds was 3, is 2"):
        Sweep(_specification(worlds=2), tmp_path)


@pytest.mark.parametrize("pragma", [None, "PRAGMA journal_mode=WAL", "PRAGMA user_version=0"])
def test_a_store_that_never_got_its_tables_goes_on(pragma, tmp_path):
    """A full disk, or a kill at the start, leaves it so."""
    if pragma is None:
        (tmp_path / RESULTS).touch()
    else:
        with contextlib.closing(sqlite3.connect(tmp_path / RESULTS)) as begun:
            begun.execute(pragma)
    for command in ("status", "show"):
        told = _potlp("sweep", command, tmp_path)
        assert (told.exit_code, "holds nothing yet: give the sweep's command again" in told.stderr) == (2, True)
    run_sweep(_specification(worlds=1), tmp_path)
    assert Sweep(_specification(worlds=1), tmp_path, read_only=True).finished()


def test_of_a_specification_that_cannot_be_run_no_store_is_begun(tmp_path):
    with pytest.raises(EstimatorError):
        run_sweep(_specification(policies=["potlp"]), tmp_path)
    assert not (tmp_path / RESULTS).exists()
    Store(tmp_path / RESULTS).close()
    for command in ("status", "show"):
        told = _potlp("sweep", command, tmp_path)
        assert (told.exit_code, "holds nothing yet" in told.stderr) == (2, True)


def test_rows_of_a_world_that_has_changed_are_not_gone_on_with_nor_shown(finished, tmp_path, monkeypatch):
    folder = tmp_path / "sweep"
    shutil.copytree(finished, folder)
    plain = Toy.draw
    # As where a wall was drawn into the picture of a map.
    monkeypatch.setattr(Toy, "draw", lambda self, key: plain(self, jax.random.fold_in(key, 1)))
    with pytest.raises(StoreError, match="toy: world 5 is not that of the rows that are there"):
        run_sweep(_specification(worlds=4), folder)
    told = _potlp("report", folder, "--out", tmp_path / "report.html")
    assert (told.exit_code, "is not that of the rows that are there" in told.stderr) == (2, True)
    assert _potlp("report", folder, "--out", tmp_path / "report.html", "--replays", 0).exit_code == 0


def test_a_world_whose_way_is_longer_than_the_budget_is_possible(tmp_path):
    run_sweep(_specification(settings={"budget_factor": 0.01}, policies=["baseline"]), tmp_path)
    with contextlib.closing(Store(tmp_path / RESULTS, read_only=True)) as store:
        assert {row.outcome for row in store.rows()} == {"budget"}
        (cell,) = read_results(store).cells
    assert [world_of(pair) for pair in cell.pairs] == [5, 6, 7]
    assert cell.redrawn == 0
    assert cell.comparison.charged.pairs == 3


def test_what_was_given_up_is_told_everywhere_and_forgotten_by_its_own_sweep_alone(finished, tmp_path):
    folder = tmp_path / "sweep"
    shutil.copytree(finished, folder)
    store = Store(folder / RESULTS)
    store.set_broken(dataclasses.replace(ITEMS[5], policy="optimistic"), "it died")
    store.close()
    shown = json.loads(_potlp("sweep", "show", folder, "--json").stdout)["given_up"]
    assert [(entry["world"], entry["error"]) for entry in shown] == [(5, "it died")]
    assert "given up: optimistic in world 5" in _potlp("sweep", "show", folder).stdout
    assert _potlp("report", folder, "--replays", 0).exit_code == 0
    assert "given up: optimistic in world 5" in (folder / "report.html").read_text("utf-8")
    with pytest.raises(StoreError, match="another specification"):
        run_sweep(_specification(tasks=[1]), folder, retry_broken=True)
    assert Store(folder / RESULTS, read_only=True).broken()
    run_sweep(_specification(), folder, retry_broken=True)
    assert not Store(folder / RESULTS, read_only=True).broken()


def test_worlds_end_at_the_last_number(tmp_path, monkeypatch):
    with pytest.raises(ConfigurationError, match="worlds: 3 from number 268435454 on, and the last is 268435455"):
        _specification(first_world=MAX_INDEX - 1)
    monkeypatch.setattr(Work, "examined", lambda self, items: [Examined(item, False) for item in items])
    with pytest.raises(WorldError, match=r"is possible in 0 worlds .* and world 268435455 is the last"):
        run_sweep(_specification(first_world=MAX_INDEX - 1, worlds=2), tmp_path)


def test_a_sweep_with_an_estimators_file_is_the_same_from_any_folder(tmp_path, monkeypatch):
    (tmp_path / "mine.npz").touch()
    there = specification_from_dict({**SMALL, "estimator": "mine.npz"}, "here", tmp_path)
    monkeypatch.chdir(tmp_path)
    assert specification_from_dict({**SMALL, "estimator": "mine.npz"}, "here") == there


def test_maps_lie_beside_the_file_that_names_them(tmp_path, monkeypatch):
    (tmp_path / "maps").mkdir()
    for name in ("office.yaml", "office.places.yaml"):
        (tmp_path / "maps" / name).touch()
    name = "map:office.yaml,places=office.places.yaml,resolution=0.4"
    assert _environment(name, tmp_path / "maps") == (
        f"map:{tmp_path}/maps/office.yaml,places={tmp_path}/maps/office.places.yaml,resolution=0.4"
    )
    (tmp_path / "link").symlink_to(tmp_path / "maps")
    absolute = f"map:{tmp_path}/link/office.yaml"
    assert _environment(absolute, tmp_path / "maps") == absolute
    # What is found as it stands keeps its name, and so does what is no file.
    monkeypatch.chdir(tmp_path / "maps")
    assert _environment(name, Path()) == name
    assert _environment("rooms", tmp_path) == "rooms"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "maps" / "sweep.yaml").write_text(json.dumps({**SMALL, "environments": ["map:none.yaml"]}))
    with pytest.raises(PotlpError, match=rf"none\.yaml: cannot be read \(No such file .*, seen from {tmp_path}\)"):
        read_specification(tmp_path / "maps" / "sweep.yaml")


def test_tasks_without_a_finished_world_are_named(tmp_path):
    store = Store(tmp_path / RESULTS)
    store.agree({"specification": _specification().to_dict(), "estimator": None})
    store.close()
    told = _potlp("sweep", "show", tmp_path)
    assert "toy, task !hazard U goal: no world that all policies have finished yet" in told.stdout


def test_an_interrupted_sweep_says_that_it_goes_on(tmp_path, monkeypatch):
    def run_sweep(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("potlp_jax.sweep.runner.run_sweep", run_sweep)
    (tmp_path / "sweep.yaml").write_text(json.dumps(SMALL))
    told = _potlp("sweep", tmp_path / "sweep.yaml", "--out", tmp_path / "out")
    assert told.exit_code == 130
    words = "interrupted; what is finished is kept: the same command goes on"
    assert words in " ".join(told.stderr.split())
    # A comparison without a folder keeps nothing.
    assert words in " ".join(_potlp("compare", "toy", "--out", tmp_path / "compared").stderr.split())
    assert "interrupted" not in _potlp("compare", "toy").stderr


def test_a_sweep_that_is_asked_to_end_says_that_it_goes_on_where_its_folder_stays(tmp_path, monkeypatch):
    def run_sweep(*arguments):
        with ending_when_asked(arguments[-1]):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)

    monkeypatch.setattr("potlp_jax.sweep.runner.run_sweep", run_sweep)
    # Here the interpreter stays.
    monkeypatch.setattr("potlp_jax.sweep.ending.end_process_soon", lambda: None)
    told = _potlp("compare", "toy", "--out", tmp_path / "compared")
    assert told.exit_code == ENDED
    assert f"ended by SIGTERM; {KEPT}" in " ".join(told.stderr.split())
    told = _potlp("compare", "toy")
    assert "ended by SIGTERM" in told.stderr
    assert KEPT not in " ".join(told.stderr.split())


_EXITS = """
import atexit, sys, time
atexit.register(lambda: (time.sleep({seconds}), print("tidied up")))
from potlp_jax.cli import sweep
from potlp_jax.sweep import runner
def run_sweep(*_):
    raise SystemExit({code})
runner.run_sweep = run_sweep
sweep.run_reported(None, None, 1)
"""


def _ended(code, seconds):
    """A sweep that exits with this code, in an interpreter that then takes a while to end."""
    words = [sys.executable, "-c", _EXITS.format(code=code, seconds=seconds)]
    return subprocess.run(words, timeout=60, check=False, capture_output=True, text=True)


def test_a_sweep_that_was_asked_to_end_does_not_wait_at_the_end_of_the_interpreter():
    assert _ended(ENDED, seconds=300).returncode == ENDED


@pytest.mark.parametrize(("code", "returned"), [("5", 5), ("'no more worlds'", 1)])
def test_a_plug_in_that_exits_by_itself_ends_as_it_likes(code, returned):
    # Longer than a sweep that was asked to end may take.
    ended = _ended(code, seconds=2)
    assert ended.returncode == returned
    assert "tidied up" in ended.stdout


def test_other_files_are_no_store(tmp_path):
    (tmp_path / "a").write_text("something else, and long enough to be looked at as a header of a file" * 20)
    with pytest.raises(StoreError, match="not a store"):
        Store(tmp_path / "a")
    old = Store(tmp_path / "b")
    old._connection.execute("UPDATE facts SET value = 'potlp-sweep-0' WHERE name = 'format'")
    old.close()
    with pytest.raises(StoreError, match=r"'potlp-sweep-0'.*'potlp-sweep-5'"):
        Store(tmp_path / "b")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A sweep in one process."""
    folder = tmp_path_factory.mktemp("sweep")
    reports = []
    run_sweep(_specification(), folder, 1, reports.append)
    assert [report.done for report in reports] == sorted(report.done for report in reports)
    assert reports[-1].done == reports[-1].total == 9
    return folder


def _rows(folder, read_only=False):
    """Rows without what differs between runs."""
    store = Store(folder / RESULTS, read_only)
    rows = [dataclasses.replace(row, seconds=0.0) for row in store.rows()]
    store.close()
    return rows


def test_a_row_is_what_a_single_trial_gives(finished):
    toy = make("toy")
    task = Task.from_formula(toy.tasks["2"], propositions=toy.propositions)
    rows = _rows(finished)
    assert len(rows) == 9
    for row in rows:
        world = toy.generate(world_key("validation", row.item.world, "toy"))
        key = jax.random.fold_in(jax.random.key(0), row.item.world)
        trial = run_trial(world, task, row.item.policy, key)
        assert (row.outcome, row.cost, row.steps) == (trial.outcome, trial.cost, len(trial.path) - 1)
        assert read_path(row.path).tolist() == [list(cell) for cell in trial.path]
        assert row.decisions == len(trial.decisions)


def test_a_finished_sweep_has_nothing_left_to_do(finished):
    before = _rows(finished)
    run_sweep(_specification(), finished, 1)
    assert _rows(finished) == before


def test_a_sweep_can_be_made_longer(finished, tmp_path):
    run_sweep(_specification(worlds=1), tmp_path, 1)
    short = _rows(tmp_path)
    run_sweep(_specification(), tmp_path, 1)
    assert len(short) == 3
    assert _rows(tmp_path) == _rows(finished)


MANY_KILLS = """
import os, random, signal, sys, time
from pathlib import Path
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.runner import run_sweep
from potlp_jax.sweep.specification import Cell, Specification
from potlp_jax.sweep.store import POSSIBLE, Row
from potlp_jax.sweep.work import Examined, Work

def do(self, unit):
    for item in unit.items:
        time.sleep(0.002)
        if item.policy == POSSIBLE:
            yield Examined(item, item.world % 3 != 1)
        else:
            yield Row(item, "satisfied", item.world / 7, 9.0, 1, 1, 0, 0, (1, 2), "p", "c", {}, "", 0.0, "d")

Work.do, Work.is_of = do, lambda self, row: True
specification = Specification(
    cells=(Cell("toy", "F goal"), Cell("toy", "F hazard")),
    policies=(Policy.KNOWN_MAP, Policy.BASELINE, Policy.ORACLE),
    worlds=40,
)
folder, draw, kills = Path(sys.argv[1]), random.Random(5), 0
while True:
    pid = os.fork()
    if not pid:
        run_sweep(specification, folder)
        os._exit(0)
    if kills < 60:
        time.sleep(draw.random() * 0.08)
        os.kill(pid, signal.SIGKILL)
    if not os.WIFSIGNALED(os.waitpid(pid, 0)[1]):
        break
    kills += 1
print(kills)
"""


@pytest.mark.long
def test_killed_many_times_at_random_moments_nothing_is_lost_and_nothing_is_there_twice(tmp_path):
    # The work is a stand-in, so that hundreds of trials and tens of kills take seconds.
    done = subprocess.run([sys.executable, "-c", MANY_KILLS, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 8
    possible = [world for world in range(60) if world % 3 != 1][:40]
    expected = [
        (task, policy, world, world / 7)
        for task in ("F goal", "F hazard")
        for policy in ("baseline", "known-map", "oracle")
        for world in possible
    ]
    rows = _rows(tmp_path)
    assert [(row.item.task, row.item.policy, row.item.world, row.cost) for row in rows] == expected


class _Fragile:
    """An engine of whose workers each dies of one trial."""

    workers = 2

    def __init__(self, deadly: int | None) -> None:
        self.deadly, self.asked = deadly, []

    def run(self, work, shared, units):
        for unit in units:
            self.asked.append(len(unit.items))
            if any(item.world == self.deadly and item.policy == "optimistic" for item in unit.items):
                yield unit, Broken("every worker that began it died: out of memory")
            else:
                yield unit, list(work(shared, unit))

    def close(self):
        pass


def test_a_trial_that_kills_its_workers_is_found_listed_and_not_run_for_ever(finished, tmp_path, monkeypatch):
    fragile = _Fragile(deadly=6)
    monkeypatch.setattr("potlp_jax.sweep.runner.open_engine", lambda *where: contextlib.nullcontext(fragile))
    monkeypatch.setattr("potlp_jax.sweep.runner._UNITS_A_WORKER", 1)
    run_sweep(_specification(), tmp_path)
    whole = _rows(finished)
    rest = [row for row in whole if (row.item.world, row.item.policy) != (6, "optimistic")]
    assert _rows(tmp_path) == rest
    # The unit with the trial, then each of its trials by itself.
    assert max(fragile.asked) > 1
    assert fragile.asked[-max(fragile.asked) :] == [1] * max(fragile.asked)
    fragile.asked.clear()
    run_sweep(_specification(), tmp_path)
    assert not fragile.asked
    told = _potlp("sweep", "show", tmp_path)
    assert "given up: optimistic in world 6 of toy" in told.stdout
    assert "out of memory" in told.stdout
    fragile.deadly = None
    (tmp_path / "sweep.yaml").write_text(json.dumps(SMALL))
    told = _potlp("sweep", tmp_path / "sweep.yaml", "--out", tmp_path, "--retry-broken")
    assert told.exit_code == 0, told.stderr
    assert "given up" not in told.stdout
    assert _rows(tmp_path) == whole


def test_what_was_given_up_stays_known_where_nobody_can_try_it_again(tmp_path):
    store = Store(tmp_path / RESULTS)
    store.agree({"specification": _specification().to_dict(), "estimator": None})
    store.set_broken(ITEMS[0], "it died")
    store.close()
    with pytest.raises(EngineError, match="unknown"):
        run_sweep(_specification(), tmp_path, cluster="mars", retry_broken=True)
    assert Store(tmp_path / RESULTS, read_only=True).broken() == {ITEMS[0]: "it died"}


def test_a_world_that_cannot_be_examined_ends_the_sweep(tmp_path, monkeypatch):
    class Dying(_Fragile):
        def run(self, work, shared, units):
            for unit in units:
                yield unit, Broken("it died")

    monkeypatch.setattr("potlp_jax.sweep.runner.open_engine", lambda *where: contextlib.nullcontext(Dying(None)))
    with pytest.raises(SweepError, match="toy, world 5: cannot be examined: it died; what is finished is kept"):
        run_sweep(_specification(), tmp_path)


def _flip(file, table, column, value):
    """Change one value behind the store's back, and what SQLite would check of it."""
    store = Store(file)
    store._connection.execute(f"UPDATE {table} SET {column} = {value}")
    store.close()


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("trials", "cost", "cost + 1e-12"),
        ("trials", "path", "'2,3:71'"),
        ("trials", "world", "world + 1"),
        ("trials", "key", "'[0, 1]'"),
        ("trials", "outcome", "x'00ff'"),
        ("worlds", "possible", "1 - possible"),
        ("facts", "value", "replace(value, '3', '2')"),
    ],
)
def test_what_was_changed_in_a_store_is_not_taken_for_a_result(table, column, value, tmp_path):
    file = tmp_path / RESULTS
    store = Store(file)
    store.agree({"specification": {"worlds": 3}})
    store.finish([_row(ITEMS[0])])
    store.set_possible("toy", "F goal", {0: True})
    assert len(store.rows()) == len(store.possible("toy", "F goal")) == len(store.facts()) == 1
    store.close()
    _flip(file, table, column, f"{value} WHERE name <> 'format'" if table == "facts" else value)
    changed = Store(file, read_only=True)
    read = {"trials": changed.rows, "worlds": lambda: changed.possible("toy", "F goal"), "facts": changed.facts}
    with pytest.raises(StoreError, match=r"results\.sqlite: .* is damaged: its checksum .*another folder") as caught:
        read[table]()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("column", "value"), [("outcome", "'stuck'"), ("versions", "'{\"jax'"), ("world_digest", "'other'")]
)
def test_a_changed_row_is_called_damaged_however_it_is_read(column, value, tmp_path):
    store = Store(tmp_path / RESULTS)
    store.finish([_row(ITEMS[0])])
    store.close()
    _flip(tmp_path / RESULTS, "trials", column, value)
    changed = Store(tmp_path / RESULTS)
    for read in (changed.rows, lambda: changed.outer_rows("toy"), lambda: changed.finish([_row(ITEMS[0])])):
        with pytest.raises(StoreError, match="is damaged: its checksum"):
            read()


def test_bits_that_flip_in_the_file_end_in_one_line_or_change_nothing(tmp_path):
    store = Store(tmp_path / "whole")
    rows = [_row(item, cost=item.world / 7) for item in ITEMS]
    store.finish(rows)
    store.close()
    whole, random, refused = (tmp_path / "whole").read_bytes(), np.random.default_rng(3), 0
    for _ in range(60):
        damaged = bytearray(whole)
        damaged[random.integers(len(whole))] ^= 1 << int(random.integers(8))
        (tmp_path / "damaged").write_bytes(damaged)
        try:
            found = Store(tmp_path / "damaged", read_only=True).rows()
        except StoreError as error:
            refused += "\n" not in str(error)
        else:
            # Bits that no row lies on, such as those of free pages.
            assert found == rows
    assert refused > 3


def test_rows_that_went_with_a_part_of_the_file_are_missed(tmp_path):
    store = Store(tmp_path / RESULTS)
    store.finish([_row(item) for item in ITEMS])
    root = store._connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'trials'").fetchone()[0]
    (size,) = store._connection.execute("PRAGMA page_size").fetchone()
    store.close()
    whole = bytearray((tmp_path / RESULTS).read_bytes())
    # The number of rows on a page stands at its fourth and fifth byte.
    whole[(root - 1) * size + 4] -= 3
    (tmp_path / RESULTS).write_bytes(whole)
    with pytest.raises(StoreError, match="is damaged"):
        Store(tmp_path / RESULTS, read_only=True)


def test_a_full_disk_is_named_and_loses_nothing(tmp_path):
    store = Store(tmp_path / RESULTS)
    store.finish([_row(ITEMS[0])])
    (pages,) = store._connection.execute("PRAGMA page_count").fetchone()
    store._connection.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(StoreError, match=r"the disk is full .*make room"):
        store.finish([dataclasses.replace(_row(item), path="2,3:" + "7" * 9000) for item in ITEMS[1:]])
    assert store.rows() == [_row(ITEMS[0])]
    store._connection.execute("PRAGMA max_page_count = 100000")
    store.finish([_row(ITEMS[1])])
    assert store.count() == 2


def test_a_store_that_another_program_holds_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("potlp_jax.sweep.store.PATIENCE", 0.01)
    one, other = Store(tmp_path / RESULTS), Store(tmp_path / RESULTS)
    with one._transaction(), pytest.raises(StoreError, match="another process has been writing"):
        other.finish([_row(ITEMS[0])])


@pytest.fixture(params=["whole", "killed"])
def read_only(request, finished, tmp_path):
    """A finished sweep on a medium that cannot be written; in the second case its log was not merged into the file."""
    source, mounted = tmp_path / "source", tmp_path / "mounted"
    shutil.copytree(finished, source)
    mounted.mkdir()
    if request.param == "killed":
        code = (
            "import os, sys; from potlp_jax.sweep.store import *; from pathlib import Path\n"
            "store = Store(Path(sys.argv[1])); store.set_possible('toy', 'F x', {1: True}); os._exit(1)"
        )
        subprocess.run([sys.executable, "-c", code, str(source / RESULTS)])
        assert (source / f"{RESULTS}-wal").stat().st_size
        (source / f"{RESULTS}-shm").unlink()
    if subprocess.run(["mount", "--bind", source, mounted], stderr=subprocess.DEVNULL).returncode:
        pytest.skip("no right to mount")
    subprocess.run(["mount", "-o", "remount,bind,ro", source, mounted], check=True)
    yield mounted
    subprocess.run(["umount", "--lazy", mounted], check=True)


def test_reading_makes_no_store_where_there_is_none(tmp_path):
    with pytest.raises(StoreError, match="no such file; name the folder of a sweep that was begun"):
        Store(tmp_path / RESULTS, read_only=True)
    assert not list(tmp_path.iterdir())


def test_a_finished_sweep_is_shown_from_a_medium_that_cannot_be_written(read_only, tmp_path):
    assert _rows(read_only, read_only=True) == _rows(read_only, read_only=True)
    told = _potlp("sweep", "show", read_only, "--json")
    assert told.exit_code == 0, told.stderr
    (cell,) = json.loads(told.stdout)["cells"]
    assert cell["satisfied"]["pairs"] == 3
    run_sweep(_specification(), read_only, 2)
    told = _potlp("report", read_only, "--out", tmp_path / "page.html", "--replays", 0)
    assert told.exit_code == 0, told.stderr
    with pytest.raises(StoreError, match=r"cannot be (read or )?written"):
        run_sweep(_specification(worlds=4), read_only, 1)


WORKER = """
import sys
from pathlib import Path
from potlp_jax.sweep.runner import run_sweep
from potlp_jax.sweep.specification import read_specification
if __name__ == "__main__":
    run_sweep(read_specification(Path(sys.argv[1])), Path(sys.argv[2]), int(sys.argv[3]))
"""


@pytest.fixture
def command(tmp_path):
    """Runs the sweep in a process of its own; its arguments but the number of workers."""
    (tmp_path / "sweep.yaml").write_text(json.dumps(SMALL))
    (tmp_path / "worker.py").write_text(WORKER)
    return [sys.executable, str(tmp_path / "worker.py"), str(tmp_path / "sweep.yaml"), str(tmp_path / "out")]


@pytest.mark.long
def test_killed_after_its_first_trials_it_goes_on_in_two_workers(finished, command, tmp_path):
    # What this run of the tests has compiled serves the workers too.
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": os.environ["POTLP_TEST_CACHE"]}
    process = subprocess.Popen([*command, "1"], env=environment)
    while not (tmp_path / "out" / RESULTS).exists() or not Store(tmp_path / "out" / RESULTS).count():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = _rows(tmp_path / "out")
    assert 1 <= len(before) < 9
    assert subprocess.run([*command, "2"], env=environment).returncode == 0
    assert _rows(tmp_path / "out") == _rows(finished)


def _two_workers_of(process):
    """The workers of a running command, once there are two."""
    while len(workers := workers_of(process.pid)) < 2:
        assert process.poll() is None
        time.sleep(0.05)
    return workers


needs_proc = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="processes are found in /proc")


@pytest.mark.long
@needs_proc
def test_after_sigterm_the_command_ends_with_its_workers_and_says_so(command):
    process = subprocess.Popen([*command, "2"], stderr=subprocess.PIPE, text=True)
    workers = _two_workers_of(process)
    starts = [process_start(worker) for worker in workers]
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert f"ended by SIGTERM; {KEPT}" in errors
    assert all(process_start(worker) != start for worker, start in zip(workers, starts, strict=True))


@pytest.mark.long
@needs_proc
def test_a_sweep_goes_on_when_a_worker_is_killed_and_says_so(finished, command, tmp_path):
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": os.environ["POTLP_TEST_CACHE"]}
    process = subprocess.Popen([*command, "2"], env=environment, stderr=subprocess.PIPE, text=True)
    workers = _two_workers_of(process)
    while not (tmp_path / "out" / RESULTS).exists() or not Store(tmp_path / "out" / RESULTS).possible(
        "toy", make("toy").tasks["2"]
    ):
        assert process.poll() is None
        time.sleep(0.05)
    os.kill(workers[0], signal.SIGKILL)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert "1 of 2 workers ended; what they had begun begins again elsewhere" in errors
    assert _rows(tmp_path / "out") == _rows(finished)


def test_where_no_worker_can_be_started_the_message_says_what_to_do(tmp_path, monkeypatch):
    def start(*arguments, **options):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("distributed.LocalCluster", start)
    with pytest.raises(EngineError, match=r"no workers could be started .*fewer --processes"):
        run_sweep(_specification(), tmp_path, 2)


def _potlp(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_command_runs_and_shows_the_tables(finished, tmp_path):
    specification = tmp_path / "sweep.yaml"
    specification.write_text(json.dumps(SMALL))
    told = _potlp("sweep", specification, "--out", finished, "--processes", 1, "--json")
    assert told.exit_code == 0, told.stderr
    (cell,) = json.loads(told.stdout)["cells"]
    assert cell["satisfied"]["pairs"] == 3
    shown = _potlp("sweep", "show", finished)
    assert "!hazard U goal" in shown.stdout
    assert "optimistic" in shown.stdout


def test_the_report_holds_tables_plots_and_replays_of_the_trials_as_they_were(finished, tmp_path):
    page = tmp_path / "report.html"
    told = _potlp("report", finished, "--out", page, "--replays", 1)
    assert told.exit_code == 0, told.stderr
    text = page.read_text("utf-8")
    assert text.count("<svg") == 3
    assert "!hazard U goal" in text
    assert not re.findall(r"""<(?:img|script|link)[^>]*(?:src|href)\s*=\s*["'](?!data:)""", text)
    data = re.findall(r'<script type="application/json" id="replay-0-\d">(.*?)</script>', text)
    rows = [row for row in _rows(finished) if row.item.policy == "optimistic"]
    paths = {path_text(np.array(json.loads(entry)["path"], np.int32)) for entry in data}
    assert len(data) == 2
    assert paths <= {row.path for row in rows}


def test_a_trial_of_a_sweep_is_looked_at_as_it_was(finished, tmp_path):
    told = _potlp("sweep", "trial", finished, "--world", 6, "--out", tmp_path, "--no-animation", "--json")
    assert told.exit_code == 0, told.stderr
    # What the report shows: the last policy, where PO-TLP took no part.
    (row,) = [row for row in _rows(finished) if (row.item.policy, row.item.world) == ("optimistic", 6)]
    trial = load_trial(tmp_path / "trial.json")
    assert (trial.policy, trial.world_number, trial.environment) == ("optimistic", 6, "toy/validation")
    assert (path_text(np.array(trial.path, np.int32)), trial.cost) == (row.path, row.cost)
    assert json.loads(told.stdout)["files"] == [str(tmp_path / name) for name in ("trial.json", "trial.png")]
    assert json.loads(told.stdout)["differs_from_row"] == []
    assert "not that of" not in told.stderr
    # By the number in the family, by the formula of the tables, and by one that means the same; of another policy.
    for task in ("2", "!hazard U goal", "(!(hazard)) U (goal)"):
        told = _potlp("sweep", "trial", finished, "--world", 6, "--task", task, "--policy", "baseline")
        assert told.exit_code == 0, told.stderr
        assert re.search(r"policy +baseline", told.stdout)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["trial.json", "trial.png"]


@pytest.fixture
def changed(finished, tmp_path):
    """A copy of the sweep with a row that says otherwise, in the first world of the baseline; and the row of before."""
    folder = tmp_path / "sweep"
    shutil.copytree(finished, folder)
    store = Store(folder / RESULTS)
    row = next(row for row in store.rows() if row.item.policy == "baseline")
    store._connection.execute("DELETE FROM trials WHERE policy = 'baseline' AND world = ?", (row.item.world,))
    store.finish([dataclasses.replace(row, decisions=row.decisions + 1, status=2, commit="0123abc")])
    store.close()
    return folder, row


def test_in_what_a_trial_goes_otherwise_today_is_said(finished, changed):
    folder, row = changed
    arguments = ("--world", row.item.world, "--policy", "baseline", "--json")
    told = _potlp("sweep", "trial", folder, *arguments)
    said = " ".join(told.stderr.split())
    assert re.search(rf"cost {row.cost:.2f}, by commit 0123abc\); it differs in: decisions, status\.", said), said
    assert json.loads(told.stdout)["differs_from_row"] == ["decisions", "status"]
    assert "not that of" not in _potlp("sweep", "trial", finished, *arguments).stderr


def test_a_trial_that_is_not_satisfied_ends_with_1_when_it_is_looked_at_too(tmp_path):
    settings = {"budget_factor": 0.01}
    run_sweep(_specification(policies=["baseline"], worlds=1, settings=settings), tmp_path, 1)
    told = _potlp("sweep", "trial", tmp_path, "--world", 5)
    assert "budget" in told.stdout
    assert told.exit_code == 1


def test_why_there_is_no_trial_is_said(finished, changed, tmp_path):
    folder, row = changed
    store = Store(folder / RESULTS)
    store._connection.execute("DELETE FROM trials WHERE policy = 'baseline'")
    store.set_broken(row.item, "3 workers that began it died")
    store.set_possible("toy", row.item.task, {99: False})
    store.close()
    for world, message in (
        (row.item.world, "it was given up: 3 workers that began it died"),
        (99, "the task is impossible in it"),
        (6, "the sweep has not run it; there are: none"),
    ):
        told = _potlp("sweep", "trial", folder, "--world", world, "--policy", "baseline")
        assert told.exit_code == 2
        assert f"--world {world}: baseline has no trial there: {message}" in " ".join(told.stderr.split())
    # Before anything runs.
    told = _potlp("sweep", "trial", finished, "--world", 6, "--out", finished / RESULTS)
    assert "is a file; give a folder" in told.stderr
    told = _potlp("sweep", "trial", finished / RESULTS, "--world", 6)
    assert "is a file; give the folder of the sweep" in told.stderr


def test_what_a_sweep_was_run_with_is_to_be_put_back(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "sweep")
    store = Store(tmp_path / "sweep" / RESULTS)
    # As of a sweep that asked a file which is gone.
    facts = store.facts()
    gone = facts["specification"] | {"estimator": "gone.npz"}
    store._connection.execute("DELETE FROM facts WHERE name = 'specification'")
    store.agree({"specification": gone})
    store.close()
    told = _potlp("sweep", "trial", tmp_path / "sweep", "--world", 6)
    assert told.exit_code == 2
    assert re.search(r"put back what the sweep was run with: .*gone\.npz", " ".join(told.stderr.split()))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--world", 99), "--world 99: optimistic has no trial there: the sweep has not run it; there are: 5, 6, 7"),
        (("--world", 6, "--task", "F hazard"), "--task F hazard: the sweep has no such task; it has: !hazard U goal"),
        (("--world", 6, "--task", "7"), "toy has no task 7"),
        (("--world", 6, "--policy", "oracle"), "--policy oracle: the sweep has no such policy; it has: known-map"),
        (("--world", 6, "--environment", "rooms"), "--environment rooms: the sweep has no such environment.*toy"),
        (("--world", 6, "--no-animation"), "--no-animation needs --out"),
    ],
)
def test_a_trial_that_the_sweep_does_not_have_is_refused_with_those_that_it_has(finished, arguments, message):
    told = _potlp("sweep", "trial", finished, *arguments)
    assert told.exit_code == 2
    assert re.search(message, " ".join(told.stderr.split())), told.stderr


def test_of_several_tasks_one_is_to_be_named(tmp_path):
    store = Store(tmp_path / RESULTS)
    store.agree({"specification": _specification(tasks=[1, 2]).to_dict(), "estimator": None})
    store.close()
    told = _potlp("sweep", "trial", tmp_path, "--world", 5)
    assert re.search(r"--task: name one; it has: .*, !hazard U goal", " ".join(told.stderr.split())), told.stderr


@pytest.mark.parametrize(
    ("folder", "title"),
    [("out/validation", "Sweep validation"), ("out/sweep", "Sweep"), ("sweep-of-halls", "Sweep-of-halls")],
)
def test_a_report_is_titled_after_its_folder(folder, title):
    assert page_title(Path(folder)) == title


def test_a_report_of_the_folder_one_stands_in_has_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert page_title(Path()) == f"Sweep {tmp_path.name}"


def test_a_report_writes_each_policy_in_its_colour():
    policies = ["known-map", "baseline", "first", "second"]
    rows = {policy: _row(Item("toy", "F goal", policy, 0)) for policy in policies}
    data = {policy: Shown(f"worst {policy}", policy, 0, 1.0, "satisfied", 2.0, {}) for policy in policies}
    page = report_page("a", [], policies, [Cell("toy", "F goal", [rows], [data["second"]])])
    styles = policy_styles(policies)
    for policy in policies[1:]:
        assert f'style="color: {styles[policy].colour}">{policy}</td>' in page
    # Once in the table, once among the trials to look at.
    assert page.count(f'style="color: {styles["second"].colour}"') == 2
    # The page's own ink, which a dark screen turns.
    assert "<td>known-map</td>" in page


def test_policies_that_were_in_different_worlds_are_not_compared():
    """An environment that draws from more than its key makes another world in every process."""
    rows = [_row(Item("toy", "F goal", policy, world)) for policy in ("baseline", "potlp") for world in (3, 4)]
    assert len(pair_rows(rows, ["baseline", "potlp"])) == 2
    rows[3] = dataclasses.replace(rows[3], world_digest="another")
    with pytest.raises(StoreError, match="toy: world 4 was not the same for all policies"):
        pair_rows(rows, ["baseline", "potlp"])


def test_worlds_that_are_one_world_are_told():
    pairs = [{"baseline": _row(Item("toy", "F goal", "baseline", world))} for world in range(3)]
    (line,) = remarks_on_worlds(pairs)
    assert line.startswith("All 3 worlds are the same one")
    other = {"baseline": dataclasses.replace(pairs[0]["baseline"], world_digest="another")}
    assert remarks_on_worlds([*pairs, other]) == remarks_on_worlds(pairs[:1]) == []


def test_a_trial_that_gave_up_is_none_of_the_best():
    def pair(world, cost, outcome="satisfied", status=0):
        rows = {policy: _row(Item("toy", "F goal", policy, world), cost=100.0) for policy in ("known-map", "baseline")}
        ours = _row(Item("toy", "F goal", "potlp", world), cost=cost)
        return rows | {"potlp": dataclasses.replace(ours, outcome=outcome, status=status, budget=1000.0)}

    pairs = [pair(0, 90.0), pair(1, 3.0, "stuck"), pair(2, 120.0), pair(3, 1.0, status=int(Status.TREE_OVERFLOW))]
    found = [(reason, ours.item.world) for reason, ours, _ in _notable(pairs, "potlp", 1)]
    assert found == [("worst 1", 1), ("best 1", 0)]
    # Drawn as it counts: 90 + 1000 + 120, beside 300 of the baseline.
    assert [charged_cost(entry["potlp"]) for entry in pairs[:3]] == [90.0, 1000.0, 120.0]


def test_a_report_without_replays_runs_nothing_again(finished, tmp_path, monkeypatch):
    monkeypatch.delattr("potlp_jax.sweep.work.run_trial")
    told = _potlp("report", finished, "--out", tmp_path / "report.html", "--replays", 0)
    assert told.exit_code == 0, told.stderr
    assert 'id="replay-' not in (tmp_path / "report.html").read_text("utf-8")


def test_of_a_world_or_two_a_report_promises_no_interval():
    costs = {"known-map": 10.0, "baseline": 30.0, "oracle": 10.0, "potlp": 17.0}
    rows = {policy: dataclasses.replace(_row(Item("toy", "F goal", policy, 0)), cost=c) for policy, c in costs.items()}
    page = report_page("a", [], list(costs), [Cell("toy", "F goal", [rows], [])])
    assert "- to -" not in page
    assert "± -" not in page
    # The known map attains all too, but it is a bound.
    assert re.findall(r'<tr class="best"><td[^>]*>([^<]*)<', page) == ["oracle"]
    # Ticks of worlds between 0 and 1 are none of a whole number.
    worlds = page.split("<figure>")[3]
    assert not re.search(r">0\.5<", worlds[: worlds.index("cost of all of them")])


def test_progress_says_nothing_twice(monkeypatch, caplog):
    monkeypatch.setattr("potlp_jax.cli.sweep.SECONDS_BETWEEN_LINES", 0.0)
    reporter = _Reporter()
    with caplog.at_level("INFO", logger="potlp_jax"):
        for done in (0, 0, 1):
            reporter.report(Progress(done, 2))
    reporter.close()
    assert [record.message.partition(" (")[0] for record in caplog.records] == ["0 of 2 trials", "1 of 2 trials"]


def test_the_rate_is_that_of_trials_and_not_of_compilation(monkeypatch, caplog):
    clock = [0.0]
    monkeypatch.setattr("potlp_jax.cli.sweep.SECONDS_BETWEEN_LINES", 0.0)
    monkeypatch.setattr("potlp_jax.cli.sweep.time.monotonic", lambda: clock[0])
    reporter = _Reporter()
    with caplog.at_level("INFO", logger="potlp_jax"):
        # Eight trials after 100 seconds of compilation, and four more in ten.
        for clock[0], done in ((0.0, 0), (100.0, 8), (110.0, 12)):
            reporter.report(Progress(done, 100))
    reporter.close()
    assert [record.message for record in caplog.records] == [
        "0 of 100 trials",
        "8 of 100 trials",
        "12 of 100 trials (0.40 a second, 4 min remaining)",
    ]


def test_where_the_loss_is():
    costs = {"known-map": 10.0, "baseline": 30.0, "oracle": 12.0, "potlp": 17.0}
    rows = {policy: dataclasses.replace(_row(Item("toy", "F goal", policy, 0)), cost=c) for policy, c in costs.items()}
    page = report_page("a", [], list(costs), [Cell("toy", "F goal", [rows], [])])
    assert "Of 20.0 that could be saved in a world, potlp saves 13.0 (65.0 %)" in page
    assert "The estimator costs 5.0 (25.0 %" in page
    assert "planner 2.0 (10.0 %" in page


def test_an_invalid_trial_is_in_no_table_and_no_plot_of_a_report():
    policies = ["known-map", "baseline", "potlp"]
    rows = [{policy: _row(Item("toy", "F goal", policy, world)) for policy in policies} for world in range(3)]
    rows[0]["potlp"] = dataclasses.replace(rows[0]["potlp"], status=int(Status.INVALID))
    page = report_page("a", [], policies, [Cell("toy", "F goal", rows, [])])
    assert "potlp (2 worlds)" in page
    assert page.count('<caption class="note">') == 1
    assert '<caption class="note">2 worlds in which every policy satisfied the task' in page
    assert "left out of all tables: 1." in page


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed to look at the page with")
def test_a_browser_opens_a_replay_and_closes_it(finished, tmp_path):
    page = tmp_path / "report.html"
    assert _potlp("report", finished, "--out", page, "--replays", 1).exit_code == 0
    tour = """<script>
const button = document.querySelector("button[data-replay]"), shown = [];
for (let i = 0; i < 2; i++) { button.click(); shown.push(document.querySelectorAll("canvas").length); }
document.body.append(Object.assign(document.createElement("pre"), {id: "result", textContent: JSON.stringify(shown)}));
</script></body>"""
    page.write_text(page.read_text("utf-8").replace("</body>", tour), "utf-8")
    assert dump_page(page, tmp_path / "profile") == [1, 0]


def test_a_second_command_on_the_folder_is_refused_while_readers_are_free(finished, tmp_path):
    folder = tmp_path / "sweep"
    shutil.copytree(finished, folder)
    with only_writer(folder, StoreError):
        longer = _specification(worlds=4)
        with pytest.raises(StoreError, match="another command works on it"):
            run_sweep(longer, folder)
        # Nor does it forget what was given up.
        with pytest.raises(StoreError, match="another command works on it"):
            run_sweep(longer, folder, retry_broken=True)
        told = json.loads(_potlp("sweep", "status", folder, "--json").stdout)
        assert (told["done"], told["broken"]) == (told["total"], 0)
        assert sum(told["of_policies"].values()) == told["total"]
        assert f"{told['done']} of {told['total']} trials done" in _potlp("sweep", "status", folder).stdout
        assert _potlp("sweep", "show", folder).exit_code == 0


def test_export_has_a_line_per_trial(finished, tmp_path):
    assert _potlp("sweep", "export", finished, "--out", tmp_path / "a.csv").exit_code == 0
    with (tmp_path / "a.csv").open() as file:
        read = list(csv.DictReader(file))
    assert {(row["split"], row["seed"]) for row in read} == {("validation", "0")}
    assert [(row["policy"], int(row["world"]), float(row["cost"])) for row in read] == [
        (row.item.policy, row.item.world, row.cost) for row in _rows(finished)
    ]
    pandas = pytest.importorskip("pandas")
    assert _potlp("sweep", "export", finished, "--out", tmp_path / "a.parquet").exit_code == 0
    assert pandas.read_parquet(tmp_path / "a.parquet")["cost"].tolist() == [row.cost for row in _rows(finished)]


def test_parquet_without_its_library_fails_with_what_to_install(finished, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    told = _potlp("sweep", "export", finished, "--out", tmp_path / "a.parquet")
    assert told.exit_code == 1
    assert "pip install 'potlp-jax[train]', or write a .csv" in told.stderr


@pytest.mark.parametrize("name", ["a.csv", "a.parquet"])
def test_an_export_into_a_folder_that_is_not_there_is_named(finished, tmp_path, name):
    told = _potlp("sweep", "export", finished, "--out", tmp_path / "gone" / name)
    assert told.exit_code != 0
    assert f"gone/{name}: No such file or directory" in told.stderr.replace("\n", "")


def test_a_report_into_a_folder_that_is_not_there_is_named_before_trials_run_again(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(Sweep, "trial", lambda *_: pytest.fail("it runs a trial"))
    told = _potlp("report", finished, "--out", tmp_path / "gone" / "page.html")
    assert told.exit_code == 2
    assert "there is no folder" in told.stderr


def test_export_names_status_bits(tmp_path):
    store = Store(tmp_path / RESULTS)
    flagged = Status.SUBGOAL_OVERFLOW | Status.FALLBACK
    store.agree({"specification": _specification().to_dict()})
    store.finish([dataclasses.replace(_row(ITEMS[0]), status=int(flagged)), _row(ITEMS[1])])
    store.close()
    assert _potlp("sweep", "export", tmp_path, "--out", tmp_path / "a.csv").exit_code == 0
    with (tmp_path / "a.csv").open() as file:
        assert sorted(row["status"] for row in csv.DictReader(file)) == ["", "subgoal_overflow fallback"]


def test_wrong_folders_and_names_are_refused(finished, tmp_path):
    told = _potlp("sweep", "show", tmp_path)
    assert told.exit_code == 2
    assert "begin one with" in told.stderr
    told = _potlp("sweep", "export", finished, "--out", tmp_path / "a.xlsx")
    assert told.exit_code == 2
    assert ".csv or .parquet" in told.stderr


def test_a_task_that_is_impossible_everywhere_ends_the_sweep(tmp_path, monkeypatch):
    monkeypatch.setattr("potlp_jax.sweep.runner.IMPOSSIBLE_IN_A_ROW", 3)
    with pytest.raises(ValueError, match="impossible in 3 worlds in a row, up to number 7"):
        run_sweep(_specification(tasks=["F (goal & hazard)"], policies=["baseline"]), tmp_path, 1)


def test_an_experiment_counts_the_decisions_and_flagged_trials_of_a_policy():
    overflowed = dataclasses.replace(_row(Item("toy", "F goal", "potlp", 0)), status=5, decisions=6, seconds=3.5)
    found = decisions_of([overflowed, _row(Item("toy", "F goal", "potlp", 1)), _row(ITEMS[0])], ["potlp"])["potlp"]
    assert (found["trials"], found["number"], found["seconds"]) == (2, 8, 0.5)
    flagged = {name for name, count in found["flagged"].items() if count}
    assert flagged == {"SUBGOAL_OVERFLOW", "DEPTH_OVERFLOW"}


def test_the_commit_is_the_packages_own_and_not_that_of_a_repository_around_it(tmp_path, monkeypatch):
    def git(*arguments):
        subprocess.run(["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a", *arguments], check=True)

    installed = tmp_path / "environment" / "potlp_jax" / "sweep" / "rows.py"
    installed.parent.mkdir(parents=True)
    installed.touch()
    (tmp_path / ".gitignore").write_text("environment\n")
    git("init", "--quiet")
    git("add", ".")
    git("commit", "--quiet", "--message", "a project that uses the package")
    monkeypatch.setattr("potlp_jax.sweep.rows.__file__", str(installed))
    try:
        source_commit.cache_clear()
        assert source_commit() == ""
        git("add", "--force", "environment")
        git("commit", "--quiet", "--message", "the package itself")
        source_commit.cache_clear()
        assert len(source_commit()) == 40
    finally:
        source_commit.cache_clear()


def test_a_schema_that_is_no_text_is_damage(tmp_path):
    Store(tmp_path / "whole").close()
    whole = (tmp_path / "whole").read_bytes()
    (tmp_path / "damaged").write_bytes(whole.replace(b"CREATE TABLE facts", b"CREATE TABLE f\xe9cts"))
    with pytest.raises(StoreError, match="damaged"):
        Store(tmp_path / "damaged", read_only=True)


def test_a_table_says_which_worlds_it_does_not_hold():
    def pair(world, outcome="satisfied", status=0):
        rows = {policy: _row(Item("toy", "F goal", policy, world), cost=100.0) for policy in ("known-map", "baseline")}
        rows |= {"potlp": _row(Item("toy", "F goal", "potlp", world), cost=150.0)}
        rows["baseline"] = dataclasses.replace(rows["baseline"], cost=200.0)
        rows["potlp"] = dataclasses.replace(rows["potlp"], outcome=outcome, status=status, budget=500.0)
        return rows.values()

    policies = ["known-map", "baseline", "potlp"]
    whole = [row for world in range(4) for row in pair(world)]
    table = compare_first(whole, "F goal", policies, 9, lambda world: world // 2)
    assert table["buildings"] == 2
    assert len(table_lines(table, policies)) == 3
    # The other building is in no figure.
    short = [*whole[:6], *pair(2, "stuck"), *pair(3, status=int(Status.TREE_OVERFLOW))]
    table = compare_first(short, "F goal", policies, 9, lambda world: world // 2)
    assert table["buildings"] == 1
    *lines, last = table_lines(table, policies)
    assert "| 2 in 1 building | 150.0 | 50.0 % (no interval) | 25.0 % | 25.0 no error % |" in lines[-1]
    assert "worlds left out: 1 not satisfied, 1 cut short; shares with unsatisfied trials charged their budgets" in last
    assert "potlp -66.7 % " in last


def test_real_maps_compare_potlp_with_another_baseline_on_the_same_worlds():
    rows = [_row(Item("toy", "F goal", policy, 0)) for policy in ("known-map", "baseline", "potlp")]
    others = [dataclasses.replace(row, cost=row.cost + 5) for row in rows]
    found = {row.item.policy: row.cost for row in exchange(rows, others)}
    assert found == {"known-map": rows[0].cost, "baseline": others[1].cost, "potlp": rows[2].cost}
    assert len(exchange(rows, others)) == 3


def test_the_worst_trials_of_a_sweep_are_run_again_as_it_ran_them(tmp_path):
    def swept(**changes):
        file = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        file.mkdir()
        store = Store(file / RESULTS)
        given = {"environments": ["toy"], "tasks": ["F goal"], "policies": ["potlp"], "worlds": 1, **changes}
        store.agree({"specification": specification_from_dict(given, "here").to_dict()})
        store.close()
        return file

    found = experiment_of(swept(split="test"), 8)
    assert (found.generator.name, found.split, found.given, found.buildings) == ("toy", Split.TEST, None, 8)
    with pytest.raises(ValueError, match="has trials in campus-medium, campus-small: give a sweep of one environment"):
        experiment_of(swept(environments=["campus-small", "campus-medium"], tasks=[1]), 8)
    with pytest.raises(ValueError, match="has the seed 1: give a sweep with seed 0"):
        experiment_of(swept(seed=1), 8)
    own, arm = {"replan_distance": 3.0}, Arm.BASELINE
    for changes in ({"settings": own}, {"policy_settings": {"potlp": own}}):
        other = experiment_of(swept(**changes), 8)
        assert (other.config.replan_distance, found.config) == (3.0, TrialConfig())
        # Trials with other settings are other trials: their rows are not taken for those of the family's.
        assert other.key("F goal", 0, arm) != found.key("F goal", 0, arm)
    assert other.run("1", 0, arm).config["replan_distance"] == 3.0
