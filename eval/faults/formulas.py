"""Formulas that grow: conjunctions, chains, ranges and nests of a size that doubles, triples or breaks what reads them.

Whatever is made of one must be a task that can be planned with, or a refusal in one line, soon.
"""

import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from eval.faults import Kind, WrongAnswerError
from potlp_jax.errors import TaskWarning
from potlp_jax.task.propositions import MAX_PROPOSITIONS
from potlp_jax.task.task import Task

_LIMIT = 5.0


def _names(count: int) -> list[str]:
    return [f"p{number}" for number in range(count)]


def _size(random: np.random.Generator, most: int) -> int:
    """From 1 to ``most``, as often small as large on a scale of powers."""
    return int(np.exp(random.uniform(0, np.log(most + 1))))


def _operand(random: np.random.Generator) -> str:
    """A few propositions, joined so that their letters take few cubes or many."""
    names = random.choice(_names(MAX_PROPOSITIONS), random.integers(1, 4), replace=False)
    operator = random.choice([" & ", " | ", " xor ", " <-> "])
    signs = random.choice(["", "!"], len(names), p=[0.8, 0.2])
    return "(" + operator.join(map("".join, zip(signs, names, strict=True))) + ")"


def _conjunction(random: np.random.Generator) -> str:
    """Parts that may come in any order: the automaton doubles with each."""
    operator = random.choice([" & ", " & ", " | "])
    return operator.join(f"F {_operand(random)}" for _ in range(_size(random, 40)))


def _chain(random: np.random.Generator) -> str:
    """One part within the other."""
    depth, text = _size(random, 1500), _operand(random)
    links = [
        random.choice(["X {}", "F({1} & {0})", "({1} U {0})", "X({1} & {0})"]) for _ in range(random.integers(1, 3))
    ]
    for step in range(depth):
        text = links[step % len(links)].format(text, _operand(random))
    return text


def _repeated(random: np.random.Generator) -> str:
    """Signs without end: longer than a stack is deep."""
    sign = str(random.choice(["X ", "F", "!", "(", "!X ", "<>", "a U ", "a -> ", '"', "\x00", "é"]))
    count = _size(random, 200_000)
    return sign * count + "p0" + (")" * count if sign == "(" else "")


def _range(random: np.random.Generator) -> str:
    """Short texts that stand for long formulas."""
    text = _operand(random)
    for _ in range(random.integers(1, 4)):
        low, high = sorted(random.choice([0, 1, 3, 20, 100, 254, 10**6, 10**12], 2).tolist())
        form = random.choice(["F[{0}:{1}]({2})", "X[{1}]({2})", "{{{2}[*{0}:{1}]}}!", "F({3} & F[{0}:{1}]({2}))"])
        text = form.format(low, high, text, _operand(random))
    return text


def _random(random: np.random.Generator) -> str:
    """Any co-safe formula of any size."""

    def part(size: int) -> str:
        if size <= 1:
            return _operand(random)
        left = int(random.integers(1, size))
        form = random.choice(["F({0})", "X({0})", "({0}) & ({1})", "({0}) | ({1})", "({0}) U ({1})", "({0}) M ({1})"])
        return form.format(part(left), part(size - left))

    return part(_size(random, 60))


def _case(make: Callable[[np.random.Generator], str], random: np.random.Generator, folder: Path) -> None:
    """Compile a formula, with a limit of positive literals in every third case, and use what comes of it."""
    text = make(random)
    (folder / "formula").write_bytes(text.encode("utf-8", "surrogatepass"))
    limit = 1 if random.random() < 1 / 3 else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TaskWarning)
        task = Task.from_formula(text, max_positive_literals=limit)
        again = Task.from_formula(f"({text})", task.propositions, limit)
    fields = task.arrays
    if task.dfa.accepting.sum() != 1 or not fields.state_mask.all():
        raise WrongAnswerError("the automaton has no accepting state, or the arrays are not those of the task")
    if not np.array_equal(again.dfa.transitions, task.dfa.transitions):
        raise WrongAnswerError("the formula in parentheses gives another automaton")


def _kind(name: str, make: Callable[[np.random.Generator], str]) -> Kind:
    # Spot's own process has a limit of memory too, above what it needs to start; it inherits none from this one.
    return Kind(name, partial(_case, make), "formulas", _LIMIT, memory=None)


KINDS = (
    _kind("formulas: many parts", _conjunction),
    _kind("formulas: long chains", _chain),
    _kind("formulas: repeated signs", _repeated),
    _kind("formulas: ranges", _range),
    _kind("formulas: at random", _random),
)
