"""Check a finished trial against the truth, independently of the planner: also that of a planner of one's own.

The truth is a world that the caller makes anew, from its environment, split and number: a record that was made in
another one, or whose copy of the world was changed, is found by that.

The word is judged by ``potlp_jax.verify.semantics``, an evaluator of the formula's semantics (a task that is an
automaton without a formula by the automaton's table: nothing else says what was to be done); moves, letters, cost and
what was observed when are checked against the world by rules of this file alone. Nothing of how the library plans,
moves or simulates is used: a mistake made there is not made here again.
"""

import functools
import math
import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Int32

from potlp_jax.errors import PropositionsError, TaskError, TaskWarning
from potlp_jax.task.task import Task
from potlp_jax.trials.record import NEVER_SEEN, Outcome, Trial
from potlp_jax.verify.semantics import can_be_judged, has_language_of, word_satisfies, word_violates
from potlp_jax.world.grid import World
from potlp_jax.world.settings import Settings

Cell = tuple[int, int]
Node = tuple[Cell, int]
"""A cell and a state of the automaton."""

Cells = list[list[bool]]
"""Rows of a map; True where a cell is free."""

# Costs are sums of float64 on both sides, in another order: only rounding may differ.
_TOLERANCE = 1e-9
_SINGLE = 1e-5


def problems_of(trial: Trial, task: Task, world: World) -> list[str]:
    """What is wrong with a trial in simulation; an empty list if nothing is.

    Checks the path, the cost and the outcome as ``problems_of_path`` does, that the record is of this world and this
    task, that its word, its states and its decisions are those of the path, that no cell was entered before it had
    been observed, and that the trial ended satisfied where docs/model.md section 7 promises it.

    Args:
        trial: the record to be judged.
        task: what was to be done.
        world: the true map, made anew from its environment, split and number. The record's own copy is judged as the
            rest of it is: a trial in another world is a problem.

    Returns:
        One sentence for each problem. One about a violation of the task begins with ``violates``.
    """
    found = _world_differences(trial.world, world) + _task_differences(trial, task)
    found += problems_of_path(world, trial.path, trial.cost, trial.outcome, task)
    # What follows looks cells up in the map and letters in the automaton, and needs both to be the trial's.
    if found or trial.first_seen.shape != world.shape:
        return found or ["the table of first observations has another shape than the map"]
    word = _word_of(world, trial.path)
    if list(trial.word) != word:
        found.append("the word is not that of the path")
    if list(trial.states) != _states_of(task, word):
        found.append("the states are not those of the word")
    elif any(task.dfa.accepting[state] for state in trial.states[:-1]):
        found.append("goes on after the task was satisfied")
    found += _decision_differences(trial) + _entered_before_observed(trial) + _ending_differences(trial, task)
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
    task: str | Task,
) -> list[str]:
    """What is wrong with a path that some planner took; an empty list if nothing is.

    Args:
        world: the true map. Its ``propositions`` say what the bits of its letters mean.
        path: cells entered in order, the start first.
        cost: what the planner says that the path costs, in the unit of the world's resolution.
        outcome: how the planner says that the trial ended; ``"satisfied"`` is the value that matters.
        task: a formula, co-safe linear temporal logic over the world's propositions; or a task, which is judged by its
            formula (``formula_of``), or where it has none by its automaton.

    Returns:
        One sentence for each problem. One about a violation of the task begins with ``violates``.

    Raises:
        PropositionsError: a task that is judged by its automaton is not over the world's propositions.
        TaskError: a text is no co-safe formula over the world's propositions.
    """
    cells = [(int(row), int(column)) for row, column in path]
    start = (int(world.start[0]), int(world.start[1]))
    height, width = world.shape
    # A path of another world is told by where it begins, long before a wall of this one is in its way.
    if not cells or cells[0] != start:
        return [f"begins in {cells[0] if cells else 'no cell'}, the start of the world is {start}"]
    outside = [cell for cell in cells if not (0 <= cell[0] < height and 0 <= cell[1] < width)]
    if outside:
        return [f"enters {outside[0]}, outside of the {height}x{width} map"]
    found = []
    true_cost = path_cost(world, cells)
    if true_cost is None:
        found.append("illegal move")
    elif not math.isclose(true_cost, cost, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE):
        found.append(f"the cost is said to be {cost}, the moves cost {true_cost}")
    word = _word_of(world, cells)
    satisfied, violated = _judged(task, world.propositions, word)
    if satisfied != (outcome == Outcome.SATISFIED):
        found.append(f"outcome {outcome} is not what the word says")
    # A start that violates is nobody's move.
    if len(word) > 1 and violated:
        found.append("violates the formula")
    return found


