"""Formulas: syntax, propositions, co-safety, and errors that say where and what to do."""

import signal
import subprocess
import sys
import time

import pytest

from eval.faults.kills import process_start
from potlp_jax.errors import TaskError
from potlp_jax.task import spot_process
from potlp_jax.task.formula import parse_formula
from potlp_jax.task.task import Task


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
    assert caret_column(message) == 10, "below the word as it was written"


@pytest.mark.parametrize("known", [None, ("küche", "Fußweg", "出口")])
def test_names_beyond_ascii_need_no_quotes(known):
    assert parse_formula("F küche & F出口", known).propositions == (known or ("küche", "出口"))


def test_a_name_with_operators_before_it_is_whole_where_it_is_known():
    assert parse_formula("F Fußweg", ("Fußweg",)).parsed == 'F"Fußweg"'
    assert parse_formula("F Fußweg").propositions == ("ußweg",), "as Spot reads Fire"


def test_errors_beside_names_beyond_ascii_have_their_column():
    assert caret_column(error_of("F küche & & a")) == 11
    assert caret_column(error_of("F küche & G a", ("küche", "a"))) == 11
    message = error_of("F küchen & F bad", ("küche", "bad"))
    assert "unknown proposition 'küchen'; did you mean küche?" in message
    assert caret_column(message) == 3
    # Signs are operators of Spot's, not names.
    assert parse_formula("◇a ∧ ◇b").propositions == ("a", "b")


def test_unknown_quoted_proposition_has_a_caret():
    assert caret_column(error_of('F a & F"front door"', ("a",))) == 9


def test_a_name_taken_apart_is_explained():
    assert 'quote it, "GOAL"' in error_of("F GOAL")
    assert 'quote it, "FIRE"' in error_of("F FIRE", ("fire",))
    assert "quote it" not in error_of("F Ga")


@pytest.mark.parametrize(
    ("text", "known"), [("!Fire U exit", None), ("!Fire U exit", ("fire", "exit")), ("!Fire", ("x",))]
)
def test_an_error_about_a_name_taken_apart_points_at_the_name(text, known):
    message = error_of(text, known)
    assert "'Fire' is read as F ire" in message
    assert 'quote it, "Fire"' in message
    assert caret_column(message) == 2


def test_an_unknown_name_is_answered_by_the_nearest_one():
    assert "did you mean alarm?" in error_of("F alram", ("fire", "alarm"))
    assert "did you mean Exit?" in error_of("F exit", ("Exit", "fire"))
    assert "did you mean" not in error_of("F dragon", ("fire", "alarm"))


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


@pytest.mark.parametrize(
    ("text", "column"),
    [
        ("F a & G b", 7),
        ("!(G a) & (F b -> c)", 11),
        ("a W b", 3),
        ("!(a & (b U c))", 10),
        ("Fire & G a", 8),
        ("F GOAL", 3),
    ],
)
def test_what_is_not_co_safe_is_pointed_at(text, column):
    assert caret_column(error_of(text)) == column


@pytest.mark.parametrize("text", ["!(G a)", "!(a W b)", "!(a R b)", "a -> F b", "!(a M b) | 1", "a M b", "{a;b[*];c}!"])
def test_co_safety_is_judged_after_negation_normal_form(text):
    parse_formula(text)


def test_spot_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "spot", None)
    message = error_of("F a")
    assert "pip install spottl" in message
    assert "conda install -c conda-forge spot" in message


