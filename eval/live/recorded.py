"""Drive a simulated robot live through real buildings, over rosbridge, and keep record, page and picture of each drive.

    python -m eval.live.recorded --out out/recorded --maps MAPS
    python -m eval.live.recorded --out out/recorded --maps MAPS --only uma_rooms --policies baseline

``MAPS`` is a folder with the maps ``uma_rooms`` and ``gdc_3ne``. The robot is behind a rosbridge server in a process of
its own (``eval.live.server``). It is driven as by ``potlp drive --follow``, with the settings that the worlds call for;
the clock is the real one, and the robot does not wait for decisions. The task is to find a document and a package in
test world 0 of each map. Each drive gets a folder in ``--out``, MAP-POLICY, with ``trial.json`` and ``replay.html``.

Afterwards an evaluator that shares no code with the planner judges each path in the true building: moves, cost, letters
and how the task ended. Exit code 1 where it finds a fault. What costs were to be expected say the same world without a
network, and its true map. ``--report`` writes NAME.json, and beside it a picture of each map; the pages hold the maps
cell by cell, which are others', and stay in ``--out``.
"""

import argparse
import contextlib
import dataclasses
import json
import math
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from eval.live.building import Building
from eval.live.simulator import PICTURES
from eval.real_maps.__main__ import environment_of
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.drive.config import DriveConfig, Mode, Topics
from potlp_jax.drive.driving import drive_robot
from potlp_jax.drive.inbox import Inbox
from potlp_jax.drive.rosbridge import RosbridgeLink
from potlp_jax.environments.campus.furnishing import PARCELS
from potlp_jax.learning.estimator import named_estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.rows import provenance
from potlp_jax.task.task import Task
from potlp_jax.trials.config import trial_config_for
from potlp_jax.trials.loop import run_trial, shifted_cells, shifted_decision
from potlp_jax.trials.record import NEVER_SEEN, Decision, Trial
from potlp_jax.trials.replay import Views
from potlp_jax.verify.audit import problems_of_path
from potlp_jax.view.maps import draw_side_by_side
from potlp_jax.view.replay_page import replay_page
from potlp_jax.view.style import save_figure
from potlp_jax.world.grid import BeliefMap, World
from potlp_jax.world.moves import Cell, as_cell

MAPS = ("uma_rooms", "gdc_3ne")
POLICIES = (Policy.BASELINE.value, Policy.POTLP.value)
FORMULA = PARCELS.tasks["1"]
WORLD = 0

COMMAND = "python -m eval.live.recorded --out out/recorded --maps MAPS"
"""As results name it: without the folders of one machine."""


class _TimedInbox(Inbox):
    """Knows when the robot was looked after last: what follows, up to the decision, is the time that this takes."""

    looked = 0.0

    def wait(self, seconds: float) -> None:
        super().wait(seconds)
        self.looked = time.monotonic()


