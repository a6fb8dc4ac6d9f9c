"""``potlp log ...``: options and help texts of the commands about robots' logs; what they do is in ``log.py``."""

import importlib
import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from potlp_jax.cli.commands.options import EstimatorFile, Json, Simulations
from potlp_jax.cli.output import FAILED, clear_errors, fail

app = typer.Typer(
    name="log",
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="Use what a robot recorded: ROS 1 bags, ROS 2 bags and MCAP. Needs the extra [cyan]logs[/cyan], no ROS.",
)

_BAG_HELP = "A .bag, .mcap or .db3 file, or the folder of a ROS 2 bag."
BagFile = Annotated[Path, typer.Argument(metavar="BAG", help=_BAG_HELP)]
BagFiles = Annotated[list[Path], typer.Argument(metavar="BAG...", help=f"{_BAG_HELP} All with one map frame.")]
Labels = Annotated[
    Path, typer.Option("--labels", "-l", help="YAML of where the propositions are, in metres of the map's frame.")
]
MapTopic = Annotated[str | None, typer.Option("--map-topic", help="Of nav_msgs/OccupancyGrid; default: /map.")]
ImageTopic = Annotated[
    str | None, typer.Option("--image-topic", help="Of sensor_msgs/CompressedImage; default: the only one.")
]
BaseFrame = Annotated[
    str | None, typer.Option("--base-frame", help="The robot's frame; default: the odometry's child, or base_link.")
]
Free = Annotated[int, typer.Option("--free", help="Occupancy, in percent, up to which a cell is free.")]
Occupied = Annotated[int, typer.Option("--occupied", help="Occupancy, in percent, from which it is an obstacle.")]
Resolution = Annotated[
    float | None, typer.Option("--resolution", help="Metres a cell of the planner; default: 0.2, or the map's.")
]
Radius = Annotated[float, typer.Option("--radius", help="The robot's radius in metres, by which obstacles grow.")]
CameraYaw = Annotated[
    float | None,
    typer.Option(
        "--camera-yaw",
        help="Degrees, counter-clockwise, from ahead to where the middle of a picture looks; default: as /tf says.",
    ),
]
VerticalField = Annotated[
    float | None,
    typer.Option("--vertical-field", help="Degrees from a picture's lower to its upper edge; default: square pixels."),
]


def _commands() -> ModuleType:
    """What the commands do."""
    if importlib.util.find_spec("rosbags") is None:
        fail("logs are read by rosbags, which is not installed: pip install 'potlp-jax[logs]'", FAILED)
    # By its full name: the package's own attribute of this name is this module.
    return importlib.import_module("potlp_jax.cli.log")


@app.command(
    "inspect",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp log inspect drive.bag[/cyan]

[cyan]potlp log inspect drive/ --map-topic /slam/map --json[/cyan]

[dim]Ends with exit code 1 if the log is damaged or cannot be used for anything.[/dim]
""",
)
@clear_errors
def inspect_command(
    bag: BagFile,
    map_topic: MapTopic = None,
    image_topic: ImageTopic = None,
    base_frame: BaseFrame = None,
    free: Free = 25,
    occupied: Occupied = 65,
    vertical_field: VerticalField = None,
    json: Json = False,
) -> None:
    """Show what is in a log: topics, rates, gaps, what it can be used for, and what is wrong with it."""
    _commands().inspect_log(bag, map_topic, image_topic, base_frame, free, occupied, vertical_field, json)


@app.command(
    "to-dataset",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp log to-dataset drive.bag --labels places.yaml --out data/office[/cyan]

[cyan]potlp log to-dataset monday/ tuesday/ -l places.yaml --environment office --split validation -o data/v[/cyan]

[dim]The answers come from the final map of each bag: drive until the building is mapped. docs/dataset.md describes the
files. Needs the extra train, too.[/dim]
""",
)
@clear_errors
def to_dataset_command(
    bags: BagFiles,
    labels: Labels,
    out: Annotated[Path, typer.Option("--out", "-o", help="Empty folder for the dataset.")],
    environment: Annotated[
        str | None, typer.Option("--environment", "-e", help="Name of the building; default: that of the labels' file.")
    ] = None,
    split: Annotated[
        str, typer.Option("--split", help="What the dataset is for: training, validation, ...")
    ] = "training",
    views: Annotated[int, typer.Option("--views", min=1, help="Views of each bag, at most.")] = 200,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Of the tasks asked about, and the spacing.")] = 0,
    map_topic: MapTopic = None,
    image_topic: ImageTopic = None,
    base_frame: BaseFrame = None,
    free: Free = 25,
    occupied: Occupied = 65,
    resolution: Resolution = None,
    radius: Radius = 0.1,
    camera_yaw: CameraYaw = None,
    vertical_field: VerticalField = None,
    json: Json = False,
) -> None:
    """Turn drives into samples for training an estimator: panoramas, and the true answers from the final map."""
    reading = _commands().Reading(
        map_topic, image_topic, base_frame, free, occupied, resolution, radius, camera_yaw, vertical_field
    )
    _commands().logs_to_dataset(bags, labels, out, environment, split, views, seed, reading, json)


