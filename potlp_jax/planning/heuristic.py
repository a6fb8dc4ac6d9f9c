"""What an action's outcome costs if rollouts forgot their failures: a cheap guess that guides the search.

Forgetting makes the rollout a Markov process over (subgoal, state): whatever was tried may be tried again with the
same chances. Sweeps of value iteration from above bound the attempts: after ``n`` sweeps the guess is the cost of the
best plan of at most ``n`` attempts after which only the dead end is left.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float32

from potlp_jax.planning.history import ActionTables


@struct.dataclass(kw_only=True)
class Guess:
    """Expected cost after each action's success or failure, apart from the way back that is then owed.

    ``leave`` is the best that goes elsewhere (the way back is paid), ``stay`` the best that goes on beyond the same
    subgoal (it is not). ``value`` combines them.
    """

    success_leave: Float32[Array, "*A"]
    success_stay: Float32[Array, "*A"]
    failure_leave: Float32[Array, "*A"]
    failure_stay: Float32[Array, "*A"]
    dead_end_cost: Float32[Array, "*A"]

    def value(self, success: Bool[Array, "*A"], owed: Float32[Array, "*A"]) -> Float32[Array, "*A"]:
        """Guessed cost of the history after the outcome, in which ``owed`` is the way back."""
        leave = jnp.where(success, self.success_leave, self.failure_leave)
        stay = jnp.where(success, self.success_stay, self.failure_stay)
        best = jnp.minimum(owed + leave, stay)
        return jnp.where(jnp.isinf(best), self.dead_end_cost, best)


def guess_values(
    tables: ActionTables,
    success_probability: Float32[Array, "A"],
    success_cost: Float32[Array, "A"],
    dead_end_cost: Float32[Array, ""],
    sweeps: int,
) -> Guess:
    """Guess for every action of one problem; ``success_probability`` and ``success_cost`` are those of the root."""
    nodes, states, actions = tables.distance.shape
    subgoals, edges = nodes - 1, (actions - 1) // max(nodes - 1, 1)

    def by_subgoal(values: Array) -> Array:
        return values[:-1].reshape(subgoals, edges)

    rows = tables.actions
    probability, won, lost = map(by_subgoal, (success_probability, success_cost, rows.failure_cost))
    source, target = by_subgoal(rows.from_state), by_subgoal(rows.to_state)
    # A way that begins where it ends is no way: the robot goes on inside.
    starts = source[:, None, :] == jnp.arange(states, dtype=jnp.int32)[None, :, None]
    inside = jnp.eye(subgoals, dtype=jnp.bool_)[:, None, :, None] & starts[:, :, None, :]
    way = jnp.where(inside, jnp.inf, tables.distance[:-1, :, :-1].reshape(subgoals, states, subgoals, edges))
    # Just after a failure the same attempt is out of the question; elsewhere failures are forgotten.
    other = ~jnp.eye(edges, dtype=jnp.bool_)[None] & (source[:, :, None] == source[:, None, :])
    place = jnp.arange(subgoals, dtype=jnp.int32)[:, None]

    def after(leave: Float32[Array, "S Z"], stay: Float32[Array, "S Z"], again: Float32[Array, "S E"]) -> Guess:
        return Guess(
            success_leave=leave[place, target],
            success_stay=stay[place, target],
            failure_leave=leave[place, jnp.maximum(source, 0)],
            failure_stay=again,
            dead_end_cost=jnp.broadcast_to(dead_end_cost, (subgoals, edges)),
        )

    def sweep(_, guess: Guess) -> Guess:
        flags = jnp.full((subgoals, edges), True)
        success, failure = won + guess.value(flags, won), lost + guess.value(~flags, lost)
        cost = probability * success + (1.0 - probability) * failure
        cost = jnp.where(probability > 0, cost, jnp.inf)
        elsewhere = jnp.min(way + cost[None, None], axis=(2, 3), initial=jnp.inf)
        leave = jnp.minimum(elsewhere, tables.distance[:-1, :, -1])
        stay = jnp.min(jnp.where(starts, cost[:, None, :], jnp.inf), axis=2, initial=jnp.inf)
        again = jnp.min(jnp.where(other, cost[:, None, :], jnp.inf), axis=2, initial=jnp.inf)
        return after(jnp.where(tables.accepting[None], 0.0, leave), jnp.where(tables.accepting[None], 0.0, stay), again)

    unknown = jnp.broadcast_to(jnp.where(tables.accepting, 0.0, jnp.inf)[None], (subgoals, states))
    start = after(unknown, unknown, jnp.full((subgoals, edges), jnp.inf))
    guess = jax.lax.fori_loop(0, sweeps, sweep, start)
    return jax.tree.map(lambda values: jnp.append(values.reshape(-1), jnp.float32(0.0)), guess)
