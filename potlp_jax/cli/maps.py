"""``potlp map``: from a ROS map to a world."""

import dataclasses
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import Json
from potlp_jax.cli.output import console, fail, print_json
from potlp_jax.errors import MapWarning

if TYPE_CHECKING:
    from potlp_jax.environments.ros.cleaning import CleanMap
    from potlp_jax.environments.ros.map_files import OccupancyMap
    from potlp_jax.environments.ros.places import Disc, Places, Point, Polygon, Region
    from potlp_jax.environments.ros.survey import MapSurvey, Passage

PLACE_RADIUS: float = 0.5
"""Metres around a point where its proposition is true, unless a radius is given."""

# What fits on a screen beside the rest; passages come narrowest first.
SHOWN: int = 8
"""Passages, and parts that are cut off, that are printed; JSON has all."""

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
        clean = clean_map(image_map, resolution, radius, _read_start(start), "--start")
    survey = survey_map(image_map, clean)
    defects = [*remarks, *_defects(survey, clean)]
    if json:
        print_json(
            {**_map_facts(image_map), **_survey_facts(survey), **_clean_facts(clean, radius), "defects": defects}
        )
        return
    out = console()
    out.print(str(file), style="bold")
    for name, text in (*_map_lines(image_map, survey), *_clean_lines(clean, radius)):
        out.print(f"{name:12} {text}")
    if survey.passages:
        out.print(_passage_table(survey.passages))
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
    # A cleaned map has lost what was cleaned away, so that it must not replace its source by accident.
    own = {path.resolve() for path in (image_map.settings.file, image_map.settings.image)}
    if own & {out.resolve(), out.with_suffix(".pgm").resolve()}:
        fail(f"--out {out} would overwrite the map itself; give another name")
    clean = clean_map(image_map, resolution, radius, _read_start(start), "--start")
    out.parent.mkdir(parents=True, exist_ok=True)
    image = save_map(out, clean.free, clean.frame)
    # The map is written with obstacles grown already: growing them again would close passages.
    world = _environment(out, None, resolution, 0.0, None)
    if json:
        print_json({**_clean_facts(clean, radius), "files": [str(out), str(image)], "world": world})
        return
    output = console()
    for name, text in _clean_lines(clean, radius):
        output.print(f"{name:12} {text}")
    for line in _cut_off_lines(clean):
        output.print(f"- {line}")
    output.print(f"wrote {out} and {image}")
    next_one = f"potlp map label {out} --resolution {clean.frame.resolution:g} --radius 0, then potlp run {world}"
    output.print(f"next: {next_one} (the radius is in the map already)", style="dim")


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
        typer.Option("--out", "-o", metavar="LABELS.yaml", help="Default: FILE.places.yaml beside the map."),
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
    from potlp_jax.environments.ros.places import Places, check_points, load_places, place_letters, save_places

    target = file.with_suffix(".places.yaml") if out is None else out
    # Labels are typed by hand; overwriting them by a repeated command would lose work.
    if target.exists() and not add:
        fail(f"{target} exists: --add adds to it, --out writes another file")
    old = load_places(target) if add else Places(())
    image_map = load_building(file, level)
    own = _named_places(file, image_map, named or [])
    labels = _joined(old, own, places=place or [], rooms=room or [], tasks=task or [], start=start)
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
    example = labels.tasks[0][0] if labels.tasks else " & ".join(f"F {name}" for name in labels.names)
    world = _environment(file, None if out is None else target, resolution, radius, level)
    output.print(f"next: potlp run {world} --task '{example}'", style="dim")


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
    from potlp_jax.environments.ros.ros_map import RosMap, RosMapConfig
    from potlp_jax.view.map_preview import draw_map, draw_places
    from potlp_jax.view.style import save_figure

    # Where `map:FILE.yaml` looks for labels too.
    beside = file.with_suffix(".places.yaml")
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
    options = [f"{name}={value:g}" for name, value in chosen.items() if value != getattr(RosMapConfig, name)]
    of_level = [] if level is None else [f"level={level}"]
    return ",".join([f"map:{file}", *([] if places is None else [f"places={places}"]), *options, *of_level])


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


def _map_facts(image_map: "OccupancyMap") -> dict[str, Any]:
    settings, frame = image_map.settings, image_map.frame
    return {
        "file": str(settings.file),
        "kind": image_map.kind,
        "closed_gaps": image_map.closed_gaps,
        "places": [] if image_map.places is None else list(image_map.places.names),
        "image": str(settings.image),
        "pixels": [frame.height, frame.width],
        "resolution": frame.resolution,
        # Products of a resolution such as 0.05 have digits that mean nothing.
        "metres": [round(frame.height * frame.resolution, 6), round(frame.width * frame.resolution, 6)],
        "origin": [frame.x, frame.y],
        "yaw": frame.yaw,
        "mode": settings.mode,
        "negate": settings.negate,
        "occupied_thresh": float(settings.occupied_thresh),
        "free_thresh": float(settings.free_thresh),
    }


