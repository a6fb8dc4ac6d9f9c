"""Values that leave the program and come back: JSON without infinities, differences, configurations from mappings.

Configurations are frozen dataclasses. ``config_from_dict`` reads one that ``dataclasses.asdict`` wrote, and
``with_settings`` changes some fields of one, as a person or an environment asks. Both check names and types at every
depth, and the message names the field that is wrong. Where one of several classes can stand, the field ``kind`` tells
which one is meant.
"""

import dataclasses
import functools
import json
import math
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import pydantic
import yaml
from pydantic_core import ErrorDetails

from potlp_jax.errors import ConfigurationError
from potlp_jax.files import parse_yaml, read_yaml, require_mapping, short

KIND: str = "kind"
"""The field that tells configurations apart where one of several classes can stand."""

_Config = TypeVar("_Config")

# Characters of a value in a message; longer ones would hide what else differs.
_LONGEST_VALUE = 80


def finite_or_text(value: Any) -> Any:
    """JSON-able values in which ``"inf"`` and ``"nan"`` stand for such numbers; ``float`` reads them back."""
    return _replace_non_finite(value, str)


def finite_or_null(value: Any) -> Any:
    """JSON-able values in which None stands for numbers that are not finite, for readers that expect numbers."""
    return _replace_non_finite(value, lambda _: None)


def _replace_non_finite(value: Any, stand_in: Callable[[float], Any]) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else stand_in(value)
    if isinstance(value, Mapping):
        return {name: _replace_non_finite(entry, stand_in) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_non_finite(entry, stand_in) for entry in value]
    return value


def json_copy(value: Any) -> Any:
    """The value as it comes back from a JSON file: tuples become lists, and what JSON does not know becomes text."""
    return json.loads(json.dumps(value, default=_json_value))


def _json_value(value: Any) -> Any:
    # json knows dict alone among the mappings; configurations hold read-only ones.
    if isinstance(value, Mapping):
        return dict(value)
    return value.value if isinstance(value, Enum) else str(value)


def differences(before: Any, now: Any, name: str = "") -> list[str]:
    """What differs between two nested JSON values, such as ``"training.seed was 1, is 2"``.

    Args:
        before: what is stored.
        now: what was given.
        name: what both values are called; the names of their entries follow after a dot.

    Returns:
        One text for each entry that differs, in the order of the names. An entry that is missing counts as null.
    """
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        prefix = f"{name}." if name else ""
        keys = sorted({*before, *now})
        return [found for key in keys for found in differences(before.get(key), now.get(key), f"{prefix}{key}")]
    # A number that is none is not equal to itself.
    equal = before == now or (before != before and now != now)
    return [] if equal else [f"{name} was {_short(before)}, is {_short(now)}".lstrip()]


