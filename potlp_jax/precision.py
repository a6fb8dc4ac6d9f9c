"""The library computes in 32 bits, also in a program that has ``jax_enable_x64`` on."""

import functools
from collections.abc import Callable, Generator, Iterator
from typing import Any, ParamSpec, TypeVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int32

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_NARROWER = {
    jnp.dtype("float64"): jnp.float32,
    jnp.dtype("int64"): jnp.int32,
    jnp.dtype("uint64"): jnp.uint32,
}


def in_32_bits(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """A public function that gives the same under ``jax_enable_x64`` as without it.

    With the switch on, integers and floats that are made within would have 64 bits, and loops would refuse a carry of
    two types. Its arguments' arrays of 64 bits are rounded to 32, and everything within is traced without the switch,
    functions of the caller's (a policy, an estimator) included. Without the switch it is the function as it is.

    Args:
      function: traceable or for the host; a generator that it returns is resumed without the switch too.

    Returns:
      The function, with the same signature.
    """

    @functools.wraps(function)
    def narrowed(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        if not _has_64_bits():
            return function(*args, **kwargs)
        with jax.enable_x64(False):
            args, kwargs = jax.tree.map(_narrow, (args, kwargs), is_leaf=_is_iterator)
            result = function(*args, **kwargs)
        return cast(_Result, _resumed_in_32_bits(result)) if isinstance(result, Generator) else result

    return narrowed


def narrow_type(kind: Any) -> jnp.dtype:
    """The type in which the library computes with an array of this one: 64 bits are rounded to 32."""
    return jnp.dtype(_NARROWER.get(jnp.dtype(kind), kind))


def whole_numbers(given: Any, what: str, error: type[Exception]) -> Int32[Array, "*shape"]:
    """Whole numbers of any type, Python's included, as the kernels take them. Raises ``error`` for other numbers."""
    array = jnp.asarray(given)
    if not jnp.issubdtype(array.dtype, jnp.integer):
        raise error(f"{what} has the type {array.dtype}: give whole numbers")
    return array.astype(jnp.int32)


def _resumed_in_32_bits(results: Generator[Any]) -> Iterator[Any]:
    # The switch is the caller's again whenever the generator waits.
    end = object()
    while (result := in_32_bits(next)(results, end)) is not end:
        yield result


def _has_64_bits() -> bool:
    return jnp.result_type(float) == jnp.float64


def _is_iterator(value: Any) -> bool:
    """Not looked into: jax will refuse iterators in a pytree."""
    return isinstance(value, Iterator)


def _narrow(leaf: Any) -> Any:
    """Arrays of 64 bits rounded; NumPy's are rounded where they become jax's."""
    return leaf.astype(_NARROWER[leaf.dtype]) if isinstance(leaf, jax.Array) and leaf.dtype in _NARROWER else leaf
