"""The mutants: small faults of the core, each as one exchange of text, with the tests that must notice it."""

from dataclasses import dataclass

PLANNING, SEARCH, WORLD, DISTANCES, TASK, LEARNING, TRIALS, FLAGS, JUDGES = (
    "what a rollout knows and costs",
    "search",
    "sensing and frontiers",
    "distances",
    "tasks",
    "labels and loss",
    "trials",
    "status bits",
    "judges",
)
"""Parts of the core, in the order of the table."""


@dataclass(frozen=True)
class Mutant:
    """A fault and the tests that are to notice it.

    Attributes:
        part: of the core.
        says: the fault in words.
        file: in which it is made, from the root of the repository.
        old: text that occurs once in the file.
        new: what stands there in the mutant.
        tests: files of tests; narrow, so that a mutant costs seconds.
        only: names of tests, as ``pytest -k`` takes them; all of the files where it is empty.
    """

    part: str
    says: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    only: str = ""


_HISTORY = "potlp_jax/planning/history.py"
_PROBLEM = "potlp_jax/planning/problem.py"
_BEST_FIRST = "potlp_jax/planning/search/best_first.py"
_GRAPH = "potlp_jax/planning/search/graph.py"
_UCT = "potlp_jax/planning/search/uct.py"
_COMMITMENT = "potlp_jax/planning/commitment.py"
_SENSING = "potlp_jax/world/sensing.py"
_FRONTIERS = "potlp_jax/world/frontiers.py"
_MOVES = "potlp_jax/world/moves.py"
_PRODUCT = "potlp_jax/planning/distances/product.py"
_OUTCOMES = "potlp_jax/task/outcomes.py"
_LABELS = "potlp_jax/learning/labels.py"
_LOSS = "potlp_jax/learning/loss.py"
_RULES = "potlp_jax/trials/rules.py"
_AUDIT = "potlp_jax/verify/audit.py"

_ALONE = "not sweep and not command and not row"
"""Of the auditor's tests: those of one trial, which need no sweep."""

_ROLLOUTS = ("tests/test_history.py",)
_EXACT = ("tests/test_exact.py",)
_CONVERGED = ("tests/test_search.py",)

