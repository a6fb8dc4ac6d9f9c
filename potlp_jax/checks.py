"""Checks of configurations: one form of rule and of message wherever several fields are checked alike."""

import dataclasses
import math
import numbers
from collections.abc import Callable, Iterable
from typing import Any


@dataclasses.dataclass(frozen=True)
class Kind:
    """What values of a kind fulfil, and how a message asks for one."""

    holds: Callable[[Any], bool]
    wanted: str

    def allows(self, value: Any) -> bool:
        """Whether a value is of the kind; what cannot be compared with numbers is of none."""
        try:
            return self.holds(value)
        except TypeError:
            return False


def is_whole(value: object) -> bool:
    """Whether it is a whole number of whatever type, NumPy's too; True and False are none."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def is_number(value: object) -> bool:
    """Whether it is one number of whatever type, NumPy's too; True and False are none, nor is an array."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


FLAG: Kind = Kind(lambda value: type(value).__name__ in ("bool", "bool_"), "True or False")
COUNT: Kind = Kind(lambda value: is_whole(value) and value >= 1, "a whole number of at least 1")
WHOLE: Kind = Kind(lambda value: is_whole(value) and value >= 0, "a whole number from 0")
AT_LEAST_ONE: Kind = Kind(lambda value: value >= 1, "at least 1")
POSITIVE: Kind = Kind(lambda value: is_number(value) and 0 < value < math.inf, "a positive number")
FINITE: Kind = Kind(lambda value: is_number(value) and math.isfinite(value), "a finite number")
NOT_NEGATIVE: Kind = Kind(lambda value: is_number(value) and 0 <= value < math.inf, "a number from 0")
# jax reads a seed modulo 2**32 (without 64 bits): two would be one.
SEED: Kind = Kind(lambda value: is_whole(value) and 0 <= value < 2**32, f"a whole number from 0 to {2**32 - 1}")
SHARE: Kind = Kind(lambda value: is_number(value) and 0 <= value <= 1, "a number from 0 to 1")


def require_fields(config: object, names: Iterable[str], kind: Kind, error: type[Exception]) -> None:
    """Raise ``error`` with name and value of the first of these fields of ``config`` that is not of the kind."""
    for name in names:
        value = getattr(config, name)
        if not kind.allows(value):
            raise error(f"{name} is {value}; give {kind.wanted}")


def as_python_numbers(config: Any) -> None:
    """Make numbers of other types Python's in all fields of a frozen dataclass: records of settings hold no others.

    Args:
        config: which is being made. What is no number, and no tuple of them, stays as it is.
    """
    for field in dataclasses.fields(config):
        object.__setattr__(config, field.name, _as_python(getattr(config, field.name)))


def _as_python(value: Any) -> Any:
    # Here, for help and completion of the commands load this module, and shall not wait for numpy.
    import numpy as np

    if isinstance(value, tuple):
        return tuple(map(_as_python, value))
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if is_whole(value):
        return int(value)
    return float(value) if is_number(value) else value


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
