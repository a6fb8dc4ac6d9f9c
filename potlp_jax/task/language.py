"""Whether a formula and an automaton have the same language, decided without Spot.

Spot makes automata out of formulas. Where it is missing, a formula can still be recognised as that of an automaton
which exists already, however it is written: with other spaces, operands in another order, or other operators. Nothing
made here is planned with; the automaton is Spot's.

The formula is progressed letter by letter beside the automaton. What remains of a co-safe formula after a word is a
disjunction of sets of obligations, and "nothing remains" is reached by exactly the words that satisfy it. So the two
languages are equal if and only if the automaton accepts wherever nothing remains, and no infinite word stays among
accepting states while something remains.

References:
    Bacchus and Kabanza, Using temporal logics to express search control knowledge for planning, AIJ 2000 (progression).
"""

import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from itertools import product

import numpy as np

from potlp_jax.task.automaton import Dfa
from potlp_jax.task.formula import Structure

Formula = Structure
"""Nested tuples: ("true",), ("false",), ("name", p), ("not", f), ("X", f), ("and", f, g), ("or", f, g), ("U", f, g)."""

Rest = frozenset[frozenset[Formula]]
"""What remains: some set of obligations, all of which the remaining word must meet. No set contains another one."""

MAX_TOKENS: int = 200
"""Longer formulas are not read: the parser is recursive, and the longest task that ships has 18 tokens."""
MAX_SETS: int = 200
"""Sets of obligations, at most: their number can double with each operand, and tasks that ship have 4 at most."""
MAX_STEPS: int = 20_000
"""Letters read, at most, for one comparison: about a second. Tasks that ship take 200 at most."""

_TRUE: Formula = ("true",)
_FALSE: Formula = ("false",)
_DONE: Rest = frozenset({frozenset()})
_HOPELESS: Rest = frozenset()

# Stricter than Spot: to Spot a word that begins with a capital may be operators and a name (XFa), or one name, as the
# known names have it. Such a word is not read at all, because a wrong reading would be a wrong task.
_TOKEN = re.compile(
    r"""\s*(?: (?P<name> [a-z_][A-Za-z0-9_.]* ) | (?P<quoted> "(?:[^"\\]|\\.)*" )
      | (?P<operator> <->|<=>|->|=>|\[\]|<>|&&|\|\||[!&|^()]|[FGXURWM](?![A-Za-z0-9_.]) )
      | (?P<constant> [01](?![A-Za-z0-9_.]) ) )""",
    re.VERBOSE,
)
_SPELLINGS = {"&&": "&", "||": "|", "=>": "->", "<=>": "<->", "[]": "G", "<>": "F", "^": "xor"}
_CONSTANTS = {"1": _TRUE, "true": _TRUE, "0": _FALSE, "false": _FALSE}


class UnreadableError(Exception):
    """The formula is not one that can be compared here; Spot may be able to read it."""


def same_language(formula: Formula, dfa: Dfa, propositions: Sequence[str]) -> bool:
    """Whether a formula and an automaton accept the same infinite words.

    Args:
        formula: a co-safe formula, from ``read_formula``.
        dfa: the automaton.
        propositions: names of the bits of the automaton's letters.

    Returns:
        True if they do. False if they do not, and also where the comparison was given up as too long.
    """
    names = names_of(formula)
    # A language cannot depend on a name that the formula does not hold.
    if not {propositions[bit] for bit in support(dfa)} <= set(names):
        return False
    try:
        late = _late_pairs(formula, names, dfa, propositions)
        # A cycle is an infinite word that the automaton accepts and that never satisfies the formula.
        TopologicalSorter(late).prepare()
    except (CycleError, _DifferentError, UnreadableError):
        return False
    return True


def support(dfa: Dfa) -> tuple[int, ...]:
    """The bits of a letter on which some transition depends."""
    letters = np.arange(dfa.transitions.shape[1])
    bits = range(letters.size.bit_length() - 1)
    return tuple(bit for bit in bits if (dfa.transitions != dfa.transitions[:, letters ^ 1 << bit]).any())