_PLANNING_MUTANTS = (
    Mutant(
        PLANNING,
        "D is 0 at the same subgoal in whatever state",
        _HISTORY,
        "inside = (rows.subgoal == history.location) & (rows.from_state == history.state)\n    return",
        "inside = rows.subgoal == history.location\n    return",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "D leaves the pending cost out",
        _HISTORY,
        "jnp.where(inside, 0.0, path_cost + history.pending_cost)",
        "jnp.where(inside, 0.0, path_cost)",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "the way back after a failure costs R_S",
        _HISTORY,
        "pending_cost=jnp.where(success, success_cost, row.failure_cost)",
        "pending_cost=success_cost",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "the way back after a success costs R_F",
        _HISTORY,
        "pending_cost=jnp.where(success, success_cost, row.failure_cost)",
        "pending_cost=row.failure_cost",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "a success says nothing of weaker conditions",
        _HISTORY,
        "jnp.where(success, holds | row.forward, holds)",
        "jnp.where(success, holds | row.condition_bits, holds)",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "a failure says nothing of stronger conditions",
        _HISTORY,
        "jnp.where(success, fails, fails | row.backward)",
        "jnp.where(success, fails, fails | row.condition_bits)",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "failures are not closed over conditions of several cubes",
        _HISTORY,
        "    fails = _propagate_failures(tables, fails)\n",
        "",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "a condition of several cubes fails with one of them",
        _HISTORY,
        "failed = jnp.all(open_cubes == 0, axis=-1, keepdims=True)",
        "failed = jnp.any(jnp.expand_dims(tables.cubes[q], range(fails.ndim - 1)) & fails != 0, -1, keepdims=True)",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "of more than 32 conditions one word is taken for all",
        _HISTORY,
        "failed = jnp.all(open_cubes == 0, axis=-1, keepdims=True)",
        "failed = jnp.any(open_cubes == 0, axis=-1, keepdims=True)",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "a rollout may go round in circles",
        _HISTORY,
        "(probability > 0) & ~leads_back & live",
        "(probability > 0) & live",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "an accepting history has actions",
        _HISTORY,
        "(probability > 0) & ~leads_back & live",
        "(probability > 0) & ~leads_back",
        _ROLLOUTS + _EXACT,
    ),
    Mutant(
        PLANNING,
        "what holds keeps its chance",
        _HISTORY,
        "    probability = jnp.where(certain, 1.0, probability)\n",
        "",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "what fails keeps its chance",
        _HISTORY,
        "jnp.where(failed, 0.0, rows.cube_probability[..., k])",
        "rows.cube_probability[..., k]",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "the rollout forgets where it has been when it learns nothing",
        _HISTORY,
        "visited=jnp.where(certain, history.visited | arrived, arrived)",
        "visited=arrived",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "the most expensive cube is tried first",
        _HISTORY,
        "order = jnp.argsort(cost, axis=-1, stable=True)",
        "order = jnp.argsort(-cost, axis=-1, stable=True)",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "R_F of several cubes is none of theirs",
        _HISTORY,
        "failure_cost = jnp.max(jnp.where(real,",
        "failure_cost = jnp.min(jnp.where(real,",
        _ROLLOUTS,
    ),
    Mutant(
        PLANNING,
        "a satisfied task still has actions to list",
        _PROBLEM,
        "    return reachable & possible & real & ~task.accepting[state]",
        "    return reachable & possible & real",
        ("tests/test_problem.py",),
        "enumerate",
    ),
    Mutant(
        PLANNING,
        "the robot is committed below what the search found, not above",
        _COMMITMENT,
        "(1.0 + commitment) * plan.value",
        "(1.0 - commitment) * plan.value",
        ("tests/test_commitment.py",),
    ),
    Mutant(
        PLANNING,
        "the intention outlives a change of the automaton's state",
        _COMMITMENT,
        "acts & (intention.state == state) & jnp.any(same)",
        "acts & jnp.any(same)",
        ("tests/test_commitment.py",),
    ),
)

