"""Where in a formula something is that was not meant, compared with what Spot refuses."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.errors import TaskError
from potlp_jax.task.formula import parse_formula
from potlp_jax.task.pointing import nearest_name, offending_column, words_taken_apart

formulas = st.recursive(
    st.sampled_from(["a", "b"]),
    lambda parts: (
        st.tuples(st.sampled_from(["!", "X", "F", "G", "X F"]), parts).map(lambda pair: f"{pair[0]}({pair[1]})")
        | st.tuples(parts, st.sampled_from(["&", "|", "->", "<->", "xor", "U", "R", "W", "M"]), parts).map(
            lambda parts: f"({' '.join(parts)})"
        )
    ),
    max_leaves=5,
)


@settings(deadline=None)
@given(formulas)
def test_an_operator_is_found_exactly_where_spot_refuses(text):
    try:
        accepted = parse_formula(text)
    except TaskError:
        column = offending_column(text, ())
        assert column is not None
        assert text[column - 1] in "FGURWM"
    else:
        # Spot simplifies what it reads before it judges, such as `a R a` to `a`.
        assert None in (offending_column(text, ()), offending_column(accepted.parsed, ()))


def test_the_strength_of_operators_is_that_of_spot():
    assert offending_column("G a -> b & G c", ()) == 12
    assert offending_column("!a U b", ()) is None
    assert offending_column("! F a U b", ()) == 3
    assert offending_column("{a;b}!", ()) is None


def test_what_is_known_is_a_name():
    assert offending_column("GOAL & G b", ("GOAL",)) == 8
    assert words_taken_apart("F FIRE & Fire & Falarm", ("FIRE", "Fire", "alarm")) == []


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("!Fire U GOAL", [("Fire", 2, "F ire"), ("GOAL", 9, "G OAL")]),
        ("XFalarm_1", []),
        ("Fa & XFa & F A", []),
        ('"Fire" & F "GOAL"', []),
    ],
)
def test_words_that_look_like_names(line, words):
    assert [(word.word, word.column, word.read_as) for word in words_taken_apart(line)] == words


def test_the_nearest_name():
    assert nearest_name(["Fire", "ire"], ("exit", "fire")) == "fire"
    assert nearest_name(["xyz"], ("exit", "fire")) is None
    assert nearest_name(["a"], ()) is None
