"""Faults of the core: search."""

from eval.mutants.mutant import Mutant

PART = "search"

_BEST_FIRST = "potlp_jax/planning/search/best_first.py"
_GRAPH = "potlp_jax/planning/search/graph.py"
_UCT = "potlp_jax/planning/search/uct.py"
_CONVERGED = ("tests/test_search.py",)

MUTANTS = (
    Mutant(
        PART,
        "the backup passes values up as bounds",
        _BEST_FIRST,
        "low = step.base_bound + rounded_product(step.weight, bound)",
        "low = step.base_bound + rounded_product(step.weight, value)",
        _CONVERGED,
        "converges or pessimistic or consistent",
    ),
    Mutant(
        PART,
        "the backup ignores the other actions of a node",
        _BEST_FIRST,
        "jnp.minimum(step.rival, q_value), jnp.minimum(step.rival_bound, bound)",
        "q_value, bound",
        _CONVERGED,
        "converges or consistent",
    ),
    Mutant(
        PART,
        "selection ignores the pending cost",
        _BEST_FIRST,
        "score = bounds + jnp.where(inside, 0.0, descent.pending_cost[:, None])",
        "score = bounds",
        _CONVERGED,
        "converges or consistent or regret",
    ),
    Mutant(
        PART,
        "actions that stay inside are counted among those that leave",
        _BEST_FIRST,
        "        leave=jnp.where(step.inside, before.leave, least),\n"
        "        stay=jnp.where(step.inside, least, before.stay),",
        "        leave=jnp.where(step.inside, least, before.leave),\n"
        "        stay=jnp.where(step.inside, before.stay, least),",
        _CONVERGED,
        "converges or consistent",
    ),
    Mutant(
        PART,
        "a guess takes the satisfied task for a dead end",
        "potlp_jax/planning/search/guess.py",
        "after_success=jnp.where(rows.accepts, 0.0, dead_end_cost[:, None])",
        "after_success=jnp.broadcast_to(dead_end_cost[:, None], rows.accepts.shape)",
        _CONVERGED,
        "converges or wrong_guess or regret",
    ),
    Mutant(
        PART,
        "a satisfied root costs a dead end",
        "potlp_jax/planning/search/plan.py",
        "    value = jnp.where(accepted, 0.0, value)\n",
        "",
        _CONVERGED,
        "accepting_root",
    ),
    Mutant(
        PART,
        "bounds lie above the guesses",
        _BEST_FIRST,
        "optimistic = rounded_product(1.0 - context.optimism[:, None], guessed)",
        "optimistic = rounded_product(1.0 + context.optimism[:, None], guessed)",
        _CONVERGED,
        "converges or pessimistic or wrong_guess",
    ),
    Mutant(
        PART,
        "Eq. 3 weighs R_F by P_S",
        _BEST_FIRST,
        "    known += rounded_product(1.0 - chance, attempt.failure_cost)\n",
        "    known += rounded_product(chance, attempt.failure_cost)\n",
        _CONVERGED,
        "converges or consistent",
    ),
    Mutant(
        PART,
        "a dead end costs nothing",
        _GRAPH,
        "return jnp.where(jnp.isinf(best), dead_end_cost, best)",
        "return jnp.where(jnp.isinf(best), 0.0, best)",
        _CONVERGED,
        "converges or boxed_in",
    ),
    Mutant(
        PART,
        "arriving pays no pending cost",
        _GRAPH,
        "best = jnp.minimum(pending_cost + leave, stay)",
        "best = jnp.minimum(leave, stay)",
        _CONVERGED,
        "converges or consistent",
    ),
    Mutant(
        PART,
        "PO-UCT prefers what is expensive and well known (sign of the exploration term)",
        _UCT,
        "jnp.where(visits == 0, -jnp.inf, q_values - width)",
        "jnp.where(visits == 0, -jnp.inf, q_values + width)",
        ("tests/test_uct.py",),
        "literal or converges",
    ),
    Mutant(
        PART,
        "PO-UCT explores half as much as asked (its constant)",
        _UCT,
        "jnp.float32(exploration)",
        "jnp.float32(0.5 * exploration)",
        ("tests/test_uct.py",),
        "literal",
    ),
    Mutant(
        PART,
        "PO-UCT chooses the least visited action",
        _UCT,
        "jnp.inf, -tree.root_visits.astype(jnp.float32))",
        "jnp.inf, tree.root_visits.astype(jnp.float32))",
        ("tests/test_uct.py",),
        "literal or converges",
    ),
    Mutant(
        PART,
        "PO-UCT samples failures for successes",
        _UCT,
        "< tree.chances[rows, node, action]",
        ">= tree.chances[rows, node, action]",
        ("tests/test_uct.py",),
        "literal or converges",
    ),
    Mutant(
        PART,
        "PO-UCT takes an action that it has never tried to be the worst",
        _UCT,
        "jnp.where(visits == 0, -jnp.inf, q_values - width)",
        "jnp.where(visits == 0, jnp.inf, q_values - width)",
        ("tests/test_uct.py",),
        "tried_once or literal",
    ),
)
