"""Settings that a world calls for, as a value that can be hashed: part of what is static under jit."""

from collections.abc import Iterator, Mapping
from typing import Any


class Settings(Mapping[str, Any]):
    """An immutable mapping from names to values or further settings; two with equal entries are equal.

    A plain dictionary could not be a static field of a pytree, because JAX hashes those.
    """

    def __init__(self, values: Mapping[str, Any] | None = None) -> None:
        self._values = {name: _frozen(value) for name, value in (values or {}).items()}

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __hash__(self) -> int:
        # Order does not count, as in the equality of mappings.
        return hash(frozenset(self._values.items()))

    def __repr__(self) -> str:
        return f"Settings({self._values!r})"

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionaries, for files."""
        return {name: _thawed(value) for name, value in self.items()}


def _frozen(value: Any) -> Any:
    """The value as one that can be hashed; JSON has lists where settings have tuples."""
    if isinstance(value, Mapping):
        return Settings(value)
    return tuple(map(_frozen, value)) if isinstance(value, list | tuple) else value


def _thawed(value: Any) -> Any:
    """The value without ``Settings``, those within tuples included."""
    if isinstance(value, Settings):
        return value.to_dict()
    return tuple(map(_thawed, value)) if isinstance(value, tuple) else value


NO_SETTINGS: Settings = Settings()
"""Trials run with the defaults."""
