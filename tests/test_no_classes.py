"""Formulas that ask nothing of what is unobserved (``X X goal``: no state lasts): every policy copes with them."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from potlp_jax.cli import app
from potlp_jax.environments.toy import Toy, ToyConfig
from potlp_jax.errors import TaskError
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.rl.episodes import OUTCOME_NAMES, TaskEnv
from potlp_jax.task.task import Task, TaskSizes
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome, load_trial
from potlp_jax.trials.replay import Views, replay_decision
from potlp_jax.verify.audit import problems_of
from potlp_jax.view.replay_page import replay_page
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.sensing import SensorConfig
from tests.reference.domains import domain_of

TOY = Toy(ToyConfig(door_row=4, start=(4, 2), goal=(2, 12), hazard=(6, 9)))
GOAL = 1 << TOY.propositions.index("goal")


def _world():
    """A goal two moves from the start, in sight."""
    world = TOY.generate(jax.random.key(0))
    return dataclasses.replace(world, letters=world.letters.at[4, 4].set(GOAL))


WORLD = _world()
FORMULAS = {
    "X X goal": Outcome.SATISFIED,
    "F[2:5] goal": Outcome.SATISFIED,
    "X X X true": Outcome.SATISFIED,
    # The hazard is too far away.
    "X X hazard": Outcome.INFEASIBLE,
    "F[1:2] hazard": Outcome.INFEASIBLE,
}
BEST_FIRST = TrialConfig(
    sensor=SensorConfig(range_cells=3.0),
    decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=4), search=BestFirstConfig(simulations=20)),
)
UCT = dataclasses.replace(
    BEST_FIRST, decision=dataclasses.replace(BEST_FIRST.decision, search=UctConfig(simulations=20))
)


def _network():
    config = NetworkConfig(
        propositions=TOY.propositions, first_widths=(4,) * 4, second_widths=(4,) * 8, dense_widths=(8,) * 4
    )
    params = EstimatorNetwork(config).init(jax.random.key(0))
    return TrainedEstimator(
        params=params, config=config, domain=domain_of("toy"), metadata={}, name="untrained", digest=""
    )


NETWORK = _network()
CASES = [(Policy.ORACLE, BEST_FIRST), (Policy.POTLP, BEST_FIRST), (Policy.POTLP, UCT)]


TASKS = {formula: Task.from_formula(formula, propositions=TOY.propositions) for formula in FORMULAS}
# Of one size, so that a policy is compiled once for all of them.
SIZES = functools.reduce(TaskSizes.union, [task.sizes for task in TASKS.values()])


@pytest.mark.long
@pytest.mark.parametrize("formula", FORMULAS)
@pytest.mark.parametrize(("policy", "config"), CASES, ids=["oracle", "network", "network-uct"])
def test_a_search_ends_as_the_baseline_does(formula, policy, config):
    task = TASKS[formula]
    assert not task.classes
    arrays = task.padded(SIZES)
    reference = run_trial(WORLD, task, Policy.BASELINE, jax.random.key(0), BEST_FIRST, arrays=arrays)
    trial = run_trial(WORLD, task, policy, jax.random.key(0), config, arrays=arrays, estimator=NETWORK)
    assert trial.outcome is reference.outcome is FORMULAS[formula]
    assert trial.cost == reference.cost
    assert trial.path == reference.path
    # The auditor reads the same formulas by a parser of its own.
    assert problems_of(trial, task, WORLD) == []


@pytest.mark.long
def test_a_batch_beside_a_task_that_has_classes():
    tasks = [*TASKS.values(), Task.from_formula("F goal", propositions=TOY.propositions)]
    sizes = SIZES.union(tasks[-1].sizes)
    starts = [Start(WORLD, task.padded(sizes), jax.random.key(0), name=task) for task in tasks]
    found = {
        trial.name.text: trial.outcome
        for trial in run_batch(starts, Policy.POTLP, BEST_FIRST, slots=3, estimator=NETWORK)
    }
    assert found == {**FORMULAS, "F goal": Outcome.SATISFIED}


def test_an_episode_is_the_baselines_trial():
    task = TASKS["X X goal"]
    env = TaskEnv([WORLD], task, BEST_FIRST)
    state, step = env.reset_in(WORLD)
    mask = np.asarray(step.observation.action_mask)
    # The one edge of the arrays is padding.
    assert (env.num_actions, mask.tolist()) == (4 + 2, [False] * 4 + [True, True])
    _, last = env.step(state, jnp.int32(env.num_actions - 1))
    assert OUTCOME_NAMES[int(last.extras["outcome"])] == Outcome.SATISFIED
    assert float(last.reward) == -run_trial(WORLD, task, Policy.BASELINE, jax.random.key(0), BEST_FIRST).cost
    with pytest.raises(TaskError, match="there is nothing to do for 'true': every word satisfies it"):
        TaskEnv([WORLD], WORLD.task("true"), BEST_FIRST)


def test_its_record_is_read_searched_again_and_shown(tmp_path):
    task = TASKS["X X goal"]
    trial = run_trial(WORLD, task, Policy.ORACLE, jax.random.key(0), BEST_FIRST, arrays=task.padded(SIZES))
    trial.save(tmp_path / "trial.json")
    read = load_trial(tmp_path / "trial.json")
    assert read.decisions == trial.decisions
    _, plan, _ = replay_decision(read, 0)
    assert float(plan.value) == pytest.approx(trial.decisions[0].value)
    assert "finish" in replay_page(read, Views())
    shown = CliRunner().invoke(app, ["explain", f"{tmp_path}:0", "--json"])
    assert shown.exit_code == 0, shown.output
    (action,) = json.loads(shown.stdout)["actions"]
    assert action["subgoal"] is None


def test_arrays_have_a_row_of_padding_where_there_is_nothing():
    arrays = TASKS["X X goal"].arrays
    assert arrays.edges.shape == (1, 2)
    assert arrays.class_phi.shape == (1, 2, 2)
    for mask in (arrays.edge_mask, arrays.class_mask, arrays.condition_mask):
        assert not np.any(mask)
