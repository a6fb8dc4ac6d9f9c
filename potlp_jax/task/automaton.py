"""Deterministic automata as dense arrays, in one canonical form for every co-safe language.

Spot delivers a Büchi automaton, which accepts infinite words. A robot's word is finite, and a co-safe task is satisfied
by a finite word as soon as every continuation of it is accepted. ``canonical_dfa`` turns the one into the other.

References:
    Kupferman and Vardi, Model checking of safety properties, FMSD 2001 (co-safe languages).
    Moore, Gedanken-experiments on sequential machines, 1956 (minimal automata by refining a partition).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int, Int32

from potlp_jax.errors import TaskError
from potlp_jax.task.formula import Formula
from potlp_jax.task.spot_child import LONGEST_HOA
from potlp_jax.task.spot_process import SIMPLER, ask_spot

MAX_STATES: int = 1024
"""States of a task's automaton, at most. Tasks that ship have 8 at most."""

MOST_ENTRIES: int = 1 << 22
"""Entries of the table of successors, states times letters: 64 states over 16 propositions, 1,024 over 12."""


@dataclass(frozen=True, eq=False)
class Dfa:
    """Minimal complete DFA of a co-safe language: a word is accepted when every continuation satisfies the task.

    States are numbered breadth-first from the initial state, letters in increasing order, so that equal languages
    have equal arrays. There is at most one accepting state, which is absorbing, and at most one trap state.

    Attributes:
        transitions: ``[z, letter]`` is the next state.
        accepting: the task is satisfied, whatever follows.
        trap: acceptance is out of reach.
        initial: the state before the first letter is read; always 0.
    """

    transitions: Int32[np.ndarray, "Z L"]
    accepting: Bool[np.ndarray, " Z"]
    trap: Bool[np.ndarray, " Z"]
    initial: int

    @property
    def num_states(self) -> int:
        return self.transitions.shape[0]


def translate(formula: Formula) -> str:
    """Spot's deterministic complete Büchi automaton of the formula, in HOA format.

    Raises:
        TaskError: Spot is missing, or the automaton is too large.
    """
    answer = ask_spot("translate", formula.quoted)
    check_size(answer["states"], answer["propositions"])
    if answer["hoa"] is None:
        raise TaskError(
            f"the formula is too large: its automaton has {answer['states']:,} states and {answer['transitions']:,} "
            f"transitions, and takes more than {LONGEST_HOA:,} characters to write down; {SIMPLER}"
        )
    return answer["hoa"]


def check_size(states: int, propositions: int) -> None:
    """Refuse an automaton that takes too long to work with, or whose tables would be too large.

    Args:
        states: of the automaton.
        propositions: over which it is to be written down.

    Raises:
        TaskError: it is too large; says how large and what to do.
    """
    entries = states << propositions
    if states > MAX_STATES or entries > MOST_ENTRIES:
        raise TaskError(
            f"the task is too large: its automaton has {states:,} states (at most {MAX_STATES:,}), and {entries:,} "
            f"entries for each state and letter of Sigma (at most {MOST_ENTRIES:,}); {SIMPLER}"
        )


def canonical_dfa(transitions: Int[np.ndarray, "Z L"], accepting: Bool[np.ndarray, " Z"], initial: int) -> Dfa:
    """The minimal DFA of a complete deterministic Büchi automaton with state-based acceptance.

    Args:
        transitions: ``[z, letter]`` is the next state.
        accepting: states that an accepted run visits infinitely often.
        initial: where runs begin.

    Returns:
        The DFA in its canonical form: equal languages give equal arrays.

    Raises:
        TaskError: the language is not co-safe; names a state that shows it.
    """
    # A task over 16 propositions has 65,536 letters, most of which act alike: all the work is done on one of each kind.
    letter_class, representative = letter_classes(transitions)
    reduced = transitions[:, representative]
    # From here on a state accepts if it accepts whatever follows; the Büchi condition is needed no more.
    satisfied = _satisfied_states(reduced, accepting)
    _check_co_safe(reduced, accepting, satisfied, initial)
    block = _refine(reduced, satisfied)
    order, number = _breadth_first(reduced, block, initial)
    # One representative of each block, its successors renumbered, and the columns expanded to all letters again.
    minimal = number[block[reduced[order]]][:, letter_class]
    accepted = satisfied[order]
    return Dfa(
        transitions=np.ascontiguousarray(minimal, dtype=np.int32),
        accepting=accepted,
        # No word leads from a trap to acceptance. All such states are equivalent, so the minimal automaton has at most
        # one.
        trap=~_reaches(_adjacency(minimal), accepted),
        initial=0,
    )


