"""Semantics of linear temporal logic, written from its definition: no Spot, no automata, nothing of the planner.

* ``satisfies_lasso`` evaluates any LTL formula on an infinite word ``prefix . loop . loop . ...``, exactly.
* ``word_satisfies`` and ``word_violates`` tell whether a finite word decides a co-safe formula, whatever follows.
* ``has_language_of`` tells whether an automaton is one of a co-safe formula.

Syntax: ``! & | -> <-> xor X F G U R V W M true false 1 0``, with Spot's other spellings of them (``_SPELLINGS``),
names, "quoted names" and parentheses; ``X[n]``, ``F[n:m]``, ``G[n:m]`` and, without an end, ``F[n:]`` and ``G[n:]``
(also ``..`` or ``,`` for the colon, ``$`` for no end, and ``!``, which changes nothing on infinite words). A word that
begins with F, G or X is a name where it is a proposition, and what is left of it without these letters is none. ``U R V
W M`` and ``->`` associate to the right and bind as in Spot: from weak to strong ``-> <->``, ``|``, ``xor``, ``&``, ``U
R W M``, ``X F G !``.

A letter is an integer whose bit i is set where ``propositions[i]`` is true.

Written to be checked by eye, not to be fast: a formula is nested tuples, an infinite word is a finite graph, and what a
finite word leaves to do is a set of sets of formulas.

References:
  Baier and Katoen, Principles of Model Checking, 2008, section 5.1 (semantics, expansion laws, negation normal form).
"""

import re
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from jaxtyping import Bool, Int

from potlp_jax.errors import TaskError

Formula = tuple
"""Nested tuples: ("true",), ("false",), ("name", p), ("not", f), ("X", f), ("and", f, g), ("U", f, g), ..."""

# Spot reads all of these spellings, and tasks are written for Spot.
_SPELLINGS = {
    "!": "~ ¬",
    "&": "&& * /\\ ∧ ∩",
    "|": "|| + \\/ ∨ ∪",
    "xor": "^ ⊕",
    "->": "=> --> → ⟶ ⇒ ⟹",
    "<->": "<=> <--> ↔ ⇔",
    "F": "<> ◇ ⋄ ♢",
    "G": "[] □ ⬜ ◻",
    "X": "() ○ ◯",
    "R": "V",
}
_ALIASES = {alias: operator for operator, aliases in _SPELLINGS.items() for alias in aliases.split()}
# Longer operators stand before their own beginnings, such as "<->" before "<>"; words are names or operators.
_SIGNS = sorted((sign for sign in [*_ALIASES, "!", "&", "|", "->", "<->"] if not sign.isalpha()), key=len, reverse=True)
_TOKEN = re.compile(r'\s*("(?:[^"\\]|\\.)*"|\[[^][]+\]|' + "|".join(map(re.escape, _SIGNS)) + r"|[()01]|[^\W\d][\w.]*)")
# How often in "X[3]", from when to when in "F[2:5]"; "!" and "$" as in Spot.
_COUNT = re.compile(r"\[\s*(\d*)\s*!?\s*\]")
_BOUNDS = re.compile(r"\[\s*(\d*)\s*(?::|\.\.|,|to)\s*(\d*|\$)\s*!?\s*\]")
_CONSTANTS = {"1": ("true",), "true": ("true",), "0": ("false",), "false": ("false",)}


def satisfies_lasso(formula: str, propositions: Sequence[str], prefix: Sequence[int], loop: Sequence[int]) -> bool:
    """Whether the infinite word ``prefix . loop . loop . ...`` satisfies the formula (LTL with any operators).

    Args:
        formula: linear temporal logic.
        propositions: names of the bits of a letter; the formula's names are among them.
        prefix: letters that are read once; may be empty.
        loop: letters that are read for ever after; not empty.

    Returns:
        Whether the word satisfies the formula.

    Raises:
        TaskError: the formula cannot be read, names what is no proposition, or the loop is empty.
    """
    if not loop:
        raise TaskError("the loop of an infinite word is empty: give at least one letter that repeats")
    # The word as a finite graph: each position has one successor, the last one leads back to the start of the loop.
    letters = [*prefix, *loop]
    successor = [*range(1, len(letters)), len(prefix)]
    bit = {name: i for i, name in enumerate(propositions)}
    return _truth(_normal_form(formula, tuple(propositions)), bit, letters, successor)[0]


