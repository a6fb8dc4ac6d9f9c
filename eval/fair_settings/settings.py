"""What is tried: combinations of the frontier rule, the replanning distance and the commitment."""

import itertools
from collections.abc import Sequence
from typing import Any

from potlp_jax.planning.policies import Policy
from potlp_jax.trials.config import TrialConfig

SIZES: tuple[int, ...] = (1, 2, 4)
DISTANCES: tuple[float, ...] = (2.0, 4.0, 8.0)
COMMITMENTS: tuple[float, ...] = (0.0, 0.15, 0.3)
"""What is tried besides what the family's trials have by default."""

SEARCHING: tuple[str, ...] = (Policy.ORACLE, Policy.POTLP)
"""Policies of which commitment means anything."""

Setting = tuple[int, float, float]
"""Least component size, replanning distance and commitment."""


def setting_of(config: TrialConfig) -> Setting:
    """What is varied of a configuration."""
    return config.decision.frontiers.min_size, config.replan_distance, config.decision.commitment


def changes_of(setting: Setting) -> dict[str, Any]:
    """A setting as ``settings`` of a sweep's file."""
    size, distance, commitment = setting
    return {
        "replan_distance": distance,
        "decision": {"commitment": commitment, "frontiers": {"min_size": size}},
    }


def grid(
    policy: str, default: TrialConfig, sizes: Sequence[int], distances: Sequence[float], commitments: Sequence[float]
) -> list[Setting]:
    """Every combination for a policy, its default first.

    Args:
        policy: a name.
        default: what trials of the family have.
        sizes, distances, commitments: to try besides the default's; commitments only where the policy searches.

    Returns:
        The settings, each once.
    """
    own = setting_of(default)
    combined = itertools.product(
        sorted({own[0], *sizes}),
        sorted({own[1], *distances}),
        sorted({own[2], *(commitments if policy in SEARCHING else ())}),
    )
    return [own, *(setting for setting in combined if setting != own)]