def letter_classes(transitions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Letters that act alike, by equal columns: the class of each letter, and the first letter of each class."""
    _, first, inverse = np.unique(transitions, axis=1, return_index=True, return_inverse=True)
    # ``np.unique`` sorts columns by content. Classes are numbered by their first letter instead, because the canonical
    # numbering of states follows letters in increasing order.
    rank = np.argsort(first)
    position = np.empty_like(rank)
    position[rank] = np.arange(rank.size)
    return position[inverse.ravel()], first[rank]


def _adjacency(transitions: np.ndarray) -> np.ndarray:
    """``[z, z'']``: some letter leads from z to z''."""
    adjacency = np.zeros((transitions.shape[0],) * 2, dtype=bool)
    adjacency[np.arange(transitions.shape[0])[:, None], transitions] = True
    return adjacency


def _reaches(adjacency: np.ndarray, target: np.ndarray) -> np.ndarray:
    """States from which a state of ``target`` can be reached in zero or more steps."""
    reached = target
    while True:
        grown = reached | (adjacency & reached).any(axis=1)
        if (grown == reached).all():
            return reached
        reached = grown


def _distance(adjacency: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Steps to the next state of ``target`` from each state; -1 where none can be reached."""
    distance = np.where(target, 0, -1)
    ring, steps = target, 0
    while ring.any():
        steps += 1
        ring = adjacency[:, ring].any(axis=1) & (distance < 0)
        distance[ring] = steps
    return distance


def _satisfied_states(transitions: np.ndarray, accepting: np.ndarray) -> np.ndarray:
    """States from which every infinite word is accepted: no run ends up avoiding ``accepting`` for ever."""
    adjacency = _adjacency(transitions)
    # The greatest fixed point: states that can stay outside of ``accepting`` for one more step, again and again. Some
    # word is rejected from exactly those states that can reach one of them.
    avoiding = ~accepting
    while True:
        shrunk = avoiding & (adjacency & avoiding).any(axis=1)
        if (shrunk == avoiding).all():
            return ~_reaches(adjacency, avoiding)
        avoiding = shrunk


def _check_co_safe(transitions: np.ndarray, accepting: np.ndarray, satisfied: np.ndarray, initial: int) -> None:
    """Raises if an accepted run need never reach a satisfied state: then no finite word decides the task."""
    adjacency = _adjacency(transitions)
    reachable = _reaches(adjacency.T, np.arange(accepting.size) == initial)
    # An accepted run that avoids satisfied states visits some accepting state infinitely often, so one that lies on a
    # cycle. No satisfied state lies on that cycle: from a satisfied state only satisfied ones can be reached.
    for state in np.flatnonzero(reachable & accepting & ~satisfied):
        if _reaches(adjacency, np.arange(accepting.size) == state)[transitions[state]].any():
            raise TaskError(
                f"the automaton is not co-safe: an accepted run can visit accepting state {state} for ever, yet not "
                "every continuation from there is accepted"
            )


def _refine(transitions: np.ndarray, satisfied: np.ndarray) -> np.ndarray:
    """Coarsest partition whose blocks agree on ``satisfied`` and move to equal blocks (Moore's algorithm)."""
    # Equivalent states are equally far from satisfaction. Beginning with that, a chain of a thousand states takes one
    # round instead of a thousand.
    block = _distance(_adjacency(transitions), satisfied)
    count = 0
    while True:
        # States stay together if they were together and all their successors are. Including the own block means that
        # blocks are only ever split, so an unchanged count is an unchanged partition.
        signature = np.concatenate([block[:, None], block[transitions]], axis=1)
        distinct, block = np.unique(signature, axis=0, return_inverse=True)
        block = block.ravel()  # numpy 2.0 returns a column here
        if distinct.shape[0] == count:
            return block
        count = distinct.shape[0]


def _breadth_first(transitions: np.ndarray, block: np.ndarray, initial: int) -> tuple[np.ndarray, np.ndarray]:
    """Representatives of the reachable blocks in breadth-first order, and each block's number (-1 unreachable)."""
    # The numbering depends on the language alone: letters are tried in increasing order, and which state represents a
    # block does not matter, since equivalent states have equivalent successors.
    number = np.full(block.max() + 1, -1)
    number[block[initial]] = 0
    order = [initial]
    for state in order:  # grows while it is walked: the queue of the search
        for successor in transitions[state]:
            if number[block[successor]] < 0:
                number[block[successor]] = len(order)
                order.append(int(successor))
    return np.array(order), number
