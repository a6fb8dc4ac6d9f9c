"""Text becomes a checked co-safe formula: propositions, syntax, co-safety, errors with a caret.

Formulas are in Spot's syntax. Spot is asked only when a formula is parsed (``task.spot_process``), so that everything
else in this package works without it.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from potlp_jax.errors import TaskError
from potlp_jax.files import one_line
from potlp_jax.task.pointing import (
    OPERATOR_PREFIX,
    WORD_OR_STRING,
    TakenApart,
    nearest_name,
    offending_column,
    words_taken_apart,
)
from potlp_jax.task.propositions import LONGEST_NAME, check_propositions
from potlp_jax.task.spot_process import ask_spot

MAX_LENGTH: int = 4000
"""Characters of a formula, at most; the longest task that ships has 55."""

LONGEST_EXCERPT: int = 160
"""Characters of a formula that a message shows, around what is wrong."""

Structure = tuple
"""Nested tuples, such as ``("U", ("true",), ("name", "a"))``: the form of ``task.language.Formula``."""

# Not a sign such as those that Spot reads for "and" and "not".
_WORD = re.compile(r"[^\W\d]")
_CARET_INDENT = 4
"""Columns that Spot's error report puts before the formula (``>>> ``)."""


def error_at(message: str, text: str, column: int) -> TaskError:
    """An error that points into a text.

    Args:
        message: what is wrong.
        text: one line.
        column: where, counted from 1; the caret stands under it. Of a long text only what is around it is shown.

    Returns:
        The error, to be raised.
    """
    # One sign for one, so that the caret stays below its place.
    shown = "".join(char if char.isprintable() else "\N{REPLACEMENT CHARACTER}" for char in text)
    start = max(0, min(column - LONGEST_EXCERPT // 2, len(shown) - LONGEST_EXCERPT))
    before, after = "..." if start else "", "..." if start + LONGEST_EXCERPT < len(shown) else ""
    excerpt = f"{before}{shown[start : start + LONGEST_EXCERPT]}{after}"
    caret = " " * (len(before) + column - 1 - start) + "^"
    return TaskError(f"{message} (column {column})\n  {excerpt}\n  {caret}")


@dataclass(frozen=True)
class Formula:
    """A formula that has passed all checks.

    Attributes:
        text: what the user wrote.
        propositions: Sigma; bit ``i`` of a letter is ``propositions[i]``.
        quoted: the text that Spot has read, with quotes around names that it would take apart.
        parsed: the formula as Spot writes it, for people: names such as ``xor`` have no quotes there.
        structure: its negation normal form, in the form of ``task.language``; None where it is large or has operators
            of PSL.
    """

    text: str
    propositions: tuple[str, ...]
    quoted: str
    parsed: str
    structure: Structure | None


def parse_formula(text: str, propositions: Sequence[str] | None = None) -> Formula:
    """Parses and checks a formula in Spot's syntax.

    Args:
        text: the formula. Names that begin with F, G or X, or hold spaces, stand in double quotes.
        propositions: Sigma, a superset of the formula's names; default: these names, sorted.

    Raises:
        TaskError: text that is empty or too long, syntax, unknown proposition, too many propositions (all with column
            and caret where they have one), a formula that is not syntactically co-safe, or Spot missing.
    """
    # One line, of unchanged length: columns of errors refer to the text as it was given, and the caret is printed
    # below.
    line = re.sub(r"\s", " ", text)
    if not line.strip():
        raise error_at("the formula is empty", line, 1)
    # A file of another encoding may hold halves of characters, which no other program reads.
    if any("\ud800" <= char <= "\udfff" for char in line):
        raise TaskError("the formula is no valid text: it holds surrogates, halves of characters")
    if len(line) > MAX_LENGTH:
        raise TaskError(f"the formula has {len(line):,} characters, more than {MAX_LENGTH:,}: use a shorter one")
    # Wrong propositions are reported before Spot is asked for.
    known = None if propositions is None else check_propositions(propositions)
    answer = _parse(line, known or ())
    sigma = check_propositions(answer["names"] if known is None else known)
    for name in answer["names"]:
        if name not in sigma:
            raise unknown_proposition(name, sigma, line)
    # The check is of syntax: a formula that is co-safe for subtler reasons is refused, which is why the message says
    # what may be used.
    if answer["offender"] is not None:
        raise _not_co_safe(answer["offender"], line, sigma if known is not None else ())
    structure = None if answer["structure"] is None else _frozen(answer["structure"])
    return Formula(text, sigma, answer["quoted"], answer["formula"], structure)


def _frozen(part: Any) -> Any:
    """Nested lists, as JSON has them, as nested tuples."""
    return tuple(map(_frozen, part)) if isinstance(part, list) else part


def _parse(line: str, known: tuple[str, ...]) -> dict[str, Any]:
    """What Spot has read, and of what text, or the first of its complaints."""
    quoted, added = _quote_known_names(line, known)
    answer = ask_spot("parse", quoted)
    if "errors" not in answer:
        return answer | {"quoted": quoted}
    # Spot reports an error in three lines: the formula, carets below it, the message.
    _, carets, message = answer["errors"].splitlines()[:3]
    column = carets.index("^") - _CARET_INDENT
    # Quotes that were added before the column have moved it to the right.
    column = min(column - sum(quote < column for quote in added), len(line)) + 1
    raise error_at(f"syntax error in the formula: {one_line(message.removeprefix('syntax error, '))}", line, column)


def _quote_known_names(line: str, known: tuple[str, ...]) -> tuple[str, list[int]]:
    """Quotes known names that Spot would take apart, such as FIRE into F and IRE, and words beyond ASCII.

    A word stays as it is where Spot's reading is possible too (IRE is known as well).

    Returns:
        The formula for Spot, and where in it quotes were added.
    """
    pieces: list[str] = []
    added: list[int] = []
    for piece in WORD_OR_STRING.findall(line):
        operand = OPERATOR_PREFIX.sub("", piece)
        # Only F, G and X are left of the word (``operand`` is empty): these are operators, whatever is known.
        if piece in known and operand not in ("", piece, *known):
            start = sum(map(len, pieces))
            added += [start, start + len(piece) + 1]
            piece = f'"{piece}"'
        elif not operand.isascii() and _WORD.match(operand):
            start = sum(map(len, pieces)) + len(piece) - len(operand)
            added += [start, start + len(operand) + 1]
            piece = f'{piece.removesuffix(operand)}"{operand}"'
        pieces.append(piece)
    return "".join(pieces), added


def unknown_proposition(name: str, known: tuple[str, ...], line: str) -> TaskError:
    """Points at what was written, and lists the known propositions, with the nearest one first."""
    # The name as a whole word, perhaps in quotes, perhaps with operators written in front of it.
    pattern = rf'(?<![\w.])[FGX]*("?)(?P<name>{re.escape(name)})\1(?![\w.])'
    match = re.search(pattern, line)
    column = 1 + (match.start("name") if match else 0)
    word = _word_around(column, line, known)
    near = nearest_name((name,) if word is None else (word.word, name), known)
    proposal = "" if near is None else f"; did you mean {near}?"
    shown = one_line(name, LONGEST_NAME)
    message = f"unknown proposition '{shown}'{_reading(word)}{proposal}; known: {', '.join(known) or 'none'}"
    return error_at(message + ("" if word is None else word.hint), line, column if word is None else word.column)


def _not_co_safe(offender: str, line: str, known: tuple[str, ...]) -> TaskError:
    """Points at the operator because of which the formula is refused, or at the name that was read as operators."""
    column = offending_column(line, known)
    words = words_taken_apart(line, known)
    # Where the operator cannot be told, a word that was taken apart is the likeliest to have brought it.
    word = next(iter(words), None) if column is None else _word_around(column, line, known)
    message = (
        f"the formula is not co-safe: its negation normal form holds '{one_line(offender)}', which no finite word can "
        f"make true{_reading(word)}; use X, F, U, M, &, | and negated propositions only"
    )
    if word is not None:
        return error_at(message + word.hint, line, word.column)
    return TaskError(f"{message}\n  {one_line(line)}") if column is None else error_at(message, line, column)


def _word_around(column: int, line: str, known: tuple[str, ...]) -> TakenApart | None:
    """The word that was taken apart and holds a column."""
    words = words_taken_apart(line, known)
    return next((word for word in words if word.column <= column < word.column + len(word.word)), None)


def _reading(word: TakenApart | None) -> str:
    return "" if word is None else f" ('{word.word}' is read as {word.read_as})"
