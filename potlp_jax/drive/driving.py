"""A drive from the first map to the end of the task, and to that of every task that is asked for meanwhile."""

import logging
import time
from collections.abc import Callable, Generator

from jaxtyping import PRNGKeyArray

from potlp_jax.drive.advice import Advertiser
from potlp_jax.drive.config import DriveConfig, Mode
from potlp_jax.drive.inbox import Inbox
from potlp_jax.drive.link import Link
from potlp_jax.drive.movers import Mover, mover_of
from potlp_jax.drive.robot import InterruptionError, RemoteRobot
from potlp_jax.environments.ros.places import Places
from potlp_jax.errors import PotlpError
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.planning.estimates import Estimator
from potlp_jax.planning.policies import Policy, PolicyFunction
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.live import run_robot
from potlp_jax.trials.record import Decision, Trial
from potlp_jax.trials.setbacks import SetbackConfig
from potlp_jax.world.grid import BeliefMap

logger = logging.getLogger(__name__)


def drive_robot(
    link: Link,
    task: Task,
    policy: Policy | PolicyFunction | str,
    key: PRNGKeyArray,
    config: DriveConfig,
    *,
    trial_config: TrialConfig | None = None,
    setbacks: SetbackConfig | None = None,
    places: Places | None = None,
    estimator: TrainedEstimator | Estimator | None = None,
    name: str = "",
    listener: Callable[[Decision, BeliefMap], None] = lambda _decision, _belief: None,
    inbox: Inbox | None = None,
    interrupted: Callable[[], bool] = lambda: False,
    clock: Callable[[], float] = time.monotonic,
) -> Generator[Trial, None, None]:
    """Drive, or advise, a robot behind a link.

    Args:
        link: to the robot; it stays open.
        task: what to do.
        policy: who decides.
        key: drives the search where it samples.
        config: who moves the robot, and how it is listened to.
        trial_config: settings of the decisions.
        setbacks: what to do after legs that failed.
        places: where propositions hold that are known beforehand; of those that the task lacks it is said that they are
            not used.
        estimator: what the policy asks.
        name: of the robot, for the records.
        listener: is told each decision before it is carried out.
        inbox: what hears the robot; by default one that waits for the network.
        interrupted: whether the drive shall end; asked again and again. No goal is sent then. The trial ends
            ``unfinished``, and is the last; before its first decision there is none.
        clock: seconds, of the same kind as the inbox's.

    Yields:
        A trial for each task: the first, and those that were asked for on ``Topics.task``. A task that gives way to
        another ends ``unfinished``.

    Raises:
        RobotError: nothing is heard of the robot, or it broke the contract; once the drive has begun, a
            ``BrokenDriveError``, which has the record.
        PropositionsError: task and estimator are not over the same propositions.
    """
    inbox = Inbox(config, task.propositions) if inbox is None else inbox
    for topic, (kind, _) in inbox.handlers.items():
        link.subscribe(topic, kind, lambda message, topic=topic: inbox.handle(topic, message))
    mover = mover_of(config, link)
    desk = _Desk(inbox, task)
    try:
        # Also a formula that was heard while its listener had the last trial.
        while not interrupted() and (desk.task is not None or desk.has_another()):
            asked = desk.begin()
            robot, advertiser = _robot(
                link, inbox, mover, asked, desk, config, trial_config, places, interrupted, clock
            )
            trial = run_robot(
                robot,
                asked,
                policy,
                key,
                trial_config,
                estimator=estimator,
                setbacks=setbacks,
                listener=_listener(advertiser, listener, config),
                name=name,
            )
            # A trial may end on the way to a goal; whoever has the record may take long with it.
            mover.stop()
            yield trial
    except InterruptionError:
        return
    finally:
        # However it ends: nobody is left driving.
        mover.stop()


def _robot(
    link: Link,
    inbox: Inbox,
    mover: Mover,
    task: Task,
    desk: "_Desk",
    config: DriveConfig,
    trial_config: TrialConfig | None,
    places: Places | None,
    interrupted: Callable[[], bool],
    clock: Callable[[], float],
) -> tuple[RemoteRobot, Advertiser]:
    advertiser = Advertiser(link, config.topics.advice, task, lambda: (robot.frame, robot.frame_id))

    def say(text: str) -> None:
        logger.warning(text)
        if config.mode is not Mode.DRY:
            advertiser.say("stopped" if text.startswith("stopped") else "driving", text)

    desk.say = say
    robot = RemoteRobot(
        inbox,
        mover,
        config,
        task.propositions,
        places=places,
        camera=(TrialConfig() if trial_config is None else trial_config).camera,
        interrupted=interrupted,
        replaced=desk.has_another,
        say=say,
        clock=clock,
    )
    return robot, advertiser


def _listener(
    advertiser: Advertiser, listener: Callable[[Decision, BeliefMap], None], config: DriveConfig
) -> Callable[[Decision, BeliefMap], None]:
    def told(decision: Decision, belief: BeliefMap) -> None:
        listener(decision, belief)
        # A dry run leaves no trace on the robot.
        if config.mode is not Mode.DRY:
            advertiser.advise(decision, belief)

    return told


class _Desk:
    """Takes the formulas that are asked for; one that cannot be used is refused, and the former goes on."""

    def __init__(self, inbox: Inbox, task: Task) -> None:
        self._inbox, self._propositions = inbox, task.propositions
        self.task: Task | None = task
        self.say: Callable[[str], None] = lambda _text: None

    def begin(self) -> Task:
        """The task that is next; there is none after it until another is asked for."""
        assert self.task is not None
        task, self.task = self.task, None
        return task

    def has_another(self) -> bool:
        """Whether another task is wanted."""
        text = self._inbox.take_task()
        if text is not None:
            try:
                # A formula, and nothing else: whoever may publish to the robot shall name no files here.
                self.task = Task.from_formula(text, self._propositions)
            except PotlpError as error:
                self.say(f"the formula {text!r} is refused: {error}")
        return self.task is not None
