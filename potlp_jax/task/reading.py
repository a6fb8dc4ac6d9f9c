"""Tasks as users name them: a formula, the name of a shipped task, an automaton in a file."""

from collections.abc import Sequence

from potlp_jax.errors import TaskError
from potlp_jax.files import read_text
from potlp_jax.task.shipped import shipped_tasks
from potlp_jax.task.task import Task


def read_task(text: str, propositions: Sequence[str] | None = None, max_positive_literals: int | None = None) -> Task:
    """The task of a formula, of the name of a shipped task, or of a ``.hoa`` file.

    Args:
        text: one of the three.
        propositions: all propositions, in the order of a letter's bits; None: those that the task names.
        max_positive_literals: drops cubes that need more propositions to hold at one cell.

    Returns:
        The task, over ``propositions`` where they are given.

    Raises:
        TaskError: the file cannot be read, or what is named is no task over these propositions.
    """
    if text.endswith(".hoa"):
        return Task.from_hoa(read_text(text, TaskError), propositions, max_positive_literals)
    if text in shipped_tasks():
        return Task.from_hoa(Task.shipped(text).to_hoa(), propositions, max_positive_literals)
    return Task.from_formula(text, propositions, max_positive_literals)
