"""``TaskEnv`` for gymnasium: one trial at a time, NumPy in and out. Install ``potlp-jax[gym]``."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.checks import COUNT
from potlp_jax.environments.base import Generator
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.errors import WorldError
from potlp_jax.rl.episodes import OUTCOME_NAMES, EnvState, Observation, TaskEnv, TimeStep
from potlp_jax.task.task import Task

try:
    import gymnasium
    from gymnasium import spaces
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("gymnasium is missing; install it with: pip install 'potlp-jax[gym]'") from error


class GymTaskEnv(gymnasium.Env[dict[str, np.ndarray], np.int64]):
    """A task in the worlds of a family, a new world each episode.

    Observations are dictionaries with the fields of ``episodes.Observation``; actions, masks and rewards are those of
    ``TaskEnv``. ``info`` holds ``action_mask``, the ``cost`` travelled and the ``outcome``.
    """

    def __init__(
        self,
        environment: str | Generator,
        task: str | int | Task = 1,
        *,
        worlds: int = 1000,
        split: Split | str = Split.TRAINING,
    ) -> None:
        """Choose the worlds.

        Args:
            environment: a name that ``potlp_jax.make`` knows, or a generator.
            task: number of one of the environment's tasks, a formula over its propositions, or a task.
            worlds: an episode is in one of the first so many worlds of the split, drawn by gymnasium's own generator.
            split: from which they are taken.
        """
        self._generator = make(environment) if isinstance(environment, str) else environment
        if not COUNT.allows(worlds):
            raise WorldError(f"worlds is {worlds}; give {COUNT.wanted}")
        self._worlds, self._split = worlds, split
        asked = task if isinstance(task, Task) else self._generator.task(task)
        self.env = TaskEnv([self._generator.world(0, split)], asked)
        # All worlds of a family have one shape, so that both are compiled once.
        self._reset, self._step = jax.jit(self.env.reset_in), jax.jit(self.env.step)
        self._state: EnvState | None = None
        self.action_space = spaces.Discrete(self.env.num_actions)
        self.observation_space = self._spaces()

    def _spaces(self) -> gymnasium.Space[Any]:
        height, width = self.env.worlds.shape
        subgoals, states = self.env.config.decision.frontiers.max_subgoals, self.env.task.dfa.num_states
        longest = max(height, width) - 1
        # No shortest path visits a product state twice, and no step is longer than a diagonal.
        farthest = 1.5 * height * width * states * float(self.env.worlds.resolution[0])

        def box(low: float | int, high: float | int, *shape: int, dtype: Any = np.int32) -> spaces.Box:
            return spaces.Box(low, high, shape, dtype)

        return spaces.Dict(
            {
                "cells": box(-1, 1, height, width, dtype=np.int8),
                "letters": box(0, 2 ** len(self.env.task.propositions) - 1, height, width),
                "position": box(0, longest, 2),
                "state": box(0, states - 1),
                "subgoals": box(0, longest, subgoals, 2),
                "subgoal_mask": spaces.MultiBinary(subgoals),
                "distances": box(0.0, farthest, subgoals, states, dtype=np.float32),
                "finish_distance": box(0.0, farthest, dtype=np.float32),
                "action_mask": spaces.MultiBinary(self.env.num_actions),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: as in gymnasium.
            options: ``{"world": number}`` asks for one world.

        Returns:
            The first observation and ``info``.
        """
        super().reset(seed=seed)
        # Drawn in any case, so that asking for a world does not shift what comes after.
        drawn = int(self.np_random.integers(self._worlds))
        index = drawn if options is None else int(options.get("world", drawn))
        self._state, time_step = self._reset(self._generator.world(index, self._split))
        return _arrays(time_step.observation), _info(time_step)

    def step(self, action: np.int64) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take an action. An episode that its budget has ended is truncated, any other is terminated."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state, time_step = self._step(self._state, jnp.int32(action))
        ended, goes_on = bool(time_step.last()), float(time_step.discount) > 0.0
        observation = _arrays(time_step.observation)
        return observation, float(time_step.reward), ended and not goes_on, ended and goes_on, _info(time_step)


def _arrays(observation: Observation) -> dict[str, np.ndarray]:
    arrays = {name: np.asarray(getattr(observation, name)) for name in observation.__dataclass_fields__}
    # MultiBinary is of bytes, which NumPy does not take booleans for.
    return {name: value.astype(np.int8) if value.dtype == np.bool_ else value for name, value in arrays.items()}


def _info(time_step: TimeStep) -> dict[str, Any]:
    number = int(time_step.extras["outcome"])
    return {
        "action_mask": np.asarray(time_step.observation.action_mask),
        "cost": float(time_step.extras["cost"]),
        "outcome": OUTCOME_NAMES[number],
    }
