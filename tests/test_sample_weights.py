"""Weights of the loss against their definition, one pair at a time."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.learning.sample_weights import WeightBounds, loss_weights
from potlp_jax.planning.estimates import Estimates

BOUNDS = WeightBounds(low=2.0, high=50.0)


def _reference(distance, success, success_cost, failure_cost, mask, s, c):
    others = [distance[o] + success_cost[o][c] for o in range(len(distance)) if o != s and mask[o][c] and success[o][c]]
    missed = BOUNDS.low
    if success[s][c] and others:
        missed = min(max(min(others) - distance[s] - success_cost[s][c], BOUNDS.low), BOUNDS.high)
    elif success[s][c]:
        missed = BOUNDS.high
    return missed, min(max(2 * failure_cost[s][c], BOUNDS.low), BOUNDS.high)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.2, 0.7, 1.0]))
def test_weights_equal_the_reference(seed, share):
    rng = np.random.default_rng(seed)
    subgoals, classes = 4, 3
    distance = rng.uniform(0, 60, subgoals).astype(np.float32)
    success = rng.random((subgoals, classes)) < share
    success_cost = rng.uniform(1, 60, (subgoals, classes)).astype(np.float32)
    failure_cost = rng.uniform(0, 40, (subgoals, classes)).astype(np.float32)
    mask = (np.arange(subgoals) < rng.integers(1, 5))[:, None] & (np.arange(classes) < rng.integers(1, 4))[None, :]
    labels = Estimates(
        success_probability=jnp.asarray(success.astype(np.float32)),
        success_cost=jnp.asarray(success_cost),
        failure_cost=jnp.asarray(failure_cost),
    )
    # Padding may hold anything, also what cannot be reached.
    padded = np.where(mask[:, 0], distance, np.inf).astype(np.float32)
    weights = loss_weights(jnp.asarray(padded), labels, jnp.asarray(mask), BOUNDS)
    for s in range(subgoals):
        for c in range(classes):
            expected = (0.0, 0.0)
            if mask[s, c]:
                expected = _reference(distance, success, success_cost, failure_cost, mask, s, c)
            assert float(weights.success[s, c]) == pytest.approx(expected[0], rel=1e-4, abs=1e-4)
            assert float(weights.failure[s, c]) == pytest.approx(expected[1], rel=1e-4)


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (-1.0, 1.0), (2.0, 1.0), (1.0, float("inf"))])
def test_bounds_that_make_no_sense(bounds):
    with pytest.raises(ValueError, match="low <= high"):
        WeightBounds(*bounds)


def test_bounds_of_a_map_follow_its_size():
    assert WeightBounds.of_map(60, 40, 0.5) == WeightBounds(low=2.5, high=50.0)
