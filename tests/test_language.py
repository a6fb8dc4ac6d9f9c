"""Formulas without Spot: shipped automata are found by language, and nothing else is taken for them."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.campus.furnishing import PARCELS, PEOPLE
from potlp_jax.environments.families import NAMED
from potlp_jax.environments.registry import make
from potlp_jax.errors import SpotMissingError, TaskError, UnsatisfiableError
from potlp_jax.task.language import UnreadableError, names_of, read_formula, same_language
from potlp_jax.task.shipped import shipped_tasks
from potlp_jax.task.task import Task

# Families that look like another have its tasks (``Generator.family``).
ENVIRONMENT_TASKS = [(name, number) for name in NAMED if not make(name).family for number in make(name).tasks]

# Other ways of writing shipped tasks, over all propositions of the environment or over their own.
REWRITTEN = {
    "F(goal)": ("goal",),
    "!(G !goal) & true": ("goal", "hazard"),
    "!(!goal W 0) | (goal M 1)": ("hazard", "goal"),
    "goal | (!hazard & X((goal & 1) || !hazard U goal))": ("goal", "hazard"),
    "!(hazard R !goal)": ("goal", "hazard"),
    "<>grad && <>professor && F undergrad": ("professor", "grad", "undergrad"),
    "exit | (!fire U exit)": ("exit", "fire"),
    "(!fire U extinguisher) & F ((fire) & F(exit))": ("fire", "alarm", "extinguisher", "exit"),
    "F(document & F(F package))": ("document", "package"),
    'F("a" & F(b & F c)) | false': ("a", "b", "c"),
}
UNKNOWN_HERE = [
    *("F q", "F[2:3] goal", "Fgoal", "FGOAL", "X X fire", "exit M !fire", "{goal}!", "goal U hazard"),
    *("F goal &", "F goal & F q", "F(goal & X goal)", "G goal", "0"),
]


@pytest.fixture
def no_spot(monkeypatch):
    monkeypatch.setitem(sys.modules, "spot", None)


def same(one: Task, other: Task) -> bool:
    return one.propositions == other.propositions and all(
        np.array_equal(getattr(one.dfa, field), getattr(other.dfa, field))
        for field in ("transitions", "accepting", "trap")
    )


@pytest.mark.parametrize("text", REWRITTEN)
def test_a_shipped_task_written_otherwise_is_the_same_with_and_without_spot(text, monkeypatch):
    translated = Task.from_formula(text, REWRITTEN[text])
    monkeypatch.setitem(sys.modules, "spot", None)
    found = Task.from_formula(text, REWRITTEN[text])
    assert found.text == translated.text == text
    assert same(found, translated)
    own = names_of(read_formula(text))
    assert same(Task.from_formula(text), Task.from_formula(text, own, max_positive_literals=2))


@pytest.mark.parametrize("text", UNKNOWN_HERE)
def test_without_spot_a_formula_of_another_language_is_refused(text, no_spot):
    with pytest.raises(SpotMissingError, match="pip install spottl"):
        Task.from_formula(text, ("fire", "alarm", "exit", "goal", "hazard", "q", "GOAL"))


def test_without_spot_an_unknown_proposition_is_named(no_spot):
    with pytest.raises(TaskError, match=r"unknown proposition 'exit'; known: fire, door \(column 9\)"):
        Task.from_formula("!fire U exit", ("fire", "door"))


def test_every_task_of_every_environment_ships():
    for name in NAMED:
        generator = make(name)
        shipped = {number: shipped_tasks()[f"{generator.family or name}-{number}"] for number in generator.tasks}
        assert shipped == dict(generator.tasks)


def test_tasks_of_environments_that_are_made_from_files_ship(no_spot):
    for errand in (PEOPLE, PARCELS):
        for formula in errand.tasks.values():
            assert Task.from_formula(formula, errand.propositions).text == formula
    # A map's own places may be many more.
    assert Task.from_formula("F document & F package", ("document", "kitchen", "package")).dfa.num_states == 4


@pytest.mark.long
@pytest.mark.parametrize(("environment", "number"), ENVIRONMENT_TASKS)
def test_the_promised_command_runs_without_spot(environment, number, no_spot):
    # The path that needs no search: what is tested is where tasks come from. In world 2 every task is possible.
    options = ["--task", number, "--world", "2", "--policy", "known-map"]
    result = CliRunner().invoke(app, ["run", environment, *options])
    assert result.exit_code == 0, result.output
    assert "satisfied" in result.output


# Against Spot, on formulas of every operator that is read.

BINARY = ["U", "M", "R", "W", "&", "&&", "|", "||", "->", "=>", "<->", "xor", "^"]
FORMULAS = st.recursive(
    st.sampled_from(["a", "b", '"c d"', "true", "0"]),
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(["!", "X ", "F ", "<>", "G ", "[] "]), inner).map("".join),
        st.tuples(inner, st.sampled_from(BINARY), inner).map(" ".join),
        inner.map("({})".format),
    ),
    max_leaves=6,
)
SIGMA = ("a", "b", "c d")


def task_of_spot(text: str) -> Task | None:
    try:
        return Task.from_formula(text, SIGMA)
    except TaskError:
        return None


@settings(max_examples=150, deadline=None)
@given(FORMULAS, FORMULAS)
def test_languages_are_equal_here_exactly_where_they_are_to_spot(one, other):
    tasks = [task for task in map(task_of_spot, (one, other)) if task is not None]
    for task in tasks:
        try:
            formula = read_formula(task.text)
        except UnreadableError:
            # Spot simplifies as it reads: G true is true to it, and G is not co-safe here.
            continue
        assert set(names_of(formula)) <= set(SIGMA)
        for candidate in tasks:
            assert same_language(formula, candidate.dfa, SIGMA) == same(task, candidate), (task.text, candidate.text)


@pytest.mark.parametrize("text", ["F(a xor b | a)", "F(a | b ^ a)", "F(a ^ b & a) | b", "F xOR & F a"])
def test_operators_bind_as_in_spot(text):
    task = Task.from_formula(text)
    assert same_language(read_formula(text), task.dfa, task.propositions)


@settings(max_examples=150, deadline=None)
@given(FORMULAS)
def test_what_spot_finds_not_co_safe_is_not_read(text):
    try:
        Task.from_formula(text, SIGMA)
    except UnsatisfiableError:
        return  # co-safe, but no task
    except TaskError:
        with pytest.raises(UnreadableError):
            read_formula(text)


OTHER_SYNTAX = ["XFa", "Fa", "F[2:3] a", "X[!]a", "a=1", "a;b", "{a}!", "01"]
BROKEN = ["", "a b", "(a", "a)", "a U", "! ", "F", '"a', "()", "a & " * 200 + "a", "!" * 5_000 + "a"]


@pytest.mark.parametrize("text", [*OTHER_SYNTAX, *BROKEN])
def test_other_syntax_is_not_read(text):
    with pytest.raises(UnreadableError):
        read_formula(text)


def test_a_comparison_that_grows_too_large_is_given_up_soon():
    wide = " & ".join(f"(F a{i} | X F b{i})" for i in range(8))
    many = " | ".join(f"p{i}" for i in range(16))
    dfa = Task.from_formula("F a0").dfa
    for text in (wide, many, f"F({many})"):
        assert not same_language(read_formula(text), dfa, ("a0",))
    assert not same_language(read_formula(f"F a0 | ({wide})"), dfa, ("a0",))
