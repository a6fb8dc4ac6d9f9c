"""Chains of failures: the actions that the rule takes as long as they fail, and what it is expected to cost.

While attempts fail, one history follows another and no branch opens, so the expected cost of the rule is a sum along a
single **chain** of failures, with exact knowledge of what has failed, exact path costs, and a dead end where no action
remains. Each success along the chain is worth what ``Rule.after_success`` says. Where chains are **nested**, it is
worth a chain that does without all that has failed before.

Everything here has a leading batch axis, written out by hand: a chain is a loop of a few operations on all rows.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.search.arrays import first_of_least
from potlp_jax.planning.search.rule import Guess, Rule
from potlp_jax.planning.sharding import vary_alike

NEGLIGIBLE: float = 1e-3
"""A chain is cut where the probability of getting there is below this; the rest counts as a dead end. So the error is
below a thousandth of the dead-end cost. No experiment on it is recorded."""


@struct.dataclass(kw_only=True)
class Starts:
    """Where chains begin; several may begin in one problem.

    Attributes:
      problem: row of the rule, for each chain.
      product_state: where the chain begins.
      pending_cost: there.
      available: actions that the chain may take.
      chance: P_S of each action, given what is known there.
      attempt_cost: expected cost of each attempt without the path to it (``cost_of_attempts``).
      success_cost: R_S of each action, given what is known there.
    """

    problem: Int32[Array, "N"]
    product_state: Int32[Array, "N"]
    pending_cost: Float32[Array, "N"]
    available: Bool[Array, "N A"]
    chance: Float32[Array, "N A"]
    attempt_cost: Float32[Array, "N A"]
    success_cost: Float32[Array, "N A"]


@struct.dataclass(kw_only=True)
class Chain:
    """Actions in the order in which the rule tries them as long as they fail, by level.

    Attributes:
      levels: of the longest chain.
      action: the action; A where the chain has ended.
      cost: expected cost of its attempt, what follows its success included.
      chance: its P_S.
      dead_end: probability of ending at a dead end after its success.
      rest: ``[L + 1, N]``, what follows from this level on, given that all before have failed.
    """

    levels: Int32[Array, ""]
    action: Int32[Array, "L N"]
    cost: Float32[Array, "L N"]
    chance: Float32[Array, "L N"]
    dead_end: Float32[Array, "L N"]
    rest: Guess


def cost_of_attempts(
    rule: Rule, problem: Int32[Array, "N"], chance: Float32[Array, "N A"], success_cost: Float32[Array, "N A"]
) -> Float32[Array, "N A"]:
    """Expected cost of each attempt without the path to it: what follows success is included, what follows failure
    is not.

    Args:
      rule: of the problems.
      problem: row of the rule, for each chain.
      chance: P_S of every action.
      success_cost: R_S, likewise.

    Returns:
      P_S (R_S + after success) + (1 - P_S) R_F.
    """
    succeeds = rounded_product(chance, success_cost + rule.after_success.cost[problem])
    return succeeds + rounded_product(1.0 - chance, rule.failure_cost[problem])


def follow_chain(rule: Rule, starts: Starts, length: int, nested: int = 0) -> Chain:
    """The chain of the rule from each start.

    Args:
      rule: of the problems.
      starts: where the chains begin.
      length: failures in a row that are followed.
      nested: so many successes in a row remember what has failed in the chain; those after them forget it.

    Returns:
      The chains, and what follows from each of their levels on.
    """
    count, actions = starts.available.shape
    zeros = jnp.zeros((length, count), jnp.float32)
    walk = _Walk(
        level=jnp.int32(0),
        active=jnp.ones((count,), jnp.bool_),
        product_state=starts.product_state,
        pending_cost=starts.pending_cost,
        # Divided once here instead of at every level.
        inverse_chance=jnp.where(starts.available, 1.0 / starts.chance, jnp.inf),
        reached=jnp.ones((count,), jnp.float32),
        action=jnp.full((length, count), actions, jnp.int32),
        cost=zeros,
        chance=zeros,
        dead_end=zeros,
    )
    walk = jax.lax.while_loop(
        lambda walk: (walk.level < length) & jnp.any(walk.active),
        lambda walk: _fail_once(rule, starts, walk, length, nested),
        vary_alike(walk, rule),
    )

    def add(step: Int32[Array, ""], rest: Guess) -> Guess:
        # From the chain's end backward. Levels that a chain did not reach cost nothing and cannot succeed.
        level = walk.level - 1 - step
        chance = walk.chance[level]
        own = Guess(cost=walk.cost[level], dead_end=rounded_product(chance, walk.dead_end[level]))

        def put(rest: Array, own: Array) -> Array:
            below = own + rounded_product(1.0 - chance, rest[level + 1])
            return jax.lax.dynamic_update_index_in_dim(rest, below, level, 0)

        return jax.tree.map(put, rest, own)

    # A chain that is cut, or that has no action left, ends at a dead end.
    end = Guess(
        cost=jnp.broadcast_to(rule.dead_end_cost[starts.problem], (length + 1, count)),
        dead_end=jnp.ones((length + 1, count), jnp.float32),
    )
    rest = jax.lax.fori_loop(0, walk.level, add, vary_alike(end, rule))
    return Chain(
        levels=walk.level, action=walk.action, cost=walk.cost, chance=walk.chance, dead_end=walk.dead_end, rest=rest
    )


@struct.dataclass(kw_only=True)
class _Walk:
    """The head of every chain while it is followed.

    Attributes:
      level: failures so far.
      active: True where the chain goes on.
      product_state: where the head is.
      pending_cost: there.
      inverse_chance: 1 / P_S, inf where an action is not available or has failed.
      reached: probability that all attempts so far have failed.
      action: see ``Chain``.
      cost: see ``Chain``.
      chance: see ``Chain``.
      dead_end: see ``Chain``.
    """

    level: Int32[Array, ""]
    active: Bool[Array, "N"]
    product_state: Int32[Array, "N"]
    pending_cost: Float32[Array, "N"]
    inverse_chance: Float32[Array, "N A"]
    reached: Float32[Array, "N"]
    action: Int32[Array, "L N"]
    cost: Float32[Array, "L N"]
    chance: Float32[Array, "L N"]
    dead_end: Float32[Array, "L N"]


def _fail_once(rule: Rule, starts: Starts, walk: _Walk, length: int, nested: int) -> _Walk:
    """Take the action of least cost per chance in every chain that goes on, and go on as if it had failed.

    Args:
      rule: of the problems.
      starts: where the chains begin.
      walk: their heads.
      length: failures in a row that nested chains follow.
      nested: how deep chains are nested.

    Returns:
      The heads one level further.
    """
    problem, actions = starts.problem, starts.available.shape[1]
    number = jnp.arange(problem.shape[0], dtype=jnp.int32)
    product_states = rule.product_states[problem]
    path_cost = rule.path_costs[problem, walk.product_state]
    inside = product_states == walk.product_state[:, None]
    # D of every action from the chain's head, as in `history.distance_of`.
    distance = jnp.where(inside, 0.0, path_cost + walk.pending_cost[:, None])
    ratio = jnp.where(jnp.isinf(walk.inverse_chance), jnp.inf, (distance + starts.attempt_cost) * walk.inverse_chance)
    # Without the barrier XLA would compute the ratios anew for each minimum over them.
    action, least = first_of_least(jax.lax.optimization_barrier(ratio))
    moves = walk.active & ~jnp.isinf(least)
    chance = starts.chance[number, action]
    # The ratio times the chance gives the cost back.
    cost = rounded_product(least, chance)
    dead_end = rule.after_success.dead_end[problem, action]
    if nested:
        cost, dead_end = _with_nested_success(rule, starts, walk, action, moves, cost, length, nested)
    # The chain follows the failure.
    reached = walk.reached * (1.0 - chance)

    def record(array: Array, new: Array) -> Array:
        return jax.lax.dynamic_update_index_in_dim(array, new, walk.level, 0)

    return _Walk(
        level=walk.level + 1,
        active=moves & (reached > NEGLIGIBLE),
        product_state=jnp.where(moves, product_states[number, action], walk.product_state),
        pending_cost=jnp.where(moves, rule.failure_cost[problem, action], walk.pending_cost),
        inverse_chance=jnp.where(rule.closes[problem, action], jnp.inf, walk.inverse_chance),
        reached=reached,
        action=record(walk.action, jnp.where(moves, action, actions)),
        cost=record(walk.cost, jnp.where(moves, cost, 0.0)),
        chance=record(walk.chance, jnp.where(moves, chance, 0.0)),
        dead_end=record(walk.dead_end, dead_end),
    )


def _with_nested_success(
    rule: Rule,
    starts: Starts,
    walk: _Walk,
    action: Int32[Array, "N"],
    moves: Bool[Array, "N"],
    cost: Float32[Array, "N"],
    length: int,
    nested: int,
) -> tuple[Float32[Array, "N"], Float32[Array, "N"]]:
    """Each chain's next attempt, with its success valued by a chain without what has failed so far.

    Args:
      rule: of the problems.
      starts: where the chains begin.
      walk: their heads.
      action: what each chain takes next.
      moves: True where it takes it.
      cost: of the attempt, with the rule's value of its success.
      length: failures in a row that the nested chains follow.
      nested: how deep chains are nested, this one included.

    Returns:
      The cost, unchanged where the success leads nowhere, and the probability of a dead end after the success.
    """
    problem, number = starts.problem, jnp.arange(action.shape[0], dtype=jnp.int32)
    success_state = rule.success_states[problem, action]
    leads_on = moves & (success_state >= 0)
    inner = dataclasses.replace(
        starts,
        product_state=jnp.maximum(success_state, 0),
        pending_cost=starts.success_cost[number, action],
        # Chains that do not move may take nothing, and end at once.
        available=~jnp.isinf(walk.inverse_chance) & leads_on[:, None],
    )
    chance = starts.chance[number, action]
    rest = follow_chain(rule, inner, length, nested - 1).rest
    after = jax.tree.map(lambda values: values[problem, action], rule.after_success)
    anew = cost + rounded_product(chance, rest.cost[0])
    cost = jnp.where(leads_on, anew - rounded_product(chance, after.cost), cost)
    return cost, jnp.where(leads_on, rest.dead_end[0], after.dead_end)
