"""Parcels delivered by a simulated robot on real maps, after the real-world experiment (Bradley et al. 2021, V-C).

    python -m eval.real_maps --out out/real-maps --maps MAPS
    python -m eval.real_maps --out out/real-maps --maps MAPS --only uma_rooms gdc_3ne --worlds 5

``MAPS`` is a folder with the maps ``uma_rooms``, ``gdc_3ne``, ``gdc_floor2`` and ``intel_lab``; the rooms of the first
and last are drawn by hand (the YAML files beside this one), those of the others come from the labels in MAPS/labels.
A document and a package are in two rooms, which are lit; the camera has noise, and another exposure and colour balance
in every picture. The paper ran 5 trials per planner: the first 5 of each task and map are set apart. The network
learned on generated floors only. Beside the baseline that decides as all policies do, PO-TLP is compared with baselines
of other settings (``OPPONENTS``). ``--report`` writes NAME.json, and NAME.png: the first world in which the nearest
room is dark, as the baseline and as PO-TLP solve it.
"""

import argparse
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.contact_sheet import draw_plan
from eval.real_maps.gdc import LABELS, rooms_from_labels
from eval.savings import (
    TABLE_HEAD,
    audit,
    compare_first,
    decision_lines,
    decisions_of,
    read_rows,
    sweep,
    table_lines,
)
from potlp_jax.environments.campus.furnishing import PARCELS
from potlp_jax.environments.ros.mapped_rooms import MappedRooms
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.planning.distances.product import grid_distances
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.results import Pair, pair_rows
from potlp_jax.sweep.rows import provenance, read_path
from potlp_jax.sweep.store import Row
from potlp_jax.trials.config import trial_config_for
from potlp_jax.view.layers import draw_ends
from potlp_jax.view.style import ROBOT, new_figure, save_figure

MAPS = ("uma_rooms", "gdc_3ne", "gdc_floor2", "intel_lab")
POLICIES = [Policy.KNOWN_MAP.value, Policy.BASELINE.value, Policy.ORACLE.value, Policy.POTLP.value]
LARGE = ("gdc_floor2", "intel_lab")
"""Maps on which the oracle is left out: its labels take seconds a decision there."""

FIRST = 5
OPPONENTS: dict[str, Callable[[float], dict[str, Any]]] = {
    "replanning twice as often": lambda replan_distance: {"replan_distance": replan_distance / 2},
    "with frontiers of two cells": lambda _: {"decision": {"frontiers": {"min_size": 2}}},
}
"""Settings of further baselines, from the ``replan_distance`` of the map. The first is best for it in the
validation worlds of buildings with doors as narrow (docs/results/fair_settings.md); the second is best for it on GDC
3NE, where slivers between clutter draw it away, and was chosen with these maps known."""

CAMERA = {"noise": 6.0, "exposure": 0.15, "colour": 0.05}
"""Disturbances of every picture (``world.camera.Disturbance``)."""


def environment_of(maps: Path, name: str, out: Path) -> str:
    """The environment of a map; its rooms file is written into ``out`` where it is made from labels."""
    rooms = Path(__file__).with_name(f"{name}.rooms.yaml")
    if name in LABELS:
        rooms = out / f"{name}.rooms.yaml"
        rooms.write_text(json.dumps(rooms_from_labels(maps, name)))
    return f"parcels:{maps / name}.yaml,rooms={rooms}"


def policies_of(name: str) -> list[str]:
    """The policies that run on a map."""
    return [policy for policy in POLICIES if name not in LARGE or policy != Policy.ORACLE]