def _judged(task: str | Task, propositions: tuple[str, ...], word: Sequence[int]) -> tuple[bool, bool]:
    """Whether a word satisfies and whether it violates a task."""
    formula = formula_of(task) if isinstance(task, Task) else task
    if formula is None:
        assert isinstance(task, Task)
        if task.propositions != propositions:
            raise PropositionsError(f"the task is over {task.propositions}, the world over {propositions}")
        states = _states_of(task, word)
        return any(task.dfa.accepting[state] for state in states), bool(task.dfa.trap[states[-1]])
    return word_satisfies(formula, propositions, word), word_violates(formula, propositions, word)


NOT_READ: str = (
    "the auditor does not read this formula, as those of PSL; trials are judged by the automaton that Spot makes of it"
)
"""What is said of such a task."""


# Tasks are compared by identity, and all trials of a sweep ask for the same few.
@functools.lru_cache(maxsize=64)
def formula_of(task: Task) -> str | None:
    """The formula by which a task is judged; None for an automaton of which its table alone says what is to be done.

    A task that was made from a formula is judged by it, whatever its automaton, but for operators of PSL, which are not
    read here. The name of an automaton may be anything, also a formula of another language: it counts only where the
    languages are equal.
    """
    if task.structure is not None:
        is_formula = can_be_judged(task.text, task.propositions)
    else:
        dfa = task.dfa
        is_formula = has_language_of(task.text, task.propositions, dfa.transitions, dfa.accepting, int(dfa.initial))
    return task.text if is_formula else None


def task_of_record(trial: Trial, propositions: tuple[str, ...]) -> Task:
    """What a trial was for, by its record alone: its formula, or where the text is a mere name its automaton.

    Args:
        trial: of a record.
        propositions: of the environment.

    Returns:
        The task, over these propositions.

    Raises:
        TaskError: the automaton of the record is none, or names another proposition.
    """
    recorded = Task.from_hoa(trial.task_hoa, propositions)
    if formula_of(recorded) is not None:
        return recorded
    # Either a file's automaton that is called as a formula is, or a formula that was translated wrongly. A wrong
    # translation comes out once more, and is judged by the formula.
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TaskWarning)
            translated = Task.from_formula(trial.task_text, propositions)
    except TaskError:
        return recorded
    return translated if has_table_of(translated, recorded) else recorded


def _world_differences(claimed: World, world: World) -> list[str]:
    """What differs between the world that a record holds and the true one, in words."""
    # Everything that a trial depends on: also what a camera sees, and the settings that the world calls for.
    pairs = {
        name: (getattr(claimed, name), getattr(world, name))
        for name in ("occupied", "letters", "start", "resolution", "extent", "propositions", "settings")
    }
    pairs |= {name: (value, vars(world.appearance)[name]) for name, value in vars(claimed.appearance).items()}
    differing = [name for name, (mine, true) in pairs.items() if not _is_same(mine, true)]
    return [f"was in another world: {', '.join(differing)} differ"] if differing else []


def _is_same(mine: Any, true: Any) -> bool:
    if isinstance(true, tuple | Settings):
        return mine == true
    return np.array_equal(np.asarray(mine), np.asarray(true))


