"""Writes the HOA files of the tasks that come with the package; needs Spot.

    python -m train.write_shipped_tasks

They are the tasks of all environments that have a name. ``tests/test_task.py`` checks that the files equal what this
writes.
"""

from pathlib import Path

import potlp_jax.task
from potlp_jax.environments.families import NAMED
from potlp_jax.environments.registry import make
from potlp_jax.task.task import Task


def shipped_texts() -> dict[str, str]:
    """The texts of all files, by the names of the tasks: the environment's, and the task's number in it."""
    generators = {name: make(name) for name in NAMED}
    return {
        f"{name}-{number}": Task.from_formula(formula, generator.propositions).to_hoa()
        for name, generator in generators.items()
        for number, formula in generator.tasks.items()
    }


def main() -> None:
    """Writes every file."""
    folder = Path(potlp_jax.task.__file__).parent / "data"
    for name, text in shipped_texts().items():
        (folder / f"{name}.hoa").write_text(text, "utf-8")


if __name__ == "__main__":
    main()
