"""A formula in plain English, part by part, from its structure.

``(!fire U extinguisher) & F fire`` reads "avoid fire until extinguisher is found; and find fire". One rule for each
operator of the negation normal form (`potlp_jax.task.language`):

* ``F p`` is *find p*, ``F (p & g)`` *find p and from there g*, and ``F g`` otherwise *at some point g*;
* ``p U q`` is *p until q is found*, where p is something to be avoided or stayed in; other left sides must hold anew
  at every step;
* ``X g`` is *in one step g*; what stands under no operator must hold at once, where the robot starts;
* ``&`` and ``|`` join the whole formula by *and* and *or*; within another part they stand in brackets, so that a phrase
  has one meaning.
"""

from potlp_jax.task.formula import Structure
from potlp_jax.task.words import join_names

_TEMPORAL = ("X", "U")


def formula_phrase(formula: Structure) -> str:
    """What the formula asks of the robot, as a phrase without a full stop, such as "find a, and from there find b"."""
    return _asked(formula, outermost=True)


def place_words(formula: Structure) -> str:
    """A formula without temporal operators as what holds at a place: "a and b together", "a without b", "a or b"."""
    if formula[0] == "or":
        return join_names([_both(part) for part in operands(formula)], "or")
    return _both(formula)


def is_of_one_place(formula: Structure) -> bool:
    """Whether a formula speaks of a single place: it has no temporal operator."""
    return formula[0] not in _TEMPORAL and (formula[0] == "name" or all(is_of_one_place(part) for part in formula[1:]))


def operands(formula: Structure) -> list[Structure]:
    """What a chain of one operator, "and" or "or", joins; a formula of another kind is its only operand."""
    return _chain(formula, formula[0]) if formula[0] in ("and", "or") else [formula]


def _chain(formula: Structure, kind: str) -> list[Structure]:
    return [part for side in formula[1:] for part in _chain(side, kind)] if formula[0] == kind else [formula]


def _both(formula: Structure) -> str:
    """A conjunction, or one of its parts, as what holds at a place."""
    if formula[0] in ("true", "false"):
        return "anything" if formula[0] == "true" else "what never holds"
    if formula[0] == "name":
        return formula[1]
    if formula[0] == "not":
        return f"no {formula[1][1]}"
    if formula[0] == "or":
        return f"({place_words(formula)})"
    parts = operands(formula)
    wanted = [_both(part) for part in parts if part[0] != "not"]
    refused = [part[1][1] for part in parts if part[0] == "not"]
    if not wanted:
        return f"neither {join_names(refused, 'nor')}"
    text = join_names(wanted, "and") + (" together" if len(wanted) > 1 else "")
    return text + (f" without {join_names(refused, 'or')}" if refused else "")


def _asked(formula: Structure, *, outermost: bool = False) -> str:
    if is_of_one_place(formula):
        return f"{_presence(formula)} at once"
    if formula[0] in ("and", "or"):
        joint = f"; {formula[0]} " if outermost else f" {formula[0]} "
        text = joint.join(_asked(part) for part in operands(formula))
        return text if outermost else f"({text})"
    if formula[0] == "X":
        return _later(formula)
    left, right = formula[1:]
    if left == ("true",):
        return _found(right)
    return f"{_manner(left)} until {_moment(right)}"


def _presence(place: Structure) -> str:
    if place[0] == "true":
        return "be anywhere"
    return f"be elsewhere than at {place[1][1]}" if place[0] == "not" else f"be at {place_words(place)}"


def _later(formula: Structure) -> str:
    """``X X ... g``, its steps counted."""
    steps = 0
    while formula[0] == "X":
        formula, steps = formula[1], steps + 1
    after = "in one step" if steps == 1 else f"in {steps} steps"
    return f"{after} {_presence(formula) if is_of_one_place(formula) else _asked(formula)}"


def _found(goal: Structure) -> str:
    """``F goal``."""
    place, rest = _place_and_rest(goal)
    if place is None:
        return f"at some point {_asked(goal)}"
    return f"find {place_words(place)}" + (f", and from there {_asked(rest)}" if rest else "")


def _moment(goal: Structure) -> str:
    """The right side of an until: when the left one may end."""
    place, rest = _place_and_rest(goal)
    if place is None:
        return f"the moment from which on: {_asked(goal)}"
    words = place_words(place)
    # Several that are wanted together are more than one.
    return f"{words} {'are' if words.endswith(' together') else 'is'} found" + (
        f", and from there {_asked(rest)}" if rest else ""
    )


def _place_and_rest(goal: Structure) -> tuple[Structure | None, Structure | None]:
    """What a goal wants of one place, and what it wants from there on; None where there is nothing of the kind."""
    if is_of_one_place(goal):
        return goal, None
    if goal[0] != "and":
        return None, None
    here = [part for part in operands(goal) if is_of_one_place(part)]
    later = [part for part in operands(goal) if not is_of_one_place(part)]
    return (_conjoined(here), _conjoined(later)) if here else (None, None)


def _conjoined(parts: list[Structure]) -> Structure:
    joined, *others = parts
    for part in others:
        joined = ("and", joined, part)
    return joined


def _manner(kept: Structure) -> str:
    """The left side of an until: what must hold at every step before the right one does."""
    if not is_of_one_place(kept):
        return f"at every step anew {_asked(kept)},"
    parts = operands(kept)
    refused = [part[1][1] for part in parts if part[0] == "not"]
    if len(refused) == len(parts) > 1 and kept[0] == "or":
        return f"avoid {join_names(refused, 'and')} together"
    if len(refused) == len(parts):
        return f"avoid {join_names(refused, 'and')}"
    return f"stay in {place_words(kept)}"
