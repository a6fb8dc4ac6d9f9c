"""Check a finished trial against the truth, independently of the planner.

The word is judged by ``potlp_jax.verify.semantics``, an evaluator of the formula's semantics that shares no code
with the library; moves, letters, cost and what was observed when are checked against the world.
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from potlp_jax.sweep.rows import read_path
from potlp_jax.sweep.store import Row
from potlp_jax.task.task import Task
from potlp_jax.trials.record import NEVER_SEEN, Outcome, Trial
from potlp_jax.verify.semantics import word_satisfies, word_violates
from potlp_jax.world.grid import World
from tests.reference.dijkstra import grid_moves


def problems_of(trial: Trial, task: Task) -> list[str]:
    """What is wrong with a trial; empty if nothing. Not ending satisfied is wrong where section 7 of docs/model.md promises it."""
    found = [*_moves(trial), *_observation(trial), *_word(trial, task)]
    if trial.outcome is not Outcome.SATISFIED and satisfaction_is_promised(trial, task):
        found.append(f"ended {trial.outcome} although acceptance stays within reach of every state")
    return found


def _moves(trial: Trial) -> list[str]:
    cost = path_cost(trial.world, trial.path)
    if cost is None:
        return ["illegal move"]
    return [] if math.isclose(cost, trial.cost, rel_tol=1e-9, abs_tol=1e-9) else [f"cost {trial.cost}, moves {cost}"]


def problems_of_row(row: Row, world: World, propositions: Sequence[str]) -> list[str]:
    """What is wrong with a trial of a sweep: its moves, its cost, its word. A violation begins with 'violates'."""
    path, problems = read_path(row.path), []
    cost = path_cost(world, [(int(row), int(column)) for row, column in path])
    if cost is None or abs(cost - row.cost) > 1e-6 * max(cost, 1.0):
        problems.append(f"moves of {row.item}: they cost {cost}, the row says {row.cost}")
    word = np.asarray(world.letters)[path[:, 0], path[:, 1]].tolist()
    if word_satisfies(row.item.task, propositions, word) != (row.outcome == Outcome.SATISFIED):
        problems.append(f"outcome of {row.item}: {row.outcome} is not what the word says")
    if len(word) > 1 and word_violates(row.item.task, propositions, word):
        problems.append(f"violates: {row.item}")
    return problems


def path_cost(world: World, path: Sequence[tuple[int, int]]) -> float | None:
    """What the moves of a path cost, None where one of them does not exist in the world."""
    free = (~np.asarray(world.occupied)).tolist()
    cost = 0.0
    for before, after in pairwise(path):
        step = dict(grid_moves(free, before)).get(after)
        if step is None or not free[after[0]][after[1]]:
            return None
        cost += step
    return cost * float(world.resolution)


def _observation(trial: Trial) -> list[str]:
    seen = trial.first_seen
    for step, cell in enumerate(trial.path[1:], start=1):
        if seen[cell] == NEVER_SEEN or seen[cell] >= step:
            return [f"step {step} enters {cell}, first seen at step {seen[cell]}"]
    return []


def _word(trial: Trial, task: Task) -> list[str]:
    letters = np.asarray(trial.world.letters)
    if list(trial.word) != [int(letters[cell]) for cell in trial.path]:
        return ["the word is not that of the path"]
    satisfied = word_satisfies(task.text, task.propositions, trial.word)
    if satisfied != (trial.outcome is Outcome.SATISFIED):
        return [f"outcome {trial.outcome}, but the word {'satisfies' if satisfied else 'does not satisfy'} the formula"]
    # A start that violates is nobody's move.
    if len(trial.word) > 1 and word_violates(task.text, task.propositions, trial.word):
        return ["the word violates the formula"]
    return []


def satisfaction_is_promised(trial: Trial, task: Task) -> bool:
    """Whether acceptance stays within reach of every live product state that the robot can reach in the true world."""
    dfa = task.dfa
    free, letters = (~np.asarray(trial.world.occupied)).tolist(), np.asarray(trial.world.letters).tolist()
    start = trial.path[0]
    first = (start, int(dfa.transitions[dfa.initial, letters[start[0]][start[1]]]))
    reached, backward = {first}, {}
    queue = deque([first])
    while queue:
        node = queue.popleft()
        if dfa.accepting[node[1]]:
            continue
        for cell, _ in grid_moves(free, node[0]):
            if not free[cell[0]][cell[1]]:
                continue
            state = int(dfa.transitions[node[1], letters[cell[0]][cell[1]]])
            if dfa.trap[state]:
                continue
            following = (cell, state)
            backward.setdefault(following, []).append(node)
            if following not in reached:
                reached.add(following)
                queue.append(following)
    winning = {node for node in reached if dfa.accepting[node[1]]}
    queue = deque(winning)
    while queue:
        for node in backward.get(queue.popleft(), ()):
            if node not in winning:
                winning.add(node)
                queue.append(node)
    return len(winning) == len(reached) and not dfa.trap[first[1]]
