"""Operations on batches of rows that the search needs, in the forms that XLA compiles well on CPU."""

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32, Int32, Shaped, UInt32

from potlp_jax.types import Status, status_if

_PerAction = TypeVar("_PerAction")


def pack_rows(rows: Any) -> UInt32[Array, "A n"]:
    """All that a pytree of per-action arrays says of an action, as one row of bits: one lookup instead of many."""
    # Floats and integers by their bits, flags as words: a bitcast keeps every value as it is.
    columns = []
    for leaf in jax.tree.leaves(rows):
        values = leaf.astype(jnp.uint32) if leaf.dtype == jnp.bool_ else leaf
        columns.append(jax.lax.bitcast_convert_type(values, jnp.uint32).reshape(leaf.shape[0], -1))
    return jnp.concatenate(columns, axis=1)


def unpack_rows(packed: UInt32[Array, "B n"], like: _PerAction) -> _PerAction:
    """Inverse of ``pack_rows`` for one action per batch entry; ``like`` is the batch of what was packed."""
    # Only shapes and types of `like` are used.
    leaves, structure = jax.tree.flatten(like)
    # In the order of `pack_rows`, which is that of the leaves.
    rows, start = [], 0
    for leaf in leaves:
        shape = leaf.shape[2:]
        size = math.prod(shape)
        bits = packed[:, start : start + size].reshape(-1, *shape)
        rows.append(bits != 0 if leaf.dtype == jnp.bool_ else jax.lax.bitcast_convert_type(bits, leaf.dtype))
        start += size
    return jax.tree.unflatten(structure, rows)


def uniform(seeds: UInt32[Array, "B 2"], simulation: Int32[Array, "B"], level: Int32[Array, ""]) -> Float32[Array, "B"]:
    """Uniform numbers in [0, 1) from a counter: 24 bits of a twice mixed hash of (seed, simulation, level).

    Args:
        seeds: of each row of the batch.
        simulation: its number, in each row.
        level: of the tree, the same in all rows.

    Returns:
        A number for each row; the same arguments give the same.
    """
    # Odd constants: at one level every simulation has a counter of its own.
    counter = simulation.astype(jnp.uint32) * jnp.uint32(0x9E3779B9) + level.astype(jnp.uint32) * jnp.uint32(0x85EBCA77)
    # Mixed twice, with the other half of the seed in between: nearby counters give unrelated bits.
    bits = mix(mix(seeds[:, 0] ^ counter) + seeds[:, 1])
    return (bits >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)


def mix(bits: UInt32[Array, "*N"]) -> UInt32[Array, "*N"]:
    """Finaliser of MurmurHash3: every input bit affects every output bit."""
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits ^ (bits >> 16)


def status_of_rows(flags: Bool[Array, "B"], status: Status) -> UInt32[Array, "B"]:
    return jax.vmap(lambda flag: status_if(flag, status))(flags)


def least_of_each(values: Shaped[Array, "B A"], worst: int | float) -> Shaped[Array, "B"]:
    """Minimum over actions; ``worst`` is not less than any value."""
    return jnp.min(_combine(jnp.minimum, values, worst), axis=1)


def first_of_least(score: Float32[Array, "B A"]) -> tuple[Int32[Array, "B"], Float32[Array, "B"]]:
    """The action of least score and that score; ties go to the lowest index.

    The minimum first, then the first index that attains it: faster on CPU than ``argmin``.
    """
    last = score.shape[1] - 1
    index = jnp.arange(last + 1, dtype=jnp.int32)[None, :]
    least = least_of_each(score, jnp.inf)
    return least_of_each(jnp.where(score <= least[:, None], index, last), last), least


def _combine(
    operation: Callable[[Array, Array], Array], values: Shaped[Array, "B A"], neutral: int | float
) -> Shaped[Array, "B w"]:
    """Reduce over actions up to a few columns, slice by slice: on CPU XLA vectorises that, but not whole rows."""
    # 8 columns for up to 128 actions, so that at most 16 slices are combined.
    width = 8 * max(1, -(-values.shape[1] // 128))
    count = -(-values.shape[1] // width)
    padded = jnp.pad(values, ((0, 0), (0, count * width - values.shape[1])), constant_values=neutral)
    return functools.reduce(operation, [padded[:, i * width : (i + 1) * width] for i in range(count)])
