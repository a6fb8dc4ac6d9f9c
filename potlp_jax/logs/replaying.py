"""What a policy would have decided at each moment of a drive: the loop of a trial, with a log for a robot."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Int32, PRNGKeyArray, UInt8

from potlp_jax.errors import LogError
from potlp_jax.learning.estimator import TrainedEstimator, estimator_for
from potlp_jax.learning.labels import TrueMapEstimator
from potlp_jax.logs.drive import Drive, Eyes
from potlp_jax.logs.poses import Cell
from potlp_jax.planning.distances.paths import KnownPath
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import Loop, versions
from potlp_jax.trials.record import LOG_PREFIX, NEVER_SEEN, Outcome, Trial
from potlp_jax.trials.robot import DIAGONAL, Leg, Stop
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import BeliefMap


class LoggedRobot:
    """A robot that goes where the log says, whatever it is told.

    It hands back control where a simulated robot would that goes the same way: when the map has changed, and the target
    was reached or is no frontier any more, a new proposition was seen, or the replan distance was travelled. While the
    map does not change there is nothing to decide. With ``eyes`` it goes on to the next cell that has a picture.
    """

    def __init__(self, drive: Drive, eyes: Eyes | None = None) -> None:
        self._drive, self._eyes, self._step = drive, eyes, 0

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
        seen = None if self._eyes is None else self._eyes.panorama(self._step)
        if seen is None:
            raise LogError(f"{self._drive.log.path}: there is no picture of cell number {self._step} of the way")
        return jax.numpy.asarray(seen)

    def advance(self, path: KnownPath, stop: Stop) -> Leg:
        """Go on along the log; ``path`` tells where its target was reached."""
        planned = [(int(row), int(column)) for row, column in np.asarray(path.cells)[: int(path.length) + 1]]
        start, travelled, follows = self._step, 0.0, True
        while not self.ended:
            before, here = self._drive.path[self._step], self._drive.path[self._step + 1]
            self._step += 1
            moved = self._step - start
            travelled += DIAGONAL if before[0] != here[0] and before[1] != here[1] else 1.0
            follows = follows and moved < len(planned) and here == planned[moved]
            # A plan may pass its target's cell before it ends there.
            arrived = here == planned[-1] and (moved == len(planned) - 1 or not follows)
            due = travelled >= float(stop.replan_distance)
            gone = bool(stop.is_frontier) and not self._beside_unobserved(planned[-1])
            wanted = self._changed_since(start) and (due or arrived or gone or self._surprised_since(start))
            if wanted and (self._eyes is None or self._eyes.panorama(self._step) is not None):
                break
        return Leg(cells=self._drive.path[start + 1 : self._step + 1])

    def _changed_since(self, start: int) -> bool:
        first_seen = self._drive.first_seen
        return bool(np.any((first_seen > start) & (first_seen <= self._step)))

    def _surprised_since(self, start: int) -> bool:
        """Whether a proposition was seen that had not been seen anywhere."""
        first_seen, letters = self._drive.first_seen, np.asarray(self._drive.world.letters)
        seen = first_seen != NEVER_SEEN
        before = np.bitwise_or.reduce(letters[seen & (first_seen <= start)], initial=0)
        return bool(np.bitwise_or.reduce(letters[seen & (first_seen <= self._step)], initial=0) & ~before)

    def _beside_unobserved(self, cell: Cell) -> bool:
        """As the simulator asks it: whether a 4-neighbour is unobserved; outside of the map counts as unobserved."""
        first_seen = self._drive.first_seen
        for row, column in (
            (cell[0] - 1, cell[1]),
            (cell[0] + 1, cell[1]),
            (cell[0], cell[1] - 1),
            (cell[0], cell[1] + 1),
        ):
            inside = 0 <= row < first_seen.shape[0] and 0 <= column < first_seen.shape[1]
            if not inside or first_seen[row, column] == NEVER_SEEN or first_seen[row, column] > self._step:
                return True
        return False


class _Replay(Loop):
    """The loop of a trial that goes on as long as the log does, until the task is decided."""

    def run(self) -> Outcome:
        """Decide at each moment; what came after the task was decided is left out."""
        robot, dfa = self._robot, self._task.dfa
        assert isinstance(robot, LoggedRobot)
        while (end := self._decided_at()) is None and not robot.ended:
            belief, cell = robot.observe()
            self._advance(belief, self._decide(belief, cell))
        if end is None:
            return Outcome.UNFINISHED
        self.path, self.word, self.states = self.path[: end + 1], self.word[: end + 1], self.states[: end + 1]
        return Outcome.SATISFIED if dfa.accepting[self.states[-1]] else Outcome.INFEASIBLE

    def _decided_at(self) -> int | None:
        """Index into the path at which the task was satisfied or violated."""
        dfa, states = self._task.dfa, np.array(self.states)
        decided = np.flatnonzero(dfa.accepting[states] | dfa.trap[states])
        return int(decided[0]) if len(decided) else None


def replay(
    drive: Drive,
    task: Task,
    policy: Policy,
    key: PRNGKeyArray,
    config: TrialConfig | None = None,
    estimator: TrainedEstimator | None = None,
) -> tuple[Trial, dict[int, UInt8[np.ndarray, "rows columns 3"]]]:
    """The decisions of ``policy`` along a drive, as the record of a trial, and the panoramas by number of the decision.

    The path of the record is the one that was driven. ``estimator`` is for the policy ``potlp``; by default the shipped
    one for the task's propositions.

    Raises:
        LogError: the policy needs panoramas and the log has none, or it needs no log.
        CheckpointError: the estimator knows other propositions than the task, or none is shipped for them.
    """
    if policy is Policy.KNOWN_MAP:
        raise LogError("the policy known-map knows all from the start: choose baseline, optimistic, oracle or potlp")
    config = TrialConfig() if config is None else config
    trained = estimator_for(task.propositions, estimator) if policy is Policy.POTLP else None
    eyes = None
    if trained is not None:
        drive = from_first_picture(drive, config.camera)
        eyes = Eyes(drive, config.camera)
    first = _first_estimator(policy, drive, trained)
    loop = _Replay(LoggedRobot(drive, eyes), task, task.arrays, policy, first, key, config)
    outcome = loop.run()
    trial = Trial(
        outcome=outcome,
        cost=_length(loop.path) * float(drive.world.resolution),
        path=tuple(loop.path),
        word=tuple(loop.word),
        states=tuple(loop.states),
        decisions=tuple(loop.decisions),
        first_seen=np.where(drive.first_seen < len(loop.path), drive.first_seen, NEVER_SEEN).astype(np.int32),
        world=drive.world,
        task_text=task.text,
        task_hoa=task.to_hoa(),
        propositions=task.propositions,
        policy=policy.value,
        environment=f"{LOG_PREFIX}{Path(drive.log.path).name}",
        seed=None,
        status=loop.status,
        config=dataclasses.asdict(config),
        versions=versions() | ({} if trained is None else {"estimator": trained.identity}),
    )
    return trial, _panoramas(drive, trial, config.camera)


def _first_estimator(policy: Policy, drive: Drive, trained: TrainedEstimator | None) -> Estimator | None:
    if policy is Policy.ORACLE:
        return TrueMapEstimator(world=drive.world)
    return None if trained is None else trained.start(*drive.world.shape)


def _panoramas(drive: Drive, trial: Trial, camera: CameraConfig) -> dict[int, UInt8[np.ndarray, "rows columns 3"]]:
    """Those that decisions used."""
    eyes = Eyes(drive, camera)
    looks = sorted({look for decision in trial.decisions for look in decision.looks})
    seen = {look: eyes.panorama(trial.decisions[look].step) for look in looks}
    return {look: image for look, image in seen.items() if image is not None}


def from_first_picture(drive: Drive, camera: CameraConfig) -> Drive:
    """The drive from the first cell on of which there is a picture."""
    eyes = Eyes(drive, camera)
    first = next((step for step in sorted(drive.pictures) if eyes.panorama(step) is not None), None)
    if first is None:
        raise LogError(
            f"{drive.log.path}: has no panorama, and the policy potlp looks at them: record "
            "sensor_msgs/CompressedImage, or choose --policy baseline"
        )
    first_seen: Int32[np.ndarray, "H W"] = drive.first_seen
    return dataclasses.replace(
        drive,
        world=dataclasses.replace(drive.world, start=jax.numpy.asarray(drive.path[first], jax.numpy.int32)),
        path=drive.path[first:],
        times=drive.times[first:],
        first_seen=np.where(first_seen == NEVER_SEEN, NEVER_SEEN, np.maximum(first_seen - first, 0)).astype(np.int32),
        pictures={step - first: picture for step, picture in drive.pictures.items() if step >= first},
        bearings={step - first: angle for step, angle in drive.bearings.items() if step >= first},
    )


def _length(path: list[Cell]) -> float:
    """In cells."""
    steps = np.abs(np.diff(np.array(path), axis=0)).sum(axis=1)
    return float(np.where(steps == 2, DIAGONAL, 1.0).sum())