_SEARCH_MUTANTS = (
    Mutant(
        SEARCH,
        "the backup passes values up as bounds",
        _BEST_FIRST,
        "low = step.base_bound + rounded_product(step.weight, bound)",
        "low = step.base_bound + rounded_product(step.weight, value)",
        _CONVERGED,
        "converges or pessimistic or consistent",
    ),
    Mutant(
        SEARCH,
        "the backup ignores the other actions of a node",
        _BEST_FIRST,
        "jnp.minimum(step.rival, q_value), jnp.minimum(step.rival_bound, bound)",
        "q_value, bound",
        _CONVERGED,
        "converges or consistent",
    ),
    Mutant(
        SEARCH,
        "selection ignores the pending cost",
        _BEST_FIRST,
        "score = bounds + jnp.where(inside, 0.0, descent.pending_cost[:, None])",
        "score = bounds",
        _CONVERGED,
        "converges or consistent or regret",
    ),
    Mutant(
        SEARCH,
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
        SEARCH,
        "a guess takes the satisfied task for a dead end",
        "potlp_jax/planning/search/guess.py",
        "after_success=jnp.where(rows.accepts, 0.0, dead_end_cost[:, None])",
        "after_success=jnp.broadcast_to(dead_end_cost[:, None], rows.accepts.shape)",
        _CONVERGED,
        "converges or wrong_guess or regret",
    ),
    Mutant(
        SEARCH,
        "a satisfied root costs a dead end",
        "potlp_jax/planning/search/plan.py",
        "    value = jnp.where(accepted, 0.0, value)\n",
        "",
        _CONVERGED,
        "accepting_root",
    ),
    Mutant(
        SEARCH,
        "bounds lie above the guesses",
        _BEST_FIRST,
        "optimistic = rounded_product(1.0 - context.optimism[:, None], guessed)",
        "optimistic = rounded_product(1.0 + context.optimism[:, None], guessed)",
        _CONVERGED,
        "converges or pessimistic or wrong_guess",
    ),
    Mutant(
        SEARCH,
        "Eq. 3 weighs R_F by P_S",
        _BEST_FIRST,
        "    known += rounded_product(1.0 - chance, attempt.failure_cost)\n",
        "    known += rounded_product(chance, attempt.failure_cost)\n",
        _CONVERGED,
        "converges or consistent",
    ),
    Mutant(
        SEARCH,
        "a dead end costs nothing",
        _GRAPH,
        "return jnp.where(jnp.isinf(best), dead_end_cost, best)",
        "return jnp.where(jnp.isinf(best), 0.0, best)",
        _CONVERGED,
        "converges or boxed_in",
    ),
    Mutant(
        SEARCH,
        "arriving pays no pending cost",
        _GRAPH,
        "best = jnp.minimum(pending_cost + leave, stay)",
        "best = jnp.minimum(leave, stay)",
        _CONVERGED,
        "converges or consistent",
    ),
    Mutant(
        SEARCH,
        "PO-UCT prefers what is expensive and well known (sign of the exploration term)",
        _UCT,
        "jnp.where(visits == 0, -jnp.inf, q_values - width)",
        "jnp.where(visits == 0, -jnp.inf, q_values + width)",
        ("tests/test_uct.py",),
        "literal or converges",
    ),
    Mutant(
        SEARCH,
        "PO-UCT explores half as much as asked (its constant)",
        _UCT,
        "jnp.float32(exploration)",
        "jnp.float32(0.5 * exploration)",
        ("tests/test_uct.py",),
        "literal",
    ),
    Mutant(
        SEARCH,
        "PO-UCT chooses the least visited action",
        _UCT,
        "jnp.inf, -tree.root_visits.astype(jnp.float32))",
        "jnp.inf, tree.root_visits.astype(jnp.float32))",
        ("tests/test_uct.py",),
        "literal or converges",
    ),
    Mutant(
        SEARCH,
        "PO-UCT samples failures for successes",
        _UCT,
        "< tree.chances[rows, node, action]",
        ">= tree.chances[rows, node, action]",
        ("tests/test_uct.py",),
        "literal or converges",
    ),
    Mutant(
        SEARCH,
        "PO-UCT takes an action that it has never tried to be the worst",
        _UCT,
        "jnp.where(visits == 0, -jnp.inf, q_values - width)",
        "jnp.where(visits == 0, jnp.inf, q_values - width)",
        ("tests/test_uct.py",),
        "tried_once or literal",
    ),
)

_WORLD_MUTANTS = (
    Mutant(
        WORLD,
        "the sensor sees a cell farther than its range",
        _SENSING,
        "in_range = (row**2 + column**2 <= range_cells**2)",
        "in_range = (row**2 + column**2 <= (range_cells + 1) ** 2)",
        ("tests/test_sensing.py",),
        "reference or euclidean",
    ),
    Mutant(
        WORLD,
        "lines of sight are rounded down",
        _SENSING,
        "minor = np.sign(aim) * ((2 * k * np.abs(aim) + half) // (2 * half))",
        "minor = np.sign(aim) * ((2 * k * np.abs(aim)) // (2 * half))",
        ("tests/test_sensing.py",),
        "reference",
    ),
    Mutant(
        WORLD,
        "a line is stopped by one obstacle beside a diagonal step",
        _SENSING,
        "(beside & above).astype(jnp.uint8)",
        "(beside | above).astype(jnp.uint8)",
        ("tests/test_sensing.py",),
        "reference",
    ),
    Mutant(
        WORLD,
        "walls beside visible floor are seen by lines alone",
        _SENSING,
        "return near | free_seen | (occupied & dilate(free_seen))",
        "return near | free_seen | (occupied & seen)",
        ("tests/test_sensing.py",),
        "reference or grazed",
    ),
    Mutant(
        WORLD,
        "an observation forgets the letters that were known",
        _SENSING,
        "letters=jnp.where(seen, world.letters, belief.letters)",
        "letters=jnp.where(seen, world.letters, 0)",
        ("tests/test_sensing.py",),
        "kept",
    ),
    Mutant(
        WORLD,
        "components of a frontier part at corners",
        _FRONTIERS,
        "for row, column in NEIGHBOURS], dtype=jnp.int32)",
        "for row, column in NEIGHBOURS if 0 in (row, column)], dtype=jnp.int32)",
        ("tests/test_frontiers.py",),
        "reference or corners",
    ),
    Mutant(
        WORLD,
        "a component of the least size counts as a sliver",
        _FRONTIERS,
        "kept = is_root & ((size[:-1] >= config.min_size) | ~some_large)",
        "kept = is_root & ((size[:-1] > config.min_size) | ~some_large)",
        ("tests/test_frontiers.py",),
        "reference or small",
    ),
    Mutant(
        WORLD,
        "the subgoal is not the cell nearest the centroid",
        _FRONTIERS,
        "return count * square - 2 * (",
        "return count * square - (",
        ("tests/test_frontiers.py",),
        "reference or centroid",
    ),
    Mutant(
        WORLD,
        "as many subgoals as fit are called too many",
        _FRONTIERS,
        "jnp.sum(kept, dtype=jnp.int32) > config.max_subgoals",
        "jnp.sum(kept, dtype=jnp.int32) >= config.max_subgoals",
        ("tests/test_frontiers.py",),
        "reference or flagged or order_is",
    ),
)

