"""Extensions by name: ``module:attribute``, or the name of an entry point that an installed package declares.

Environments, policies, cameras and estimators of other packages are found here, each kind in an entry-point group of
its own. A name is resolved again in every process, so it means the same in the workers of a sweep.
"""

import functools
import hashlib
import importlib
import importlib.metadata
import inspect
import os
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from potlp_jax.errors import PluginError

# Groups of entry points, one for each kind of extension.
ENVIRONMENTS: str = "potlp_jax.environments"
POLICIES: str = "potlp_jax.policies"
CAMERAS: str = "potlp_jax.cameras"
ESTIMATORS: str = "potlp_jax.estimators"

_REFERENCE = re.compile(r"(?P<module>[^\W\d]\w*(\.[^\W\d]\w*)*):(?P<attribute>[^\W\d]\w*(\.[^\W\d]\w*)*)")


def is_reference(name: str) -> bool:
    """Whether the name has the form ``module:attribute``."""
    return _REFERENCE.fullmatch(name) is not None


def entry_points(group: str) -> tuple[str, ...]:
    """Names that installed packages declare in an entry-point group, sorted."""
    return tuple(sorted(importlib.metadata.entry_points(group=group).names))


def is_known(name: str, group: str) -> bool:
    """Whether the name can be an extension of this kind, and not, say, that of a file."""
    return is_reference(name) or name in entry_points(group)


def reference_of(found: Any) -> str:
    """``module:attribute`` of a function or class, or of the class of anything else: how records name it."""
    named = _named(found)
    return f"{named.__module__}:{named.__qualname__}"


def is_ours(found: Any) -> bool:
    """Whether a function, a class or the class of anything else is of this package, and known by its commit."""
    return reference_of(found).startswith("potlp_jax.")


def source_digest(found: Any) -> str | None:
    """Twelve hexadecimal digits of the file that defines a function or class, or the class of anything else.

    None where there is no file, as in a notebook.
    """
    try:
        file = inspect.getsourcefile(_named(found))
        return None if file is None else hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12]
    except (OSError, TypeError):
        return None


def _named(found: Any) -> Any:
    """What has a name and a file: the function within a ``partial``, or within what ``jax.jit`` makes of it."""
    while within := found.func if isinstance(found, functools.partial) else getattr(found, "__wrapped__", None):
        found = within
    return found if hasattr(found, "__qualname__") else type(found)


def load(name: str, *, group: str, kind: str, known: Iterable[str] = ()) -> Any:
    """The object that a name stands for.

    Args:
        name: ``module:attribute`` (attributes may be nested: ``module:Class.method``), or an entry point's name.
        group: the entry-point group of this kind of extension.
        kind: what is looked for, for messages: "environment", "policy".
        known: names that are no extensions, listed where ``name`` is unknown.

    Returns:
        Whatever it is; that it is of the right kind is for the caller to check.

    Raises:
        PluginError: nothing has this name, or what has it cannot be imported.
    """
    match = _REFERENCE.fullmatch(name)
    if match is not None:
        return _attribute(match["module"], match["attribute"], f"{kind} {name!r}")
    found = importlib.metadata.entry_points(group=group, name=name)
    for entry in found:
        if not entry.attr:
            raise PluginError(
                f"{kind} {name!r}: its entry point {entry.value!r} names no attribute: write module:attribute"
            )
        return _attribute(entry.module, entry.attr, f"{kind} {name!r} (entry point {entry.value!r})")
    choices = ", ".join([*known, *entry_points(group)])
    raise PluginError(f"unknown {kind} {name!r}; choose one of: {choices}; or write module:attribute")


def _attribute(module_name: str, attribute: str, what: str) -> Any:
    """``module.attribute``, with the current directory importable as under ``python -m``."""
    # A console script has its own folder in sys.path instead of the current directory.
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())
    try:
        found: Any = importlib.import_module(module_name)
    except Exception as error:
        # Whatever a foreign module raises on import, the user has to know which module, and why.
        raise PluginError(f"{what}: importing {module_name} failed: {type(error).__name__}: {error}") from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise PluginError(f"{what}: {module_name} has no attribute {attribute!r}")
        found = getattr(found, part)
    return found
