"""What an accelerator gains: searches and whole trials in batches, on the device that JAX finds.

    python -m eval.bench.accelerator --out gpu.json
    JAX_PLATFORMS=cpu python -m eval.bench.accelerator --out cpu.json --slots 8 --batches 64
    python -m eval.bench.accelerator --agree gpu.json cpu.json

Searches are tuning problems of a family with S = 8; trials are all tasks of the fire-fighting building in validation
worlds, the shipped estimator asked. Seconds are wall time, compilation apart: a device works beside the host. The first
trial of a policy is run before the clock starts. ``--agree`` counts in how many trials two runs took paths of the same
cost and as many decisions. Rows are written as they are found.
"""

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from eval.bench.trials import starts
from potlp_jax.bench.planner import family_batch
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.search.config import BestFirstConfig
from potlp_jax.sweep.rows import provenance
from potlp_jax.trials.batch import run_batch

SUBGOALS = 8
DIFFERENT = 64
"""Problems of a batch that differ; larger batches repeat them."""


def search_rows(
    families: Sequence[str], batches: Sequence[int], simulations: Sequence[int]
) -> Iterator[dict[str, Any]]:
    """Searches a second, of every family, batch and budget."""
    for family in families:
        for batch in batches:
            few = family_batch(family, SUBGOALS, min(batch, DIFFERENT))
            problems = jax.tree.map(lambda leaf, rows=batch: jnp.resize(leaf, (rows, *leaf.shape[1:])), few)
            keys = jax.random.split(jax.random.key(0), batch)
            for budget in simulations:
                config = BestFirstConfig(simulations=budget)
                search = jax.jit(
                    jax.vmap(lambda problem, key, config=config: plan_actions(problem, key, config).action)
                )
                began = time.perf_counter()
                jax.block_until_ready(search(problems, keys))
                first = time.perf_counter() - began
                seconds = statistics.median(_seconds(search, problems, keys) for _ in range(3))
                yield {
                    "part": "search",
                    "family": family,
                    "batch": batch,
                    "simulations": budget,
                    "first_call_s": first,
                    "searches_per_s": batch / seconds,
                }


def _seconds(function: Any, *arguments: Any) -> float:
    began = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - began


def trial_rows(policies: Sequence[Policy], slots: Sequence[int], worlds: int) -> Iterator[dict[str, Any]]:
    """Trials a second, of every policy and number of slots; each world has a trial of every task."""
    trials = starts(worlds)
    for policy in policies:
        for count in slots:
            began = time.perf_counter()
            list(run_batch(trials[:1], policy, slots=count))
            first = time.perf_counter() - began
            began = time.perf_counter()
            finished = list(run_batch(_numbered(trials), policy, slots=count))
            seconds = time.perf_counter() - began
            finished.sort(key=lambda trial: int(str(trial.name)))
            yield {
                "part": "trials",
                "policy": policy.value,
                "slots": count,
                "trials": len(trials),
                "first_trial_s": first,
                "trials_per_s": len(trials) / seconds,
                "decisions_per_s": sum(trial.decisions for trial in finished) / seconds,
                "costs": [trial.cost for trial in finished],
                "decisions": [trial.decisions for trial in finished],
            }


def _numbered(trials: Sequence[Any]) -> Iterator[Any]:
    return (dataclasses.replace(start, name=number) for number, start in enumerate(trials))


def agreement(one: dict[str, Any], other: dict[str, Any]) -> Iterator[str]:
    """Of every policy in both, how many trials are the same, and the mean costs."""
    costs = [
        {row["policy"]: (row["costs"], row["decisions"]) for row in found["rows"] if row["part"] == "trials"}
        for found in (one, other)
    ]
    for policy in costs[0].keys() & costs[1].keys():
        (mine, my_decisions), (its, its_decisions) = costs[0][policy], costs[1][policy]
        count = min(len(mine), len(its))
        same = sum(np.isclose(mine[i], its[i], rtol=1e-5) and my_decisions[i] == its_decisions[i] for i in range(count))
        means = f"mean cost {np.mean(mine[:count]):.2f} and {np.mean(its[:count]):.2f}"
        yield f"{policy}: {same} of {count} trials the same, {means}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/bench/accelerator.json"))
    parser.add_argument("--families", nargs="+", default=["two", "three-single"], metavar="NAME")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 64, 1024, 4096])
    parser.add_argument("--simulations", type=int, nargs="+", default=[30, 300])
    parser.add_argument("--policies", nargs="+", type=Policy, default=list(Policy))
    parser.add_argument("--slots", type=int, nargs="+", default=[64, 256])
    parser.add_argument("--worlds", type=int, default=32)
    parser.add_argument("--agree", type=Path, nargs=2, metavar="FILE", help="compare two files, run nothing")
    arguments = parser.parse_args()
    if arguments.agree:
        print("\n".join(agreement(*(json.loads(file.read_text()) for file in arguments.agree))))
        return
    device = jax.devices()[0]
    found = {"provenance": provenance(), "device": device.device_kind, "platform": device.platform, "rows": []}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    parts = [
        search_rows(arguments.families, arguments.batches, arguments.simulations),
        trial_rows(arguments.policies, arguments.slots, arguments.worlds),
    ]
    for part in parts:
        for row in part:
            found["rows"].append(row)
            arguments.out.write_text(json.dumps(found, indent=1))
            print({name: value for name, value in row.items() if name not in ("costs", "decisions")}, flush=True)


if __name__ == "__main__":
    main()
