"""The suite is parted by marks; what CI calls of it is all of it."""

import itertools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MARKS = ("long", "numbers", "optimised")


def chosen_by_ci() -> list[str]:
    """The expressions of marks by which the targets that ``.ci/run`` makes choose tests."""
    called = re.findall(r"^make (\w+)$", (ROOT / ".ci" / "run").read_text("utf-8"), re.M)
    makefile = (ROOT / "Makefile").read_text("utf-8")
    recipes = {name: lines for name, lines in re.findall(r"^(\w+):.*\n((?:\t.*\n)+)", makefile, re.M)}
    runs = [line for target in called for line in recipes[target].splitlines() if "-m pytest" in line]
    # The first -m is Python's, which names pytest; without another one all tests are run.
    expressions = [re.findall(r" -m ('[^']+'|\w+)", line)[1:] for line in runs]
    return [" ".join(found).strip("'") or "True" for found in expressions]


@pytest.mark.parametrize("marked", list(itertools.product([False, True], repeat=len(MARKS))))
def test_every_test_is_run_by_ci(marked):
    marks = dict(zip(MARKS, marked, strict=True))
    assert any(eval(expression, {}, marks) for expression in chosen_by_ci()), f"{marks}: {chosen_by_ci()}"


def test_there_are_no_other_marks():
    conftest = (ROOT / "tests" / "conftest.py").read_text("utf-8")
    assert sorted(re.findall(r'"(\w+): the ', conftest)) == sorted(MARKS)