def names_of(formula: Formula) -> tuple[str, ...]:
    """The propositions of a formula, sorted."""
    if formula[0] == "name":
        return (formula[1],)
    return tuple(sorted({name for part in formula[1:] for name in names_of(part)}))


def read_formula(text: str) -> Formula:
    """A co-safe formula in the usual part of Spot's syntax, with negations in front of names alone.

    Raises:
        UnreadableError: the formula is too long, in other syntax, or not syntactically co-safe.
    """
    tokens = _tokens(text)
    formula = _binary(tokens, weakest=0)
    if tokens != [""]:
        raise UnreadableError(text)
    return _push_negation(formula, positive=True)


# Reading


def _tokens(text: str) -> list[str]:
    """The tokens in one spelling; names are marked by a leading quote, and "" ends them."""
    tokens, position, text = [], 0, text.rstrip()
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None or len(tokens) == MAX_TOKENS:
            raise UnreadableError(text)
        kind, token = str(match.lastgroup), match.group(str(match.lastgroup))
        if kind == "name" and token.lower() in ("true", "false"):
            token = token.lower()
        elif kind == "name" and token != "xor":
            token = f'"{token}'
        elif kind == "quoted":
            token = '"' + re.sub(r"\\(.)", r"\1", token[1:-1])
        tokens.append(_SPELLINGS.get(token, token))
        position = match.end()
    return [*tokens, ""]


def _not(f: Formula) -> Formula:
    return ("not", f)


def _iff(f: Formula, g: Formula) -> Formula:
    return ("or", ("and", f, g), ("and", _not(f), _not(g)))


def _release(f: Formula, g: Formula) -> Formula:
    return _not(("U", _not(f), _not(g)))


# How strongly each operator binds, whether it associates to the right, and what it means in terms of and, or, not, U.
_BINARY: dict[str, tuple[int, bool, Callable[[Formula, Formula], Formula]]] = {
    "->": (0, True, lambda f, g: ("or", _not(f), g)),
    "<->": (0, True, _iff),
    "|": (1, False, lambda f, g: ("or", f, g)),
    "xor": (2, False, lambda f, g: _not(_iff(f, g))),
    "&": (3, False, lambda f, g: ("and", f, g)),
    "U": (4, True, lambda f, g: ("U", f, g)),
    "M": (4, True, lambda f, g: ("U", g, ("and", f, g))),
    "R": (4, True, _release),
    "W": (4, True, lambda f, g: _release(g, ("or", f, g))),
}
_UNARY: dict[str, Callable[[Formula], Formula]] = {
    "!": _not,
    "X": lambda f: ("X", f),
    "F": lambda f: ("U", _TRUE, f),
    "G": lambda f: _not(("U", _TRUE, _not(f))),
}


def _binary(tokens: list[str], weakest: int) -> Formula:
    """A formula whose operators outside of parentheses bind at least as strongly as ``weakest``."""
    left = _unary(tokens)
    while tokens[0] in _BINARY and _BINARY[tokens[0]][0] >= weakest:
        strength, to_the_right, meaning = _BINARY[tokens.pop(0)]
        left = meaning(left, _binary(tokens, strength if to_the_right else strength + 1))
    return left


def _unary(tokens: list[str]) -> Formula:
    token = tokens.pop(0)
    if token in _UNARY:
        return _UNARY[token](_unary(tokens))
    if token in _CONSTANTS:
        return _CONSTANTS[token]
    if token.startswith('"') and len(token) > 1:
        return ("name", token[1:])
    if token == "(":
        inner = _binary(tokens, weakest=0)
        if tokens.pop(0) == ")":
            return inner
    raise UnreadableError(token)


