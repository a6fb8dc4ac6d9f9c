"""The page of a trial: what it holds, and, where there is a browser, what it shows and how it is moved through."""

import base64
import dataclasses
import json
import re

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import world_key
from potlp_jax.planning.policies import Policy
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.replay import Views
from potlp_jax.view.replay_page import page_style, replay_data, replay_page
from potlp_jax.view.style import rgb
from potlp_jax.world.sensing import SensorConfig
from tests.reference.browser import BROWSER, dump_page

NEAR = TrialConfig(sensor=SensorConfig(range_cells=4.0))


@pytest.fixture(scope="module")
def trial():
    """A baseline's trial that looked once: no planner has to be compiled for it."""
    toy = make("toy")
    task = Task.from_formula(toy.tasks["2"], propositions=toy.propositions)
    walked = run_trial(toy.generate(world_key("validation", 1, "toy")), task, Policy.BASELINE, jax.random.key(0), NEAR)
    first = dataclasses.replace(walked.decisions[0], observations=(0,) * len(walked.decisions[0].subgoals))
    return dataclasses.replace(walked, decisions=(first, *walked.decisions[1:]))


@pytest.fixture(scope="module")
def views():
    image = np.full((16, 64, 3), 200, np.uint8)
    image[:, :8] = (0, 0, 255)
    return Views(panoramas={0: image})


def test_the_data_hold_the_whole_trial(trial, views):
    data = json.loads(json.dumps(replay_data(trial, views)))
    seen = np.frombuffer(base64.b64decode(data["first_seen"]), "<i4").reshape(trial.first_seen.shape)
    np.testing.assert_array_equal(seen, trial.first_seen)
    occupied = np.frombuffer(base64.b64decode(data["occupied"]), np.uint8).reshape(seen.shape)
    np.testing.assert_array_equal(occupied, np.asarray(trial.world.occupied))
    letters = np.zeros(seen.shape, np.int32)
    for row, column, letter in data["letters"]:
        letters[row, column] = letter
    np.testing.assert_array_equal(letters, np.asarray(trial.world.letters))
    assert [tuple(cell) for cell in data["path"]] == list(trial.path)
    assert data["states"] == list(trial.states)
    assert len(data["decisions"]) == len(trial.decisions)
    assert len(data["state_names"]) == len(data["state_colours"]) > max(trial.states)


def test_a_policy_that_does_not_search_expects_nothing(trial, views):
    data = replay_data(trial, views)
    assert not any(decision.actions for decision in trial.decisions)
    assert {entry["value"] for entry in data["decisions"]} == {None}
    assert [tuple(entry["target"]) for entry in data["decisions"]] == [decision.target for decision in trial.decisions]


def test_no_text_ends_the_script(trial, views):
    hostile = dataclasses.replace(trial, environment="</script><script>alert(1)</script>", task_text="a < b & </h1>")
    page = replay_page(hostile, views)
    assert page.count("<script") == page.count("</script>") == 2
    assert "alert(1)</script>" not in page
    assert "a &lt; b &amp; &lt;/h1&gt;" in page


