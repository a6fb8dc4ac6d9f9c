"""Transitions and states of a task in words, derived from the automaton alone.

``find alarm, avoiding fire`` says more than ``0→2``. The words follow one rule for every formula:

* What makes the transition is the set of letters ("go") that lead from z' to z''. It is written as a canonical cover
  by cubes (`potlp_jax.task.guards`); propositions that a cube needs are *found*, several at one cell *together*.
* What must not happen on the way is the set of letters that lead from z' into a trap: *avoiding* what they need,
  *staying in* what they lack.
* A negative literal is left out where adding that proposition would make progress as well: it only tells transitions
  apart (``alarm & !exit`` beside ``alarm & exit``). It is kept where it matters: ``fire & !badge`` is "fire without
  badge".
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from potlp_jax.task.guards import cube_letters, minimal_cover
from potlp_jax.task.task import Task

MAX_ALTERNATIVES: int = 4
"""Alternatives that a phrase lists; more are counted. A line of a table or of a legend holds about so many."""


def transition_words(task: Task, source: int, target: int, *, brief: bool = False) -> str:
    """What the transition from state ``source`` to ``target`` asks of the robot, such as "find alarm, avoiding fire".

    Transitions of one state have different words. A state that stays as it is reads "wait", a trap "fail".

    Args:
        task: the task whose automaton is meant.
        source: z', the state before.
        target: z'', the state after.
        brief: leave out what must be avoided on the way; for tables whose rows share it.

    Returns:
        The phrase, without a full stop.
    """
    row = task.dfa.transitions[source]
    if task.dfa.trap[target]:
        return "fail"
    if source == target:
        return "wait"
    goal = _goal(task, source, row == target)
    others = [z for z in np.unique(row).tolist() if z not in (source, target) and not task.dfa.trap[z]]
    if goal in (_goal(task, source, row == other) for other in others):
        goal = _goal(task, source, row == target, exact=True)
    return goal if brief else goal + _manner(task, source)


def state_words(task: Task, state: int) -> str:
    """What is asked of the robot in a state: whatever makes progress from it; "satisfied" and "failed" at the ends."""
    if task.dfa.accepting[state]:
        return "satisfied"
    if task.dfa.trap[state]:
        return "failed"
    row = task.dfa.transitions[state]
    return _goal(task, state, (row != state) & ~task.dfa.trap[row]) + _manner(task, state)


def _goal(task: Task, source: int, go: Bool[np.ndarray, " L"], *, exact: bool = False) -> str:
    """The letters ``go`` as something to be done; ``exact`` keeps every literal."""
    wanted, left = [], []
    for positive, negative in _cubes(go):
        if not exact:
            negative = [bit for bit in negative if not _makes_progress(task, source, (positive, negative), bit)]
        if not positive and not negative:
            # Every letter will do, or would but for transitions that find more.
            return "take a step"
        if positive:
            wanted.append(_cube_words(task, positive, negative))
        else:
            left.append(join_names([task.propositions[bit] for bit in negative], "and"))
    phrases = [f"{verb} {_alternatives(cubes)}" for verb, cubes in (("find", wanted), ("leave", left)) if cubes]
    return " or ".join(phrases)


def _manner(task: Task, source: int) -> str:
    """What leads into a trap, as something to be avoided or to be kept; begins with a comma, empty if nothing does."""
    avoided, kept = [], []
    for positive, negative in _cubes(task.dfa.trap[task.dfa.transitions[source]]):
        negative = [bit for bit in negative if not _makes_progress(task, source, (positive, negative), bit)]
        if positive:
            avoided.append(_cube_words(task, positive, negative))
        elif negative:
            kept.append(join_names([task.propositions[bit] for bit in negative], "or"))
    manner = f", avoiding {_alternatives(avoided)}" if avoided else ""
    return manner + (f", staying in {join_names(kept, 'and')}" if kept else "")


def _cubes(letters: Bool[np.ndarray, " L"]) -> list[tuple[list[int], list[int]]]:
    """The canonical cover as pairs: propositions that must hold, those that must not. In the order of propositions."""
    return sorted(
        ([bit for bit, sign in enumerate(cube) if sign > 0], [bit for bit, sign in enumerate(cube) if sign < 0])
        for cube in minimal_cover(letters)
    )


def _makes_progress(task: Task, source: int, cube: tuple[list[int], list[int]], bit: int) -> bool:
    """Whether every letter of the cube leads on to another live state once the proposition is added."""
    positive, negative = cube
    phi = [1 if i in positive else -1 if i in negative else 0 for i in range(len(task.propositions))]
    after = task.dfa.transitions[source, np.flatnonzero(cube_letters(phi)) | 1 << bit]
    return bool(np.all((after != source) & ~task.dfa.trap[after]))


def _cube_words(task: Task, positive: Sequence[int], negative: Sequence[int]) -> str:
    text = join_names([task.propositions[bit] for bit in positive], "and") + (" together" if len(positive) > 1 else "")
    return text + (f" without {join_names([task.propositions[bit] for bit in negative], 'or')}" if negative else "")


def _alternatives(phrases: Sequence[str]) -> str:
    """Joined by commas and "or"; those beyond ``MAX_ALTERNATIVES`` are counted."""
    shown = list(dict.fromkeys(phrases))
    if len(shown) > MAX_ALTERNATIVES:
        shown = [*shown[: MAX_ALTERNATIVES - 1], f"one of {len(shown) - MAX_ALTERNATIVES + 1} more"]
    return join_names(shown, "or")


def join_names(names: Sequence[str], last: str) -> str:
    """Joined by commas and, before the last one, a word such as "or"."""
    return f" {last} ".join(filter(None, (", ".join(names[:-1]), names[-1])))
