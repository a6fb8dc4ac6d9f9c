"""``potlp log``: robots' logs inspected, turned into datasets, replayed, and written by the simulator."""

import dataclasses
import importlib.util
import logging
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.cli.completion import complete_policy
from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import EstimatorName, Json, OpenPage, SearchName, Simulations, TrialFile, spread
from potlp_jax.cli.output import FAILED, console, fail, make_folder, open_page, print_json, print_next, progress_bar
from potlp_jax.cli.view import PAGE

if TYPE_CHECKING:
    from potlp_jax.learning.estimator import TrainedEstimator
    from potlp_jax.logs.drive import Drive
    from potlp_jax.logs.log import LogConfig
    from potlp_jax.logs.working_grid import GridConfig
    from potlp_jax.planning.estimates import Estimator
    from potlp_jax.planning.policies import Policy

logger = logging.getLogger(__name__)

app = command_app(
    "log", "Use what a robot recorded: ROS 1 bags, ROS 2 bags and MCAP. Needs the extra [cyan]logs[/cyan], no ROS."
)

_BAG_HELP = "A .bag, .mcap or .db3 file, or the folder of a ROS 2 bag."
BagFile = Annotated[Path, typer.Argument(metavar="BAG", help=_BAG_HELP)]
BagFiles = Annotated[list[Path], typer.Argument(metavar="BAG...", help=f"{_BAG_HELP} All with one map frame.")]
Labels = Annotated[
    Path, typer.Option("--labels", "-l", help="YAML of where the propositions are, in metres of the map's frame.")
]
Resolution = Annotated[
    float | None, typer.Option("--resolution", help="Metres a cell of the planner; default: 0.2, or the map's.")
]
Radius = Annotated[float, typer.Option("--radius", help="The robot's radius in metres, by which obstacles grow.")]


@dataclasses.dataclass(frozen=True)
class Reading:
    """How a log is read: robots differ in topics, frames and cameras, so every command that reads one has these."""

    map_topic: Annotated[str | None, typer.Option("--map-topic", help="Of nav_msgs/OccupancyGrid; default: /map.")] = (
        None
    )
    image_topic: Annotated[
        str | None, typer.Option("--image-topic", help="Of sensor_msgs/CompressedImage; default: the only one.")
    ] = None
    base_frame: Annotated[
        str | None, typer.Option("--base-frame", help="The robot's frame; default: the odometry's child, or base_link.")
    ] = None
    # Thresholds of nav_msgs/OccupancyGrid, with the defaults of nav2_map_server: between them a cell is unknown.
    free: Annotated[int, typer.Option("--free", help="Occupancy, in percent, up to which a cell is free.")] = 25
    occupied: Annotated[
        int, typer.Option("--occupied", help="Occupancy, in percent, from which it is an obstacle.")
    ] = 65
    # What a bag may not say: where the camera looks, and how much of the sphere a picture covers.
    camera_yaw: Annotated[
        float | None,
        typer.Option(
            "--camera-yaw",
            help="Degrees, counter-clockwise, from ahead to where the middle of a picture looks; default: as /tf says.",
        ),
    ] = None
    vertical_field: Annotated[
        float | None,
        typer.Option(
            "--vertical-field", help="Degrees from a picture's lower to its upper edge; default: square pixels."
        ),
    ] = None

    def config(self) -> "LogConfig":
        """The same for the library."""
        from potlp_jax.logs.log import LogConfig

        return LogConfig(**dataclasses.asdict(self))


