"""Writes the HOA files of the tasks that come with the package; needs Spot.

    python -m train.write_shipped_tasks

``tests/test_task.py`` checks that the files equal what this writes.
"""

from pathlib import Path

import potlp_jax.task
from potlp_jax.task.task import Task

FIREFIGHTING = ("fire", "alarm", "extinguisher", "exit")
DELIVERY = ("professor", "grad", "undergrad")
TOY = ("goal", "hazard")

# The fire-fighting and delivery tasks are those of Bradley et al. 2021, sections V-A and V-B, in the paper's order.
SHIPPED_TASKS: dict[str, tuple[str, tuple[str, ...]]] = {
    "firefighting-1": ("(!fire U alarm) | ((!fire U extinguisher) & F fire)", FIREFIGHTING),
    "firefighting-2": ("!fire U (alarm & F exit)", FIREFIGHTING),
    "firefighting-3": ("(!fire U extinguisher) & F(fire & F exit)", FIREFIGHTING),
    "firefighting-4": ("!fire U exit", FIREFIGHTING),
    "delivery-1": ("F professor & F grad & F undergrad", DELIVERY),
    "toy-1": ("F goal", TOY),
    "toy-2": ("!hazard U goal", TOY),
}


def shipped_hoa(name: str) -> str:
    """The text of one file."""
    formula, propositions = SHIPPED_TASKS[name]
    return Task.from_formula(formula, propositions).to_hoa()


def main() -> None:
    """Writes every file."""
    folder = Path(potlp_jax.task.__file__).parent / "data"
    for name in SHIPPED_TASKS:
        (folder / f"{name}.hoa").write_text(shipped_hoa(name), "utf-8")


if __name__ == "__main__":
    main()
