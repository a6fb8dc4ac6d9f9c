"""What lies beyond an outcome, guessed by following a simple rule: what guides the search.

The rule takes the action of least cost per chance of success. While attempts fail, one history follows another and no
branch opens, so that the expected cost of the rule is a sum along a single chain, with exact knowledge of what has
failed, exact ways, and a dead end where the chain has nothing left; each success along it is worth what the rule costs
from there on with nothing known. Ordering by cost per chance is optimal for independent tests without ways in between
(Mitten 1960); with ways it is a policy like any other, so that a guess is seldom too low.

Everything here has a leading batch axis, written out by hand: a chain is a loop of a few operations on all rows.

References:
  L. G. Mitten, An analytic solution to the least cost testing sequence problem, J. of Industrial Engineering, 1960.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.planning.history import ActionTables
from potlp_jax.planning.search.arrays import least_of_each
from potlp_jax.types import NO_STATE

NEGLIGIBLE: float = 1e-3
"""Probability of getting that far below which a chain is cut; what is left counts as a dead end."""

PASSES: int = 4
"""Times that the successes are valued where the automaton has cycles; without, each is valued once, the last first."""


@struct.dataclass(kw_only=True)
class Rule:
    """The rule in a batch of problems.

    ``path_costs[r, p, a]`` is the path cost to action ``a`` from the product state ``p = location * Z + state``;
    ``product_states`` where each action is attempted, -1 for finish. ``closes[r, a, b]``: if ``a`` fails, so does
    ``b``. ``after_success`` is the guessed cost after each action's success, the pending cost included; 0 where that
    satisfies the task, and after finish.
    """

    path_costs: Float32[Array, "*R P A"]
    product_states: Int32[Array, "*R A"]
    failure_cost: Float32[Array, "*R A"]
    closes: Bool[Array, "*R A A"]
    after_success: Float32[Array, "*R A"]
    dead_end_cost: Float32[Array, "*R"]


@struct.dataclass(kw_only=True)
class _Chain:
    """Actions in the order in which the rule tries them as long as they fail, per level and row.

    ``action`` is A where a row has ended; ``cost`` is the expected cost of an attempt, what is left after its success
    included, ``chance`` its P_S, ``rest`` the expected cost from this level on, given that all before have failed.
    """

    action: Int32[Array, "L N"]
    cost: Float32[Array, "L N"]
    chance: Float32[Array, "L N"]
    rest: Float32[Array, "L1 N"]


def make_rule(
    tables: ActionTables,
    product_states: Int32[Array, "R A"],
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    reach: Bool[Array, "R Z Z"],
    dead_end_cost: Float32[Array, "R"],
    length: int,
    solve: bool = True,
) -> Rule:
    """The rule with the values of all successes (without them where ``solve`` is False).

    Args:
      tables: of a batch of problems.
      product_states: ``location * Z + state`` of each action's attempt.
      chance, success_cost: P_S and R_S with nothing known.
      reach: ``[r, z, z']``: from z the rollout can get to z'.
      dead_end_cost: of each problem.
      length: failures in a row that are followed.
    """
    rows = tables.actions
    count, actions = product_states.shape
    closes = jnp.any(rows.backward[:, :, None, :] & rows.condition_bits[:, None, :, :] != 0, axis=-1)
    closes &= rows.subgoal[:, :, None] == rows.subgoal[:, None, :]
    rule = Rule(
        path_costs=tables.distance.reshape(count, -1, actions),
        product_states=product_states,
        failure_cost=rows.failure_cost,
        closes=closes,
        after_success=jnp.where(rows.accepts, 0.0, dead_end_cost[:, None]).at[:, -1].set(0.0),
        dead_end_cost=dead_end_cost,
    )
    if not solve:
        return rule
    real = (rows.from_state != NO_STATE).at[:, -1].set(True)
    return _value_successes(rule, tables, jnp.where(real, chance, 0.0), success_cost, reach, length)


def guess_outcomes(
    rule: Rule,
    product_state: Int32[Array, "R"],
    pending_cost: Float32[Array, "R"],
    available: Bool[Array, "R A"],
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    length: int,
) -> tuple[Float32[Array, "R A"], Float32[Array, "R A"]]:
    """What is guessed to be left after the failure and after the success of every action of one history per problem.

    After the failure of the rule's first action that is the rest of its chain. After that of another action the chain
    begins there and does without it. What does not depend on the history is kept in ``rule``.
    """
    problem = jnp.arange(product_state.shape[0], dtype=jnp.int32)
    gain = _gain(rule, problem, chance, success_cost)
    chain = _follow(rule, problem, product_state, pending_cost, available, chance, gain, length)
    first, levels, actions = chain.action[0], chain.action.shape[0], available.shape[1]
    index = jnp.arange(actions, dtype=jnp.int32)[None, :]

    def skip(carry, level):
        spent, reached = carry
        left_out = spent + reached * chain.rest[level + 1]
        return (spent + reached * chain.cost[level], reached * (1.0 - chain.chance[level])), left_out

    nothing = jnp.zeros_like(pending_cost), jnp.ones_like(pending_cost)
    _, left_out = jax.lax.scan(skip, nothing, jnp.arange(levels, dtype=jnp.int32))
    whole = jnp.broadcast_to(chain.rest[0][:, None], available.shape)
    without = whole.at[problem[None, :], chain.action].set(left_out, mode="drop", unique_indices=True)

    # The chain without an action begins where that action has failed instead of here.
    start = jnp.minimum(first, actions - 1)
    cost_here = chain.cost[0] - gain[problem, start]
    product_states = jnp.maximum(rule.product_states, 0)
    cost_there = rule.path_costs[problem[:, None], product_states, start[:, None]] + rule.failure_cost
    cost_there = jnp.where(rule.product_states == rule.product_states[problem, start][:, None], 0.0, cost_there)
    cost_there = jnp.where(jnp.isinf(cost_there), cost_here[:, None], cost_there)
    moved = jnp.where(index == first[:, None], 0.0, cost_there - cost_here[:, None])
    return without + moved, rule.after_success


def _value_successes(
    rule: Rule,
    tables: ActionTables,
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    reach: Bool[Array, "R Z Z"],
    length: int,
) -> Rule:
    """Fill in ``after_success``, edges that end nearest to acceptance first."""
    count, actions = rule.product_states.shape
    states, subgoals = reach.shape[1], tables.distance.shape[1] - 1
    edges = (actions - 1) // max(subgoals, 1)
    if edges == 0:
        return rule
    targets = jnp.max(tables.actions.to_state[:, :-1].reshape(count, subgoals, edges), axis=1)
    ends = jnp.all(tables.actions.accepts[:, :-1].reshape(count, subgoals, edges), axis=1) | (targets < 0)
    depth = jnp.sum(reach, axis=2, dtype=jnp.int32)
    late = jnp.where(ends, states + 1, jnp.take_along_axis(depth, jnp.maximum(targets, 0), axis=1))
    order = jnp.argsort(late, axis=1, stable=True).astype(jnp.int32)
    todo = jnp.max(jnp.sum(~ends, axis=1, dtype=jnp.int32))
    others = ~jnp.eye(states, dtype=jnp.bool_)
    cyclic = jnp.any(reach & jnp.swapaxes(reach, 1, 2) & others[None], axis=(1, 2))
    problem = jnp.repeat(jnp.arange(count, dtype=jnp.int32), subgoals)
    subgoal = jnp.tile(jnp.arange(subgoals, dtype=jnp.int32), count)
    chances, costs, tried = chance[problem], success_cost[problem], chance[problem] > 0

    def value(step, after_success):
        edge = order[problem, step % jnp.maximum(todo, 1)]
        action = subgoal * edges + edge
        now = dataclasses.replace(rule, after_success=after_success)
        product_state = subgoal * states + jnp.maximum(targets[problem, edge], 0)
        pending_cost = success_cost[problem, action]
        gain = _gain(now, problem, chances, costs)
        chain = _follow(now, problem, product_state, pending_cost, tried, chances, gain, length)
        # A problem without cycles is not valued again because another of the batch has them.
        stays = ends[problem, edge] | ((step >= todo) & ~cyclic[problem])
        left = jnp.where(stays, after_success[problem, action], chain.rest[0])
        return after_success.at[problem, action].set(left, unique_indices=True)

    steps = todo * jnp.where(jnp.any(cyclic), PASSES, 1)
    return dataclasses.replace(rule, after_success=jax.lax.fori_loop(0, steps, value, rule.after_success))


def _gain(
    rule: Rule, problem: Int32[Array, "N"], chance: Float32[Array, "N A"], success_cost: Float32[Array, "N A"]
) -> Float32[Array, "N A"]:
    """Expected cost of each attempt without the way to it, what is left after success included, after failure not."""
    return chance * (success_cost + rule.after_success[problem]) + (1.0 - chance) * rule.failure_cost[problem]


def _follow(
    rule: Rule,
    problem: Int32[Array, "N"],
    product_state: Int32[Array, "N"],
    pending_cost: Float32[Array, "N"],
    available: Bool[Array, "N A"],
    chance: Float32[Array, "N A"],
    gain: Float32[Array, "N A"],
    length: int,
) -> _Chain:
    """The chain of the rule from a product state of each problem row; ``problem`` is the problem of each row."""
    count, actions = available.shape
    index = jnp.arange(actions, dtype=jnp.int32)[None, :]
    number = jnp.arange(count, dtype=jnp.int32)
    product_states, inverse = rule.product_states[problem], jnp.where(available, 1.0 / chance, jnp.inf)
    none = jnp.full((length, count), actions, jnp.int32)
    zeros = jnp.zeros((length, count), jnp.float32)

    def goes_on(carry):
        return (carry[0] < length) & jnp.any(carry[4])

    def advance(carry):
        level, product_state, pending_cost, inverse, active, reached, records = carry
        path_cost = rule.path_costs[problem, product_state]
        distance = jnp.where(product_states == product_state[:, None], 0.0, path_cost + pending_cost[:, None])
        score = jax.lax.optimization_barrier(jnp.where(jnp.isinf(inverse), jnp.inf, (distance + gain) * inverse))
        least = least_of_each(score, jnp.inf)
        action = least_of_each(jnp.where(score <= least[:, None], index, actions - 1), actions - 1)
        moves = active & ~jnp.isinf(least)
        odds = chance[number, action]
        new = (jnp.where(moves, action, actions), jnp.where(moves, least * odds, 0.0), jnp.where(moves, odds, 0.0))
        records = tuple(
            jax.lax.dynamic_update_index_in_dim(old, entry, level, 0) for old, entry in zip(records, new, strict=True)
        )
        inverse = jnp.where(rule.closes[problem, action], jnp.inf, inverse)
        reached = reached * (1.0 - odds)
        return (
            level + 1,
            jnp.where(moves, product_states[number, action], product_state),
            jnp.where(moves, rule.failure_cost[problem, action], pending_cost),
            inverse,
            moves & (reached > NEGLIGIBLE),
            reached,
            records,
        )

    start = (
        jnp.int32(0),
        product_state,
        pending_cost,
        inverse,
        jnp.ones_like(product_state, bool),
        jnp.ones_like(pending_cost),
        (none, zeros, zeros),
    )
    action, cost, odds = jax.lax.while_loop(goes_on, advance, start)[-1]

    def add(rest, level):
        rest = cost[level] + (1.0 - odds[level]) * rest
        return rest, rest

    end = rule.dead_end_cost[problem]
    _, rest = jax.lax.scan(add, end, jnp.arange(length, dtype=jnp.int32), reverse=True)
    return _Chain(action=action, cost=cost, chance=odds, rest=jnp.concatenate([rest, end[None]]))
