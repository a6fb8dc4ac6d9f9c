"""What in a task was probably not meant: from its text, its structure, and the places where it is to be used.

A doubt is no error: the task can be planned with. `Surroundings` say what some worlds hold, as letters, so that this
module knows no maps.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from potlp_jax.task.formula import Structure
from potlp_jax.task.language import UnreadableError, names_of, read_formula, same_language
from potlp_jax.task.phrases import formula_phrase, is_of_one_place, operands, place_words
from potlp_jax.task.pointing import words_taken_apart
from potlp_jax.task.task import Task
from potlp_jax.task.witnesses import shortest_satisfying

NOTHING_TO_DO: str = "nothing to do"
"""The kind of doubt about a task that every word satisfies; compiling it warns of that, too."""


@dataclass(frozen=True)
class Doubt:
    """Something that was probably not meant.

    Attributes:
        kind: ``operator``, ``nothing to do``, ``constant``, ``nowhere``, ``together``, ``start`` or ``impossible``.
        message: one line.
    """

    kind: str
    message: str


@dataclass(frozen=True)
class Surroundings:
    """What some worlds hold, over the propositions of a task.

    Attributes:
        name: of the worlds, for messages, such as ``worlds 0 to 2 of toy``.
        letters: that occur in one of them at a place that is free.
        starts: the letter of each one's start.
    """

    name: str
    letters: tuple[int, ...]
    starts: tuple[int, ...]


def find_doubts(
    task: Task, surroundings: Surroundings | None = None, *, propositions_given: bool = False
) -> tuple[Doubt, ...]:
    """What was probably not meant, the most telling first.

    Args:
        task: the task.
        surroundings: where it is to be used; None: nowhere in particular.
        propositions_given: whether the propositions were given, so that a name that was read is one that was meant.

    Returns:
        The doubts; those about places need the formula's structure.
    """
    found = [] if propositions_given else _taken_apart(task)
    structure = structure_of(task)
    if task.dfa.accepting[task.dfa.initial]:
        found.append(Doubt(NOTHING_TO_DO, "every word satisfies it: there is nothing to do"))
    elif structure is not None:
        found += _constant_parts(task, structure)
    if surroundings is not None:
        found += _in_places(task, structure, surroundings)
    return tuple(dict.fromkeys(found))


def structure_of(task: Task) -> Structure | None:
    """The formula's structure; of an automaton that was read, that of its name if this is a formula of its language."""
    if task.structure is not None:
        return task.structure
    try:
        structure = read_formula(task.text)
    except UnreadableError:
        return None
    # Writers of automata drop what the language does not depend on; such a formula is not about this task's places.
    if not set(names_of(structure)) <= set(task.propositions):
        return None
    return structure if same_language(structure, task.dfa, task.propositions) else None


def _taken_apart(task: Task) -> list[Doubt]:
    return [
        Doubt("operator", f"'{word.word}' is read as {word.read_as}{word.hint} if it is one name")
        for word in words_taken_apart(task.text)
    ]


def _constant_parts(task: Task, structure: Structure) -> Iterator[Doubt]:
    letters = np.arange(2 ** len(task.propositions))
    for place in _places(structure):
        truth = _holds(task, place, letters)
        # A constant that was written as one is meant.
        if names_of(place) and (truth.all() or not truth.any()):
            yield Doubt("constant", f"'{place_words(place)}' {'always' if truth.all() else 'never'} holds")


def _in_places(task: Task, structure: Structure | None, surroundings: Surroundings) -> Iterator[Doubt]:
    letters, explained = np.array(surroundings.letters, dtype=np.int64), False
    if structure is not None:
        doubts = [*_lost_at_the_start(task, structure, surroundings), *_nowhere(task, structure, letters, surroundings)]
        explained = bool(doubts)
        yield from doubts
    after = task.dfa.transitions[task.dfa.initial, np.array(surroundings.starts, dtype=np.int64)]
    if task.dfa.accepting[after].all() and not task.dfa.accepting[task.dfa.initial]:
        yield Doubt("start", f"it is satisfied where the robot starts in {surroundings.name}: there is nothing to do")
    # Where a part is missing is told above; a reason that lies in the order of things has no shorter words than these.
    if not explained and shortest_satisfying(task, surroundings.letters) is None:
        yield Doubt("impossible", f"no path satisfies it among what the places of {surroundings.name} hold")


