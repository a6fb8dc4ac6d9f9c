"""Deliveries in other families: which trials are run, and what is written of them."""

import json
import sys

from eval import campus
from eval.delivery import WITHOUT_ORACLE
from potlp_jax.environments.registry import make


def test_all_tasks_of_the_families_that_are_named_are_run_and_written(tmp_path, monkeypatch):
    asked = []

    def run_group(folder, environment, tasks, policies, worlds, processes):
        asked.append((folder, environment, tuple(tasks), policies, worlds))
        return []

    group = {"tables": [], "audited": 0, "problems": [], "decisions": {}}
    monkeypatch.setattr(campus, "run_group", run_group)
    monkeypatch.setattr(campus, "results_of", lambda rows, family, tasks: group | {"environment": family})
    families = ["parcels", "campus-small"]
    arguments = ["--out", tmp_path, "--worlds", 3, "--families", *families, "--report", tmp_path / "campus"]
    monkeypatch.setattr(sys, "argv", ["campus", *map(str, arguments)])
    campus.main()
    tasks = {family: tuple(make(family).tasks.values()) for family in families}
    assert asked == [(tmp_path / family, family, tasks[family], WITHOUT_ORACLE, 3) for family in families]
    found = json.loads((tmp_path / "campus.json").read_text())
    assert [(name, entry["environment"]) for name, entry in found["groups"].items()] == [(f, f) for f in families]
    assert "commit" in found["provenance"]
