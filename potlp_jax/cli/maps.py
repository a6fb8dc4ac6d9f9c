"""``potlp map``: from a ROS map to a world; ``map_report`` has what it prints, ``map_labels`` what it labels."""

import shlex
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.map_labels import joined_labels, named_places, read_start
from potlp_jax.cli.map_report import (
    clean_facts,
    clean_lines,
    cut_off_lines,
    defects_of,
    map_facts,
    map_lines,
    passage_table,
    survey_facts,
)
from potlp_jax.cli.options import Json
from potlp_jax.cli.output import console, fail, print_json, print_next
from potlp_jax.errors import MapWarning

if TYPE_CHECKING:
    from potlp_jax.environments.ros.cleaning import CleanMap

app = command_app(
    "map", "From a ROS map to a world: inspect, clean, label and look at it. docs/maps.md goes through it."
)
# Resolution and radius have the defaults of `map:FILE.yaml` worlds, so that what is inspected is what a trial gets.
MapFile = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="A map of ROS map_server or nav2_map_server (.yaml), a building of Open-RMF (building.yaml), a Gazebo "
        "world (.world, .sdf) or a floor plan (.xml).",
    ),
]
Level = Annotated[
    str | None, typer.Option("--level", metavar="NAME", help="Of a building with several.", show_default=False)
]
Resolution = Annotated[
    float | None,
    typer.Option(
        "--resolution",
        help="Size of a cell of the working grid, in metres. Default: 0.2, larger on large maps.",
        show_default=False,
    ),
]
Radius = Annotated[float, typer.Option("--radius", help="The robot's radius in metres, by which obstacles grow.")]
Start = Annotated[
    str | None,
    typer.Option(
        "--start", metavar="X,Y", help="Metres; what is connected with it is kept. Default: the largest part."
    ),
]


@app.command(
    "inspect",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp map inspect office.yaml[/cyan]

[cyan]potlp map inspect office.yaml --resolution 0.4 --radius 0.2 --json[/cyan]

[dim]Changes nothing. Cells and radius are those of map:office.yaml,resolution=0.4,radius=0.2.[/dim]
""",
)
def inspect_map(
    file: MapFile,
    resolution: Resolution = None,
    radius: Radius = 0.1,
    start: Start = None,
    level: Level = None,
    json: Json = False,
) -> None:
    """Show what a map holds, its narrowest passages, what is wrong with it, and what cleaning would do."""
    from potlp_jax.environments.ros.buildings import load_building
    from potlp_jax.environments.ros.cleaning import clean_map
    from potlp_jax.environments.ros.survey import survey_map

    # What is odd about the file is listed with the map's other defects rather than as notes on stderr.
    with _caught_warnings() as remarks:
        image_map = load_building(file, level)
        # `--start` names the option in messages about a start that lies in a wall.
        clean = clean_map(image_map, resolution, radius, read_start(start), "--start")
    survey = survey_map(image_map, clean)
    defects = [*remarks, *defects_of(survey, clean)]
    if json:
        print_json({**map_facts(image_map), **survey_facts(survey), **clean_facts(clean, radius), "defects": defects})
        return
    out = console()
    out.print(str(file), style="bold")
    for name, text in (*map_lines(image_map, survey), *clean_lines(clean, radius)):
        out.print(f"{name:12} {text}")
    if survey.passages:
        out.print(passage_table(survey.passages))
    for defect in defects:
        out.print(f"- {defect}", soft_wrap=True)


@app.command(
    "clean",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp map clean office.yaml --out out/clean.yaml[/cyan]

[cyan]potlp map clean office.yaml --resolution 0.05 --radius 0 --start 1.5,2 --out out/clean.yaml[/cyan]

[dim]map:office.yaml cleans a map in the same way by itself; this is to see, correct or share the result.[/dim]
""",
)
def write_clean_map(
    file: MapFile,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="NEW.yaml", help="Map to write, NEW.pgm beside it.")],
    resolution: Resolution = None,
    radius: Radius = 0.1,
    start: Start = None,
    level: Level = None,
    json: Json = False,
) -> None:
    """Write the grid on which the robot moves, where everything else is an obstacle, as a ROS map."""
    from potlp_jax.environments.ros.buildings import load_building
    from potlp_jax.environments.ros.cleaning import clean_map
    from potlp_jax.environments.ros.map_writer import save_map

    image_map = load_building(file, level)
    if not out.name:
        fail(f"--out {out} is a folder; give the name of a map to write")
    # A cleaned map has lost what was cleaned away, so that it must not replace its source by accident.
    own = {path.resolve() for path in (image_map.settings.file, image_map.settings.image)}
    if own & {out.resolve(), out.with_suffix(".pgm").resolve()}:
        fail(f"--out {out} would overwrite the map itself; give another name")
    # It is written to be mended by hand; a repeated command would lose that.
    if there := [str(written) for written in (out, out.with_suffix(".pgm")) if written.exists()]:
        fail(f"{' and '.join(there)} exists: remove it, or give another name with --out")
    clean = clean_map(image_map, resolution, radius, read_start(start), "--start")
    out.parent.mkdir(parents=True, exist_ok=True)
    image = save_map(out, clean.free, clean.frame)
    # The map is written with obstacles grown already: growing them again would close passages.
    world = _environment(out, None, resolution, 0.0, None)
    if json:
        print_json({**clean_facts(clean, radius), "files": [str(out), str(image)], "world": world})
        return
    output = console()
    for name, text in clean_lines(clean, radius):
        output.print(f"{name:12} {text}")
    for line in cut_off_lines(clean):
        output.print(f"- {line}")
    output.print(f"wrote {out} and {image}")
    label = ["potlp", "map", "label", str(out), "--resolution", _number(clean.frame.resolution), "--radius", "0"]
    then = shlex.join(["potlp", "run", world])
    print_next(output, f"{shlex.join(label)}, then {then} (the radius is in the map already)")