_DISTANCE_MUTANTS = (
    Mutant(
        DISTANCES,
        "a diagonal move costs 1",
        _MOVES,
        "1.0 if 0 in offset else DIAGONAL for offset",
        "1.0 for offset",
        ("tests/test_moves.py",),
    ),
    Mutant(
        DISTANCES,
        "a move cuts one kind of corner",
        _MOVES,
        "if free[there] and free[there[0], column] and free[row, there[1]]:",
        "if free[there] and free[there[0], column]:",
        ("tests/test_moves.py",),
    ),
    Mutant(
        DISTANCES,
        "falling and rising diagonals are exchanged",
        _MOVES,
        "    return falling, rising\n",
        "    return rising, falling\n",
        ("tests/test_moves.py", "tests/test_product.py"),
        "corners",
    ),
    Mutant(
        DISTANCES,
        "the cost to finish is in cells",
        _PRODUCT,
        "return travel * resolution, finish * resolution",
        "return travel * resolution, finish",
        ("tests/test_product.py",),
        "table_equals",
    ),
    Mutant(
        DISTANCES,
        "a letter that leads to a trap may be entered",
        _PRODUCT,
        "known_free[:, :, None] & ~task.trap[following]",
        "known_free[:, :, None]",
        ("tests/test_product.py",),
        "trap or equal_a_heap",
    ),
    Mutant(
        DISTANCES,
        "a diagonal step of a sweep costs 1",
        "potlp_jax/planning/distances/sweeping.py",
        "return jnp.where(blocked, jnp.inf, DIAGONAL).astype(jnp.float32)",
        "return jnp.where(blocked, jnp.inf, 1.0).astype(jnp.float32)",
        ("tests/test_product.py",),
        "equal_a_heap",
    ),
)

