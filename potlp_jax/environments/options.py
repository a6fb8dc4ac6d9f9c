"""Environments that are named with options: ``PREFIX:PATH,option=value,...``."""

import re
from collections.abc import Mapping
from typing import Any

from potlp_jax.errors import MapError


def parse_options(
    spec: str, prefix: str, kind: str, options: Mapping[str, type[str] | type[float]], usage: str
) -> tuple[str, dict[str, Any]]:
    """The path (of a ``kind`` of file) and the values of the options that a name gives.

    Args:
        spec: the name.
        prefix: how names of this family begin.
        kind: what the path leads to, for messages.
        options: the type of each option.
        usage: ends every message.

    Returns:
        The path, and the values of the options that are given, by name.

    Raises:
        MapError: the text is not of that form, or an option is unknown, given twice, or no number where it must be.
    """
    # Names of files hold no comma, so the first one ends the path.
    path, *given = spec.removeprefix(prefix).split(",")
    if not spec.startswith(prefix) or not path:
        raise MapError(spec, "", f"names no {kind}; {usage}")
    values: dict[str, Any] = {}
    for text in given:
        # Only known options match: a path's own "=" would otherwise pass for one.
        match = re.fullmatch(rf"({'|'.join(options)})=(.+)", text)
        if match is None or match[1] in values:
            raise MapError(spec, text, f"is no option, or given twice; {usage}")
        try:
            values[match[1]] = options[match[1]](match[2])
        except ValueError as error:
            raise MapError(spec, match[1], f"{error}; {usage}") from error
    return path, values
