"""Trials as environments for reinforcement learning: conventions of the field, and agreement with the trials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.environments.rooms import Rooms
from potlp_jax.environments.toy import Toy, ToyConfig
from potlp_jax.errors import WorldError
from potlp_jax.rl.episodes import OUTCOME_NAMES, StepType, TaskEnv
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.rules import trial_key
from potlp_jax.world.grid import make_world

STEPS = 12


@pytest.fixture(scope="module")
def env():
    return TaskEnv.of_family(Toy(ToyConfig(height=7, width=11)), task=2, worlds=range(3))


def random_action(key, time_step):
    """Uniform over the actions that can be taken; any action once there are none."""
    logits = jnp.where(time_step.observation.action_mask, 0.0, -1e9)
    return jax.random.categorical(key, logits).astype(jnp.int32)


def episode(env, key):
    """Steps of a random agent, the first time step left out."""
    state, first = env.reset(key)

    def step(carry, key):
        state, time_step = env.step(carry[0], random_action(key, carry[1]))
        return (state, time_step), time_step

    return first, jax.lax.scan(step, (state, first), jax.random.split(key, STEPS))[1]


def shapes(tree):
    return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


def shapes_of(function, *arguments):
    """Of the leaves that a function would return; whole classes would have their annotations checked."""
    return shapes(jax.eval_shape(lambda *arguments: jax.tree.leaves(function(*arguments)), *arguments))


def test_types_are_the_same_at_every_step(env):
    state, first = jax.jit(env.reset)(jax.random.key(0))
    after, time_step = jax.jit(env.step)(state, jnp.int32(0))
    assert shapes_of(env.reset, jax.random.key(0)) == shapes((state, first))
    assert shapes_of(env.step, state, jnp.int32(0)) == shapes((state, first)) == shapes((after, time_step))
    assert jax.tree.structure((after, time_step)) == jax.tree.structure((state, first))
    assert first.observation.action_mask.shape == (env.num_actions,)


def test_episodes_of_a_random_agent_end_and_stay_ended(env):
    keys = jax.random.split(jax.random.key(1), 4)
    first, steps = jax.jit(jax.vmap(lambda key: episode(env, key)))(keys)
    assert np.all(first.step_type == StepType.FIRST)
    assert np.all(first.reward == 0.0)
    ended = np.asarray(steps.last())
    assert np.all(ended[:, -1]), "the toy's worlds have few frontiers"
    assert np.all(ended[:, 1:] >= ended[:, :-1]), "an episode never goes on after its end"
    assert np.all(np.asarray(steps.reward)[:, 1:][ended[:, :-1]] == 0.0)
    assert not np.any(np.asarray(steps.observation.action_mask)[ended])
    for number in range(4):
        satisfied = OUTCOME_NAMES[int(steps.extras["outcome"][number, -1])] == "satisfied"
        if satisfied:
            assert np.sum(steps.reward[number]) == pytest.approx(-float(steps.extras["cost"][number, -1]), rel=1e-5)
        assert np.all(steps.discount[number][ended[number]] == 0.0)


@pytest.mark.long
def test_the_same_key_gives_the_same_episode_alone_and_in_a_batch(env):
    keys = jax.random.split(jax.random.key(2), 3)
    together = jax.jit(jax.vmap(lambda key: episode(env, key)[1]))(keys)
    alone = [jax.jit(lambda key: episode(env, key)[1])(key) for key in keys]
    for number, steps in enumerate(alone):
        for one, batch in zip(jax.tree.leaves(steps), jax.tree.leaves(together), strict=True):
            np.testing.assert_array_equal(one, batch[number])


def _rewards_of_choices(env, world, actions):
    """Rewards of given actions, and the last time step."""
    state, time_step = jax.jit(env.reset_in)(world)
    step, rewards = jax.jit(env.step), []
    for action in actions:
        assert time_step.observation.action_mask[action]
        state, time_step = step(state, jnp.int32(action))
        rewards.append(float(time_step.reward))
    return rewards, state, time_step


@pytest.mark.parametrize("policy", ["oracle", "baseline"])
def test_an_agent_that_takes_a_planners_choices_makes_its_trial(policy):
    generator = Rooms.toy()
    task, world = generator.task("F a & F b"), generator.world(1)
    trial = run_trial(world, task, policy, trial_key(1))
    env = TaskEnv([world], task)
    nearest = env.num_actions - 1
    actions = [nearest if decision.choice is None else decision.choice for decision in trial.decisions]
    rewards, state, last = _rewards_of_choices(env, world, actions)
    assert bool(last.last())
    assert OUTCOME_NAMES[int(last.extras["outcome"])] == trial.outcome == "satisfied"
    steps = len(trial.path)
    assert tuple(map(tuple, np.asarray(state.progress.path)[:steps].tolist())) == trial.path
    assert sum(rewards) == pytest.approx(-trial.cost, rel=1e-5)
    assert len(trial.decisions) > 2


def test_an_action_that_is_masked_makes_no_move_and_ends_stuck(env):
    state, time_step = jax.jit(env.reset)(jax.random.key(3))
    wrong = int(np.flatnonzero(~np.asarray(time_step.observation.action_mask))[0])
    step = jax.jit(env.step)
    for _ in range(2):
        assert not bool(time_step.last())
        state, time_step = step(state, jnp.int32(wrong))
    assert OUTCOME_NAMES[int(time_step.extras["outcome"])] == "stuck"
    assert float(time_step.extras["cost"]) == 0.0
    # The cost of a dead end: four times the seven rows and eleven columns.
    assert float(time_step.reward) == -4.0 * (7 + 11)


def test_an_episode_that_cannot_be_won_pays_for_its_failure_once():
    """The start violates the task: the first step is the last."""
    world = make_world(
        np.pad(np.zeros((3, 5), bool), 1, constant_values=True),
        np.full((5, 7), 1),
        (2, 2),
        propositions=("goal", "hazard"),
    )
    env = TaskEnv([world], world.task("!goal U hazard"))
    state, first = jax.jit(env.reset)(jax.random.key(0))
    assert (float(first.reward), float(first.discount)) == (0.0, 0.0)
    rewards = []
    for _ in range(3):
        state, time_step = jax.jit(env.step)(state, jnp.int32(0))
        rewards.append(float(time_step.reward))
    assert OUTCOME_NAMES[int(time_step.extras["outcome"])] == "infeasible"
    assert rewards == [-4.0 * (5 + 7), 0.0, 0.0]


@pytest.mark.parametrize("beyond", [-1, -2, 0, 1000])
def test_an_action_that_does_not_exist_makes_no_move(env, beyond):
    state, _ = jax.jit(env.reset)(jax.random.key(3))
    action = beyond if beyond < 0 else env.num_actions + beyond
    _, time_step = jax.jit(env.step)(state, jnp.int32(action))
    assert float(time_step.extras["cost"]) == 0.0


def test_an_episode_that_its_budget_ends_is_truncated():
    generator = Toy(ToyConfig(height=7, width=11))
    tight = TaskEnv([generator.world(0)], generator.task(1), config=TrialConfig(budget_factor=0.1))
    state, time_step = jax.jit(tight.reset)(jax.random.key(0))
    step = jax.jit(tight.step)
    while not bool(time_step.last()):
        state, time_step = step(state, jnp.int32(tight.num_actions - 1))
    assert OUTCOME_NAMES[int(time_step.extras["outcome"])] == "budget"
    assert float(time_step.discount) == 1.0


def test_the_gymnasium_wrapper_passes_gymnasiums_own_check():
    pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'potlp-jax[gym]'")
    from gymnasium.utils.env_checker import check_env

    from potlp_jax.rl.gym import GymTaskEnv

    wrapped = GymTaskEnv(Toy(ToyConfig(height=7, width=11)), task=2, worlds=5)
    check_env(wrapped)
    observation, info = wrapped.reset(seed=3, options={"world": 1})
    cost, ended = 0.0, False
    while not ended:
        action = wrapped.action_space.sample(mask=info["action_mask"].astype(np.int8))
        observation, reward, terminated, truncated, info = wrapped.step(action)
        assert observation in wrapped.observation_space
        cost, ended = cost - reward, terminated or truncated
    assert cost == pytest.approx(info["cost"], rel=1e-5) or info["outcome"] != "satisfied"


def test_worlds_that_do_not_go_together_are_named():
    toy, wide = Toy().world(0), Toy(ToyConfig(width=21)).world(0)
    task = Toy().task("2")
    with pytest.raises(WorldError, match=r"world 1 is of the family 'toy' and has \(9, 21\) cells, the first"):
        TaskEnv([toy, wide], task)
    with pytest.raises(WorldError, match="give worlds of one family with the same settings"):
        TaskEnv([toy, toy.replace(family="another")], task)
