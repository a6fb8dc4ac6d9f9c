"""Sigma: names of the bits of a letter. What is checked of them, and the one check that two things have the same.

Tasks, worlds, beliefs, networks and data sets meet in arrays, where bit ``i`` of a letter, and entry ``i`` of a cube,
mean a name by their place alone. So each of them carries its names, as a static part where it is a pytree, and whatever
joins two of them calls ``require_same_propositions`` first. Under jit that happens while tracing, and costs nothing
afterwards: names are part of what JAX compiles for, so that another pair of names is traced, and checked, anew.
"""

import re
from collections.abc import Sequence

from potlp_jax.errors import PropositionsError, TaskError
from potlp_jax.files import short

MAX_PROPOSITIONS: int = 16
"""Propositions of a task, at most: tables are dense over ``2 ** n`` letters."""

LONGEST_NAME: int = 50
"""Characters of a name: sixteen fit into a message."""

TAKE_ITS_NAMES = (
    "take the task from the world, world.task(formula), or give its names, Task.from_formula(formula, names)"
)
"""What to do where a task meets a world or a belief of other propositions."""

# F, G and X at the start of a name are operators to Spot, single U, R, W, M and V too, and these words in any case.
_PLAIN_NAME = re.compile(
    r"(?!(?:[URWMV]|(?i:true|false)|xor|first_match)\Z)[A-EH-WYZa-z_][A-Za-z0-9_]*", flags=re.ASCII
)
"""Names that Spot reads as they stand."""


def check_propositions(propositions: Sequence[str]) -> tuple[str, ...]:
    """Sigma as a tuple.

    Raises:
        TaskError: a single string, an empty or repeated name, or more than ``MAX_PROPOSITIONS`` names.
    """
    if isinstance(propositions, str):
        raise TaskError(f"propositions must be a sequence of names, not the single text {propositions!r}")
    names = tuple(propositions)
    if any(not isinstance(name, str) or not name for name in names):
        raise TaskError(f"propositions must be non-empty texts, got {short(names)}")
    # Every message about them names all of them, and files may hold anything.
    odd = [name for name in names if len(name) > LONGEST_NAME or not name.isprintable()]
    if odd:
        raise TaskError(f"proposition {short(odd[0])}: names are printable texts of at most {LONGEST_NAME} characters")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise TaskError(f"propositions are repeated: {', '.join(repeated)}")
    if len(names) > MAX_PROPOSITIONS:
        raise TaskError(f"{len(names)} propositions are too many: a task has at most {MAX_PROPOSITIONS}")
    return names


def in_formula(name: str) -> str:
    """A name as it is written in a formula: in double quotes where Spot would read something else without them."""
    if _PLAIN_NAME.fullmatch(name):
        return name
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def require_same_propositions(
    asked: Sequence[str],
    known: Sequence[str],
    *,
    asker: str = "the task",
    knower: str = "the world",
    remedy: str = TAKE_ITS_NAMES,
) -> None:
    """Refuse to join two things whose propositions differ in names or in order.

    Args:
        asked: propositions of the one, in the order of its bits.
        known: propositions of the other.
        asker, knower: what the two are called in the message.
        remedy: what to do, an imperative.

    Raises:
        PropositionsError: they differ. The message names both, in order.
    """
    if tuple(asked) == tuple(known):
        return
    # The same names in another order look alike in print: it is said what differs.
    differs = "in order" if sorted(asked) == sorted(known) else "in names"
    raise PropositionsError(
        f"{asker} has the propositions {in_order(asked)}, {knower} {in_order(known)}: they differ {differs}, and a "
        f"letter's bits mean them by position; {remedy}"
    )


def in_order(propositions: Sequence[str]) -> str:
    """Sigma for messages, such as ``(fire, exit)``."""
    return f"({', '.join(propositions)})"