def _lost_at_the_start(task: Task, structure: Structure, surroundings: Surroundings) -> Iterator[Doubt]:
    """Untils that are read at the first letter and fail with it in every world."""
    starts = np.array(surroundings.starts, dtype=np.int64)
    for kept, goal in _untils_at_once(structure):
        if is_of_one_place(kept) and not _holds(task, kept, starts).any() and not _may_hold(task, goal, starts).any():
            yield Doubt(
                "start",
                f"'{formula_phrase(('U', kept, goal))}' fails at once: in {surroundings.name} the robot starts at "
                f"{_shown_letter(task, surroundings.starts[0])}",
            )


def _nowhere(task: Task, structure: Structure, letters: np.ndarray, surroundings: Surroundings) -> Iterator[Doubt]:
    """What is to be found and holds at no place: a proposition, or several together."""
    missing = {name for name in names_of(structure) if not _holds(task, ("name", name), letters).any()}
    for goal in _places(structure, goals=True):
        # Alternatives of which one can be found are no reason for doubt.
        if _holds(task, goal, letters).any():
            continue
        wanted = sorted(missing & set(names_of(goal)))
        if wanted:
            yield Doubt("nowhere", f"{' and '.join(wanted)} is nowhere in {surroundings.name}")
        elif _holds(task, goal, np.arange(2 ** len(task.propositions))).any():
            yield Doubt("together", f"no place in {surroundings.name} has {place_words(goal)}")


def _places(formula: Structure, *, goals: bool = False) -> Iterator[Structure]:
    """The largest parts of one place; with ``goals`` only those to be found, without the left sides of untils."""
    if is_of_one_place(formula):
        yield formula
        return
    joins = formula[0] in ("and", "or")
    parts = operands(formula) if joins else formula[2:] if goals and formula[0] == "U" else formula[1:]
    here = [part for part in parts if is_of_one_place(part)]
    # What is joined of one place belongs together: `a & b` in `a & F c & b`.
    yield from [functools.reduce(lambda left, right: (formula[0], left, right), here)] if joins and here else here
    for part in parts:
        if not is_of_one_place(part):
            yield from _places(part, goals=goals)


def _untils_at_once(formula: Structure) -> Iterator[tuple[Structure, Structure]]:
    """Left and right sides of the untils that are read at the first letter."""
    if formula[0] in ("and", "or"):
        for part in operands(formula):
            yield from _untils_at_once(part)
    elif formula[0] == "U" and formula[1] != ("true",):
        yield formula[1], formula[2]


def _may_hold(task: Task, formula: Structure, letters: np.ndarray) -> Bool[np.ndarray, " N"]:
    """Whether a formula can still come true where these letters are read first; True where it cannot be told."""
    if is_of_one_place(formula):
        return _holds(task, formula, letters)
    if formula[0] == "and":
        return np.logical_and.reduce([_may_hold(task, part, letters) for part in formula[1:]])
    return np.ones(len(letters), dtype=bool)


def _holds(task: Task, formula: Structure, letters: np.ndarray) -> Bool[np.ndarray, " N"]:
    """At which letters a formula of one place holds."""
    if formula[0] in ("true", "false"):
        return np.full(len(letters), formula[0] == "true")
    if formula[0] == "name":
        return (letters >> task.propositions.index(formula[1]) & 1).astype(bool)
    parts = [_holds(task, part, letters) for part in formula[1:]]
    if formula[0] == "not":
        return ~parts[0]
    return parts[0] & parts[1] if formula[0] == "and" else parts[0] | parts[1]


def _shown_letter(task: Task, letter: int) -> str:
    return (
        ", ".join(name for bit, name in enumerate(task.propositions) if letter >> bit & 1)
        or "a place where nothing holds"
    )
