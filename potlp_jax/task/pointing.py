"""Where in the text of a formula something is that was probably not meant: for errors and warnings with a caret.

Spot says what is wrong with what it has read, not where that stands in what was written. Two things are found here: a
name that Spot takes apart into operators and another name (``Fire`` into F and ``ire``), and the operator because of
which a formula is not co-safe, by its polarity: an F, U or M under an odd number of negations, a G, R or W under an
even one.
"""

import difflib
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass

WORD_OR_STRING = re.compile(r'"(?:[^"\\]|\\.)*"|[^\W\d][\w.]*|.')
"""Splits a formula into names, quoted names and single characters."""

OPERATOR_PREFIX = re.compile(r"^[FGX]+")
"""What Spot reads as operators at the start of a name that is not known."""

# Names rather than operators written without a space: FIRE, in which another letter than F, G and X stands, and Fire,
# but not Fa and XFa.
_LIKE_A_NAME = re.compile(r"[FGX][A-Z_]*[A-EH-WY-Z][A-Z0-9_]+|[FGX][a-z][A-Za-z0-9_.]+")

_TOKEN = re.compile(r'\s*("(?:[^"\\]|\\.)*"|<->|<=>|->|=>|\[\]|<>|&&|\|\||[!&|^()]|[^\W\d][\w.]*|[01])')
# How strongly operators bind; those of the strengths 0 and 4 associate to the right.
_STRENGTH = {"->": 0, "=>": 0, "<->": 0, "<=>": 0, "|": 1, "||": 1, "xor": 2, "^": 2, "&": 3, "&&": 3}
_STRENGTH |= dict.fromkeys("URWM", 4)
_SPELLINGS = {"<>": "F", "[]": "G"}
_TO_THE_RIGHT = (0, 4)
_MOST_TOKENS = 200
"""Longer formulas are not looked at: the reader is recursive."""


@dataclass(frozen=True)
class TakenApart:
    """A word that is read as operators and a name.

    Attributes:
        word: as it was written.
        column: where it begins, from 1.
        read_as: operators and name, such as ``F ire``.
    """

    word: str
    column: int
    read_as: str

    @property
    def hint(self) -> str:
        """What to do, as the end of a message."""
        return f'; F, G and X at the start of a name are operators: quote it, "{self.word}"'


def words_taken_apart(line: str, known: Collection[str] = ()) -> list[TakenApart]:
    """The words of a formula that look like names and are read as operators and another name.

    Args:
        line: the formula, on one line.
        known: propositions; a word that is one of them is a name, and one whose rest is one of them was meant so.
    """
    found = []
    for match in WORD_OR_STRING.finditer(line):
        rest = OPERATOR_PREFIX.sub("", match[0])
        if _LIKE_A_NAME.fullmatch(match[0]) and not {match[0], rest} & set(known):
            operators = match[0][: len(match[0]) - len(rest)]
            found.append(TakenApart(match[0], match.start() + 1, " ".join((*operators, rest))))
    return found


def nearest_name(written: Iterable[str], known: Collection[str]) -> str | None:
    """The known name that is most like one of those written, in capitals or not; None if none is like them."""
    # Of two names that differ in capitals alone either will do as a proposal.
    by_lower = {name.lower(): name for name in reversed(list(known))}
    for name in written:
        close = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.7)
        if close:
            return by_lower[close[0]]
    return None


def offending_column(line: str, known: Collection[str]) -> int | None:
    """The column, from 1, of the first operator that makes a formula not co-safe; None where it cannot be told.

    Args:
        line: a formula that Spot has refused.
        known: propositions, which are names whatever letter they begin with.
    """
    try:
        tokens = _tokens(line, known)
        found = _binary(tokens, 0)
    except (_UnreadableError, IndexError):
        return None
    wrong = [at for at, operator, signs in found if (-1 if operator in "FUM" else 1) in signs]
    return min(wrong) + 1 if wrong and not tokens else None


class _UnreadableError(Exception):
    """The formula holds something else than the usual operators."""


_Token = tuple[int, str]
_Operators = list[tuple[int, str, frozenset[int]]]
"""Of each temporal operator: where it stands, which it is, and the signs under which it is read."""


def _tokens(line: str, known: Collection[str]) -> list[_Token]:
    """Where each token stands, and what it is; names and constants are empty."""
    tokens: list[_Token] = []
    position, line = 0, line.rstrip()
    while position < len(line):
        match = _TOKEN.match(line, position)
        if match is None or len(tokens) > _MOST_TOKENS:
            raise _UnreadableError
        start, word, position = match.start(1), match[1], match.end()
        if word in _STRENGTH or word in ("!", "(", ")") or word in _SPELLINGS:
            tokens.append((start, _SPELLINGS.get(word, word)))
            continue
        prefix = "" if word in known else word[: len(word) - len(OPERATOR_PREFIX.sub("", word))]
        tokens += [(start + i, operator) for i, operator in enumerate(prefix)]
        if prefix != word:
            tokens.append((start + len(prefix), ""))
    return tokens


def _binary(tokens: list[_Token], weakest: int) -> _Operators:
    left = _unary(tokens)
    while tokens and _STRENGTH.get(tokens[0][1], -1) >= weakest:
        at, operator = tokens.pop(0)
        strength = _STRENGTH[operator]
        right = _binary(tokens, strength if strength in _TO_THE_RIGHT else strength + 1)
        if operator in ("->", "=>"):
            left = _signed(left, -1)
        elif operator in ("<->", "<=>", "xor", "^"):
            left, right = (_signed(side, 1) + _signed(side, -1) for side in (left, right))
        left = left + right + ([(at, operator, frozenset({1}))] if strength == _STRENGTH["U"] else [])
    return left


def _unary(tokens: list[_Token]) -> _Operators:
    at, token = tokens.pop(0)
    if token == "":
        return []
    if token == "!":
        return _signed(_unary(tokens), -1)
    if token in ("F", "G", "X"):
        own = [] if token == "X" else [(at, token, frozenset({1}))]
        return own + _unary(tokens)
    if token == "(":
        inner = _binary(tokens, 0)
        if tokens.pop(0)[1] == ")":
            return inner
    raise _UnreadableError


def _signed(operators: _Operators, sign: int) -> _Operators:
    return [(at, operator, frozenset(sign * old for old in signs)) for at, operator, signs in operators]
