"""Which libraries of kernels there are, whether they can be used, and the choice between a kernel and its twin."""

import ctypes
import dataclasses
import functools
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.ffi

from potlp_jax.native.build import BuildError, built_library

SWITCH: str = "POTLP_NATIVE"
"""Environment variable that turns all native kernels off where it is 0; read once in a process."""

LIBRARIES: dict[str, tuple[str, ...]] = {
    "distances": ("product_distances", "distance_table"),
    "frontiers": ("find_components",),
    "labels": ("true_labels",),
    "paths": ("shortest_path",),
    "sensing": ("visible",),
    "square_ways": ("cheapest_ways",),
}
"""Handlers by library: the name of the source in ``kernels`` without ``.cc``, and the symbols that it defines."""

_Result = TypeVar("_Result")

# A program that was traced with native kernels is never taken for one without, because jax.jit knows of this context.
_twins = jax.make_user_context(False)


@dataclasses.dataclass(frozen=True)
class LibraryStatus:
    """Whether a library is used.

    Attributes:
      name: of the library.
      file: the shared library that was loaded; None where the twin is used.
      reason: why the twin is used; empty where it is not.
      seconds: that building and loading took.
    """

    name: str
    file: Path | None
    reason: str
    seconds: float


def status() -> list[LibraryStatus]:
    """Each library, with the reason where its twin is used. Builds what is not built yet."""
    return [_loaded(name) for name in LIBRARIES]


def is_usable(library: str) -> bool:
    """Whether programs that are traced now may call a library's kernels on CPU; built and loaded if need be."""
    return not _twins.value and _loaded(library).file is not None


def target(handler: str) -> str:
    """The name of a handler for ``jax.ffi.ffi_call``."""
    return f"potlp_{handler}"


def by_platform(library: str, native: Callable[..., _Result], twin: Callable[..., _Result], *arguments: Any) -> _Result:
    """The native function on CPU where its library can be used, otherwise its twin.

    Args:
      library: whose kernels ``native`` calls.
      native: traceable, of the arguments.
      twin: likewise, with results of the same shapes and types. Of a program for CPU alone it is no part.
      *arguments: pytrees of arrays.

    Returns:
      What either gives.
    """
    if not is_usable(library):
        return twin(*arguments)
    return jax.lax.platform_dependent(*arguments, cpu=native, default=twin)


def twin_only() -> AbstractContextManager[Any]:
    """Programs that are traced within hold no native kernel: they need JAX alone, and run on every machine."""
    return _twins(True)


@functools.cache
def _loaded(library: str) -> LibraryStatus:
    """Build and load a library and register its handlers; once in a process."""
    began = time.perf_counter()
    file, reason = None, ""
    if os.environ.get(SWITCH, "") == "0":
        reason = f"{SWITCH} is 0"
    else:
        try:
            file = built_library(library)
            _register(file, LIBRARIES[library])
        except (BuildError, OSError) as error:
            file, reason = None, str(error)
    return LibraryStatus(name=library, file=file, reason=reason, seconds=time.perf_counter() - began)


def _register(file: Path, handlers: tuple[str, ...]) -> None:
    loaded = ctypes.CDLL(str(file))
    for handler in handlers:
        capsule = jax.ffi.pycapsule(getattr(loaded, handler))
        jax.ffi.register_ffi_target(target(handler), capsule, platform="cpu")
