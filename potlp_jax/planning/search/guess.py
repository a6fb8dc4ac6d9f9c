"""The guessed value of outcomes that have no node: what guides best-first search.

A simple rule is followed: take the action of least cost per chance of success. While attempts fail, one history follows
another and no branch opens, so the expected cost of the rule is a sum along a single **chain** of failures, with exact
knowledge of what has failed, exact path costs, and a dead end where no action remains. Each success along the chain is
worth what the rule costs from there on with nothing known (``make_rule``).

Where a failure closes conditions of later states of the automaton too, the problem is **coupled**, and that would
forget what matters: guesses at outcomes that have not been examined would be far too low beside those that have, and
more simulations would choose worse. There every node values its successes anew, with its own chances
(``value_successes_anew``), and guesses each outcome of each action by a chain of its own, from where that outcome leads
and with what it teaches. Chains are then **nested**: a success along a chain is worth a chain that does without all
that has failed before. The values of ``value_successes_anew`` still choose the order, and stand for successes that are
nested more than ``NESTED`` deep.

Beside its cost every guess has its **dead end**, the probability that the rule ends at one: what it adds to the cost is
far surer than the rest, because any order of the same attempts has the same chance that all fail.

Ordering by cost per chance is optimal for independent tests without path costs between them (Mitten 1960). With path
costs the rule is a policy like any other, so that a guess is seldom too low in problems that are not coupled.

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
from potlp_jax.planning.rounding import rounded_product
from potlp_jax.planning.search.arrays import first_of_least
from potlp_jax.planning.sharding import vary_alike
from potlp_jax.types import NO_STATE

NEGLIGIBLE: float = 1e-3
"""A chain is cut where the probability of getting there is below this; the rest counts as a dead end. So the error is
below a thousandth of the dead-end cost. No experiment on it is recorded."""

PASSES: int = 4
"""How often the successes are valued where the automaton has cycles. Without cycles each is valued once, the last
first, and is then final; in a cycle each pass adds one round. No experiment on the number is recorded."""


NESTED: int = 2
"""Successes in a row along a chain that are valued by what has failed in it; those after them forget it. With three
things to find, 2 forget nothing. Chosen on the split ``tuning`` of ``shared-dear``, S = 4, 12 problems: with 1 the mean
regret is 1.2 % after 300 simulations and 0.6 % after 10,000, with 2 it is 0.03 %. Each one more multiplies the time of
a guess by the length of a chain."""


@struct.dataclass(kw_only=True)
class Guess:
    """What is guessed to follow an outcome.

    Attributes:
      cost: expected cost, what dead ends cost included.
      dead_end: probability of ending at a dead end.
    """

    cost: Float32[Array, "..."]
    dead_end: Float32[Array, "..."]


@struct.dataclass(kw_only=True)
class Rule:
    """The rule in a batch of problems; ``R`` is the batch axis, ``P`` numbers product states.

    Attributes:
      path_costs: ``[r, p, a]``, path cost from the product state ``p = location * Z + state`` to action ``a``.
      product_states: where each action is attempted; negative for finish and padding.
      success_states: where its success leads; negative where that satisfies the task, and for finish and padding.
      failure_cost: R_F of each action.
      closes: ``[r, a, b]``: a failure of ``a`` closes the condition of ``b``, so that ``b`` fails too.
      after_success: ``[r, a]``, guess after each action's success, the cost that is then pending included; 0 where the
        success satisfies the task, and for finish.
      dead_end_cost: of each problem.
      reach: ``[r, z, z']``: from z the rollout can get to z'.
      coupled: True where what fails in one state of the automaton closes a condition of a later one.
    """

    path_costs: Float32[Array, "*R P A"]
    product_states: Int32[Array, "*R A"]
    success_states: Int32[Array, "*R A"]
    failure_cost: Float32[Array, "*R A"]
    closes: Bool[Array, "*R A A"]
    after_success: Guess
    dead_end_cost: Float32[Array, "*R"]
    reach: Bool[Array, "*R Z Z"]
    coupled: Bool[Array, "*R"]


@struct.dataclass(kw_only=True)
class _Starts:
    """Where chains begin; several may begin in one problem.

    Attributes:
      problem: row of the rule, for each chain.
      product_state: where the chain begins.
      pending_cost: there.
      available: actions that the chain may take.
      chance: P_S of each action, given what is known there.
      attempt_cost: expected cost of each attempt without the path to it (``_attempt_cost``).
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
class _Chain:
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
      action: see ``_Chain``.
      cost: see ``_Chain``.
      chance: see ``_Chain``.
      dead_end: see ``_Chain``.
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


def make_rule(
    tables: ActionTables,
    product_states: Int32[Array, "R A"],
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    reach: Bool[Array, "R Z Z"],
    dead_end_cost: Float32[Array, "R"],
    length: int,
) -> Rule:
    """The rule with the values of all successes.

    Args:
      tables: of a batch of problems.
      product_states: where each action is attempted, negative for finish and padding.
      chance: P_S with nothing known.
      success_cost: R_S with nothing known.
      reach: ``[r, z, z']``: from z the rollout can get to z'.
      dead_end_cost: of each problem.
      length: failures in a row that are followed.

    Returns:
      One rule per problem.
    """
    rows = tables.actions
    count, actions = product_states.shape
    # A failure closes all conditions that imply the failed one, at the same subgoal.
    closes = jnp.any(rows.backward[:, :, None, :] & rows.condition_bits[:, None, :, :] != 0, axis=-1)
    closes &= rows.subgoal[:, :, None] == rows.subgoal[:, None, :]
    rule = Rule(
        path_costs=tables.distance.reshape(count, -1, actions),
        product_states=product_states,
        success_states=_success_states(tables),
        failure_cost=rows.failure_cost,
        closes=closes,
        after_success=_unvalued(tables, dead_end_cost),
        dead_end_cost=dead_end_cost,
        reach=reach,
        coupled=_is_coupled(tables, closes, reach),
    )
    return _value_successes(rule, tables, chance, success_cost, length)


def value_successes_anew(
    rule: Rule,
    tables: ActionTables,
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    length: int,
) -> Rule:
    """In coupled problems, the rule with its successes valued by what one history of each problem knows.

    Order of operations: as in ``make_rule``, with the history's chances and costs in place of the root's; so what has
    failed stays out of every chain. What fails within a chain is forgotten after its successes here, and remembered
    where chains are nested (``guess_outcomes``).

    Args:
      rule: of the problems.
      tables: of the problems.
      chance: P_S of every action, given what the history knows; 0 where its condition has failed.
      success_cost: R_S, likewise.
      length: failures in a row that are followed.

    Returns:
      The rule; where a problem is not coupled, as it was.
    """

    def value_anew(rule: Rule) -> Rule:
        unvalued = dataclasses.replace(rule, after_success=_unvalued(tables, rule.dead_end_cost))
        anew = _value_successes(unvalued, tables, chance, success_cost, length)
        return dataclasses.replace(
            rule, after_success=_where(rule.coupled[:, None], anew.after_success, rule.after_success)
        )

    # The batch pays for it only if one of its problems needs it.
    return jax.lax.cond(jnp.any(rule.coupled), value_anew, lambda rule: rule, rule)


def _where(condition: Bool[Array, "..."], guess: Guess, other: Guess) -> Guess:
    """The one guess where the condition holds, the other elsewhere."""
    return jax.tree.map(lambda own, other: jnp.where(condition, own, other), guess, other)


def _success_states(tables: ActionTables) -> Int32[Array, "R A"]:
    """Product state that each action's success leads to; see ``Rule``."""
    rows, states = tables.actions, tables.accepting.shape[1]
    leads_on = (rows.from_state != NO_STATE) & ~rows.accepts
    return jnp.where(leads_on, rows.subgoal * states + rows.to_state, NO_STATE).astype(jnp.int32)


def _unvalued(tables: ActionTables, dead_end_cost: Float32[Array, "R"]) -> Guess:
    """What successes are worth until they are valued: they lead to a dead end, unless they satisfy the task."""
    dead_end = jnp.where(tables.actions.accepts, jnp.float32(0.0), jnp.float32(1.0)).at[:, -1].set(0.0)
    return Guess(cost=jnp.where(dead_end > 0, dead_end_cost[:, None], 0.0), dead_end=dead_end)


def _is_coupled(tables: ActionTables, closes: Bool[Array, "R A A"], reach: Bool[Array, "R Z Z"]) -> Bool[Array, "R"]:
    """Whether a failure can close an action of another state that is reached from the failed one's."""
    rows = tables.actions
    states, problems = jnp.maximum(rows.from_state, 0), jnp.arange(closes.shape[0], dtype=jnp.int32)[:, None, None]
    real = rows.from_state != NO_STATE
    later = reach[problems, states[:, :, None], states[:, None, :]] & (states[:, :, None] != states[:, None, :])
    return jnp.any(closes & later & real[:, :, None] & real[:, None, :], axis=(1, 2))


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
    failure, success = (_where(rule.coupled[:, None], own, other) for own, other in zip(each, along_chain, strict=True))
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
    starts = _Starts(
        problem=problem,
        product_state=both(jnp.maximum(rule.product_states, 0), jnp.maximum(rule.success_states, 0)),
        pending_cost=both(rule.failure_cost, success_cost),
        available=both(after_failure, after_success),
        chance=chance[problem],
        attempt_cost=_attempt_cost(rule, rows, chance, success_cost)[problem],
        success_cost=success_cost[problem],
    )
    rest = _follow_chain(rule, starts, length, NESTED).rest
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
    attempt_cost = _attempt_cost(rule, rows, chance, success_cost)
    starts = _Starts(
        problem=rows,
        product_state=product_state,
        pending_cost=pending_cost,
        available=available,
        chance=chance,
        attempt_cost=attempt_cost,
        success_cost=success_cost,
    )
    chain = _follow_chain(rule, starts, length)
    without = _without_each(chain, available.shape[1])
    elsewhere = without.cost + _cost_to_begin_elsewhere(rule, starts, chain)
    return dataclasses.replace(without, cost=elsewhere), rule.after_success


def _without_each(chain: _Chain, actions: int) -> Guess:
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


def _cost_to_begin_elsewhere(rule: Rule, starts: _Starts, chain: _Chain) -> Float32[Array, "R A"]:
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


@struct.dataclass(kw_only=True)
class _Order:
    """In which order successes are valued: edges that end nearest to acceptance first.

    Attributes:
      edges: edges in that order.
      targets: state z'' of each edge, negative on padding.
      is_final: True where the success needs no value: it satisfies the task, or the edge is padding.
      cyclic: True where the automaton can return to a state.
    """

    edges: Int32[Array, "R E"]
    targets: Int32[Array, "R E"]
    is_final: Bool[Array, "R E"]
    cyclic: Bool[Array, "R"]


def _order_of_successes(tables: ActionTables, reach: Bool[Array, "R Z Z"], subgoals: int, edges: int) -> _Order:
    rows, count, states = tables.actions, reach.shape[0], reach.shape[1]
    # Edges have the same ends at every subgoal.
    targets = jnp.max(rows.to_state[:, :-1].reshape(count, subgoals, edges), axis=1)
    is_final = jnp.all(rows.accepts[:, :-1].reshape(count, subgoals, edges), axis=1) | (targets < 0)
    # The fewer states a state can get to, the nearer it is to the end.
    depth = jnp.sum(reach, axis=2, dtype=jnp.int32)
    late = jnp.where(is_final, states + 1, jnp.take_along_axis(depth, jnp.maximum(targets, 0), axis=1))
    others = ~jnp.eye(states, dtype=jnp.bool_)
    return _Order(
        edges=jnp.argsort(late, axis=1, stable=True).astype(jnp.int32),
        targets=targets,
        is_final=is_final,
        cyclic=jnp.any(reach & jnp.swapaxes(reach, 1, 2) & others[None], axis=(1, 2)),
    )


def _value_successes(
    rule: Rule,
    tables: ActionTables,
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    length: int,
) -> Rule:
    """Fill in ``after_success``: a chain from every subgoal, for one edge of every problem at a time."""
    count, actions = rule.product_states.shape
    states, subgoals = rule.reach.shape[1], tables.distance.shape[1] - 1
    edges = (actions - 1) // max(subgoals, 1)
    # No subgoals or no edges: finish alone.
    if edges == 0:
        return rule
    order = _order_of_successes(tables, rule.reach, subgoals, edges)
    real = (tables.actions.from_state != NO_STATE).at[:, -1].set(True)
    chance = jnp.where(real, chance, 0.0)
    # The batch runs as long as the problem with most edges to value.
    todo = jnp.max(jnp.sum(~order.is_final, axis=1, dtype=jnp.int32))
    # One chain per problem and subgoal, all subgoals of one problem side by side.
    problem = jnp.repeat(jnp.arange(count, dtype=jnp.int32), subgoals)
    subgoal = jnp.tile(jnp.arange(subgoals, dtype=jnp.int32), count)
    chances, costs, tried = chance[problem], success_cost[problem], chance[problem] > 0

    def value_edge(step, after_success):
        # Later edges see the values of earlier ones, which lie nearer to acceptance.
        edge = order.edges[problem, step % jnp.maximum(todo, 1)]
        action = subgoal * edges + edge
        now = dataclasses.replace(rule, after_success=after_success)
        starts = _Starts(
            problem=problem,
            product_state=subgoal * states + jnp.maximum(order.targets[problem, edge], 0),
            # After the success the rollout is beyond the subgoal, in the state that the edge ends in.
            pending_cost=success_cost[problem, action],
            available=tried,
            chance=chances,
            attempt_cost=_attempt_cost(now, problem, chances, costs),
            success_cost=costs,
        )
        chain = _follow_chain(now, starts, length)
        # A problem without cycles is not valued again because another of the batch has them.
        keeps = order.is_final[problem, edge] | ((step >= todo) & ~order.cyclic[problem])

        def renew(after: Array, rest: Array) -> Array:
            value = jnp.where(keeps, after[problem, action], rest[0])
            return after.at[problem, action].set(value, unique_indices=True)

        return jax.tree.map(renew, after_success, chain.rest)

    steps = todo * jnp.where(jnp.any(order.cyclic), PASSES, 1)
    start = vary_alike(rule.after_success, rule)
    return dataclasses.replace(rule, after_success=jax.lax.fori_loop(0, steps, value_edge, start))


def _attempt_cost(
    rule: Rule, problem: Int32[Array, "N"], chance: Float32[Array, "N A"], success_cost: Float32[Array, "N A"]
) -> Float32[Array, "N A"]:
    """Expected cost of each attempt without the path to it: what follows success is included, what follows failure
    is not."""
    succeeds = rounded_product(chance, success_cost + rule.after_success.cost[problem])
    return succeeds + rounded_product(1.0 - chance, rule.failure_cost[problem])


def _follow_chain(rule: Rule, starts: _Starts, length: int, nested: int = 0) -> _Chain:
    """The chain of the rule from each start; ``nested`` of its successes in a row remember what has failed in it."""
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
    return _Chain(
        levels=walk.level, action=walk.action, cost=walk.cost, chance=walk.chance, dead_end=walk.dead_end, rest=rest
    )


def _fail_once(rule: Rule, starts: _Starts, walk: _Walk, length: int, nested: int) -> _Walk:
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
    starts: _Starts,
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
    rest = _follow_chain(rule, inner, length, nested - 1).rest
    after = jax.tree.map(lambda values: values[problem, action], rule.after_success)
    anew = cost + rounded_product(chance, rest.cost[0])
    cost = jnp.where(leads_on, anew - rounded_product(chance, after.cost), cost)
    return cost, jnp.where(leads_on, rest.dead_end[0], after.dead_end)