def word_satisfies(formula: str, propositions: Sequence[str], word: Sequence[int]) -> bool:
    """Whether every infinite continuation of the finite word satisfies the co-safe formula (a good prefix).

    Exact: what remains to be done after the word, as a positive combination of obligations, has finitely many
    successors; the word is good if no infinite sequence of them avoids "nothing remains".

    Args:
        formula: co-safe linear temporal logic.
        propositions: names of the bits of a letter; the formula's names are among them.
        word: letters read so far.

    Returns:
        Whether the task is accomplished.

    Raises:
        TaskError: the formula cannot be read, names what is no proposition, or is not co-safe.
    """
    return _always_reaches_done(_after(formula, tuple(propositions), word), _own_letters(formula, tuple(propositions)))


def word_violates(formula: str, propositions: Sequence[str], word: Sequence[int]) -> bool:
    """Whether no continuation of the finite word satisfies the co-safe formula (a bad prefix). Exact.

    Args:
        formula: co-safe linear temporal logic.
        propositions: names of the bits of a letter; the formula's names are among them.
        word: letters read so far.

    Returns:
        Whether the task can no longer be accomplished.

    Raises:
        TaskError: the formula cannot be read, names what is no proposition, or is not co-safe.
    """
    return not _can_reach_done(_after(formula, tuple(propositions), word), _own_letters(formula, tuple(propositions)))


def can_be_judged(formula: str, propositions: Sequence[str]) -> bool:
    """Whether the text is a co-safe formula over these propositions. The name of an automaton may be anything."""
    try:
        word_satisfies(formula, propositions, ())
    except TaskError:
        return False
    return True


def has_language_of(
    formula: str,
    propositions: Sequence[str],
    transitions: Int[np.ndarray, "Z L"],
    accepting: Bool[np.ndarray, " Z"],
    initial: int,
) -> bool:
    """Whether an automaton accepts exactly the words that satisfy the co-safe formula. Exact.

    Args:
        formula: the text, which may also be none.
        propositions: names of the bits of a letter.
        transitions: ``[z, letter]`` is the next state.
        accepting: states in which the word so far satisfies, whatever follows.
        initial: where words begin.

    Returns:
        Whether it does; False where the text is no co-safe formula over these propositions.
    """
    known = tuple(propositions)
    if not can_be_judged(formula, known):
        return False
    own = _own_letters(formula, known)
    # By each of the formula's own letters, the automaton's letters that are the same to the formula.
    # The last one holds all of the formula's names.
    bits = {name: known.index(name) for name in own[-1]}
    letters = np.arange(2 ** len(known))
    alike = {letter: np.flatnonzero(_shows(letters, letter, bits)) for letter in own}
    start = (initial, _after(formula, known, ()))
    reached, waiting = {start}, [start]
    while waiting:
        state, rest = waiting.pop()
        # A co-safe language is what its good prefixes say.
        if bool(accepting[state]) != _always_reaches_done(rest, own):
            return False
        following = {
            (int(target), _step(rest, letter))
            for letter in own
            for target in np.unique(transitions[state, alike[letter]])
        }
        waiting += following - reached
        reached |= following
    return True


def _shows(letters: Int[np.ndarray, " L"], names: frozenset[str], bits: Mapping[str, int]) -> Bool[np.ndarray, " L"]:
    """Which letters hold these names and no others of those that have bits."""
    held = sum(1 << bit for name, bit in bits.items() if name in names)
    return (letters & sum(1 << bit for bit in bits.values())) == held


# Parser


