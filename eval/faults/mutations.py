"""Damage to inputs: flipped bits, parts cut, repeated or moved, numbers that no float holds, deep nesting."""

import re
from collections.abc import Callable, Sequence
from typing import Literal, TypeVar

import numpy as np

T = TypeVar("T")

EXTREMES: tuple[str, ...] = (
    "0",
    "-0",
    "-1",
    "1e308",
    "1e309",
    "-1e999",
    "1e-999",
    "9" * 400,
    "1" + "0" * 5000,
    "NaN",
    ".nan",
    "nan",
    "Infinity",
    ".inf",
    "-.inf",
    "2147483648",
    "9223372036854775808",
    "18446744073709551616",
    "0x7fffffff",
    "1_000_000",
    "1e5",
    "3.5",
    "true",
    "null",
    "~",
    "''",
    '"a"',
    "[]",
    "{}",
    "1:30:00",
    "2001-01-01",
)
"""What may stand where a number is expected: the ends of the types, and what YAML or Python read as something else."""

_BYTE_ORDERS: tuple[Literal["little"], Literal["big"]] = ("little", "big")
_NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(r"[A-Za-z_]\w*")
_BRACKETS = (("[", "]"), ("{", "}"), ("(", ")"), ("{a: ", "}"), ("<a>", "</a>"), ("- ", ""), ("!", ""), ("X ", ""))
_ODD = (
    "\x00",
    "\ufeff",
    "\u202e",
    "\t",
    "\r",
    "\n",
    "\\",
    '"',
    "'",
    "&a ",
    "*a",
    "%",
    "@",
    "`",
    "|",
    ">",
    "<",
    "é",
    "\U0001f600",
)


def pick(random: np.random.Generator, choices: Sequence[T]) -> T:
    """One of some values, as it is; ``Generator.choice`` would make numpy's types of them, and floats of 64 bits."""
    return choices[int(random.integers(len(choices)))]


def damaged(random: np.random.Generator, data: bytes, others: Sequence[bytes] = ()) -> bytes:
    """The bytes of a file with one to five kinds of damage, one after another.

    Args:
        random: chooses kinds and places.
        data: a file that is whole.
        others: further files of the kind, from which parts may come.

    Returns:
        Other bytes, at most a few times as many.
    """
    for _ in range(_few(random)):
        data = pick(random, _BYTES)(random, data, [*others, data])
    return data


def damaged_text(random: np.random.Generator, text: str, others: Sequence[str] = ()) -> str:
    """A text with one to five kinds of damage that keep it a text.

    Args:
        random: chooses kinds and places.
        text: one that can be read.
        others: further texts of the kind, from which parts may come.

    Returns:
        Another text.
    """
    for _ in range(_few(random)):
        text = pick(random, _TEXTS)(random, text, [*others, text])
    return text


def _few(random: np.random.Generator) -> int:
    # Mostly one: two faults at once hide each other.
    return int(min(random.geometric(0.6), 5))


def _span(random: np.random.Generator, length: int, longest: int | None = None) -> tuple[int, int]:
    """A part of something of this length, from and to; long parts are as frequent as short ones."""
    begin = int(random.integers(length + 1))
    size = int(2 ** random.uniform(0, np.log2(max(2, min(length, longest or length)))))
    return begin, min(length, begin + size)


def _flip_bits(random: np.random.Generator, data: bytes, others: Sequence[bytes]) -> bytes:
    changed = bytearray(data)
    for place in random.integers(len(data), size=int(2 ** random.uniform(0, 6))) if data else ():
        changed[int(place)] ^= 1 << int(random.integers(8))
    return bytes(changed)


def _cut_short(random: np.random.Generator, data: bytes, others: Sequence[bytes]) -> bytes:
    return data[: random.integers(len(data) + 1)]


def _cut_out(random: np.random.Generator, data: bytes, others: Sequence[bytes]) -> bytes:
    begin, end = _span(random, len(data))
    return data[:begin] + data[end:]


def _overwrite(random: np.random.Generator, data: bytes, others: Sequence[bytes]) -> bytes:
    # Lost blocks of a disk come back as zeros or as something else.
    begin, end = _span(random, len(data))
    size = end - begin
    return data[:begin] + (bytes(size) if random.random() < 0.5 else random.bytes(size)) + data[end:]


def _splice(random: np.random.Generator, data: bytes, others: Sequence[bytes]) -> bytes:
    other = pick(random, others)
    (begin, end), (first, last) = _span(random, len(data)), _span(random, len(other))
    return data[:begin] + other[first:last] + data[end:]


