"""The auditor fails on everything that is wrong: each part of a record, and of a sweep's row, is changed in turn."""

import dataclasses
import json
import re
import sys

import jax
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.rooms import Rooms
from potlp_jax.environments.splits import Split
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import PropositionsError
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.sweep.audit import audit_rows
from potlp_jax.sweep.rows import path_text, read_path
from potlp_jax.sweep.runner import RESULTS, run_sweep
from potlp_jax.sweep.specification import specification_from_dict
from potlp_jax.sweep.store import Store
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import NEVER_SEEN, Outcome
from potlp_jax.trials.run import run
from potlp_jax.verify.audit import (
    formula_of,
    path_cost,
    problems_of,
    problems_of_ending,
    problems_of_path,
    task_of_record,
)
from potlp_jax.verify.semantics import has_language_of
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import make_world, world_digest
from potlp_jax.world.sensing import SensorConfig

ENVIRONMENT = "potlp_jax.environments.rooms:Rooms.toy"
ROOMS = Rooms.toy()
# Not world 0, where two decisions are enough.
NUMBER = 1
WORLDS = [ROOMS.world(number, Split.VALIDATION) for number in range(NUMBER, NUMBER + 4)]
WORLD = WORLDS[0]
FORMULA = "F(a & F c)"
TASK = WORLD.task(FORMULA)
CONFIG = TrialConfig(
    sensor=SensorConfig(range_cells=6.0),
    decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=4), search=BestFirstConfig(simulations=20)),
)


SETTINGS = {
    "sensor": {"range_cells": 6.0},
    "decision": {"frontiers": {"max_subgoals": 4}, "search": {"simulations": 20}},
}


@pytest.fixture(scope="module")
def trial():
    trial = run_trial(
        WORLD, TASK, Policy.BASELINE, jax.random.key(0), CONFIG, environment="rooms/validation", world_number=1
    )
    assert trial.outcome is Outcome.SATISFIED
    assert len(trial.decisions) > 3
    assert problems_of(trial, TASK, WORLD) == []
    return trial


def _with_path(trial, path):
    """The trial with another path, and everything else that follows from a path made to fit it."""
    letters = np.asarray(WORLD.letters)
    word = tuple(int(letters[cell]) for cell in path)
    states, state = [], int(TASK.dfa.initial)
    for letter in word:
        state = int(TASK.dfa.transitions[state, letter])
        states.append(state)
    cost = path_cost(WORLD, path)
    return dataclasses.replace(
        trial, path=tuple(path), word=word, states=tuple(states), cost=trial.cost if cost is None else cost
    )


# The world, its number, its split, its start.


@pytest.mark.parametrize("world", [WORLDS[1], ROOMS.world(NUMBER, Split.TEST), ROOMS.world(NUMBER, Split.TRAINING)])
def test_another_world_number_or_split_is_found(trial, world):
    assert "was in another world" in problems_of(trial, TASK, world)[0]
    # Also where the record's copy was changed to agree with the true world, and only the path is of another one.
    copied = dataclasses.replace(trial, world=world)
    assert problems_of(copied, TASK, world)


@pytest.mark.parametrize("world", WORLDS[1:])
def test_a_path_of_another_world_is_found(trial, world):
    (problem,) = problems_of_path(world, trial.path, trial.cost, trial.outcome, FORMULA)
    assert problem.startswith(f"begins in {trial.path[0]}")
    # From the same start: walls and letters tell.
    moved = dataclasses.replace(world, start=WORLD.start)
    assert problems_of_path(moved, trial.path, trial.cost, trial.outcome, FORMULA)


