"""The program of the process in which Spot runs: questions on stdin, answers on stdout, one JSON a line.

It imports nothing but Spot, so that it starts in a tenth of a second; ``task.spot_process`` starts and asks it. For
some formulas Spot takes hours or all memory, or crashes: its limits end this process and no other.

A question is ``{"ask": "parse" | "translate", "formula": text}``. Answers are ``{"errors": report}`` where Spot cannot
read the text; of ``parse`` ``{"formula", "names", "offender", "structure"}`` (``offender`` is None for a co-safe
formula; ``structure`` is its negation normal form as nested lists in the form of ``task.language``, None where it is
large or has operators of PSL); of ``translate`` ``{"states", "propositions", "transitions", "hoa"}``, with ``hoa`` None
where it is longer than the limit.
"""

import functools
import importlib
import json
import resource
import signal
import sys
from collections.abc import Iterator
from typing import Any

SECONDS: float = 2.0
"""Of computing for one question; of this process alone, so that a busy machine refuses no formula."""

MEMORY: int = 1 << 31
"""Bytes of address space."""

MOST_PARTS: int = 200
"""Parts of a structure, at most: the tasks that ship have 14, and whoever reads one does so recursively."""

LONGEST_HOA: int = 250_000
"""Characters of an automaton: 8 conjoined ``F p``, 256 states with 6,561 transitions, have half as many."""


def main() -> None:
    """Answer until nobody asks any more; the first line says whether Spot is ready, missing or another library."""
    _set_limits()
    # Whatever a package of this name writes when it is imported must not be taken for an answer.
    answers, sys.stdout = sys.stdout, sys.stderr
    spot, state = _load()
    print(json.dumps(state), file=answers, flush=True)
    for line in sys.stdin:
        # Its default action ends the process, in the middle of Spot's own code.
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        answer = _answer(spot, **json.loads(line))
        signal.setitimer(signal.ITIMER_PROF, 0)
        print(json.dumps(answer), file=answers, flush=True)


def _set_limits() -> None:
    # An interrupt from the terminal reaches this process too; the one that asked it ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # It ends by a signal by design, and nobody looks into what it leaves.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY if hard == resource.RLIM_INFINITY else min(MEMORY, hard), hard))


def _load() -> tuple[Any, str]:
    try:
        spot = importlib.import_module("spot")
    except ImportError:
        return None, "missing"
    except Exception:  # the namesake on PyPI is Python 2 code and fails in its own ways
        return None, "another"
    return spot, "ready" if hasattr(spot, "translate") and hasattr(spot, "formula") else "another"


def _answer(spot: Any, ask: str, formula: str) -> dict[str, Any]:
    result = spot.parse_infix_psl(formula)
    if result.errors:
        stream = spot.ostringstream()
        result.format_errors(stream)
        return {"errors": stream.str()}
    return {"parse": _parsed, "translate": _translated}[ask](spot, result.f)


def _parsed(spot: Any, formula: Any) -> dict[str, Any]:
    # "Guarantee" is Manna and Pnueli's class that the field calls co-safe. The check is of syntax: a formula that is
    # co-safe for subtler reasons is refused.
    normal_form = spot.negative_normal_form(formula)
    return {
        "formula": str(formula),
        "names": sorted(proposition.ap_name() for proposition in spot.atomic_prop_collect(formula) or ()),
        "offender": None if normal_form.is_syntactic_guarantee() else str(_offending_part(normal_form)),
        "structure": _structure(normal_form),
    }


def _structure(normal_form: Any) -> list[Any] | None:
    try:
        return _nested(normal_form, iter(range(MOST_PARTS)))
    # A formula of more parts than the counter has, and an operator of another logic.
    except (StopIteration, KeyError):
        return None


def _nested(formula: Any, counter: Iterator[int]) -> list[Any]:
    """The formula as lists such as ``["U", ["true"], ["name", "a"]]``; And and Or join two parts each."""
    next(counter)
    kind = formula.kindstr()
    if kind == "ap":
        return ["name", formula.ap_name()]
    parts = [_nested(part, counter) for part in formula]
    if kind == "F":
        return ["U", ["true"], *parts]
    if kind == "M":
        # Read once more, so that the second copy counts too.
        return ["U", parts[1], ["and", parts[0], _nested(formula[1], counter)]]
    name = {"tt": "true", "ff": "false", "Not": "not", "X": "X", "U": "U", "And": "and", "Or": "or"}[kind]
    return functools.reduce(lambda left, right: [name, left, right], parts) if name in ("and", "or") else [name, *parts]


def _offending_part(formula: Any) -> Any:
    """The innermost sub-formula that breaks co-safety while its own parts do not."""
    for part in formula:
        if part.is_psl_formula() and not part.is_syntactic_guarantee():
            return _offending_part(part)
    return formula


def _translated(spot: Any, formula: Any) -> dict[str, Any]:
    # "BA" puts acceptance on states. "deterministic" is a preference to Spot; for co-safe formulas it is always met.
    automaton = spot.translate(formula, "BA", "deterministic", "complete")
    hoa = automaton.to_str("hoa")
    return {
        "states": automaton.num_states(),
        "propositions": len(automaton.ap()),
        "transitions": automaton.num_edges(),
        "hoa": hoa if len(hoa) <= LONGEST_HOA else None,
    }


if __name__ == "__main__":
    main()
