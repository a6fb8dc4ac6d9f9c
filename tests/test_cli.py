"""The command line: what it prints and writes, exit codes, and where its output goes."""

import csv
import dataclasses
import gzip
import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax
import pytest
from PIL import Image
from typer import Exit
from typer.testing import CliRunner

from potlp_jax.cli import app, completion
from potlp_jax.cli.output import clear_errors
from potlp_jax.cli.run import _why_infeasible
from potlp_jax.environments.families import FAMILIES, NAMED
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import PotlpError, PotlpWarning, WorldError
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import Outcome, load_trial
from potlp_jax.trials.run import run
from tests.reference.command_line import all_commands

ROOT = Path(__file__).parents[1]

# Beyond the Basic Multilingual Plane there are pictograms, and no letter that the project uses.
PICTOGRAM = re.compile("[\U00010000-\U0010ffff]")

# Few simulations: what is tested is the command line, not the planner.
FAST = ("--simulations", "20")


def _potlp(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    # Shown where the test fails.
    print(result.output)
    return result


def _json(result):
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A trial of the toy environment with everything that `potlp run` writes."""
    folder = tmp_path_factory.mktemp("run")
    result = _potlp("run", "toy", "-t", "2", "--policy", "oracle", "--world", "3", "--out", folder, *FAST)
    assert result.exit_code == 0, result.output
    return folder


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no file that is always full")
def test_a_full_disk_is_said_in_one_line(capfd):
    with pytest.raises(Exit) as ended, clear_errors():
        Path("/dev/full").write_text("rows")
    assert ended.value.exit_code == 1
    assert "No space left on device: what was finished is kept; make room" in capfd.readouterr().err


def test_help_leads_a_newcomer_to_the_commands():
    result = _potlp("--help")
    assert result.exit_code == 0
    for part in ("task", "run", "compare", "explain", "--version", "potlp run rooms"):
        assert part in result.stdout
    for command in ("task", "run", "compare", "explain"):
        shown = _potlp(command, "--help")
        assert shown.exit_code == 0
        assert "Examples" in shown.stdout
        assert f"potlp {command}" in shown.stdout
        assert "--json" in shown.stdout


def test_paragraphs_of_help_break_where_the_terminal_does(monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    told = _potlp("compare", "--help").stdout
    (line,) = (line for line in told.splitlines() if "known-map (the least possible cost)" in line)
    assert line.strip().endswith("potlp report makes a page of it.")
    # Examples stay on lines of their own.
    assert sum(line.strip().startswith("potlp compare") for line in told.splitlines()) == 2


@pytest.mark.long
def test_the_first_tour_shows_what_it_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = _potlp("--help").stdout
    run, explain = (
        next(line for line in shown.splitlines() if f"potlp {name}" in line) for name in ("run rooms", "explain demo")
    )
    for line in (run, explain):
        done = _potlp(*line.partition(" - ")[0].split()[1:])
        assert done.exit_code == 0, done.output
    # Of a policy that does not search there would be nothing to explain.
    assert "visits" in done.stdout


def test_version():
    result = _potlp("--version")
    assert result.exit_code == 0
    assert result.stdout.startswith("potlp 0.")


def test_task_as_json_is_its_description():
    data = _json(_potlp("task", "!hazard U goal", "--propositions", "goal,hazard", "--json"))
    assert data.items() >= json.loads(json.dumps(Task.shipped("toy-2").describe())).items()
    assert data["words"] == "avoid hazard until goal is found"
    assert data["can_be_lost"]
    assert data["examples"] == {
        "satisfying": {"letters": [["goal"]], "repeated": 0},
        "violating": {"letters": [["hazard"]], "repeated": 0},
    }
    assert data["doubts"] == []


def test_task_is_checked_against_an_environment():
    data = _json(_potlp("task", "F (goal & hazard)", "--environment", "toy", "--json"))
    assert data["propositions"] == ["goal", "hazard"]
    assert [doubt["kind"] for doubt in data["doubts"]] == ["together"]
    assert data["examples"]["satisfying"] is None
    assert _json(_potlp("task", "2", "--environment", "toy", "--json"))["formula"] == "!hazard U goal"
    both = _potlp("task", "2", "--environment", "toy", "--propositions", "goal,hazard")
    assert both.exit_code == 2
    assert "leave out --propositions" in both.stderr


def test_task_names_a_word_that_was_taken_apart():
    result = _potlp("task", "Fire")
    assert "Find ire." in result.stdout
    assert "'Fire' is read as F ire" in result.stderr


@pytest.mark.long
def test_a_doubt_is_one_line_of_run_and_of_compare():
    asked = ("toy", "--task", "F (goal & hazard) & X (goal & hazard)", "--policy", "baseline")
    line = "no place in world 0 of toy/validation has goal and hazard together"
    assert _potlp("run", *asked).stderr.count(line) == 1
    result = _potlp("compare", *asked[:3], "--policies", "baseline", "--trials", "1")
    assert result.stderr.count("no place in worlds 0 to 2 of toy/validation has goal and hazard together") == 1


def test_task_as_text_and_picture(tmp_path):
    svg = tmp_path / "task.svg"
    result = _potlp("task", "toy-2", "--out", svg)
    assert result.exit_code == 0
    for part in ("!hazard U goal", "initial", "accepting", "trap", "!goal & hazard", "0→1"):
        assert part in result.stdout
    texts = ["".join(node.itertext()) for node in ElementTree.parse(svg).iter("{http://www.w3.org/2000/svg}text")]
    assert "!goal & !hazard" in texts


def test_a_dollar_in_a_formula_is_drawn(tmp_path):
    svg = tmp_path / "task.svg"
    result = _potlp("task", 'F "cost$a" & F "cost$b"', "--out", svg)
    assert result.exit_code == 0, result.output
    assert "cost$a" in "".join(ElementTree.parse(svg).getroot().itertext())


def test_task_from_a_hoa_file(tmp_path):
    file = tmp_path / "task.hoa"
    file.write_text(Task.shipped("firefighting-4").to_hoa())
    data = _json(_potlp("task", file, "--json"))
    assert data["formula"] == "!fire U exit"
    assert data["propositions"] == ["fire", "alarm", "extinguisher", "exit"]


def test_max_positive_literals_reaches_the_task():
    literals = _json(_potlp("task", "F (a & b | c)", "--max-positive-literals", "1", "--json"))
    assert [outcome["cube"] for outcome in literals["classes"]] == ["c"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("task", "G a"), "co-safe"),
        (("task", "F (a &"), "^"),
        (("task", "F b", "--propositions", "a"), "unknown proposition"),
        (("task", "F (a & !a)"), "no robot can satisfy 'F (a & !a)'"),
        (("run", "toy", "--task", "F goal & G !goal"), "co-safe"),
        (("run", "toy", "--task", "X goal & X !goal"), "no robot can satisfy 'X goal & X !goal'"),
        (("compare", "toy", "--task", "F (goal & !goal)"), "no robot can satisfy 'F (goal & !goal)'"),
        (("task", "missing.hoa"), "missing.hoa"),
        (("task", "F a", "--out", "picture.docx"), "docx"),
        (("run", "castle"), ", ".join(FAMILIES)),
        (("run", "map:missing.yaml"), "missing.yaml"),
        (("run", "floorplan:missing.xml"), "missing.xml: cannot be read"),
        (("run", "floorplan:"), "names no plan"),
        (("run", "toy", "--task", "9"), "1 (F goal)"),
        (("run", "toy", "--task", "F dragon"), "dragon"),
        (("run", "toy", "--policy", "clever"), "known-map, baseline"),
        (("run", "toy", "--split", "holiday"), "validation"),
        (("run", "toy", "--search", "breadth-first"), "best-first, uct"),
        (("run", "toy", "--world", "999999999999"), "--world"),
        (("compare", "toy", "--policies", "oracle,clever"), "clever"),
        (("run", "toy", "--policy", "potlp"), "no estimator is shipped for the propositions goal"),
        (("run", "firefighting", "--estimator", "nowhere.npz"), "nowhere.npz"),
        (("run", "toy", "--no-animation"), "--no-animation needs --out"),
        (("explain", "trial.json:0", "--depth", "3"), "--depth needs --out"),
        (("explain", "trial.json:0", "--estimator", "firefighting"), "--estimator needs --out"),
        (("explain", "nothing"), "FOLDER:INDEX"),
        (("explain", "nowhere/trial.json:0"), "nowhere/trial.json"),
    ],
)
def test_bad_input_is_one_message_and_exit_code_2(arguments, message):
    result = _potlp(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""


NAME = "[bold]:office:[/x]"
"""A user's own name, in which Rich would read a style and a pictogram."""


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", f"map:{NAME}.yaml"),
        ("run", f"floorplan:{NAME}/plans:office:x"),
        ("explain", f"{NAME}/first"),
        ("explain", f"{NAME}/trial.json:0"),
        ("task", f"F {NAME}"),
        ("run", "toy", "--task", f"F {NAME}"),
        ("run", "toy", "--policy", NAME),
        ("run", "toy", f"--{NAME}"),
        ("sweep", "show", NAME),
        (NAME,),
    ],
)
def test_messages_show_what_was_typed(arguments):
    result = _potlp(*arguments)
    assert result.exit_code in (1, 2)
    # Errors about options stand in a box, which breaks lines.
    assert NAME in re.sub(r"[\s│]", "", result.stderr)
    assert not PICTOGRAM.search(result.output)