@app.command(
    "inspect",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp log inspect drive.bag[/cyan]

[cyan]potlp log inspect drive/ --map-topic /slam/map --json[/cyan]

[dim]Ends with exit code 1 if the log is damaged or cannot be used for anything.[/dim]
""",
)
@spread("reading", Reading)
def inspect_log(
    bag: BagFile,
    reading: Reading,
    json: Json = False,
) -> None:
    """Show what is in a log: topics, rates, gaps, what it can be used for, and what is wrong with it."""
    _check_rosbags()
    from potlp_jax.logs.inspection import inspect
    from potlp_jax.logs.log import Log

    log = Log(bag, reading.config())
    found = inspect(log)
    if json:
        print_json(found)
    else:
        _print_inspection(found)
    # For scripts: a log that is of no use is a failure, whatever there is to print about it.
    if log.bag.damaged or not any(use.startswith("yes") for use in found["uses"].values()):
        raise typer.Exit(FAILED)


@app.command(
    "to-dataset",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp log to-dataset drive.bag --labels places.yaml --out data/office[/cyan]

[cyan]potlp log to-dataset monday/ tuesday/ -l places.yaml --environment office --split validation -o data/v[/cyan]

[dim]The answers come from the final map of each bag: drive until the building is mapped. docs/dataset.md describes the
files. Needs the extra train, too.[/dim]
""",
)
@spread("reading", Reading)
def logs_to_dataset(
    bags: BagFiles,
    labels: Labels,
    reading: Reading,
    out: Annotated[Path, typer.Option("--out", "-o", help="Empty folder for the dataset.")],
    environment: Annotated[
        str | None, typer.Option("--environment", "-e", help="Name of the building; default: that of the labels' file.")
    ] = None,
    split: Annotated[
        str, typer.Option("--split", help="What the dataset is for: training, validation, ...")
    ] = "training",
    views: Annotated[int, typer.Option("--views", min=1, help="Views of each bag, at most.")] = 200,
    subgoals: Annotated[
        int, typer.Option("--subgoals", min=1, help="Subgoals of each view that are asked about, the nearest.")
    ] = 12,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Of the tasks asked about, and the spacing.")] = 0,
    resolution: Resolution = None,
    radius: Radius = 0.1,
    json: Json = False,
) -> None:
    """Turn drives into samples for training an estimator: panoramas, and the true answers from the final map."""
    _check_rosbags()
    if importlib.util.find_spec("pyarrow") is None:
        fail("datasets are Parquet files, and pyarrow is not installed: pip install 'potlp-jax[train]'", FAILED)
    from potlp_jax.environments.ros.places import load_places
    from potlp_jax.learning.dataset_reading import read_dataset
    from potlp_jax.learning.questions import HELD_OUT
    from potlp_jax.learning.recording import overflow_in_words
    from potlp_jax.logs.collecting import LogCollectConfig, collect_drives
    from potlp_jax.logs.working_grid import GridConfig
    from potlp_jax.world.frontiers import FrontierConfig

    if len({bag.resolve() for bag in bags}) < len(bags):
        fail("a log is given twice: its views would count twice")
    # `office.places.yaml` are the places of office.
    name = labels.name.split(".")[0] if environment is None else environment
    collecting = LogCollectConfig(
        views_per_world=views,
        frontiers=FrontierConfig(max_subgoals=subgoals),
        seed=seed,
        held_out=HELD_OUT.get(name, ()),
    )
    with progress_bar() as progress:
        progress.add_task("reading and labelling (the first view compiles)", total=None)
        drives = [_read_drive(bag, labels, reading.config(), GridConfig(resolution, radius)) for bag in bags]
        counts = collect_drives(drives, load_places(labels), out, name, split, collecting)
    samples = read_dataset(out)
    # Read back rather than counted on the way: what is reported is what a training would read.
    holds = samples.success > 0
    summary = {
        "dataset": str(out),
        "views": {str(bag): counted.views for bag, counted in zip(bags, counts, strict=True)},
        "overflowed": {str(bag): counted.overflowed for bag, counted in zip(bags, counts, strict=True)},
        "samples": len(holds),
        "successes": int(holds.sum()),
        "propositions": list(samples.metadata.propositions),
    }
    if json:
        print_json(summary)
    else:
        out_console = console()
        for bag, counted in zip(bags, counts, strict=True):
            out_console.print(f"{bag}: {counted.views} views")
            if overflow := overflow_in_words(counted.views, counted.overflowed, subgoals, "--subgoals "):
                out_console.print(f"{bag}: {overflow}", soft_wrap=True)
        out_console.print(f"{len(holds)} samples, {int(holds.sum())} successes")
        out_console.print(f"wrote {out}")
    if not len(holds):
        logger.warning(
            "no sample: nowhere a subgoal was in view whose answer the final map gives; drive on until the building is "
            "mapped"
        )
        raise typer.Exit(FAILED)


