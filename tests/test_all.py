"""One command for every experiment: its commands are real, every page has one, and a run that is killed goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from eval import all as everything
from eval.all import Run, left_out, perform
from eval.experiments import EXPERIMENTS, Experiment
from potlp_jax.errors import ConfigurationError
from tests.reference.mentions import parse_module, parse_potlp

RESULTS = Path(__file__).parents[1] / "docs" / "results"
WITHOUT = {
    "index": "it quotes the others",
    "dropped": "what was tried once and is gone",
    "delivery_panorama": "of an estimator of 0.1, which ships no more",
}
"""Pages of results that no experiment makes."""


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_commands_are_read_by_their_programs(name, tmp_path):
    program, *words = Run(out=tmp_path, data=tmp_path, processes=2, commit="").words(name)
    wrong = parse_potlp(words) if program == "potlp" else parse_module(words[1], words[2:])
    assert wrong is None


def test_every_page_of_results_has_an_experiment():
    pages = {experiment.page for experiment in EXPERIMENTS.values()}
    assert pages | set(WITHOUT) == {file.stem for file in RESULTS.glob("*.md")}
    assert not pages & set(WITHOUT)


@pytest.fixture
def small(monkeypatch, tmp_path):
    """Three experiments that count how often they run; the second ends well only where a file is."""
    counts = "import sys, pathlib; file = pathlib.Path(sys.argv[1]); file.open('a').write('x')"
    told = "import os, sys, pathlib; pathlib.Path(sys.argv[1]).write_text(os.environ['X'])"
    fails = f"{counts}; sys.exit(0 if pathlib.Path(sys.argv[2]).exists() else 3)"
    mended = tmp_path / "mended"
    experiments = {
        "first": Experiment(page="index", command=f'python -c "{counts}" {{out}}/count'),
        "second": Experiment(page="index", command=f'python -c "{fails}" {{out}}/count {mended}'),
        "third": Experiment(page="index", command=f'python -c "{told}" {{out}}/count', variables={"X": "{all}"}),
    }
    monkeypatch.setattr(everything, "EXPERIMENTS", experiments)
    return Run(out=tmp_path / "out", data=None, processes=1, commit="abc"), mended


def _counts(run):
    return [len((run.out / name / "count").read_text()) for name in ("first", "second")]


def test_what_is_done_is_not_run_again_and_a_failure_stops_nothing(small):
    run, mended = small
    names = ["first", "second", "third"]
    assert [(name, ended["code"]) for name, ended in perform(run, names)] == [("first", 0), ("second", 3), ("third", 0)]
    mended.touch()
    assert [(name, ended["code"]) for name, ended in perform(run, names)] == [("second", 0)]
    assert _counts(run) == [1, 2]
    assert (run.out / "third" / "count").read_text() == str(run.out)
    assert not list(perform(run, names))


def test_another_commit_or_command_is_run(small):
    run, mended = small
    mended.touch()
    assert len(list(perform(run, ["first", "third"]))) == 2
    other = Run(out=run.out, data=None, processes=1, commit="def")
    assert [name for name, _ in perform(other, ["first", "third"])] == ["first", "third"]
    everything.EXPERIMENTS["first"] = Experiment(page="index", command='python -c "pass"')
    assert [name for name, _ in perform(other, ["first", "third"])] == ["first"]


DRIVER = """
import sys
from pathlib import Path
from eval import all as everything
from eval.all import Run, perform
from eval.experiments import Experiment
waits = "import os, pathlib, sys, time; pathlib.Path(sys.argv[1]).write_text(str(os.getpid())); time.sleep(600)"
everything.EXPERIMENTS = {
    "first": Experiment(page="index", command='python -c "pass"'),
    "second": Experiment(page="index", command=f'python -c "{waits}" {{out}}/pid'),
}
list(perform(Run(out=Path(sys.argv[1]), data=None, processes=1, commit="abc"), ["first", "second"]))
"""


def test_it_goes_on_after_a_kill_once_what_it_had_begun_has_ended(monkeypatch, tmp_path):
    run, names = Run(out=tmp_path / "out", data=None, processes=1, commit="abc"), ["first", "second"]
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, str(run.out)], cwd=RESULTS.parents[1])
    pid = run.out / "second" / "pid"
    while not (pid.exists() and pid.read_text()):
        assert driver.poll() is None
        time.sleep(0.05)
    driver.kill()
    driver.wait()
    experiments = {name: Experiment(page="index", command='python -c "pass"') for name in names}
    monkeypatch.setattr(everything, "EXPERIMENTS", experiments)
    with pytest.raises(ConfigurationError, match=r"second.log: the experiment still runs"):
        list(perform(run, names))
    os.kill(int(pid.read_text()), signal.SIGKILL)
    while True:
        try:
            assert [name for name, _ in perform(run, names)] == ["second"]
            break
        except ConfigurationError:
            time.sleep(0.05)


def test_what_reads_from_another_comes_after_it():
    """The folders below ``{all}`` are those of experiments that are earlier in the list."""
    names = list(EXPERIMENTS)
    read = [(name, part) for name in names for part in EXPERIMENTS[name].reads]
    assert ("worst", "table1") in read
    assert ("f-own", "own") in read
    for name, part in read:
        assert part in names[: names.index(name)], f"{name} reads {part}"


def test_what_needs_something_that_is_not_there_is_left_out_by_name(tmp_path, monkeypatch):
    monkeypatch.delenv("SLURM_CONF", raising=False)
    without = left_out(Run(out=tmp_path, data=None, processes=1, commit=""), EXPERIMENTS)
    assert {"delivery", "real-maps", "floors"} <= without.keys()
    assert "table1" not in without
    # Nor is what reads them begun, only to fail.
    assert without["d-office"] == "it reads what is left out: own-office"
    assert "d-own" not in without
    with_data = Run(out=tmp_path, data=tmp_path, processes=1, commit="")
    assert left_out(with_data, EXPERIMENTS) == {
        "scale-slurm": "it needs a service that SLURM_CONF names: start it, and set the variable"
    }
    monkeypatch.setenv("SLURM_CONF", str(tmp_path))
    assert not left_out(with_data, EXPERIMENTS)


def test_the_command_says_what_failed_and_what_was_left_out(small, monkeypatch, capsys):
    run, _ = small
    everything.EXPERIMENTS["maps"] = Experiment(page="index", command='python -c "pass" {data}')
    monkeypatch.setattr(sys, "argv", ["all", "--out", str(run.out), "--only", "first", "second", "maps"])
    assert everything.main() == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("maps: left out: ")
    assert said[1].startswith("first: done, ")
    assert said[2].startswith(f"second: failed with exit code 3: see {run.out / 'second'}.log")
    assert json.loads((run.out / "first.json").read_text())["code"] == 0
