"""Short words that satisfy and that violate a task, found in its automaton.

Both searches are breadth-first, so that no shorter word does the same; of the letters that lead from one state to
another the one with the fewest propositions is shown.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from potlp_jax.task.task import Task


@dataclass(frozen=True)
class Word:
    """A word that decides a task.

    Attributes:
        letters: of each step, the propositions that hold there.
        repeated: so many letters at the end repeat for ever; 0: whatever follows changes nothing.
    """

    letters: tuple[tuple[str, ...], ...]
    repeated: int = 0

    def __str__(self) -> str:
        shown = ["{" + ", ".join(letter) + "}" for letter in self.letters]
        once, repeated = shown[: len(shown) - self.repeated], shown[len(shown) - self.repeated :]
        again = [f"{' '.join(repeated)} for ever"] if repeated else []
        return " ".join([*once, *again]) or "the empty word"


_Steps = list[dict[int, int]]
"""Of each state: the states that follow, and for each the letter with the fewest propositions that leads there."""


def shortest_satisfying(task: Task, letters: Sequence[int] | None = None) -> Word | None:
    """A shortest word after which the task is satisfied, whatever follows.

    Args:
        task: the task.
        letters: that may occur; None: all.

    Returns:
        The word; None if no word of these letters satisfies the task.
    """
    steps = _steps(task, letters)
    path = _shortest(steps, task.dfa.initial, task.dfa.accepting)
    return None if path is None else Word(_named(task, path))


def shortest_violating(task: Task, letters: Sequence[int] | None = None) -> Word | None:
    """A shortest word after which the task can be satisfied no more; if there is none, one that goes on for ever.

    Args:
        task: the task.
        letters: that may occur; None: all.

    Returns:
        The word; None if every word of these letters satisfies the task.
    """
    steps = _steps(task, letters)
    path = _shortest(steps, task.dfa.initial, task.dfa.trap)
    if path is not None:
        return Word(_named(task, path))
    return _endless(task, steps)


def _endless(task: Task, steps: _Steps) -> Word | None:
    """The shortest path and cycle that never reach acceptance."""
    best: tuple[int, Word] | None = None
    for state, prefix in _paths(steps, task.dfa.initial):
        # States come by distance, and a cycle has a letter at least.
        if task.dfa.accepting[state] or (best is not None and len(prefix) + 1 >= best[0]):
            continue
        here = np.arange(task.dfa.num_states) == state
        ways = [(letter, _shortest(steps, following, here)) for following, letter in steps[state].items()]
        cycle = min(([letter, *back] for letter, back in ways if back is not None), key=len, default=None)
        if cycle is not None and (best is None or len(prefix) + len(cycle) < best[0]):
            best = len(prefix) + len(cycle), Word(_named(task, [*prefix, *cycle]), len(cycle))
    return None if best is None else best[1]


def _steps(task: Task, letters: Sequence[int] | None) -> _Steps:
    allowed = range(task.dfa.transitions.shape[1]) if letters is None else set(letters)
    # The first of several letters is kept, so those with few propositions come first.
    order = np.array(sorted(allowed, key=lambda letter: (letter.bit_count(), letter)), dtype=np.int64)
    steps = []
    for row in task.dfa.transitions[:, order]:
        targets, first = np.unique(row, return_index=True)
        by_letter = sorted(zip(first.tolist(), targets.tolist(), strict=True))
        steps.append({target: int(order[index]) for index, target in by_letter})
    return steps


def _paths(steps: _Steps, start: int) -> list[tuple[int, list[int]]]:
    """The states that can be reached, by distance, and the letters of a shortest path to each."""
    found = {start: list[int]()}
    queue = [start]
    for state in queue:  # grows while it is walked
        for target, letter in steps[state].items():
            if target not in found:
                found[target] = [*found[state], letter]
                queue.append(target)
    return list(found.items())


def _shortest(steps: _Steps, start: int, targets: np.ndarray) -> list[int] | None:
    """The letters of a shortest path into the targets; None if there is none."""
    return next((path for state, path in _paths(steps, start) if targets[state]), None)


def _named(task: Task, letters: Sequence[int]) -> tuple[tuple[str, ...], ...]:
    names = task.propositions
    return tuple(tuple(name for bit, name in enumerate(names) if letter >> bit & 1) for letter in letters)