class _Parser:
    """Recursive descent: one method per level of precedence, weakest first; ``""`` ends the tokens."""

    def __init__(self, text: str, known: Sequence[str]) -> None:
        self.text = text
        tokens: list[str] = []
        position = 0
        while text[position:].strip():
            match = _TOKEN.match(text, position)
            if match is None:
                raise TaskError(f"formula {text!r}: cannot read {text[position:]!r}")
            token = match.group(1)
            tokens += [token] if _is_whole_name(token, known) else _parts_of(token)
            position = match.end()
        self.tokens = [_ALIASES.get(token, token) for token in tokens] + [""]

    def whole(self) -> Formula:
        parsed = self.formula()
        if self.tokens != [""]:
            raise TaskError(f"formula {self.text!r}: cannot read {' '.join(self.tokens)!r} after its end")
        return parsed

    def take(self, *texts: str) -> str | None:
        return self.tokens.pop(0) if self.tokens[0] in texts else None

    def formula(self) -> Formula:
        left = self.disjunction()
        # Recursion on the right-hand side alone makes an operator associate to the right.
        if operator := self.take("->", "<->"):
            return (operator, left, self.formula())
        return left

    # Operators of equal strength that associate to the left are a loop, not a recursion.
    def disjunction(self) -> Formula:
        left = self.exclusive()
        while self.take("|"):
            left = ("or", left, self.exclusive())
        return left

    def exclusive(self) -> Formula:
        left = self.conjunction()
        while self.take("xor"):
            left = ("xor", left, self.conjunction())
        return left

    def conjunction(self) -> Formula:
        left = self.until()
        while self.take("&"):
            left = ("and", left, self.until())
        return left

    def until(self) -> Formula:
        left = self.unary()
        if operator := self.take("U", "R", "W", "M"):
            return (operator, left, self.until())
        return left

    def unary(self) -> Formula:
        if self.take("!"):
            return ("not", self.unary())
        if operator := self.take("X", "F", "G"):
            return self.bounded(operator) if self.tokens[0].startswith("[") else (operator, self.unary())
        if self.take("("):
            inner = self.formula()
            if not self.take(")"):
                raise TaskError(f"formula {self.text!r}: ')' is missing before {self.tokens[0]!r}")
            return inner
        token = self.tokens.pop(0)
        if not re.match(r'["01]|[^\W\d]', token):
            raise TaskError(f"formula {self.text!r}: expected a formula, found {token or 'its end'!r}")
        if token in _CONSTANTS:
            return _CONSTANTS[token]
        return ("name", re.sub(r"\\(.)", r"\1", token[1:-1]) if token.startswith('"') else token)

    def bounded(self, operator: str) -> Formula:
        """``X[n] f``: n letters later; ``F[n:m] f`` and ``G[n:m] f``: at one, or at all, of n to m letters later."""
        text = self.tokens.pop(0)
        match = (_COUNT if operator == "X" else _BOUNDS).fullmatch(text)
        if match is None:
            raise TaskError(f"formula {self.text!r}: cannot read {text!r} after {operator}")
        inner = self.unary()
        if operator == "X":
            # X[!] alone is X.
            return _later(inner, int(match[1] or 1))
        first, last = int(match[1] or 0), match[2]
        if last in ("", "$"):
            return _later((operator, inner), first)
        # In either order, as in Spot.
        first, end = sorted((first, int(last)))
        joined = inner
        for _ in range(end - first):
            joined = ("or" if operator == "F" else "and", inner, ("X", joined))
        return _later(joined, first)


def _later(f: Formula, count: int) -> Formula:
    for _ in range(count):
        f = ("X", f)
    return f


def _is_whole_name(token: str, known: Sequence[str]) -> bool:
    """Whether a known name such as FIRE is meant as it stands, and not as F and IRE."""
    operand = token.lstrip("FGX")
    # F, G and X alone are operators, whatever is known; and where both readings are possible, Spot's counts.
    return token in known and operand not in ("", token, *known)


def _parts_of(token: str) -> list[str]:
    """``XFa`` is X F a, as in Spot; names such as F1 or X2 are names, and FALSE is a constant."""
    if token.lower() in _CONSTANTS:
        return [token.lower()]
    # A digit after the letter makes it a name, any other letter an operator in front of one.
    if re.fullmatch(r"[FGX][^\W\d].*|[FGX]", token):
        return [token[0], *(_parts_of(token[1:]) if len(token) > 1 else [])]
    return [token]


