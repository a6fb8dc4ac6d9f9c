"""Buildings of every family: what a decision costs, how much memory a trial takes, and whether anything overflows.

    python -m eval.buildings --data DATA --out out/buildings.jsonl --report docs/results/buildings
    python -m eval.buildings --data DATA --out out/buildings.jsonl --most 6

``DATA`` is the folder with the maps, plans and buildings of others; without it the generated families run alone. Each
building is a process of its own, whose largest memory is that of the whole: reading, compiling, deciding. A document
and a package lie in cells drawn at random, whatever the building calls its places, so that every file that can be read
is a world (of several levels the first); the baseline and PO-TLP, which asks the estimator for parcels, look for both
in ``--worlds`` of them. Generated families run tasks and estimators of their own, on validation worlds. A map of 4,000
x 4,000 pixels is drawn, for want of one that may be had (``eval.large_map``); on it both places are within 30 m of the
start. Seconds a decision are those of a whole trial, sensing and driving included, divided by its decisions, in the
fastest trial: others compile for arrays of subgoals that grow. ``--most`` takes so many buildings of each family,
spread evenly over their sizes in bytes. The same command goes on where it was stopped.
"""

import argparse
import collections
import json
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from eval.large_map import write_large_map
from eval.limit.rows import append_row, read_rows
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments.base import Generator, host_generators
from potlp_jax.environments.campus.delivery import PARCELS_FAMILY, scaled_to
from potlp_jax.environments.campus.furnishing import NARROW_DOORS, PARCELS
from potlp_jax.environments.registry import make
from potlp_jax.environments.ros.buildings import load_building
from potlp_jax.environments.ros.cleaning import clean_map
from potlp_jax.environments.ros.map_settings import read_yaml
from potlp_jax.environments.ros.rmf import is_building
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.errors import PotlpWarning
from potlp_jax.learning.estimator import named_estimator
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.rows import provenance, source_commit
from potlp_jax.trials.config import trial_config_for
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome, Trial
from potlp_jax.types import Status, status_names
from potlp_jax.world.grid import World, make_world
from potlp_jax.world.settings import Settings

GENERATED = ("firefighting", "delivery", "campus-small", "campus-medium", "campus-large")
LARGE_MAP = "large-map"
FILES = {
    "plans in XML": "floorplans/*/*.xml",
    "ROS maps": "maps/*.yaml",
    "Open-RMF": "buildings/rmf/*.building.yaml",
    "Gazebo worlds": "buildings/kth/*.world",
}
"""Families of the data of others, and where their files lie."""

POLICIES = (Policy.BASELINE, Policy.POTLP)
LOSSES = Status.SUBGOAL_OVERFLOW | Status.TREE_OVERFLOW | Status.DEPTH_OVERFLOW | Status.VIEW_OVERFLOW
"""What says that something was cut off."""

_FIRST_WORLD = 500
# Metres around a place on which it is met.
_REACH = 0.5
# Metres from the start to the places on the large map, all of which would take a robot kilometres to see.
_NEAR = 30.0


class FoundPlaces(Generator):
    """One building of others with two places to find, in cells drawn at random.

    Args:
        file: that says what the building is.
        within: metres from the start within which the places are.
    """

    propositions = PARCELS.propositions
    tasks = PARCELS.tasks
    family = PARCELS_FAMILY

    def __init__(self, file: Path, within: float = np.inf) -> None:
        clean = clean_map(load_building(file, _first_level(file)))
        self.name = f"found:{file.stem}"
        self._free, self._resolution, self._within = clean.free, clean.frame.resolution, within
        self.settings = Settings({**NARROW_DOORS, **scaled_to(self._resolution)})

    def draw(self, key: PRNGKeyArray) -> World:
        """Start anywhere, places within the given distance of it."""
        (rng,) = host_generators(key, 1)
        free = np.argwhere(self._free)
        start = free[rng.choice(len(free))]
        near = free[np.hypot(*(free - start).T) * self._resolution <= self._within]
        places = near[rng.choice(len(near), 2, replace=False)]
        letters, reach = np.zeros(self._free.shape, np.int32), max(1, round(_REACH / self._resolution))
        for bit, (row, column) in enumerate(places):
            letters[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] |= 1 << bit
        row, column = start.tolist()
        return make_world(
            ~self._free, letters * self._free, (row, column), self._resolution, propositions=self.propositions
        )


