"""Splits never share a world, and the keys are those that published results refer to."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import MAX_INDEX, Split, world_key
from potlp_jax.errors import ConfigurationError
from potlp_jax.trials.rules import trial_key
from potlp_jax.world.grid import world_digest

# Worlds that results were published on: a change of this value changes every world.
FIXED = (1142170752, 2515870191)
PLACES = st.tuples(st.sampled_from(list(Split)), st.integers(0, MAX_INDEX))


def words(split: Split | str, index: int, family: str = "toy") -> tuple[int, ...]:
    return tuple(np.asarray(jax.random.key_data(world_key(split, index, family))).tolist())


def test_no_two_worlds_of_a_family_share_a_key():
    keys = [words(split, index) for split in Split for index in (*range(200), MAX_INDEX - 1, MAX_INDEX)]
    assert len(set(keys)) == len(keys)


@settings(max_examples=50, deadline=None)
@given(PLACES, PLACES)
def test_keys_are_equal_only_where_places_are(one, other):
    assert (words(*one) == words(*other)) == (one == other)


def test_families_have_keys_of_their_own():
    assert words("test", 0, "toy") != words("test", 0, "firefighting")


def test_keys_are_typed_and_fixed():
    key = world_key("validation", 7, "firefighting")
    assert jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    assert words(Split.VALIDATION, 7, "firefighting") == words("validation", 7, "firefighting") == FIXED


@pytest.mark.parametrize("index", [-1, MAX_INDEX + 1])
def test_indices_that_would_reach_into_another_split_are_refused(index):
    with pytest.raises(ValueError, match="index of a world"):
        world_key("training", index, "toy")


def test_unknown_splits_are_refused():
    with pytest.raises(ValueError, match="holdout"):
        world_key("holdout", 0, "toy")


@pytest.mark.parametrize("family", ["toy", "rooms", "firefighting", "delivery", "parcels", "campus-small"])
def test_no_setting_of_jax_changes_a_world(family):
    generator = make(family)
    as_it_is = world_digest(generator.world(3))
    with jax.threefry_partitionable(False):
        assert world_digest(generator.world(3)) == as_it_is
    with jax.threefry_partitionable(True), jax.default_prng_impl("rbg"):
        assert world_digest(generator.world(3)) == as_it_is


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_seeds_that_would_be_others_are_refused(seed):
    with pytest.raises(ConfigurationError, match=r"give a whole number from 0 to 4294967295"):
        trial_key(0, seed)


def test_the_key_of_a_trial_is_the_same_under_every_setting_of_jax():
    expected = np.asarray(jax.random.key_data(trial_key(3, 2**32 - 1)))
    with jax.enable_x64(True), jax.default_prng_impl("rbg"):
        np.testing.assert_array_equal(jax.random.key_data(trial_key(3, 2**32 - 1)), expected)
