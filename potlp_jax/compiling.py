"""``jax.jit`` for functions that are given pytrees of callers' own classes: estimators, and what they remember.

jax compares the structures of two dataclasses (``flax.struct.dataclass`` among them) without their classes and without
the names of their fields: two estimators with as many fields look alike to it. Their hashes differ, but its caches look
at a part of a hash alone, so that about one pair in a hundred runs the program of the other class, and gets back an
object of that class (seen with jax 0.10.1 and 0.10.2).

``jax.lax.cond``, ``scan`` and ``while_loop``, and ``jax.eval_shape``, compare in the same way where they are given the
same function again. So what has callers' classes among its operands is given functions that are made anew, as all of
the package's are.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax

_Result = TypeVar("_Result")

_STRUCTURE = "structure_of_arguments"


def jit_by_class(
    function: Callable[..., _Result],
    *,
    static_argnames: tuple[str, ...] = (),
    donate_argnums: tuple[int, ...] = (),
) -> Callable[..., _Result]:
    """``jax.jit`` that never takes the program of one class of pytrees for that of another.

    Args:
      function: pure, of pytrees and of static arguments.
      static_argnames: as in ``jax.jit``.
      donate_argnums: as in ``jax.jit``.

    Returns:
      The compiled function, of the same arguments; ``_cache_size`` as ``jax.jit`` has it.
    """

    @functools.wraps(function)
    def told_apart(*args: Any, **kwargs: Any) -> _Result:
        # The structure is for the cache alone.
        kwargs.pop(_STRUCTURE)
        return function(*args, **kwargs)

    # jax looks for the names of static arguments in the signature.
    own = inspect.signature(function)
    structure = inspect.Parameter(_STRUCTURE, inspect.Parameter.KEYWORD_ONLY)
    cast(Any, told_apart).__signature__ = own.replace(parameters=[*own.parameters.values(), structure])
    names = (*static_argnames, _STRUCTURE)
    # More than its types tell: the size of its cache.
    compiled = cast(Any, jax.jit(told_apart, static_argnames=names, donate_argnums=donate_argnums))

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> _Result:
        # Of a structure the hash alone knows the classes.
        return compiled(*args, **kwargs, **{_STRUCTURE: hash(jax.tree.structure((args, kwargs)))})

    cast(Any, call)._cache_size = compiled._cache_size
    return call
