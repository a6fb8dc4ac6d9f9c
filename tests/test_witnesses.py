"""The shortest words that decide a task, compared with all short words and the semantics of the auditor."""

import itertools
import warnings

import pytest
from hypothesis import assume, given, settings

from potlp_jax.errors import TaskWarning, UnsatisfiableError
from potlp_jax.task.pointing import offending_column
from potlp_jax.task.task import Task
from potlp_jax.task.witnesses import Word, shortest_satisfying, shortest_violating
from potlp_jax.verify.semantics import satisfies_lasso, word_satisfies, word_violates
from tests.test_pointing import formulas

NAMES = ("a", "b")
LONGEST = 3


def letters(word: Word) -> list[int]:
    return [sum(1 << NAMES.index(name) for name in letter) for letter in word.letters]


def first_length(decides, allowed) -> int | None:
    """Length of the shortest of all words up to `LONGEST` letters that decides, by trying them all."""
    for length in range(LONGEST + 1):
        if any(decides(word) for word in itertools.product(allowed, repeat=length)):
            return length
    return None


@pytest.mark.parametrize("allowed", [(0, 1, 2, 3), (0, 1, 2)])
@settings(max_examples=60, deadline=None)
@given(formulas)
def test_no_shorter_word_decides(allowed, text):
    # What Spot simplifies before it judges, such as `a R a`, the auditor refuses.
    assume(offending_column(text, ()) is None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TaskWarning)
            task = Task.from_formula(text, NAMES)
    except UnsatisfiableError:
        return
    satisfying, violating = shortest_satisfying(task, allowed), shortest_violating(task, allowed)
    shortest = first_length(lambda word: word_satisfies(text, NAMES, word), allowed)
    if satisfying is None or len(satisfying.letters) > LONGEST:
        assert shortest is None
    else:
        assert word_satisfies(text, NAMES, letters(satisfying))
        assert len(satisfying.letters) == shortest
        assert set(letters(satisfying)) <= set(allowed)
    shortest = first_length(lambda word: word_violates(text, NAMES, word), allowed)
    if violating is not None and not violating.repeated and len(violating.letters) <= LONGEST:
        assert word_violates(text, NAMES, letters(violating))
        assert len(violating.letters) == shortest
    else:
        assert shortest is None
    if violating is not None and violating.repeated:
        split = len(violating.letters) - violating.repeated
        assert not satisfies_lasso(text, NAMES, letters(violating)[:split], letters(violating)[split:])


def test_words_in_print():
    assert str(shortest_satisfying(Task.from_formula("F (a & X F b)"))) == "{a} {b}"
    assert str(shortest_violating(Task.from_formula("F a"))) == "{} for ever"
    assert str(shortest_violating(Task.from_formula("!b U a"))) == "{b}"
    with pytest.warns(TaskWarning):
        always = Task.from_formula("X a | X !a")
    assert str(shortest_satisfying(always)) == "the empty word"
    assert shortest_violating(always) is None


def test_an_endless_word_may_need_steps_before_its_cycle():
    task = Task.from_formula("X F a", NAMES)
    assert shortest_violating(task, (0,)) == Word(((), ()), 1)
    assert shortest_violating(Task.from_formula("X X F !a", NAMES), (0, 1)) == Word(((), (), ("a",)), 1)
