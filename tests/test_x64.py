"""Callers whose own programs have ``jax_enable_x64`` on get what the others get, bit for bit."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import potlp_jax
from potlp_jax import (
    BestFirstConfig,
    DecisionConfig,
    Estimates,
    FrontierConfig,
    SensorConfig,
    Start,
    TaskEnv,
    TrialConfig,
    UctConfig,
)
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.estimator import estimator_file
from potlp_jax.learning.serialization import load_estimator
from potlp_jax.precision import in_32_bits
from potlp_jax.trials.replay import replay_decision
from potlp_jax.trials.robot import initial_belief
from tests.reference.toy_plan import TASK, C, S, plan, problem

TOY = potlp_jax.make("toy")
CONFIG = TrialConfig(
    sensor=SensorConfig(range_cells=5.0),
    decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=4), search=BestFirstConfig(simulations=20)),
)


@pytest.fixture(scope="module", autouse=True)
def wide() -> Iterator[None]:
    with jax.enable_x64(True):
        assert jnp.zeros(1).dtype == np.float64
        yield


CHANCES = np.random.default_rng(0).uniform(0.1, 0.9, (4, S, C)).astype(np.float32)


def assert_same(found, expected):
    """Two pytrees of the same types and bits."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert one.dtype == other.dtype
        if not jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(one, other)


def narrow(function, *arguments):
    """What the same calls give without the switch."""
    with jax.enable_x64(False):
        return function(*arguments)


@pytest.mark.parametrize(
    ("config", "transformed"),
    [
        (BestFirstConfig(simulations=20), lambda function: jax.jit(jax.vmap(function))),
        # The batching rule of the search is called where the library's own functions have returned.
        (BestFirstConfig(simulations=20), lambda function: jax.vmap(jax.jit(function))),
        (UctConfig(simulations=20), lambda function: jax.vmap(jax.jit(function))),
    ],
    ids=["jit of vmap", "vmap of jit", "vmap of jit, PO-UCT"],
)
def test_a_plan_within_a_program_of_64_bits(config, transformed):
    def planned(chances):
        # `plan` is wrapped anew, so that no program of the other kind is found.
        return transformed(lambda chances: plan(chances, jax.random.key(0), config))(chances)

    found = planned(jnp.asarray(CHANCES, jnp.float64))
    assert found.value.dtype == jnp.float32
    assert_same(
        found,
        narrow(lambda: transformed(lambda chances: plan(chances, jax.random.key(0), config))(jnp.asarray(CHANCES))),
    )


def test_a_move_from_a_cell_of_64_bits():
    def move(kind):
        world = TOY.world(0)
        belief = potlp_jax.observe(initial_belief(world, CONFIG), world, world.start, CONFIG.sensor)
        state, key = TASK.arrays.initial, jax.random.key(0)
        subgoals = potlp_jax.frontier_subgoals(belief, world.start, state, TASK.arrays, CONFIG.decision)
        costs = jnp.full((subgoals.mask.shape[0], C), 5.0, jnp.float32)
        estimates = Estimates(success_probability=costs / 10, success_cost=costs, failure_cost=costs)
        decide = jax.jit(potlp_jax.decide_from_estimates, static_argnums=7)
        return decide(belief, subgoals, estimates, TASK.arrays, world.start.astype(kind), state, key, CONFIG.decision)

    assert_same(move(jnp.int64), narrow(move, jnp.int32))


@pytest.mark.parametrize("policy", ["baseline", "oracle"])
def test_a_trial_of_a_program_of_64_bits(policy):
    def trial():
        done = potlp_jax.run(TOY, 2, policy, world=1, config=CONFIG)
        return done.outcome, done.cost, done.path, done.status, [move.value for move in done.decisions]

    found = trial()
    assert found == narrow(trial)
    assert found[0] == "satisfied"


def test_a_batch_of_trials_leaves_the_switch_on_between_its_results():
    def figures():
        starts = [Start(TOY.world(n), TASK.arrays, jax.random.key(n), name=n) for n in range(3)]
        for trial in potlp_jax.run_batch(starts, "baseline", CONFIG, slots=2):
            yield jnp.zeros(1).dtype, (trial.name, trial.outcome, trial.cost, trial.path.tolist())

    found = list(figures())
    assert {kind for kind, _ in found} == {np.dtype("float64")}
    assert [entry for _, entry in found] == [entry for _, entry in narrow(lambda: list(figures()))]


def test_worlds_are_the_same():
    key = world_key(Split.VALIDATION, 0, "rooms")
    assert_same(potlp_jax.make("rooms").generate(key), narrow(potlp_jax.make("rooms").generate, key))


def test_an_episode_of_64_bits():
    def episode():
        env = TaskEnv([TOY.world(0), TOY.world(1)], TASK, CONFIG)
        state, first = jax.jit(env.reset)(jax.random.key(0))
        action = jnp.argmax(first.observation.action_mask)
        return jax.jit(env.step)(state, action)[1]

    assert_same(episode(), narrow(episode))


def test_the_exact_solution_of_a_problem_made_with_64_bits():
    def value():
        made = problem(CHANCES[0], np)
        made.check()
        return potlp_jax.solve_exact(made).value

    assert value() == narrow(value)


def test_arguments_are_rounded_and_results_are_the_callers():
    @in_32_bits
    def doubled(numbers, name):
        assert jnp.zeros(1).dtype == np.float32
        return 2 * numbers["values"], name

    values, name = doubled({"values": jnp.arange(3.0)}, "kept")
    assert (values.dtype, name) == (np.float32, "kept")
    assert jnp.zeros(1).dtype == np.float64


def test_an_estimator_is_read_as_without_the_switch():
    path = estimator_file("firefighting-panorama")
    params, *_ = load_estimator(path)
    expected, *_ = narrow(load_estimator, path)
    assert_same(params, expected)


def test_a_decision_is_searched_again_as_without_the_switch():
    trial = potlp_jax.run_trial(TOY.world(1), TASK, "oracle", jax.random.key(0), CONFIG, environment="toy")
    assert_same(replay_decision(trial, 1), narrow(replay_decision, trial, 1))
