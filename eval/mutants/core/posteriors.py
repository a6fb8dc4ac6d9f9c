"""Faults of the core: what buildings agree with what was seen."""

from eval.mutants.mutant import Mutant

PART = "who may be where"

_PEOPLE = "potlp_jax/environments/campus/people_posterior.py"
_TESTS = ("tests/test_people_posterior.py",)
_AS_OFTEN = "as_often_as_all_placements"

MUTANTS = (
    Mutant(
        PART,
        "somebody may be in a room that is dark",
        _PEOPLE,
        "jnp.where(fits & ~dark[plan.rooms][None], plan.prior, 0.0)",
        "jnp.where(fits, plan.prior, 0.0)",
        _TESTS,
        _AS_OFTEN,
    ),
    Mutant(
        PART,
        "somebody may be where they would have been met",
        _PEOPLE,
        "jnp.sum(has, dtype=jnp.int32)) & ~missed",
        "jnp.sum(has, dtype=jnp.int32))",
        _TESTS,
        _AS_OFTEN,
    ),
    Mutant(
        PART,
        "of two who share their rooms both may be in the same",
        _PEOPLE,
        "second = jnp.where(elsewhere & wanted, weights[other][None], 0.0)",
        "second = jnp.where(wanted, weights[other][None], 0.0)",
        _TESTS,
        "share_none",
    ),
    Mutant(
        PART,
        "a light that only one person can have turned on says nothing",
        _PEOPLE,
        "own = jnp.where(~jnp.any(theirs) | theirs[rooms], weights[person], 0.0)",
        "own = weights[person]",
        _TESTS,
        _AS_OFTEN,
    ),
    Mutant(
        PART,
        "of two who share their rooms neither need be in a room that one of them has lit",
        _PEOPLE,
        "jnp.where((left[at] == 1)[:, None, None], theirs[rooms][None], True)",
        "jnp.bool_(True)",
        _TESTS,
        _AS_OFTEN,
    ),
)
