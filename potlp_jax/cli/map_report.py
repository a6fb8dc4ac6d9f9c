"""What ``potlp map`` says of a map: facts as JSON, lines and a table for the terminal, and its defects in words."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

if TYPE_CHECKING:
    from potlp_jax.environments.ros.cleaning import CleanMap
    from potlp_jax.environments.ros.occupancy_map import OccupancyMap
    from potlp_jax.environments.ros.survey import MapSurvey, Passage

# What fits on a screen beside the rest; passages come narrowest first.
SHOWN: int = 8
"""Passages, and parts that are cut off, that are printed; JSON has all."""


def map_facts(image_map: "OccupancyMap") -> dict[str, Any]:
    """The map and its plan or image, JSON-able."""
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


def survey_facts(survey: "MapSurvey") -> dict[str, Any]:
    """What the map shows, JSON-able."""
    facts = dataclasses.asdict(survey)
    return {"shares": {name: facts.pop(name) for name in ("free", "occupied", "unknown")}, **facts}


def clean_facts(clean: "CleanMap", radius: float) -> dict[str, Any]:
    """The grid that cleaning leaves to a robot of this radius in metres, JSON-able."""
    return {
        "grid": {"cells": [clean.frame.height, clean.frame.width], "resolution": clean.frame.resolution},
        "radius": radius,
        "reachable_cells": int(clean.free.sum()),
        "free_area": dataclasses.asdict(clean.area),
        "cut_off": [dataclasses.asdict(part) for part in clean.cut_off],
    }


def map_lines(image_map: "OccupancyMap", survey: "MapSurvey") -> Iterator[tuple[str, str]]:
    """Names and texts of the lines about the map."""
    from potlp_jax.environments.ros.occupancy_map import ROS_MAP

    settings, frame = image_map.settings, image_map.frame
    metres = f"{frame.width * frame.resolution:.2f} x {frame.height * frame.resolution:.2f} m"
    drawn = f"{frame.width} x {frame.height} pixels of {frame.resolution:g} m: {metres}"
    origin = f"[{frame.x:g}, {frame.y:g}], turned by {frame.yaw:g} rad ({math.degrees(frame.yaw):.1f} degrees)"
    # Robots' own maps are turned by less; degrees in their place would put every label elsewhere.
    if abs(frame.yaw) > 2 * math.pi:
        origin += ": more than a whole turn; is the third number of origin in degrees?"
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


def clean_lines(clean: "CleanMap", radius: float) -> Iterator[tuple[str, str]]:
    """Names and texts of the lines about the cleaned map, for a robot of this radius in metres."""
    frame, area = clean.frame, clean.area
    yield "grid", f"{frame.height} x {frame.width} cells of {frame.resolution:g} m, {clean.free.sum()} reachable"
    yield (
        "cleaning",
        f"{area.mapped:.1f} m2 free on the map; {area.inflated:.1f} where a robot of radius {radius:g} m fits; "
        f"{area.resampled:.1f} in whole cells; {area.reachable:.1f} connected",
    )


def passage_table(passages: "Sequence[Passage]") -> Table:
    """The first ``SHOWN`` passages."""
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


def defects_of(survey: "MapSurvey", clean: "CleanMap") -> Iterator[str]:
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
    yield from cut_off_lines(clean)


def cut_off_lines(clean: "CleanMap") -> Iterator[str]:
    """The parts that the robot cannot reach, in words, with what to do about each."""
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
