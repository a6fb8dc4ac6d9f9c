"""``potlp drive``: a robot behind rosbridge, driven or advised."""

import dataclasses
import itertools
import logging
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from potlp_jax.cli.completion import complete_policy
from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import EstimatorName, Json, spread
from potlp_jax.cli.output import FAILED, console, fail, make_folder, print_json

if TYPE_CHECKING:
    from potlp_jax.drive.config import Topics
    from potlp_jax.environments.ros.places import Places
    from potlp_jax.trials.record import Decision, Trial
    from potlp_jax.world.grid import BeliefMap

logger = logging.getLogger(__name__)

app = command_app()


@dataclasses.dataclass(frozen=True)
class TopicNames:
    """What the robot calls its topics; an empty name is not subscribed."""

    map_topic: Annotated[str, typer.Option("--map-topic", help="nav_msgs/OccupancyGrid, or a costmap.")] = "/map"
    updates_topic: Annotated[str, typer.Option("--updates-topic", help="map_msgs/OccupancyGridUpdate.")] = (
        "/map_updates"
    )
    pose_topic: Annotated[
        str, typer.Option("--pose-topic", help="geometry_msgs/PoseStamped in the map's frame; default: by /tf.")
    ] = ""
    image_topic: Annotated[
        str, typer.Option("--image-topic", help="Equirectangular panoramas, for --policy potlp.")
    ] = ""
    places_topic: Annotated[
        str, typer.Option("--places-topic", help="std_msgs/String, JSON: where the robot sees propositions hold.")
    ] = "/potlp/places"
    task_topic: Annotated[
        str, typer.Option("--task-topic", help="std_msgs/String: another formula, while it drives.")
    ] = "/potlp/task"
    prefix: Annotated[str, typer.Option("--prefix", help="Of the topics that are published.")] = "/potlp"
    action: Annotated[str, typer.Option("--action", help="Of Nav2; default: /navigate_to_pose or /follow_path.")] = ""

    def topics(self) -> "Topics":
        """The same for the library."""
        from potlp_jax.drive.config import Topics

        return Topics(
            map=self.map_topic,
            map_updates=self.updates_topic,
            pose=self.pose_topic,
            image=self.image_topic,
            places=self.places_topic,
            task=self.task_topic,
            advice=self.prefix,
            action=self.action,
        )