@contextlib.contextmanager
def serving(environment: str, world: int, speed: float) -> Iterator[str]:
    """A robot behind rosbridge in a process of its own; gives its address.

    Args:
        environment, world: where it drives.
        speed: seconds of the simulation in a second.

    Yields:
        HOST:PORT.
    """
    words = ["--port", "0", "--speed", str(speed), "--environment", environment, "--world", str(world)]
    server = subprocess.Popen([sys.executable, "-m", "eval.live.server", *words], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        told = server.stdout.readline()
        if not told:
            raise SystemExit("the robot did not start; see above")
        port = told.split(";")[0].rsplit(":", 1)[1]
        yield f"127.0.0.1:{port}"
    finally:
        server.kill()
        server.wait()


def drive_live(name: str, environment: str, building: Building, policy: str, speed: float) -> tuple[Trial, list[float]]:
    """One drive.

    Args:
        name: of the map, for the record.
        environment: of the building, for the server.
        building: the same; only its settings and the size of its cells are used.
        policy: baseline or potlp; the latter asks the estimator that is shipped for parcels.
        speed: as in ``serving``.

    Returns:
        The record, and the seconds of each decision: from the last look at the robot to the decision.
    """
    # The walls of the building have grown by the robot's radius already.
    config = DriveConfig(
        mode=Mode.FOLLOW,
        topics=Topics(image=PICTURES if policy == Policy.POTLP else ""),
        resolution=building.frame.resolution,
        radius=0.0,
        silence=20.0,
        patience=120.0,
    )
    task = Task.from_formula(FORMULA, building.propositions)
    inbox, seconds = _TimedInbox(config, task.propositions), []

    def time_it(_decision: Decision, _belief: BeliefMap) -> None:
        seconds.append(time.monotonic() - inbox.looked)

    estimator = named_estimator("parcels") if policy == Policy.POTLP else None
    settings = trial_config_for(building.world)
    with serving(environment, WORLD, speed) as address:
        link = RosbridgeLink(address)
        try:
            drive = drive_robot(
                link,
                task,
                policy,
                jax.random.key(0),
                config,
                trial_config=settings,
                estimator=estimator,
                name=f"{name}, over rosbridge",
                listener=time_it,
                inbox=inbox,
            )
            trial = next(drive)
            drive.close()
        finally:
            link.close()
    return trial, seconds


def on_true_map(trial: Trial, world: World) -> Trial:
    """A record of a robot, whose map begins somewhere, on the cells of the building that it drove in.

    Args:
        trial: of a robot that began in the world's start; its cells are those of the world, but for a shift.
        world: the truth.
    """
    start = as_cell(world.start)
    down, across = start[0] - trial.path[0][0], start[1] - trial.path[0][1]
    seen = np.full(world.shape, NEVER_SEEN, np.int32)
    for row, column in np.argwhere(trial.first_seen != NEVER_SEEN):
        seen[row + down, column + across] = trial.first_seen[row, column]
    return dataclasses.replace(
        trial,
        world=world,
        first_seen=seen,
        path=shifted_cells(trial.path, down, across),
        decisions=tuple(shifted_decision(decision, down, across) for decision in trial.decisions),
    )


def problems_of_drive(trial: Trial, world: World) -> list[str]:
    """What is wrong with a drive, ``trial`` being on the true map; an empty list if nothing is."""
    found = problems_of_path(world, trial.path, trial.cost, trial.outcome, trial.task_text)
    letters = np.asarray(world.letters)
    if tuple(int(letters[cell]) for cell in trial.path) != trial.word:
        found.append("the word is not that of the path")
    return found


def length_to_and_fro(path: Sequence[Cell]) -> float:
    """How much of a path, in cells, was driven to and fro: up to a cell, and the same way back."""
    moves: set[int] = set()
    for turn in range(1, len(path) - 1):
        reach = 0
        while reach < min(turn, len(path) - 1 - turn) and path[turn - reach - 1] == path[turn + reach + 1]:
            reach += 1
        moves.update(range(turn - reach, turn + reach))
    return sum(math.dist(path[move], path[move + 1]) for move in moves)


def row_of(
    name: str, trial: Trial, seconds: Sequence[float], wall: float, building: Building, task: Task
) -> dict[str, Any]:
    """Figures of one drive, ``trial`` being on the true map."""
    world = building.world

    def simulated(policy: str) -> Trial:
        return run_trial(world, task, policy, jax.random.key(0), trial_config_for(world))

    def to_and_fro(one: Trial) -> float:
        return length_to_and_fro(one.path) * building.frame.resolution

    without_network = simulated(trial.policy)

    return {
        "map": name,
        "policy": trial.policy,
        "outcome": str(trial.outcome),
        "cost": trial.cost,
        "to_and_fro": to_and_fro(trial),
        "cost_without_network": without_network.cost,
        "to_and_fro_without_network": to_and_fro(without_network),
        "cost_known_map": simulated(Policy.KNOWN_MAP.value).cost,
        "decisions": len(trial.decisions),
        "failed_legs": sum(bool(decision.failure) for decision in trial.decisions),
        "corrected_cells": len(trial.corrections),
        "seconds_median": float(np.median(seconds)),
        "seconds_p95": float(np.quantile(seconds, 0.95)),
        "seconds_longest": max(seconds),
        "seconds_of_drive": wall,
        "letters": len(trial.word),
        "status": trial.summary()["status"],
        "notes": list(trial.notes),
        "problems": problems_of_drive(trial, world),
    }


def write(trial: Trial, folder: Path) -> None:
    """Write record and page of a drive, as ``potlp drive --out`` does."""
    folder.mkdir(exist_ok=True)
    trial.save(folder / "trial.json")
    (folder / "replay.html").write_text(replay_page(trial, Views()), "utf-8")


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog="python -m eval.live.recorded", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the records and pages")
    parser.add_argument("--maps", type=Path, required=True, help="folder of the maps")
    parser.add_argument("--only", nargs="+", choices=MAPS, default=list(MAPS), metavar="MAP")
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=list(POLICIES))
    parser.add_argument("--speed", type=float, default=1.0, help="seconds of the simulation in a second")
    parser.add_argument("--report", type=Path, help="without suffix: where figures go; pictures beside it")
    options = parser.parse_args()
    enable_compilation_cache()
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for name in options.only:
        environment = environment_of(options.maps, name, options.out)
        building = Building.from_spec(environment, WORLD)
        task, drawn = Task.from_formula(FORMULA, building.propositions), []
        for policy in options.policies:
            begun = time.monotonic()
            trial, seconds = drive_live(name, environment, building, policy, options.speed)
            wall = time.monotonic() - begun
            write(trial, options.out / f"{name}-{policy}")
            drawn.append(on_true_map(trial, building.world))
            rows.append(row_of(name, drawn[-1], seconds, wall, building, task))
            print(json.dumps(rows[-1]), flush=True)
        if options.report is not None:
            save_figure(draw_side_by_side(drawn), options.report.with_name(f"{name}.png"))
    if options.report is not None:
        chosen = ["--only", *options.only, "--policies", *options.policies, "--speed", f"{options.speed:g}"]
        command = shlex.join([*COMMAND.split(), *chosen])
        data = {"provenance": provenance() | {"command": command}, "world": WORLD, "speed": options.speed, "rows": rows}
        options.report.with_suffix(".json").write_text(json.dumps(data, indent=1) + "\n", "utf-8")
    return int(any(row["problems"] for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