@pytest.mark.parametrize(
    "change",
    [
        {"occupied": WORLD.occupied.at[1, 1].set(~WORLD.occupied[1, 1])},
        {"letters": WORLD.letters.at[1, 1].set(5)},
        {"start": WORLD.start + 1},
        {"resolution": WORLD.resolution * 2},
        {"extent": WORLD.extent + 1},
        {"propositions": WORLD.propositions[::-1]},
        {"appearance": dataclasses.replace(WORLD.appearance, light=WORLD.appearance.light * 0.5)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_change_of_the_records_world_is_found(trial, change):
    changed = dataclasses.replace(trial, world=dataclasses.replace(WORLD, **change))
    assert f"another world: {next(iter(change)).replace('appearance', 'light')}" in problems_of(changed, TASK, WORLD)[0]


def test_another_start_is_found(trial):
    second = _with_path(trial, trial.path[1:])
    assert "begins in" in problems_of(second, TASK, WORLD)[0]
    (problem,) = problems_of_path(WORLD, trial.path[1:], second.cost, trial.outcome, FORMULA)
    assert f"the start of the world is {trial.path[0]}" in problem
    assert "begins in no cell" in problems_of_path(WORLD, [], 0.0, Outcome.STUCK, FORMULA)[0]


# The task.


@pytest.mark.parametrize("formula", ["F c", "F(c & F a)", "F(a & F c) & F b", "F a & F c"])
def test_another_task_is_found(trial, formula):
    other = WORLD.task(formula)
    assert f"was for the task {FORMULA!r}, not for {formula!r}" in problems_of(trial, other, WORLD)[0]
    # A record whose text was changed as well still holds the automaton.
    renamed = dataclasses.replace(trial, task_text=formula)
    assert "its automaton is not that of the task" in problems_of(renamed, other, WORLD)


def test_another_order_of_the_labels_is_found(trial):
    swapped = Task.from_formula(FORMULA, TASK.propositions[::-1])
    assert problems_of(trial, swapped, WORLD)
    assert problems_of(dataclasses.replace(trial, propositions=swapped.propositions), swapped, WORLD)
    renamed = dataclasses.replace(WORLD, propositions=("b", "a", "c"))
    assert problems_of_path(renamed, trial.path, trial.cost, trial.outcome, FORMULA)


# The path, the cost, the outcome and what else is in the record.


def test_a_change_of_any_cell_of_the_path_is_found(trial):
    """Also where the other cell is as good: each leg is the one that its decision handed out."""
    as_good = 0
    for step, (row, column) in enumerate(trial.path):
        for i, j in ((row + 1, column), (row, column + 1), (row - 1, column), (row, column - 1)):
            path = [*trial.path[:step], (i, j), *trial.path[step + 1 :]]
            changed = _with_path(trial, path)
            assert problems_of(changed, TASK, WORLD), f"step {step} in {(i, j)}"
            as_good += changed.cost == pytest.approx(trial.cost) and path_cost(WORLD, path) is not None
    # Otherwise the test would not show what it says.
    assert as_good > 0


def test_cells_outside_of_the_map_are_found(trial):
    for cell in ((-1, 3), (3, 10**6)):
        path = (trial.path[0], cell, *trial.path[2:])
        assert "outside of the" in problems_of_path(WORLD, path, trial.cost, trial.outcome, FORMULA)[0]


def test_a_path_that_violates_is_found_whatever_it_says_of_itself():
    """A corridor with b on the way to a: told as it was, and told as a success."""
    letters = np.array([[0, 0, 0, 0, 0], [0, 0, 2, 1, 0], [0, 0, 0, 0, 0]], np.int32)
    occupied = np.ones((3, 5), bool)
    occupied[1, 1:4] = False
    world = make_world(occupied, letters, (1, 1), propositions=("a", "b"))
    through = [(1, 1), (1, 2), (1, 3)]
    formula = "!b U a"
    assert problems_of_path(world, through, 2.0, Outcome.INFEASIBLE, formula) == ["violates the formula"]
    told = problems_of_path(world, through, 2.0, Outcome.SATISFIED, formula)
    assert told == ["outcome satisfied is not what the word says", "violates the formula"]
    assert problems_of_path(world, through[:1], 0.0, Outcome.INFEASIBLE, formula) == []
    # Who is put down where the task is lost already has violated nothing.
    lost = make_world(occupied, letters, (1, 2), propositions=("a", "b"))
    assert problems_of_path(lost, [(1, 2)], 0.0, Outcome.INFEASIBLE, formula) == []


def test_a_path_that_goes_on_or_stops_short_is_found(trial):
    back = _with_path(trial, (*trial.path, trial.path[-2]))
    assert "goes on after the task was satisfied" in problems_of(back, TASK, WORLD)
    assert "outcome satisfied is not what the word says" in problems_of(_with_path(trial, trial.path[:-1]), TASK, WORLD)


def _first_seen_late(trial):
    seen = trial.first_seen.copy()
    seen[trial.path[3]] = NEVER_SEEN
    return seen


CHANGES = {
    "cost": lambda trial: {"cost": trial.cost * (1 + 1e-6)},
    "no cost": lambda trial: {"cost": float("nan")},
    "outcome": lambda trial: {"outcome": Outcome.BUDGET},
    "word": lambda trial: {"word": (trial.word[0] ^ 1, *trial.word[1:])},
    "states": lambda trial: {"states": (*trial.states[:-1], trial.states[0])},
    "seen": lambda trial: {"first_seen": _first_seen_late(trial)},
    "shape": lambda trial: {"first_seen": trial.first_seen[1:]},
    "missing decision": lambda trial: {"decisions": (*trial.decisions[:1], *trial.decisions[2:])},
    "no decisions": lambda trial: {"decisions": ()},
    "order of decisions": lambda trial: {"decisions": trial.decisions[::-1]},
    "place of a decision": lambda trial: {
        "decisions": (*trial.decisions[:-1], dataclasses.replace(trial.decisions[-1], cell=(1, 1)))
    },
    "state of a decision": lambda trial: {
        "decisions": (*trial.decisions[:-1], dataclasses.replace(trial.decisions[-1], state=99))
    },
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_the_record_is_found(trial, change):
    assert problems_of(dataclasses.replace(trial, **CHANGES[change](trial)), TASK, WORLD)


@pytest.fixture(scope="module")
def unsatisfied():
    """Trials of which nothing is promised, by how they ended: there is no goal, or the budget is too short to know."""
    world = dataclasses.replace(WORLD, letters=WORLD.letters * 0)
    task = world.task("F c")
    short = dataclasses.replace(CONFIG, budget_factor=0.1)
    return {
        Outcome.INFEASIBLE: (run_trial(world, task, "baseline", jax.random.key(0), CONFIG), task, world),
        Outcome.BUDGET: (run_trial(world, task, "baseline", jax.random.key(0), short), task, world),
    }


@pytest.mark.parametrize("ended", [Outcome.INFEASIBLE, Outcome.BUDGET])
@pytest.mark.parametrize("said", [Outcome.INFEASIBLE, Outcome.BUDGET, Outcome.STUCK, Outcome.UNFINISHED])
def test_another_way_to_fail_is_found(unsatisfied, ended, said):
    trial, task, world = unsatisfied[ended]
    assert trial.outcome is ended
    assert bool(problems_of(dataclasses.replace(trial, outcome=said), task, world)) == (said is not ended)


@pytest.mark.parametrize(
    ("outcome", "cost", "wrong"),
    [
        ("budget", 100.0, False),
        ("budget", 99.0, True),
        ("stuck", 99.0, False),
        ("stuck", 101.0, True),
        ("infeasible", 120.0, False),
        ("unfinished", 10.0, True),
        ("lost", 10.0, True),
    ],
)
def test_an_end_is_judged_by_the_budget(outcome, cost, wrong):
    assert bool(problems_of_ending(outcome, cost, 100.0)) == wrong


# Sweeps.


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """The folder, specification and rows of a small sweep."""
    folder = tmp_path_factory.mktemp("sweep")
    specification = specification_from_dict(
        {
            "environments": [ENVIRONMENT],
            "tasks": [FORMULA],
            "policies": ["baseline"],
            "worlds": 3,
            "settings": SETTINGS,
        },
        "here",
    )
    run_sweep(specification, folder, 1)
    store = Store(folder / RESULTS)
    rows = store.rows()
    store.close()
    return folder, specification, rows


def _audited(rows, split=Split.VALIDATION, seed=0):
    return [problem for _, problem in audit_rows(rows, split, seed)]


def test_a_sweep_is_audited_by_the_command(sweep):
    folder, _, rows = sweep
    result = CliRunner().invoke(app, ["audit", str(folder), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == {"trials": len(rows), "violations": 0, "problems": []}
    assert len(rows) == 6


@pytest.mark.parametrize("change", [{"split": "test"}, {"seed": 1}], ids=["split", "seed"])
def test_the_command_finds_another_split_and_seed_in_every_row(sweep, change, tmp_path):
    _, specification, rows = sweep
    store = Store(tmp_path / RESULTS)
    store.agree({"specification": {**specification.to_dict(), **change}, "estimator": None})
    store.finish(rows)
    store.close()
    result = CliRunner().invoke(app, ["audit", str(tmp_path), "--json"])
    assert result.exit_code == 1, result.output
    found = json.loads(result.stdout)["problems"]
    assert len({problem["trial"] for problem in found}) == len(rows)


def test_a_problem_that_many_trials_share_is_not_shown_for_each(sweep, tmp_path, monkeypatch):
    monkeypatch.setattr("potlp_jax.cli.audit._SHOWN", 2)
    _, specification, rows = sweep
    store = Store(tmp_path / RESULTS)
    store.agree({"specification": {**specification.to_dict(), "seed": 1}, "estimator": None})
    store.finish(rows)
    store.close()
    result = CliRunner().invoke(app, ["audit", str(tmp_path)])
    assert result.exit_code == 1
    assert result.stdout.count("another key") == 3
    assert f"\n{len(rows) - 2} more trials (--json names them): was made with another key" in result.stdout
    assert f"{len(rows)} trials, {len(rows)} problems" in result.stdout


def test_worlds_of_another_split_are_found_without_a_digest_too(sweep):
    """What other planners deliver is a path alone; the start tells first."""
    _, _, rows = sweep
    for row in rows:
        for split in (Split.TEST, Split.TRAINING):
            world = ROOMS.world(row.item.world, split)
            assert problems_of_path(world, read_path(row.path), row.cost, row.outcome, FORMULA)


def _moved(row, **changes):
    return dataclasses.replace(row, item=dataclasses.replace(row.item, **changes))


ROW_CHANGES = {
    "world": lambda row: _moved(row, world=row.item.world + 7),
    "environment": lambda row: _moved(row, environment="rooms"),
    "task": lambda row: _moved(row, task="F b & F(c & F a)"),
    "cost": lambda row: dataclasses.replace(row, cost=row.cost + 1e-3),
    "outcome": lambda row: dataclasses.replace(row, outcome="stuck"),
    "start": lambda row: dataclasses.replace(row, path=path_text(read_path(row.path) + 1)),
    "end": lambda row: dataclasses.replace(row, path=row.path[:-1]),
    "move": lambda row: dataclasses.replace(row, path=row.path[:-1] + str((int(row.path[-1]) + 1) % 8)),
    "text": lambda row: dataclasses.replace(row, path="no path"),
    "steps": lambda row: dataclasses.replace(row, steps=row.steps + 1),
    "key": lambda row: dataclasses.replace(row, key=(row.key[0], row.key[1] ^ 1)),
    "digest": lambda row: dataclasses.replace(row, world_digest="0" * 16),
}


@pytest.mark.parametrize("change", ROW_CHANGES)
def test_a_change_of_any_row_is_found(sweep, change):
    _, _, rows = sweep
    assert _audited(rows) == []
    for number, row in enumerate(rows):
        assert _audited([*rows[:number], ROW_CHANGES[change](row), *rows[number + 1 :]])


@pytest.mark.parametrize("change", [{"task": "F a"}, {"policy": "oracle"}, {"task": "F(a & F c) | F b"}])
def test_a_row_that_the_sweep_does_not_have_is_found(sweep, change, tmp_path):
    """Its path is legal, and satisfies the other task too."""
    _, specification, rows = sweep
    assert _audited([_moved(rows[0], **change)]) == []
    store = Store(tmp_path / RESULTS)
    store.agree({"specification": specification.to_dict(), "estimator": None})
    store.finish([_moved(rows[0], **change), *rows[1:]])
    store.close()
    result = CliRunner().invoke(app, ["audit", str(tmp_path), "--json"])
    assert result.exit_code == 1, result.output
    (problem,) = json.loads(result.stdout)["problems"]
    assert "that the sweep does not have" in problem["problem"]


def test_a_world_that_was_edited_after_the_sweep_is_found(sweep):
    """A map in a file may change: the rows are of what it was, though each path is still legal in what it is."""
    _, _, rows = sweep

    class Repainted(Rooms):
        def draw(self, key):
            world = super().draw(key)
            look = dataclasses.replace(world.appearance, light=world.appearance.light * 0.5)
            return dataclasses.replace(world, appearance=look)

    repainted = Repainted(ROOMS.config)
    problems = [problem for _, problem in audit_rows(rows, Split.VALIDATION, generator_of=lambda _: repainted)]
    assert len(problems) == len(rows)
    assert all(problem.startswith("was in another world") for problem in problems)


def test_digests_differ_where_anything_does():
    changed = [
        dataclasses.replace(WORLD, start=WORLD.start + 1),
        dataclasses.replace(WORLD, propositions=WORLD.propositions[::-1]),
        dataclasses.replace(WORLD, resolution=WORLD.resolution * 2),
        *WORLDS[1:],
    ]
    assert len({world_digest(world) for world in [WORLD, *changed]}) == len(changed) + 1
    assert world_digest(WORLD) == world_digest(ROOMS.world(NUMBER, Split.VALIDATION))


# A record in a file.


def _command(trial, folder):
    trial.save(folder / "trial.json")
    result = CliRunner().invoke(app, ["audit", str(folder)])
    return result.exit_code, result.output


def test_a_record_is_audited_by_the_command(tmp_path):
    trial = run(ENVIRONMENT, FORMULA, "baseline", 1, split="validation", config=CONFIG)
    assert _command(trial, tmp_path)[0] == 0
    for change in (
        {"world_number": 2},
        {"environment": f"{ENVIRONMENT}/test"},
        {"task_text": "F c"},
        {"cost": trial.cost - 1},
    ):
        code, said = _command(dataclasses.replace(trial, **change), tmp_path)
        assert (code, "1 trials, 0 problems" in said) == (1, False)
    for unknown in ({"world_number": None}, {"environment": ""}, {"environment": "log:drive.bag"}):
        assert _command(dataclasses.replace(trial, **unknown), tmp_path)[0] == 2


# Tasks from files.


MAIL = """HOA: v1
NAMED
States: 2
Start: 0
AP: 1 "goal"
Acceptance: 1 Inf(0)
--BODY--
State: 0
[0] 1
[!0] 0
State: 1 {0}
[t] 1
--END--
"""
"""Reach the goal, as an automaton."""


# The last two read as formulas, and as the number of a task: of another language than the automaton's.
NAMES = ["", 'name: "deliver the mail"', 'name: "goal"', 'name: "1"']


@pytest.mark.long
@pytest.mark.parametrize("name", [*NAMES, 'name: "F goal"'])
def test_a_sweep_of_an_automaton_is_audited_whatever_becomes_of_its_file(tmp_path, monkeypatch, name):
    file, out = tmp_path / "tasks" / "mail.hoa", tmp_path / "out"
    file.parent.mkdir()
    file.write_text(MAIL.replace("NAMED\n", f"{name}\n" if name else ""))
    sweep = file.with_name("sweep.yaml")
    sweep.write_text("environments: [toy]\ntasks: [mail.hoa]\npolicies: [baseline]\nworlds: 2\n")
    # Files are named as the specification has them, beside it.
    monkeypatch.chdir(tmp_path)
    command = ["sweep", str(sweep), "--out", str(out), "--processes", "1"]
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0, ran.output
    file.rename(file.with_name("elsewhere.hoa"))
    audited = CliRunner().invoke(app, ["audit", str(out)])
    assert (audited.exit_code, "4 trials, 0 problems" in audited.output) == (0, True), audited.output
    store = Store(out / RESULTS, read_only=True)
    rows = store.rows()
    store.close()
    assert {row.item.task for row in rows} == {"F goal" if "F goal" in name else "mail.hoa"}
    # A word that does not do what the automaton asks for is found.
    lied = [dataclasses.replace(row, outcome="stuck") for row in rows]
    specification = specification_from_dict(
        {**yaml.safe_load(sweep.read_text()), "tasks": ["elsewhere.hoa"]}, "", file.parent
    )
    automata = {rows[0].item.task: specification.automata[0][1]}
    assert len({row.item for row, _ in audit_rows(lied, Split.VALIDATION, automata=automata)}) == len(rows)


def test_a_sweep_does_not_go_on_with_another_automaton(tmp_path):
    file, out = tmp_path / "mail.hoa", tmp_path / "out"
    file.write_text(MAIL.replace("NAMED\n", ""))
    sweep = tmp_path / "sweep.yaml"
    sweep.write_text("environments: [toy]\ntasks: [mail.hoa]\npolicies: [baseline]\nworlds: 1\n")
    command = ["sweep", str(sweep), "--out", str(out), "--processes", "1"]
    assert CliRunner().invoke(app, command).exit_code == 0
    file.write_text(MAIL.replace("NAMED\n", "").replace("[0] 1", "[!0] 1").replace("[!0] 0", "[0] 0"))
    refused = CliRunner().invoke(app, command)
    assert refused.exit_code == 2
    assert "automata" in refused.output


@pytest.mark.parametrize("name", NAMES)
def test_a_trial_of_an_automaton_without_a_formula_is_audited(tmp_path, name):
    file = tmp_path / "mail.hoa"
    file.write_text(MAIL.replace("NAMED\n", f"{name}\n" if name else ""))
    trial = run("toy", str(file), "baseline", 0)
    assert _command(trial, tmp_path)[0] == 0
    code, said = _command(dataclasses.replace(trial, outcome=Outcome.STUCK), tmp_path)
    assert (code, "is not what the word says" in said) == (1, True)


def test_a_formula_is_what_a_record_is_for_if_its_automaton_is_that_of_the_formula(trial):
    other = trial.task_hoa.replace(FORMULA, "F c")
    assert formula_of(task_of_record(trial, WORLD.propositions)) == FORMULA
    assert formula_of(task_of_record(dataclasses.replace(trial, task_text="F c"), WORLD.propositions)) == FORMULA
    misnamed = dataclasses.replace(trial, task_text="F c", task_hoa=other)
    assert formula_of(task_of_record(misnamed, WORLD.propositions)) is None


def test_propositions_of_an_automaton_are_those_of_the_world():
    world = Toy().world(0)
    named = Task.from_hoa(MAIL.replace("NAMED\n", 'name: "deliver the mail"\n'), tuple(reversed(world.propositions)))
    with pytest.raises(PropositionsError, match=r"the task is over .* the world over"):
        problems_of_path(world, [tuple(map(int, world.start))], 0.0, "stuck", named)


@pytest.mark.parametrize(
    ("text", "is_read"), [("~hazard U goal", True), ("F (goal xor hazard | goal)", True), ("F goal=1", False)]
)
def test_formulas_in_any_spelling_are_audited_and_what_is_not_read_is_said(tmp_path, text, is_read):
    trial = run("toy", text, "baseline", 0)
    assert trial.outcome is Outcome.SATISFIED
    code, said = _command(trial, tmp_path)
    assert (code, "the auditor does not read this formula" in said) == (0, not is_read)
    code, said = _command(dataclasses.replace(trial, outcome=Outcome.STUCK), tmp_path)
    assert (code, "is not what the word says" in said) == (1, True)
    sweep, out = tmp_path / "sweep.yaml", tmp_path / "out"
    sweep.write_text(json.dumps({"environments": ["toy"], "tasks": [text], "policies": ["baseline"], "worlds": 1}))
    ran = CliRunner().invoke(app, ["sweep", str(sweep), "--out", str(out), "--processes", "1"])
    assert ran.exit_code == 0, ran.output
    audited = CliRunner().invoke(app, ["audit", str(out)])
    assert (audited.exit_code, "2 trials, 0 problems" in audited.output) == (0, True), audited.output
    assert ("the auditor does not read this formula" in audited.output) == (not is_read)


def test_an_automaton_that_is_not_that_of_a_formula_that_is_not_read_is_said(tmp_path):
    trial = run("toy", "F goal=1", "baseline", 0)
    other = Task.from_formula("F hazard | F goal", trial.propositions).to_hoa()
    # The record says what the task is called, whatever the file of its automaton does.
    for name in ('name: "F goal=1"', 'name: "mail"', ""):
        renamed = re.sub(r'name: ".*"', name, other)
        _, said = _command(dataclasses.replace(trial, task_hoa=renamed), tmp_path)
        assert "the task is called 'F goal=1', and its automaton is not that of this formula" in " ".join(said.split())
        assert "the auditor does not read" not in said


def test_what_cannot_be_read_without_spot_is_said(tmp_path, monkeypatch):
    trial = run("toy", "F goal=1", "baseline", 0)
    monkeypatch.setitem(sys.modules, "spot", None)
    code, said = _command(trial, tmp_path)
    assert code == 0
    assert "'F goal=1', which cannot be read here without Spot: the trial is judged by the automaton" in " ".join(
        said.split()
    )


def test_a_wrong_translation_is_judged_by_the_formula(trial, monkeypatch):
    """It comes out the same once more: the record's automaton is no evidence for it."""
    hoa = WORLD.task("F c").to_hoa().replace("F c", FORMULA)
    wrong = dataclasses.replace(Task.from_hoa(hoa, WORLD.propositions), structure=TASK.structure)
    monkeypatch.setattr(Task, "from_formula", lambda *_: wrong)
    asked = task_of_record(dataclasses.replace(trial, task_hoa=hoa), WORLD.propositions)
    assert asked is wrong
    assert formula_of(asked) == FORMULA


FIRE = ("Fire", "Goal", "Gate")


@pytest.mark.parametrize("formula", ["!Fire U Goal", "F Gate & F(Goal)", "F(Fire) & XX Goal"])
def test_names_that_begin_as_operators_do_are_names_to_the_auditor_too(formula):
    task = Task.from_formula(formula, FIRE)
    read = (task.text, FIRE, task.dfa.transitions, task.dfa.accepting, task.dfa.initial)
    assert has_language_of(*read)
    assert not has_language_of("F Fire", *read[1:])


def test_where_both_readings_are_possible_the_operators_count():
    both = ("Fire", "ire")
    task = Task.from_formula("!ire U Fire", both)
    assert has_language_of(task.text, both, task.dfa.transitions, task.dfa.accepting, task.dfa.initial)


class Fires(Toy):
    name = "fires"
    propositions = ("Goal", "Fire")

    def draw(self, key):
        world = Toy().generate(key)
        return dataclasses.replace(world, propositions=self.propositions)


def test_a_sweep_over_such_names_is_audited(tmp_path):
    environment = "tests.test_audit:Fires"
    tasks = ["!Fire U Goal"]
    data = {"environments": [environment], "tasks": tasks, "policies": ["baseline"], "worlds": 1}
    run_sweep(specification_from_dict(data, "here"), tmp_path, 1)
    result = CliRunner().invoke(app, ["audit", str(tmp_path), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["problems"] == []


def test_a_shipped_task_is_its_formula():
    specification = specification_from_dict(
        {"environments": ["firefighting"], "tasks": ["firefighting-4"], "policies": ["baseline"], "worlds": 1}, ""
    )
    assert specification.cells[0].task == Task.shipped("firefighting-4").text
    assert specification.automata == ()