def test_results_show_names_as_they_are():
    formula = f'!"{NAME}" U ":house:"'
    result = _potlp("task", formula)
    assert result.exit_code == 0, result.output
    # The heading, the list of propositions, and the table.
    assert result.stdout.count(NAME) >= 3
    assert result.stdout.count(":house:") >= 3
    assert not PICTOGRAM.search(result.stdout)


def test_help_has_no_pictograms():
    for words in all_commands():
        result = _potlp(*words, "--help")
        assert result.exit_code == 0
        assert not PICTOGRAM.search(result.stdout), words


def test_one_place_makes_consoles():
    for file in (ROOT / "potlp_jax").rglob("*.py"):
        if file.name != "output.py":
            assert not re.search(r"\bConsole\(|from_markup|rich import print", file.read_text()), file


def test_bad_options_have_exit_code_2():
    assert _potlp("run", "toy", "--world", "-1").exit_code == 2
    assert _potlp("compare", "toy", "--trials", "0").exit_code == 2
    assert _potlp("run").exit_code == 2
    assert _potlp("dance").exit_code == 2


def test_run_writes_record_picture_and_animation(recorded):
    trial = load_trial(recorded / "trial.json")
    assert trial.outcome is Outcome.SATISFIED
    assert (trial.environment, trial.world_number, trial.policy) == ("toy/validation", 3, "oracle")
    world = make("toy").generate(world_key("validation", 3, "toy"))
    assert trial.path[0] == tuple(int(entry) for entry in world.start)
    assert trial.config["decision"]["search"]["simulations"] == 20
    with Image.open(recorded / "trial.png") as picture:
        assert picture.size[0] > 400
        assert len(picture.convert("RGB").getcolors(1 << 20) or []) > 20
    with Image.open(recorded / "trial.gif") as animation:
        assert animation.n_frames == len(trial.decisions) + 1


