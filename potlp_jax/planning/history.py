"""What a rollout knows, what follows from it, and what can still be done: the paper's b_h (section III-B).

Knowledge has three values (unknown, holds, fails) per subgoal and condition. Attempting an action closes its condition
at its subgoal; what follows is added at once:

* a condition implies every weaker one, so ``holds`` travels forward along the task's implications and ``fails``
  backward;
* a condition made of several cubes holds exactly if one of its cubes does.

The closure is complete: whatever is true in every assignment that agrees with what is known is itself known, so a
condition that is still unknown can turn out either way and no rollout ever contradicts itself. Every rule has at most
one negative literal, so unit propagation of failures decides entailment: a condition holds exactly if assuming that
it fails makes a condition fail that is known to hold. Without conditions of several cubes one round suffices.

Sets are bit masks in ``uint32`` words: a search carries them down the tree, and stores none.

References:
  Bradley et al., Learning and Planning for Temporally Extended Tasks in Unknown Environments, ICRA 2021, Eq. 3.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt32

from potlp_jax.planning.problem import PlanningProblem, take_rows
from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.sharding import vary_alike
from potlp_jax.types import NO_CLASS, NO_STATE

WORD_BITS: int = 32


@struct.dataclass(kw_only=True)
class History:
    """Summary of a rollout: all that later costs and choices depend on.

    Attributes:
      location: node of the problem: the subgoal beyond which the robot is, or S for the robot's own cell.
      state: automaton state.
      pending_cost: cost of the path back out of the unknown region, which the next action pays if it leaves it: R_S or
        R_F of the last action, by its outcome; 0 at the robot.
      holds: per subgoal, bit mask over conditions known to hold there.
      fails: per subgoal, bit mask over conditions known to fail there.
      visited: per node, bit mask over the states in which the rollout has been there since it last learnt something.

    ``M`` conditions take ``W = ceil(M / 32)`` words, ``Z`` states ``V = ceil(Z / 32)`` (at least one each); see
    ``pack_bits`` and ``unpack_bits``.
    """

    location: Int32[Array, "*B"]
    state: Int32[Array, "*B"]
    pending_cost: Float32[Array, "*B"]
    holds: UInt32[Array, "*B S W"]
    fails: UInt32[Array, "*B S W"]
    visited: UInt32[Array, "*B S1 V"]


@struct.dataclass(kw_only=True)
class ActionTerms:
    """The terms of Eq. 3 for every action of one history; the last action is finish (P_S = 1, R_S = R_F = 0).

    Attributes:
      distance: D, the pending cost included; inf where the action is not real or out of reach.
      success_probability: P_S given what is known.
      success_cost: R_S given what is known.
      failure_cost: R_F.
      certain: True where the action's condition is known to hold.
      available: True where the action can be taken. The other terms mean something only there.
    """

    distance: Float32[Array, "*B A"]
    success_probability: Float32[Array, "*B A"]
    success_cost: Float32[Array, "*B A"]
    failure_cost: Float32[Array, "*B A"]
    certain: Bool[Array, "*B A"]
    available: Bool[Array, "*B A"]


@struct.dataclass(kw_only=True)
class ActionRow:
    """What does not depend on the history, per action (leading axis or axes ``*A``).

    Attributes:
      subgoal: where the action is attempted; S for finish.
      from_state: state z' in which; ``NO_STATE`` for finish, and where the action is not real.
      to_state: state z'' after success; an accepting state for finish.
      accepts: True where success satisfies the task.
      cube_probability: P_S of the cubes of the action's condition, in order of R_S; 0 for padding.
      cube_cost: R_S of the cubes, in order; inf for padding.
      cube_bits: mask over conditions in which each cube's class is set; empty for padding.
      failure_cost: R_F.
      condition_bits: mask in which the action's condition is set; empty for finish.
      forward: mask of the conditions that the action's condition implies, itself included.
      backward: mask of the conditions that imply it, itself included.
      end_bits: mask over states in which ``to_state`` is set.
    """

    subgoal: Int32[Array, "*A"]
    from_state: Int32[Array, "*A"]
    to_state: Int32[Array, "*A"]
    accepts: Bool[Array, "*A"]
    cube_probability: Float32[Array, "*A K"]
    cube_cost: Float32[Array, "*A K"]
    cube_bits: UInt32[Array, "*A K W"]
    failure_cost: Float32[Array, "*A"]
    condition_bits: UInt32[Array, "*A W"]
    forward: UInt32[Array, "*A W"]
    backward: UInt32[Array, "*A W"]
    end_bits: UInt32[Array, "*A V"]


@struct.dataclass(kw_only=True)
class ActionTables:
    """A problem, rearranged by action for search.

    Attributes:
      actions: one row per action.
      distance: ``[u, z, a]``, path cost to action ``a`` from node ``u`` in state ``z``; inf where the action is not
        real or out of reach.
      accepting: True for real accepting states.
      backward: for each condition, mask of those that imply it.
      cubes: for each of the Q conditions of several cubes, which are the last Q of the M, mask of its cubes' classes.
      compound_mask: True where a condition of several cubes is real.
    """

    actions: ActionRow
    distance: Float32[Array, "*B S1 Z A"]
    accepting: Bool[Array, "*B Z"]
    backward: UInt32[Array, "*B M W"]
    cubes: UInt32[Array, "*B Q W"]
    compound_mask: Bool[Array, "*B Q"]


def pack_bits(flags: Bool[Array, "*N n"]) -> UInt32[Array, "*N w"]:
    """Flags along the last axis as 32-bit words, lowest bit first; at least one word."""
    # At least one word, so that no array is empty where a task has no conditions.
    words = max(1, -(-flags.shape[-1] // WORD_BITS))
    padding = [(0, 0)] * (flags.ndim - 1) + [(0, words * WORD_BITS - flags.shape[-1])]
    bits = jnp.pad(flags, padding).reshape(*flags.shape[:-1], words, WORD_BITS).astype(jnp.uint32)
    # A sum of distinct powers of two is the union of the bits.
    weights = jnp.asarray(np.uint32(1) << np.arange(WORD_BITS, dtype=np.uint32))
    return jnp.sum(bits * weights.reshape((1,) * (bits.ndim - 1) + (-1,)), axis=-1, dtype=jnp.uint32)


def unpack_bits(words: UInt32[Array, "*N w"], count: int) -> Bool[Array, "*N n"]:
    """Inverse of ``pack_bits``: the first ``count`` flags."""
    shifts = jnp.arange(WORD_BITS, dtype=jnp.uint32).reshape((1,) * words.ndim + (-1,))
    bits = (words[..., None] >> shifts) & jnp.uint32(1)
    return (bits != 0).reshape(*words.shape[:-1], -1)[..., :count]


def initial_history(problem: PlanningProblem) -> History:
    """At the robot, nothing known, nothing pending."""
    subgoals, states = problem.subgoal_count, problem.task.state_mask.shape[-1]
    words = max(1, -(-problem.task.condition_mask.shape[-1] // WORD_BITS))
    unknown = jnp.zeros((subgoals, words), jnp.uint32)
    # The robot's cell counts as visited in its state, so that no rollout ends where it began without having learnt.
    at_robot = jnp.arange(subgoals + 1)[:, None] == subgoals
    return History(
        location=jnp.int32(subgoals),
        state=problem.dfa_state,
        pending_cost=jnp.float32(0.0),
        holds=unknown,
        fails=unknown,
        visited=pack_bits(at_robot & (jnp.arange(states) == problem.dfa_state)[None, :]),
    )


def action_terms(problem: PlanningProblem, history: History) -> ActionTerms:
    """D, P_S, R_S, R_F of every action given the history, and whether it is available.

    An action is available where it is real and can be reached, its P_S is not 0, and it does not merely lead back:
    one whose condition is known to hold and that ends where the rollout has been since it last learnt something is
    not. An accepting history has no actions. A condition that holds has P_S = 1, also where the estimates say that
    none of its cubes can succeed; its R_S is then that of the cheapest cube not known to fail.

    Callers with many histories of one problem make ``action_tables`` once and call ``terms_of_all``.
    """
    return terms_of_all(action_tables(problem), history)


def step(problem: PlanningProblem, history: History, action: Int32[Array, ""], success: Bool[Array, ""]) -> History:
    """The history after an action.

    Args:
      problem: unbatched.
      history: before the action.
      action: index of an available action; finish always succeeds.
      success: its outcome.

    Returns:
      The history after it.
    """
    # For one step at a time; a search keeps the tables.
    tables = action_tables(problem)
    row = jax.tree.map(lambda leaf: leaf[action], tables.actions)
    return step_row(tables, row, history, success)


def action_tables(problem: PlanningProblem) -> ActionTables:
    """Rearrange an unbatched problem by action: the axis that every step of a search runs along comes last."""
    task, subgoals, edges = problem.task, problem.subgoal_count, problem.edge_count
    states, classes = task.state_mask.shape[-1], task.class_mask.shape[-1]
    condition_bits = pack_bits(jnp.eye(task.condition_mask.shape[-1], dtype=jnp.bool_))
    cubes = jnp.any(
        task.condition_classes[:, :, None] == jnp.arange(condition_bits.shape[0], dtype=jnp.int32)[None, None, :],
        axis=1,
    )
    real = problem.subgoal_mask[:, None] & task.edge_mask[None, :]
    # An action is reached in the state z' in which its edge begins.
    travel = jnp.where(real[None, None], problem.travel[..., task.edges[:, 0]], jnp.inf)
    return ActionTables(
        actions=_action_rows(problem, condition_bits),
        distance=_with_finish(travel.reshape(subgoals + 1, states, subgoals * edges), problem.finish),
        accepting=task.accepting & task.state_mask,
        backward=pack_bits(task.implies.T),
        cubes=pack_bits(cubes)[classes:],
        compound_mask=task.condition_mask[classes:],
    )


def terms_of_all(tables: ActionTables, history: History) -> ActionTerms:
    """``action_terms`` from the tables of the problem."""
    rows = tables.actions
    holds, fails, visited = (
        _per_action(words, rows.subgoal.shape[0]) for words in (history.holds, history.fails, history.visited[:-1])
    )
    probability, success_cost, certain = knowledge_terms(rows, holds, fails)
    # A rollout that repeats what it knows, and ends where it has been, would go round in circles for ever.
    distance = distance_of(rows, history, tables.distance[history.location, history.state])
    leads_back = certain & _overlaps(visited, rows.end_bits)
    live = ~tables.accepting[history.state]
    return ActionTerms(
        distance=distance,
        success_probability=probability,
        success_cost=success_cost,
        failure_cost=rows.failure_cost,
        certain=certain,
        available=jnp.isfinite(distance) & (probability > 0) & ~leads_back & live,
    )


def distance_of(rows: ActionRow, history: History, path_cost: Float32[Array, "*A"]) -> Float32[Array, "*A"]:
    """D (docs/model.md section 5).

    Args:
      rows: of the actions.
      history: before the actions.
      path_cost: to each action, from where the history is.

    Returns:
      Path cost and pending cost; 0 for going on beyond the same subgoal in the same state.
    """
    inside = (rows.subgoal == history.location) & (rows.from_state == history.state)
    return jnp.where(inside, 0.0, path_cost + history.pending_cost)


def knowledge_terms(
    rows: ActionRow, holds: UInt32[Array, "*A W"], fails: UInt32[Array, "*A W"]
) -> tuple[Float32[Array, "*A"], Float32[Array, "*A"], Bool[Array, "*A"]]:
    """P_S, R_S and whether the condition is known to hold, from the masks of each action's own subgoal.

    Cubes are tried in order of R_S (docs/model.md section 3): P = 1 - Π(1 - P_i), R_S = Σ R_i P_i Π_{j<i}(1 - P_j) / P,
    with P_i = 1 or 0 where cube i is known.

    Args:
      rows: of the actions.
      holds: conditions known to hold, of each action's own subgoal.
      fails: conditions known to fail there.

    Returns:
      P_S, R_S (0 where nothing can succeed), and True where the condition is known to hold.
    """
    certain = _overlaps(holds, rows.condition_bits)
    probability = jnp.zeros(certain.shape, jnp.float32)
    cost = jnp.full(certain.shape, jnp.inf, jnp.float32)
    # Few cubes, unrolled: the recurrence holds P and R_S of the cubes so far.
    for k in range(rows.cube_cost.shape[-1]):
        bits, cube_cost = rows.cube_bits[..., k, :], rows.cube_cost[..., k]
        failed = _overlaps(fails, bits)
        chance = jnp.where(_overlaps(holds, bits), 1.0, jnp.where(failed, 0.0, rows.cube_probability[..., k]))
        share = rounded_product(1.0 - probability, chance)
        total = probability + share
        mean = rounded_product(cost, probability) + rounded_product(cube_cost, share)
        mean = mean / jnp.where(total > 0, total, 1.0)
        # The first cube that can succeed is taken as it is, so that padding does not change a result by rounding.
        first = (probability == 0) & ((chance > 0) | (jnp.isinf(cost) & ~failed))
        cost = jnp.where(first, cube_cost, jnp.where(share > 0, mean, cost))
        probability = jnp.where(first, chance, total)
    # A condition may be known to hold before it is known which of its cubes does. One that fails needs no such case:
    # each of its cubes implies it, so that all of them are known to fail.
    probability = jnp.where(certain, 1.0, probability)
    return probability, jnp.where(jnp.isinf(cost), 0.0, cost), certain


def knowledge_of(subgoal: Int32[Array, ""], history: History) -> tuple[UInt32[Array, "W"], UInt32[Array, "W"]]:
    """What holds and what fails at one subgoal; nothing is known at the robot's node."""
    # Selected, not indexed: S, the robot's node, has no row, and an index of S would read the last subgoal's.
    here = jnp.arange(history.holds.shape[0], dtype=jnp.int32)[:, None] == subgoal
    return _or_rows(jnp.where(here, history.holds, 0)), _or_rows(jnp.where(here, history.fails, 0))


