"""The guessed value of outcomes that have no node: what guides best-first search.

A simple rule is followed (``search.rule``): take the action of least cost per chance of success. Its expected cost is a
sum along a **chain** of failures (``search.chains``), in which each success is worth what the rule costs from there on
with nothing known (``successes.value_successes``).

Where a failure closes conditions of later states of the automaton too, the problem is **coupled**, and that would
forget what matters: guesses at outcomes that have not been examined would be far too low beside those that have, and
more simulations would choose worse. There every node values its successes anew, with its own chances
(``successes.value_successes_anew``), and guesses each outcome of each action by a chain of its own, from where that
outcome leads and with what it teaches. Chains are then **nested**: a success along a chain is worth a chain that does
without all that has failed before. The values of ``value_successes_anew`` still choose the order, and stand for
successes that are nested more than ``NESTED`` deep.

Beside its cost every guess has its **dead end**, the probability that the rule ends at one: what it adds to the cost is
far surer than the rest, because any order of the same attempts has the same chance that all fail.

Everything here has a leading batch axis, written out by hand, as chains have.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.search.chains import Chain, Starts, cost_of_attempts, follow_chain
from potlp_jax.planning.search.rule import Guess, Rule, guess_where
from potlp_jax.planning.sharding import vary_alike

NESTED: int = 2
"""Successes in a row along a chain that are valued by what has failed in it; those after them forget it. With three
things to find, 2 forget nothing. Chosen on the split ``tuning`` of ``shared-dear``, S = 4, 12 problems: with 1 the mean
regret is 1.2 % after 300 simulations and 0.6 % after 10,000, with 2 it is 0.03 %. Each one more multiplies the time of
a guess by the length of a chain."""


def guess_outcomes(
    rule: Rule,
    product_state: Int32[Array, "R"],
    pending_cost: Float32[Array, "R"],
    available: Bool[Array, "R A"],
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    length: int,
) -> tuple[Guess, Guess]:
    """What is guessed to follow every action of one history per problem.

    After the failure of the rule's first action the rest of its chain follows. After the failure of another action the
    chain begins where that action failed, and does without it. In coupled problems each outcome has nested chains of
    its own.

    Args:
      rule: of the problems.
      product_state: where the history is.
      pending_cost: there.
      available: its actions.
      chance: their P_S, given what is known.
      success_cost: their R_S, given what is known.
      length: failures in a row that are followed.

    Returns:
      The guess after failure and the guess after success, ``[R, A]``, the costs that are then pending included.
    """

    def guess_each(rule: Rule) -> tuple[Guess, Guess]:
        return _guess_each(rule, available, chance, success_cost, length)

    along_chain = _guess_along_chain(rule, product_state, pending_cost, available, chance, success_cost, length)
    # The batch pays for it only if one of its problems needs it.
    each = jax.lax.cond(jnp.any(rule.coupled), guess_each, lambda rule: along_chain, rule)
    failure, success = (
        guess_where(rule.coupled[:, None], own, other) for own, other in zip(each, along_chain, strict=True)
    )
    return failure, success


def _guess_each(
    rule: Rule,
    available: Bool[Array, "R A"],
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    length: int,
) -> tuple[Guess, Guess]:
    """The guesses of ``guess_outcomes`` for coupled problems: nested chains from each outcome of each action.

    Args:
      rule: with successes valued by what the histories know.
      available: the histories' actions.
      chance: P_S of every action, given what is known.
      success_cost: R_S, likewise.
      length: failures in a row that are followed.

    Returns:
      The guess after failure and the guess after success; where there is no such outcome, a dead end.
    """
    count, actions = available.shape
    attempts = rule.product_states >= 0
    tried = ((chance > 0) & attempts.at[:, -1].set(True))[:, None, :]
    # Chains of outcomes that do not exist may take nothing, and end at once.
    after_failure = tried & ~rule.closes & (available & attempts)[:, :, None]
    after_success = tried & (available & (rule.success_states >= 0))[:, :, None]

    def both(failure: Array, success: Array) -> Array:
        return jnp.stack([failure, success], axis=1).reshape(count * 2 * actions, *failure.shape[2:])

    problem = jnp.repeat(jnp.arange(count, dtype=jnp.int32), 2 * actions)
    rows = jnp.arange(count, dtype=jnp.int32)
    starts = Starts(
        problem=problem,
        product_state=both(jnp.maximum(rule.product_states, 0), jnp.maximum(rule.success_states, 0)),
        pending_cost=both(rule.failure_cost, success_cost),
        available=both(after_failure, after_success),
        chance=chance[problem],
        attempt_cost=cost_of_attempts(rule, rows, chance, success_cost)[problem],
        success_cost=success_cost[problem],
    )
    rest = follow_chain(rule, starts, length, NESTED).rest
    failure, success = (
        jax.tree.map(lambda rest, which=which: rest[0].reshape(count, 2, actions)[:, which], rest) for which in range(2)
    )
    return failure, success


def _guess_along_chain(
    rule: Rule,
    product_state: Int32[Array, "R"],
    pending_cost: Float32[Array, "R"],
    available: Bool[Array, "R A"],
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    length: int,
) -> tuple[Guess, Guess]:
    """The guesses of ``guess_outcomes`` for problems that are not coupled, with the same arguments: one chain each."""
    rows = jnp.arange(product_state.shape[0], dtype=jnp.int32)
    # What has been learnt enters the chances and costs here.
    attempt_cost = cost_of_attempts(rule, rows, chance, success_cost)
    starts = Starts(
        problem=rows,
        product_state=product_state,
        pending_cost=pending_cost,
        available=available,
        chance=chance,
        attempt_cost=attempt_cost,
        success_cost=success_cost,
    )
    chain = follow_chain(rule, starts, length)
    without = _without_each(chain, available.shape[1])
    elsewhere = without.cost + _cost_to_begin_elsewhere(rule, starts, chain)
    return dataclasses.replace(without, cost=elsewhere), rule.after_success


def _without_each(chain: Chain, actions: int) -> Guess:
    """Each chain with one action left out, ``[N, A]``."""
    count = chain.action.shape[1]
    number = jnp.arange(count, dtype=jnp.int32)

    def skip(level, carry):
        # What the levels before cost, and then the rest of the chain behind the level that is left out.
        spent, reached, without = carry

        def leave_out(without: Array, spent: Array, rest: Array) -> Array:
            left_out = spent + rounded_product(reached, rest[level + 1])
            # Where a chain has ended the index is A, and the write is dropped.
            return without.at[number, chain.action[level]].set(left_out, mode="drop", unique_indices=True)

        without = jax.tree.map(leave_out, without, spent, chain.rest)
        spent = Guess(
            cost=spent.cost + rounded_product(reached, chain.cost[level]),
            dead_end=spent.dead_end + rounded_product(reached * chain.chance[level], chain.dead_end[level]),
        )
        return spent, reached * (1.0 - chain.chance[level]), without

    # An action that the chain does not contain leaves it whole.
    whole = jax.tree.map(lambda rest: jnp.broadcast_to(rest[0][:, None], (count, actions)), chain.rest)
    zeros = jnp.zeros((count,), jnp.float32)
    start = Guess(cost=zeros, dead_end=zeros), jnp.ones((count,), jnp.float32), whole
    return jax.lax.fori_loop(0, chain.levels, skip, vary_alike(start, chain))[2]


def _cost_to_begin_elsewhere(rule: Rule, starts: Starts, chain: Chain) -> Float32[Array, "R A"]:
    """How much more the chain's first step costs from where each action fails than from where the history is."""
    rows, actions = starts.problem, starts.available.shape[1]
    first = chain.action[0]
    # A chain that is empty has the index A; its cost is not used.
    start = jnp.minimum(first, actions - 1)
    cost_here = chain.cost[0] - starts.attempt_cost[rows, start]
    product_states = jnp.maximum(rule.product_states, 0)
    cost_there = rule.path_costs[rows[:, None], product_states, start[:, None]] + rule.failure_cost
    # Who is there already pays nothing; who cannot get there is treated as if still here.
    cost_there = jnp.where(rule.product_states == rule.product_states[rows, start][:, None], 0.0, cost_there)
    cost_there = jnp.where(jnp.isinf(cost_there), cost_here[:, None], cost_there)
    index = jnp.arange(actions, dtype=jnp.int32)[None, :]
    return jnp.where(index == first[:, None], 0.0, cost_there - cost_here[:, None])
