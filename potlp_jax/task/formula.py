"""Text becomes a checked co-safe formula: propositions, syntax, co-safety, errors with a caret.

Formulas are in Spot's syntax. Spot is imported only when a formula is parsed, so that everything else in this package
works without it.
"""

import importlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from potlp_jax.errors import SpotMissingError, TaskError
from potlp_jax.task.propositions import check_propositions

_INSTALL_SPOT = (
    "install it with 'pip install spottl' (Linux x86_64; the PyPI package called 'spot' is something else) or, on "
    "other platforms, 'conda install -c conda-forge spot'; formulas of shipped tasks, however they are written, and "
    "HOA files need no Spot"
)
_WORD_OR_STRING = re.compile(r'"(?:[^"\\]|\\.)*"|[A-Za-z_][A-Za-z0-9_.]*|.')
_OPERATOR_PREFIX = re.compile(r"^[FGX]+")
_CARET_INDENT = 4
"""Columns that Spot's error report puts before the formula (``>>> ``)."""


def error_at(message: str, text: str, column: int) -> TaskError:
    """An error that points into a text.

    Args:
        message: what is wrong.
        text: one line.
        column: where, counted from 1; the caret stands under it.

    Returns:
        The error, to be raised.
    """
    return TaskError(f"{message} (column {column})\n  {text}\n  {' ' * (column - 1)}^")


@dataclass(frozen=True)
class Formula:
    """A formula that has passed all checks.

    Attributes:
        text: what the user wrote.
        propositions: Sigma; bit ``i`` of a letter is ``propositions[i]``.
        parsed: Spot's formula.
    """

    text: str
    propositions: tuple[str, ...]
    parsed: Any


def load_spot() -> Any:
    """The module ``spot``.

    Raises:
        SpotMissingError: Spot is missing, or another package of that name is installed.
    """
    # Imported by name: neither the type checker nor the tests of layers need Spot to be there.
    try:
        spot = importlib.import_module("spot")
    except ImportError as error:
        raise SpotMissingError(f"this formula needs Spot, which is not installed: {_INSTALL_SPOT}") from error
    except Exception as error:  # the namesake on PyPI is Python 2 code and fails in its own ways
        raise SpotMissingError(f"the installed module 'spot' is not the Spot library: {_INSTALL_SPOT}") from error
    if not (hasattr(spot, "translate") and hasattr(spot, "formula")):
        raise SpotMissingError(f"the installed module 'spot' is not the Spot library: {_INSTALL_SPOT}")
    return spot


def parse_formula(text: str, propositions: Sequence[str] | None = None) -> Formula:
    """Parses and checks a formula in Spot's syntax.

    Args:
        text: the formula. Names that begin with F, G or X, or hold spaces, stand in double quotes.
        propositions: Sigma, a superset of the formula's names; default: these names, sorted.

    Raises:
        TaskError: empty text, syntax, unknown proposition, too many propositions (all with column and caret where
            they have one), a formula that is not syntactically co-safe, or Spot missing.
    """
    # One line, of unchanged length: columns of errors refer to the text as it was given, and the caret is printed
    # below.
    line = re.sub(r"\s", " ", text)
    if not line.strip():
        raise error_at("the formula is empty", line, 1)
    # Wrong propositions are reported before Spot is asked for.
    known = None if propositions is None else check_propositions(propositions)
    spot = load_spot()
    parsed = _parse(spot, line, known or ())
    names = sorted(proposition.ap_name() for proposition in spot.atomic_prop_collect(parsed) or ())
    sigma = check_propositions(names if known is None else known)
    for name in names:
        if name not in sigma:
            raise unknown_proposition(name, sigma, line)
    _check_co_safe(spot, parsed, line)
    return Formula(text=text, propositions=sigma, parsed=parsed)


def _parse(spot: Any, line: str, known: tuple[str, ...]) -> Any:
    """Spot's formula, or the first of Spot's complaints."""
    quoted, added = _quote_known_names(line, known)
    result = spot.parse_infix_psl(quoted)
    if not result.errors:
        return result.f
    # Spot reports an error in three lines: the formula, carets below it, the message.
    stream = spot.ostringstream()
    result.format_errors(stream)
    _, carets, message = stream.str().splitlines()[:3]
    column = carets.index("^") - _CARET_INDENT
    # Quotes that were added before the column have moved it to the right.
    column = min(column - sum(quote < column for quote in added), len(line)) + 1
    raise error_at(f"syntax error in the formula: {message.removeprefix('syntax error, ')}", line, column)


def _quote_known_names(line: str, known: tuple[str, ...]) -> tuple[str, list[int]]:
    """Quotes known names that Spot would take apart, such as FIRE into F and IRE.

    A word stays as it is where Spot's reading is possible too (IRE is known as well).

    Returns:
        The formula for Spot, and where in it quotes were added.
    """
    pieces: list[str] = []
    added: list[int] = []
    for piece in _WORD_OR_STRING.findall(line):
        operand = _OPERATOR_PREFIX.sub("", piece)
        # Only F, G and X are left of the word (``operand`` is empty): these are operators, whatever is known.
        if piece in known and operand not in ("", piece, *known):
            start = sum(map(len, pieces))
            added += [start, start + len(piece) + 1]
            piece = f'"{piece}"'
        pieces.append(piece)
    return "".join(pieces), added


def unknown_proposition(name: str, known: tuple[str, ...], line: str) -> TaskError:
    """Points at the name and lists the known propositions."""
    message = f"unknown proposition '{name}'; known: {', '.join(known) or 'none'}{_operator_hint(line)}"
    # The name as a whole word, perhaps in quotes, perhaps with operators written in front of it.
    pattern = rf'(?<![A-Za-z0-9_.])[FGX]*("?)(?P<name>{re.escape(name)})\1(?![A-Za-z0-9_.])'
    match = re.search(pattern, line)
    return error_at(message, line, 1 + (match.start("name") if match else 0))


def _operator_hint(line: str) -> str:
    """What may have gone wrong if a name in capitals was taken apart."""
    # A word in capitals that begins with F, G or X and has a letter that is none of them, such as FIRE.
    match = re.search(r'(?<![\w".])[FGX][A-Z_]*[A-EH-WY-Z][A-Z0-9_]+(?![\w"])', line)
    return "" if match is None else f'; F, G and X at the start of a name are operators: quote it, "{match.group()}"'


def _check_co_safe(spot: Any, parsed: Any, line: str) -> None:
    """Raises unless the negation normal form is syntactically co-safe (a 'guarantee', in Spot's words)."""
    # "Guarantee" is Manna and Pnueli's class that the field calls co-safe. The check is of syntax: a formula that is
    # co-safe for subtler reasons is refused, which is why the message says what may be used.
    normal_form = spot.negative_normal_form(parsed)
    if normal_form.is_syntactic_guarantee():
        return
    offender = _offending_part(normal_form)
    raise TaskError(
        f"the formula is not co-safe: its negation normal form holds '{offender}', which no finite word can "
        f"make true; use X, F, U, M, &, | and negated propositions only"
        f"{_operator_hint(line)}\n  {line}"
    )


def _offending_part(formula: Any) -> Any:
    """The innermost sub-formula that breaks co-safety while its own parts do not."""
    for part in formula:
        if part.is_psl_formula() and not part.is_syntactic_guarantee():
            return _offending_part(part)
    return formula
