"""A policy of your own: go where the largest frontier is.

    potlp compare rooms --policies baseline,examples.own_policy:largest_frontier --trials 5

A policy is a pure function (``planning.policies.PolicyFunction``): it is compiled with the rest of the decision, and
runs in batches, so it branches with ``jnp.where``. A package that is installed may declare it as an entry point in the
group ``potlp_jax.policies``.
"""

import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

import potlp_jax
from potlp_jax.planning.commitment import Intention
from potlp_jax.planning.move import Move, MoveKind, move_to
from potlp_jax.planning.situation import Situation


def largest_frontier(
    situation: Situation,
    estimates: potlp_jax.Estimates | None,
    key: PRNGKeyArray,
    config: potlp_jax.DecisionConfig,
    intention: Intention,
) -> Move:
    """Finish in known space where that is possible, otherwise go to the frontier of the most cells."""
    del estimates, key, intention
    subgoals = situation.subgoals
    # Cost to each subgoal in each state of the automaton; inf where it cannot be reached without violation.
    costs = situation.distances[subgoals.cells[:, 0], subgoals.cells[:, 1]]
    reached = subgoals.mask & jnp.isfinite(jnp.min(costs, axis=1))
    largest = jnp.argmax(jnp.where(reached, subgoals.size, -1))
    finishes = jnp.isfinite(situation.finish_cost)
    kind = jnp.where(jnp.any(reached), MoveKind.FRONTIER, MoveKind.NONE)
    return move_to(
        situation,
        config,
        jnp.where(finishes, MoveKind.FINISH, kind),
        jnp.where(finishes, situation.finish_cell, subgoals.cells[largest]),
        jnp.where(finishes, situation.finish_state, jnp.argmin(costs[largest])).astype(jnp.int32),
        jnp.where(finishes, situation.finish_cost, jnp.min(costs[largest])),
    )


def main() -> None:
    """Beside the baseline, in the same worlds."""
    for policy in ("baseline", largest_frontier):
        costs = [potlp_jax.run("toy", policy=policy, world=number).cost for number in range(3)]
        name = policy if isinstance(policy, str) else policy.__name__
        print(f"{name}: {', '.join(f'{cost:.1f}' for cost in costs)}")


if __name__ == "__main__":
    main()
