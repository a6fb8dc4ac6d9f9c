"""A problem from arrays of a caller's own: the toy's second task with three subgoals."""

import jax.numpy as jnp

import potlp_jax
from potlp_jax import PlanningProblem

TASK = potlp_jax.make("toy").task(2)
S, Z, C = 3, len(TASK.dfa.accepting), len(TASK.classes)


def problem(chances, library=jnp):
    """The problem where ``chances`` of shape ``[S, C]`` are P_S; its arrays are the library's, as wide as it makes
    them."""
    return PlanningProblem.from_arrays(
        TASK.arrays,
        travel=library.full((S + 1, Z, S, Z), 10.0),
        finish=library.full((S + 1, Z), library.inf),
        success_probability=chances,
        success_cost=library.full((S, C), 5.0),
        failure_cost=library.full((S, C), 20.0),
        dfa_state=library.asarray(TASK.dfa.initial),
        subgoal_mask=library.ones(S, bool),
        dead_end_cost=library.asarray(500.0),
    )


def plan(chances, key, config):
    """The plan for that problem."""
    return potlp_jax.plan_actions(problem(chances), key, config)