def _normal_form(text: str, propositions: Sequence[str]) -> Formula:
    """Parsed, and rewritten to true, false, literals, and, or, X, U, R. Raises TaskError for other names than these."""
    try:
        formula = _push_negation(_Parser(text, propositions).whole(), True)
    except RecursionError:
        raise TaskError(f"formula {text[:80]!r} is nested too deeply to be judged") from None
    unknown = sorted(set(_names(formula)) - set(propositions))
    if unknown:
        raise TaskError(f"formula {text!r}: {', '.join(unknown)} is not among the propositions {tuple(propositions)}")
    return formula


def _names(f: Formula) -> list[str]:
    """The propositions of a formula, each as often as it is there."""
    return [f[1]] if f[0] == "name" else [name for g in f[1:] for name in _names(g)]


def _push_negation(f: Formula, positive: bool) -> Formula:
    """``f``, or its negation where not ``positive``, with negations in front of names alone."""

    def same(g: Formula) -> Formula:
        return _push_negation(g, positive)

    # De Morgan and the dualities of U and R: below a negation each operator becomes its dual.
    true, false = (("true",), ("false",)) if positive else (("false",), ("true",))
    conjunction, disjunction = ("and", "or") if positive else ("or", "and")
    until, release = ("U", "R") if positive else ("R", "U")
    match f:
        case ("true",):
            return true
        case ("false",):
            return false
        case ("name", _):
            return f if positive else ("not", f)
        case ("not", g):
            return _push_negation(g, not positive)
        case ("and", g, h):
            return (conjunction, same(g), same(h))
        case ("or", g, h):
            return (disjunction, same(g), same(h))
        case ("->", g, h):
            return (disjunction, _push_negation(g, not positive), same(h))
        case ("xor", g, h):
            return _push_negation(("<->", g, h), not positive)
        case ("<->", g, h):
            both = ("and", ("->", g, h), ("->", h, g))
            return same(both)
        case ("X", g):
            return ("X", same(g))
        case ("F", g):
            return (until, true, same(g))
        case ("G", g):
            return (release, false, same(g))
        case ("U", g, h):
            return (until, same(g), same(h))
        case ("R", g, h):
            return (release, same(g), same(h))
        case ("W", g, h):  # g W h = h R (g | h)
            return (release, same(h), (disjunction, same(g), same(h)))
        case ("M", g, h):  # g M h = h U (g & h)
            return (until, same(h), (conjunction, same(g), same(h)))
    raise AssertionError(f)


# Infinite words


def _truth(f: Formula, bit: dict[str, int], letters: list[int], successor: list[int]) -> list[bool]:
    """Truth at each position of a lasso: ``successor`` leads from the last position back into the loop."""
    positions = range(len(letters))
    match f:
        case ("true",) | ("false",):
            return [f[0] == "true"] * len(letters)
        case ("name", name):
            return [bool(letter >> bit[name] & 1) for letter in letters]
        case ("not", g):
            return [not value for value in _truth(g, bit, letters, successor)]
        case ("X", g):
            inner = _truth(g, bit, letters, successor)
            return [inner[successor[i]] for i in positions]
    left, right = (_truth(g, bit, letters, successor) for g in f[1:])
    match f[0]:
        case "and":
            return [a and b for a, b in zip(left, right, strict=True)]
        case "or":
            return [a or b for a, b in zip(left, right, strict=True)]
        # Until and release are the least and the greatest solution of their expansion laws. Each round settles at
        # least one more position, so that as many rounds as there are positions suffice.
        case "U":  # u = right | (left & next u)
            truth = [False] * len(letters)
            for _ in positions:
                truth = [right[i] or (left[i] and truth[successor[i]]) for i in positions]
            return truth
        case "R":  # r = right & (left | next r)
            truth = [True] * len(letters)
            for _ in positions:
                truth = [right[i] and (left[i] or truth[successor[i]]) for i in positions]
            return truth
    raise AssertionError(f)


