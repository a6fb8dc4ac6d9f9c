"""Check a finished trial against the truth, independently of the planner: also that of a planner of one's own.

The word is judged by ``potlp_jax.verify.semantics``, an evaluator of the formula's semantics; moves, letters, cost and
what was observed when are checked against the world by rules of this file alone. Nothing of how the library plans,
moves or simulates is used: a mistake made there is not made here again.
"""

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Int32

from potlp_jax.task.task import Task
from potlp_jax.trials.record import NEVER_SEEN, Outcome, Trial
from potlp_jax.verify.semantics import word_satisfies, word_violates
from potlp_jax.world.grid import World

Cell = tuple[int, int]
Node = tuple[Cell, int]
"""A cell and a state of the automaton."""

Cells = list[list[bool]]
"""Rows of a map; True where a cell is free."""

# Costs are sums of float64 on both sides, in another order: only rounding may differ.
_TOLERANCE = 1e-9


def problems_of(trial: Trial, task: Task) -> list[str]:
    """What is wrong with a trial in simulation; an empty list if nothing is.

    Checks the path, the cost and the outcome as ``problems_of_path`` does, that the recorded word is the path's, that
    no cell was entered before it had been observed, and that the trial ended satisfied where docs/model.md section 7
    promises it.
    """
    word = _word_of(trial.world, trial.path)
    found = problems_of_path(trial.world, trial.path, trial.cost, trial.outcome, task.text, task.propositions)
    if list(trial.word) != word:
        found.append("the word is not that of the path")
    found += _entered_before_observed(trial)
    # Ends that are nobody's fault - the task cannot be done here, or a branch was a mistake that could not be known -
    # are no problem. Where nothing can go wrong, not ending satisfied is a fault of the planner.
    if trial.outcome is not Outcome.SATISFIED and satisfaction_is_promised(trial, task):
        found.append(f"ended {trial.outcome} although acceptance stays within reach of every state")
    return found


def problems_of_path(
    world: World,
    path: Sequence[Cell] | Int32[np.ndarray, "steps 2"],
    cost: float,
    outcome: str,
    formula: str,
    propositions: Sequence[str],
) -> list[str]:
    """What is wrong with a path that some planner took; an empty list if nothing is.

    Args:
        world: the true map.
        path: cells entered in order, the start first.
        cost: what the planner says that the path costs, in the unit of the world's resolution.
        outcome: how the planner says that the trial ended; ``"satisfied"`` is the value that matters.
        formula: the task, co-safe linear temporal logic.
        propositions: names of the bits of the world's letters.

    Returns:
        One sentence for each problem. One about a violation of the task begins with ``violates``.
    """
    cells = [(int(row), int(column)) for row, column in np.asarray(path)]
    found = []
    true_cost = path_cost(world, cells)
    if true_cost is None:
        found.append("illegal move")
    elif not math.isclose(true_cost, cost, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE):
        found.append(f"the cost is said to be {cost}, the moves cost {true_cost}")
    word = _word_of(world, cells)
    if word_satisfies(formula, propositions, word) != (outcome == Outcome.SATISFIED):
        found.append(f"outcome {outcome} is not what the word says")
    # A start that violates is nobody's move.
    if len(word) > 1 and word_violates(formula, propositions, word):
        found.append("violates the formula")
    return found


def path_cost(world: World, path: Sequence[Cell]) -> float | None:
    """What the moves of a path cost, in the unit of the resolution; None where one of them does not exist."""
    free = _free(world)
    cost = 0.0
    for before, after in pairwise(path):
        length = dict(_moves(free, before)).get(after)
        if length is None:
            return None
        cost += length
    return cost * float(world.resolution)


def satisfaction_is_promised(trial: Trial, task: Task) -> bool:
    """Whether acceptance stays within reach of every live product state that the robot can reach in the true world."""
    dfa = task.dfa
    start = trial.path[0]
    letters = np.asarray(trial.world.letters).tolist()
    first = (start, int(dfa.transitions[dfa.initial, letters[start[0]][start[1]]]))
    if dfa.trap[first[1]]:
        return False
    came_from = _explore(_free(trial.world), letters, task, first)
    # Acceptance is never left again, so that reaching it once is winning.
    winning = {node for node in came_from if dfa.accepting[node[1]]}
    # Backwards from acceptance: whatever can get there.
    queue = deque(winning)
    while queue:
        for node in came_from[queue.popleft()]:
            if node not in winning:
                winning.add(node)
                queue.append(node)
    return len(winning) == len(came_from)


def _explore(free: Cells, letters: list[list[int]], task: Task, first: Node) -> Mapping[Node, list[Node]]:
    """Every product state that can be reached without entering a trap, with those from which it is entered."""
    dfa = task.dfa
    came_from: dict[Node, list[Node]] = {first: []}
    queue = deque([first])
    while queue:
        node = queue.popleft()
        # After acceptance there is nothing left to do.
        if dfa.accepting[node[1]]:
            continue
        for cell, _ in _moves(free, node[0]):
            state = int(dfa.transitions[node[1], letters[cell[0]][cell[1]]])
            # A move into a trap does not exist: no policy may make it.
            if dfa.trap[state]:
                continue
            following = (cell, state)
            if following not in came_from:
                came_from[following] = []
                queue.append(following)
            came_from[following].append(node)
    return came_from


def _moves(free: Cells, cell: Cell) -> Iterator[tuple[Cell, float]]:
    """Free cells that one move enters, and its length: 8-connected, and a diagonal move needs both sides free.

    Written here again on purpose: the planner's own rule (``world.moves``) is what is to be checked.
    """
    row, column = cell
    for i in range(max(row - 1, 0), min(row + 2, len(free))):
        for j in range(max(column - 1, 0), min(column + 2, len(free[0]))):
            is_diagonal = i != row and j != column
            if (i, j) == cell or not free[i][j]:
                continue
            if is_diagonal and not (free[row][j] and free[i][column]):
                continue
            yield (i, j), math.sqrt(2.0) if is_diagonal else 1.0


def _free(world: World) -> Cells:
    return (~np.asarray(world.occupied)).tolist()


def _word_of(world: World, path: Sequence[Cell]) -> list[int]:
    letters = np.asarray(world.letters)
    return [int(letters[cell]) for cell in path]


def _entered_before_observed(trial: Trial) -> list[str]:
    """The first step that enters a cell which had not been observed before that step."""
    # The robot stands on a cell before it observes from there: what it enters must have been seen earlier.
    seen = trial.first_seen
    for step, cell in enumerate(trial.path[1:], start=1):
        if seen[cell] == NEVER_SEEN or seen[cell] >= step:
            return [f"step {step} enters {cell}, first seen at step {seen[cell]}"]
    return []
