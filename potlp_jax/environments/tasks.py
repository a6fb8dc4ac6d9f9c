"""Tasks as users name them: by number, as a formula, as an automaton in a file."""

from collections.abc import Sequence
from pathlib import Path

from potlp_jax.environments.base import Generator
from potlp_jax.errors import TaskError
from potlp_jax.task.task import Task, shipped_tasks


def read_task(text: str, propositions: Sequence[str] | None = None, max_positive_literals: int | None = None) -> Task:
    """The task of a formula, of the name of a shipped task, or of a ``.hoa`` file.

    Args:
        text: one of the three.
        propositions: all propositions, in the order of a letter's bits; None: those that the task names.
        max_positive_literals: drops cubes that need more propositions to hold at one cell.

    Raises:
        TaskError: the file cannot be read, or what is named is no task over these propositions.
    """
    if text.endswith(".hoa"):
        return Task.from_hoa(_read(Path(text)), propositions, max_positive_literals)
    if text in shipped_tasks():
        return Task.from_hoa(Task.shipped(text).to_hoa(), propositions, max_positive_literals)
    return Task.from_formula(text, propositions, max_positive_literals)


def environment_task(generator: Generator, text: str) -> Task:
    """A task over the environment's propositions: one of its own by number (or name), or any that ``read_task`` reads.

    Raises:
        TaskError: the environment has no such task, or as ``read_task``.
    """
    formula = generator.tasks.get(text, text)
    if formula.strip().isdecimal():
        known = ", ".join(f"{number} ({entry})" for number, entry in generator.tasks.items()) or "none"
        raise TaskError(f"{generator.name} has no task {text}; it has: {known}. Or give a formula.")
    if formula in generator.tasks.values():
        # Tasks of the shipped families come compiled, so that they need no Spot.
        return Task.of_formula(formula, generator.propositions)
    return read_task(formula, generator.propositions)


def _read(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except OSError as error:
        raise TaskError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise TaskError(f"{path}: not a text file") from error