@app.command(
    "drive",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp drive robot:9090 --task "!fire U exit" --propositions fire,exit --dry-run[/cyan]

[cyan]potlp drive robot:9090 --task "F document & F package" --labels office.yaml --out out/monday[/cyan] - advise

[cyan]potlp drive robot:9090 -t 1 -l office.yaml --navigate --out out/monday[/cyan] - drive, by Nav2

[dim]Ends with exit code 1 if a task was not satisfied. Ctrl-C stops the robot, and the record is written. Needs the
extra drive, and rosbridge on the robot; no ROS here. docs/robots.md goes through a first drive.[/dim]
""",
)
@spread("names", TopicNames)
def drive(
    robot: Annotated[str, typer.Argument(metavar="ADDRESS", help="HOST:PORT of rosbridge, or ws:// or wss://.")],
    task: Annotated[
        str, typer.Option("--task", "-t", help="A formula, the name of one in the labels, or a .hoa file.")
    ],
    names: TopicNames,
    labels: Annotated[
        Path | None,
        typer.Option("--labels", "-l", help="YAML of places known beforehand, in the map's metres."),
    ] = None,
    propositions: Annotated[
        str | None, typer.Option("--propositions", help="Names, a,b; default: those of the labels.")
    ] = None,
    advise: Annotated[bool, typer.Option("--advise", help="Publish decisions only (the default).")] = False,
    navigate: Annotated[bool, typer.Option("--navigate", help="Send goals to Nav2: NavigateToPose.")] = False,
    follow: Annotated[bool, typer.Option("--follow", help="Send paths to Nav2: FollowPath.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Decide once, and publish nothing.")] = False,
    policy: Annotated[
        str | None,
        typer.Option(
            "--policy",
            "-p",
            help="baseline, optimistic or potlp; default: potlp with an --estimator, baseline without.",
            autocompletion=complete_policy,
        ),
    ] = None,
    estimator: EstimatorName = None,
    resolution: Annotated[float, typer.Option("--resolution", help="Metres a cell of the planner.")] = 0.2,
    radius: Annotated[
        float, typer.Option("--radius", help="The robot's radius in metres, by which obstacles grow; 0 for costmaps.")
    ] = 0.1,
    free: Annotated[int, typer.Option("--free", help="Occupancy, in percent, up to which a cell is free.")] = 25,
    occupied: Annotated[int, typer.Option("--occupied", help="Occupancy from which it is an obstacle.")] = 65,
    base_frame: Annotated[str, typer.Option("--base-frame", help="The robot's frame in /tf.")] = "base_link",
    camera_yaw: Annotated[
        float, typer.Option("--camera-yaw", help="Degrees from ahead to where the middle of a picture looks.")
    ] = 0.0,
    silence: Annotated[
        float, typer.Option("--silence", help="Seconds without a pose after which the robot is stopped.")
    ] = 2.0,
    patience: Annotated[
        float, typer.Option("--patience", help="Seconds for which map and pose are waited for.")
    ] = 30.0,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for a record and a page of each task; the second is in 2, and so on."),
    ] = None,
    json: Json = False,
) -> None:
    """Drive a robot, or advise whoever drives it, over rosbridge."""
    import jax

    from potlp_jax.cli.inputs import read_estimator, read_names
    from potlp_jax.drive.config import DriveConfig, Mode
    from potlp_jax.drive.driving import drive_robot
    from potlp_jax.drive.rosbridge import RosbridgeLink
    from potlp_jax.environments.ros.places import load_places
    from potlp_jax.planning.policies import Policy, named_policy
    from potlp_jax.task.reading import read_task
    from potlp_jax.trials.loop import BrokenDriveError
    from potlp_jax.trials.record import Outcome

    chosen = [mode for mode, on in zip(Mode, (advise, navigate, follow, dry_run), strict=True) if on] or [Mode.ADVISE]
    if len(chosen) > 1:
        fail("--advise, --navigate, --follow and --dry-run exclude each other: choose one")
    places = None if labels is None else load_places(labels)
    known = read_names(propositions) or (None if places is None else list(places.names))
    if known is None:
        fail("what the propositions are is not said: give --propositions a,b or --labels FILE")
    config = DriveConfig(
        mode=chosen[0],
        topics=names.topics(),
        base_frame=base_frame,
        resolution=resolution,
        radius=radius,
        free=free,
        occupied=occupied,
        camera_yaw=camera_yaw,
        silence=silence,
        patience=patience,
    )
    chosen_policy = policy or (Policy.BASELINE if estimator is None else Policy.POTLP)
    # Before the robot is asked for anything.
    if named_policy(chosen_policy) in (Policy.KNOWN_MAP, Policy.ORACLE):
        fail(f"--policy {chosen_policy}: it knows the true map, which nobody does here; choose another")
    if names.image_topic and estimator is None and chosen_policy != Policy.POTLP:
        logger.warning(f"the policy is {chosen_policy}: --image-topic is of use with an --estimator alone")
    asked = read_task(_formula(task, places), known)
    folder = None if out is None else make_folder(out)
    link = RosbridgeLink(robot)
    trials = []

    def keep(trial: "Trial") -> None:
        trials.append(trial)
        files = [] if folder is None else _write(trial, folder)
        if not json:
            console().print(f"{trial.outcome}: {len(trial.decisions)} decisions along {trial.cost:.2f} m")
            for file in files:
                console().print(f"wrote {file}")

    try:
        with _interruption() as interrupted:
            for trial in drive_robot(
                link,
                asked,
                chosen_policy,
                jax.random.key(0),
                config,
                places=places,
                estimator=read_estimator(estimator),
                name=robot,
                listener=(lambda _decision, _belief: None) if json else _print_decision,
                interrupted=interrupted,
            ):
                keep(trial)
    except BrokenDriveError as error:
        # No drive can be had again.
        if error.trial is not None:
            keep(error.trial)
        raise
    finally:
        link.close()
    if json:
        print_json([trial.summary() for trial in trials])
    if not trials:
        fail("interrupted before the first decision: there is nothing to record", FAILED)
    # A dry run has done what it was to do; a task that gave way to another was not to be satisfied.
    if chosen[0] is not Mode.DRY and trials[-1].outcome is not Outcome.SATISFIED:
        raise typer.Exit(FAILED)


@contextmanager
def _interruption() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C was pressed: once, and the trial ends and is written; again, and the command ends at once."""
    pressed = threading.Event()
    before = signal.getsignal(signal.SIGINT)

    def press(number: int, frame: FrameType | None) -> None:
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()

    # Only the main thread may ask for signals; elsewhere, as in a test, Ctrl-C is somebody else's.
    mine = threading.current_thread() is threading.main_thread()
    if mine:
        signal.signal(signal.SIGINT, press)
    try:
        yield pressed.is_set
    finally:
        if mine:
            signal.signal(signal.SIGINT, before)


def _formula(task: str, places: "Places | None") -> str:
    return task if places is None else dict(places.tasks).get(task, task)


def _print_decision(decision: "Decision", belief: "BeliefMap") -> None:
    target = "" if decision.target is None else f" to cell {decision.target[0]},{decision.target[1]}"
    known = int((~belief.unknown).sum())
    row, column = decision.cell
    console().print(
        f"decision {decision.index}: {decision.kind} from cell {row},{column}{target}, state {decision.state}, "
        f"{known} cells known"
    )


def _write(trial: "Trial", folder: Path) -> list[Path]:
    from potlp_jax.cli.inputs import RECORD
    from potlp_jax.cli.view import PAGE
    from potlp_jax.trials.replay import Views
    from potlp_jax.view.replay_page import replay_page

    # A folder each, because every command that reads a record takes its folder; and no drive can be had again, so that
    # one of an earlier command stays where it is.
    numbered = (make_folder(folder / str(number)) for number in itertools.count(2))
    own = next(place for place in itertools.chain([folder], numbered) if not (place / RECORD).exists())
    trial.save(own / RECORD)
    (own / PAGE).write_text(replay_page(trial, Views()), "utf-8")
    return [own / RECORD, own / PAGE]
