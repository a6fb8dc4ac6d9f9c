"""What successes are worth in a guess: what the rule costs from there on (``Rule.after_success``).

A success leads to another state of the automaton, from where a chain of its own begins (``search.chains``). Successes
are valued from acceptance backward, so that each chain finds its own successes valued: at the root with nothing known
(``value_successes``), and in coupled problems at every node anew, with what its history knows
(``value_successes_anew``).
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from potlp_jax.planning.history import ActionTables
from potlp_jax.planning.search.chains import Starts, cost_of_attempts, follow_chain
from potlp_jax.planning.search.rule import Rule, guess_where, unvalued_successes
from potlp_jax.planning.sharding import vary_alike
from potlp_jax.types import NO_STATE

PASSES: int = 4
"""How often the successes are valued where the automaton has cycles. Without cycles each is valued once, the last
first, and is then final; in a cycle each pass adds one round. No experiment on the number is recorded."""


def value_successes(
    rule: Rule,
    tables: ActionTables,
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    length: int,
) -> Rule:
    """Fill in ``after_success``: a chain from every subgoal, for one edge of every problem at a time.

    Args:
      rule: with unvalued successes.
      tables: of the problems.
      chance: P_S of every action, given what is known.
      success_cost: R_S, likewise.
      length: failures in a row that are followed.

    Returns:
      The rule with the values of all successes.
    """
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
        starts = Starts(
            problem=problem,
            product_state=subgoal * states + jnp.maximum(order.targets[problem, edge], 0),
            # After the success the rollout is beyond the subgoal, in the state that the edge ends in.
            pending_cost=success_cost[problem, action],
            available=tried,
            chance=chances,
            attempt_cost=cost_of_attempts(now, problem, chances, costs),
            success_cost=costs,
        )
        chain = follow_chain(now, starts, length)
        # A problem without cycles is not valued again because another of the batch has them.
        keeps = order.is_final[problem, edge] | ((step >= todo) & ~order.cyclic[problem])

        def renew(after: Array, rest: Array) -> Array:
            value = jnp.where(keeps, after[problem, action], rest[0])
            return after.at[problem, action].set(value, unique_indices=True)

        return jax.tree.map(renew, after_success, chain.rest)

    steps = todo * jnp.where(jnp.any(order.cyclic), PASSES, 1)
    start = vary_alike(rule.after_success, rule)
    return dataclasses.replace(rule, after_success=jax.lax.fori_loop(0, steps, value_edge, start))


def value_successes_anew(
    rule: Rule,
    tables: ActionTables,
    chance: Float32[Array, "R A"],
    success_cost: Float32[Array, "R A"],
    length: int,
) -> Rule:
    """In coupled problems, the rule with its successes valued by what one history of each problem knows.

    Order of operations: as in ``value_successes``, with the history's chances and costs in place of the root's; so what
    has failed stays out of every chain. What fails within a chain is forgotten after its successes here, and remembered
    where chains are nested (``guess.guess_outcomes``).

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
        unvalued = dataclasses.replace(rule, after_success=unvalued_successes(tables, rule.dead_end_cost))
        anew = value_successes(unvalued, tables, chance, success_cost, length)
        return dataclasses.replace(
            rule, after_success=guess_where(rule.coupled[:, None], anew.after_success, rule.after_success)
        )

    # The batch pays for it only if one of its problems needs it.
    return jax.lax.cond(jnp.any(rule.coupled), value_anew, lambda rule: rule, rule)


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
