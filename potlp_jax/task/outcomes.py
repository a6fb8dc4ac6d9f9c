"""What an attempt beyond a subgoal can need: edges, conditions, outcome classes and what implies what.

Definitions (docs/model.md sections 3 and 4; Bradley et al. 2021, sections III-B and IV-A):

* An **edge** z' -> z'' can be attempted: z'' differs from z', z'' is no trap, z' is not accepting and has at least one
  letter that stays.
* Its **condition** is (stay, go): the letters that keep z' and those that lead to z''.
* ``go`` is a union of cubes; an **outcome class** is a distinct (stay, cube). The estimator is asked per class.
* Condition a **implies** condition b if whatever makes a hold beyond a subgoal makes b hold there as well.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int32

from potlp_jax.checks import is_whole
from potlp_jax.errors import TaskError
from potlp_jax.task.automaton import Dfa
from potlp_jax.task.guards import Phi, cube_letters, hull, minimal_cover
from potlp_jax.task.spot_process import SIMPLER

MAX_CLASSES: int = 4096
"""Outcome classes of a task, at most: each is asked of an estimator, and stored with its letters."""

MAX_COMPARISONS: int = 1 << 33
"""Letters that the relation ``implies`` compares, at most: the square of the classes times the letters.

``MAX_CLASSES`` over 9 propositions, 362 over 16; it is computed in a second or two."""


class OutcomeClass(NamedTuple):
    """The two vectors of an outcome class, {-1, 0, 1}^n each."""

    phi_stay: Phi
    """Literals that all letters share which keep the state: the paper's phi(z', z')."""
    phi_cube: Phi
    """The cube of letters that makes the transition: the paper's phi(z', z'')."""