# Finite words. What remains to be done is a disjunction of sets of obligations (formulas that the rest of the word must
# satisfy), kept free of sets that contain another one: {} is false, {{}} is "nothing remains".

Rest = frozenset
_DONE: Rest = frozenset({frozenset()})
_HOPELESS: Rest = frozenset()


# Keeping the least sets alone makes equal obligations equal sets, so that searches over them are finite.
def _minimal(sets: set[frozenset]) -> Rest:
    return frozenset(s for s in sets if not any(other < s for other in sets))


def _any_of(a: Rest, b: Rest) -> Rest:
    return _minimal(set(a | b))


def _both(a: Rest, b: Rest) -> Rest:
    return _minimal({s | t for s in a for t in b})


@cache
def _read(f: Formula, letter: frozenset[str]) -> Rest:
    """What remains of a formula after a letter (the set of propositions that hold): its expansion law, one step."""
    match f:
        case ("true",):
            return _DONE
        case ("false",):
            return _HOPELESS
        case ("name", name):
            return _DONE if name in letter else _HOPELESS
        case ("not", ("name", name)):
            return _HOPELESS if name in letter else _DONE
        case ("X", g):
            return frozenset({frozenset({g})})
        case ("and", g, h):
            return _both(_read(g, letter), _read(h, letter))
        case ("or", g, h):
            return _any_of(_read(g, letter), _read(h, letter))
        case ("U", g, h):
            return _any_of(_read(h, letter), _both(_read(g, letter), frozenset({frozenset({f})})))
    # Release is what only an infinite word can satisfy.
    raise TaskError(f"{f} is not co-safe: no finite word decides it")


@cache
def _step(rest: Rest, letter: frozenset[str]) -> Rest:
    """What remains after one more letter."""
    result = _HOPELESS
    for obligations in rest:
        alternative = _DONE
        for obligation in obligations:
            alternative = _both(alternative, _read(obligation, letter))
        result = _any_of(result, alternative)
    return result


@cache
def _parsed(formula: str, propositions: tuple[str, ...]) -> Formula:
    return _normal_form(formula, propositions)


def _after(formula: str, propositions: tuple[str, ...], word: Sequence[int]) -> Rest:
    """What remains to be done after a word."""
    rest: Rest = frozenset({frozenset({_parsed(formula, propositions)})})
    for letter in word:
        rest = _step(rest, frozenset(name for i, name in enumerate(propositions) if letter >> i & 1))
    return rest


@cache
def _own_letters(formula: str, propositions: tuple[str, ...]) -> tuple[frozenset[str], ...]:
    """All letters over the formula's own propositions: the others change nothing."""
    # One letter for each combination of the names that the formula mentions: 2 to the power of few.
    own = sorted(set(_names(_parsed(formula, propositions))))
    return tuple(frozenset(name for i, name in enumerate(own) if letter >> i & 1) for letter in range(2 ** len(own)))


@cache
def _successors(rest: Rest, letters: tuple[frozenset[str], ...]) -> frozenset[Rest]:
    return frozenset(_step(rest, letter) for letter in letters)


@cache
def _can_reach_done(rest: Rest, letters: tuple[frozenset[str], ...]) -> bool:
    """Some sequence of letters leads to ``_DONE``."""
    # There are finitely many sets of sub-formulas, so this ends.
    reached, waiting = {rest}, [rest]
    while waiting:
        current = waiting.pop()
        if current == _DONE:
            return True
        new = _successors(current, letters) - reached
        reached |= new
        waiting += new
    return False


@cache
def _always_reaches_done(rest: Rest, letters: tuple[frozenset[str], ...]) -> bool:
    """No infinite path avoids ``_DONE``: peel off, from ``_DONE`` backwards, what has only peeled successors."""
    reached, waiting = {rest}, [rest]
    while waiting:
        new = _successors(waiting.pop(), letters) - reached
        reached |= new
        waiting += new
    inevitable = {_DONE}
    while True:
        more = {r for r in reached if r in inevitable or _successors(r, letters) <= inevitable}
        if more <= inevitable:
            return rest in inevitable
        inevitable |= more
