"""Arithmetic whose last bit does not depend on the program that it is compiled into.

XLA's CPU and GPU backends let the compiler contract ``a * b + c`` into one fused multiply-add, which rounds once
instead of twice. They do so where product and sum end up in the same kernel, and of two products that are added only
one is contracted. Which one, and where, changes with the size of the batch, with what the caller's program fuses, and
with the compiler's options. Then one search rounds a cost differently from a batch of searches. Everything else that
the search computes (sums, quotients, minima, products that nothing is added to) rounds as IEEE 754 says, in every
program.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float32


def rounded_product(first: Float32[Array, "..."], second: Float32[Array, "..."]) -> Float32[Array, "..."]:
    """The product of two arrays that are not negative, for use in a sum.

    Args:
      first: not negative.
      second: not negative; the shapes broadcast.

    Returns:
      ``first * second``, rounded before anything is added to it.
    """
    # The absolute value changes nothing, but a sum of it is no longer a multiply-add. `optimization_barrier` would not
    # do: it is gone before the code for the processor is made. Nor would `reduce_precision` to the same precision,
    # which XLA removes.
    return jnp.abs(first * second)
