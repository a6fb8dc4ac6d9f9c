"""Do trials keep their promises? Thousands of trials, each checked against the truth and an independent evaluator.

Suites:
  firefighting  155 worlds × 4 tasks in full-size fire-fighting buildings
  rooms         180 floors of 48 to 128 cells a side with as many formulas (next, cycles, several cubes)
  maps          real ROS maps of POTLP_EXTERNAL_DATA with places drawn at random, 52 trials
  revealed      125 fire-fighting worlds × 4 tasks, every policy on a fully revealed map: exactly the known-map cost

    python -m eval.trials firefighting rooms maps revealed --processes 2
    python -m eval.trials --report docs/results/trials

Results are appended as JSON lines; the same command again continues where it stopped. ``--report`` also reads
JSON lines that were packed with ``gzip``.
"""

import argparse
import functools
import multiprocessing
import os
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from eval.formulas import random_tasks, traits
from eval.limit.rows import append_row, read_rows
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.environments.rooms import Rooms
from potlp_jax.environments.ros.cleaning import clean_map
from potlp_jax.environments.ros.occupancy_map import load_map
from potlp_jax.environments.ros.places import Disc, Places
from potlp_jax.environments.ros.ros_map import RosMap, RosMapConfig
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.rows import provenance
from potlp_jax.task.task import Task, TaskSizes
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.trials.record import Outcome
from potlp_jax.verify.audit import problems_of
from potlp_jax.world.grid import World
from potlp_jax.world.sensing import SensorConfig

POLICIES = tuple(policy.value for policy in Policy if policy is not Policy.POTLP)
WORLDS = {"firefighting": 155, "revealed": 125}
FORMULAS = 180
"""A few of the random formulas ask for something in the first steps, which no floor offers."""
ROOMS_SIZES = TaskSizes(states=8, propositions=3, edges=16, classes=16, compound=5, cubes=3)
MAPS = {
    "gdc_3ne": (0.4, 0.0),
    "gdc_floor2": (0.4, 0.0),
    "intel_lab": (0.25, 0.1),
    "uma_rooms": (0.2, 0.1),
    "sarmis_home": (0.1, 0.1),
    "levine_lobby": (0.2, 0.1),
    "kth_50052752": (0.2, 0.1),
    "kth_50010535_PLAN1": (0.4, 0.0),
}
"""Working resolution (metres) and robot radius per map: the grids stay below about 260 cells a side."""


def items(suite: str) -> list[dict[str, Any]]:
    """What a suite runs, in order; each item is small and JSON-able."""
    if suite in ("firefighting", "revealed"):
        tasks = Firefighting().tasks
        return [{"suite": suite, "task": task, "number": n} for n in range(WORLDS[suite]) for task in tasks]
    if suite == "rooms":
        return [{"suite": suite, "task": str(n), "number": n} for n in range(FORMULAS)]
    return [{"suite": suite, "task": task, "number": n} for n, task in zip(range(13), MAP_TASKS * 7, strict=False)]


MAP_TASKS = ["F a & F b", "!b U a", "F(a & F b)", "(!b U a) & F b"]


def possible_world(item: dict[str, Any]) -> Iterator[tuple[World, Task, str, int, TrialConfig]]:
    """Candidate worlds of an item with their numbers, until the caller finds one that is possible for its task."""
    suite, number = item["suite"], item["number"]
    for world_number in range(number, number + 50_000, 1000):
        if suite == "rooms":
            generator, task, config = Rooms(), rooms_tasks()[number], rooms_config()
            environment = family = generator.name
        elif suite == "maps":
            name = sorted(MAPS)[number % len(MAPS)]
            generator, config = map_generator(name, world_number), rooms_config()
            task = Task.from_formula(item["task"], propositions=("a", "b"))
            environment, family = f"map:{name}", "map"
        else:
            generator, config = Firefighting(), TrialConfig(revealed=suite == "revealed")
            task = Task.from_formula(generator.tasks[item["task"]], propositions=generator.propositions)
            environment = family = generator.name
        world = generator.generate(world_key(Split.VALIDATION, world_number, family))
        yield world, task, environment, world_number, config


@functools.cache
def rooms_tasks() -> list[Task]:
    """The formulas of the rooms suite."""
    return random_tasks(FORMULAS, Rooms().propositions, ROOMS_SIZES)


def rooms_config() -> TrialConfig:
    """A sensing range of 30 cells: rooms are seen from within, most of the floor is not."""
    return TrialConfig(sensor=SensorConfig(range_cells=30.0))


def map_generator(name: str, number: int) -> RosMap:
    """A real map with one place for ``a`` and two for ``b``, drawn by the world's number among its free cells."""
    folder = Path(os.environ["POTLP_EXTERNAL_DATA"]) / "maps"
    resolution, radius = MAPS[name]
    clean = clean_map(load_map(folder / f"{name}.yaml"), resolution, radius)
    rng = np.random.default_rng(number)
    cells = np.argwhere(clean.free)
    points = [clean.frame.cell_to_metres(*(int(v) for v in cells[rng.integers(len(cells))])) for _ in range(3)]
    discs = [Disc(point, 2.0 * resolution) for point in points]
    places = Places((("a", (discs[0],)), ("b", (discs[1], discs[2]))), start=None, tasks=())
    return RosMap(RosMapConfig(str(folder / f"{name}.yaml"), places, resolution, radius))