_TASK_MUTANTS = (
    Mutant(
        TASK,
        "the order of Σ does not matter",
        "potlp_jax/task/propositions.py",
        "    if tuple(asked) == tuple(known):\n",
        "    if sorted(asked) == sorted(known):\n",
        ("tests/test_propositions.py",),
        "refused",
    ),
    Mutant(
        TASK,
        "a world may have propositions that the task does not know",
        "potlp_jax/task/propositions.py",
        "    if tuple(asked) == tuple(known):\n",
        "    if tuple(asked) == tuple(known)[: len(asked)]:\n",
        ("tests/test_propositions.py",),
        "refused",
    ),
    Mutant(
        TASK,
        "bits of Σ are those of the automaton's own order",
        "potlp_jax/task/task.py",
        "bits = [propositions.index(name) for name in automaton.propositions]",
        "bits = list(range(len(automaton.propositions)))",
        ("tests/test_task.py", "tests/test_automaton.py"),
        "propositions",
    ),
    Mutant(
        TASK,
        "a state is satisfied that can still avoid acceptance",
        "potlp_jax/task/automaton.py",
        "            return ~_reaches(adjacency, avoiding)",
        "            return ~avoiding",
        ("tests/test_automaton.py",),
    ),
    Mutant(
        TASK,
        "a condition implies another only if its staying letters stay there too",
        _OUTCOMES,
        "implies[a] = go_within & ~(stay[a] & ~(stay | go)).any(axis=1)",
        "implies[a] = go_within & ~(stay[a] & ~stay).any(axis=1)",
        ("tests/test_outcomes.py",),
        "implications",
    ),
    Mutant(
        TASK,
        "a condition implies another whatever the letters on the way",
        _OUTCOMES,
        "implies[a] = go_within & ~(stay[a] & ~(stay | go)).any(axis=1)",
        "implies[a] = go_within",
        ("tests/test_outcomes.py",),
        "implications",
    ),
    Mutant(
        TASK,
        "there are actions that lead to a trap",
        _OUTCOMES,
        "            if target == source or dfa.trap[target]:\n",
        "            if target == source:\n",
        ("tests/test_outcomes.py",),
        "firefighting",
    ),
    Mutant(
        TASK,
        "cubes of a guard are not prime",
        "potlp_jax/task/guards.py",
        "cubes |= {(*cube, -1) for cube in primes(low) - both}",
        "cubes |= {(*cube, -1) for cube in primes(low)}",
        ("tests/test_outcomes.py",),
        "canonical_cover",
    ),
    Mutant(
        TASK,
        "classes of other staying letters are one",
        _OUTCOMES,
        "return [(self.phi_stay, cube, self.stay.tobytes()) for cube in self.cubes]",
        'return [(self.phi_stay, cube, b"") for cube in self.cubes]',
        ("tests/test_outcomes.py",),
        "equal_hulls",
    ),
    Mutant(
        TASK,
        "max_positive_literals drops cubes that need just so many",
        _OUTCOMES,
        "positive <= max_positive_literals",
        "positive < max_positive_literals",
        ("tests/test_outcomes.py",),
        "max_positive_literals_drops",
    ),
)

_LEARNING_MUTANTS = (
    Mutant(
        LEARNING,
        "R_S: a path may come back through its own frontier",
        _LABELS,
        "[:, :, None] & ~own\n",
        "[:, :, None]\n",
        ("tests/test_labels.py",),
    ),
    Mutant(
        LEARNING,
        "R_S: what was seen may be left for the unobserved again",
        _LABELS,
        "enter((~hidden & ~own, SEEN))",
        "enter((~own, SEEN))",
        ("tests/test_labels.py",),
    ),
    Mutant(
        LEARNING,
        "R_F: observed cells beyond count too",
        _LABELS,
        "enter((hidden, HIDDEN), (way_back, SEEN)),",
        "enter((hidden | way_back, HIDDEN)),",
        ("tests/test_labels.py",),
    ),
    Mutant(
        LEARNING,
        "R_F: the nearest cell",
        _LABELS,
        "failure_cost = jnp.max(jnp.where(jnp.isfinite(cost[HIDDEN]), cost[HIDDEN], 0.0), axis=(0, 1))",
        "failure_cost = jnp.min(jnp.where(jnp.isfinite(cost[HIDDEN]), cost[HIDDEN], jnp.inf), axis=(0, 1))",
        ("tests/test_labels.py",),
    ),
    Mutant(
        LEARNING,
        "loss: failures are pulled toward success",
        _LOSS,
        "taken = (1 - success) * of_failure * jax.nn.softplus(answers.success_logit)",
        "taken = (1 - success) * of_failure * jax.nn.softplus(-answers.success_logit)",
        ("tests/test_training.py",),
        "written_out",
    ),
    Mutant(
        LEARNING,
        "loss: weights are not scaled by their mean",
        _LOSS,
        "of_failure = weighting * jnp.where(batch.mask, batch.failure_weight, jnp.float32(0)) / mean + (1 - weighting)",
        "of_failure = weighting * jnp.where(batch.mask, batch.failure_weight, jnp.float32(0)) + (1 - weighting)",
        ("tests/test_training.py",),
        "written_out",
    ),
    Mutant(
        LEARNING,
        "loss: R_S is learned from failures too, and R_F from successes",
        _LOSS,
        "jnp.where(known, share * error**2, jnp.float32(0))",
        "jnp.where(known, error**2, jnp.float32(0))",
        ("tests/test_training.py",),
        "written_out or nan_gradient",
    ),
    Mutant(
        LEARNING,
        "loss: padding counts",
        _LOSS,
        "cross_entropy=jnp.sum(real * (missed + taken))",
        "cross_entropy=jnp.sum(missed + taken)",
        ("tests/test_training.py",),
        "written_out or nan_gradient",
    ),
)

