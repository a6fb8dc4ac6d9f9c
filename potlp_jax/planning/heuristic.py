"""What an action's outcome will cost, guessed from how often the rollout has failed: what guides the search.

Which attempts have failed is forgotten, how many is not. Attempts of the same automaton state are ranked by what they
cost per chance of success; after ``t`` failures the first ``t`` of that order count as spent, but for ``SLACK``,
because rollouts do not keep to the order exactly. Values are tables over (state, failures, subgoal), solved backward in
the number of failures until only the dead end is left; a success begins a count of its own. Ways are those of the map.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32

from potlp_jax.planning.history import ActionTables
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.types import NO_STATE

SLACK: int = 1
"""Attempts that count as not yet spent although enough have failed. Without any, actions out of order look up to twice
as costly as they are; with two, values come out 10 to 20 % too low."""

ROUNDS: int = 8
"""Successes in a row that the guess looks ahead: enough for most automata, a bound where they have cycles."""


@struct.dataclass(kw_only=True)
class Guess:
    """Expected cost from beyond a subgoal on, apart from the way back that is then owed.

    ``leave`` is the best that goes elsewhere (the way back is paid), ``stay`` the best that goes on beyond the same
    subgoal (it is not), ``again`` the same just after an attempt has failed, which is not repeated; inf where there is
    nothing left. ``sources`` and ``targets`` are z' and z'' of the edges.
    """

    leave: Float32[Array, "*B Z T S"]
    stay: Float32[Array, "*B Z T S"]
    again: Float32[Array, "*B E T S"]
    sources: Int32[Array, "*B E"]
    targets: Int32[Array, "*B E"]
    dead_end_cost: Float32[Array, "*B"]

    def count_by_state(self, failed: Int32[Array, "E"]) -> Int32[Array, "Z"]:
        """Failures per state from failures per edge."""
        states = jnp.arange(self.leave.shape[0], dtype=jnp.int32)
        own = self.sources[None, :] == states[:, None]
        return jnp.sum(jnp.where(own, failed[None, :], 0), axis=1, dtype=jnp.int32)

    def after_success(self, failures: Int32[Array, "Z"], owed: Float32[Array, "S E"]) -> Float32[Array, "S E"]:
        """Guessed cost once each attempt has succeeded; ``failures`` are counted per state."""
        targets = jnp.maximum(self.targets, 0)
        count = self._clip(failures[targets])
        return self._value(self.leave[targets, count].T, self.stay[targets, count].T, owed)

    def after_failure(self, failures: Int32[Array, "Z"], owed: Float32[Array, "S E"]) -> Float32[Array, "S E"]:
        """Guessed cost once each attempt has failed; ``failures`` do not count it yet."""
        sources = jnp.maximum(self.sources, 0)
        count = self._clip(failures[sources] + 1)
        edges = jnp.arange(sources.shape[0], dtype=jnp.int32)
        return self._value(self.leave[sources, count].T, self.again[edges, count].T, owed)

    def _clip(self, count: Int32[Array, "E"]) -> Int32[Array, "E"]:
        return jnp.minimum(count, self.leave.shape[-2] - 1)

    def _value(
        self, leave: Float32[Array, "S E"], stay: Float32[Array, "S E"], owed: Float32[Array, "S E"]
    ) -> Float32[Array, "S E"]:
        best = jnp.minimum(owed + leave, stay)
        return jnp.where(jnp.isinf(best), self.dead_end_cost, best)


def guess_values(
    problem: PlanningProblem,
    tables: ActionTables,
    success_probability: Float32[Array, "A"],
    success_cost: Float32[Array, "A"],
    failures: int,
) -> Guess:
    """Guess for one problem; ``success_probability`` and ``success_cost`` are those of the root.

    ``failures`` bounds those that are told apart; beyond, only the dead end is left.
    """
    nodes, states, actions = tables.distance.shape
    subgoals, edges = nodes - 1, (actions - 1) // max(nodes - 1, 1)

    def by_subgoal(values: Array) -> Array:
        return values[:-1].reshape(subgoals, edges)

    rows = tables.actions
    success_probability = jnp.where(rows.from_state == NO_STATE, 0.0, success_probability)
    probability, won, lost = map(by_subgoal, (success_probability, success_cost, rows.failure_cost))
    source, target = (jnp.max(by_subgoal(ends), axis=0, initial=-1) for ends in (rows.from_state, rows.to_state))
    starts = source[None, :] == jnp.arange(states, dtype=jnp.int32)[:, None]
    # A way that begins where it ends is no way: the robot goes on inside.
    count = subgoals * states
    real = (problem.subgoal_mask[:, None] & problem.task.state_mask[None, :]).reshape(count)
    is_way = real[:, None] & real[None, :] & ~jnp.eye(count, dtype=jnp.bool_)
    way = jnp.where(is_way, problem.travel[:-1].reshape(count, count), jnp.inf)
    other = ~jnp.eye(edges, dtype=jnp.bool_) & (source[:, None] == source[None, :])
    nearest = jnp.min(way, axis=0, initial=jnp.inf).reshape(subgoals, states)[:, jnp.maximum(source, 0)]
    nearest = jnp.where(jnp.isinf(nearest), 0.0, nearest)
    price = (nearest + probability * won + (1.0 - probability) * lost) / probability
    rank = _rank(jnp.where(probability > 0, price, jnp.inf), source)
    finish, accepting = problem.finish[:-1].T, tables.accepting[:, None]
    dead_end_cost = problem.dead_end_cost

    def solve(success: Float32[Array, "S E"]) -> tuple[Array, Array, Array]:
        """Tables by the number of failures, given the value of every success."""

        def fail_less(after, failed):
            leave, again = after
            best = jnp.minimum(lost + leave[jnp.maximum(source, 0)].T, again.T)
            failure = jnp.where(jnp.isinf(best), dead_end_cost, best)
            cost = probability * (won + success) + (1.0 - probability) * (lost + failure)
            cost = jnp.where((probability > 0) & (rank >= failed - SLACK), cost, jnp.inf)
            stay = jnp.min(jnp.where(starts[:, None, :], cost[None], jnp.inf), axis=2, initial=jnp.inf)
            elsewhere = jnp.min(way + stay.T.reshape(-1)[None, :], axis=1, initial=jnp.inf).reshape(subgoals, states).T
            leave = jnp.where(accepting, 0.0, jnp.minimum(elsewhere, finish))
            stay = jnp.where(accepting, 0.0, stay)
            again = jnp.min(jnp.where(other[:, None, :], cost[None], jnp.inf), axis=2, initial=jnp.inf)
            return (leave, again), (leave, stay, again)

        nothing = jnp.where(accepting, 0.0, finish), jnp.full((edges, subgoals), jnp.inf, jnp.float32)
        return jax.lax.scan(fail_less, nothing, jnp.arange(failures, dtype=jnp.int32), reverse=True)[1]

    def improve(carry):
        count, success, _ = carry
        leave, stay, _ = solve(success)
        best = jnp.minimum(won + leave[0, jnp.maximum(target, 0)].T, stay[0, jnp.maximum(target, 0)].T)
        after = jnp.where(jnp.isinf(best), dead_end_cost, best)
        return count + 1, after, jnp.any(after != success)

    start = (jnp.int32(0), jnp.full((subgoals, edges), dead_end_cost, jnp.float32), jnp.asarray(True))
    _, success, _ = jax.lax.while_loop(lambda carry: carry[2] & (carry[0] < ROUNDS), improve, start)
    leave, stay, again = (jnp.moveaxis(table, 0, 1) for table in solve(success))
    return Guess(leave=leave, stay=stay, again=again, sources=source, targets=target, dead_end_cost=dead_end_cost)


def _rank(price: Float32[Array, "S E"], source: Int32[Array, "E"]) -> Int32[Array, "S E"]:
    """How many attempts in the same state come before each: those of a lower price, ties by index."""
    flat, state = price.reshape(-1), jnp.broadcast_to(source[None, :], price.shape).reshape(-1)
    index = jnp.arange(flat.shape[0], dtype=jnp.int32)
    lower = (flat[:, None] < flat[None, :]) | ((flat[:, None] == flat[None, :]) & (index[:, None] < index[None, :]))
    before = lower & (state[:, None] == state[None, :])
    return jnp.sum(before, axis=0, dtype=jnp.int32).reshape(price.shape)
