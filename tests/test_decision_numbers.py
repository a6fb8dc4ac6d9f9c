"""A decision has one number, from 0, wherever it is named: record, animation, page, and ``potlp explain``."""

import json
import re

import pytest
from matplotlib.axes import Axes
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.trials.record import load_trial
from potlp_jax.view.animation import save_animation
from tests.reference.browser import BROWSER, dump_page


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recorded trial and its page. The known map's single decision would show nothing."""
    folder = tmp_path_factory.mktemp("trial")
    words = ["run", "rooms", "--policy", "baseline", "--world", "2", "--no-animation", "--out", str(folder)]
    told = CliRunner().invoke(app, words)
    assert told.exit_code == 0, told.stderr
    told = CliRunner().invoke(app, ["view", str(folder), "--no-open"])
    assert told.exit_code == 0, told.stderr
    return folder


@pytest.fixture(scope="module")
def recorded(folder):
    """Cell, step and number of each decision, in the order of the record: what the other places must agree with."""
    decisions = json.loads((folder / "trial.json").read_text())["decisions"]
    assert len(decisions) > 3
    return {decision["index"]: (decision["step"], tuple(decision["cell"])) for decision in decisions}


def test_the_record_counts_from_0(recorded):
    assert list(recorded) == list(range(len(recorded)))


def test_the_animation_has_the_numbers_of_the_record(folder, recorded, tmp_path, monkeypatch):
    written, text = [], Axes.text
    monkeypatch.setattr(Axes, "text", lambda *args, **options: written.append(args[3]) or text(*args, **options))
    save_animation(load_trial(folder / "trial.json"), tmp_path / "trial.gif", max_frames=10_000)
    shown = [found for line in written if (found := re.match(r"decision (\d+) \(last: (\d+)\)   step (\d+)", line))]
    assert {int(number): int(step) for number, _, step in (found.groups() for found in shown)} == {
        number: step for number, (step, _) in recorded.items()
    }
    assert {int(found[2]) for found in shown} == {max(recorded)}


def test_the_page_has_the_numbers_of_the_record(folder, recorded):
    page = (folder / "replay.html").read_text("utf-8")
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page)[1])
    # The page's script shows a decision's place in this list as its number.
    assert {n: (d["step"], tuple(d["cell"])) for n, d in enumerate(data["decisions"])} == recorded
    for number, decision in enumerate(data["decisions"]):
        assert decision["index"] == number
        assert decision["text"].startswith(f"Decision {number}: ")


TOUR = """<script>
const shown = [];
const next = () => {
  shown.push([document.querySelector(".where").textContent, document.querySelector("h2.decision").textContent]);
  document.querySelector('[data-go="decision-on"]').click();
};
for (let count = 0; count < COUNT; count++) next();
const result = document.createElement("pre");
result.id = "result";
result.textContent = JSON.stringify(shown);
document.body.append(result);
</script></body>"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed to look at the page with")
def test_the_page_shows_the_numbers_of_the_record(folder, recorded, tmp_path):
    page, text = tmp_path / "page.html", (folder / "replay.html").read_text("utf-8")
    page.write_text(text.replace("</body>", TOUR.replace("COUNT", str(len(recorded)))), "utf-8")
    for number, (where, heading) in zip(recorded, dump_page(page, tmp_path / "profile"), strict=True):
        assert f"step {recorded[number][0]} of" in where
        assert f"decision {number} (last: {max(recorded)})" in where
        assert heading.startswith(f"Decision {number}: ")


def test_explain_takes_the_numbers_of_the_record(folder, recorded):
    for number in (0, 1, max(recorded)):
        told = CliRunner().invoke(app, ["explain", f"{folder}:{number}", "--json"])
        assert told.exit_code == 0, told.stderr
        found = json.loads(told.stdout)
        assert (found["index"], found["step"], tuple(found["cell"])) == (number, *recorded[number])
        told = CliRunner().invoke(app, ["explain", f"{folder}:{number}"])
        assert told.stdout.startswith(f"decision {number} of baseline, step {recorded[number][0]}:")
    told = CliRunner().invoke(app, ["explain", f"{folder}:{len(recorded)}"])
    assert told.exit_code == 2
    assert f"decisions 0 to {max(recorded)}" in told.stderr
