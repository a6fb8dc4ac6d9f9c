"""Chances of subgoals side by side, which exclude each other, raised so that independence does them no harm."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float32

from potlp_jax.world.frontiers import Subgoals

SURE: float = 0.97
"""The most that the chances of subgoals side by side come to together."""


def exclusive_chances(chances: Float32[Array, "S C"], subgoals: Subgoals, within: float) -> Float32[Array, "S C"]:
    """P_S of subgoals side by side, raised so that, taken as independent, they fail together as rarely as they do.

    In fire-fighting buildings two frontiers within 16 cells of each other border the same place, and what is asked for
    is in one of its parts: both succeed in less than 1 % of the cases, and one of them does with about the sum of their
    chances (``eval.exclusion``). Eq. 3 takes attempts as independent. The logarithms of the chances to fail are scaled
    by a common factor, so that all subgoals ``within`` so many cells of one fail together with ``1 - sum``, at least
    ``1 - SURE``. With ``within`` 0 nothing is raised.

    Args:
        chances: P_S as the network answers it, in [0, 1].
        subgoals: where they are; masked ones neither raise others nor are raised.
        within: distance in cells between subgoals that exclude each other; static.

    Returns:
        P_S of the same shape, nowhere lower than ``chances``, but for chances of 1, which become 1 - 1e-6.
    """
    apart = subgoals.cells[:, None] - subgoals.cells[None, :]
    near = jnp.sum(apart**2, axis=2) <= math.floor(within**2)
    near = jnp.where(near & subgoals.mask[:, None] & subgoals.mask[None, :], 1.0, 0.0)
    # Logarithms of the chance to fail: a product over neighbours becomes a matrix product.
    # Kept off 1, where the logarithm is infinite.
    fails = jnp.log1p(-jnp.minimum(chances, jnp.float32(1.0 - 1e-6)))
    independent, together = near @ fails, jnp.log1p(-jnp.minimum(near @ chances, SURE))
    # Where no neighbour can succeed both logarithms are 0, and there is nothing to scale.
    factor = jnp.where(independent < 0.0, together / jnp.minimum(independent, -1e-12), 1.0)
    # Never below 1: subgoals that exclude each other do not make each other less likely.
    return -jnp.expm1(fails * jnp.maximum(factor, 1.0))
