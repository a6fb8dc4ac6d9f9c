"""Transitions in words: what the automaton of any formula says, and no two transitions of a state in the same words."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from potlp_jax.task.automaton import canonical_dfa
from potlp_jax.task.hoa import write_hoa
from potlp_jax.task.shipped import shipped_tasks
from potlp_jax.task.task import Task
from potlp_jax.task.words import MAX_ALTERNATIVES, state_words, transition_words


def _words(name: str) -> dict[tuple[int, int], str]:
    task = Task.shipped(name)
    return {(int(z), int(after)): transition_words(task, int(z), int(after)) for z, after in task.edges}


def test_transitions_of_the_paper_s_tasks():
    assert _words("toy-2") == {(0, 1): "find goal, avoiding hazard"}
    assert _words("firefighting-2") == {
        (0, 2): "find alarm, avoiding fire",
        (0, 3): "find alarm and exit together, avoiding fire",
        (2, 3): "find exit",
    }
    assert _words("delivery-1")[0, 1] == "find professor"
    assert _words("delivery-1")[0, 7] == "find professor, grad and undergrad together"


def test_states_say_what_is_asked_for():
    task = Task.shipped("firefighting-3")
    assert [state_words(task, state) for state in range(5)] == [
        "find extinguisher, avoiding fire",
        "failed",
        "find fire",
        "find exit",
        "satisfied",
    ]


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("p U q", "find q, staying in p"),
        ("!(a & b) U c", "find c, avoiding a and b together"),
        ("(fire -> badge) U door", "find door, avoiding fire without badge"),
        ("F(a & b & !c)", "find a and b together without c"),
        ("F(!a & F a)", "leave a"),
        ("F(a | b | c)", "find a, b or c"),
        ("X X a", "take a step"),
    ],
)
def test_words_follow_the_guard_for_other_formulas(formula, words):
    task = Task.from_formula(formula)
    assert state_words(task, task.dfa.initial) == words


def test_brief_words_leave_out_what_is_avoided():
    assert transition_words(Task.shipped("toy-2"), 0, 1, brief=True) == "find goal"


def test_waiting_and_failing():
    task = Task.shipped("toy-2")
    assert transition_words(task, 0, 0) == "wait"
    assert transition_words(task, 0, 2) == "fail"


def test_many_alternatives_are_counted():
    task = Task.from_formula("F(a | b | c | d | e | g)")
    assert state_words(task, task.dfa.initial) == "find a, b, c or one of 3 more"
    assert MAX_ALTERNATIVES == 4


@settings(max_examples=150, deadline=None)
@given(states=st.integers(2, 5), propositions=st.integers(1, 3), seed=st.integers(0, 10**6))
def test_words_of_one_state_tell_its_transitions_apart(states, propositions, seed):
    generator = np.random.default_rng(seed)
    transitions = generator.integers(0, states, (states, 2**propositions))
    # The first state is accepting: it keeps whatever is read.
    transitions[0] = 0
    dfa = canonical_dfa(transitions, np.arange(states) == 0, states - 1)
    assume(not dfa.trap[dfa.initial])
    task = Task.from_hoa(write_hoa(dfa, tuple("abc"[:propositions]), "random"))
    for state in range(task.dfa.num_states):
        assert state_words(task, state)
        if task.dfa.trap[state]:
            continue
        live = [z for z in np.unique(task.dfa.transitions[state]).tolist() if not task.dfa.trap[z]]
        words = [transition_words(task, state, z, brief=True) for z in live]
        assert len(set(words)) == len(words), (state, words)


def test_every_edge_of_a_shipped_task_has_words():
    for name in shipped_tasks():
        assert all(words.startswith("find ") for words in _words(name).values())
