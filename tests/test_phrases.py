"""Formulas in words: one phrase for each operator, and a phrase for whatever can be written."""

import pytest
from hypothesis import given, settings

from potlp_jax.errors import TaskError
from potlp_jax.task.formula import parse_formula
from potlp_jax.task.language import names_of
from potlp_jax.task.phrases import formula_phrase
from tests.test_pointing import formulas


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("F goal", "find goal"),
        ("F (a & b)", "find a and b together"),
        ("F (a & !b & !c)", "find a without b or c"),
        ("F (a | b)", "find a or b"),
        ("F (a & (b | c))", "find a and (b or c) together"),
        ("(!fire U extinguisher) & F fire", "avoid fire until extinguisher is found; and find fire"),
        ("!fire U (a & F exit)", "avoid fire until a is found, and from there find exit"),
        ("(!a & !b) U (c & d)", "avoid a and b until c and d together are found"),
        ("(!a | !b) U c", "avoid a and b together until c is found"),
        ("a U b", "stay in a until b is found"),
        ("F a & (F b | F c)", "find a; and (find b or find c)"),
        ("F (F a & F b)", "at some point (find a and find b)"),
        ("(F a) U b", "at every step anew find a, until b is found"),
        ("a | F b", "be at a at once; or find b"),
        ("X X !a", "in 2 steps be elsewhere than at a"),
        ("X F a", "in one step find a"),
        ("!(G a)", "find no a"),
        ("1", "be anywhere at once"),
    ],
)
def test_each_operator_has_a_phrase(text, phrase):
    structure = parse_formula(text).structure
    assert structure is not None
    assert formula_phrase(structure) == phrase


@settings(deadline=None)
@given(formulas)
def test_every_formula_has_a_phrase_that_names_all_it_speaks_of(text):
    try:
        formula = parse_formula(text)
    except TaskError:
        return
    assert formula.structure is not None
    words = formula_phrase(formula.structure).replace("(", " ").replace(")", " ").replace(",", " ").replace(";", " ")
    assert set(names_of(formula.structure)) <= set(words.split())


@pytest.mark.parametrize("text", ["{a;b}!", "X" * 300 + "a"])
def test_what_is_of_another_logic_or_large_has_no_structure(text):
    assert parse_formula(text).structure is None


def test_long_formulas_have_phrases():
    structure = parse_formula("X" * 199 + "a").structure
    assert structure is not None
    assert formula_phrase(structure) == "in 199 steps be at a"
