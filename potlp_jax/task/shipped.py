"""Automata that come with the package: found by name, or by the language of a formula. No Spot is needed.

``train/write_shipped_tasks.py`` makes the files, with Spot: one for every task of every environment that has a name.
"""

from collections.abc import Mapping
from functools import cache
from importlib import resources

import numpy as np

from potlp_jax.task.automaton import Dfa, canonical_dfa
from potlp_jax.task.hoa import HoaAutomaton, read_hoa
from potlp_jax.task.language import Formula, same_language, support


@cache
def shipped_hoa() -> Mapping[str, str]:
    """The texts of the files, by the names of the tasks, sorted."""
    files = resources.files("potlp_jax.task").joinpath("data").iterdir()
    texts = {file.name.removesuffix(".hoa"): file.read_text("utf-8") for file in files if file.name.endswith(".hoa")}
    return dict(sorted(texts.items()))


def shipped_tasks() -> Mapping[str, str]:
    """Names of the tasks that come with the package, and their formulas."""
    return {name: read_hoa(text).name for name, text in shipped_hoa().items()}


def find_shipped(formula: Formula) -> HoaAutomaton | None:
    """The automaton that ships and has the language of a formula; None if there is none.

    Its propositions are those on which the language depends: a shipped automaton has all of its environment's, and
    those that the task does not mention need not exist where the formula is used.
    """
    for automaton in _automata():
        dfa = canonical_dfa(automaton.transitions, automaton.accepting, automaton.initial)
        if same_language(formula, dfa, automaton.propositions):
            return _over_support(dfa, automaton)
    return None


@cache
def _automata() -> tuple[HoaAutomaton, ...]:
    return tuple(read_hoa(text) for text in shipped_hoa().values())


def _over_support(dfa: Dfa, automaton: HoaAutomaton) -> HoaAutomaton:
    """The same language over the propositions on which it depends."""
    bits = support(dfa)
    narrow = np.arange(2 ** len(bits))
    letters = sum(((narrow >> i & 1) << bit for i, bit in enumerate(bits)), np.zeros_like(narrow))
    return HoaAutomaton(
        name=automaton.name,
        propositions=tuple(automaton.propositions[bit] for bit in bits),
        transitions=dfa.transitions[:, letters],
        accepting=dfa.accepting,
        initial=dfa.initial,
    )