def step_row(tables: ActionTables, row: ActionRow, history: History, success: Bool[Array, ""]) -> History:
    """``step`` from the action's row of the tables.

    Args:
      tables: of the problem.
      row: of the action.
      history: before the action.
      success: its outcome.

    Returns:
      The history after it.
    """
    subgoals = history.holds.shape[0]
    here = jnp.arange(subgoals, dtype=jnp.int32)[:, None] == row.subgoal
    holds, fails = knowledge_of(row.subgoal, history)
    _, success_cost, certain = knowledge_terms(row, holds, fails)
    holds, fails = add_outcome(tables, row, holds, fails, success)
    state = jnp.where(success, row.to_state, row.from_state)
    nodes = jnp.arange(subgoals + 1, dtype=jnp.int32)[:, None]
    # Having learnt something, the rollout may go anywhere again.
    arrived = jnp.where(nodes == row.subgoal, _single_bit(state, history.visited.shape[-1])[None, :], jnp.uint32(0))
    return History(
        location=row.subgoal,
        state=state,
        pending_cost=jnp.where(success, success_cost, row.failure_cost),
        holds=jnp.where(here, holds[None, :], history.holds),
        fails=jnp.where(here, fails[None, :], history.fails),
        visited=jnp.where(certain, history.visited | arrived, arrived),
    )