def _task_differences(trial: Trial, task: Task) -> list[str]:
    """What differs between the task that a record holds and the one that was to be done."""
    found = []
    if trial.task_text != task.text:
        found.append(f"was for the task {trial.task_text!r}, not for {task.text!r}")
    # Names and order: the same formula over other bits is another task.
    if trial.propositions != task.propositions or trial.propositions != trial.world.propositions:
        found.append(
            f"was for a task over {trial.propositions} in a world over {trial.world.propositions}, not over "
            f"{task.propositions}"
        )
        return found
    if not has_table_of(Task.from_hoa(trial.task_hoa, trial.propositions), task):
        found.append("its automaton is not that of the task")
    return found


def has_table_of(task: Task, other: Task) -> bool:
    """Whether the automata of two tasks over the same propositions have one language."""
    # Both are minimal with their states in one canonical order: equal languages have equal tables.
    mine, true = task.dfa, other.dfa
    tables = ((mine.transitions, true.transitions), (mine.accepting, true.accepting))
    return mine.initial == true.initial and all(np.array_equal(one, another) for one, another in tables)


def _states_of(task: Task, word: Sequence[int]) -> list[int]:
    """The automaton's state after each letter of a word."""
    states, state = [], int(task.dfa.initial)
    for letter in word:
        state = int(task.dfa.transitions[state, letter])
        states.append(state)
    return states


def _ending_differences(trial: Trial, task: Task) -> list[str]:
    """What speaks against the way in which the trial is said to have ended without being satisfied."""
    if trial.outcome is Outcome.SATISFIED:
        return []
    found = problems_of_ending(trial.outcome, trial.cost, _budget(trial))
    # Infeasible: the policy knew no move, or the start is in a trap; and nothing else.
    knew_none = bool(trial.decisions) and trial.decisions[-1].kind == "none"
    if (knew_none or bool(task.dfa.trap[trial.states[-1]])) != (trial.outcome is Outcome.INFEASIBLE):
        found.append(f"ended {trial.outcome}, which is not what its last decision says")
    return found


def _budget(trial: Trial) -> float:
    """The cost at which the trial was to be given up, by its own settings."""
    return float(trial.config["budget_factor"]) * int(np.sum(trial.world.extent)) * float(trial.world.resolution)


def problems_of_ending(outcome: str, cost: float, budget: float) -> list[str]:
    """What speaks against the end of a trial in simulation, by its cost alone; an empty list if nothing does.

    Args:
        outcome: how it is said to have ended.
        cost: what it travelled.
        budget: the cost at which it was to be given up.

    Returns:
        One sentence at most.
    """
    # A world does not end before the task is decided, as a robot's log may.
    if outcome not in set(Outcome) - {Outcome.UNFINISHED}:
        return [f"{outcome!r} is no way for a trial in simulation to end"]
    # The planner counts in single precision.
    spent = cost >= budget * (1.0 - _SINGLE)
    if outcome == Outcome.BUDGET and not spent:
        return [f"ended {outcome} at the cost {cost}, the budget is {budget}"]
    if outcome == Outcome.STUCK and cost > budget * (1.0 + _SINGLE):
        return [f"ended {outcome} at the cost {cost}, beyond the budget {budget}"]
    return []


def _decision_differences(trial: Trial) -> list[str]:
    """The first decision that was not taken on the path, or after which the robot went elsewhere."""
    # Each leg of the path is the beginning of what its decision handed out: no cell of it can be exchanged for another.
    steps, last = [decision.step for decision in trial.decisions], len(trial.path) - 1
    # From the start, in order, none after the end; without any decision there is no move.
    if [*steps, last] != sorted([*steps, last]) or (steps[0] if steps else last) != 0:
        return ["the decisions do not cover the path"]
    for number, (decision, end) in enumerate(zip(trial.decisions, [*steps[1:], last], strict=False)):
        if decision.index != number:
            return [f"decision {number} has the number {decision.index}"]
        if decision.cell != trial.path[decision.step] or decision.state != trial.states[decision.step]:
            return [f"decision {number} was not taken where the path is at step {decision.step}"]
        leg = trial.path[decision.step : end + 1]
        if leg != decision.path[: len(leg)]:
            return [f"after decision {number} the path is not the one that was chosen"]
    return []


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