def _first_level(file: Path) -> str | None:
    """Of a building with levels; None of other files."""
    fields = read_yaml(file) if file.suffix == ".yaml" else {}
    return next(iter(fields["levels"])) if is_building(fields) else None


def run_building(source: str, worlds: int) -> dict[str, Any]:
    """What one building costs; call it in a process of its own."""
    enable_compilation_cache()
    warnings.simplefilter("ignore", PotlpWarning)
    generator = _generator(source)
    # Buildings of others have test worlds only; nothing is chosen by these figures.
    split = Split.VALIDATION if source in GENERATED else Split.TEST
    keys = [world_key(split, number, generator.name) for number in range(_FIRST_WORLD, _FIRST_WORLD + worlds)]
    made = [generator.generate(key) for key in keys]
    found: dict[str, Any] = {policy.value: [] for policy in POLICIES}
    for number, world in enumerate(made):
        task = world.task(next(iter(generator.tasks.values())))
        for policy in POLICIES:
            estimator = named_estimator(_estimator_for(source)) if policy is Policy.POTLP else None
            began = time.perf_counter()
            trial = run_trial(world, task, policy, jax.random.key(number), trial_config_for(world), estimator=estimator)
            found[policy.value].append(_row(trial, time.perf_counter() - began))
    first = made[0]
    return {
        "cells": list(first.shape),
        "resolution": float(first.resolution),
        "free_m2": float(np.count_nonzero(~np.asarray(first.occupied)) * float(first.resolution) ** 2),
        # Kibibytes, on Linux.
        "memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "policies": found,
        "commit": source_commit(),
    }


def _generator(source: str) -> Generator:
    if source in GENERATED:
        return make(source)
    if source != LARGE_MAP:
        return FoundPlaces(Path(source))
    with tempfile.TemporaryDirectory() as folder:
        return FoundPlaces(write_large_map(Path(folder)), within=_NEAR)


def _estimator_for(source: str) -> str:
    return {"firefighting": "firefighting"}.get(source, "delivery") if source in GENERATED else "parcels"


def _row(trial: Trial, seconds: float) -> dict[str, Any]:
    return {
        "outcome": str(trial.outcome),
        "status": list(status_names(trial.status)),
        "decisions": len(trial.decisions),
        "subgoals": max((len(decision.subgoals) for decision in trial.decisions), default=0),
        "seconds": seconds / max(len(trial.decisions), 1),
    }


def sources(data: Path | None, most: int | None) -> Iterator[tuple[str, str]]:
    """Families and buildings, files by their path within the data."""
    yield from (("generated", name) for name in (*GENERATED, LARGE_MAP))
    if data is None:
        return
    for family, pattern in FILES.items():
        # The size of the image or of the text: a rough measure of the building's.
        files = sorted(data.glob(pattern), key=lambda file: (_bytes(file), file.name))
        chosen = range(len(files)) if most is None else np.linspace(0, len(files) - 1, min(most, len(files)))
        yield from ((family, str(files[round(index)].relative_to(data))) for index in chosen)


def _bytes(file: Path) -> int:
    return sum(beside.stat().st_size for beside in file.parent.glob(f"{file.name.partition('.')[0]}.*"))