def _survey_facts(survey: "MapSurvey") -> dict[str, Any]:
    facts = dataclasses.asdict(survey)
    return {"shares": {name: facts.pop(name) for name in ("free", "occupied", "unknown")}, **facts}


def _clean_facts(clean: "CleanMap", radius: float) -> dict[str, Any]:
    return {
        "grid": {"cells": [clean.frame.height, clean.frame.width], "resolution": clean.frame.resolution},
        "radius": radius,
        "reachable_cells": int(clean.free.sum()),
        "free_area": dataclasses.asdict(clean.area),
        "cut_off": [dataclasses.asdict(part) for part in clean.cut_off],
    }


def _map_lines(image_map: "OccupancyMap", survey: "MapSurvey") -> Iterator[tuple[str, str]]:
    from potlp_jax.environments.ros.map_files import ROS_MAP

    settings, frame = image_map.settings, image_map.frame
    metres = f"{frame.width * frame.resolution:.2f} x {frame.height * frame.resolution:.2f} m"
    drawn = f"{frame.width} x {frame.height} pixels of {frame.resolution:g} m: {metres}"
    origin = f"[{frame.x:g}, {frame.y:g}], turned by {frame.yaw:g} rad ({math.degrees(frame.yaw):.1f} degrees)"
    if image_map.kind == ROS_MAP:
        yield "image", f"{settings.image.name}, {drawn}"
        yield "origin", origin
        inverted = ", negated" if settings.negate else ""
        thresholds = f"occupied above {float(settings.occupied_thresh):g}, free below {float(settings.free_thresh):g}"
        yield "mode", f"{settings.mode}{inverted}, {thresholds}"
    else:
        yield "plan", f"{image_map.kind}, drawn as {drawn}"
        yield "origin", origin
    if image_map.closed is not None:
        yield "outer walls", f"{image_map.closed_gaps} gaps closed (potlp map preview shows them)"
    if image_map.places is not None:
        yield "places", ", ".join(image_map.places.names)
    shares = ((survey.free, "free"), (survey.occupied, "occupied"), (survey.unknown, "unknown"))
    yield "pixels", ", ".join(f"{100 * share:.1f} % {name}" for share, name in shares)
    # Specks count as parts, so that they are named: otherwise a noisy map seems to fall into hundreds of rooms.
    specks = f", {survey.specks} of them specks" if survey.specks else ""
    yield "free space", f"connected parts: {survey.components}{specks}; the largest has {survey.largest:.1f} m2"


def _clean_lines(clean: "CleanMap", radius: float) -> Iterator[tuple[str, str]]:
    frame, area = clean.frame, clean.area
    yield "grid", f"{frame.height} x {frame.width} cells of {frame.resolution:g} m, {clean.free.sum()} reachable"
    yield (
        "cleaning",
        f"{area.mapped:.1f} m2 free on the map; {area.inflated:.1f} where a robot of radius {radius:g} m fits; "
        f"{area.resampled:.1f} in whole cells; {area.reachable:.1f} connected",
    )


