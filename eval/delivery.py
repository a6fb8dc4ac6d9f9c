"""Delivery in simulation (Bradley et al. 2021, section V-B): generated floors and real plans that no training saw.

    python -m eval.delivery --out out/delivery --plans PLANS
    python -m eval.delivery --out out/delivery --plans PLANS --worlds 80 --formula-worlds 0

``PLANS`` is a folder with folders of plans (docs/delivery.md), each a group of its own beside the generated floors.
The paper's 80 simulations are the first 80 of each group. The same network, unchanged, then runs formulas that no
training task equals. Intervals and errors are clustered by building. The same command goes on where it was stopped.
``--report`` writes NAME.json beside what is printed.
"""

import argparse
import json
import os
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from eval.savings import TABLE_HEAD, audit, compare_first, read_rows, sweep, table_lines
from potlp_jax.environments import make
from potlp_jax.environments.academic import PEOPLE
from potlp_jax.environments.base import Generator
from potlp_jax.environments.floorplan import FloorPlans
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.formulas import HELD_OUT
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.rows import source_commit
from potlp_jax.trial import versions

POLICIES = [Policy.KNOWN_MAP.value, Policy.BASELINE.value, Policy.ORACLE.value, Policy.POTLP.value]
WITHOUT_ORACLE = [policy for policy in POLICIES if policy != Policy.ORACLE.value]
"""Of all groups but the generated floors: on the large grids of plans true labels take seconds a decision."""

GENERATED = "generated"
FIRST = 80
"""Simulations of the paper: 13.5 % per trial (6.1 % standard error), 7.8 % net."""


def groups(plans: Path | None) -> dict[str, str]:
    """Environments by the name of their group."""
    found = {GENERATED: "delivery"}
    for folder in [] if plans is None else sorted(path for path in plans.iterdir() if path.is_dir()):
        found[folder.name] = f"floorplan:{folder}"
    return found


def specification(environment: str, tasks: list[str], policies: list[str], worlds: int) -> dict[str, Any]:
    """A sweep over test worlds."""
    return {
        "environments": [environment],
        "tasks": tasks,
        "policies": policies,
        "worlds": worlds,
        "split": Split.TEST.value,
    }


def building_of(generator: Generator, world: int) -> Hashable:
    """The building of a test world: a plan's name; generated floors are all different."""
    if isinstance(generator, FloorPlans):
        return generator.building(world_key(Split.TEST, world, generator.name)).name
    return world


def results_of(folder: Path, environment: str, policies: list[str], worlds: Mapping[str, int]) -> dict[str, Any]:
    """Tables of a group: the first 80 worlds and all, by formula, and the audit."""
    generator, rows = make(environment), read_rows(folder)
    problems = audit(rows, generator, Split.TEST)
    counts = {formula: sorted({min(FIRST, count), count}) for formula, count in worlds.items()}
    return {
        "environment": environment.partition(":")[0],
        "policies": policies,
        "tables": [
            compare_first(rows, formula, policies, count, lambda world: building_of(generator, world))
            for formula, found in counts.items()
            for count in found
        ],
        "audited": len(rows),
        "violations": sum(problem.startswith("violates") for problem in problems),
        "problems": problems,
        "commits": sorted({row.commit for row in rows}),
        "seconds_per_trial": {
            policy: float(np.mean([row.seconds for row in rows if row.item.policy == policy])) for policy in policies
        },
    }


def markdown(results: Mapping[str, Any]) -> str:
    """The tables as they stand in docs/results."""
    lines = []
    for name, group in results["groups"].items():
        lines += ["", f"### {name}", "", TABLE_HEAD]
        for table in group["tables"]:
            lines += table_lines(table, group["policies"])
        lines += ["", f"{group['audited']} trials audited: {len(group['problems'])} problems."]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweeps")
    parser.add_argument("--plans", type=Path, help="folder with folders of floor plans")
    parser.add_argument("--worlds", type=int, default=1000, help="generated floors")
    parser.add_argument("--plan-worlds", type=int, default=200, help="worlds of each folder of plans")
    parser.add_argument("--formula-worlds", type=int, default=80, help="generated floors for each other formula")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--report", type=Path, help="without suffix: where the results go")
    options = parser.parse_args()
    found: dict[str, Any] = {}
    for name, environment in groups(options.plans).items():
        generated = name == GENERATED
        count, policies = (options.worlds, POLICIES) if generated else (options.plan_worlds, WITHOUT_ORACLE)
        worlds = {PEOPLE.tasks["1"]: count}
        sweep(options.out / name, specification(environment, list(worlds), policies, count), options.processes)
        found[name] = results_of(options.out / name, environment, policies, worlds)
    if options.formula_worlds:
        worlds = {formula: int(options.formula_worlds) for formula in HELD_OUT["delivery"]}
        folder = options.out / "formulas"
        chosen = specification("delivery", list(worlds), WITHOUT_ORACLE, options.formula_worlds)
        sweep(folder, chosen, options.processes)
        found["other formulas"] = results_of(folder, "delivery", WITHOUT_ORACLE, worlds)
    results = {"groups": found, "versions": versions(), "reported_at": source_commit()}
    print(markdown(results))
    for group in found.values():
        print("\n".join(group["problems"]))
    if options.report is not None:
        options.report.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
