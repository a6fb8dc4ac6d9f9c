"""Delivery in simulation (Bradley et al. 2021, section V-B): generated floors and real plans that no training saw.

    python -m eval.delivery --out out/delivery --plans PLANS
    python -m eval.delivery --out out/delivery --plans PLANS --worlds 80 --formula-worlds 0

``PLANS`` is a folder with folders of plans (docs/delivery.md), each a group of its own beside the generated floors.
The paper's 80 simulations are the first 80 of each group; the oracle runs on the generated ones among them. The same
network, unchanged, then runs formulas that no training task equals. Intervals and errors are clustered by building. The
same command goes on where it was stopped, also with more worlds.
``--report`` writes NAME.json beside what is printed.
"""

import argparse
import json
import os
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

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
from potlp_jax.environments.base import Generator
from potlp_jax.environments.campus.floor_plans import FloorPlans
from potlp_jax.environments.campus.furnishing import PEOPLE
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split, world_key
from potlp_jax.learning.questions import HELD_OUT
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.rows import provenance
from potlp_jax.sweep.store import Row

POLICIES = [Policy.KNOWN_MAP.value, Policy.BASELINE.value, Policy.ORACLE.value, Policy.POTLP.value]
WITHOUT_ORACLE = [policy for policy in POLICIES if policy != Policy.ORACLE]
"""Of all but the first generated floors: true labels take as long as the network, on large grids seconds a decision."""

GENERATED = "generated"
FIRST = 80
"""Simulations of the paper: 13.5 % per trial (6.1 % standard error), 7.8 % net."""


def groups(plans: Path | None) -> dict[str, str]:
    """Environments by the name of their group."""
    found = {GENERATED: "delivery"}
    for folder in [] if plans is None else sorted(path for path in plans.iterdir() if path.is_dir()):
        # The tables are of plans with all places of the delivery task, for every one of its tasks.
        found[folder.name] = f"floorplan:{folder},needs=professor+grad+undergrad"
    return found


def run_group(
    folder: Path, environment: str, tasks: list[str], policies: list[str], worlds: int, processes: int
) -> list[Row]:
    """The rows of test worlds; what is missing is run."""
    chosen = {
        "environments": [environment],
        "tasks": tasks,
        "policies": policies,
        "worlds": worlds,
        "split": Split.TEST.value,
    }
    sweep(folder, chosen, processes)
    return read_rows(folder)


def run_oracle(folder: Path, environment: str, tasks: list[str], worlds: int, processes: int) -> list[Row]:
    """The oracle's rows; the sweep is one of its own, with the two policies that every sweep has."""
    rows = run_group(folder, environment, tasks, [Policy.ORACLE.value], worlds, processes)
    return [row for row in rows if row.item.policy == Policy.ORACLE]


def building_of(generator: Generator, world: int) -> Hashable:
    """The building of a test world: a plan's name; generated floors are all different."""
    if isinstance(generator, FloorPlans):
        return generator.building(world_key(Split.TEST, world, generator.name)).name
    return world


def results_of(rows: Sequence[Row], environment: str, tasks: Sequence[str]) -> dict[str, Any]:
    """Tables of a group: of every task the first 80 worlds and all, and the audit."""
    generator = make(environment)
    problems = audit(rows, generator, Split.TEST)
    ran = [policy for policy in POLICIES if any(row.item.policy == policy for row in rows)]
    return {
        "environment": environment.partition(":")[0],
        "tables": [table for task in tasks for table in tables_of(rows, generator, task, ran)],
        "audited": len(rows),
        "violations": sum(problem.startswith("violates") for problem in problems),
        "problems": problems,
        "commits": sorted({row.commit for row in rows}),
        "decisions": decisions_of(rows, ran),
        "seconds_per_trial": {
            policy: float(np.mean([row.seconds for row in rows if row.item.policy == policy])) for policy in ran
        },
    }


def tables_of(rows: Sequence[Row], generator: Generator, task: str, ran: list[str]) -> list[dict[str, Any]]:
    """The comparison over the paper's number of worlds, and over all where there are more."""
    worlds = len({row.item.world for row in rows if row.item.task == task})
    chosen = {min(worlds, FIRST): ran} | ({worlds: WITHOUT_ORACLE} if worlds > FIRST else {})
    return [
        {
            "policies": policies,
            **compare_first(rows, task, policies, count, lambda world: building_of(generator, world)),
        }
        for count, policies in chosen.items()
    ]


def markdown(results: Mapping[str, Any]) -> str:
    """The tables as they stand in docs/results."""
    lines = []
    for name, group in results["groups"].items():
        lines += ["", f"### {name}", "", TABLE_HEAD]
        for table in group["tables"]:
            lines += table_lines(table, table["policies"])
        lines += [
            "",
            f"{group['audited']} trials audited: {len(group['problems'])} problems.",
            "",
            *decision_lines(group["decisions"]),
        ]
    return "\n".join(lines)


def tell(groups: Mapping[str, Mapping[str, Any]], report: Path | None) -> None:
    """Print the tables and problems of all groups; ``report``: without suffix, where the results go."""
    results = {"groups": groups, "provenance": provenance()}
    print(markdown(results))
    for group in groups.values():
        print("\n".join(group["problems"]))
    if report is not None:
        report.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n")


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
    task = PEOPLE.tasks["1"]
    for name, environment in groups(options.plans).items():
        generated = name == GENERATED
        worlds = options.worlds if generated else options.plan_worlds
        rows = run_group(options.out / name, environment, [task], WITHOUT_ORACLE, worlds, options.processes)
        if generated:
            rows += run_oracle(options.out / "oracle", environment, [task], min(worlds, FIRST), options.processes)
        found[name] = results_of(rows, environment, [task])
    if options.formula_worlds:
        tasks = list(HELD_OUT["delivery"])
        formulas = options.out / "formulas"
        rows = run_group(formulas, "delivery", tasks, WITHOUT_ORACLE, options.formula_worlds, options.processes)
        found["other formulas"] = results_of(rows, "delivery", tasks)
    tell(found, options.report)


if __name__ == "__main__":
    main()
