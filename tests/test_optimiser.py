"""Numbers are tested in programs compiled as users' programs are; ``test_unoptimised.py`` has the others."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytestmark = pytest.mark.optimised


def contractions() -> int:
    """How many of 4096 sums with a product XLA rounds once instead of twice, as its optimiser alone does."""
    a, b, c = np.random.default_rng(0).uniform(0.0, 1.0, (3, 4096)).astype(np.float32)
    return int(np.sum(np.asarray(jax.jit(lambda a, b, c: a * b + c)(a, b, c)) != a * b + c))


def contractions_of_a_process() -> int:
    """The same in a process that a test starts."""
    code = "from tests.test_optimiser import contractions; print(contractions())"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ)
    return int(told.stdout)


def test_the_optimiser_is_on():
    assert contractions() > 100
    assert contractions_of_a_process() > 100


@pytest.mark.parametrize("rows", [32_769, 40_001])
def test_rows_times_a_matrix_and_reduced_are_right_in_every_row(rows):
    """jaxlib 0.10.2 computes the last rows wrong on CPUs, with and without the optimiser: why it is excluded
    (https://github.com/jax-ml/jax/issues/39103). The values are small integers, which float32 holds exactly."""
    vectors = (np.arange(3 * rows).reshape(rows, 3) % 7).astype(np.float32)
    matrix = np.arange(9).reshape(3, 3).astype(np.float32)

    @jax.jit
    def squares(vectors):
        return jax.vmap(lambda vector: jnp.sum((matrix @ vector) ** 2))(vectors)

    np.testing.assert_array_equal(squares(vectors), ((vectors @ matrix.T) ** 2).sum(axis=1))