def specification(
    environment: str, policies: list[str], worlds: int, own: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """A sweep over test worlds of one map; ``own`` are settings of the baseline alone."""
    return {
        "environments": [environment],
        "tasks": [int(task) for task in PARCELS.tasks],
        "policies": policies,
        "worlds": worlds,
        "split": Split.TEST.value,
        "settings": {"disturbance": CAMERA},
        "policy_settings": {Policy.BASELINE.value: own} if own else {},
    }


def exchange(rows: Sequence[Row], others: Sequence[Row]) -> list[Row]:
    """Rows with the baseline's taken from other rows."""
    kept = [row for row in rows if row.item.policy != Policy.BASELINE]
    return kept + [row for row in others if row.item.policy == Policy.BASELINE]


def first_room(generator: MappedRooms, path: np.ndarray) -> int:
    """Number of the room that a path enters first; 0 (the hallways) where it enters none."""
    rooms = generator.floor.rooms[path[:, 0], path[:, 1]]
    return int(rooms[np.argmax(rooms > 0)])


def nearest_room(generator: MappedRooms, world: Any) -> int:
    """Number of the room whose entrance is nearest to the start."""
    distance = np.asarray(grid_distances(~world.occupied, world.start, world.resolution))
    inside = generator.floor.rooms > 0
    return int(generator.floor.rooms[inside][np.argmin(distance[inside])])


def contrast(generator: MappedRooms, pairs: list[Pair]) -> dict[str, Any]:
    """How often each planner enters first the nearest room, and a lit one, in worlds whose nearest room is dark."""
    found: dict[str, dict[str, int]] = {}
    dark, example = 0, None
    for pair in pairs:
        number = pair[Policy.BASELINE].item.world
        world, placement = generator.generate_with_layout(world_key(Split.TEST, number, generator.name))
        nearest, lit = nearest_room(generator, world), set(placement.rooms.values())
        if nearest in lit:
            continue
        dark += 1
        entered = {policy: first_room(generator, read_path(row.path)) for policy, row in pair.items()}
        for policy, room in entered.items():
            counts = found.setdefault(policy, {"nearest": 0, "lit": 0})
            counts["nearest"] += room == nearest
            counts["lit"] += room in lit
        if example is None and entered[Policy.BASELINE] == nearest and entered[Policy.POTLP] in lit:
            example = number
    return {"worlds": dark, "first_entered": found, "example": example}


def draw_contrast(generator: MappedRooms, pair: Pair, file: Path) -> None:
    """The paths of the baseline and of PO-TLP in one world, side by side unless it is wide; lit rooms are bright."""
    number = pair[Policy.BASELINE].item.world
    world = generator.generate(world_key(Split.TEST, number, generator.name))
    height, width = world.shape
    rows, columns = (1, 2) if width < 2 * height else (2, 1)
    figure = new_figure(11.0, rows * (11.0 / columns * height / width + 0.3))
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.95, wspace=0.03, hspace=0.1)
    for place, policy in enumerate((Policy.BASELINE, Policy.POTLP)):
        axes = figure.add_subplot(rows, columns, place + 1)
        path = [(int(row), int(column)) for row, column in read_path(pair[policy].path)]
        draw_plan(axes, world, generator.propositions, path[0])
        axes.plot(*np.array(path, float).T[::-1], color=ROBOT, lw=1.5)
        draw_ends(axes, path)
        axes.set_title(f"{policy}: {pair[policy].cost:.1f} m", fontsize=10)
    save_figure(figure, file)


def compare_with(generator: MappedRooms, folder: Path, policies: list[str], worlds: int) -> dict[str, Any]:
    """By opponent: its tables in place of the baseline's, and the audit of its trials."""
    found, rows = {}, read_rows(folder)
    for name in OPPONENTS:
        own = [row for row in read_rows(opponent_folder(folder, name)) if row.item.policy == Policy.BASELINE]
        tables = [compare_first(exchange(rows, own), formula, policies, worlds) for formula in PARCELS.tasks.values()]
        found[name] = {"tables": tables, "audited": len(own), "problems": audit(own, generator, Split.TEST)}
    return found


