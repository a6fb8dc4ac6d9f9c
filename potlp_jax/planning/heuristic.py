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
    rows = tables.actions
    nodes, states, actions = tables.distance.shape
    distance = tables.distance.reshape(nodes * states, actions)
    inside = tables.stays_inside.reshape(nodes * states, actions)
    possible = success_probability > 0
    accepting = jnp.broadcast_to(tables.accepting[None], (nodes, states)).reshape(-1)
    after_success = rows.subgoal * states + rows.to_state
    after_failure = rows.subgoal * states + jnp.maximum(rows.from_state, 0)
    dead_end = jnp.broadcast_to(dead_end_cost, (actions,))

    def outcomes(leave: Float32[Array, "N"], stay: Float32[Array, "N"], again: Float32[Array, "A"]) -> Guess:
        return Guess(
            success_leave=leave[after_success],
            success_stay=stay[after_success],
            failure_leave=leave[after_failure],
            failure_stay=again,
            dead_end_cost=dead_end,
        )

    def attempt(guess: Guess) -> Float32[Array, "A"]:
        """Expected cost of each action from the subgoal on."""
        success = success_cost + guess.value(jnp.full((actions,), True), success_cost)
        failure = rows.failure_cost + guess.value(jnp.full((actions,), False), rows.failure_cost)
        cost = success_probability * success + (1.0 - success_probability) * failure
        return jnp.where(possible, cost, jnp.inf)

    def sweep(_, guess: Guess) -> Guess:
        cost = attempt(guess)
        leave = jnp.min(jnp.where(inside, jnp.inf, distance + cost[None]), axis=1)
        beyond = jnp.where(inside, cost[None], jnp.inf)
        stay = jnp.min(beyond, axis=1)
        index = jnp.arange(actions, dtype=jnp.int32)
        best = jnp.min(jnp.where(beyond <= stay[:, None], index[None], actions), axis=1)
        second = jnp.min(jnp.where(index[None] == best[:, None], jnp.inf, beyond), axis=1)
        # Just after a failure the same attempt is out of the question; elsewhere failures are forgotten.
        again = jnp.where(best[after_failure] == index, second[after_failure], stay[after_failure])
        return outcomes(jnp.where(accepting, 0.0, leave), jnp.where(accepting, 0.0, stay), again)

    unknown = jnp.where(accepting, 0.0, jnp.inf)
    start = outcomes(unknown, unknown, jnp.full((actions,), jnp.inf))
    return jax.lax.fori_loop(0, sweeps, sweep, start)
