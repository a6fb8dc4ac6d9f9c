"""Planning problems for the tests: random ones over tasks of every kind, and a way to run many at once."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.task.task import Task, TaskSizes

FORMULAS = (
    "F g",
    "F a & F b",
    "(!f U e) & F f",
    "F(a & F(b & F a))",  # a success is used again
    "F(a & X b)",  # a cycle of live states
    "F(a & (b | c))",  # several cubes
    "F((a | b) & X(b | c))",  # several cubes and a cycle
    "(!c U (a | b)) & F(b | (c & a))",  # several cubes, accepting state 2 of 4
)
SIZES = TaskSizes(states=5, propositions=3, edges=6, classes=6, compound=2, cubes=2)
"""Room for every one of these formulas, so that one compilation serves all."""


@cache
def task_of(formula, max_positive_literals=None):
    return Task.from_formula(formula, max_positive_literals=max_positive_literals)


def random_fields(task, subgoals, seed, finish_chance=0.2, unreachable=0.3, backward=False):
    """The fields of a problem over the task's unpadded arrays, as NumPy arrays.

    Ways lead to states that the automaton can reach; with ``backward`` to any.
    """
    rng = np.random.default_rng(seed)
    states, classes = task.sizes.states, task.sizes.classes
    live = np.flatnonzero(~task.dfa.accepting & ~task.dfa.trap)

    def costs(shape, chance_of_none):
        values = rng.uniform(1.0, 60.0, shape)
        return np.where(rng.random(shape) < chance_of_none, np.inf, values)

    travel = costs((subgoals + 1, states, subgoals, states), unreachable)
    if not backward:
        travel[:, ~reachable_states(task)[:, None, :].repeat(subgoals, axis=1)] = np.inf
    return {
        "travel": travel,
        "finish": costs((subgoals + 1, states), 1.0 - finish_chance) * 4.0,
        "success_probability": rng.choice([0.0, 0.3, 0.5, 0.8, 1.0], (subgoals, classes), p=[0.1, 0.3, 0.3, 0.2, 0.1]),
        "success_cost": rng.uniform(1.0, 40.0, (subgoals, classes)),
        "failure_cost": rng.uniform(0.0, 40.0, (subgoals, classes)),
        "dfa_state": int(live[0] if rng.random() < 0.7 else rng.choice(live)),
        "subgoal_mask": np.ones(subgoals, bool),
        "dead_end_cost": 300.0,
    }


def reachable_states(task):
    """``[z, z']``: some word leads from z to z'."""
    states = task.sizes.states
    reach = np.eye(states, dtype=bool)
    for _ in range(states):
        for letter in range(task.dfa.transitions.shape[1]):
            reach |= reach[task.dfa.transitions[:, letter]]
    return reach


def problem_of(task, fields):
    return PlanningProblem.from_arrays(task.arrays, **fields)


def random_problem(formula, subgoals, seed, **options):
    task = task_of(formula)
    return problem_of(task, random_fields(task, subgoals, seed, **options))


def padded_problem(task, fields, sizes, subgoals):
    """The same problem in larger arrays; the padding holds values that would win if it were looked at."""
    real, states, classes = len(fields["subgoal_mask"]), task.sizes.states, task.sizes.classes
    padded = dict(fields)
    travel = np.full((subgoals + 1, sizes.states, subgoals, sizes.states), 0.5)
    finish = np.full((subgoals + 1, sizes.states), np.inf)
    nodes = [*range(real), subgoals]
    travel[np.ix_(nodes, range(states), range(real), range(states))] = fields["travel"]
    finish[np.ix_(nodes, range(states))] = fields["finish"]
    padded["travel"], padded["finish"] = travel, finish
    for name, fill in (("success_probability", 1.0), ("success_cost", 0.5), ("failure_cost", 0.0)):
        padded[name] = np.full((subgoals, sizes.classes), fill)
        padded[name][:real, :classes] = fields[name]
    padded["subgoal_mask"] = np.arange(subgoals) < real
    # A search reads no letters. Names of propositions are static, so with the same ones for all formulas their problems
    # can be stacked, and share a compilation.
    arrays = task.padded(sizes).replace(propositions=tuple(f"p{i}" for i in range(sizes.propositions)))
    return PlanningProblem.from_arrays(arrays, **padded)


def plan_many(problems, keys, config):
    """``plan_actions`` of problems of one shape, by vmap."""
    leaves = [jax.tree.leaves(problem) for problem in problems]
    structure = jax.tree.structure(problems[0])
    stacked = [jnp.stack(column) for column in zip(*leaves, strict=True)]

    def plan(key, *leaves):
        return plan_actions(jax.tree.unflatten(structure, leaves), key, config)

    return jax.jit(jax.vmap(plan))(keys, *stacked)
