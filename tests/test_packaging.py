"""What is installed: package data, the dependencies for planning alone, and the supported versions."""

import fnmatch
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

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


def test_all_that_name_the_version_name_the_same():
    version = PROJECT["project"]["version"]
    assert re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text("utf-8"), re.M)[1] == version
    assert re.search(r"^  version = \{(.+)\},$", (ROOT / "README.md").read_text("utf-8"), re.M)[1] == version
    # With its day, as Keep a Changelog asks.
    heading = re.search(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.M)[1]
    assert re.fullmatch(rf"{re.escape(version)} - \d{{4}}-\d\d-\d\d", heading)


def test_supported_versions_of_python_are_named():
    lowest = PROJECT["project"]["requires-python"].removeprefix(">=")
    named = [entry.rpartition(" ")[2] for entry in PROJECT["project"]["classifiers"] if " :: 3." in entry]
    assert named[0] == lowest
    assert PROJECT["tool"]["ruff"]["target-version"] == f"py{lowest.replace('.', '')}"
    assert PROJECT["tool"]["pyright"]["pythonVersion"] == lowest


EXTRAS = ("export", "logs", "drive", "train", "gym", "cluster")

IMPORT_WITHOUT = """
import importlib, pkgutil, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[2].split():
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
for prefix in sys.argv[1].split():
    package = importlib.import_module(prefix)
    for module in pkgutil.walk_packages(getattr(package, "__path__", []), prefix + "."):
        importlib.import_module(module.name)
"""


def _modules_of(extra: str) -> set[str]:
    """What can be imported because of an extra: names of its distributions as Python writes them."""
    names = (re.split(r"[<>=!;\[ ]", line)[0] for line in PROJECT["project"]["optional-dependencies"][extra])
    return {name.replace("-", "_") for name in names}


# What each extra is for, and what needs none. Data sets from logs (logs.collecting) need two extras, and are left out.
@pytest.mark.long
@pytest.mark.parametrize(
    ("extra", "packages"),
    [
        (None, "potlp_jax.cli potlp_jax.planning potlp_jax.trials potlp_jax.sweep potlp_jax.verify potlp_jax.bench"),
        ("export", "potlp_jax.export"),
        ("logs", "potlp_jax.logs.drive potlp_jax.logs.inspection potlp_jax.logs.replaying potlp_jax.logs.writing"),
        ("drive", "potlp_jax.drive"),
        ("train", "potlp_jax.learning potlp_jax.recipes"),
        ("gym", "potlp_jax.rl"),
        ("cluster", "potlp_jax.engine"),
    ],
)
def test_each_part_needs_its_own_extra_alone(extra, packages):
    absent = set().union(*(_modules_of(other) for other in EXTRAS if other != extra))
    command = [sys.executable, "-c", IMPORT_WITHOUT, packages, " ".join(sorted(absent))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_every_extra_for_users_is_looked_at():
    assert {*EXTRAS, "dev", "docs", "bench"} == set(PROJECT["project"]["optional-dependencies"])
