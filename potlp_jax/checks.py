"""Checks of configurations: one form of rule and of message wherever several fields are checked alike."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Kind:
    """What values of a kind fulfil, and how a message asks for one."""

    holds: Callable[[Any], bool]
    wanted: str


AT_LEAST_ONE: Kind = Kind(lambda value: value >= 1, "at least 1")
POSITIVE: Kind = Kind(lambda value: math.isfinite(value) and value > 0, "a positive number")
NOT_NEGATIVE: Kind = Kind(lambda value: math.isfinite(value) and value >= 0, "a number from 0")
LIMIT: Kind = Kind(lambda value: value > 0, "a positive number, or infinity for none")
SHARE: Kind = Kind(lambda value: 0 <= value <= 1, "a number from 0 to 1")


def require_fields(config: object, names: Iterable[str], kind: Kind, error: type[Exception]) -> None:
    """Raise ``error`` with name and value of the first of these fields of ``config`` that is not of the kind."""
    for name in names:
        value = getattr(config, name)
        if not kind.holds(value):
            raise error(f"{name} is {value}; give {kind.wanted}")


def require_rules(rules: Iterable[tuple[bool, str]], what: str, error: type[Exception]) -> None:
    """Raise ``error`` with all that is wrong, so that a configuration is mended in one go.

    Args:
        rules: whether each holds, and what is said where it does not.
        what: what the configuration should be, with its article.
        error: the kind of error.
    """
    broken = [message for holds, message in rules if not holds]
    if broken:
        raise error(f"not {what}: {'; '.join(broken)}")
