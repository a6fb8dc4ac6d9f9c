"""Trials as an environment for reinforcement learning: a random agent in many worlds at once.

Any agent that takes a key and an observation fits in the place of ``act``. The episode is one compiled program.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, PRNGKeyArray

import potlp_jax
from potlp_jax.rl.episodes import Observation

STEPS = 20
EPISODES = 8


def act(key: PRNGKeyArray, observation: Observation) -> Int32[Array, ""]:
    """A random agent: any action that can be taken."""
    logits = jnp.where(observation.action_mask, 0.0, -jnp.inf)
    # After the end nothing can be taken; any action will do.
    logits = jnp.where(jnp.any(observation.action_mask), logits, 0.0)
    return jax.random.categorical(key, logits).astype(jnp.int32)


def main() -> None:
    """Roll the agent out, and say how episodes ended and what they returned."""
    env = potlp_jax.TaskEnv.of_family(potlp_jax.make("toy"), task=2, worlds=range(4))

    def episode(key: PRNGKeyArray) -> tuple[Array, Array]:
        def step(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, Array]:
            state, time_step = carry
            state, time_step = env.step(state, act(key, time_step.observation))
            return (state, time_step), time_step.reward

        (_, last), rewards = jax.lax.scan(step, env.reset(key), jax.random.split(key, STEPS))
        return jnp.sum(rewards), last.last()

    returns, ended = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), EPISODES))
    print(f"{int(np.sum(ended))} of {EPISODES} episodes ended; mean return {float(np.mean(returns)):.1f}")


if __name__ == "__main__":
    main()