def add_outcome(
    tables: ActionTables,
    row: ActionRow,
    holds: UInt32[Array, "W"],
    fails: UInt32[Array, "W"],
    success: Bool[Array, ""],
) -> tuple[UInt32[Array, "W"], UInt32[Array, "W"]]:
    """Knowledge about one subgoal after an outcome there, closed under what follows.

    Args:
      tables: of the problem.
      row: of the action.
      holds: conditions known to hold at its subgoal before.
      fails: conditions known to fail there before.
      success: the outcome.

    Returns:
      The masks after it.
    """
    # Implications alone are closed by one step, because `implies` is transitive.
    holds = jnp.where(success, holds | row.forward, holds)
    fails = jnp.where(success, fails, fails | row.backward)
    if tables.cubes.shape[0] == 0:
        return holds, fails
    fails = _propagate_failures(tables, fails)
    # A condition holds if its failure would refute what is known to hold. One row per assumed failure.
    refuted = _propagate_failures(tables, fails[None, :] | tables.backward)
    return pack_bits(_overlaps(refuted, jnp.broadcast_to(holds, refuted.shape))), fails


def _propagate_failures(tables: ActionTables, fails: UInt32[Array, "*N W"]) -> UInt32[Array, "*N W"]:
    """Close failures: all cubes of a condition fail, so it fails, and so does what implies it.

    Every round but the last fails one more condition of several cubes, so their number bounds the rounds.
    """
    # Conditions of several cubes are the last ones.
    count = tables.cubes.shape[0]
    backward = tables.backward[-count:]

    def close_once(_, fails):
        for q in range(count):
            # The condition fails once no cube remains open.
            open_cubes = tables.cubes[q].reshape((1,) * (fails.ndim - 1) + (-1,)) & ~fails
            failed = jnp.all(open_cubes == 0, axis=-1, keepdims=True) & tables.compound_mask[q]
            implying = backward[q].reshape((1,) * (fails.ndim - 1) + (-1,))
            fails = fails | jnp.where(failed, implying, jnp.uint32(0))
        return fails

    return jax.lax.fori_loop(0, count, close_once, vary_alike(fails, tables))