def in_own_process(source: str, worlds: int) -> dict[str, Any]:
    """What ``run_building`` finds, or the error that it ended with."""
    command = [sys.executable, "-m", "eval.buildings", "--one", source, "--worlds", str(worlds)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode:
        return {"error": ended.stderr.strip().splitlines()[-1] if ended.stderr.strip() else str(ended.returncode)}
    return json.loads(ended.stdout.splitlines()[-1])


def report(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One entry a family: medians and extremes over its buildings; the generated ones are families of their own."""
    families: dict[str, list[Mapping[str, Any]]] = collections.defaultdict(list)
    for row in rows:
        families[row["source"] if row["family"] == "generated" else row["family"]].append(row)
    return [_summary(family, own) for family, own in families.items()]


def _summary(family: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    read = [row for row in rows if "error" not in row]
    trials = {policy.value: [t for row in read for t in row["policies"][policy.value]] for policy in POLICIES}
    every = [trial for own in trials.values() for trial in own]
    lost = {str(name) for name in status_names(LOSSES)}
    return {
        "family": family,
        "buildings": len(read),
        "not read": {row["source"]: row["error"] for row in rows if "error" in row},
        "cells": _spread([row["cells"][0] * row["cells"][1] for row in read]),
        "subgoals": _spread([trial["subgoals"] for trial in every]),
        "seconds": {
            policy.value: _spread([min(t["seconds"] for t in row["policies"][policy.value]) for row in read])
            for policy in POLICIES
        },
        "memory_mib": _spread([row["memory_mib"] for row in read]),
        "trials": len(every),
        "satisfied": sum(trial["outcome"] == Outcome.SATISFIED for trial in every),
        "flagged": sum(bool(lost & set(trial["status"])) for trial in every),
    }


def _spread(values: Sequence[float]) -> list[float]:
    """Median and most."""
    return [float(np.median(values)), float(np.max(values))] if values else []


def markdown(summary: Sequence[Mapping[str, Any]]) -> str:
    """The table of docs/results/buildings.md."""
    lines = [
        "| family | buildings | cells: median, most | subgoals: median of trials, most | ms a decision, baseline | "
        "ms a decision, PO-TLP | memory of the process, GiB | trials | satisfied | flagged |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for entry in summary:
        if not entry["buildings"]:
            continue
        seconds = [_pair(entry["seconds"][policy.value], 1000, 0) for policy in POLICIES]
        parts = [entry["family"], str(entry["buildings"]), _pair(entry["cells"], 1, 0), _pair(entry["subgoals"], 1, 0)]
        parts += [*seconds, _pair(entry["memory_mib"], 1 / 1024, 1)]
        parts += [str(entry[name]) for name in ("trials", "satisfied", "flagged")]
        lines.append(f"| {' | '.join(parts)} |")
    return "\n".join(lines)


def _pair(values: Sequence[float], factor: float, digits: int) -> str:
    return ", ".join(f"{value * factor:,.{digits}f}" for value in values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with maps, plans and buildings of others")
    parser.add_argument("--out", type=Path, help="file of rows, JSON lines")
    parser.add_argument("--most", type=int, help="buildings of each family of others")
    parser.add_argument("--worlds", type=int, default=2, help="of each building")
    parser.add_argument("--report", type=Path, help="without suffix: where the summary goes")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(run_building(options.one, options.worlds)))
        return
    if options.out is None:
        parser.error("--out is missing: the file of the rows")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    rows = read_rows(options.out)
    done = {row["source"] for row in rows}
    for family, source in sources(options.data, options.most):
        if source in done:
            continue
        file = source if family == "generated" else str(options.data / source)
        row = {"family": family, "source": source, **in_own_process(file, options.worlds)}
        rows.append(row)
        append_row(options.out, row)
        print(source, row.get("error", row.get("memory_mib")), flush=True)
    summary = report(rows)
    print(markdown(summary))
    for entry in summary:
        for source, error in entry["not read"].items():
            print(f"{source}: {error}")
    if options.report is not None:
        found = {"provenance": provenance(), "commits": sorted({r["commit"] for r in rows if "commit" in r})}
        text = json.dumps({**found, "families": summary}, indent=1)
        options.report.with_suffix(".json").write_text(text + "\n", "utf-8")


if __name__ == "__main__":
    main()