def _short(value: Any) -> str:
    text = json.dumps(value, default=_json_value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."


def read_settings(file: Path) -> Mapping[str, Any]:
    """The entries of a YAML file.

    Raises:
        ConfigurationError: the file is no YAML, or holds something else than entries by name.
    """
    return require_mapping(file, read_yaml(file, ConfigurationError), ConfigurationError, "a file of settings")


def settings_from_words(words: Sequence[str]) -> dict[str, Any]:
    """Nested settings from words such as ``camera.height=64``; values are written as in YAML.

    Raises:
        ConfigurationError: a word has no ``=``, its value is no YAML, or it sets what another one has set.
    """
    settings: dict[str, Any] = {}
    for word in words:
        # At the first "=": values may hold others.
        path, equals, text = word.partition("=")
        if not (path and equals):
            raise ConfigurationError(
                f"setting {word!r}: write name=value, with dots for names inside: camera.height=64"
            )
        *outer, name = path.split(".")
        inner = settings
        for part in outer:
            inner = inner.setdefault(part, {})
            if not isinstance(inner, dict):
                raise ConfigurationError(f"setting {word!r}: {part} has got a value already, so it holds no {name}")
        if name in inner:
            raise ConfigurationError(f"setting {word!r}: {name} is set already; give it once")
        try:
            inner[name] = parse_yaml(text)
        # Beside YAML's own errors: a date that does not exist, a number with 5,000 digits.
        except (yaml.YAMLError, ValueError) as error:
            raise ConfigurationError(f"setting {short(word)}: {short(text)} is no value as in YAML") from error
        require_mapping(f"setting {short(word)}", settings, ConfigurationError, "a setting")
    return settings


def shipped_settings(package: str) -> dict[str, Path]:
    """The YAML files that come with a package as its data, by name without the ending."""
    folder = Path(str(resources.files(package))) / "data"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"), key=lambda path: path.stem)}


def settings_file(given: str | Path, package: str) -> Path:
    """The file that a user means: by its path, or by the name of one that comes with ``package``.

    Raises:
        ConfigurationError: there is neither.
    """
    shipped = shipped_settings(package)
    # A file of the user's own goes before a shipped one of the same name.
    if Path(given).is_file():
        return Path(given)
    if str(given) in shipped:
        return shipped[str(given)]
    raise ConfigurationError(f"{given}: neither a file nor one of those that are shipped: {', '.join(shipped)}")


def config_from_dict(kind: type[_Config], data: Any, where: str) -> _Config:
    """The configuration that ``dataclasses.asdict`` gave, perhaps by way of a JSON file.

    Args:
        kind: a frozen dataclass.
        data: the value of every field, nested mappings for nested configurations.
        where: what is read; begins the message of an error.

    Returns:
        An equal configuration to the one that was written.

    Raises:
        ConfigurationError: a field is missing, unknown, or has a value that does not fit.
    """
    config = _validated(kind, json_copy(data), where)
    # A default in place of a missing field could be another value than the one that was used.
    for missing in _missing_fields(config, data):
        raise ConfigurationError(f"{where}: {missing} is missing: it was written by another version")
    return config


def with_settings(config: _Config, settings: Any, where: str = "settings") -> _Config:
    """A configuration with some of its fields changed.

    Args:
        config: a frozen dataclass.
        settings: new values by field, nested mappings for nested configurations. With another ``kind`` than the
            nested configuration has, the fields that are not given take the defaults of that kind. A text alone
            in place of such a configuration is its kind.
        where: what the settings are called; begins the message of an error.

    Returns:
        A configuration of the same class.

    Raises:
        ConfigurationError: a field is unknown, or has a value that does not fit.
    """
    values: Any = config
    return _validated(type(config), _merged(json_copy(dataclasses.asdict(values)), json_copy(settings)), where)


def _merged(current: Any, changes: Any) -> Any:
    # Where a kind can be chosen, its name alone means its defaults: `search: uct`.
    if isinstance(changes, str) and isinstance(current, Mapping) and KIND in current:
        changes = {KIND: changes}
    if not (isinstance(current, Mapping) and isinstance(changes, Mapping)):
        return changes
    # A configuration of another kind has other fields: none of the current ones means anything there.
    if KIND in changes and changes[KIND] != current.get(KIND):
        return changes
    return {**current, **{name: _merged(current.get(name), value) for name, value in changes.items()}}


def _missing_fields(config: Any, data: Mapping[str, Any], path: str = "") -> Iterator[str]:
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name not in data:
            yield path + field.name
        elif dataclasses.is_dataclass(value):
            yield from _missing_fields(value, data[field.name], f"{path}{field.name}.")


@functools.cache
def _validator(kind: type[Any]) -> type[pydantic.BaseModel]:
    # Pydantic takes rules for plain dataclasses from the model around them, and applies them at every depth.
    rules = pydantic.ConfigDict(extra="forbid", strict=True)
    return pydantic.create_model("Configuration", __config__=rules, value=(kind, ...))


def _validated(kind: type[_Config], data: Any, where: str) -> _Config:
    try:
        # As JSON, because pydantic's strict rules for JSON are those wanted here: a list becomes a tuple and a text an
        # enum, but a truth value is no number, and neither is a text.
        found: Any = _validator(kind).model_validate_json(json.dumps({"value": data}))
    except pydantic.ValidationError as error:
        raise ConfigurationError(_explained(kind, data, error.errors(), where)) from error
    return found.value


_WANTED = {
    "int_type": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "string_type": "a text",
    "tuple_type": "a list",
    "dataclass_type": "a mapping",
    "dict_type": "a mapping",
}
"""What to give, by pydantic's name of the error; its own words speak of Python and JSON."""


def _explained(kind: type[Any], data: Any, errors: Sequence[ErrorDetails], where: str) -> str:
    """The first thing that is wrong, in one line: where, what is wanted and what was found."""
    relevant = _of_the_kind_meant(errors)
    # All locations begin with the field of the model around.
    named = [(error, tuple(_names(data, error["loc"][1:]))) for error in relevant]
    (first, path), location = named[0], relevant[0]["loc"][1:]
    if first["type"] == "unexpected_keyword_argument":
        known = ", ".join(field.name for field in dataclasses.fields(_hint_at(kind, location[:-1])))
        return f"{'.'.join((where, *path[:-1]))}: unknown field {location[-1]!r}; known: {known}"
    place = ".".join((where, *path))
    if first["type"] == "missing":
        return f"{place}: {location[-1]} is missing"
    if first["type"] == "value_error":
        return f"{place}: {first.get('ctx', {})['error']}"
    # Where several types are allowed, each of them has an error.
    wanted = [_wanted(error) for error, other in named if other == path]
    if type(None) in typing.get_args(_hint_at(kind, location)):
        wanted.append("null")
    return f"{place}: give {' or '.join(dict.fromkeys(wanted))}, found {_short(first['input'])}"


def _wanted(error: ErrorDetails) -> str:
    return _WANTED.get(error["type"], error["msg"].removeprefix("Input should be "))


def _of_the_kind_meant(errors: Sequence[ErrorDetails]) -> Sequence[ErrorDetails]:
    """Without the errors of classes that could stand in a place but are of another ``kind`` than was given."""
    wrong_kinds = [error for error in errors if error["type"] == "literal_error" and error["loc"][-1] == KIND]
    # Where the kind of every class is wrong, nothing is left but that.
    others = [error["loc"][:-1] for error in wrong_kinds]
    return [error for error in errors if not any(error["loc"][: len(loc)] == loc for loc in others)] or wrong_kinds


def _names(data: Any, location: Sequence[str | int]) -> Iterator[str]:
    """A location as a person would write it. Pydantic's also names the member of a union that was tried."""
    for part in location:
        if isinstance(data, Mapping) and part in data:
            yield str(part)
            data = data[part]
        elif isinstance(data, list) and isinstance(part, int):
            yield str(part)
            data = data[part] if part < len(data) else None


def _hint_at(kind: Any, location: Sequence[str | int]) -> Any:
    """The type at a location; ``Any`` below a type that is neither a configuration nor a choice among several."""
    for part in location:
        # An entry of a list: all have one type.
        if isinstance(part, int):
            kind = next(iter(typing.get_args(kind)), Any)
            continue
        choices = typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,)
        classes = [choice for choice in choices if dataclasses.is_dataclass(choice)]
        # A member of a union has its name in the location, a field of a configuration its own.
        named = [choice for choice in choices if getattr(choice, "__name__", "") == part]
        below = typing.get_type_hints(classes[0])[str(part)] if classes and not named else Any
        kind = named[0] if named else below
    return kind