@app.command(
    "replay",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp log replay drive.bag --labels places.yaml --task "F document & F package" --out out/replay[/cyan]

[cyan]potlp log replay drive/ --labels places.yaml --task 1 --policy oracle --out out/oracle --no-open[/cyan]

[dim]The path is the one that was driven; the decisions are what the policy would have chosen at each moment.[/dim]
""",
)
@spread("reading", Reading)
def replay_log(
    bag: BagFile,
    labels: Labels,
    reading: Reading,
    task: Annotated[
        str, typer.Option("--task", "-t", help="A formula, the name of one in the labels, or a .hoa file.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for trial.json, trial.png and replay.html.")],
    policy: Annotated[
        str | None,
        typer.Option(
            "--policy",
            "-p",
            help="potlp (the default with --estimator), baseline, optimistic or oracle.",
            show_default=False,
            autocompletion=complete_policy,
        ),
    ] = None,
    simulations: Simulations = None,
    search: SearchName = None,
    estimator: EstimatorName = None,
    resolution: Resolution = None,
    radius: Radius = 0.1,
    open_it: OpenPage = False,
    json: Json = False,
) -> None:
    """Show what would have been decided at each moment of a drive, as the replay of a trial."""
    _check_rosbags()
    import jax

    from potlp_jax.cli.inputs import RECORD, read_estimator, setting_changes, trial_config
    from potlp_jax.logs.replaying import replay
    from potlp_jax.logs.working_grid import GridConfig
    from potlp_jax.planning.policies import named_policy, policy_name
    from potlp_jax.task.reading import read_task
    from potlp_jax.view.maps import draw_trial
    from potlp_jax.view.replay_page import replay_page
    from potlp_jax.view.style import save_figure

    trial_settings = trial_config(setting_changes(simulations=simulations, search=search))
    drive = _read_drive(bag, labels, reading.config(), GridConfig(resolution, radius))
    asked = read_task(drive.tasks.get(task, task), drive.propositions)
    trained = read_estimator(estimator)
    chosen = _default_policy(drive, trained) if policy is None else named_policy(policy)
    folder = make_folder(out)
    with progress_bar() as progress:
        progress.add_task("deciding along the drive (the first decision compiles)", total=None)
        # Only the search `uct` draws from the key, and it is fixed so that a log gives the same decisions every time.
        trial, views = replay(drive, asked, chosen, jax.random.key(0), trial_settings, trained)
    files = [folder / RECORD, folder / "trial.png", folder / PAGE]
    trial.save(files[0])
    save_figure(draw_trial(trial), files[1])
    files[2].write_text(replay_page(trial, views), "utf-8")
    if json:
        print_json({**trial.summary(), "files": [str(file) for file in files]})
    else:
        console().print(
            f"{trial.outcome}: {len(trial.decisions)} decisions of {policy_name(chosen)} along {trial.cost:.2f} m",
        )
        for file in files:
            console().print(f"wrote {file}")
    # Not by default, unlike `potlp view`: replays of logs are made in loops over bags.
    if open_it:
        open_page(files[2])


@app.command(
    "write",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp run rooms --out out/rooms[/cyan], then [cyan]potlp log write out/rooms --out drive.bag[/cyan]

[cyan]potlp log write out/rooms --out drive --format mcap[/cyan]

[dim]Also writes the labels, as drive.labels.yaml. The topics and frames are those that a robot should record.[/dim]
""",
)
def write_log(
    trial: TrialFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="Bag to write: a .bag file, or a folder for ROS 2.")],
    kind: Annotated[
        str | None, typer.Option("--format", help="ros1, ros2 or mcap; default: ros1 for .bag, otherwise ros2.")
    ] = None,
    height: Annotated[int, typer.Option("--height", min=16, help="Rows of the pictures, twice as wide.")] = 512,
) -> None:
    """Write a simulated trial as a bag: what a robot should record, and a way to try the other commands."""
    _check_rosbags()
    from potlp_jax.cli.inputs import record_file
    from potlp_jax.logs.writing import BagFormat, write_trial
    from potlp_jax.trials.record import load_trial

    if kind is not None and kind not in list(BagFormat):
        fail(f"unknown format {kind!r}; choose from: {', '.join(BagFormat)}")
    # ROS 1 bags are files and ROS 2 bags folders, so that the name decides unless --format does.
    by_name = BagFormat.ROS1 if out.suffix == ".bag" else BagFormat.ROS2
    chosen = by_name if kind is None else BagFormat(kind)
    if (chosen is BagFormat.ROS1) != (out.suffix == ".bag"):
        fail(f"--out {out}: a ROS 1 bag is a file that ends in .bag, and a ROS 2 bag a folder that does not")
    # A bag has no propositions; without the labels beside it, it could not be read back as the same trial.
    # A folder's name may have dots that end nothing.
    labels = out.with_suffix(".labels.yaml") if chosen is BagFormat.ROS1 else out.with_name(f"{out.name}.labels.yaml")
    count = write_trial(load_trial(record_file(trial)), out, chosen, labels, height)
    console().print(f"wrote {out}: {count} messages")
    console().print(f"wrote {labels}, in metres of the bag's map: its robot starts at [0, 0]")
    print_next(console(), shlex.join(["potlp", "log", "inspect", str(out)]))


