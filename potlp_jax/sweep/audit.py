"""Check the rows of a sweep against worlds that are made anew, by rules that the planner does not share."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType

import jax
import numpy as np

from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import TaskWarning
from potlp_jax.sweep.rows import read_path
from potlp_jax.sweep.specification import Cell, Specification
from potlp_jax.sweep.store import Row
from potlp_jax.task.task import Task
from potlp_jax.trials.rules import trial_key
from potlp_jax.verify.audit import NOT_READ, problems_of_ending, problems_of_path
from potlp_jax.verify.semantics import can_be_judged
from potlp_jax.world.grid import World, world_digest


def audit_rows(
    rows: Sequence[Row],
    split: Split,
    seed: int = 0,
    generator_of: Callable[[str], Generator] = make,
    automata: Mapping[str, str] = MappingProxyType({}),
) -> Iterator[tuple[Row, str]]:
    """What is wrong with the trials of a sweep.

    Args:
        rows: of one sweep, in any order.
        split: from which its worlds are.
        seed: of its trials' keys.
        generator_of: the family of worlds of an environment's name.
        automata: HOA texts of the sweep's tasks that were read from files (``Specification.automata``).

    Returns:
        Each row with one sentence for each of its problems, ordered by environment and world; rows without any are not
        among them. A sentence about a violation of the task begins with ``violates``.

    Warns:
        TaskWarning: a formula is not read here, so that its rows are judged by the automaton that Spot makes of it.
    """
    # Making a world takes longer than judging a trial in it: each is made once, for the trials of all policies.
    made: tuple[str, int] | None = None
    generator, world = None, None
    tasks: dict[tuple[str, str], str | Task] = {}
    for row in sorted(rows, key=lambda row: (row.item.environment, row.item.world)):
        environment, number = row.item.environment, row.item.world
        if generator is None or made is None or made[0] != environment:
            generator = generator_of(environment)
        if world is None or made != (environment, number):
            world = generator.generate(world_key(split, number, generator.name))
        made = (environment, number)
        name = (environment, row.item.task)
        if name not in tasks:
            tasks[name] = _task_of(row.item.task, automata.get(row.item.task), generator.propositions)
        yield from ((row, problem) for problem in problems_of_row(row, world, tasks[name], seed))


def _task_of(text: str, automaton: str | None, propositions: tuple[str, ...]) -> str | Task:
    """What the rows of a task are judged by: its formula, or an automaton."""
    if automaton is not None:
        return Task.from_hoa(automaton, propositions)
    if can_be_judged(text, propositions):
        return text
    warnings.warn(f"task {text!r}: {NOT_READ}", TaskWarning, stacklevel=3)
    return Task.from_formula(text, propositions)


def audit_items(rows: Sequence[Row], specification: Specification) -> Iterator[tuple[Row, str]]:
    """The rows that a sweep never asked for, each with one sentence.

    Args:
        rows: of the store, in any order.
        specification: of the sweep.

    Returns:
        Rows of another environment, task or policy, or of a world before the first.
    """
    for row in rows:
        item = row.item
        # A path may satisfy another task as well: that it was not asked for is all that is wrong then.
        asked = Cell(item.environment, item.task) in specification.cells and item.policy in specification.policies
        if not asked or item.world < specification.first_world:
            yield row, "is of an environment, a task, a policy or a world that the sweep does not have"


def problems_of_row(row: Row, world: World, task: str | Task, seed: int = 0) -> list[str]:
    """What is wrong with one trial; an empty list if nothing is.

    Args:
        row: of the store.
        world: the one of the row's environment, split and number.
        task: the row's, a formula or an automaton.
        seed: of the sweep's keys.

    Returns:
        One sentence for each problem.
    """
    found = []
    # A path may be legal in another world by chance. The digest tells what the row was made in.
    if row.world_digest != world_digest(world):
        found.append("was in another world: its digest is not that of the row's environment, split and number")
    if row.key != tuple(np.asarray(jax.random.key_data(trial_key(row.item.world, seed))).tolist()):
        found.append("was made with another key than that of its world and the sweep's seed")
    try:
        path = read_path(row.path)
    except (ValueError, IndexError):
        return [*found, f"its path cannot be read: {row.path[:40]!r}"]
    if row.steps != len(path) - 1:
        found.append(f"has {row.steps} steps, its path {len(path) - 1}")
    found += problems_of_ending(row.outcome, row.cost, row.budget)
    return found + problems_of_path(world, path, row.cost, row.outcome, task)
