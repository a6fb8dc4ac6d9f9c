"""Seeds: which worlds are for calibrating, training, validating and testing, kept apart by construction.

Within a family, the key of a world is ``fold_in`` of the family's key with one 32-bit number whose high bits are the
split and whose low bits are the index. ``fold_in`` enciphers that number (Threefry) under the family's key, so it is
one-to-one: no two pairs (split, index) share a key.

Rule of the project: parameters of an environment are chosen on CALIBRATION; training, tuning and mending look at
TRAINING and VALIDATION; TEST is for the figures that are reported, and every run on it is logged. World ``N`` of the
command line is index ``N`` of VALIDATION unless another split is named.

Real buildings, from floor plans or from robots' maps, are test data: none is ever trained, tuned or validated on, and
``world_key`` refuses every other split for them (``usable_splits``). Only ``map:`` worlds, whose places their owner
chose, have all splits.

The key of a world makes only the world. What a trial draws comes from the trial's own key.
"""

import enum
import zlib

import jax
from jaxtyping import PRNGKeyArray

from potlp_jax.environments.families import FLOOR_PLAN_PREFIX, PARCELS_PREFIX
from potlp_jax.errors import WorldError
from potlp_jax.precision import in_32_bits

# The four highest bits number the split, which leaves space for sixteen.
_INDEX_BITS = 28
MAX_INDEX: int = 2**_INDEX_BITS - 1
"""Largest index of a world in a split."""

# Any number would do; another one would make other worlds, and published results would not be comparable.
_ROOT_SEED = 20210531


class Split(enum.StrEnum):
    """What the worlds of a split may be used for; the split's number in the keys is its place in this list."""

    CALIBRATION = "calibration"
    TRAINING = "training"
    VALIDATION = "validation"
    TEST = "test"

    @classmethod
    def _missing_(cls, value: object) -> "Split":
        raise WorldError(f"unknown split {value!r}; choose from: {', '.join(cls)}")


def usable_splits(family: str) -> tuple[Split, ...]:
    """The splits from which worlds of a family may be drawn."""
    # By name, because a family says so itself nowhere else that a command line could look up before it reads a map.
    return (Split.TEST,) if family.startswith((FLOOR_PLAN_PREFIX, PARCELS_PREFIX)) else tuple(Split)


def default_split(family: str) -> Split:
    """Where the command line draws worlds of a family from, unless told: VALIDATION, or TEST for real buildings."""
    return Split.VALIDATION if Split.VALIDATION in usable_splits(family) else Split.TEST


def check_split(split: Split, family: str) -> None:
    """Raises WorldError where worlds of the family must not be drawn from the split."""
    if split not in usable_splits(family):
        raise WorldError(
            f"{family}: real buildings are test data, and {split} worlds cannot be drawn from them; "
            f"use the split {Split.TEST}, and {Split.TRAINING} worlds of a generator (delivery, parcels, campus-medium)"
        )


@in_32_bits
def world_key(split: Split | str, index: int, family: str) -> PRNGKeyArray:
    """The key of a world.

    Args:
        split: what the world may be used for.
        index: number of the world in the split.
        family: name of the family (``Generator.name``).

    Returns:
        A typed key, of which ``Generator.generate`` makes the world.

    Raises:
        WorldError: where the index is negative or above ``MAX_INDEX``, there is no split of such a name, or worlds of
            the family must not be drawn from it.
    """
    check_split(Split(split), family)
    number = list(Split).index(Split(split))
    if not 0 <= index <= MAX_INDEX:
        raise WorldError(f"the index of a world must lie in 0..{MAX_INDEX}, found {index}")
    # The implementation is named, so that no setting of jax changes the worlds; CRC-32, because Python's own hash of a
    # text differs between processes.
    family_key = jax.random.fold_in(jax.random.key(_ROOT_SEED, impl="threefry2x32"), zlib.crc32(family.encode()))
    return jax.random.fold_in(family_key, number << _INDEX_BITS | index)
