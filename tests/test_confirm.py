"""Trials of a sweep that are run again are the same, and one that was another is told."""

import dataclasses
import json
import shutil
import sys
from collections import Counter

import pytest

from eval import confirm as program
from eval.confirm import confirm, drawn, markdown
from potlp_jax.sweep.runner import RESULTS, run_sweep
from potlp_jax.sweep.specification import specification_from_dict
from potlp_jax.sweep.store import Store


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A sweep of nine trials."""
    folder = tmp_path_factory.mktemp("confirm") / "out" / "toy"
    small = {"environments": ["toy"], "tasks": [2], "policies": ["optimistic"], "worlds": 3, "first_world": 5}
    run_sweep(specification_from_dict(small, "here"), folder)
    return folder


def rows_of(folder):
    store = Store(folder / RESULTS, read_only=True)
    facts, rows = store.facts(), store.rows()
    store.close()
    return facts, rows


@pytest.mark.long
def test_as_many_trials_are_drawn_of_each_policy(sweep):
    _, rows = rows_of(sweep)
    assert Counter(row.item.policy for row in drawn(rows, 5)) == {"known-map": 2, "baseline": 2, "optimistic": 2}
    assert drawn(rows, 5) == drawn(rows[::-1], 5)
    assert len({row.item for row in drawn(rows, 5)}) == 6
    assert sorted(row.item for row in drawn(rows, 100)) == sorted(row.item for row in rows)


def test_a_trial_that_was_another_is_told(sweep, tmp_path):
    facts, rows = rows_of(sweep)
    other = tmp_path / "other" / "toy"
    other.mkdir(parents=True)
    store = Store(other / RESULTS)
    store.agree(facts)
    # Seconds and commits differ between runs of one trial.
    changed = [dataclasses.replace(row, seconds=1e3, commit="abc") for row in rows]
    changed[4] = dataclasses.replace(changed[4], cost=changed[4].cost + 1, path=changed[4].path + "0")
    store.finish(changed)
    store.close()
    found = confirm(other, 9, tmp_path / "kept.jsonl")
    assert (found["trials"], found["same"], found["commits"]) == (9, 8, ["abc"])
    assert found["different"] == [{**dataclasses.asdict(changed[4].item), "differs": ["path", "cost"]}]
    assert "| other/toy | `abc` | 9 | 8 |" in markdown({"other/toy": found})


def test_what_was_run_is_kept_and_a_report_written(sweep, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        sys,
        "argv",
        ["confirm", str(sweep), "--trials", "3", "--out", str(tmp_path), "--report", str(tmp_path / "page")],
    )
    # Of changes that are not committed nothing is kept.
    monkeypatch.setattr(program, "source_commit", lambda: "one")
    program.main()
    assert "out/toy: 3 of 3 the same" in capsys.readouterr().out
    assert json.loads((tmp_path / "page.json").read_text())["sweeps"]["out/toy"]["same"] == 3
    kept = tmp_path / "out-toy.jsonl"
    assert len(kept.read_text().split()) > 0
    # A kill in the middle of a line loses that line alone.
    kept.write_text(f'{kept.read_text()}{{"commit": "o')
    asked = []
    monkeypatch.setattr(program, "run_again", lambda specification, rows: asked.extend(rows) or iter(()))
    program.main()
    assert asked == []
    # At another commit nothing of it counts, nor where the source was changed.
    for commit in ("another", "one+"):
        monkeypatch.setattr(program, "source_commit", lambda commit=commit: commit)
        with pytest.raises(KeyError):
            program.main()
    assert len(asked) == 6


def test_what_was_found_of_a_row_is_nothing_about_another(sweep, tmp_path, monkeypatch):
    """Two sweeps of the same trials in one file: of other settings, or of another commit."""
    monkeypatch.setattr(program, "source_commit", lambda: "one")
    facts, rows = rows_of(sweep)
    assert confirm(sweep, 9, tmp_path / "kept.jsonl")["same"] == 9
    other = tmp_path / "toy"
    other.mkdir()
    store = Store(other / RESULTS)
    store.agree(facts)
    store.finish([dataclasses.replace(row, cost=row.cost + 1) for row in rows])
    store.close()
    assert confirm(other, 9, tmp_path / "kept.jsonl")["same"] == 0


def test_two_sweeps_of_one_name_are_refused(sweep, tmp_path, monkeypatch, capsys):
    again = tmp_path / "out" / "toy"
    shutil.copytree(sweep, again)
    monkeypatch.setattr(sys, "argv", ["confirm", str(sweep), str(again), "--out", str(tmp_path / "kept")])
    with pytest.raises(SystemExit):
        program.main()
    assert "two of the sweeps have one name" in capsys.readouterr().err


def test_a_folder_without_a_sweep_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["confirm", str(tmp_path), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit):
        program.main()
    assert f"no sweep in {tmp_path}" in capsys.readouterr().err