@app.command(
    "label",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp map label office.yaml --place kitchen=2.1,3.4 --room "office=1,1 4,1 4,3 1,3"[/cyan]

[cyan]potlp map label office.yaml --add --place kitchen=7.5,3.4,1 --start 0.5,0.5 --task "1=F kitchen & F office"[/cyan]

[dim]A name that is given twice has two places. Without --out the file is office.places.yaml, which map:office.yaml
finds.[/dim]
""",
)
def label_map(
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
        typer.Option(
            "--out",
            "-o",
            metavar="LABELS.yaml",
            help="Default: FILE.places.yaml beside the map, or FILE.LEVEL.places.yaml.",
        ),
    ] = None,
    add: Annotated[bool, typer.Option("--add", help="Add to the labels that the file holds already.")] = False,
    named: Annotated[
        list[str] | None,
        typer.Option("--named", metavar="NAME", help="A place that the file names, such as a vertex of Open-RMF."),
    ] = None,
    resolution: Resolution = None,
    radius: Radius = 0.1,
    level: Level = None,
    json: Json = False,
) -> None:
    """Say in metres where propositions are true, and check that a robot gets there."""
    from potlp_jax.environments.ros.buildings import load_building
    from potlp_jax.environments.ros.cleaning import clean_map
    from potlp_jax.environments.ros.places import (
        Places,
        check_points,
        load_places,
        place_letters,
        places_file,
        save_places,
    )
    from potlp_jax.task.propositions import in_formula

    target = places_file(file, level) if out is None else out
    # Labels are typed by hand; overwriting them by a repeated command would lose work.
    if target.exists() and not add:
        fail(f"{target} exists: --add adds to it, --out writes another file")
    old = load_places(target) if add else Places(())
    image_map = load_building(file, level)
    own = named_places(file, image_map, named or [])
    labels = joined_labels(old, own, places=place or [], rooms=room or [], tasks=task or [], start=start)
    clean = clean_map(image_map, resolution, radius, labels.start, labels.source)
    # Before anything is written: labels that no robot reaches would make every task impossible.
    check_points(labels, clean.free, clean.frame)
    letters = place_letters(labels, clean.free, clean.frame)
    target.parent.mkdir(parents=True, exist_ok=True)
    save_places(labels, target)
    # Bit i of a cell's letter is proposition i.
    cells = {name: int((letters >> bit & 1).sum()) for bit, name in enumerate(labels.names)}
    # Areas, because a proposition that covers three cells instead of thirty is seen in them at once.
    side = clean.frame.resolution
    if json:
        print_json({"file": str(target), "cells": cells, "start": labels.start, "tasks": dict(labels.tasks)})
        return
    output = console()
    for name, count in cells.items():
        output.print(f"{name:12} {count} cells, {count * side**2:.1f} m2")
    output.print(f"wrote {target}")
    # A command that works as it stands: a task of the labels, or to reach every place.
    example = labels.tasks[0][0] if labels.tasks else " & ".join(f"F {in_formula(name)}" for name in labels.names)
    world = _environment(file, None if out is None else target, resolution, radius, level)
    print_next(output, shlex.join(["potlp", "run", world, "--task", example]))


@app.command(
    "preview",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp map preview office.yaml --out office.png[/cyan]

[cyan]potlp map preview office.yaml --labels office.places.yaml --resolution 0.4 --out office.pdf[/cyan]

[dim]Labels in office.places.yaml are drawn without being named.[/dim]
""",
)
def preview_map(
    file: MapFile,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="PICTURE", help="Picture to write: .png, .svg or .pdf.")],
    labels: Annotated[
        Path | None, typer.Option("--labels", metavar="LABELS.yaml", help="Labels to draw; default: FILE.places.yaml.")
    ] = None,
    resolution: Resolution = None,
    radius: Radius = 0.1,
    level: Level = None,
) -> None:
    """Draw a map in metres: what the robot can reach, what is cut off, propositions and start."""
    import jax

    from potlp_jax.environments.ros.buildings import load_building
    from potlp_jax.environments.ros.cleaning import clean_map
    from potlp_jax.environments.ros.places import places_file
    from potlp_jax.environments.ros.ros_map import RosMap, RosMapConfig
    from potlp_jax.view.map_preview import draw_map, draw_places
    from potlp_jax.view.style import save_figure

    # Where `map:FILE.yaml` looks for labels too.
    beside = places_file(file, level)
    found = labels or (beside if beside.is_file() else None)
    if found is None:
        image_map = load_building(file, level)
        clean = clean_map(image_map, resolution, radius)
        figure = draw_map(image_map, clean, _title(file, clean))
    else:
        # A start that the labels leave open is drawn by the key; any shows where trials may begin.
        family = RosMap(RosMapConfig(file, str(found), resolution, radius, level))
        figure = draw_places(family, family.generate(jax.random.key(0)), _title(file, family.clean))
    save_figure(figure, out)
    console().print(f"wrote {out}")


def _environment(file: Path, places: Path | None, resolution: float | None, radius: float, level: str | None) -> str:
    """How the command line names the worlds on a map, without options that have their default."""
    from potlp_jax.environments.ros.ros_map import RosMapConfig

    chosen = {"resolution": resolution, "radius": radius}
    options = [
        f"{name}={_number(value)}"
        for name, value in chosen.items()
        if value is not None and value != getattr(RosMapConfig, name)
    ]
    of_level = [] if level is None else [f"level={level}"]
    return ",".join([f"map:{file}", *([] if places is None else [f"places={places}"]), *options, *of_level])


def _number(value: float) -> str:
    """The shortest text that reads back as the same number."""
    return short if float(short := f"{value:g}") == value else repr(value)


@contextmanager
def _caught_warnings() -> Iterator[list[str]]:
    """The texts of the map's warnings, once the block is done."""
    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        # By default Python shows a warning once for each place in the program, however many maps are read.
        warnings.simplefilter("always", MapWarning)
        yield texts
    texts += [str(warning.message) for warning in caught]


def _title(file: Path, clean: "CleanMap") -> str:
    return f"{file.name}: {clean.frame.height} x {clean.frame.width} cells of {clean.frame.resolution:g} m"
