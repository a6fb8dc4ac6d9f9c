"""By which fraction best-first search assumes its guesses to be too high, where its configuration names none."""

import jax.numpy as jnp
from jaxtyping import Array, Float32

from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.config import BestFirstConfig

OPTIMISM: float = 0.3
"""Optimism of problems of more than ``FEW_ACTIONS`` where the configuration names none. Tuned on the split ``tuning``
of the families of problems (docs/results/planner.md, "How optimistic?")."""

FEW_ACTIONS: int = 41
"""Actions up to which a problem counts as small: 8 subgoals with 5 attempts each, and finish. One wrong guess then ends
the search too early. Tuned as ``OPTIMISM``."""

OPTIMISM_OF_FEW: float = 0.7
"""Optimism of small problems. Tuned as ``OPTIMISM``: the mean regret over 12 rows of problems falls from 0.08 to 0.06 %
and the worst from 5.9 to 4.1 %."""


def optimism_of(problems: PlanningProblem, config: BestFirstConfig) -> Float32[Array, "B"]:
    """``BestFirstConfig.optimism`` of each problem; by its number of actions where the configuration names none.

    Args:
      problems: every leaf has the leading axis B.
      config: of the search.

    Returns:
      The fraction by which guesses are assumed to be too high.
    """
    # A Python value of the configuration is known when the search is compiled.
    subgoals = jnp.sum(problems.subgoal_mask, axis=1, dtype=jnp.int32)
    if config.optimism is not None:
        return jnp.full(subgoals.shape, config.optimism, jnp.float32)
    # Real actions, so that padding does not change the optimism.
    actions = subgoals * jnp.sum(problems.task.edge_mask, axis=1, dtype=jnp.int32) + 1
    return jnp.where(actions <= FEW_ACTIONS, OPTIMISM_OF_FEW, OPTIMISM).astype(jnp.float32)
