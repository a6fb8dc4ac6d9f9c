"""Moves that cannot be taken back: after them some words no longer satisfy the task that would have before.

``L(z)`` is the set of words that lead from state z to acceptance. A robot in state z, on a cell with letter l, enters a
cell with letter l'. Where it can step back at once and still have every word of L(z) before it, the move has cost it
nothing but the path. Otherwise it is *irrevocable*, and may be the mistake that makes a task impossible in this world
(docs/model.md section 7, "Irrevocable moves").

References:
    Taheri and Aksaray, arXiv 2602.18951 (commit states).
"""

import warnings

import numpy as np
from jaxtyping import Bool, Int

from potlp_jax.errors import TaskWarning
from potlp_jax.task.automaton import Dfa, letter_classes

MOST_COMPARISONS: int = 1 << 28
"""Comparisons of one round, pairs of states times kinds of letters, at most: about a second. A larger automaton counts
as having no irrevocable move, and a warning says so. Tasks that ship need 1,024 at most."""


def irrevocable_moves(dfa: Dfa) -> Bool[np.ndarray, "Z L"]:
    """Whether entering a cell of a letter in a state loses words that satisfy the task.

    Args:
        dfa: the minimal automaton of a task.

    Returns:
        ``[z, l']``: for some letter l after which the automaton can be in z, the state after l' and then l does not
        accept all that z accepts. False for moves into a trap, which do not exist.
    """
    # Letters that act alike are compared once.
    kind, representative = letter_classes(dfa.transitions)
    moves = dfa.transitions[:, representative]
    states, kinds = moves.shape
    if states * kinds * max(states, kinds) > MOST_COMPARISONS:
        warnings.warn(
            f"an automaton of {states} states and {kinds} kinds of letters is too large to tell which moves cannot be "
            "taken back: none is made last",
            TaskWarning,
            stacklevel=2,
        )
        return np.zeros(dfa.transitions.shape, dtype=bool)
    included = inclusion(moves, dfa.accepting)
    loses = np.zeros(moves.shape, dtype=bool)
    for letter in range(kinds):
        # The letter of the cell that is left is one after which the automaton is in this state.
        left = np.unique(moves[:, letter])
        stepped_back = moves[moves[left], letter]
        loses[left] |= ~included[left[:, None], stepped_back]
    return (loses & ~dfa.trap[moves])[:, kind]


def inclusion(transitions: Int[np.ndarray, "Z L"], accepting: Bool[np.ndarray, " Z"]) -> Bool[np.ndarray, "Z Z"]:
    """Which states accept all that others accept.

    Args:
        transitions: ``[z, letter]`` is the next state.
        accepting: states in which the task is satisfied; never left again.

    Returns:
        ``[z, w]``: every word that leads from z to acceptance leads there from w, too.
    """
    # The greatest fixed point: pairs stay until some letter leads to a pair that a shorter word has told apart.
    included = ~accepting[:, None] | accepting[None, :]
    while True:
        count = np.count_nonzero(included)
        for after in transitions.T:
            included &= included[np.ix_(after, after)]
        if np.count_nonzero(included) == count:
            return included