@pytest.mark.parametrize(
    "module", ["", "raise SyntaxError('print is a statement')", "print('hello')"], ids=["empty", "fails", "talks"]
)
def test_another_package_called_spot(module, monkeypatch, tmp_path):
    (tmp_path / "spot.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(spot_process, "_running", None)
    message = error_of("F a")
    assert "not the Spot library" in message
    assert "pip install spottl" in message


# Formulas that blow up.


def conjoined(parts):
    return " & ".join(f"F p{i}" for i in range(parts))


def error_of_task(text, **options) -> str:
    with pytest.raises(TaskError) as caught:
        Task.from_formula(text, **options)
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (conjoined(9), "19,683 transitions"),
        (conjoined(14), "takes Spot more than 2 s of computing"),
        ("F[0:200](a & F[0:200] b)", "takes Spot more than 2 s of computing"),
        ("F(" + " xor ".join(f"p{i}" for i in range(16)) + ")", "more than 250,000 characters to write down"),
        ("X" * 1500 + "a", "1,503 states"),
    ],
)
def test_formulas_whose_automata_blow_up_are_refused_with_what_to_change(text, why):
    message = error_of_task(text)
    assert "too large" in message
    assert why in message
    assert "give them an order, as F(a & F b) does" in message
    # The process that gave up has been followed by another one.
    assert Task.from_formula("F a & F b").dfa.num_states == 4


def test_automata_whose_tables_blow_up_are_refused():
    names = [f"p{i}" for i in range(15)]
    assert "65,798,144 entries for each state and letter" in error_of_task("X" * 1001 + "a", propositions=[*names, "a"])


def test_where_fewer_propositions_at_one_cell_help_the_message_says_so(monkeypatch):
    # Of the 3^5 - 2^5 pairs of a set of parts and a smaller one, those that differ by one part remain: 5 * 2^4.
    monkeypatch.setattr("potlp_jax.task.outcomes.MAX_CLASSES", 100)
    message = error_of_task(conjoined(5))
    assert "more than 100 outcome classes" in message
    assert "max_positive_literals=1, which leaves 80 of them" in message
    assert len(Task.from_formula(conjoined(5), max_positive_literals=1).classes) == 80
    both = conjoined(6).replace("F p0 & F p1", "F(p0 & p1)")
    assert "max_positive_literals" not in error_of_task(both), "where it would make the task impossible"


def test_a_formula_on_which_spot_crashes_ends_in_one_line(monkeypatch):
    # Longer than formulas may be, so that the limit of their length does not hide the crash.
    monkeypatch.setattr("potlp_jax.task.formula.MAX_LENGTH", 1_000_000)
    assert "a deeper stack than Spot has" in error_of_task("X" * 500_000 + "a")
    assert Task.from_formula("F a").dfa.num_states == 2


@pytest.mark.parametrize("text", ["X" * 100_000 + "a", "(" * 50_000 + "a" + ")" * 50_000])
def test_long_texts_are_not_read(text):
    assert "characters, more than 4,000" in error_of(text)


def test_messages_show_what_is_around_the_place_and_nothing_that_a_terminal_obeys():
    message = error_of("F a & " * 500 + "\x1b[2J F b")
    print(message)
    assert len(message) < 500
    assert "\x1b" not in message
    caret = message.splitlines()[-1].index("^")
    assert message.splitlines()[-2][caret] == "\N{REPLACEMENT CHARACTER}"
    assert len(error_of("F " + "a" * 3900, ("b",))) < 500
    assert "surrogates" in error_of("F \ud800")


def test_spot_in_a_process_that_was_forked_is_its_own():
    code = (
        "import os\n"
        "from potlp_jax.task import formula, spot_process\n"
        "formula.parse_formula('F a')\n"
        "before = spot_process._running\n"
        "if os.fork() == 0:\n"
        "    formula.parse_formula('F b')\n"
        "    os._exit(int(spot_process._running is before))\n"
        "assert os.wait()[1] == 0\n"
        "assert formula.parse_formula('F c').propositions == ('c',)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_process_of_spot_ends_with_the_one_that_asked():
    pytest.importorskip("spot")
    code = (
        "import os, signal\n"
        "from potlp_jax.task import formula, spot_process\n"
        "formula.parse_formula('F a')\n"
        "print(spot_process._running._process.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL
    until = time.monotonic() + 20
    while process_start(int(done.stdout)) is not None:
        assert time.monotonic() < until
        time.sleep(0.05)
