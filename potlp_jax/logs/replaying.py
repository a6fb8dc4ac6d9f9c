"""What a policy would have decided at each moment of a drive: the loop of a trial, with a log for a robot."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, PRNGKeyArray, UInt8

from potlp_jax.errors import LogError
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.observing import ObservingEstimator
from potlp_jax.logs.drive import Drive, PanoramaReader
from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy, PolicyFunction, named_policy
from potlp_jax.task.propositions import require_same_propositions
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import drive as drive_robot
from potlp_jax.trials.loop import make_trial
from potlp_jax.trials.record import LOG_PREFIX, NEVER_SEEN, Trial
from potlp_jax.trials.replay import Panorama, Views, recall_views
from potlp_jax.trials.robot import Leg
from potlp_jax.trials.rules import Knowledge, Stop, estimator_of
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import BeliefMap
from potlp_jax.world.moves import Cell, as_cell, path_length


class LoggedRobot:
    """A robot that goes where the log says, whatever it is told.

    It hands back control where a simulated robot would that goes the same way (``rules.Stop``), but only once the map
    has changed: until then there is nothing to decide. With a ``reader`` of panoramas it goes on to the next cell that
    has a picture. A budget does not stop it, for the log does not end there.
    """

    def __init__(self, drive: Drive, reader: PanoramaReader | None = None) -> None:
        self._drive, self._reader, self._step = drive, reader, 0
        # Of the last advance: whoever asks for the first of them again would have the log read from its start.
        self._pictures: list[Panorama | None] = []

    @property
    def ended(self) -> bool:
        """Whether the log has ended."""
        return self._step == len(self._drive.path) - 1

    def observe(self) -> tuple[BeliefMap, Cell]:
        """The map as it was known, and the robot's cell."""
        return self._drive.belief_at(self._step), self._drive.path[self._step]

    def panorama(self) -> UInt8[Array, "rows columns 3"]:
        """What the camera saw from the robot's cell.

        Raises:
            LogError: there is no picture, or it is of no use.
        """
        seen = self._pictures[-1] if self._pictures else self._first_picture()
        if seen is None:
            raise LogError(f"{self._drive.log.path}: there is no picture of cell number {self._step} of the path")
        return jnp.asarray(seen)

    def panorama_before(self, back: int) -> UInt8[Array, "rows columns 3"] | None:
        """What the camera saw on the last advance, ``back`` cells before the robot's cell, where there is a picture."""
        seen = self._pictures[-1 - back]
        return None if seen is None else jnp.asarray(seen)

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Go on along the log; ``path`` tells where its target was reached."""
        start, path_taken = self._step, self._drive.path
        before = Knowledge.of(self._drive.belief_at(start))
        stop = dataclasses.replace(stop, budget=jnp.float32(jnp.inf))
        planned = [as_cell(cell) for cell in np.asarray(path.cells)[: int(path.length) + 1]]
        target = jnp.asarray(planned[-1], jnp.int32)
        follows = True
        self._pictures = []
        while not self.ended:
            self._step += 1
            self._pictures.append(None if self._reader is None else self._reader.panorama(self._step))
            moved, here = self._step - start, path_taken[self._step]
            follows = follows and moved < len(planned) and here == planned[moved]
            # A plan may pass its target's cell before it ends there.
            arrived = here == planned[-1] and (moved == len(planned) - 1 or not follows)
            if not self._map_changed_since(start):
                continue
            travelled = jnp.float32(path_length(path_taken[start : self._step + 1]))
            is_due = arrived or bool(_is_due(stop, before, self._drive.belief_at(self._step), target, travelled))
            if is_due and self._can_decide():
                break
        return Leg(cells=path_taken[start + 1 : self._step + 1], ended=self.ended)

    def _first_picture(self) -> Panorama | None:
        return None if self._reader is None else self._reader.panorama(self._step)

    def _map_changed_since(self, start: int) -> bool:
        # Asked of the array of all steps: beliefs are made only where there is something new in them.
        first_seen = self._drive.first_seen
        return bool(np.any((first_seen > start) & (first_seen <= self._step)))

    def _can_decide(self) -> bool:
        """Whether a policy can decide here: always, unless it needs a picture."""
        return self._reader is None or self._pictures[-1] is not None


_is_due = jax.jit(Stop.is_due)

_NO_BUDGET = 1e30
"""``budget_factor`` of a drive that no budget ends: more cells than any log has, and a number in single precision."""


def replay(
    drive: Drive,
    task: Task,
    policy: Policy | PolicyFunction,
    key: PRNGKeyArray,
    config: TrialConfig | None = None,
    estimator: TrainedEstimator | Estimator | None = None,
) -> tuple[Trial, Views]:
    """The decisions of a policy along a drive, as the record of a trial, up to where the task was decided.

    The policy decides; the robot goes where it was driven. No budget ends the trial, and its path is the one that was
    driven.

    Args:
        drive: what the log says.
        task: what would have been to do.
        policy: one of the library's, or a function of one's own (``planning.policies.PolicyFunction``).
        key: drives the planner's search.
        config: settings; the sensor is the log's own.
        estimator: what the policy asks. No shipped estimator was made for logs: ``potlp`` asks none but the one given.

    Returns:
        The trial, and what the robot saw and made of it at its decisions.

    Raises:
        LogError: the policy needs panoramas and the log has none, or it needs no log.
        PropositionsError: the labels, the task and the estimator are not over the same propositions.
        EstimatorError: the policy is ``potlp``, and no estimator is given.

    Warns:
        PotlpWarning: the estimator given was made for other worlds.
    """
    policy = named_policy(policy)
    if policy is Policy.KNOWN_MAP:
        raise LogError("the policy known-map knows all from the start: choose baseline, optimistic, oracle or potlp")
    require_same_propositions(
        task.propositions, drive.propositions, asker=f"the task {task.text!r}", knower="the labels of the log"
    )
    config = TrialConfig() if config is None else config
    here = Domain.of_world(drive.world, config.camera)
    asked = estimator_of(policy, task.propositions, here, estimator)
    reader = None
    if isinstance(asked, TrainedEstimator | ObservingEstimator):
        drive = from_first_picture(drive, config.camera)
        reader = PanoramaReader(drive, config.camera)
    run = drive_robot(
        LoggedRobot(drive, reader),
        task,
        policy,
        key,
        dataclasses.replace(config, budget_factor=_NO_BUDGET),
        estimator=asked,
        world=drive.world,
    )
    # What was seen after the task was decided is no part of the trial.
    first_seen = np.where(drive.first_seen < len(run.path), drive.first_seen, NEVER_SEEN).astype(np.int32)
    environment = f"{LOG_PREFIX}{Path(drive.log.path).name}"
    trial = make_trial(
        run, task, policy, config, asked, drive.world, first_seen, environment=environment, world_number=None
    )
    return trial, _views(drive, trial, config, asked)


def _views(drive: Drive, trial: Trial, config: TrialConfig, asked: TrainedEstimator | Estimator | None) -> Views:
    # A reader of its own: asked for the steps in their order, it does not start the log again for each.
    return recall_views(trial, asked, config, PanoramaReader(drive, config.camera).panorama)


def from_first_picture(drive: Drive, camera: CameraConfig) -> Drive:
    """The drive from the first cell on of which there is a picture. Raises LogError where there is none."""
    reader = PanoramaReader(drive, camera)
    first = next((step for step in sorted(drive.pictures) if reader.panorama(step) is not None), None)
    if first is None:
        raise LogError(
            f"{drive.log.path}: has no panorama, and the policy potlp needs them: record "
            "sensor_msgs/CompressedImage, or choose --policy baseline"
        )
    first_seen: Int32[np.ndarray, "H W"] = drive.first_seen
    return dataclasses.replace(
        drive,
        world=dataclasses.replace(drive.world, start=jnp.asarray(drive.path[first], jnp.int32)),
        path=drive.path[first:],
        times=drive.times[first:],
        first_seen=np.where(first_seen == NEVER_SEEN, NEVER_SEEN, np.maximum(first_seen - first, 0)).astype(np.int32),
        pictures={step - first: picture for step, picture in drive.pictures.items() if step >= first},
        bearings={step - first: angle for step, angle in drive.bearings.items() if step >= first},
    )
