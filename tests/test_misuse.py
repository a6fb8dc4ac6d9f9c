"""Calls that are easily made wrongly: each ends in one clear error, or does what its documentation says."""

import copy
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import potlp_jax
from potlp_jax import Policy, Start
from potlp_jax.checks import FLAG
from potlp_jax.environments.registry import make
from potlp_jax.errors import BatchError, ProblemError, RobotError, TaskError
from potlp_jax.learning.estimator import identity_of
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.learning.painting import blank_painting, paint
from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.planning.distances.product import product_distances, product_transitions
from potlp_jax.planning.distances.sweeping import Wildcard
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.move import MoveKind
from potlp_jax.planning.policies import search_move
from potlp_jax.planning.search.api import plan_within
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.trials.batch import run_batch
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.rules import asked_of, trial_key
from potlp_jax.trials.watching import WatchedRobot
from potlp_jax.types import NO_ACTION, Status
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.sensing import SensorConfig
from tests.reference.toy_plan import C, S, problem

TOY = make("toy")
WORLD = TOY.world(1)
CAMERA = CameraConfig(height=16, width=32, horizon=6.0, fold=3.0)
CONFIG = TrialConfig(
    sensor=SensorConfig(range_cells=4.0), camera=CAMERA, decision=DecisionConfig(search=BestFirstConfig(simulations=20))
)


def trial(task="2", *, policy=Policy.POTLP, **options):
    task = TOY.task(task) if isinstance(task, str) else task
    return run_trial(WORLD, task, policy, trial_key(1), CONFIG, environment="toy", **options)


# Estimators.


def guess(belief, subgoals, task, scale=5.0):
    shape = (subgoals.mask.shape[0], task.class_mask.shape[0])
    return Estimates(
        success_probability=jnp.where(task.class_mask[None, :], jnp.full(shape, 0.5), 0.0),
        success_cost=jnp.full(shape, scale),
        failure_cost=jnp.full(shape, scale),
    )


class Guesser:
    def __call__(self, belief, subgoals, task):
        return guess(belief, subgoals, task)

    def bound(self, belief, subgoals, task):
        return guess(belief, subgoals, task)


@pytest.mark.parametrize(
    ("estimator", "name"),
    [
        (functools.partial(guess, scale=5.0), "guess"),
        (jax.jit(guess), "guess"),
        (Guesser().bound, "Guesser.bound"),
        (Guesser(), "Guesser"),
    ],
)
def test_anything_that_can_be_called_is_an_estimator(estimator, name):
    found = trial(estimator=estimator)
    assert (found.path, found.versions["estimator"]) == (trial(estimator=guess).path, f"tests.test_misuse:{name}")
    assert identity_of(estimator) == identity_of(asked_of(Policy.POTLP, estimator))


@struct.dataclass
class Lazy:
    """Has no memory before the first picture."""

    memory: object = None

    def encode(self, panorama):
        return jnp.mean(panorama.astype(jnp.float32))

    def remember(self, seen, belief, cell):
        return dataclasses.replace(self, memory=seen)

    def __call__(self, belief, subgoals, task):
        return guess(belief, subgoals, task)


def test_what_does_not_go_into_a_batch_is_named():
    starts = [Start(WORLD, TOY.task("2").arrays, trial_key(1))]
    with pytest.raises(BatchError, match=r"Lazy begins as nothing and is float32\[\] after a picture"):
        list(run_batch(starts, Policy.POTLP, CONFIG, estimator=Lazy()))
    mixed = [starts[0], dataclasses.replace(starts[0], key=jax.random.PRNGKey(0), name="old")]
    with pytest.raises(BatchError, match="'old': its key is of another kind"):
        list(run_batch(mixed, Policy.BASELINE, CONFIG))


@pytest.mark.parametrize("shape", [(8, 8), (9, 40), (20, 15)])
def test_a_painting_of_another_shape_is_refused(shape):
    belief = BeliefMap.revealed(WORLD)
    picture = jnp.zeros((CAMERA.height, CAMERA.width, 3), jnp.uint8)
    with pytest.raises(ValueError, match=r"the painting's floor has \(.*\) cells and the belief \(9, 15\)"):
        paint(blank_painting(*shape), picture, belief, WORLD.start, CAMERA)


# Policies and tasks.


def through_walls(situation, estimates, key, config, intention):
    """Straight on to the right, whatever is there."""
    move = search_move(situation, estimates, key, config, intention)
    steps = jnp.arange(move.path.cells.shape[0], dtype=jnp.int32)
    cells = situation.cell[None] + jnp.stack([0 * steps, jnp.minimum(steps, 9)], axis=1)
    path = KnownPath(
        cells=cells,
        states=jnp.broadcast_to(situation.state, steps.shape),
        length=jnp.int32(9),
        cost=jnp.float32(9.0),
    )
    return dataclasses.replace(move, path=path, kind=jnp.int32(MoveKind.FRONTIER))


