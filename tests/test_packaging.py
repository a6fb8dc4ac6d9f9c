"""What is installed: package data, the dependencies for planning alone, and the supported versions."""

import fnmatch
import re
import subprocess
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))


def test_every_data_file_of_the_package_is_package_data():
    tracked = subprocess.run(["git", "ls-files", "potlp_jax"], cwd=ROOT, capture_output=True, text=True, check=True)
    data = [name.removeprefix("potlp_jax/") for name in tracked.stdout.split() if not name.endswith(".py")]
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["potlp_jax"]
    assert [name for name in data if not any(fnmatch.fnmatch(name, pattern) for pattern in patterns)] == []
    assert {"py.typed", "recipes/data/firefighting.yaml", "sweep/data/firefighting.yaml"} <= set(data)


def test_planning_alone_asks_for_nothing_that_the_whole_does_not():
    lines = (ROOT / "requirements-planner.txt").read_text("utf-8").splitlines()
    asked = {line for line in lines if line and not line.startswith("#")}
    assert asked < set(PROJECT["project"]["dependencies"])


def test_the_pinned_versions_are_of_libraries_that_are_asked_for():
    pinned = {line.partition("==")[0].lower() for line in (ROOT / "constraints.txt").read_text("utf-8").split()}
    for dependency in PROJECT["project"]["dependencies"]:
        name = re.split(r"[<>=!;\[ ]", dependency)[0]
        assert name.lower() in pinned, f"{name} has no line in constraints.txt"


def test_supported_versions_of_python_are_named():
    lowest = PROJECT["project"]["requires-python"].removeprefix(">=")
    named = [entry.rpartition(" ")[2] for entry in PROJECT["project"]["classifiers"] if " :: 3." in entry]
    assert named[0] == lowest
    assert PROJECT["tool"]["ruff"]["target-version"] == f"py{lowest.replace('.', '')}"
    assert PROJECT["tool"]["pyright"]["pythonVersion"] == lowest