def policies_of(item: dict[str, Any]) -> tuple[str, ...]:
    """All policies; of the suites with many items the oracle, which costs ten times the others, in every fourth."""
    sparse = item["suite"] in ("firefighting", "rooms") and item["number"] % 4
    return tuple(policy for policy in POLICIES if not (sparse and policy == Policy.ORACLE))


def run_item(item: dict[str, Any], made_by: dict[str, Any]) -> list[dict[str, Any]]:
    """One row per policy, on the first world that is possible for the item's task; one row if none of 50 is."""
    for world, task, environment, world_number, config in possible_world(item):
        run = functools.partial(
            run_trial,
            world,
            task,
            key=jax.random.fold_in(jax.random.key(world_number), 7),
            config=config,
            environment=environment,
            world_number=world_number,
            arrays=task.padded(ROOMS_SIZES) if item["suite"] == "rooms" else None,
        )
        known = run(policy=Policy.KNOWN_MAP)
        if known.outcome is not Outcome.SATISFIED or not known.decisions:
            continue
        rows = []
        for policy in policies_of(item):
            begun = time.perf_counter()
            trial = known if policy == Policy.KNOWN_MAP else run(policy=policy)
            found = problems_of(trial, task, world)
            if item["suite"] == "revealed" and abs(trial.cost - known.cost) > 1e-6 * known.cost:
                found.append(f"costs {trial.cost} on a revealed map, the known-map planner {known.cost}")
            rows.append(
                {
                    **item,
                    **trial.summary(),
                    "task": item["task"],
                    "formula": task.text,
                    "traits": traits(task),
                    "problems": found,
                    "seconds": time.perf_counter() - begun,
                    "provenance": made_by,
                }
            )
        return rows
    return [{**item, "impossible": True, "problems": []}]


def work(arguments: tuple[dict[str, Any], Path, dict[str, Any]]) -> None:
    """Run one item and append its rows; an exception is a row too."""
    item, out, made_by = arguments
    try:
        rows = run_item(item, made_by)
    except Exception:
        rows = [{**item, "exception": traceback.format_exc(), "problems": ["exception"]}]
    append_row(out / f"{item['suite']}.jsonl", rows)


def rows_of(out: Path, suite: str) -> list[dict[str, Any]]:
    """Rows written so far; a line cut off by a kill is dropped, its item runs again."""
    path = out / f"{suite}.jsonl"
    packed = path.with_suffix(".jsonl.gz")  # as docs/results keeps them
    return [*read_rows(packed), *read_rows(path)]


def report(out: Path) -> str:
    """Figures of all suites as Markdown."""
    lines = []
    for suite in ("firefighting", "rooms", "maps", "revealed"):
        every = rows_of(out, suite)
        rows = [row for row in every if "impossible" not in row]
        if not rows:
            continue
        formulas = {row["formula"]: row["traits"] for row in rows if "formula" in row}
        awkward = {name: sum(has[name] for has in formulas.values()) for name in ("next", "cycle", "several cubes")}
        impossible = len(every) - len(rows)
        lines += [
            f"## {suite}",
            "",
            f"{len(rows)} trials, {len(formulas)} formulas ({awkward}), {impossible} impossible",
            "",
        ]
        lines.append(
            "| policy | trials | outcomes | mean cost | steps median (max) | decisions median (max) "
            "| fallbacks (trials) | problems |"
        )
        lines.append("|---|---|---|---|---|---|---|---|")
        groups = defaultdict(list)
        for row in rows:
            groups[row.get("policy", "exception")].append(row)
        for policy, members in groups.items():
            lines.append(_line(policy, members))
        lines.append("")
    return "\n".join(lines)


def _line(policy: str, rows: list[dict[str, Any]]) -> str:
    ran = [row for row in rows if "outcome" in row]
    outcomes = ", ".join(f"{name} {count}" for name, count in Counter(row["outcome"] for row in ran).items())
    steps, decisions = ([row[name] for row in ran] or [0] for name in ("steps", "decisions"))
    fallbacks = [row["fallbacks"] for row in ran]
    return (
        f"| {policy} | {len(rows)} | {outcomes} | {np.mean([row['cost'] for row in ran] or [0]):.1f} "
        f"| {np.median(steps):.0f} ({max(steps)}) | {np.median(decisions):.0f} ({max(decisions)}) "
        f"| {sum(fallbacks)} ({sum(count > 0 for count in fallbacks)}) | {sum(bool(row['problems']) for row in rows)} |"
    )


def main() -> None:
    """Command line."""
    enable_compilation_cache()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", metavar="SUITE", help="firefighting, rooms, maps or revealed")
    parser.add_argument("--out", type=Path, default=Path("out/trials"))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--report", type=Path, metavar="DIR", help="print the figures of a run and stop")
    arguments = parser.parse_args()
    if arguments.report:
        print(report(arguments.report))
        return
    arguments.out.mkdir(parents=True, exist_ok=True)
    todo = []
    for suite in arguments.suites:
        done = {(row["task"], row["number"]) for row in rows_of(arguments.out, suite)}
        todo += [item for item in items(suite) if (item["task"], item["number"]) not in done]
    # Of the command: a worker has one of its own.
    made_by = provenance()
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        for count, _ in enumerate(pool.imap_unordered(work, [(item, arguments.out, made_by) for item in todo]), 1):
            print(f"{count}/{len(todo)} items", end="\r", flush=True)
    print(report(arguments.out))


if __name__ == "__main__":
    main()