def opponent_folder(folder: Path, name: str) -> Path:
    """Where the trials of one of ``OPPONENTS`` lie, beside those of the map."""
    return folder.with_name(f"{folder.name}-{name.replace(' ', '-')}")


def results_of(generator: MappedRooms, folder: Path, policies: list[str], worlds: int) -> dict[str, Any]:
    """Tables of one map, the audit, and the contrast."""
    rows = read_rows(folder)
    problems = audit(rows, generator, Split.TEST)
    pairs = pair_rows([row for row in rows if row.item.task == PARCELS.tasks["1"]], policies)
    return {
        "policies": policies,
        "rooms": len(generator.rooms) - 1,
        "cells": generator.floor.rooms.shape,
        "tables": [
            compare_first(rows, formula, policies, count)
            for formula in PARCELS.tasks.values()
            for count in sorted({min(FIRST, worlds), worlds})
        ],
        "opponents": compare_with(generator, folder, policies, worlds),
        "contrast": contrast(generator, pairs),
        "audited": len(rows),
        "problems": problems,
        "commits": sorted({row.commit for row in rows}),
        "decisions": decisions_of(rows, policies),
    }


def markdown(results: Mapping[str, Any]) -> str:
    """The tables as they stand in docs/results."""
    lines = []
    for name, found in results["maps"].items():
        lines += ["", f"### {name}: {found['rooms']} rooms, {found['cells'][0]} × {found['cells'][1]} cells", ""]
        lines.append(TABLE_HEAD)
        for table in found["tables"]:
            lines += table_lines(table, found["policies"])
        for label, opponent in found["opponents"].items():
            lines += ["", f"Another baseline, {label}:", "", TABLE_HEAD]
            for table in opponent["tables"]:
                lines += table_lines(table, [Policy.BASELINE, Policy.POTLP])
            lines.append(f"\n{opponent['audited']} trials audited: {len(opponent['problems'])} problems.")
        dark = found["contrast"]
        entered = "; ".join(
            f"{policy} {counts['nearest']} and {counts['lit']}" for policy, counts in dark["first_entered"].items()
        )
        lines += [
            "",
            f"{found['audited']} trials audited: {len(found['problems'])} problems. In {dark['worlds']} worlds the "
            f"nearest room is dark; it, and a lit room, was entered first by: {entered}.",
            "",
            *decision_lines(found["decisions"]),
        ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweeps")
    parser.add_argument("--maps", type=Path, required=True, help="folder of the maps")
    parser.add_argument("--only", nargs="+", choices=MAPS, default=list(MAPS), metavar="MAP")
    parser.add_argument("--worlds", type=int, default=50, help="per map and task")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--report", type=Path, help="without suffix: where results and picture go")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    found, example = {}, None
    for name in options.only:
        environment, policies = environment_of(options.maps, name, options.out), policies_of(name)
        sweep(options.out / name, specification(environment, policies, options.worlds), options.processes)
        generator = MappedRooms.from_spec(environment)
        for label, changes in OPPONENTS.items():
            own = changes(trial_config_for(generator).replan_distance)
            specified = specification(environment, [Policy.KNOWN_MAP, Policy.BASELINE], options.worlds, own)
            sweep(opponent_folder(options.out / name, label), specified, options.processes)
        found[name] = results_of(generator, options.out / name, policies, options.worlds)
        if example is None and found[name]["contrast"]["example"] is not None:
            rows = [row for row in read_rows(options.out / name) if row.item.task == PARCELS.tasks["1"]]
            wanted = found[name]["contrast"]["example"]
            example = generator, next(p for p in pair_rows(rows, policies) if p[Policy.BASELINE].item.world == wanted)
    results = {"maps": found, "camera": CAMERA, "provenance": provenance()}
    print(markdown(results))
    if options.report is not None:
        options.report.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n")
        if example is not None:
            draw_contrast(*example, options.report.with_suffix(".png"))


if __name__ == "__main__":
    main()
