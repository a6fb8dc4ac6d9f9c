"""What ``eval.release`` reads and writes; it builds and installs nothing here."""

import tomllib
from pathlib import Path

import pytest

from eval.release import IMPORTS, contents, disk, first_plan, markdown, seconds_of

ROOT = Path(__file__).parents[1]


def test_the_plan_of_the_readme_is_found():
    code = first_plan((ROOT / "README.md").read_text("utf-8"))
    compile(code, "README.md", "exec")
    assert "plan_actions(" in code
    with pytest.raises(ValueError, match="not enough values"):
        first_plan("```python\nprint()\n```")


def test_a_wheel_is_compared_with_what_is_tracked():
    names = ["p/a.py", "p/data/b.npz", "p/stray.py", "p/py.typed", "p-1.0.dist-info/RECORD"]
    found = contents(names, ["p/a.py", "p/data/b.npz", "p/py.typed", "p/forgotten.yaml"])
    assert found == {
        "files": 4,
        "kinds": {".npz": 1, ".py": 2, ".typed": 1},
        "missing": ["p/forgotten.yaml"],
        "foreign": ["p/stray.py"],
    }


def test_disk_is_that_of_files_by_what_holds_them(tmp_path):
    for name, size in (("one/a", 2_000_000), ("one/deep/b", 1_500_000), ("two.py", 400_000)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(bytes(size))
    (tmp_path / "again").symlink_to(tmp_path / "two.py")
    assert disk(tmp_path) == {"megabytes": 3.9, "largest": {"one": 3.5, "two.py": 0.4}}


def test_the_first_run_is_kept_apart():
    assert seconds_of([9.0, 1.0, 3.0, 2.0]) == {"first": 9.0, "median": 2.0}


def test_tables_have_a_row_for_each_installation_and_as_many_cells_as_heads():
    one = {
        "packages": 40,
        "disk": {"megabytes": 778.0, "largest": {}},
        "install_s": 40.0,
        "first_decision_s": 46.0,
        "decision_again_s": 3.0,
        "imports": {kind: {"first": 1.0, "median": 0.5} for kind in IMPORTS},
    }
    archives = {"p.whl": {"megabytes": 8.5, "unpacked": 10.8}, "p.tar.gz": {"megabytes": 8.7}}
    text = markdown({"archives": archives, "installations": {"whole": one, "planning alone": one}})
    assert "| p.whl | 8.5 | 10.8 |" in text
    assert "| planning alone | 40 | 778.0 | 40.0 | 46.0 | 3.0 | 0.5 | 0.5 | 0.5 |" in text
    assert len({row.count("|") for row in text.split("\n\n")[1].splitlines()}) == 1


def test_source_distributions_hold_what_the_pages_install_with():
    packed = (ROOT / "MANIFEST.in").read_text("utf-8")
    for name in ("requirements-planner.txt", "constraints.txt", "CHANGELOG.md", "graft examples", "prune tests"):
        assert name in packed
    # The check of what is in the wheel has one exception: tasks that several families ship by their names.
    ignored = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["check-wheel-contents"]["ignore"]
    assert ignored == ["W002"]