@app.command(
    "replay",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp log replay drive.bag --labels places.yaml --task "F document & F package" --out out/replay[/cyan]

[cyan]potlp log replay drive/ --labels places.yaml --task 1 --policy oracle --out out/oracle --no-open[/cyan]

[dim]The path is the one that was driven; the decisions are what the policy would have chosen at each moment.[/dim]
""",
)
@clear_errors
def replay_command(
    bag: BagFile,
    labels: Labels,
    task: Annotated[
        str, typer.Option("--task", "-t", help="A formula, the name of one in the labels, or a .hoa file.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for trial.json, trial.png and replay.html.")],
    policy: Annotated[
        str | None,
        typer.Option(
            "--policy",
            "-p",
            help="potlp (the default where an estimator knows the propositions), baseline, optimistic or oracle.",
            show_default=False,
        ),
    ] = None,
    simulations: Simulations = None,
    estimator: EstimatorFile = None,
    map_topic: MapTopic = None,
    image_topic: ImageTopic = None,
    base_frame: BaseFrame = None,
    free: Free = 25,
    occupied: Occupied = 65,
    resolution: Resolution = None,
    radius: Radius = 0.1,
    camera_yaw: CameraYaw = None,
    vertical_field: VerticalField = None,
    open_it: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")] = False,
    json: Json = False,
) -> None:
    """Show what would have been decided at each moment of a drive, as the replay of a trial."""
    reading = _commands().Reading(
        map_topic, image_topic, base_frame, free, occupied, resolution, radius, camera_yaw, vertical_field
    )
    _commands().replay_log(bag, labels, task, out, policy, simulations, estimator, reading, open_it, json)


@app.command(
    "write",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp run rooms --out out/rooms[/cyan], then [cyan]potlp log write out/rooms --out drive.bag[/cyan]

[cyan]potlp log write out/rooms --out drive --format mcap[/cyan]

[dim]Also writes the labels, as drive.labels.yaml. The topics and frames are those that a robot should record.[/dim]
""",
)
@clear_errors
def write_command(
    trial: Annotated[Path, typer.Argument(metavar="TRIAL", help="Folder or file that `potlp run --out` wrote.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Bag to write: a .bag file, or a folder for ROS 2.")],
    kind: Annotated[
        str | None, typer.Option("--format", help="ros1, ros2 or mcap; default: ros1 for .bag, else ros2.")
    ] = None,
    height: Annotated[int, typer.Option("--height", min=16, help="Rows of the pictures, twice as wide.")] = 512,
) -> None:
    """Write a simulated trial as a bag: what a robot should record, and a way to try the other commands."""
    _commands().write_log(trial, out, kind, height)