def test_a_trial_has_the_key_of_its_world_in_a_sweep(monkeypatch):
    keys = []

    def run_trial(world, task, policy, key, *rest, **named):
        keys.append(key)
        raise WorldError("seen")

    monkeypatch.setattr("potlp_jax.trials.loop.run_trial", run_trial)
    _potlp("run", "toy", "--policy", "baseline", "--world", "3")
    assert (keys[0] == jax.random.fold_in(jax.random.key(0), 3)).all()


def test_nothing_of_an_earlier_trial_stays_beside_a_record(tmp_path, monkeypatch):
    out = ("--out", str(tmp_path))
    assert _potlp("run", "toy", "--policy", "baseline", *out).exit_code == 0
    (tmp_path / "replay.html").write_text("of the first trial")
    assert _potlp("run", "toy", "--policy", "baseline", "--world", "1", "--no-animation", *out).exit_code == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["trial.json", "trial.png"]

    def draw_trial(trial):
        raise PotlpError("no picture")

    monkeypatch.setattr("potlp_jax.view.maps.draw_trial", draw_trial)
    assert "no picture" in _potlp("run", "toy", "--policy", "baseline", "--world", "2", *out).stderr
    assert [file.name for file in tmp_path.iterdir()] == ["trial.json"]


def test_a_trial_without_decisions_is_not_to_be_explained(tmp_path):
    formula = "F (goal | !goal)"
    result = _potlp("run", "toy", "--task", formula, "--policy", "baseline", "--out", tmp_path, "--no-animation")
    assert not load_trial(tmp_path / "trial.json").decisions
    assert f"next: potlp view {tmp_path}" in " ".join(result.stdout.split("\n"))


