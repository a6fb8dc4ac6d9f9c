"""Doubts about a formula where it meets an environment: what its first worlds hold, and one line on stderr."""

import logging
from collections.abc import Sequence

import numpy as np

from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import MAX_INDEX, Split, default_split, world_key
from potlp_jax.sweep.specification import Specification
from potlp_jax.task.doubts import NOTHING_TO_DO, Surroundings, find_doubts
from potlp_jax.task.task import Task
from potlp_jax.world.grid import World

logger = logging.getLogger(__name__)

WORLDS_LOOKED_AT: int = 3
"""Worlds that stand for an environment: what none of them holds is probably in none."""


def surroundings_of(generator: Generator, split: Split | None = None, first: int = 0) -> Surroundings:
    """What the first worlds of an environment hold.

    Args:
        generator: the environment.
        split: whose worlds; None: the environment's default.
        first: number of the first world.

    Returns:
        The letters of ``WORLDS_LOOKED_AT`` worlds, of fewer where there are no more, and their starts.

    Raises:
        WorldError: one cannot be made.
    """
    chosen = default_split(generator.name) if split is None else split
    numbers = range(first, min(first + WORLDS_LOOKED_AT, MAX_INDEX + 1))
    worlds = [generator.generate(world_key(chosen, number, generator.name)) for number in numbers]
    return of_worlds(f"worlds {first} to {numbers[-1]} of {generator.name}/{chosen}", worlds)


def of_worlds(name: str, worlds: Sequence[World]) -> Surroundings:
    """What these worlds hold, under this name."""
    letters: set[int] = set()
    for world in worlds:
        letters |= set(np.unique(np.asarray(world.letters)[~np.asarray(world.occupied)]).tolist())
    starts = [int(np.asarray(world.letters)[tuple(np.asarray(world.start))]) for world in worlds]
    return Surroundings(name, tuple(sorted(letters)), tuple(starts))


def warn_of_doubts(task: Task, surroundings: Surroundings) -> None:
    """Say the first doubt about a task in one line, and how many more there are."""
    # That there is nothing to do, compiling the task has said.
    doubts = [
        doubt for doubt in find_doubts(task, surroundings, propositions_given=True) if doubt.kind != NOTHING_TO_DO
    ]
    if doubts:
        more = f" (and {len(doubts) - 1} more: potlp task)" if len(doubts) > 1 else ""
        logger.warning(f"task '{task.text}': {doubts[0].message}{more}")


def warn_of_sweep(specification: Specification) -> None:
    """Say the first doubt about each task of a sweep, before it costs hours."""
    for name in dict.fromkeys(cell.environment for cell in specification.cells):
        generator = make(name)
        surroundings = surroundings_of(generator, specification.split, specification.first_world)
        for cell in specification.cells:
            if cell.environment == name:
                warn_of_doubts(specification.task_of(cell, generator), surroundings)