def test_the_page_needs_nothing_from_elsewhere(trial, views):
    page = replay_page(trial, views)
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:)""", page)
    assert "http" not in page


def _contrast(*colours):
    """Of two colours, by the Web Content Accessibility Guidelines."""
    shares = np.array([rgb(colour) for colour in colours]) / 255
    linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    dark, light = sorted(linear @ [0.2126, 0.7152, 0.0722])
    return (light + 0.05) / (dark + 0.05)


def test_lines_can_be_seen_on_dark_screens():
    dark = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6})", page_style().partition("(prefers-color-scheme: dark)")[2]))
    # What is planned goes through what is known and what is not; states are dark, and have a rim there.
    for first, second in (("planned", "free"), ("planned", "unseen"), ("stroke-rim", "paper")):
        assert _contrast(dark[first], dark[second]) >= 3.0, (first, second)


def test_view_writes_the_page_beside_the_record(trial, tmp_path):
    blind = dataclasses.replace(
        trial, decisions=tuple(dataclasses.replace(decision, observations=()) for decision in trial.decisions)
    )
    blind.save(tmp_path / "trial.json")
    told = CliRunner().invoke(app, ["view", str(tmp_path), "--no-open"])
    assert told.exit_code == 0, told.stderr
    assert (tmp_path / "replay.html").read_text("utf-8") == replay_page(blind, Views())
    told = CliRunner().invoke(app, ["view", str(tmp_path), "--no-open", "--out", str(tmp_path / "page.png")])
    assert told.exit_code == 2
    assert ".html" in told.stderr


TOUR = """<script>
const shown = [];
const note = () => shown.push(document.querySelector(".where").textContent.trim());
const press = (key) => {
  document.querySelector("input").dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true}));
  note();
};
note();
for (const key of ["ArrowRight", "PageDown", "PageUp", "End", "ArrowRight", "ArrowLeft"]) press(key);
document.querySelector('[data-go="step-on"]').click(); note();
press("Home");
const context = document.querySelector("canvas").getContext("2d");
const colours = new Set();
const pixels = context.getImageData(0, 0, context.canvas.width, context.canvas.height).data;
for (let i = 0; i < pixels.length; i += 4) colours.add(`${pixels[i]},${pixels[i + 1]},${pixels[i + 2]}`);
addEventListener("load", () => setTimeout(() => {
  const images = [...document.querySelectorAll("figure img")].map((image) => image.src.slice(0, 15));
  const result = document.createElement("pre");
  result.id = "result";
  result.textContent = JSON.stringify({shown, colours: [...colours], images, focus: document.activeElement.tagName});
  document.body.append(result);
}, 500));
</script></body>"""


AGAIN = """<script>
const shown = [];
const press = (key) => {
  document.querySelector("input").dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true}));
  shown.push(Number(/decision (\\d+)/.exec(document.querySelector(".where").textContent)[1]));
};
for (const key of [...Array(5).fill("PageDown"), ...Array(6).fill("PageUp"), "End", "Home"]) press(key);
addEventListener("load", () => setTimeout(() => {
  const result = document.createElement("pre");
  result.id = "result";
  result.textContent = JSON.stringify(shown);
  document.body.append(result);
}, 500));
</script></body>"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed to look at the page with")
def test_every_one_of_several_decisions_at_one_step_is_shown(trial, tmp_path):
    """A robot that fails to move decides again where it is; those decisions say why."""
    first, second, *_ = trial.decisions
    steps = [0, 0, second.step, second.step, second.step]
    decisions = [
        dataclasses.replace(first if step == 0 else second, index=n, step=step) for n, step in enumerate(steps)
    ]
    page = tmp_path / "page.html"
    text = replay_page(dataclasses.replace(trial, decisions=tuple(decisions)), Views())
    page.write_text(text.replace("</body>", AGAIN), "utf-8")
    # After the last decision there is the end, from which one comes back to it.
    assert dump_page(page, tmp_path / "profile") == [1, 2, 3, 4, 4, 4, 3, 2, 1, 0, 0, 4, 0]