def test_run_as_json_is_the_summary(recorded, tmp_path):
    data = _json(
        _potlp(
            *("run", "toy", "-t", "2", "--policy", "oracle", "--world", "3", "--out", tmp_path / "new"),
            *("--no-animation", "--json", *FAST),
        )
    )
    files = data.pop("files")
    assert data == load_trial(recorded / "trial.json").summary()
    assert [Path(file).name for file in files] == ["trial.json", "trial.png"]
    assert not (tmp_path / "new" / "trial.gif").exists()


def test_one_call_from_python_makes_the_trial_of_the_command_line():
    data = _json(_potlp("run", "toy", "-t", "2", "--policy", "baseline", "--world", "4", "--json"))
    assert {**run("toy", 2, "baseline", 4).summary(), "files": []} == data


def test_environments_and_policies_of_others_are_run_by_their_names():
    names = ("examples.own_environment:Corridor", "--policy", "examples.own_policy:largest_frontier")
    data = _json(_potlp("run", *names, "--camera", "examples.own_camera:thermal", "--json"))
    assert (data["environment"], data["policy"]) == (f"{names[0]}/validation", names[2])
    assert data["outcome"] == "satisfied"


@pytest.mark.long
def test_the_search_is_chosen_by_name(tmp_path):
    chosen = ("toy", "-t", "2", "--search", "uct", "--simulations", "30", "--out", tmp_path)
    assert _potlp("run", *chosen, "--policy", "oracle", "--no-animation").exit_code == 0
    trial = load_trial(tmp_path / "trial.json")
    assert trial.config["decision"]["search"] == dataclasses.asdict(UctConfig(simulations=30))
    assert {action.visits for action in trial.decisions[0].actions} != {0}
    # The settings of a sweep; its policies here do not search, which would compile for long.
    compared = _json(_potlp("compare", *chosen, "--policies", "baseline", "--trials", "1", "--json"))
    assert compared["specification"]["settings"]["decision"]["search"] == trial.config["decision"]["search"]


def test_without_an_estimator_the_default_policy_is_the_baseline():
    result = _potlp("run", "toy", "-t", "2")
    assert result.exit_code == 0
    assert "no estimator is shipped for the propositions goal, hazard: the policy is baseline" in result.stderr
    assert "baseline" in result.stdout


def test_run_without_out_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = _potlp("run", "toy", "-t", "2", "--policy", "baseline")
    assert result.exit_code == 0
    assert "satisfied" in result.stdout
    assert not list(tmp_path.iterdir())


