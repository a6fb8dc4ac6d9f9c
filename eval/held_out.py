"""Formulas that no training task equals, beside those of Table I, in the same test worlds of fire-fighting.

    python -m eval.held_out docs/results/table1/rows.csv.gz --out out/held-out --report docs/results/estimator/held_out
    python -m eval.held_out docs/results/panorama/rows.csv.gz --estimator firefighting-panorama --out out/panorama

The formulas are ``HELD_OUT`` of the library, which no collection asks about. The costs of the trained tasks are read
from a file of ``eval.compact_rows``; it has to be of the same estimator, and of trials
that all ended satisfied, as those of Table I did. The same command goes on where it was stopped.
``--report`` writes NAME.json.
"""

import argparse
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.gains import Costs, costs_of
from eval.savings import TABLE_HEAD, audit, compare_first, pairs_of, read_rows, sweep, table_lines
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.learning.questions import HELD_OUT
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.rows import provenance
from potlp_jax.sweep.statistics import attainable_share
from potlp_jax.sweep.store import Row

ENVIRONMENT = "firefighting"
POLICIES = [Policy.KNOWN_MAP.value, Policy.BASELINE.value, Policy.POTLP.value]

_DRAWS = 2000


def mean_share(costs: Costs, formulas: Iterable[str], worlds: Sequence[int]) -> float:
    """PO-TLP's share of the attainable savings, the mean over formulas.

    Args:
        costs: by formula and world.
        formulas: each counts alike.
        worlds: in which each formula has all three policies; one that is there twice counts twice.
    """
    shares = []
    for formula in formulas:
        trials = [costs[formula, world] for world in worlds]
        ours, baseline, known = (
            np.array([trial[policy] for trial in trials])
            for policy in (Policy.POTLP, Policy.BASELINE, Policy.KNOWN_MAP)
        )
        shares.append(attainable_share(ours, baseline, known))
    return float(np.mean(shares))


def difference(
    costs: Costs, held_out: Sequence[str], trained: Sequence[str], worlds: Sequence[int], seed: int = 0
) -> tuple[float, float, float]:
    """The mean share of formulas held out less that of trained ones, with the ends of its 95 % interval.

    The interval draws whole worlds, the same for both.
    """
    rng = np.random.default_rng(seed)
    drawn = [rng.choice(worlds, len(worlds)).tolist() for _ in range(_DRAWS)]
    found = [mean_share(costs, held_out, one) - mean_share(costs, trained, one) for one in [list(worlds), *drawn]]
    low, high = np.percentile(found[1:], [2.5, 97.5])
    return found[0], float(low), float(high)


def shared_worlds(costs: Costs, formulas: Iterable[str]) -> list[int]:
    """The worlds in which every formula has a cost of each of ``POLICIES``."""
    wanted = set(POLICIES)
    complete = [
        {world for (name, world), by in costs.items() if name == text and wanted <= set(by)} for text in formulas
    ]
    return sorted(set.intersection(*complete))


def results_of(rows: Sequence[Row], trained: Costs) -> dict[str, Any]:
    """A table for each formula held out, the comparison with trained tasks, and the audit."""
    generator = make(ENVIRONMENT)
    held_out, tasks = list(HELD_OUT[ENVIRONMENT]), sorted({formula for formula, _ in trained})
    worlds = len({row.item.world for row in rows})
    own = {text: pairs_of([row for row in rows if row.item.task == text], POLICIES) for text in held_out}
    costs = {**trained, **{(text, world): found for text, pairs in own.items() for world, found in pairs.items()}}
    shared = shared_worlds(costs, [*held_out, *tasks])
    return {
        "provenance": provenance(),
        "commits": sorted({row.commit for row in rows}),
        "audited": len(rows),
        "problems": audit(rows, generator, Split.TEST),
        "tables": [compare_first(rows, text, POLICIES, worlds, lambda world: world) for text in held_out],
        "trained": {"tasks": tasks, "worlds": len(shared), "share": mean_share(costs, tasks, shared)},
        "held_out": {"worlds": len(shared), "share": mean_share(costs, held_out, shared)},
        "difference": difference(costs, held_out, tasks, shared),
    }


def markdown(found: Mapping[str, Any]) -> str:
    """The table and the comparison as they stand in docs/results."""
    lines = [TABLE_HEAD, *(line for table in found["tables"] for line in table_lines(table, POLICIES))]
    value, low, high = (100 * part for part in found["difference"])
    lines += [
        "",
        f"{found['audited']} trials audited: {len(found['problems'])} problems.",
        f"Mean over formulas, {found['held_out']['worlds']} worlds in which all are satisfied: held out "
        f"{100 * found['held_out']['share']:.1f} %, trained {100 * found['trained']['share']:.1f} %; difference "
        f"{value:+.1f} points ({low:+.1f} to {high:+.1f}).",
    ]
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trained", type=Path, metavar="ROWS.csv.gz", help="trials of Table I, of eval.compact_rows")
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweep")
    parser.add_argument("--estimator", help="what potlp asks; default: the shipped one")
    parser.add_argument("--worlds", type=int, default=200, help="test worlds of each formula")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--report", type=Path, metavar="NAME", help="without suffix: where the results go")
    options = parser.parse_args()
    specification: dict[str, Any] = {
        "environments": [ENVIRONMENT],
        "tasks": list(HELD_OUT[ENVIRONMENT]),
        "policies": POLICIES,
        "worlds": options.worlds,
        "split": Split.TEST.value,
    }
    if options.estimator is not None:
        specification["estimator"] = options.estimator
    sweep(options.out, specification, options.processes)
    found = results_of(read_rows(options.out), costs_of(options.trained))
    print(markdown(found))
    for problem in found["problems"]:
        print(problem)
    if options.report is not None:
        options.report.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
