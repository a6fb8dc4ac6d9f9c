"""Relations between the states of an automaton, as matrices: which state can lead to which."""

import jax.numpy as jnp
from jaxtyping import Array, Bool


def transitive_closure(leads: Bool[Array, "*B Z Z"]) -> Bool[Array, "*B Z Z"]:
    """``[z, z']``: any number of steps lead from z to z'. ``leads`` is reflexive: every state that counts keeps itself.

    Each round doubles the length of the ways that are known.
    """
    for _ in range(max(leads.shape[-1] - 1, 1).bit_length()):
        leads = jnp.any(leads[..., :, :, None] & leads[..., None, :, :], axis=-2)
    return leads
