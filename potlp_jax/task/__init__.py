"""A formula becomes arrays (host only)."""

from potlp_jax.errors import TaskError
from potlp_jax.task.automaton import Dfa
from potlp_jax.task.outcomes import Condition, OutcomeClass, Outcomes
from potlp_jax.task.task import Task, TaskArrays, TaskSizes, shipped_tasks, stack_tasks

__all__ = [
    "Condition",
    "Dfa",
    "OutcomeClass",
    "Outcomes",
    "Task",
    "TaskArrays",
    "TaskError",
    "TaskSizes",
    "shipped_tasks",
    "stack_tasks",
]