def test_task_that_is_not_satisfied_has_exit_code_1():
    result = _potlp("run", "toy", "--task", "!hazard U (goal & hazard)", "--policy", "baseline", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["outcome"] == "infeasible"


def _goals_behind_the_hazard(monkeypatch, possible):
    """Toy worlds whose second task is possible in these numbers alone: elsewhere no cell is a goal."""
    plain = Toy.draw

    def draw(self, key):
        world = plain(self, key)
        keys = [world_key("validation", number, "toy") for number in possible]
        return world if any((key == own).all() for own in keys) else world.replace(letters=world.letters * 0)

    monkeypatch.setattr(Toy, "draw", draw)


def test_an_infeasible_trial_says_whether_the_world_is_at_fault(monkeypatch):
    _goals_behind_the_hazard(monkeypatch, {3})
    result = _potlp("run", "toy", "-t", "2", "--policy", "baseline", "--world", "1")
    assert result.exit_code == 1
    assert "with the whole map it is impossible too: try --world 3" in result.stderr


def test_a_world_whose_known_path_is_longer_than_the_budget_is_not_at_fault():
    """As in a sweep, which counts it as possible."""
    short = TrialConfig(budget_factor=0.1)
    said = _why_infeasible(Toy(), Split.VALIDATION, Toy().task(2), short, world=1)
    assert said.startswith("with the whole map the task is possible in this world")


def test_where_no_further_world_can_be_made_the_result_stands(monkeypatch):
    def draw(self, key):
        if not (key == world_key("validation", 1, "toy")).all():
            raise WorldError("there is one world")
        world = plain(self, key)
        return world.replace(letters=world.letters * 0)

    plain = Toy.draw
    monkeypatch.setattr(Toy, "draw", draw)
    result = _potlp("run", "toy", "-t", "2", "--policy", "baseline", "--world", "1")
    assert (result.exit_code, "infeasible" in result.stdout) == (1, True)
    assert "with the whole map it is impossible too: check the task" in result.stderr
    assert "there is one world" not in result.stderr


def test_a_task_that_no_world_allows_is_to_be_checked(monkeypatch):
    monkeypatch.setattr("potlp_jax.cli.run.WORLDS_TRIED", 2)
    result = _potlp("run", "toy", "--task", "!hazard U (goal & hazard)", "--policy", "baseline")
    assert "as in the 2 worlds that follow: check the task" in result.stderr


def test_a_task_that_asks_for_nothing_is_named():
    result = _potlp("run", "toy", "--task", "F (goal | !goal)", "--policy", "baseline")
    assert result.exit_code == 0
    assert "'F (goal | !goal)' is satisfied by every word: there is nothing to do" in result.stderr


def test_out_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    result = _potlp("run", "toy", "--out", tmp_path / "file")
    assert result.exit_code == 2
    assert "is a file" in result.stderr


def test_explain_prints_the_actions_of_a_decision(recorded):
    decision = load_trial(recorded / "trial.json").decisions[0]
    result = _potlp("explain", f"{recorded}:0")
    assert result.exit_code == 0
    for part in ("P_S", "R_S", "R_F", "visits", f"expected cost {decision.value:.2f}"):
        assert part in result.stdout
    data = _json(_potlp("explain", f"{recorded}/trial.json:0", "--json"))
    assert data["choice"] == decision.choice
    assert len(data["actions"]) == len(decision.actions) > 0
    assert data["trial"]["policy"] == "oracle"


def test_explain_draws_the_tree(recorded, tmp_path):
    result = _potlp("explain", f"{recorded}:0", "--out", tmp_path / "tree.svg")
    assert result.exit_code == 0, result.output
    assert "another action" not in result.stderr
    texts = "".join(ElementTree.parse(tmp_path / "tree.svg").getroot().itertext())
    assert "robot" in texts
    assert "succeeds" in texts


def test_explain_refuses_what_is_not_there(recorded, tmp_path):
    result = _potlp("explain", f"{recorded}:500")
    assert result.exit_code == 2
    assert "no decision 500" in result.stderr
    (tmp_path / "trial.json").write_text('{"format": "something else"}')
    assert "not a trial record" in _potlp("explain", f"{tmp_path}:0").stderr


def test_decision_of_a_policy_that_does_not_search(tmp_path):
    _potlp("run", "toy", "-t", "2", "--policy", "baseline", "--out", tmp_path, "--no-animation")
    assert "does not search" in _potlp("explain", f"{tmp_path}:0").stdout
    result = _potlp("explain", f"{tmp_path}:0", "--out", tmp_path / "tree.png")
    assert result.exit_code == 2
    assert "no tree" in result.stderr


@pytest.mark.long
def test_compare_reports_pairs_and_writes_its_files(tmp_path):
    result = _potlp(
        "compare", "toy", "--task", "2", "--policies", "oracle", "--trials", "3", "--out", tmp_path, "--json", *FAST
    )
    data = _json(result)
    assert data == json.loads((tmp_path / "compare.json").read_text())
    (cell,) = data["cells"]
    assert (cell["worlds"], cell["world_numbers"], cell["redrawn"]) == (3, [0, 1, 2], 0)
    assert [row["policy"] for row in cell["satisfied"]["rows"]] == ["known-map", "baseline", "oracle"]
    with (tmp_path / "trials.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9
    oracle = [float(row["cost"]) for row in rows if row["policy"] == "oracle"]
    assert cell["charged"]["rows"][2]["mean_cost"] == pytest.approx(sum(oracle) / 3)
    # 20 (H + W) on the toy's 9 by 15 cells.
    assert {float(row["budget"]) for row in rows} == {480.0}
    assert "3 of 3" in (tmp_path / "table.txt").read_text()
    assert Image.open(tmp_path / "scatter.png").size[0] > 400
    assert "9 of 9 trials" in result.stderr


def test_a_comparison_is_a_sweep_that_the_other_commands_show(tmp_path):
    command = (
        "compare",
        "toy",
        "-t",
        "2",
        "--policies",
        "baseline",
        "--trials",
        "2",
        "--world",
        "4",
        "--out",
        tmp_path,
    )
    compared = _json(_potlp(*command, "--json"))
    assert _json(_potlp("sweep", "show", tmp_path, "--json")) == compared
    assert compared["cells"][0]["world_numbers"] == [4, 5]
    longer = _json(_potlp(*command, "--json", "--trials", "3"))
    assert longer["cells"][0]["world_numbers"] == [4, 5, 6]


@pytest.mark.long
def test_the_trials_in_one_world_are_drawn_side_by_side(tmp_path):
    command = ("compare", "toy", "-t", "2", "--policies", "optimistic", "--trials", "2")
    _json(_potlp(*command, "--json", "--out", tmp_path, "--picture", "1"))
    with Image.open(tmp_path / "world-1.png") as picture:
        assert picture.size[0] > 400
    late = _potlp(*command, "--out", tmp_path, "--picture", "9")
    assert late.exit_code == 2
    assert "the worlds compared are 2 of 0 to 1" in late.stderr
    # The table of trials that took minutes is not lost with the picture.
    assert "optimistic" in late.stdout
    assert "--picture needs --out" in _potlp(*command, "--picture", "1").stderr
    early = _potlp(*command, "--world", "4", "--out", tmp_path / "other", "--picture", "3")
    assert "the worlds compared begin with 4" in early.stderr
    assert not (tmp_path / "other").exists()


def test_the_demo_quotes_the_results():
    """The Makefile's figures of task 2, from the trials of Table I."""
    with gzip.open(ROOT / "docs" / "results" / "table1" / "rows.csv.gz", "rt", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["task"] == make("firefighting").tasks["2"]]
    costs = {policy: {row["world"]: float(row["cost"]) for row in rows if row["policy"] == policy} for policy in Policy}
    saved = [costs[Policy.BASELINE][world] - cost for world, cost in costs[Policy.POTLP].items()]
    # Moves cost 1 or 1.414; what differs by less than a thousandth differs by rounding.
    less, same = sum(cost > 1e-3 for cost in saved), sum(abs(cost) <= 1e-3 for cost in saved)
    claim = f"Over {len(saved)} worlds PO-TLP costs less than the baseline in {100 * less / len(saved):.1f} %"
    assert claim + f" and the same in {100 * same / len(saved):.1f} %" in (ROOT / "Makefile").read_text()


def test_from_python_too_it_is_said_why_the_policy_is_the_baseline():
    with pytest.warns(PotlpWarning, match="no estimator is shipped .*the policy is baseline; give policy="):
        trial = run("toy", 2, world=4)
    assert trial.policy == "baseline"


def test_impossible_worlds_are_redrawn(monkeypatch):
    _goals_behind_the_hazard(monkeypatch, {2, 3})
    data = _json(_potlp("compare", "toy", "-t", "2", "--policies", "baseline", "--trials", "2", "--json"))
    assert (data["cells"][0]["world_numbers"], data["cells"][0]["redrawn"]) == ([2, 3], 2)


def test_task_that_is_never_possible_fails(monkeypatch):
    monkeypatch.setattr("potlp_jax.sweep.runner.IMPOSSIBLE_IN_A_ROW", 3)
    result = _potlp("compare", "toy", "--task", "!hazard U (goal & hazard)", "--policies", "baseline")
    assert result.exit_code == 2
    assert "impossible in 3 worlds in a row" in result.stderr


def test_unknown_environment_lists_the_known_ones():
    with pytest.raises(PotlpError, match="toy, firefighting, delivery, parcels, rooms"):
        make("castle")


def test_every_family_of_worlds_is_found_by_its_name():
    for family in FAMILIES:
        if ":" not in family:
            assert make(family).name == family


def _process(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)


def test_exit_codes_of_the_process():
    program = Path(sys.executable).with_name("potlp")
    good = subprocess.run(
        [program, "task", "F goal", "--json"], capture_output=True, text=True, timeout=120, check=False
    )
    assert good.returncode == 0
    assert json.loads(good.stdout)["accepting"] == [1]
    assert good.stderr == ""
    bad = subprocess.run([program, "task", "F (a"], capture_output=True, text=True, timeout=120, check=False)
    assert bad.returncode == 2
    assert bad.stdout == ""
    assert bad.stderr.startswith("potlp: ")


def test_a_terminal_that_lacks_a_letter_shows_the_rest(recorded):
    done = subprocess.run(
        [Path(sys.executable).with_name("potlp"), "explain", f"{recorded}:0"],
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "latin-1"},
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(rb"\b0\?1\b", done.stdout)


def test_interrupt_has_exit_code_130():
    interrupted = _process(
        "import signal, os, sys\n"
        "import potlp_jax.task.reading as reading\n"
        # A process started in the background inherits that interrupts are ignored.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "reading.read_task = lambda *args: os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.argv = ['potlp', 'task', 'F a']\n"
        "from potlp_jax.cli import main\n"
        "main()\n"
    )
    assert interrupted.returncode == 130
    assert "Traceback" not in interrupted.stderr


LIGHT = """
import sys
slow = {'jax', 'numpy', 'scipy', 'matplotlib', 'spot', 'cv2', 'yaml'} & set(sys.modules)
sys.exit(', '.join(slow) or 0)
"""


def test_importing_the_commands_loads_nothing_of_the_library():
    # Every command's file, so that help and completion of each are quick.
    result = _process(
        "import importlib\n"
        "from potlp_jax.cli.group import COMMANDS\n"
        "for module in COMMANDS.values(): importlib.import_module(module)\n"
        + LIGHT
        + "sys.exit(', '.join(slow) or 0)\n"
    )
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("potlp ru", ["run"]),
        ("potlp run fire", ["firefighting"]),
        ("potlp run firefighting --task ", ["1", "2", "3", "4"]),
        ("potlp run toy --policy o", ["optimistic", "oracle"]),
        ("potlp run toy --split t", ["training", "test"]),
        ("potlp compare toy --policies oracle,p", ["oracle,potlp"]),
        ("potlp bench --environment del", ["delivery"]),
        ("potlp run toy --search u", ["uct"]),
        ("potlp sweep ex", ["export"]),
    ],
)
def test_the_shell_is_told_what_may_follow(line, expected):
    result = CliRunner().invoke(
        app,
        env={
            "_POTLP_COMPLETE": "complete_bash",
            "COMP_WORDS": line,
            "COMP_CWORD": str(len(line.split(" ")) - 1),
        },
        prog_name="potlp",
    )
    assert result.stdout.split() == expected


