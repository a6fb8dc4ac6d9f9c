"""Which libraries of kernels there are, whether they can be used, and the choice between a kernel and its twin."""

import ctypes
import dataclasses
import functools
import os
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.ffi
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from potlp_jax.native.build import BuildError, NoCompilerError, built_library

SWITCH: str = "POTLP_NATIVE"
"""Environment variable that turns all native kernels off where it is 0; read once in a process."""

LIBRARIES: dict[str, tuple[str, ...]] = {
    "camera": ("obstacle_distances", "paint"),
    "distances": ("product_distances", "distance_table"),
    "frontiers": ("find_components", "label_components"),
    "labels": ("true_labels",),
    "paths": ("shortest_path",),
    "search": ("best_first",),
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
    leaves, structure = jax.tree.flatten(arguments)
    if any(jax.typeof(leaf).manual_axis_type.varying for leaf in leaves):
        return jax.lax.platform_dependent(*arguments, cpu=native, default=twin)
    structures = []

    def of_leaves(function: Callable[..., _Result]) -> Callable[..., list[jax.Array]]:
        def flat(*leaves: jax.Array) -> list[jax.Array]:
            results, kinds = jax.tree.flatten(function(*jax.tree.unflatten(structure, leaves)))
            structures.append(kinds)
            return results

        return flat

    # On leaves, because classes of arrays refuse shapes in their place.
    results = jax.eval_shape(of_leaves(native), *leaves)
    shapes = tuple((result.shape, result.dtype) for result in results)
    found = _choice.bind(*leaves, native=of_leaves(native), twin=of_leaves(twin), shapes=shapes)
    return jax.tree.unflatten(structures[0], found)


# A primitive and not `platform_dependent`, which traces both: the twins take seconds, and a program for CPU alone never
# needs them. Within `shard_map`, whose marks a primitive would have to know, both are traced.
_choice = Primitive("potlp_by_platform")
_choice.multiple_results = True


@_choice.def_impl
def _run(*leaves: jax.Array, **choice: Any) -> list[jax.Array]:
    # What is bound within ``jit`` would come back here.
    if jax.config.values["jax_disable_jit"]:
        return choice["native" if jax.default_backend() == "cpu" else "twin"](*leaves)
    return jax.jit(lambda *leaves: _choice.bind(*leaves, **choice))(*leaves)


@_choice.def_abstract_eval
def _shapes_of_results(*_leaves: Any, shapes: tuple[tuple[tuple[int, ...], Any], ...], **_choice: Any) -> list[Any]:
    return [ShapedArray(shape, dtype) for shape, dtype in shapes]


def _vectorise(leaves: Sequence[Any], axes: Sequence[Any], *, native: Any, twin: Any, shapes: Any) -> tuple[Any, Any]:
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)
    wider = tuple(((size, *shape), dtype) for shape, dtype in shapes)
    of_rows = [jax.vmap(function, in_axes=tuple(axes)) for function in (native, twin)]
    return _choice.bind(*leaves, native=of_rows[0], twin=of_rows[1], shapes=wider), [0] * len(wider)


def _no_derivative(*_: Any, **__: Any) -> Any:
    raise NotImplementedError(
        "the planner, its distances and its sensing choose among alternatives and have no derivatives: put "
        "jax.lax.stop_gradient around what goes in"
    )


@jax.custom_jvp
def without_derivative(array: jax.Array) -> jax.Array:
    """The array; who asks for a derivative by it is told that there is none."""
    return array


without_derivative.defjvp(_no_derivative)

batching.primitive_batchers[_choice] = _vectorise
ad.primitive_jvps[_choice] = _no_derivative
mlir.register_lowering(_choice, mlir.lower_fun(lambda *leaves, twin, **_: twin(*leaves), multiple_results=True))
mlir.register_lowering(
    _choice, mlir.lower_fun(lambda *leaves, native, **_: native(*leaves), multiple_results=True), platform="cpu"
)


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
        except NoCompilerError as error:
            reason = str(error)
        except (BuildError, OSError) as error:
            file, reason = None, str(error)
            warnings.warn(
                f"{library}: the native kernel cannot be used here, and its twin in JAX runs in its place, with the"
                f" same results, but slower; `python -m potlp_jax.native` shows all. {reason.partition(os.linesep)[0]}",
                stacklevel=2,
            )
    return LibraryStatus(name=library, file=file, reason=reason, seconds=time.perf_counter() - began)


def _register(file: Path, handlers: tuple[str, ...]) -> None:
    loaded = ctypes.CDLL(str(file))
    for handler in handlers:
        capsule = jax.ffi.pycapsule(getattr(loaded, handler))
        jax.ffi.register_ffi_target(target(handler), capsule, platform="cpu")
