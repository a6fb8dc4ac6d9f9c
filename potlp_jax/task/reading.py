"""Tasks as users name them: a formula, the name of a shipped task, an automaton in a file."""

from collections.abc import Sequence
from pathlib import Path

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
    if propositions is not None and max_positive_literals is None:
        # Formulas of the shipped families come compiled, so that they need no Spot.
        return Task.of_formula(text, propositions)
    return Task.from_formula(text, propositions, max_positive_literals)


def _read(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except OSError as error:
        raise TaskError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise TaskError(f"{path}: not a text file") from error
