"""Random co-safe formulas for evaluations: seeded, so that every run asks the same questions."""

import warnings

import numpy as np

from potlp_jax.errors import SpotMissingError, TaskError, TaskWarning
from potlp_jax.task.task import Task, TaskSizes


def random_formula(rng: np.random.Generator, names: tuple[str, ...], depth: int) -> str:
    """A formula in negation normal form over next, until, strong release, eventually and the Boolean operators."""
    if depth == 0 or rng.random() < 0.15:
        name = str(rng.choice(names))
        return f"!{name}" if rng.random() < 0.3 else name
    operator = str(rng.choice(["F", "X", "&", "|", "U", "M", "F&", "F&"]))
    left, right = (random_formula(rng, names, depth - 1) for _ in range(2))
    if operator in "FX":
        return f"{operator}({left})"
    if operator == "F&":
        return f"F(({left}) & F({right}))"
    return f"(({left}) {operator} ({right}))"


def random_tasks(count: int, names: tuple[str, ...], largest: TaskSizes, seed: int = 0) -> list[Task]:
    """Different automata of 2 states or more that fit ``largest`` and ask the robot to look for something."""
    rng = np.random.default_rng(seed)
    tasks, known = [], set()
    while len(tasks) < count:
        try:
            with warnings.catch_warnings():
                # Formulas that everything satisfies are drawn too, and dropped below.
                warnings.simplefilter("ignore", TaskWarning)
                task = Task.from_formula(random_formula(rng, names, int(rng.integers(2, 5))), propositions=names)
        except SpotMissingError:
            raise
        except TaskError:
            continue
        key = task.dfa.transitions.tobytes()
        first = task.dfa.transitions[task.dfa.initial, 0]
        searches = not task.dfa.accepting[first] and not task.dfa.trap[first] and len(task.edges) > 0
        if searches and key not in known and largest.covers(task.sizes):
            known.add(key)
            tasks.append(task)
    return tasks


def traits(task: Task) -> dict[str, bool]:
    """What makes a task awkward: next, a cycle of live states, a transition that several cubes make up."""
    following = {int(z): {int(target) for target in row} - {int(z)} for z, row in enumerate(task.dfa.transitions)}
    live = [z for z in following if not task.dfa.trap[z] and not task.dfa.accepting[z]]

    def reaches(start: int) -> set[int]:
        seen, stack = set(), [start]
        while stack:
            for target in following[stack.pop()]:
                if target in live and target not in seen:
                    seen.add(target)
                    stack.append(target)
        return seen

    return {
        "next": "X" in task.text,
        "cycle": any(z in reaches(z) for z in live),
        "several cubes": task.sizes.compound > 0,
    }
