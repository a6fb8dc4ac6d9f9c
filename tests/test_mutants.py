"""The mutation check: its mutants can be made, and its verdicts are right. ``python -m eval.mutants`` runs it."""

import collections
import dataclasses

import pytest

from eval.mutants import __main__ as program
from eval.mutants.__main__ import judge, page, stale, write
from eval.mutants.core import MUTANTS
from eval.mutants.mutant import Mutant

# 1 + 1 made wrong; what is imported stands beside the test.
SUM = Mutant("a part", "a sum is a difference", "sums.py", "a + b", "a - b", ("tests/test_sums.py",))


@pytest.fixture
def tree(tmp_path):
    """A tree with one function and its tests, which runs them quietly, as this one does."""
    (tmp_path / "pyproject.toml").write_text('[tool.pytest.ini_options]\naddopts = "-q"\n')
    (tmp_path / "sums.py").write_text("def add(a, b):\n    return a + b  # a sum\n")
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_sums.py").write_text(
        "import pytest\n\nfrom sums import add\n\n\ndef test_sum():\n    assert add(1, 1) == 2\n\n\n"
        "def test_nothing_much():\n    assert add(0, 0) == 0\n\n\n"
        "def test_that_skips():\n    pytest.skip('nothing to add')\n"
    )
    return tmp_path


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.says)
def test_no_mutant_is_stale(mutant):
    assert stale(mutant) is None
    assert mutant.old != mutant.new


def test_every_part_of_the_core_has_mutants():
    assert len(MUTANTS) == len({(mutant.file, mutant.old, mutant.new) for mutant in MUTANTS}) >= 30
    assert len({mutant.says for mutant in MUTANTS}) == len(MUTANTS)
    assert min(collections.Counter(mutant.part for mutant in MUTANTS).values()) >= 5


def test_a_mutant_whose_text_is_gone_or_occurs_twice_is_stale(tree):
    assert stale(SUM, tree) is None
    assert "occurs 0 times" in str(stale(dataclasses.replace(SUM, old="a * b"), tree))
    assert "occurs 2 times" in str(stale(dataclasses.replace(SUM, old="b"), tree))
    assert "there is no tests/test_none.py" in str(stale(dataclasses.replace(SUM, tests=("tests/test_none.py",)), tree))


def test_verdicts(tree):
    sound = (tree / "sums.py").read_text()
    found = judge(SUM, tree)
    assert (found["verdict"], found["by"]) == ("caught", "test_sums.py::test_sum")
    assert judge(dataclasses.replace(SUM, only="nothing_much"), tree)["verdict"] == "survived"
    assert judge(dataclasses.replace(SUM, only="no_such_test"), tree)["verdict"] == "not tested"
    assert judge(dataclasses.replace(SUM, only="that_skips"), tree)["verdict"] == "not tested"
    # The fault is taken back.
    assert (tree / "sums.py").read_text() == sound


def test_tests_that_never_end_are_stopped(tree, monkeypatch):
    monkeypatch.setattr(program, "LIMIT", 1)
    endless = dataclasses.replace(SUM, old="return a + b", new="while True: pass")
    assert judge(endless, tree) | {"seconds": 0} == {"verdict": "caught", "by": "the time limit", "seconds": 0}


def test_the_page_counts_what_is_caught(tmp_path):
    rows = [
        {"part": "a part", "fault": "one", "file": "potlp_jax/a.py", "verdict": "caught", "by": "test_a.py::test_b"},
        {"part": "a part", "fault": "two", "file": "potlp_jax/a.py", "verdict": "survived", "by": ""},
    ]
    rows = [row | {"commit": number * 40} for row, number in zip(rows, "21", strict=True)]
    write(rows, tmp_path / "mutants.json")
    text = page(rows, tmp_path / "mutants.json")
    assert "1 of 2 faults are noticed." in text
    assert "| a part | one | `a.py` | `test_a.py::test_b` |" in text
    assert "| a part | two | `a.py` | **survived** |" in text
    # Rows that were known before are of the commit at which they were judged.
    assert "commit: `1111111`, `2222222`;" in text
