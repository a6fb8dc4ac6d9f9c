"""A robot of somebody else's, driven: the loop of a trial, and a record that needs no true map."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy, PolicyFunction, named_policy
from potlp_jax.precision import in_32_bits
from potlp_jax.task.task import Task, TaskArrays
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import BrokenDriveError, Listener, drive, make_trial, shifted_cells, shifted_decision
from potlp_jax.trials.record import ROBOT_PREFIX, Decision, RunRecord, Trial
from potlp_jax.trials.robot import Robot
from potlp_jax.trials.rules import estimator_of
from potlp_jax.trials.setbacks import SetbackConfig
from potlp_jax.trials.watching import WatchedRobot, its_own
from potlp_jax.world.grid import BeliefMap, World, make_world


@in_32_bits
def run_robot(
    robot: Robot,
    task: Task,
    policy: Policy | PolicyFunction | str,
    key: PRNGKeyArray,
    config: TrialConfig | None = None,
    *,
    arrays: TaskArrays | None = None,
    estimator: TrainedEstimator | Estimator | None = None,
    world: World | None = None,
    setbacks: SetbackConfig | None = None,
    seconds_per_cell: float | None = None,
    listener: Listener | None = None,
    name: str = "",
) -> Trial:
    """Drive a robot of your own until the task is satisfied or cannot go on.

    The record's world is the last map that the robot reported: what it never observed is an obstacle there, and never
    seen. What the robot had seen wrongly and took back is kept too, so that every decision can be explained and made
    again from the record.

    Args:
        robot: observes and advances; checked at every call (``trials.watching``).
        task: what to do.
        policy: one of the library's, or a function of one's own (``planning.policies.PolicyFunction``).
        key: drives the search where it samples (``UctConfig``).
        config: settings; the sensor, the camera and ``revealed`` are the simulator's and matter not here.
        arrays: the task's arrays where they shall be padded; by default ``task.arrays``.
        estimator: what the policy asks. What worlds without a true map look like is not known: no shipped estimator
            serves them, and one is asked on request only.
        world: the true map, where it is known; only the policy ``oracle`` asks it.
        setbacks: how often a target is tried whose legs fail, and how long it is set aside then.
        seconds_per_cell: a leg that takes longer is late, which is noted in the record; None: never.
        listener: is told each decision before it is carried out, and the map that it was planned on.
        name: of the robot, for the record.

    Returns:
        The record, as of a trial in simulation.

    Raises:
        RobotError: the robot broke its side of the contract, or it or the listener raised something else. After the
            first observation it is a ``BrokenDriveError``, whose ``trial`` is the record until then: ``unfinished``,
            with the error as its last note.
        PropositionsError: the robot's map, task, estimator and ``world`` are not over the same propositions.
        EstimatorError: no estimator is shipped for the task's propositions in such a world.
        PotlpError: the policy is ``oracle`` and there is no ``world``, or ``known-map``, which no robot can follow.
    """
    policy = named_policy(policy)
    watched = WatchedRobot(robot, seconds_per_cell)
    # No robot of one's own knows the map, whatever the settings of a simulation say.
    config = dataclasses.replace(TrialConfig() if config is None else config, revealed=False)

    def record(run: RunRecord) -> Trial:
        resolution = float(watched.last_map.resolution)
        here = Domain.of_robot(resolution) if world is None else Domain.of_world(world, config.camera)
        asked = estimator_of(policy, task.propositions, here, estimator)
        trial = _recorded(run, watched, task, policy, config, asked)
        return dataclasses.replace(trial, environment=f"{ROBOT_PREFIX}{name}")

    def tell(decision: Decision, belief: BeliefMap) -> None:
        with its_own("the listener"):
            if listener is not None:
                listener(decision, belief)

    try:
        run = drive(
            watched,
            task,
            policy,
            key,
            config,
            arrays=arrays,
            estimator=estimator,
            world=world,
            setbacks=setbacks,
            listener=tell,
        )
    except BrokenDriveError as error:
        trial = record(error.run)
        trial = dataclasses.replace(trial, notes=(*trial.notes, f"the drive ended by an error: {error}"))
        raise BrokenDriveError(str(error), error.run, trial) from error.__cause__
    return record(run)


def _recorded(
    run: RunRecord,
    watched: WatchedRobot,
    task: Task,
    policy: Policy | PolicyFunction,
    config: TrialConfig,
    estimator: TrainedEstimator | Estimator | None,
) -> Trial:
    """The record of a run; its world is what the robot knew at the end."""
    belief, origin = watched.last_map, watched.last_origin
    world = _world_of(belief, run)
    # A world has a closed border: one ring more where the map has none.
    ring = (world.shape[0] - belief.cells.shape[0]) // 2
    run = dataclasses.replace(
        run,
        path=shifted_cells(run.path, ring, ring),
        decisions=tuple(shifted_decision(decision, ring, ring) for decision in run.decisions),
    )
    origin = origin[0] - ring, origin[1] - ring
    first_seen = watched.history.first_seen(origin, world.shape, len(run.path) - 1)
    for step, cell in reversed(list(enumerate(run.path))):
        # Where the robot drove it knew that it could.
        first_seen[cell] = step if first_seen[cell] < 0 else min(step, first_seen[cell])
    extent = tuple(np.asarray(world.extent).tolist())
    extents = [watched.history.extent_of(decision.index) for decision in run.decisions]
    decisions = tuple(
        dataclasses.replace(decision, extent=None if own == extent else own)
        for decision, own in zip(run.decisions, extents, strict=True)
    )
    steps = [decision.step for decision in decisions]
    trial = make_trial(
        dataclasses.replace(run, decisions=decisions),
        task,
        policy,
        config,
        estimator,
        world,
        first_seen,
        environment="",
        world_number=None,
    )
    corrections = watched.history.corrections(world, first_seen, origin, steps)
    return dataclasses.replace(trial, corrections=corrections, notes=watched.notes)


def _world_of(belief: BeliefMap, run: RunRecord) -> World:
    """What is known at the end: all that was never observed is an obstacle, and where the robot was is none."""
    free, letters = np.array(belief.free), np.array(belief.letters)
    for cell, letter in zip(run.path, run.word, strict=True):
        # A map that is corrected later may close a cell that the robot was in.
        if not free[cell]:
            free[cell], letters[cell] = True, letter
    world = make_world(
        ~free,
        letters,
        run.path[0],
        resolution=float(belief.resolution),
        propositions=belief.propositions,
    )
    # Budget and dead ends were counted by the robot's own extent, which a ring does not change.
    if world.shape == belief.cells.shape:
        world = dataclasses.replace(world, extent=jnp.asarray(belief.extent))
    return world