def _push_negation(f: Formula, positive: bool) -> Formula:
    """``f``, or its negation where not ``positive``, in negation normal form."""
    match f:
        case ("true",) | ("false",):
            return _TRUE if (f == _TRUE) == positive else _FALSE
        case ("name", _):
            return f if positive else _not(f)
        case ("not", g):
            return _push_negation(g, not positive)
        case ("X", g):
            return ("X", _push_negation(g, positive))
        # The negation of U is what only an infinite word can satisfy.
        case ("U", _, _) if not positive:
            raise UnreadableError("not co-safe")
    dual = {"and": "or", "or": "and"}
    return (f[0] if positive else dual[f[0]], *(_push_negation(g, positive) for g in f[1:]))


# Progression


class _DifferentError(Exception):
    """The languages differ."""


def _late_pairs(
    formula: Formula, names: Sequence[str], dfa: Dfa, propositions: Sequence[str]
) -> dict[tuple[Rest, int], set[tuple[Rest, int]]]:
    """Pairs in which the automaton accepts although something remains, and those of them that can follow.

    Raises:
        _DifferentError: some word satisfies the formula and is not accepted.
        UnreadableError: there are too many pairs to go on.
    """
    # The formula's letters as sets of names, and as the numbers that the automaton knows them by.
    bits = {name: 1 << bit for bit, name in enumerate(propositions)}
    letters = [frozenset(n for n, held in zip(names, row, strict=True) if held) for row in _rows(len(names))]
    numbers = [sum(bits.get(name, 0) for name in letter) for letter in letters]
    start = (frozenset({frozenset({formula})}), dfa.initial)
    following: dict[tuple[Rest, int], set[tuple[Rest, int]]] = {}
    waiting = [start]
    while waiting:
        rest, state = pair = waiting.pop()
        if pair in following:
            continue
        if rest == _DONE and not dfa.accepting[state]:
            raise _DifferentError
        # Once nothing remains and the automaton accepts, both stay as they are.
        reads = [] if rest == _DONE else zip(letters, numbers, strict=True)
        following[pair] = {(_after(rest, letter), int(dfa.transitions[state, number])) for letter, number in reads}
        waiting += following[pair]
        if len(following) * len(letters) > MAX_STEPS:
            raise UnreadableError("too many steps")
    late = {pair for pair in following if dfa.accepting[pair[1]] and pair[0] != _DONE}
    return {pair: following[pair] & late for pair in late}


def _rows(count: int) -> list[tuple[bool, ...]]:
    """All combinations of truth values."""
    if 2**count > MAX_STEPS:
        raise UnreadableError("too many propositions")
    return list(product((False, True), repeat=count))


def _after(rest: Rest, letter: frozenset[str]) -> Rest:
    """What remains after one more letter."""
    result = _HOPELESS
    for obligations in rest:
        alternative = _DONE
        for obligation in obligations:
            alternative = _both(alternative, _progress(obligation, letter))
        result = _either(result, alternative)
    return result


@lru_cache(maxsize=MAX_STEPS)
def _progress(f: Formula, letter: frozenset[str]) -> Rest:
    """What remains of one formula after a letter, by its expansion law."""
    match f:
        case ("true",) | ("false",):
            return _DONE if f == _TRUE else _HOPELESS
        case ("name", name):
            return _DONE if name in letter else _HOPELESS
        case ("not", ("name", name)):
            return _HOPELESS if name in letter else _DONE
        case ("X", g):
            return frozenset({frozenset({g})})
        case ("and", g, h):
            return _both(_progress(g, letter), _progress(h, letter))
        case ("or", g, h):
            return _either(_progress(g, letter), _progress(h, letter))
        case ("U", g, h):
            return _either(_progress(h, letter), _both(_progress(g, letter), frozenset({frozenset({f})})))
    raise AssertionError(f)


def _either(a: Rest, b: Rest) -> Rest:
    return _least(a | b)


def _both(a: Rest, b: Rest) -> Rest:
    return _least(frozenset(s | t for s, t in product(a, b)))


def _least(sets: Rest) -> Rest:
    """Without sets that contain another one: so what remains has one form, and there are finitely many."""
    if len(sets) > MAX_SETS:
        raise UnreadableError("too many alternatives")
    return frozenset(s for s in sets if not any(other < s for other in sets))