def _passage_table(passages: "Sequence[Passage]") -> Table:
    # The caption says how many are not shown, so that nobody takes the table for all.
    rest = len(passages) - SHOWN
    table = Table(
        title="narrowest passages",
        title_justify="left",
        box=SIMPLE_HEAD,
        caption=f"and {rest} more: --json" if rest > 0 else None,
        caption_justify="left",
    )
    for name in ("width (m)", "at", "area behind (m2)"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("on the grid")
    for passage in passages[:SHOWN]:
        x, y = passage.at
        state = "open" if passage.is_open else "closed"
        table.add_row(f"{passage.width:.2f}", f"[{x:.2f}, {y:.2f}]", f"{passage.area:.1f}", state)
    return table


def _defects(survey: "MapSurvey", clean: "CleanMap") -> Iterator[str]:
    """What looks wrong, in words, with what cleaning does about it."""
    if survey.open_edge:
        yield (
            f"{survey.open_edge:.1f} m of free space end at unknown space or the image's edge, without a wall: "
            "cleaning closes them"
        )
    if survey.specks:
        yield f"{survey.specks} specks of free space that no robot can have seen: cleaning drops them"
    if survey.loose_obstacles:
        yield f"{survey.loose_obstacles} obstacles of a single pixel amid free space: kept; erase what is noise"
    yield from _cut_off_lines(clean)


def _cut_off_lines(clean: "CleanMap") -> Iterator[str]:
    from potlp_jax.environments.ros.cleaning import Cause

    why = {
        Cause.MAP: "not connected with the rest on the map itself: open what joins them, or give a --start",
        Cause.RADIUS: "cut off by the robot's radius: use a smaller one",
        Cause.CELLS: "cut off by the size of the cells: use smaller ones",
    }
    for part in clean.cut_off[:SHOWN]:
        yield f"{part} are {why[part.cause]}"
    # Parts come largest first, so that those that are only counted are the small ones.
    rest = clean.cut_off[SHOWN:]
    if rest:
        area = sum(part.area for part in rest)
        yield f"{len(rest)} smaller parts, {area:.1f} m2 in all, cannot be reached either: --json has them"


def _named_places(file: Path, image_map: "OccupancyMap", names: Sequence[str]) -> "dict[str, tuple[Region, ...]]":
    known = {} if image_map.places is None else dict(image_map.places.propositions)
    for name in names:
        if name not in known:
            fail(f"--named {name}: {file} names {', '.join(known) or 'no places'}")
    return {name: known[name] for name in names}


def _joined(
    old: "Places",
    own: "Mapping[str, tuple[Region, ...]]",
    *,
    places: Sequence[str],
    rooms: Sequence[str],
    tasks: Sequence[str],
    start: str | None,
) -> "Places":
    """The old labels with what the options add. Raises TaskError for a bad name or formula."""
    from potlp_jax.environments.ros.places import Places
    from potlp_jax.task.propositions import check_propositions
    from potlp_jax.task.task import Task

    # A name that is given again gets another place: the proposition holds in each of them.
    regions: dict[str, list[Region]] = {name: list(found) for name, found in old.propositions}
    for name, found in own.items():
        regions.setdefault(name, []).extend(found)
    for option in places:
        name, text = _named("--place", option, "NAME=X,Y[,RADIUS]")
        regions.setdefault(name, []).append(_read_disc(option, text))
    for option in rooms:
        name, text = _named("--room", option, 'NAME="X,Y X,Y X,Y ..."')
        regions.setdefault(name, []).append(_read_polygon(option, text))
    if not regions:
        fail("there is nothing to label: give a --place or a --room, or --named")
    names = check_propositions(list(regions))
    formulas = dict(old.tasks) | dict(_named("--task", option, "NAME=FORMULA") for option in tasks)
    # Compiled only to be checked; labels keep the text.
    for formula in formulas.values():
        Task.from_formula(formula, names)
    return Places(
        tuple((name, tuple(found)) for name, found in regions.items()),
        old.start if start is None else _read_start(start),
        tuple(formulas.items()),
        "labels",
    )


def _named(option: str, text: str, form: str) -> tuple[str, str]:
    # Only the first "=" separates: formulas and file names may hold others.
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals and value):
        fail(f"{option} {text}: write {option} {form}")
    return name, value


def _read_disc(option: str, text: str) -> "Disc":
    from potlp_jax.environments.ros.places import Disc

    numbers = _read_numbers(f"--place {option}", text)
    if len(numbers) not in (2, 3):
        fail(f"--place {option}: give x and y in metres and, if you like, a radius: 2.1,3.4,0.5")
    # Two numbers are a point, three a point and a radius.
    radius = numbers[2] if len(numbers) == 3 else PLACE_RADIUS
    if radius < 0:
        fail(f"--place {option}: a radius of {radius:g} m is negative")
    return Disc((numbers[0], numbers[1]), radius)


def _read_polygon(option: str, text: str) -> "Polygon":
    from potlp_jax.environments.ros.places import Polygon

    corners = [_read_numbers(f"--room {option}", corner) for corner in text.split()]
    # Fewer corners enclose nothing.
    if len(corners) < 3 or any(len(corner) != 2 for corner in corners):
        fail(f"--room {option}: give three corners or more, in metres: 1,1 4,1 4,3")
    return Polygon(tuple((x, y) for x, y in corners))


def _read_start(text: str | None) -> "Point | None":
    if text is None:
        return None
    numbers = _read_numbers("--start", text)
    if len(numbers) != 2:
        fail(f"--start {text}: give x and y in metres: 1.5,2")
    return numbers[0], numbers[1]


def _read_numbers(what: str, text: str) -> list[float]:
    parts = [part.strip() for part in text.split(",")]
    # `float` would also take "nan", "inf" and "1_0".
    if not all(re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)", part) for part in parts):
        fail(f"{what}: {text!r} are no numbers joined by commas")
    return [float(part) for part in parts]
