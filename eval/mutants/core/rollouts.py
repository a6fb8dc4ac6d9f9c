"""Faults of the core: what a rollout knows and costs."""

from eval.mutants.mutant import Mutant

PART = "what a rollout knows and costs"

_HISTORY = "potlp_jax/planning/history.py"
_PROBLEM = "potlp_jax/planning/problem.py"
_COMMITMENT = "potlp_jax/planning/commitment.py"
_SITUATION = "potlp_jax/planning/situation.py"
_ROLLOUTS = ("tests/test_history.py",)
_EXACT = ("tests/test_exact.py",)

MUTANTS = (
    Mutant(
        PART,
        "D is 0 at the same subgoal in whatever state",
        _HISTORY,
        "inside = (rows.subgoal == history.location) & (rows.from_state == history.state)\n    return",
        "inside = rows.subgoal == history.location\n    return",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "D leaves the pending cost out",
        _HISTORY,
        "jnp.where(inside, 0.0, path_cost + history.pending_cost)",
        "jnp.where(inside, 0.0, path_cost)",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "the way back after a failure costs R_S",
        _HISTORY,
        "pending_cost=jnp.where(success, success_cost, row.failure_cost)",
        "pending_cost=success_cost",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "the way back after a success costs R_F",
        _HISTORY,
        "pending_cost=jnp.where(success, success_cost, row.failure_cost)",
        "pending_cost=row.failure_cost",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "a success says nothing of weaker conditions",
        _HISTORY,
        "jnp.where(success, holds | row.forward, holds)",
        "jnp.where(success, holds | row.condition_bits, holds)",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "a failure says nothing of stronger conditions",
        _HISTORY,
        "jnp.where(success, fails, fails | row.backward)",
        "jnp.where(success, fails, fails | row.condition_bits)",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "failures are not closed over conditions of several cubes",
        _HISTORY,
        "    fails = _propagate_failures(tables, fails)\n",
        "",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "a condition of several cubes fails with one of them",
        _HISTORY,
        "failed = jnp.all(open_cubes == 0, axis=-1, keepdims=True)",
        "failed = jnp.any(jnp.expand_dims(tables.cubes[q], range(fails.ndim - 1)) & fails != 0, -1, keepdims=True)",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "of more than 32 conditions one word is taken for all",
        _HISTORY,
        "failed = jnp.all(open_cubes == 0, axis=-1, keepdims=True)",
        "failed = jnp.any(open_cubes == 0, axis=-1, keepdims=True)",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "a rollout may go round in circles",
        _HISTORY,
        "(probability > 0) & ~leads_back & live",
        "(probability > 0) & live",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "an accepting history has actions",
        _HISTORY,
        "(probability > 0) & ~leads_back & live",
        "(probability > 0) & ~leads_back",
        _ROLLOUTS + _EXACT,
    ),
    Mutant(
        PART,
        "what holds keeps its chance",
        _HISTORY,
        "    probability = jnp.where(certain, 1.0, probability)\n",
        "",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "what fails keeps its chance",
        _HISTORY,
        "jnp.where(failed, 0.0, rows.cube_probability[..., k])",
        "rows.cube_probability[..., k]",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "the rollout forgets where it has been when it learns nothing",
        _HISTORY,
        "visited=jnp.where(certain, history.visited | arrived, arrived)",
        "visited=arrived",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "the most expensive cube is tried first",
        _HISTORY,
        "order = jnp.argsort(cost, axis=-1, stable=True)",
        "order = jnp.argsort(-cost, axis=-1, stable=True)",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "R_F of several cubes is none of theirs",
        _HISTORY,
        "failure_cost = jnp.max(jnp.where(real,",
        "failure_cost = jnp.min(jnp.where(real,",
        _ROLLOUTS,
    ),
    Mutant(
        PART,
        "a satisfied task still has actions to list",
        _PROBLEM,
        "    return reachable & possible & real & ~task.accepting[state]",
        "    return reachable & possible & real",
        ("tests/test_problem.py",),
        "enumerate",
    ),
    Mutant(
        PART,
        "the robot is committed below what the search found, not above",
        _COMMITMENT,
        "(1.0 + commitment) * plan.value",
        "(1.0 - commitment) * plan.value",
        ("tests/test_commitment.py",),
    ),
    Mutant(
        PART,
        "the intention outlives a change of the automaton's state",
        _COMMITMENT,
        "acts & (intention.state == state) & jnp.any(same)",
        "acts & jnp.any(same)",
        ("tests/test_commitment.py",),
    ),
    Mutant(
        PART,
        "small chances: what pads the subgoals is a measure of the others",
        _SITUATION,
        "jnp.where(in_reach[:, None], chance, 0.0), axis=0",
        "chance, axis=0",
        ("tests/test_worthwhile.py",),
    ),
    Mutant(
        PART,
        "small chances: the best of all classes is the measure of each",
        _SITUATION,
        "chance, 0.0), axis=0, keepdims=True)",
        "chance, 0.0), keepdims=True)",
        ("tests/test_worthwhile.py",),
    ),
)
