"""Automata as text: the part of the Hanoi Omega-Automata format (HOA v1) that a DFA needs.

Read: one deterministic complete automaton with state-based Büchi acceptance (or ``t`` / ``f``), explicit labels on
edges or states, implicit labels, aliases. Everything else is refused, with the line.

References:
    Babiak et al. 2015, "The Hanoi Omega-Automata Format"; http://adl.github.io/hoaf/
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from potlp_jax.errors import TaskError
from potlp_jax.files import one_line, short
from potlp_jax.task.automaton import MOST_ENTRIES, Dfa
from potlp_jax.task.guards import Phi, minimal_cover
from potlp_jax.task.propositions import check_propositions

_TOKEN = re.compile(
    r"""(?P<skip>\s+|/\*.*?\*/)
      | (?P<string>"(?:[^"\\]|\\.)*")
      | (?P<section>--(?:BODY|END|ABORT)--)
      | (?P<header>[A-Za-z_][A-Za-z0-9_-]*:)
      | (?P<alias>@[A-Za-z0-9_-]+)
      | (?P<name>[A-Za-z_][A-Za-z0-9_-]*)
      | (?P<number>\d+)
      | (?P<symbol>[\[\](){}!&|])""",
    re.VERBOSE | re.DOTALL,
)
_OF_SEVERAL_LINES = ("skip", "string")
"""Kinds of what may hold the end of a line."""

_ONCE = ("AP:", "Acceptance:", "States:", "name:")
"""Headers of which the format allows one: a second one would silently take the place of the first."""

DEEPEST: int = 30
"""Parentheses within each other in a label; Spot writes none. More would exhaust the stack of a recursive descent."""

_MOST_DIGITS = 9
"""Digits of a number: what has more is beyond 32 bits, and no automaton has so many states."""

_UNKNOWN = -1
"""A number that has not been read yet: successor of a letter, initial state."""


@dataclass(frozen=True, eq=False)
class HoaAutomaton:
    """What a HOA file says, over its own propositions and with its own state numbers.

    Attributes:
        name: the ``name:`` header, empty where there is none.
        propositions: the ``AP:`` header; bit ``i`` of a letter is ``propositions[i]``.
        transitions: ``[z, letter]`` is the next state.
        accepting: states of the Büchi acceptance set.
        initial: where runs begin.
    """

    name: str
    propositions: tuple[str, ...]
    transitions: Int[np.ndarray, "Z L"]
    accepting: Bool[np.ndarray, " Z"]
    initial: int


class _Token(NamedTuple):
    kind: str
    text: str
    line: int

    def __str__(self) -> str:
        # As messages quote it: the text may be a name of a million characters.
        return one_line(self.text, 40)


@dataclass
class _State:
    """One state of the body; ``table`` holds the successor of each letter."""

    line: int
    accepting: bool
    label: np.ndarray | None
    table: np.ndarray
    explicit_labels: bool = False
    implicit_edges: int = 0


@dataclass
class _Header:
    """The headers that matter."""

    name: str = ""
    num_states: int | None = None
    initial: int = _UNKNOWN
    propositions: tuple[str, ...] | None = None
    acceptance: str | None = None
    aliases: dict[str, np.ndarray] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set)


def read_hoa(text: str) -> HoaAutomaton:
    """Parses the text of one automaton.

    Raises:
        TaskError: syntax, or anything that is not a complete deterministic automaton with state-based Büchi
            acceptance; names the line.
    """
    # Some editors begin a file with a byte-order mark.
    return _Reader(_tokens(text.removeprefix("\ufeff"))).read()


def write_hoa(dfa: Dfa, propositions: Sequence[str], name: str) -> str:
    """The DFA as a deterministic complete Büchi automaton; edge labels are canonical covers.

    Args:
        dfa: the automaton.
        propositions: names of the bits of a letter, in order.
        name: text of the ``name:`` header; by it a formula is found again.

    Returns:
        HOA text that ``read_hoa`` reads back. Equal automata give equal texts.
    """
    quoted = "".join(f" {_quote(proposition)}" for proposition in propositions)
    lines = [
        "HOA: v1",
        f"name: {_quote(name)}",
        f"States: {dfa.num_states}",
        f"Start: {dfa.initial}",
        f"AP: {len(propositions)}{quoted}",
        # The accepting state is absorbing, so visiting it once or infinitely often is the same ("terminal").
        "acc-name: Buchi",
        "Acceptance: 1 Inf(0)",
        "properties: trans-labels explicit-labels state-acc deterministic complete terminal",
        "--BODY--",
    ]
    for state, row in enumerate(dfa.transitions):
        lines.append(f"State: {state}" + (" {0}" if dfa.accepting[state] else ""))
        lines += [f"[{_label(minimal_cover(row == target))}] {target}" for target in np.unique(row)]
    return "\n".join([*lines, "--END--", ""])


def _quote(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _unquote(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", text[1:-1], flags=re.DOTALL)


def _label(cubes: Sequence[Phi]) -> str:
    """Cubes as a HOA label over proposition numbers, such as ``!0&1 | 2``."""
    terms = ["&".join(f"{'' if sign > 0 else '!'}{i}" for i, sign in enumerate(phi) if sign) or "t" for phi in cubes]
    return " | ".join(terms)


def _tokens(text: str) -> Iterator[_Token]:
    """Splits the text; the last token marks the end."""
    position, line = 0, 1
    # Found one after the other, as a text of megabytes may be wrong in its first line.
    match = _TOKEN.match(text)
    while match is not None:
        kind, found = str(match.lastgroup), match.group()
        if kind != "skip":
            yield _Token(kind, found, line)
        if kind in _OF_SEVERAL_LINES:
            line += found.count("\n")
        position = match.end()
        match = _TOKEN.match(text, position)
    if position < len(text):
        raise _error(line, f"cannot read {short(text[position : position + 20].partition(chr(10))[0])}")
    yield _Token("end", "the end of the text", line)


def _error(line: int, message: str) -> TaskError:
    return TaskError(f"HOA line {line}: {message}")


class _Reader:
    """Recursive descent over the tokens of one automaton."""

    def __init__(self, tokens: Iterator[_Token]):
        self._rest = tokens
        # Kept, because aliases are read once more after the header.
        self._tokens = [next(tokens)]
        self._position = 0
        self._depth = 0
        self._header = _Header()
        # Without an ``AP:`` header there is one letter, in which no proposition holds.
        self._letters = np.zeros(1, dtype=np.int64)
        self._where: list[np.ndarray] = []  # per proposition the letters that hold it

    def read(self) -> HoaAutomaton:
        self._read_header()
        header = self._header
        states = self._read_body()
        transitions, accepting = self._assemble(states)
        return HoaAutomaton(header.name, header.propositions or (), transitions, accepting, header.initial)

    # Tokens

    @property
    def _next(self) -> _Token:
        return self._tokens[self._position]

    def _take(self) -> _Token:
        token = self._next
        # The end repeats for ever, so that no reader has to check for running out of tokens.
        if token.kind != "end":
            self._position += 1
            if self._position == len(self._tokens):
                self._tokens.append(next(self._rest))
        return token

    def _accept(self, text: str) -> bool:
        # A quoted name may read like a keyword.
        found = self._next.text == text and self._next.kind != "string"
        if found:
            self._take()
        return found

    def _expect(self, kind: str, what: str) -> _Token:
        if self._next.kind != kind:
            raise self._error(f"expected {what}, found {self._next}")
        return self._take()

    def _expect_symbol(self, symbol: str) -> None:
        if not self._accept(symbol):
            raise self._error(f"expected '{symbol}', found {self._next}")

    def _number(self, what: str) -> int:
        return self._value(self._expect("number", what))

    def _value(self, token: _Token) -> int:
        if len(token.text) > _MOST_DIGITS:
            raise _error(token.line, f"{token} is too large a number")
        return int(token.text)

    def _error(self, message: str) -> TaskError:
        return _error(self._next.line, message)

    # Header

    def _read_header(self) -> None:
        if not self._accept("HOA:"):
            raise self._error("the text does not begin with 'HOA: v1'")
        version = self._expect("name", "the version")
        if version.text != "v1":
            raise _error(version.line, f"version {version} is not known; v1 is")
        aliases: list[int] = []
        while self._next.text != "--BODY--":
            item = self._expect("header", "a header or --BODY--")
            if item.text == "Alias:":
                # Labels are sets of letters, which are known once ``AP:`` has been read; that may come later.
                aliases.append(self._position)
                self._skip_header_item()
            else:
                self._read_header_item(item)
        self._read_aliases(aliases)
        if self._header.initial == _UNKNOWN:
            raise self._error("there is no 'Start:' header: the automaton needs one initial state")
        if self._header.acceptance is None:
            raise self._error("there is no 'Acceptance:' header")
        self._take()

    def _read_aliases(self, positions: Sequence[int]) -> None:
        """Read the aliases that begin at these tokens; one may use those before it."""
        end = self._position
        for position in positions:
            self._position = position
            name = self._expect("alias", "an alias such as @a")
            if name.text in self._header.aliases:
                raise _error(name.line, f"a second alias {name}")
            self._header.aliases[name.text] = self._disjunction()
            if self._next.kind not in ("header", "section"):
                raise self._error(f"expected a header or --BODY--, found {self._next}")
        self._position = end

    def _read_header_item(self, token: _Token) -> None:
        header = self._header
        if token.text in _ONCE and token.text in header.seen:
            raise _error(token.line, f"a second '{token}' header")
        header.seen.add(token.text)
        match token.text:
            case "States:":
                header.num_states = self._number("the number of states")
            case "Start:":
                self._read_start(token)
            case "AP:":
                self._read_propositions(token)
            case "Acceptance:":
                self._read_acceptance(token)
            case "name:":
                header.name = _unquote(self._expect("string", "a name in quotes").text)
            case other if other[0].islower():  # by the format, such headers carry no meaning that may not be ignored
                self._skip_header_item()
            case _:
                raise _error(token.line, f"header '{token}' is not supported")

    def _skip_header_item(self) -> None:
        while self._next.kind not in ("header", "section", "end"):
            self._take()

    def _read_start(self, token: _Token) -> None:
        if self._header.initial != _UNKNOWN:
            raise _error(token.line, "several initial states: the automaton is not deterministic")
        self._header.initial = self._number("the initial state")
        if self._next.text == "&":
            raise self._error("a conjunction of initial states: alternating automata are not supported")

    def _read_propositions(self, token: _Token) -> None:
        count = self._number("the number of propositions")
        names: list[str] = []
        while self._next.kind == "string":
            names.append(_unquote(self._take().text))
        if len(names) != count or len(set(names)) != count:
            raise _error(token.line, f"'AP:' announces {count} distinct propositions, and lists {len(names)}")
        try:
            self._header.propositions = check_propositions(names)
        except TaskError as error:
            raise _error(token.line, str(error)) from error
        self._letters = np.arange(2**count)
        self._where = [(self._letters >> i & 1).astype(bool) for i in range(count)]

    def _read_acceptance(self, token: _Token) -> None:
        parts: list[str] = []
        while self._next.kind not in ("header", "section", "end"):
            parts.append(self._take().text)
        condition = "".join(parts)
        if condition not in ("0t", "0f", "1Inf(0)"):
            found = one_line(" ".join(parts), 40)
            raise _error(token.line, f"acceptance '{found}' is not supported: it must be Büchi, '1 Inf(0)'")
        self._header.acceptance = condition

    # Labels: sets of letters. By the format ! binds stronger than &, and & stronger than |.

    def _disjunction(self) -> np.ndarray:
        letters = self._conjunction()
        while self._accept("|"):
            letters = letters | self._conjunction()
        return letters

    def _conjunction(self) -> np.ndarray:
        letters = self._literal()
        while self._accept("&"):
            letters = letters & self._literal()
        return letters

    def _literal(self) -> np.ndarray:
        # Counted, not called again for each: thousands of negations in a row are a text like any other.
        negated = False
        while self._accept("!"):
            negated = not negated
        letters = self._atom()
        return ~letters if negated else letters

    def _atom(self) -> np.ndarray:
        if self._accept("("):
            self._depth += 1
            if self._depth > DEEPEST:
                raise self._error(f"more than {DEEPEST} parentheses within each other")
            letters = self._disjunction()
            self._expect_symbol(")")
            self._depth -= 1
            return letters
        token = self._take()
        if token.kind == "number":
            return self._proposition(token)
        if token.kind == "alias" and token.text in self._header.aliases:
            return self._header.aliases[token.text]
        if token.text in ("t", "f"):
            return np.full(self._letters.size, token.text == "t")
        # A negation of nothing, an alias that comes later, a name where a number belongs: all end here.
        raise _error(token.line, f"{token} is not a label: expected a proposition's number, an alias, t or f")

    def _proposition(self, token: _Token) -> np.ndarray:
        index = self._value(token)
        if index >= len(self._where):
            raise _error(token.line, f"proposition {index} does not exist: 'AP:' lists {len(self._where)}")
        return self._where[index]

    def _optional_label(self) -> np.ndarray | None:
        if not self._accept("["):
            return None
        letters = self._disjunction()
        self._expect_symbol("]")
        return letters

    # Body

    def _read_body(self) -> dict[int, _State]:
        states: dict[int, _State] = {}
        while not self._accept("--END--"):
            if not self._accept("State:"):
                raise self._error(f"expected 'State:' or --END--, found {self._next}")
            self._read_state(states)
        if self._next.kind != "end":
            raise self._error("there is text after --END--: one automaton is read, not several")
        return states

    def _read_state(self, states: dict[int, _State]) -> None:
        label = self._optional_label()
        line = self._next.line
        index = self._number("a state's number")
        if index in states:
            raise _error(line, f"state {index} is described twice")
        if (len(states) + 1) * self._letters.size > MOST_ENTRIES:
            raise _error(
                line, f"more than {MOST_ENTRIES:,} entries, states times letters: use fewer states or propositions"
            )
        if self._next.kind == "string":
            self._take()
        # Rows of the table are filled edge by edge, which shows both what is described twice and what is missing.
        table = np.full(self._letters.size, _UNKNOWN)
        states[index] = state = _State(line, self._acceptance_sets(), label, table)
        while self._next.text == "[" or self._next.kind == "number":
            self._read_edge(index, state)

    def _acceptance_sets(self) -> bool:
        """Whether the set ``{0}`` follows."""
        if not self._accept("{"):
            return False
        member = False
        while not self._accept("}"):
            if self._number("an acceptance set's number") != 0 or self._header.acceptance != "1Inf(0)":
                raise self._error("an acceptance set that 'Acceptance:' does not have")
            member = True
        return member

    def _read_edge(self, index: int, state: _State) -> None:
        line = self._next.line
        letters = self._edge_letters(state)
        target = self._number("an edge's target state")
        if self._next.text == "&":
            raise self._error("universal branching: alternating automata are not supported")
        if self._next.text == "{":
            raise self._error("acceptance on an edge: only state-based acceptance is supported")
        # Two edges for one letter are harmless where they lead to the same state.
        clash = np.flatnonzero(letters & (state.table >= 0) & (state.table != target))
        if clash.size:
            raise _error(
                line,
                f"state {index} is not deterministic: letter {self._letter_text(int(clash[0]))} leads to both "
                f"{state.table[clash[0]]} and {target}",
            )
        state.table[letters] = target

    def _edge_letters(self, state: _State) -> np.ndarray:
        """The letters of the edge that begins here: its label, its state's, or the next letter in order."""
        label = self._optional_label()
        if label is not None:
            if state.label is not None or state.implicit_edges:
                raise self._error("an edge label beside a state label or implicit labels")
            state.explicit_labels = True
            return label
        if state.explicit_labels:
            raise self._error("an edge without label beside edges with labels")
        if state.label is not None:
            return state.label
        # Implicit labels: the i-th edge belongs to letter i.
        state.implicit_edges += 1
        if state.implicit_edges > self._letters.size:
            raise self._error(f"more than {self._letters.size} edges with implicit labels")
        return self._letters == state.implicit_edges - 1

    # Result

    def _assemble(self, states: dict[int, _State]) -> tuple[np.ndarray, np.ndarray]:
        """Dense tables; refuses what is not complete."""
        count = self._num_states(states)
        for index, state in states.items():
            outside = state.table[state.table >= count]
            if outside.size:
                raise _error(state.line, f"state {index} leads to state {outside[0]}, which is not described")
            missing = np.flatnonzero(state.table == _UNKNOWN)
            if missing.size:
                raise _error(
                    state.line,
                    f"state {index} is not complete: letter {self._letter_text(int(missing[0]))} leads nowhere "
                    "(Spot completes automata with the option 'complete')",
                )
        # ``t`` accepts every run; ``f`` none, and then no state can be a member.
        transitions = np.stack([states[index].table for index in range(count)])
        members = np.array([states[index].accepting for index in range(count)])
        return transitions, members | (self._header.acceptance == "0t")

    def _num_states(self, states: dict[int, _State]) -> int:
        """The number of states, after checking that the body describes each of them."""
        header = self._header
        count = len(states) if header.num_states is None else header.num_states
        for index in range(count):
            if index not in states:
                raise self._error(f"state {index} of {count} is not described")
        for index, state in states.items():
            if index >= count:
                raise _error(state.line, f"state {index} exceeds the {count} states of the header")
        if header.initial >= count:
            raise self._error(f"the initial state {header.initial} is not described")
        return count

    def _letter_text(self, letter: int) -> str:
        """A letter as the conjunction of its literals."""
        names = self._header.propositions or ()
        return "&".join(("" if letter >> i & 1 else "!") + name for i, name in enumerate(names)) or "t"