@dataclass(frozen=True, eq=False)
class Condition:
    """What must be found beyond a subgoal for an attempt to succeed.

    Attributes:
        stay: letters that may be read on the path.
        go: letters that end it.
        classes: indices of the outcome classes whose cubes make up ``go``, increasing.
    """

    stay: Bool[np.ndarray, " L"]
    go: Bool[np.ndarray, " L"]
    classes: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Edges of a DFA with their conditions.

    Attributes:
        classes: outcome classes, sorted by (phi_stay, phi_cube, stay letters).
        conditions: first one condition per class, then ("compound") those with several cubes, by first edge.
        edges: ``(z', z'')`` in lexicographic order.
        edge_condition: index of each edge's condition.
    """

    classes: tuple[OutcomeClass, ...]
    conditions: tuple[Condition, ...]
    edges: Int32[np.ndarray, "E 2"]
    edge_condition: Int32[np.ndarray, " E"]

    @cached_property
    def stay_is_exact(self) -> Bool[np.ndarray, " C"]:
        """False where ``phi_stay`` admits letters that do not stay; true labels use the exact letters."""
        exact = [
            bool((cube_letters(phi_stay) == condition.stay).all())
            for (phi_stay, _), condition in zip(self.classes, self.conditions, strict=False)
        ]
        return np.array(exact, dtype=bool)

    @cached_property
    def implies(self) -> Bool[np.ndarray, "M M"]:
        """``[a, b]``: (stay, go) of a implies that of b, iff go_a in go_b and stay_a in stay_b or go_b.

        On a path that makes a hold, the first letter outside stay_b is then in go_b, or the last one is.
        """
        # Subset tests on bits: the sets of one condition against those of all others at once.
        stay = _packed([condition.stay for condition in self.conditions])
        go = _packed([condition.go for condition in self.conditions])
        implies = np.zeros((len(go), len(go)), dtype=bool)
        for a in range(len(go)):
            go_within = ~(go[a] & ~go).any(axis=1)
            implies[a] = go_within & ~(stay[a] & ~(stay | go)).any(axis=1)
        return implies


@dataclass(frozen=True, eq=False)
class _Edge:
    """An edge before classes are numbered; ``cubes`` make up ``go``."""

    source: int
    target: int
    stay: np.ndarray
    phi_stay: Phi
    cubes: tuple[Phi, ...]

    @property
    def class_keys(self) -> list[tuple[Phi, Phi, bytes]]:
        """Sort keys of the edge's classes. Bytes of a mask compare as the mask does, entry by entry."""
        return [(self.phi_stay, cube, self.stay.tobytes()) for cube in self.cubes]


def find_outcomes(dfa: Dfa, max_positive_literals: int | None = None) -> Outcomes:
    """Edges, conditions and classes of a DFA.

    Args:
        dfa: the task's automaton.
        max_positive_literals: cubes that need more propositions to hold at one cell are dropped (None: none are).
            An edge's ``go`` is the union of the remaining cubes; edges that lose all cubes do not exist.

    Returns:
        Edges in lexicographic order, their conditions, and the outcome classes that these are made of.

    Raises:
        TaskError: ``max_positive_literals`` is no whole number from 0, acceptance becomes unreachable because of it,
            or there are more than ``MAX_CLASSES`` outcome classes.
    """
    # Before cubes are dropped: afterwards a state without edges may as well be one that no letter keeps.
    if max_positive_literals is not None:
        _check_reachable(dfa, max_positive_literals)
    try:
        edges = _find_edges(dfa, max_positive_literals)
    except _TooManyClassesError as error:
        raise TaskError(
            f"the task has more than {error.most:,} outcome classes: {_remedy(dfa, max_positive_literals)}"
        ) from None
    # Two edges share a class if their cubes and the letters that stay agree; phi_stay alone may be coarser than these.
    stays = {key: edge.stay for edge in edges for key in edge.class_keys}
    keys = sorted(stays)
    # One condition per class, with the class's own index: what is learnt of a cube is kept under that index.
    conditions = [Condition(stays[key], cube_letters(key[1]), (c,)) for c, key in enumerate(keys)]
    number = {key: c for c, key in enumerate(keys)}
    known = {_letter_sets(condition): c for c, condition in enumerate(conditions)}
    edge_condition = []
    for edge in edges:
        # Without ``max_positive_literals`` the union of the cubes is the guard; with it, what remains of the guard.
        classes = tuple(number[key] for key in edge.class_keys)
        condition = Condition(edge.stay, np.any([conditions[c].go for c in classes], axis=0), classes)
        index = known.setdefault(_letter_sets(condition), len(conditions))
        if index == len(conditions):
            conditions.append(condition)
        edge_condition.append(index)
    return Outcomes(
        classes=tuple(OutcomeClass(phi_stay, cube) for phi_stay, cube, _ in keys),
        conditions=tuple(conditions),
        edges=np.array([(edge.source, edge.target) for edge in edges], dtype=np.int32).reshape(-1, 2),
        edge_condition=np.array(edge_condition, dtype=np.int32),
    )


def _find_edges(dfa: Dfa, max_positive_literals: int | None) -> list[_Edge]:
    """Edges in lexicographic order, with the cubes that are kept."""
    # Many edges of an automaton have the same guard, and covers are the expensive part.
    covers: dict[bytes, tuple[Phi, ...]] = {}
    edges, classes, most = [], set(), _most_classes(dfa)
    allowed = _allowed_letters(dfa, max_positive_literals)
    for source, row in enumerate(dfa.transitions):
        stay = row == source
        # A state that no letter keeps is left with the next cell, whatever that is: nothing can be explored in it.
        if dfa.accepting[source] or dfa.trap[source] or not stay.any():
            continue
        for target in np.unique(row):
            if target == source or dfa.trap[target]:
                continue
            go = row == target
            # A cube is kept exactly if it holds an allowed letter: where there is none, the cover is not needed.
            if not go[allowed].any():
                continue
            if go.tobytes() not in covers:
                covers[go.tobytes()] = minimal_cover(go)
            cubes = tuple(cube for cube in covers[go.tobytes()] if _allowed(cube.count(1), max_positive_literals))
            edges.append(_Edge(source, int(target), stay, hull(stay), cubes))
            # Counted as they are found: all classes of a formula that blows up are found in minutes or days.
            classes.update(edges[-1].class_keys)
            if len(classes) > most:
                raise _TooManyClassesError(most)
    return edges


class _TooManyClassesError(Exception):
    """There are more than ``most``."""

    def __init__(self, most: int) -> None:
        super().__init__(most)
        self.most = most


def _most_classes(dfa: Dfa) -> int:
    return min(MAX_CLASSES, math.isqrt(MAX_COMPARISONS // dfa.transitions.shape[1]))


def _allowed_letters(dfa: Dfa, max_positive_literals: int | None) -> list[int]:
    """Letters of at most so many propositions."""
    return [letter for letter in range(dfa.transitions.shape[1]) if _allowed(letter.bit_count(), max_positive_literals)]


def _remedy(dfa: Dfa, max_positive_literals: int | None) -> str:
    """What to do about too many classes: a limit of positive literals where that helps."""
    limit = 1 if max_positive_literals is None else max_positive_literals - 1
    try:
        _check_reachable(dfa, limit)
        edges = _find_edges(dfa, limit)
    except (TaskError, _TooManyClassesError):
        return SIMPLER
    count = len({key for edge in edges for key in edge.class_keys})
    return (
        f"{SIMPLER}; or, if no cell has more than {limit} of the propositions, give max_positive_literals={limit}, "
        f"which leaves {count:,} of them"
    )


def _packed(guards: list[np.ndarray]) -> np.ndarray:
    """Sets of letters as rows of bits; no rows where there are no guards."""
    # An accepting or impossible initial state leaves a task without edges.
    return np.packbits(np.reshape(guards, (len(guards), -1)) if guards else np.zeros((0, 1), bool), axis=1)


def _letter_sets(condition: Condition) -> tuple[bytes, bytes]:
    """What makes conditions equal."""
    return condition.stay.tobytes(), condition.go.tobytes()


def _allowed(positive: int, max_positive_literals: int | None) -> bool:
    return max_positive_literals is None or positive <= max_positive_literals


def _check_reachable(dfa: Dfa, max_positive_literals: int) -> None:
    """Raises if letters with at most so many propositions never lead to acceptance, where others would.

    A guard keeps a cube exactly if it holds such a letter, so this also covers states that no edge leaves
    because no letter stays there.
    """
    if not is_whole(max_positive_literals):
        raise TaskError(f"max_positive_literals is {max_positive_literals!r}: it must be None or a whole number")
    if max_positive_literals < 0:
        raise TaskError(f"max_positive_literals is {max_positive_literals}: it must be None or at least 0")
    letters = _allowed_letters(dfa, max_positive_literals)
    reached, queue = {dfa.initial}, [dfa.initial]
    for state in queue:
        successors = {int(target) for target in dfa.transitions[state, letters]} - reached
        reached |= successors
        queue += sorted(successors)
    # A task that is impossible from the start is a task all the same; the limit is not to blame.
    if not dfa.trap[dfa.initial] and not dfa.accepting[list(reached)].any():
        raise TaskError(
            f"acceptance is unreachable with max_positive_literals={max_positive_literals}: the task needs more "
            "propositions to hold at one cell"
        )
