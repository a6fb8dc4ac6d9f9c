"""Policies and estimators of a user's own: functions in place of the library's names, in loop and batch."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from potlp_jax.environments.rooms import Rooms
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import PotlpError, RecordError
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.move import MoveKind, move_to
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.task.task import Task
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.live import run_robot
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome, load_trial
from potlp_jax.trials.replay import replay_decision
from potlp_jax.trials.robot import Leg, SimulatedRobot
from potlp_jax.verify.audit import problems_of, problems_of_path
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import pad_world
from potlp_jax.world.sensing import SensorConfig

ROOMS = Rooms.toy()
TASK = Task.from_formula("F(a & F c)", propositions=ROOMS.propositions)
CONFIG = TrialConfig(
    sensor=SensorConfig(range_cells=6.0),
    decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=4), search=BestFirstConfig(simulations=20)),
)
KEYS = [jax.random.key(number) for number in range(3)]
SHAPE = (ROOMS.config.largest, ROOMS.config.largest)
WORLDS = [pad_world(ROOMS.generate(world_key(Split.VALIDATION, number, ROOMS.name)), *SHAPE) for number in range(3)]


def _go(situation, config, wanted):
    """Finish in known space where that is possible, otherwise go to the reachable subgoal that is wanted most."""
    rows, columns = situation.subgoals.cells[:, 0], situation.subgoals.cells[:, 1]
    distances = situation.distances[rows, columns]
    can_reach = situation.subgoals.mask & jnp.any(jnp.isfinite(distances), axis=1)
    subgoal = jnp.argmax(jnp.where(can_reach, wanted, -jnp.inf))
    finishes = jnp.isfinite(situation.finish_cost)
    kind = jnp.where(finishes, MoveKind.FINISH, jnp.where(jnp.any(can_reach), MoveKind.FRONTIER, MoveKind.NONE))
    cell = jnp.where(finishes, situation.finish_cell, situation.subgoals.cells[subgoal])
    state = jnp.where(finishes, situation.finish_state, jnp.argmin(distances[subgoal]).astype(jnp.int32))
    return move_to(situation, config, kind, cell, state, jnp.min(distances))


def random_frontier(situation, estimates, key, config, intention):
    """Any subgoal that can be reached."""
    assert estimates is None
    return _go(situation, config, jax.random.uniform(key, situation.subgoals.mask.shape))


def likeliest_frontier(situation, estimates, key, config, intention):
    """The subgoal beyond which anything succeeds most likely."""
    return _go(situation, config, jnp.max(estimates.success_probability, axis=1))


def southern(belief, subgoals, task):
    """An estimator that believes in the south."""
    shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
    chance = jnp.broadcast_to(subgoals.cells[:, :1] / belief.cells.shape[0], shape)
    return Estimates(success_probability=chance, success_cost=jnp.full(shape, 9.0), failure_cost=jnp.full(shape, 4.0))


CASES = [(random_frontier, None), (likeliest_frontier, southern), (Policy.POTLP, southern)]


@pytest.mark.long
@pytest.mark.parametrize(("policy", "estimator"), CASES, ids=["random", "likeliest", "potlp"])
def test_a_policy_of_ones_own_takes_the_same_path_alone_and_in_a_batch(policy, estimator):
    starts = [Start(world, TASK.arrays, key, name=n) for n, (world, key) in enumerate(zip(WORLDS, KEYS, strict=True))]
    finished = {trial.name: trial for trial in run_batch(starts, policy, CONFIG, slots=2, estimator=estimator)}
    for number, start in enumerate(starts):
        trial = run_trial(start.world, TASK, policy, start.key, CONFIG, estimator=estimator)
        assert problems_of(trial, TASK, start.world) == []
        assert [list(cell) for cell in trial.path] == finished[number].path.tolist()
        assert (trial.outcome, trial.cost) == (finished[number].outcome, finished[number].cost)


def test_what_a_key_draws_is_up_to_the_policy():
    paths = {tuple(run_trial(world, TASK, random_frontier, key, CONFIG).path for world in WORLDS) for key in KEYS}
    assert len(paths) > 1


def test_a_policy_of_ones_own_has_its_name_in_the_record(tmp_path):
    trial = run_trial(WORLDS[0], TASK, likeliest_frontier, KEYS[0], CONFIG, estimator=southern)
    trial.save(tmp_path / "trial.json")
    assert load_trial(tmp_path / "trial.json").policy == f"{__name__}:likeliest_frontier"
    with pytest.raises(RecordError, match="does not search"):
        replay_decision(trial, 0)


def test_a_robot_is_driven_by_its_three_methods_alone():
    """Everything but the true map: the run is the trial's, and the auditor needs nothing else."""
    robot = SimulatedRobot(WORLDS[0], CONFIG)
    run = run_robot(robot, TASK, "baseline", KEYS[0], CONFIG)
    trial = run_trial(WORLDS[0], TASK, "baseline", KEYS[0], CONFIG)
    assert (run.outcome, run.cost, run.path, run.states) == (trial.outcome, trial.cost, trial.path, trial.states)
    assert problems_of_path(WORLDS[0], run.path, run.cost, run.outcome, TASK.text) == []
    with pytest.raises(PotlpError, match="asks the true map"):
        run_robot(SimulatedRobot(WORLDS[0], CONFIG), TASK, "oracle", KEYS[0], CONFIG)


def test_a_robot_that_ends_or_stands_still_ends_the_run():
    class Stubborn:
        """Observes, and does what it wants."""

        def __init__(self, leg):
            self.robot, self.leg = SimulatedRobot(WORLDS[0], CONFIG), leg

        def observe(self):
            return self.robot.observe()

        def panorama(self):
            return self.robot.panorama()

        def advance(self, path, stop):
            return self.leg

    ended = run_robot(Stubborn(Leg(cells=(), ended=True)), TASK, "baseline", KEYS[0], CONFIG)
    assert (ended.outcome, len(ended.decisions)) == (Outcome.UNFINISHED, 1)
    still = run_robot(Stubborn(Leg(cells=())), TASK, "baseline", KEYS[0], CONFIG)
    assert (still.outcome, len(still.decisions)) == (Outcome.STUCK, 2)


def test_the_auditor_finds_what_is_wrong_with_a_path():
    trial = run_trial(WORLDS[0], TASK, "baseline", KEYS[0], CONFIG)
    assert trial.outcome is Outcome.SATISFIED

    def problems(**changes):
        changed = dataclasses.replace(trial, **changes)
        return problems_of_path(WORLDS[0], changed.path, changed.cost, changed.outcome, TASK.text)

    assert problems() == []
    assert "cost" in problems(cost=trial.cost + 0.5)[0]
    assert problems(outcome=Outcome.STUCK) == ["outcome stuck is not what the word says"]
    assert "illegal move" in problems(path=(trial.path[0], *trial.path[2:]))
    assert problems(path=trial.path[:-1])[-1] == "outcome satisfied is not what the word says"
