"""Environments that are named with options: ``PREFIX:PATH,option=value,...``."""

import re
from collections.abc import Sequence

from potlp_jax.environments.map_server import MapError


def parse_options(spec: str, prefix: str, kind: str, names: Sequence[str], usage: str) -> tuple[str, dict[str, str]]:
    """The path (of a ``kind`` of file) and the options of a name; ``usage`` ends every message.

    Raises:
        MapError: the text is not of that form, or an option is unknown or given twice.
    """
    path, *options = spec.removeprefix(prefix).split(",")
    if not spec.startswith(prefix) or not path:
        raise MapError(spec, "", f"names no {kind}; {usage}")
    values: dict[str, str] = {}
    for option in options:
        match = re.fullmatch(rf"({'|'.join(names)})=(.+)", option)
        if match is None or match[1] in values:
            raise MapError(spec, option, f"is no option, or given twice; {usage}")
        values[match[1]] = match[2]
    return path, values