def _action_rows(problem: PlanningProblem, condition_bits: UInt32[Array, "M W"]) -> ActionRow:
    task, subgoals, edges = problem.task, problem.subgoal_count, problem.edge_count
    states = task.state_mask.shape[-1]
    classes = take_rows(task.condition_classes, task.edge_condition)
    # By subgoal, edge and cube. Padding has P_S = 0 and R_S = inf, so that it is sorted last and never counts.
    real = jnp.broadcast_to(classes[None] != NO_CLASS, (subgoals, *classes.shape))
    probability = jnp.where(real, _by_subgoal(problem.success_probability, classes), 0.0)
    cost = jnp.where(real, _by_subgoal(problem.success_cost, classes), jnp.inf)
    failure_cost = jnp.max(jnp.where(real, _by_subgoal(problem.failure_cost, classes), 0.0), axis=-1, initial=0.0)
    # Stable, so that cubes of equal cost keep the task's order and padding (inf) stays last.
    order = jnp.argsort(cost, axis=-1, stable=True)
    probability, cost = (jnp.take_along_axis(values, order, axis=-1) for values in (probability, cost))
    sorted_classes = jnp.take_along_axis(jnp.broadcast_to(classes[None], real.shape), order, axis=-1)
    cube_bits = jnp.where((sorted_classes != NO_CLASS)[..., None], take_rows(condition_bits, sorted_classes), 0)
    backward, forward = pack_bits(task.implies.T), pack_bits(task.implies)
    states_of_edges = task.edges.T.astype(jnp.int32)

    def by_edge(values: Array, finish: Array) -> Array:
        """One row per edge becomes one row per action."""
        repeated = jnp.broadcast_to(values[None], (subgoals, *values.shape))
        return _with_finish_row(repeated.reshape(subgoals * edges, *values.shape[1:]), finish)

    def by_action(values: Array, finish: Array) -> Array:
        return _with_finish_row(values.reshape(subgoals * edges, *values.shape[2:]), finish)

    cubes, words = cost.shape[-1], condition_bits.shape[-1]
    # Finish: one cube that always succeeds at no cost, and no condition, so that nothing is learnt from it.
    no_bits = jnp.zeros((words,), jnp.uint32)
    accepting_state = jnp.argmax(task.accepting & task.state_mask).astype(jnp.int32)
    finish_cubes = jnp.arange(cubes) == 0
    to_state = by_edge(states_of_edges[1], accepting_state)
    real_action = problem.subgoal_mask[:, None] & task.edge_mask[None, :]
    # An action that is not real is attempted nowhere.
    from_state = jnp.where(real_action, states_of_edges[0][None], NO_STATE)
    node = jnp.broadcast_to(jnp.arange(subgoals, dtype=jnp.int32)[:, None], (subgoals, edges))
    return ActionRow(
        subgoal=by_action(node, jnp.int32(subgoals)),
        from_state=by_action(from_state, jnp.int32(NO_STATE)),
        to_state=to_state,
        accepts=(task.accepting & task.state_mask)[to_state],
        cube_probability=by_action(probability, finish_cubes.astype(jnp.float32)),
        cube_cost=by_action(cost, jnp.where(finish_cubes, 0.0, jnp.inf)),
        cube_bits=by_action(cube_bits, jnp.zeros((cubes, words), jnp.uint32)),
        failure_cost=by_action(failure_cost, jnp.float32(0.0)),
        condition_bits=by_edge(take_rows(condition_bits, task.edge_condition), no_bits),
        forward=by_edge(take_rows(forward, task.edge_condition), no_bits),
        backward=by_edge(take_rows(backward, task.edge_condition), no_bits),
        end_bits=_single_bit(to_state, max(1, -(-states // WORD_BITS))),
    )


def _by_subgoal(values: Float32[Array, "S C"], classes: Int32[Array, "E K"]) -> Float32[Array, "S E K"]:
    return jnp.moveaxis(take_rows(values.T, classes), -1, 0)


def _with_finish(values: Array, finish: Array) -> Array:
    """Append the finish action along the last axis."""
    return jnp.concatenate([values, finish[..., None]], axis=-1)


def _with_finish_row(values: Array, finish: Array) -> Array:
    """Append the finish action along the first axis."""
    return jnp.concatenate([values, finish[None].astype(values.dtype)], axis=0)


def _per_action(words: UInt32[Array, "S W"], actions: int) -> UInt32[Array, "A W"]:
    """The masks of each action's own subgoal; empty for finish."""
    subgoals, width = words.shape
    edges = (actions - 1) // max(subgoals, 1)
    # A repetition instead of a gather: actions of one subgoal lie side by side.
    repeated = jnp.broadcast_to(words[:, None, :], (subgoals, edges, width)).reshape(actions - 1, width)
    return _with_finish_row(repeated, jnp.zeros((width,), jnp.uint32))


def _overlaps(first: UInt32[Array, "*N W"], second: UInt32[Array, "*N W"]) -> Bool[Array, "*N"]:
    """Whether two sets have a common element. Unrolled over the few words: a reduction would be slower."""
    common = first[..., 0] & second[..., 0]
    for word in range(1, first.shape[-1]):
        common = common | (first[..., word] & second[..., word])
    return common != 0


def _or_rows(words: UInt32[Array, "S W"]) -> UInt32[Array, "W"]:
    return jax.lax.reduce(words, np.uint32(0), jax.lax.bitwise_or, (0,))


def _single_bit(index: Int32[Array, "*N"], words: int) -> UInt32[Array, "*N w"]:
    """The set with the one element ``index``; empty for a negative index."""
    # A shift of -1 gives no word that exists, so that the set stays empty.
    word = jnp.arange(words, dtype=jnp.int32).reshape((1,) * index.ndim + (-1,))
    bit = jnp.uint32(1) << (index & (WORD_BITS - 1)).astype(jnp.uint32)
    return jnp.where(word == (index >> 5)[..., None], bit[..., None], jnp.uint32(0))
