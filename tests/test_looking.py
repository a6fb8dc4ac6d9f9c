"""When the camera looks: in a trial, in a batch, in a replay and in a collection, told by an estimator that counts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from potlp_jax.learning import recording
from potlp_jax.learning.painting import blank_painting, paint
from potlp_jax.learning.sample_weights import WeightBounds
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.recipes.policy_drives import policy_drives
from potlp_jax.task.task import Task
from potlp_jax.trials import loop as trial_module
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.replay import estimator_at
from potlp_jax.trials.robot import SimulatedRobot
from potlp_jax.trials.setbacks import SetbackConfig, Setbacks
from potlp_jax.world.camera import CameraConfig, Disturbance
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.grid import make_world
from potlp_jax.world.renderer import render
from potlp_jax.world.sensing import SensorConfig

# Operation by operation they would be hundreds of programs.
_render = jax.jit(render, static_argnums=2)
_paint = jax.jit(paint, static_argnums=4)
NAMES = ("goal", "hazard")
CONFIG = TrialConfig(
    sensor=SensorConfig(range_cells=3.0),
    camera=CameraConfig(height=16, width=64, horizon=6.0, fold=2.0),
    decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=4), search=BestFirstConfig(simulations=20)),
)
TASK = Task.from_formula("!hazard U goal", propositions=NAMES)


@struct.dataclass
class Counter:
    """Remembers how often the camera looked from each cell, and answers with it."""

    memory: jax.Array
    on_the_way: bool = struct.field(pytree_node=False, default=True)

    @property
    def looks_on_the_way(self):
        return self.on_the_way

    def encode(self, panorama):
        # The picture itself is not needed, but that there is one.
        return jnp.int32(panorama.shape[0] > 0)

    def remember(self, seen, belief, cell):
        return dataclasses.replace(self, memory=self.memory.at[cell[0], cell[1]].add(seen))

    def __call__(self, belief, subgoals, task):
        # Another number of looks is another preference, so that a look too many or too few leads elsewhere.
        index = jnp.arange(subgoals.mask.shape[0], dtype=jnp.int32)
        chance = ((jnp.sum(self.memory) * 7 + index * 5) % 11 + 1).astype(jnp.float32) / 12
        shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
        return Estimates(
            success_probability=jnp.where(task.class_mask[None, :], jnp.broadcast_to(chance[:, None], shape), 0.0),
            success_cost=jnp.full(shape, 10.0),
            failure_cost=jnp.full(shape, 10.0),
        )


def _world():
    """Three rooms in a row, the goal in the last."""
    occupied = np.ones((11, 32), bool)
    for left in (1, 11, 21):
        occupied[1:-1, left : left + 9] = False
    occupied[2, 10] = occupied[8, 20] = False
    letters = np.zeros(occupied.shape, np.int32)
    letters[2, 28] = 1
    return make_world(occupied, letters, (8, 2), propositions=NAMES)


WORLD = _world()


def _counter(on_the_way=True):
    return Counter(memory=jnp.zeros(WORLD.shape, jnp.int32), on_the_way=on_the_way)


def _looks(trial, every):
    """The steps at which the camera looked, as the page says it: written down one by one."""
    steps = []
    for number, decision in enumerate(trial.decisions):
        before = trial.decisions[number - 1].step if number else decision.step
        for step in range(before + 1, decision.step):
            if every and (step - before) % every == 0:
                steps.append(step)
        steps.append(decision.step)
    return steps


def _counts(trial, steps):
    expected = np.zeros(WORLD.shape, int)
    for step in steps:
        expected[trial.path[step]] += 1
    return expected


def _loop(robot, config):
    """The loop of a policy that asks a counter, whatever the shape of the map."""
    key, setbacks = jax.random.key(0), Setbacks(SetbackConfig())
    return trial_module._Loop(
        robot, TASK, TASK.arrays, Policy.POTLP, lambda shape: _counter(), key, config, setbacks, None
    )


@pytest.mark.long
@pytest.mark.parametrize(("every", "on_the_way"), [(1, True), (2, True), (0, True), (1, False)])
def test_the_camera_looks_as_often_as_is_said_and_a_batch_and_a_replay_do_the_same(every, on_the_way):
    config = dataclasses.replace(CONFIG, look_every=every)
    estimator = _counter(on_the_way)
    trial = run_trial(WORLD, TASK, Policy.POTLP, jax.random.key(0), config, estimator=estimator)
    assert len(trial.decisions) > 4
    steps = _looks(trial, every if on_the_way else 0)
    # Otherwise nothing is told apart.
    assert (len(steps) > len(trial.decisions)) == bool(every and on_the_way)
    last = estimator_at(trial, len(trial.decisions) - 1, estimator)
    assert isinstance(last, Counter)
    np.testing.assert_array_equal(last.memory, _counts(trial, steps))
    # The loop's own answers came from as many looks; what ends the task in known space is certain.
    chances = {action.success_probability for action in trial.decisions[-1].actions} - {1.0}
    assert chances
    assert chances <= {np.float32(((len(steps) * 7 + index * 5) % 11 + 1) / 12) for index in range(4)}
    starts = [Start(WORLD, TASK.arrays, jax.random.key(number), name=number) for number in range(3)]
    for found in run_batch(starts, Policy.POTLP, config, slots=2, estimator=estimator):
        np.testing.assert_array_equal(found.path, np.asarray(trial.path))


def test_a_robot_that_keeps_no_pictures_of_its_way_is_asked_at_decisions_alone():
    robot = SimulatedRobot(WORLD, CONFIG)

    class Forgetful:
        observe, panorama, advance = robot.observe, robot.panorama, robot.advance

    loop = _loop(Forgetful(), CONFIG)
    run = loop.run(*robot.observe())
    assert isinstance(loop._estimator, Counter)
    assert int(jnp.sum(loop._estimator.memory)) == len(run.decisions)


def test_pictures_of_the_way_are_those_of_its_cells():
    """Disturbed, so that each number of moves has a picture of its own."""
    config = dataclasses.replace(CONFIG, disturbance=Disturbance(noise=10.0))
    robot = SimulatedRobot(WORLD, config, jax.random.key(3))
    seen, seen_before = [], []

    class Watching:
        observe, advance = robot.observe, robot.advance

        def panorama(self):
            seen.append((robot.observe()[1], np.asarray(robot.panorama())))
            return robot.panorama()

        def panorama_before(self, back):
            seen_before.append(np.asarray(robot.panorama_before(back)))
            return robot.panorama_before(back)

    run = _loop(Watching(), config).run(*robot.observe())
    between = [step for step in _looks(run, 1) if step not in {decision.step for decision in run.decisions}]
    assert len(between) == len(seen_before)
    for step, image in zip(between, seen_before, strict=True):
        own = np.asarray(_render(WORLD, jnp.asarray(run.path[step], jnp.int32), config.camera)).astype(int)
        # The noise has a mean of 0; another cell's picture differs by much more.
        assert np.abs(image - own).mean() < 12
    assert len({image.tobytes() for image in seen_before}) == len(seen_before)
    assert [cell for cell, _ in seen] == [decision.cell for decision in run.decisions]


@pytest.mark.parametrize("every", [0, 1, 3])
def test_a_collection_paints_what_the_camera_sees_on_the_way(every):
    config = recording.RecordingConfig(camera=CONFIG.camera, look_every=every, spacing=(0.0, 0.0))
    (poses,) = policy_drives(WORLD, [TASK], Policy.BASELINE, None, CONFIG, jax.random.key(0))
    trial = run_trial(WORLD, TASK, Policy.BASELINE, jax.random.key(0), CONFIG)
    assert [pose.cell for pose in poses] == [decision.cell for decision in trial.decisions]
    asked, painted = [], {}

    class Keeping(recording.Recorder):
        def add(self, world, pose, image, seen, scene, questions):
            painted[pose.step] = seen.painting

    def photograph(cell, step):
        asked.append(step)
        assert cell == trial.path[step]
        return np.asarray(_render(WORLD, jnp.asarray(cell, jnp.int32), config.camera))

    keeping = Keeping(0, config, WeightBounds.of_map(*WORLD.shape, 1.0))
    recording.record_views(keeping, WORLD, poses, [TASK], np.random.default_rng(0), photograph, most=100)
    steps = _looks(trial, every)
    assert asked == steps
    assert len(painted) > 3
    expected, number = blank_painting(*WORLD.shape), 0
    for decision in trial.decisions:
        while number < len(steps) and steps[number] <= decision.step:
            cell = jnp.asarray(trial.path[steps[number]], jnp.int32)
            belief = trial.belief_at(decision.step)
            expected = _paint(expected, _render(WORLD, cell, config.camera), belief, cell, config.camera)
            number += 1
        # Where no subgoal is left nothing is recorded.
        if decision.step in painted:
            for mine, its in zip(jax.tree.leaves(expected), jax.tree.leaves(painted.pop(decision.step)), strict=True):
                np.testing.assert_array_equal(mine, its)
    assert not painted