LOOK = """<script>
const canvas = document.querySelector("canvas"), context = canvas.getContext("2d");
const slider = document.querySelector("input"), scale = DATA.cell_pixels, decision = DATA.decisions[0];
const pixels = (...box) => context.getImageData(...box).data;
const at = ([row, column]) => pixels((column + 0.5) * scale, (row + 0.5) * scale, 1, 1).slice(0, 3).join();
const whole = () => pixels(0, 0, canvas.width, canvas.height).join();
const where = () => document.querySelector(".where").textContent.trim();
const result = {note: document.querySelector(".note").textContent, target: at(decision.target), where: where()};
result.robot = at(DATA.path[0]);
result.beside = at(DATA.path[0].map((place) => place + 0.3));
result.others = decision.subgoals.filter((cell) => cell.join() !== decision.target.join()).map(at);
const press = ([target, key, held]) => {
  const event = new KeyboardEvent("keydown", {key, bubbles: true, cancelable: true, ...held});
  return [document.querySelector(target).dispatchEvent(event), where()];
};
const held = [["input", "ArrowRight", {altKey: true}], ["input", "End", {ctrlKey: true}]];
result.keys = [["select", "End"], ...held].map(press);
const joined = whole();
for (const label of DATA.labels) label.anchor = label.centre;
slider.dispatchEvent(new Event("input"));
result.joined = joined !== whole();
const scroll = document.querySelector(".scroll");
result.shares = [];
for (const width of ["200px", "2000px"]) {
  document.body.style.width = width;
  result.shares.push([canvas.clientWidth / canvas.width, scroll.scrollWidth > scroll.clientWidth]);
}
document.body.append(Object.assign(document.createElement("pre"), {id: "result", textContent: JSON.stringify(result)}));
</script></body>"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed to look at the page with")
def test_a_browser_shows_where_a_policy_goes_that_does_not_search(trial, tmp_path):
    first = trial.decisions[0]
    page = tmp_path / "page.html"
    text = replay_page(trial, Views()).replace("JSON.parse(", "window.DATA = JSON.parse(")
    page.write_text(text.replace("</body>", LOOK.replace("DATA", "window.DATA")), "utf-8")
    result = dump_page(page, tmp_path / "profile")
    assert "expected cost" not in result["note"]
    # The colour of what is chosen, on a light screen, and that of paper.
    assert result["target"] == "196,0,106"
    assert set(result["others"]) <= {"255,255,255"}
    assert len(result["others"]) == sum(cell != first.target for cell in first.subgoals)
    # The robot covers no more than its cell.
    assert result["robot"] == "255,212,0" != result["beside"]
    # From a name to its area there is a line.
    assert result["joined"]
    # Keys of the browser, and of a list, move nothing and are not kept from them.
    assert result["keys"] == [[True, result["where"]]] * 3
    narrow, wide = result["shares"]
    assert 0.7 < narrow[0] <= 0.75
    assert narrow[1]
    assert wide == [1, False]


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed to look at the page with")
def test_a_browser_says_that_a_trial_has_no_decisions(trial, tmp_path):
    still = dataclasses.replace(trial, decisions=(), path=trial.path[:1], states=trial.states[:1], word=trial.word[:1])
    page = tmp_path / "page.html"
    tell = """<script>document.body.append(Object.assign(document.createElement("pre"), {id: "result",
      textContent: JSON.stringify(document.querySelector(".where").textContent)}));</script></body>"""
    page.write_text(replay_page(still, Views()).replace("</body>", tell), "utf-8")
    assert dump_page(page, tmp_path / "profile") == "step 0 of 0, no decisions"


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed to look at the page with")
def test_a_browser_shows_the_trial_and_keys_move_through_it(trial, views, tmp_path):
    page = tmp_path / "page.html"
    page.write_text(replay_page(trial, views).replace("</body>", TOUR), "utf-8")
    result = dump_page(page, tmp_path / "profile")
    last, decisions = len(trial.path) - 1, [decision.step for decision in trial.decisions]
    steps = [int(re.match(r"step (\d+) of", text)[1]) for text in result["shown"]]
    following = next((step for step in decisions if step > 1), last)
    before = max((step for step in decisions if step < following), default=0)
    assert steps == [0, 1, following, before, last, last, last - 1, last, 0]
    assert "255,212,0" in result["colours"]
    assert len(result["images"]) == len(trial.decisions[0].subgoals)
    assert set(result["images"]) <= {"data:image/png;"}
    assert result["focus"] == "INPUT"
