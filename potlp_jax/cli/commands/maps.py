"""Options and help of ``potlp map``."""

from pathlib import Path
from typing import Annotated

import typer

from potlp_jax.cli.commands.options import Json
from potlp_jax.cli.output import clear_errors

app = typer.Typer(
    name="map",
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="From a ROS map to a world: inspect, clean, label and look at it. docs/maps.md goes through it.",
)
MapFile = Annotated[Path, typer.Argument(metavar="FILE.yaml", help="A map of ROS map_server or nav2_map_server.")]
Resolution = Annotated[float, typer.Option("--resolution", help="Size of a cell of the working grid, in metres.")]
Radius = Annotated[float, typer.Option("--radius", help="The robot's radius in metres, by which obstacles grow.")]
Start = Annotated[
    str | None,
    typer.Option(
        "--start", metavar="X,Y", help="Metres; what is connected with it is kept. Default: the largest part."
    ),
]


@app.command(
    "inspect",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp map inspect office.yaml[/cyan]

[cyan]potlp map inspect office.yaml --resolution 0.4 --radius 0.2 --json[/cyan]

[dim]Changes nothing. Cells and radius are those of map:office.yaml,resolution=0.4,radius=0.2.[/dim]
""",
)
@clear_errors
def map_inspect_command(
    file: MapFile, resolution: Resolution = 0.2, radius: Radius = 0.1, start: Start = None, json: Json = False
) -> None:
    """Show what a map holds, its narrowest passages, what is wrong with it, and what cleaning would do."""
    from potlp_jax.cli.maps import inspect_map

    inspect_map(file, resolution, radius, start, json)


@app.command(
    "clean",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp map clean office.yaml --out out/clean.yaml[/cyan]

[cyan]potlp map clean office.yaml --resolution 0.05 --radius 0 --start 1.5,2 --out out/clean.yaml[/cyan]

[dim]map:office.yaml cleans a map in the same way by itself; this is to see, mend or share the result.[/dim]
""",
)
@clear_errors
def map_clean_command(
    file: MapFile,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="NEW.yaml", help="Map to write, NEW.pgm beside it.")],
    resolution: Resolution = 0.2,
    radius: Radius = 0.1,
    start: Start = None,
    json: Json = False,
) -> None:
    """Write the grid on which the robot moves, where all else is an obstacle, as a ROS map."""
    from potlp_jax.cli.maps import write_clean_map

    write_clean_map(file, out, resolution, radius, start, json)


@app.command(
    "label",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp map label office.yaml --place kitchen=2.1,3.4 --room "office=1,1 4,1 4,3 1,3"[/cyan]

[cyan]potlp map label office.yaml --add --place kitchen=7.5,3.4,1 --start 0.5,0.5 --task "1=F kitchen & F office"[/cyan]

[dim]A name that is given twice has two places. Without --out the file is office.places.yaml, which map:office.yaml
finds.[/dim]
""",
)
@clear_errors
def map_label_command(
    file: MapFile,
    place: Annotated[
        list[str] | None,
        typer.Option("--place", metavar="NAME=X,Y[,RADIUS]", help="True around a point; radius 0.5 m by default."),
    ] = None,
    room: Annotated[
        list[str] | None,
        typer.Option("--room", metavar='NAME="X,Y X,Y X,Y ..."', help="True inside a polygon of three points or more."),
    ] = None,
    task: Annotated[
        list[str] | None, typer.Option("--task", metavar="NAME=FORMULA", help="A task to run by its name.")
    ] = None,
    start: Annotated[
        str | None, typer.Option("--start", metavar="X,Y", help="Where trials start; default: drawn at random.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="LABELS.yaml", help="Default: FILE.places.yaml beside the map."),
    ] = None,
    add: Annotated[bool, typer.Option("--add", help="Add to the labels that the file holds already.")] = False,
    resolution: Resolution = 0.2,
    radius: Radius = 0.1,
    json: Json = False,
) -> None:
    """Say in metres where propositions are true, and check that a robot gets there."""
    from potlp_jax.cli.maps import label_map

    label_map(file, place or [], room or [], task or [], start, out, add, resolution, radius, json)


@app.command(
    "preview",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp map preview office.yaml --out office.png[/cyan]

[cyan]potlp map preview office.yaml --labels office.places.yaml --resolution 0.4 --out office.pdf[/cyan]

[dim]Labels in office.places.yaml are drawn without being named.[/dim]
""",
)
@clear_errors
def map_preview_command(
    file: MapFile,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="PICTURE", help="Picture to write: .png, .svg or .pdf.")],
    labels: Annotated[
        Path | None, typer.Option("--labels", metavar="LABELS.yaml", help="Labels to draw; default: FILE.places.yaml.")
    ] = None,
    resolution: Resolution = 0.2,
    radius: Radius = 0.1,
) -> None:
    """Draw a map in metres: what the robot can reach, what is cut off, propositions and start."""
    from potlp_jax.cli.maps import preview_map

    preview_map(file, out, labels, resolution, radius)
