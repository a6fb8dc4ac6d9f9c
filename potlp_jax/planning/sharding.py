"""Loops within ``jax.shard_map``: what a loop carries must be marked as different from device to device throughout."""

from typing import Any, TypeVar

import jax

_Values = TypeVar("_Values")


def vary_alike(values: _Values, *others: Any) -> _Values:
    """Arrays for the start of a loop, marked as varying over every axis of the mesh that any of them varies over.

    A loop within ``shard_map`` refuses a carry whose marks change, and a constant at its start has none. Outside of
    ``shard_map`` nothing varies and nothing happens.

    Args:
      values: a pytree of arrays.
      *others: what the loop's body reads besides.

    Returns:
      ``values``, with the same numbers.
    """
    axes = frozenset().union(*(_axes(leaf) for leaf in jax.tree.leaves((values, others))))

    def vary(leaf: jax.Array) -> jax.Array:
        missing = axes - _axes(leaf)
        return jax.lax.pcast(leaf, tuple(missing), to="varying") if missing else leaf

    return jax.tree.map(vary, values)


def _axes(leaf: jax.Array) -> frozenset[str]:
    return jax.typeof(leaf).manual_axis_type.varying
