"""Calibrate what the paper leaves open about the fire-fighting building, on worlds kept for that.

The worlds are those of ``Split.CALIBRATION``. Mean costs of the known-map planner and the baseline, over worlds that
are possible for each task, are compared with Table I of Bradley et al. 2021. Nothing learned is involved: this was run
before any learned planner existed, and the result is frozen in ``FirefightingConfig``'s defaults and by a hash in
``tests/test_firefighting.py``.

    python -m eval.calibrate_firefighting --worlds 200
    python -m eval.calibrate_firefighting --worlds 60 --set hallway_length=110 --set dead_end_fraction=0.9 --range 110
"""

import argparse
import dataclasses
import json
import math
import time

import jax
import jax.numpy as jnp
import numpy as np

from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments.firefighting import Firefighting
from potlp_jax.environments.firefighting_layout import FirefightingConfig
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.planning.distances.product import product_distances, product_transitions
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import run_trial
from potlp_jax.world.sensing import SensorConfig

PAPER = {
    "known map": {"1": 187.0, "2": 392.1, "3": 364.3, "4": 171.2},
    "baseline": {"1": 264.6, "2": 696.0, "3": 539.3, "4": 269.1},
}


@jax.jit
def known_map_cost(world, task):
    """Cost of the shortest accepting path in the true map, ``inf`` where there is none."""
    free = ~world.occupied
    transitions = product_transitions(task, world.letters, free)
    state = task.transitions[task.initial, world.letters[world.start[0], world.start[1]]]
    distances = product_distances(transitions, free, world.start[None], state[None], world.resolution)[0]
    return jnp.min(jnp.where(task.accepting[None, None, :], distances, jnp.inf))


def measure(config: FirefightingConfig, sensor: SensorConfig, count: int, with_baseline: bool) -> dict:
    """Means and standard errors per planner and task over the first ``count`` possible worlds of each task."""
    generator = Firefighting(config)
    tasks = {
        name: Task.from_formula(text, propositions=generator.propositions) for name, text in generator.tasks.items()
    }
    costs = {planner: {name: [] for name in tasks} for planner in PAPER}
    drawn = dict.fromkeys(tasks, 0)
    for index in range(100 * count):
        open_tasks = [name for name in tasks if len(costs["known map"][name]) < count]
        if not open_tasks:
            break
        key = world_key(Split.CALIBRATION, index, generator.name)
        world = generator.generate(key)
        for name in open_tasks:
            drawn[name] += 1
            shortest = float(known_map_cost(world, tasks[name].arrays))
            if not math.isfinite(shortest):
                continue
            costs["known map"][name].append(shortest)
            if with_baseline:
                trial = run_trial(world, tasks[name], "baseline", key, TrialConfig(sensor=sensor))
                if trial.outcome != "satisfied":
                    raise RuntimeError(f"baseline ended {trial.outcome} in world {index}, task {name}")
                costs["baseline"][name].append(trial.cost)
    return {
        planner: {
            name: _figures(values, PAPER[planner][name], drawn[name]) for name, values in by_task.items() if values
        }
        for planner, by_task in costs.items()
    }


def _figures(values: list[float], paper: float, drawn: int) -> dict:
    mean = float(np.mean(values))
    error = float(np.std(values, ddof=1) / math.sqrt(len(values)))
    return {
        "mean": mean,
        "standard_error": error,
        "paper": paper,
        "off": mean / paper - 1.0,
        "worlds": len(values),
        "drawn": drawn,
    }


def main() -> None:
    """Command line."""
    enable_compilation_cache()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=100, help="possible worlds per task")
    parser.add_argument(
        "--set", action="append", default=[], metavar="FIELD=VALUE", help="a field of FirefightingConfig"
    )
    parser.add_argument("--range", type=float, default=SensorConfig().range_cells, help="sensing range in cells")
    parser.add_argument("--known-map-only", action="store_true")
    arguments = parser.parse_args()
    changes = {name: json.loads(value) for name, value in (entry.split("=", 1) for entry in arguments.set)}
    config = dataclasses.replace(FirefightingConfig(), **changes)
    begun = time.time()
    figures = measure(config, SensorConfig(range_cells=arguments.range), arguments.worlds, not arguments.known_map_only)
    print(f"changed: {changes or 'nothing'}; sensing range {arguments.range}; {time.time() - begun:.0f} s")
    for planner, by_task in figures.items():
        for name, row in by_task.items():
            print(
                f"  {planner:9} task {name}: {row['mean']:6.1f} ± {row['standard_error']:4.1f}   "
                f"paper {row['paper']:5.1f}   off {100 * row['off']:+5.1f} %   "
                f"({row['worlds']} of {row['drawn']} worlds)"
            )


if __name__ == "__main__":
    main()