def test_a_policy_cannot_send_the_robot_through_walls():
    found = trial(policy=through_walls, estimator=guess)
    assert (found.outcome, len(found.path)) == ("infeasible", 1)
    assert found.decisions[0].status & Status.INVALID
    (batched,) = run_batch([Start(WORLD, TOY.task("2").arrays, trial_key(1))], through_walls, CONFIG, estimator=guess)
    assert (batched.outcome, batched.cost) == (found.outcome, found.cost)


def test_arrays_of_another_task_are_refused():
    task, other = TOY.task("F goal & F hazard"), TOY.task("F goal")
    with pytest.raises(TaskError, match="the arrays are not those of the task 'F goal & F hazard'"):
        trial(task, policy=Policy.BASELINE, arrays=other.arrays)
    padded = task.padded(task.sizes.union(TOY.task("2").sizes))
    assert trial(task, policy=Policy.BASELINE, arrays=padded).path == trial(task, policy=Policy.BASELINE).path


def test_a_task_that_is_done_is_finished_whoever_is_asked():
    task, belief = TOY.task("2"), BeliefMap.revealed(WORLD)
    state = int(np.argmax(task.dfa.accepting))
    for policy, estimator in ((Policy.ORACLE, TrueMapEstimator(world=WORLD)), (Policy.BASELINE, None)):
        move = potlp_jax.decide(
            belief,
            WORLD.start,
            state,
            task.arrays,
            estimator,
            jax.random.key(0),
            policy=policy,
            config=CONFIG.decision,
        )
        assert (int(move.kind), int(move.path.length)) == (MoveKind.FINISH, 0)
        assert not int(move.status) & Status.FALLBACK


def test_a_flag_is_true_or_false():
    assert all(map(FLAG.allows, (True, False, np.bool_(True))))
    assert not any(map(FLAG.allows, ("no", 1, 0, None)))
    for config, name in ((CONFIG, "revealed"), (CONFIG.decision, "irrevocable_last")):
        wrong = copy.copy(config)
        object.__setattr__(wrong, name, "no")
        with pytest.raises(ValueError, match=f"{name} is no; give True or False"):
            wrong.__post_init__()


# Arrays.


def test_a_problem_does_not_change_with_the_callers_arrays():
    chances = [np.full((S, C), 0.25, np.float32) for _ in range(40)]
    made = [problem(array, np) for array in chances]
    for array in chances:
        array[:] = 0.75
    assert all(np.all(np.asarray(one.success_probability) == 0.25) for one in made)


def test_a_wildcard_of_another_map_is_refused():
    task, belief = TOY.task("2"), BeliefMap.revealed(WORLD)
    transitions = product_transitions(task.arrays, belief.letters, belief.free)
    small = Wildcard(cells=jnp.ones((3, 3), bool), successors=jnp.ones((transitions.shape[2],) * 2, bool))
    source = jnp.asarray(WORLD.start)[None], jnp.zeros(1, jnp.int32)
    with pytest.raises(ProblemError, match=r"wildcard.cells has shape \(3, 3\), expected \(9, 15\)"):
        product_distances(transitions, belief.free, *source, belief.resolution, small)


def test_the_planner_runs_without_jit():
    key, config = jax.random.key(0), BestFirstConfig(simulations=10)
    given = problem(np.full((S, C), 0.5, np.float32))
    expected = potlp_jax.plan_actions(given, key, config)
    with jax.disable_jit():
        assert int(potlp_jax.plan_actions(given, key, config).action) == int(expected.action)


@pytest.mark.parametrize("kind", [BestFirstConfig, UctConfig])
def test_a_search_without_actions_ends_before_its_time(kind):
    nothing = dataclasses.replace(problem(np.full((S, C), 0.5, np.float32)), subgoal_mask=jnp.zeros(S, bool))
    config = kind(simulations=5, tree_capacity=50)
    plan, tree = plan_within(nothing, jax.random.key(0), 600.0, config)
    assert int(plan.action) == NO_ACTION
    assert int(tree.simulations) <= 10


# Robots.


class Camera:
    """Stands, and shows what it is told to."""

    def __init__(self, *pictures):
        self.pictures = list(pictures)

    def observe(self):
        raise AssertionError

    def panorama(self):
        return self.pictures.pop(0)

    def advance(self, path, stop):
        raise AssertionError


GOOD = np.zeros((16, 32, 3), np.uint8)


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (None, "an array of uint8 .*, found NoneType"),
        (GOOD.tolist(), "found list"),
        (GOOD.astype(np.float32), "found float32"),
        (GOOD[:, :, 0], r"found uint8\[16, 32\]"),
        (np.zeros((16, 32, 4), np.uint8), r"found uint8\[16, 32, 4\]"),
        (np.zeros((16, 64, 3), np.uint8), r"a picture of \(16, 32, 3\) before, and one of \(16, 64, 3\) now"),
    ],
)
def test_pictures_that_are_none_are_the_robots_fault(picture, said):
    robot = WatchedRobot(Camera(GOOD, picture))
    robot.panorama()
    with pytest.raises(RobotError, match=said):
        robot.panorama()