def test_completion_loads_nothing_of_the_library():
    result = _process(
        "import os\n"
        "os.environ |= {'_POTLP_COMPLETE': 'complete_bash', 'COMP_WORDS': 'potlp run fire', 'COMP_CWORD': '2'}\n"
        "from potlp_jax.cli import app\n"
        "try: app(prog_name='potlp')\n"
        "except SystemExit: pass\n" + LIGHT
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["firefighting"]


def test_completed_names_are_those_of_the_library():
    assert tuple(Policy) == completion.POLICIES
    assert tuple(Split) == completion.SPLITS
    assert (BestFirstConfig.kind, UctConfig.kind) == completion.SEARCHES
    assert {name: tuple(make(name).tasks) for name in NAMED} == dict(completion.TASKS)


@pytest.mark.parametrize("flag", ["--quiet", "--verbose"])
def test_quiet_and_verbose_govern_what_is_said_on_stderr(flag):
    result = _potlp(flag, "run", "toy", "-t", "2")
    assert result.exit_code == 0
    assert "satisfied" in result.stdout
    if flag == "--quiet":
        assert result.stderr == ""
    else:
        assert "no estimator is shipped for the propositions goal, hazard: the policy is baseline" in result.stderr
        assert "decision 0" in result.stderr


def test_quiet_still_tells_errors():
    assert "castle" in _potlp("--quiet", "run", "castle").stderr


def test_a_line_is_said_once_where_a_library_logs_to_the_root():
    # A process of its own: whether the root logger has a handler is decided once.
    code = (
        "import logging; from potlp_jax.cli.output import set_verbosity; set_verbosity(logging.INFO); "
        "logging.warning('of a library'); logging.getLogger('potlp_jax.x').info('of ours')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.count("of ours") == 1
