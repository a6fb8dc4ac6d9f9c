"""Which trial of a sweep ``potlp sweep trial`` runs once more, and whether it goes as its row says."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from potlp_jax.cli.output import fail

if TYPE_CHECKING:
    from potlp_jax.sweep.runner import Sweep
    from potlp_jax.sweep.specification import Specification
    from potlp_jax.sweep.store import Row

logger = logging.getLogger(__name__)

# Enough to see how the worlds are numbered.
_WORLDS_NAMED = 10


def opened(folder: Path) -> "Sweep":
    """The sweep of a folder, to be read.

    Raises:
        StoreError: its estimator, or a file of the user's own that it runs, is not what it was.
        EstimatorError, PluginError: its estimator is gone; what was asked is put back, for no other can be given.
    """
    from potlp_jax.cli.inputs import open_store
    from potlp_jax.errors import EstimatorError, PluginError
    from potlp_jax.sweep.runner import Sweep
    from potlp_jax.sweep.specification import specification_from_store

    with open_store(folder) as store:
        specification = specification_from_store(store.specification())
    try:
        return Sweep(specification, folder, read_only=True)
    except (EstimatorError, PluginError) as error:
        fail(f"{folder}: put back what the sweep was run with: {error}")


def chosen_row(sweep: "Sweep", environment: str | None, task: str | None, policy: str | None, world: int) -> "Row":
    """The row that is meant; ends the command where the sweep has no such row.

    Args:
        sweep: that is read.
        environment, task, policy: None for the only one, or of policies for the one on trial.
        world: its number.
    """
    from potlp_jax.sweep.results import subject_of

    specification = sweep.specification
    environment = _one_of("environment", environment, [cell.environment for cell in specification.cells])
    task = _task_of(specification, environment, task)
    policy = _one_of("policy", policy or subject_of(specification.policies), specification.policies)
    rows = [row for row in sweep.store.rows(environment, task) if row.item.policy == policy]
    found = {row.item.world: row for row in rows}
    if world not in found:
        fail(f"--world {world}: {policy} has no trial there: {_why_none(sweep, environment, task, policy, world)}")
    return found[world]


def _one_of(option: str, given: str | None, names: Sequence[str]) -> str:
    """What was named with an option, or the only name there is."""
    known = list(dict.fromkeys(names))
    if given is None and len(known) == 1:
        return known[0]
    if given not in known:
        said = f"--{option}: name one" if given is None else f"--{option} {given}: the sweep has no such {option}"
        fail(f"{said}; it has: {', '.join(known)}")
    return given


def _task_of(specification: "Specification", environment: str, given: str | None) -> str:
    """The task of a cell: by the cell's own name for it, by its number in the environment, or written otherwise."""
    from potlp_jax.environments.registry import make
    from potlp_jax.task.doubts import structure_of
    from potlp_jax.task.language import same_language

    cells = [cell for cell in specification.cells if cell.environment == environment]
    tasks = [cell.task for cell in cells]
    if given is None or given in tasks:
        return _one_of("task", given, tasks)
    generator = make(environment)
    asked = generator.task(given)
    structure = structure_of(asked)
    for cell in cells:
        of_cell = specification.task_of(cell, generator)
        # By its language, so that it does not matter how a formula is written, nor what an automaton is called.
        is_same = structure is not None and same_language(structure, of_cell.dfa, generator.propositions)
        if is_same or cell.task == asked.text:
            return cell.task
    return _one_of("task", given, tasks)


def _why_none(sweep: "Sweep", environment: str, task: str, policy: str, world: int) -> str:
    """Why a policy has no row in a world."""
    from potlp_jax.sweep.store import Item

    if (error := sweep.store.broken().get(Item(environment, task, policy, world))) is not None:
        return f"it was given up: {error}"
    if not sweep.store.possible(environment, task).get(world, True):
        return "the task is impossible in it"
    worlds = [row.item.world for row in sweep.store.rows(environment, task) if row.item.policy == policy]
    named = ", ".join(map(str, worlds[:_WORLDS_NAMED])) or "none"
    more = f" and {len(worlds) - _WORLDS_NAMED} more" if len(worlds) > _WORLDS_NAMED else ""
    return f"the sweep has not run it; there are: {named}{more}"


def warn_of_differences(row: "Row", differing: Sequence[str]) -> None:
    """Say in what a trial that was run once more differs from its row, and why that may be."""
    if not differing:
        return
    by = f"commit {row.commit}" if row.commit else f"potlp-jax {row.versions.get('potlp-jax', 'unknown')}"
    logger.warning(
        f"this trial is not that of the sweep's row ({row.outcome}, cost {row.cost:.2f}, by {by}); it differs in: "
        f"{', '.join(differing)}. What decides has changed since: the package, or a file that one of your own imports"
    )
