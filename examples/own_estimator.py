"""An estimator of your own: what is asked for is likely to be beyond large frontiers.

    potlp run toy --policy potlp --estimator examples.own_estimator:by_size

An estimator answers P_S, R_S and R_F (Bradley et al. 2021, Eq. 3) of every subgoal and outcome class. It is a function,
or any pytree that can be called, and runs inside jit. The planner weighs its answers; it need not know of rooms.
"""

import jax.numpy as jnp

import potlp_jax

LARGE = 8.0
"""Cells of a frontier at which the chance is one half; a guess."""


def by_size(
    belief: potlp_jax.BeliefMap, subgoals: potlp_jax.Subgoals, task: potlp_jax.TaskArrays
) -> potlp_jax.Estimates:
    """The chance of success grows with the frontier, its cost with the unobserved part of the map."""
    size = subgoals.size.astype(jnp.float32)
    chance = size / (size + LARGE)
    # A side of the square that all unobserved cells would fill, in the unit of cost.
    hidden = jnp.sqrt(jnp.sum(belief.unknown).astype(jnp.float32)) * belief.resolution
    shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
    return potlp_jax.Estimates(
        success_probability=jnp.where(task.class_mask[None, :], jnp.broadcast_to(chance[:, None], shape), 0.0),
        success_cost=jnp.full(shape, 0.5) * hidden + belief.resolution,
        failure_cost=jnp.full(shape, 1.0) * hidden + belief.resolution,
    )


def main() -> None:
    """PO-TLP with these guesses, and what it thought at its first decision."""
    trial = potlp_jax.run("toy", policy="potlp", world=3, estimator=by_size)
    first = trial.decisions[0]
    chances = ", ".join(f"{action.success_probability:.2f}" for action in first.actions)
    print(f"{trial.outcome}, cost {trial.cost:.1f}; chances at the first decision: {chances}")


if __name__ == "__main__":
    main()