def _print_inspection(found: dict[str, Any]) -> None:
    out = console()
    out.print(f"{found['bag']}  {found['format']}", style="bold")
    out.print(f"{found['seconds']:.1f} s, {found['messages']} messages")
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for name in ("topic", "type", "used for"):
        table.add_column(name)
    for name in ("messages", "a second", "gaps", "longest"):
        table.add_column(name, justify="right")
    for topic in found["topics"]:
        # A latched map has one message, and so neither rate nor gaps: empty cells, not zeros.
        rate, gaps = topic["rate"], topic["gaps"]
        table.add_row(
            topic["name"],
            topic["type"].replace("/msg/", "/"),
            topic["use"],
            str(topic["count"]),
            # A rate needs two messages.
            "" if rate is None else f"{rate:.1f}",
            str(len(gaps)) if gaps else "",
            f"{max(gap['seconds'] for gap in gaps):.1f} s" if gaps else "",
        )
    out.print(table)
    for name, value in _facts(found):
        out.print(f"{name:10} {value}")
    for name, answer in found["uses"].items():
        # An answer begins with yes or no, and goes on with why.
        good = answer.startswith("yes")
        out.print(f"{name}: {answer}", style="green" if good else "red")
    for problem in found["problems"]:
        out.print(f"problem: {problem}", style="yellow")


def _facts(found: dict[str, Any]) -> list[tuple[str, str]]:
    facts = []
    # A log without a map can still be inspected; its uses say what is missing.
    if found["map"] is not None:
        last = found["map"]
        (height, width), (x, y, yaw) = last["cells"], last["origin"]
        facts.append(
            (
                "last map",
                f"{height} x {width} cells of {last['resolution']:g} m, origin [{x:.2f}, {y:.2f}, {yaw:.2f}], "
                f"{last['free']:.0%} free, {last['obstacles']:.0%} obstacles, {last['unknown']:.0%} unknown",
            )
        )
    pose = found["pose"]
    facts.append(
        ("pose", f"{pose['base_frame']} in {pose['map_frame']}; frames: {', '.join(pose['frames']) or 'none'}")
    )
    if found["pictures"] is not None:
        sizes = ", ".join(f"{width} x {height}" for width, height in found["pictures"]["sizes"])
        facts.append(("pictures", f"{sizes} pixels, frame {found['pictures']['frame']!r}"))
    return facts


def _check_rosbags() -> None:
    """End the command where logs cannot be read."""
    if importlib.util.find_spec("rosbags") is None:
        fail("logs are read by rosbags, which is not installed: pip install 'potlp-jax[logs]'", FAILED)


def _read_drive(bag: Path, labels: Path, log: "LogConfig", grid: "GridConfig") -> "Drive":
    """The drive of a bag; what could not be used of it is noted on stderr."""
    from potlp_jax.environments.ros.places import load_places
    from potlp_jax.logs.drive import read_drive
    from potlp_jax.logs.log import Log

    drive = read_drive(Log(bag, log), load_places(labels), grid)
    # The drive can be used in spite of them; what makes it useless is an error.
    for remark in drive.notes:
        logger.warning(f"{bag}: {remark}")
    return drive


def _default_policy(drive: "Drive", trained: "TrainedEstimator | Estimator | None") -> "Policy":
    """PO-TLP where an estimator is given and there are pictures, otherwise the baseline, with a note."""
    from potlp_jax.planning.policies import Policy

    # What a real robot sees is like nothing that a shipped one has learned from, whatever the propositions are called.
    if trained is None:
        logger.warning(f"no estimator is shipped for logs: the policy is {Policy.BASELINE}; give one with --estimator")
        return Policy.BASELINE
    # The network sees nothing without pictures; the baseline needs the map alone.
    if not drive.pictures:
        logger.warning(f"the log has no panorama: the policy is {Policy.BASELINE}")
        return Policy.BASELINE
    return Policy.POTLP
