"""Sums of products round alike in every program, fused or not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.planning.rounding import rounded_product

pytestmark = pytest.mark.optimised


def test_a_sum_of_products_rounds_every_step():
    """Compiled into one kernel, where a plain product would be contracted with the sum: as NumPy rounds it, step by
    step."""
    rng = np.random.default_rng(0)
    chance, first, second, known = (rng.uniform(0.0, 1.0, 4096).astype(np.float32) for _ in range(4))

    @jax.jit
    def expected(chance, first, second, known):
        return known + rounded_product(chance, first) + rounded_product(1.0 - chance, second)

    by_steps = known + chance * first + (np.float32(1.0) - chance) * second
    np.testing.assert_array_equal(expected(chance, first, second, known), by_steps)
    # One number alone and a batch are different programs.
    alone = [float(expected(*(values[i] for values in (chance, first, second, known)))) for i in range(8)]
    np.testing.assert_array_equal(np.asarray(alone, np.float32), by_steps[:8])


def test_what_is_infinite_stays_infinite():
    products = rounded_product(jnp.asarray([0.5, 0.0, 2.0]), jnp.asarray([jnp.inf, 3.0, 4.0]))
    np.testing.assert_array_equal(products, [np.inf, 0.0, 8.0])
