"""Whole trials: in batches of several slots against one at a time, per policy, in one process on one core.

    taskset -c 0 python -m eval.bench.trials --worlds 4 --slots 1 4 8

The same trials (validation worlds of the fire-fighting building, all of its tasks) run through ``run_batch`` with each
number of slots and one after the other through ``run_trial``; compilation is left out by a first trial of each kind.
"""

import argparse
import time
from collections.abc import Sequence

import jax

from potlp_jax.cache import enable_compilation_cache
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.planning.policies import Policy
from potlp_jax.task.task import Task
from potlp_jax.trials.batch import Start, run_batch
from potlp_jax.trials.loop import run_trial

FIRST_WORLD = 2000
ENVIRONMENT = "firefighting"


def starts(worlds: int) -> list[Start]:
    """Every task of the environment in each of the worlds, in one size."""
    generator = make(ENVIRONMENT)
    tasks = [Task.from_formula(formula, generator.propositions) for formula in generator.tasks.values()]
    sizes = tasks[0].sizes
    for task in tasks:
        sizes = sizes.union(task.sizes)
    found = []
    for number in range(FIRST_WORLD, FIRST_WORLD + worlds):
        world = generator.generate(world_key(Split.VALIDATION, number, generator.name))
        found += [Start(world, task.padded(sizes), jax.random.key(number), name=task) for task in tasks]
    return found


def seconds_in_batch(trials: Sequence[Start], policy: Policy, slots: int) -> tuple[float, int]:
    """Wall time of all trials, and the decisions taken."""
    list(run_batch(trials[:1], policy, slots=slots))
    began = time.perf_counter()
    finished = list(run_batch(trials, policy, slots=slots))
    return time.perf_counter() - began, sum(trial.decisions for trial in finished)


def seconds_alone(trials: Sequence[Start], policy: Policy) -> float:
    """Wall time of the same trials one after the other."""

    def run(start: Start) -> None:
        assert isinstance(start.name, Task)
        run_trial(start.world, start.name, policy, start.key, arrays=start.arrays)

    run(trials[0])
    began = time.perf_counter()
    for start in trials:
        run(start)
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=4)
    parser.add_argument("--slots", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--policies", nargs="+", type=Policy, default=list(Policy))
    arguments = parser.parse_args()
    enable_compilation_cache()
    trials = starts(arguments.worlds)
    print("| policy | run | seconds a trial | ms a decision | times as fast as alone |")
    print("|---|---|---|---|---|")
    for policy in arguments.policies:
        alone = seconds_alone(trials, policy)
        rows = [(f"{slots} slots", *seconds_in_batch(trials, policy, slots)) for slots in arguments.slots]
        decisions = rows[0][2]
        for name, seconds, _ in [("alone", alone, decisions), *rows]:
            each = f"{seconds / len(trials):.3f} | {1e3 * seconds / max(decisions, 1):.1f}"
            print(f"| {policy} | {name} | {each} | {alone / seconds:.2f} |", flush=True)


if __name__ == "__main__":
    main()
