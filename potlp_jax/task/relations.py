"""Relations between the states of an automaton, as matrices: which state can lead to which."""

import jax.numpy as jnp
from jaxtyping import Array, Bool


def transitive_closure(leads: Bool[Array, "*B Z Z"]) -> Bool[Array, "*B Z Z"]:
    """``[z, z']``: any number of steps lead from z to z'. ``leads`` must be reflexive on the states that count.

    Each round doubles the length of the chains that are known, so that ``log2(Z)`` rounds do.
    """
    # A fixed number of rounds on small boolean matrices: under jit and vmap cheaper than a loop with a test for change.
    for _ in range(max(leads.shape[-1] - 1, 1).bit_length()):
        leads = jnp.any(leads[..., :, :, None] & leads[..., None, :, :], axis=-2)
    return leads