def _swap(random: np.random.Generator, data: bytes, others: Sequence[bytes]) -> bytes:
    a, b, c, d = sorted(int(place) for place in random.integers(len(data) + 1, size=4))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _repeat(random: np.random.Generator, data: bytes, others: Sequence[bytes]) -> bytes:
    begin, end = _span(random, len(data), 4096)
    return data[:end] + data[begin:end] * int(random.integers(1, 20)) + data[end:]


def _extreme_integer(random: np.random.Generator, data: bytes, others: Sequence[bytes]) -> bytes:
    """Sizes and counts in binary formats: the ends of their types, and values just beside."""
    size = int(random.choice([1, 2, 4, 8]))
    value = pick(random, (0, 1, (1 << (8 * size - 1)) - 1, 1 << (8 * size - 1), (1 << 8 * size) - 1))
    place = int(random.integers(max(1, len(data) - size)))
    return data[:place] + value.to_bytes(size, pick(random, _BYTE_ORDERS)) + data[place + size :]


def _as_text(random: np.random.Generator, data: bytes, others: Sequence[bytes]) -> bytes:
    return pick(random, _TEXTS)(random, data.decode("latin-1"), [""]).encode("latin-1", "replace")


def _replace_match(pattern: re.Pattern[str], random: np.random.Generator, text: str, new: str) -> str:
    matches = list(pattern.finditer(text))
    if not matches:
        return text
    match = pick(random, matches)
    return text[: match.start()] + new + text[match.end() :]


def _extreme_number(random: np.random.Generator, text: str, others: Sequence[str]) -> str:
    return _replace_match(_NUMBER, random, text, pick(random, EXTREMES))


def _other_word(random: np.random.Generator, text: str, others: Sequence[str]) -> str:
    words = _WORD.findall(pick(random, others)) or ["a"]
    return _replace_match(_WORD, random, text, pick(random, words))


def _nest(random: np.random.Generator, text: str, others: Sequence[str]) -> str:
    before, after = pick(random, _BRACKETS)
    # 400 levels go beyond the stack of many a parser, 20,000 beyond that of any that calls itself.
    depth = int(random.choice([3, 40, 400, 2_000, 20_000]))
    begin, end = _span(random, len(text), 40)
    return text[:begin] + before * depth + text[begin:end] + after * depth + text[end:]


def _repeat_line(random: np.random.Generator, text: str, others: Sequence[str]) -> str:
    lines = text.splitlines(keepends=True) or [""]
    chosen = pick(random, lines)
    lines.insert(int(random.integers(len(lines) + 1)), chosen * int(random.choice([1, 2, 100])))
    return "".join(lines)


def _drop_line(random: np.random.Generator, text: str, others: Sequence[str]) -> str:
    lines = text.splitlines(keepends=True) or [""]
    del lines[int(random.integers(len(lines)))]
    return "".join(lines)


def _swap_lines(random: np.random.Generator, text: str, others: Sequence[str]) -> str:
    lines = text.splitlines(keepends=True) or [""]
    a, b = random.integers(len(lines), size=2)
    lines[a], lines[b] = lines[b], lines[a]
    return "".join(lines)


def _indent_line(random: np.random.Generator, text: str, others: Sequence[str]) -> str:
    lines = text.splitlines(keepends=True) or [""]
    place = random.integers(len(lines))
    lines[place] = " " * int(random.integers(1, 5)) + lines[place]
    return "".join(lines)


def _odd_character(random: np.random.Generator, text: str, others: Sequence[str]) -> str:
    begin, end = _span(random, len(text), 4)
    return text[:begin] + pick(random, _ODD) * int(random.integers(1, 4)) + text[end:]


def _splice_text(random: np.random.Generator, text: str, others: Sequence[str]) -> str:
    other = pick(random, others)
    (begin, end), (first, last) = _span(random, len(text)), _span(random, len(other))
    return text[:begin] + other[first:last] + text[end:]


_Bytes = Callable[[np.random.Generator, bytes, Sequence[bytes]], bytes]
_Text = Callable[[np.random.Generator, str, Sequence[str]], str]

_BYTES: tuple[_Bytes, ...] = (
    _flip_bits,
    _cut_short,
    _cut_out,
    _overwrite,
    _splice,
    _swap,
    _repeat,
    _extreme_integer,
    _as_text,
)
_TEXTS: tuple[_Text, ...] = (
    _extreme_number,
    _extreme_number,
    _other_word,
    _nest,
    _repeat_line,
    _drop_line,
    _swap_lines,
    _indent_line,
    _odd_character,
    _splice_text,
)