_TRIAL_MUTANTS = (
    Mutant(
        TRIALS,
        "products are contracted with the sum that they are added to (rounding)",
        "potlp_jax/planning/rounding.py",
        "return jnp.abs(first * second)",
        "return first * second",
        ("tests/test_rounding.py",),
    ),
    Mutant(
        TRIALS,
        "the word begins with the second cell",
        _RULES,
        "state=task.transitions[task.initial, letter]",
        "state=task.initial",
        ("tests/test_trial.py",),
        "start_that",
    ),
    Mutant(
        TRIALS,
        "a proposition seen for the first time is no reason to decide",
        _RULES,
        "return replans | surprised | pointless",
        "return replans | pointless",
        ("tests/test_rules.py",),
    ),
    Mutant(
        TRIALS,
        "the robot goes on to a frontier that has nothing more to show",
        _RULES,
        "return replans | surprised | pointless",
        "return replans | surprised",
        ("tests/test_rules.py",),
    ),
    Mutant(
        TRIALS,
        "a map that has not changed is decided on again",
        _RULES,
        "replans = (now.cells > before.cells) & (travelled >= self.replan_distance)",
        "replans = travelled >= self.replan_distance",
        ("tests/test_rules.py",),
    ),
    Mutant(
        TRIALS,
        "visits are not counted anew on another map",
        _RULES,
        "jnp.where(known == tally.known, tally.visits, 0)",
        "tally.visits",
        ("tests/test_rules.py",),
    ),
    Mutant(
        TRIALS,
        "a trial that satisfied its task beyond its budget ends as budget",
        _RULES,
        "    outcome = jnp.where(tally.travelled >= budget(belief, config), _BUDGET, outcome)\n"
        "    outcome = jnp.where(task.trap[tally.state], _INFEASIBLE, outcome)\n"
        "    outcome = jnp.where(task.accepting[tally.state], _SATISFIED, outcome)\n",
        "    outcome = jnp.where(task.trap[tally.state], _INFEASIBLE, outcome)\n"
        "    outcome = jnp.where(task.accepting[tally.state], _SATISFIED, outcome)\n"
        "    outcome = jnp.where(tally.travelled >= budget(belief, config), _BUDGET, outcome)\n",
        ("tests/test_rules.py",),
    ),
    Mutant(
        TRIALS,
        "a path of a batch is written over its last cell",
        "potlp_jax/trials/slots.py",
        "cells[1:].astype(jnp.int16), (tally.steps + 1, 0))",
        "cells[1:].astype(jnp.int16), (tally.steps, 0))",
        ("tests/test_batch.py",),
        "alone",
    ),
    Mutant(
        TRIALS,
        "a planner without an action stays where it is (liveness)",
        "potlp_jax/planning/policies.py",
        "kind = jnp.where(falls_back, MoveKind.FALLBACK, jnp.where(acts, MoveKind.ACTION, MoveKind.NONE))",
        "kind = jnp.where(acts, MoveKind.ACTION, MoveKind.NONE)",
        ("tests/test_trial.py",),
        "lose_nothing or keep_their_promises",
    ),
)

