"""What the options of ``potlp map`` mean: points in metres, places, rooms, and the labels that they add up to."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from potlp_jax.cli.output import fail

if TYPE_CHECKING:
    from potlp_jax.environments.ros.occupancy_map import OccupancyMap
    from potlp_jax.environments.ros.places import Disc, Places, Point, Polygon, Region


def named_places(file: Path, image_map: "OccupancyMap", names: Sequence[str]) -> "dict[str, tuple[Region, ...]]":
    """Places that the file itself names.

    Args:
        file: the map, for messages.
        image_map: what it holds.
        names: those of ``--named``.

    Returns:
        Regions by name. The command ends where the file names no such place.
    """
    known = {} if image_map.places is None else dict(image_map.places.propositions)
    for name in names:
        if name not in known:
            fail(f"--named {name}: {file} names {', '.join(known) or 'no places'}")
    return {name: known[name] for name in names}


def joined_labels(
    old: "Places",
    own: "Mapping[str, tuple[Region, ...]]",
    *,
    places: Sequence[str],
    rooms: Sequence[str],
    tasks: Sequence[str],
    start: str | None,
) -> "Places":
    """The old labels with what the options add.

    Args:
        old: labels that are kept.
        own: places of the file itself (``named_places``).
        places, rooms, tasks: texts of ``--place``, ``--room`` and ``--task``. One of another form ends the command.
        start: text of ``--start``; None keeps the old one.

    Returns:
        The labels.

    Raises:
        TaskError: a bad name or formula.
    """
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
        old.start if start is None else read_start(start),
        tuple(formulas.items()),
        "labels",
    )


def read_start(text: str | None) -> "Point | None":
    """The point of ``--start``, in metres; None where it is not given. Another form ends the command."""
    if text is None:
        return None
    numbers = _read_numbers("--start", text)
    if len(numbers) != 2:
        fail(f"--start {text}: give x and y in metres: 1.5,2")
    return numbers[0], numbers[1]


def _named(option: str, text: str, form: str) -> tuple[str, str]:
    # Only the first "=" separates: formulas and file names may hold others.
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals and value):
        fail(f"{option} {text}: write {option} {form}")
    return name, value


def _read_disc(option: str, text: str) -> "Disc":
    from potlp_jax.environments.ros.places import PLACE_RADIUS, Disc

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


def _read_numbers(what: str, text: str) -> list[float]:
    parts = [part.strip() for part in text.split(",")]
    # `float` would also take "nan", "inf" and "1_0".
    if not all(re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)", part) for part in parts):
        fail(f"{what}: {text!r} are no numbers joined by commas")
    return [float(part) for part in parts]
