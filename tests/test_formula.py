"""Formulas: syntax, propositions, co-safety, and errors that say where and what to do."""

import importlib
import sys
import types

import pytest

from potlp_jax.errors import TaskError
from potlp_jax.task.formula import parse_formula


def error_of(text, propositions=None) -> str:
    with pytest.raises(TaskError) as caught:
        parse_formula(text, propositions)
    return str(caught.value)


def caret_column(message: str) -> int:
    """Column of the caret in the error's last line, and the text it stands under."""
    text, caret = message.splitlines()[-2:]
    assert caret.strip() == "^"
    column = caret.index("^") - 1
    assert f"(column {column})" in message
    assert len(text) + 1 >= caret.index("^")
    return column


def test_default_propositions_are_the_names_sorted():
    assert parse_formula("F zebra & (!b U Aa)").propositions == ("Aa", "b", "zebra")


def test_given_propositions_keep_their_order():
    assert parse_formula("F b", ("c", "b", "a")).propositions == ("c", "b", "a")


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("F A & F EXIT", ("A", "EXIT")),
        ('F "front door"', ("front door",)),
        ('F "GOAL" & F "Fire"', ("Fire", "GOAL")),
        ("F p0 & XF1", ("F1", "p0")),
        ("<>a && !([]b)", ("a", "b")),
        ("◇a ∧ ◇b", ("a", "b")),
        ("X[2] a | F[1:2] b", ("a", "b")),
        ("1", ()),
    ],
)
def test_spot_syntax_is_understood(text, names):
    assert parse_formula(text).propositions == names


def test_a_known_name_that_begins_like_an_operator_is_read_as_a_name():
    names = ("FIRE", "XGo", "a", "Fa", "F")
    assert parse_formula("F FIRE & XGo", names).parsed == parse_formula('F"FIRE" & "XGo"', names).parsed
    assert parse_formula("Fa", names).parsed == parse_formula("F(a)").parsed, "where both readings exist: Spot's"
    assert parse_formula("F a", names).parsed == parse_formula("F(a)").parsed, "an operator alone is never a name"
    message = error_of("F FIRE & F FIRE & & FIRE", ("FIRE",))
    assert caret_column(message) == 19, "added quotes do not shift the column"


@pytest.mark.parametrize("text", ["", "  ", "\n\t"])
def test_empty(text):
    message = error_of(text)
    assert "empty" in message
    assert caret_column(message) == 1


@pytest.mark.parametrize(
    ("text", "column", "what"),
    [
        ("F(a", 2, "missing closing parenthesis"),
        ("a U", 4, "unexpected end of formula"),
        ("a\n& & b", 5, "operator"),
        ("a b", 3, "unexpected atomic proposition"),
        ('"abc', 1, "unclosed string"),
        ("◇∧ a", 2, "operator"),
        ("a % b", 3, "invalid token"),
        (")", 1, "unexpected"),
    ],
)
def test_syntax_errors_have_a_caret(text, column, what):
    message = error_of(text)
    assert "syntax error" in message
    assert what in message
    assert caret_column(message) == column


def test_unknown_proposition_names_the_known_ones():
    message = error_of("F fire & Falarm", ("fire", "exit"))
    assert "unknown proposition 'alarm'" in message
    assert "fire, exit" in message
    assert caret_column(message) == 11


def test_unknown_quoted_proposition_has_a_caret():
    assert caret_column(error_of('F a & F"front door"', ("a",))) == 9


def test_a_name_taken_apart_is_explained():
    assert 'quote it, "GOAL"' in error_of("F GOAL")
    assert 'quote it, "FIRE"' in error_of("F FIRE", ("fire",))
    assert "quote it" not in error_of("F Ga")


def test_too_many_propositions():
    names = [f"p{i}" for i in range(17)]
    assert "17 propositions are too many" in error_of("F p0", names)
    assert "17 propositions are too many" in error_of(" & ".join(f"F {name}" for name in names))
    assert len(parse_formula(" & ".join(f"F {name}" for name in names[:16])).propositions) == 16


@pytest.mark.parametrize(
    ("propositions", "what"), [(("a", "a"), "repeated"), ("a", "single text"), (("a", ""), "non-empty")]
)
def test_bad_propositions(propositions, what):
    assert what in error_of("F a", propositions)


@pytest.mark.parametrize(
    ("text", "offender"),
    [
        ("G a", "Ga"),
        ("[]a", "Ga"),
        ("a W b", "a W b"),
        ("a R b", "a R b"),
        ("F a & X(b | G !c)", "G!c"),
        ("a U G b", "Gb"),
        ("!(F a)", "G!a"),
        ("!(a U b)", "!a R !b"),
        ("F a -> F b", "G!a"),
        ("F a <-> b", "G!a"),
        ("G F a", "GFa"),
        ("F G a", "Ga"),
        ("{a[*]}[]-> G b", "Gb"),
        ("{a[*]; b}[]-> c", "{a[*];b}[]-> c"),
    ],
)
def test_not_co_safe_names_the_sub_formula(text, offender):
    message = error_of(text)
    assert "not co-safe" in message
    assert f"'{offender}'" in message


@pytest.mark.parametrize("text", ["!(G a)", "!(a W b)", "!(a R b)", "a -> F b", "!(a M b) | 1", "a M b", "{a;b[*];c}!"])
def test_co_safety_is_judged_after_negation_normal_form(text):
    parse_formula(text)


def test_spot_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "spot", None)
    message = error_of("F a")
    assert "pip install spottl" in message
    assert "conda install -c conda-forge spot" in message


def test_another_package_called_spot(monkeypatch):
    monkeypatch.setitem(sys.modules, "spot", types.ModuleType("spot"))
    message = error_of("F a")
    assert "not the Spot library" in message
    assert "pip install spottl" in message


def test_another_package_called_spot_that_cannot_be_imported(monkeypatch):
    def fail(name):
        raise SyntaxError("Missing parentheses in call to 'print'")

    monkeypatch.setattr(importlib, "import_module", fail)
    assert "not the Spot library" in error_of("F a")