_FLAG_MUTANTS = (
    Mutant(
        FLAGS,
        "a full tree of best-first search is not flagged",
        _BEST_FIRST,
        "status_of_rows(is_new & ~added, Status.TREE_OVERFLOW)",
        "status_of_rows(is_new & ~is_new, Status.TREE_OVERFLOW)",
        ("tests/test_search.py",),
        "flagged",
    ),
    Mutant(
        FLAGS,
        "a rollout of PO-UCT that was cut is not flagged",
        _UCT,
        "    overflow |= status_of_rows(rollout.active, Status.DEPTH_OVERFLOW)\n",
        "",
        ("tests/test_uct.py",),
        "flagged",
    ),
    Mutant(
        FLAGS,
        "an invalid problem is a dead end and nothing more",
        "potlp_jax/planning/search/lockstep.py",
        "status = jnp.where(invalid, status_array(Status.INVALID), plan.status)",
        "status = plan.status",
        ("tests/test_status.py",),
        "situation",
    ),
    Mutant(
        FLAGS,
        "a satisfied root counts as a dead end",
        "potlp_jax/planning/search/plan.py",
        "status_of_rows(~available & ~accepted, Status.DEAD_END)",
        "status_of_rows(~available, Status.DEAD_END)",
        ("tests/test_status.py",),
        "situation",
    ),
    Mutant(
        FLAGS,
        "the bit of a forgotten panorama is lost with the next one",
        "potlp_jax/learning/memory.py",
        "status=memory.status | status_if(needed[place], Status.VIEW_OVERFLOW)",
        "status=status_if(needed[place], Status.VIEW_OVERFLOW)",
        ("tests/test_memory.py",),
    ),
    Mutant(
        FLAGS,
        "a fallback is not flagged",
        "potlp_jax/planning/policies.py",
        "plan.status | status_if(kind == MoveKind.FALLBACK, Status.FALLBACK)",
        "plan.status",
        ("tests/test_status.py",),
        "situation",
    ),
    Mutant(
        FLAGS,
        "a move forgets what was cut off among the subgoals",
        "potlp_jax/planning/move.py",
        "bits | situation.status | status_if(~goes, Status.NO_FRONTIER)",
        "bits | status_if(~goes, Status.NO_FRONTIER)",
        ("tests/test_status.py",),
        "situation",
    ),
    Mutant(
        FLAGS,
        "a trial keeps the bits of its last decision alone",
        _RULES,
        "status=tally.status | move.status",
        "status=move.status",
        ("tests/test_status.py",),
        "stays",
    ),
)

_JUDGE_MUTANTS = (
    Mutant(
        JUDGES,
        "the auditor sees no violation",
        _AUDIT,
        "if len(word) > 1 and word_violates(formula, world.propositions, word):",
        "if False:",
        ("tests/test_audit.py",),
        _ALONE,
    ),
    Mutant(
        JUDGES,
        "the auditor believes any outcome",
        _AUDIT,
        "if word_satisfies(formula, world.propositions, word) != (outcome == Outcome.SATISFIED):",
        "if False:",
        ("tests/test_audit.py",),
        _ALONE,
    ),
    Mutant(
        JUDGES,
        "the auditor takes costs roughly",
        _AUDIT,
        "_TOLERANCE = 1e-9",
        "_TOLERANCE = 1e-1",
        ("tests/test_audit.py",),
        _ALONE,
    ),
    Mutant(
        JUDGES,
        "the auditor does not look where the path begins",
        _AUDIT,
        "if not cells or cells[0] != start:",
        "if not cells:",
        ("tests/test_audit.py",),
        _ALONE,
    ),
    Mutant(
        JUDGES,
        "the auditor lets unobserved cells be entered",
        _AUDIT,
        "_decision_differences(trial) + _entered_before_observed(trial)",
        "_decision_differences(trial)",
        ("tests/test_audit.py",),
        _ALONE,
    ),
)

MUTANTS: tuple[Mutant, ...] = (
    *_PLANNING_MUTANTS,
    *_SEARCH_MUTANTS,
    *_WORLD_MUTANTS,
    *_DISTANCE_MUTANTS,
    *_TASK_MUTANTS,
    *_LEARNING_MUTANTS,
    *_TRIAL_MUTANTS,
    *_FLAG_MUTANTS,
    *_JUDGE_MUTANTS,
)
