"""The ideal observer beside a table of trials: what of the distance to the known map could have been known.

    python -m eval.limit --out out/limit --worlds 750 --arms ideal-observer
    python -m eval.limit.beside docs/results/table1/rows.csv.gz out/limit --report docs/results/table1/observer

The first command runs the observer, the baseline and the known map in the table's worlds; several folders of it, of
different tasks, or files of its rows, may be named. Compared are the worlds that both have. The costs of baseline and
known map must be the same in both: otherwise they are not of the same worlds, or not of the same planner. ``--report``
writes NAME.json.
"""

import argparse
import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.gains import SAME, Costs, costs_of
from eval.limit.arms import REFERENCES, Arm
from eval.limit.rows import ROWS, read_rows
from eval.savings import versions_of
from potlp_jax.environments.registry import make
from potlp_jax.sweep.rows import provenance
from potlp_jax.sweep.statistics import UNRELIABLE, attainable_interval, attainable_share
from potlp_jax.trials.record import Outcome

COMPARED: tuple[Arm, ...] = (Arm.ORACLE, Arm.IDEAL_OBSERVER, Arm.POTLP)


def observed_costs(rows: Sequence[Mapping[str, Any]], formulas: Mapping[str, str]) -> Costs:
    """Costs by task's formula and world, of the worlds in which observer and references ended satisfied and reliably.

    Args:
        rows: of ``eval.limit``, of one environment and split.
        formulas: of the tasks, by the names that rows have.

    Returns:
        The cost of each arm.

    Raises:
        SystemExit: an audit found something, or two rows of one trial differ.
    """
    found: Costs = defaultdict(dict)
    for row in rows:
        if row["problems"]:
            raise SystemExit(f"task {row['task']} world {row['world']} {row['arm']}: {row['problems'][0]}")
        # The others stand in the table.
        is_asked = row["arm"] in (*REFERENCES, Arm.IDEAL_OBSERVER)
        if is_asked and row["outcome"] == Outcome.SATISFIED.value and not row["status"] & UNRELIABLE:
            costs = found[formulas[row["task"]], row["world"]]
            if abs(costs.setdefault(row["arm"], row["cost"]) - row["cost"]) > SAME:
                raise SystemExit(f"task {row['task']} world {row['world']} {row['arm']}: two rows with other costs")
    return {name: costs for name, costs in found.items() if {*REFERENCES, Arm.IDEAL_OBSERVER} <= costs.keys()}


def compare(table: Costs, observed: Costs, task: str) -> dict[str, Any]:
    """Shares of the attainable savings in a task, over the worlds that both have.

    Args:
        table: costs of a sweep's policies.
        observed: of ``observed_costs``.
        task: its formula.

    Returns:
        ``worlds``, ``mean_cost`` and ``share`` by arm, and ``gain``: points of the observer's share beyond PO-TLP's,
        paired; shares and gains with the ends of their 95 % intervals.

    Raises:
        SystemExit: there is no such world, or baseline or known map do not cost the same in both.
    """
    asked = {*REFERENCES, Arm.ORACLE, Arm.POTLP}
    worlds = sorted(name for name in table.keys() & observed.keys() if name[0] == task and asked <= table[name].keys())
    if not worlds:
        raise SystemExit(f"{task}: no world is in both")
    for name in worlds:
        for arm in REFERENCES:
            if abs(table[name][arm] - observed[name][arm]) > SAME:
                raise SystemExit(
                    f"world {name[1]} of {task}: {arm.value} costs {table[name][arm]} in the table, and "
                    f"{observed[name][arm]} beside the observer: not the same worlds, or planners"
                )
    costs = {
        arm: np.array([{**table[name], **observed[name]}[arm] for name in worlds]) for arm in (*REFERENCES, *COMPARED)
    }
    known, baseline = costs[Arm.KNOWN_MAP], costs[Arm.BASELINE]
    instead = baseline - (costs[Arm.POTLP] - costs[Arm.IDEAL_OBSERVER])
    return {
        "worlds": len(worlds),
        "mean_cost": {arm.value: float(values.mean()) for arm, values in costs.items()},
        "share": {arm.value: _with_interval(costs[arm], baseline, known) for arm in COMPARED},
        "gain": _with_interval(instead, baseline, known),
    }


def _with_interval(ours: np.ndarray, baseline: np.ndarray, known: np.ndarray) -> list[float]:
    return [attainable_share(ours, baseline, known), *attainable_interval(ours, baseline, known)]


def markdown(tasks: Mapping[str, Mapping[str, Any]]) -> str:
    """The table as it stands in docs/results."""
    lines = [
        "| task | worlds | oracle | ideal observer | PO-TLP | observer beyond PO-TLP, points |",
        "|---|---|---|---|---|---|",
    ]
    for number, found in tasks.items():
        shares = [_percent(found["share"][arm.value]) for arm in COMPARED]
        value, low, high = (100 * part for part in found["gain"])
        lines.append(
            f"| {number} | {found['worlds']} | {' | '.join(shares)} | {value:+.1f} ({low:+.1f} to {high:+.1f}) |"
        )
    return "\n".join(lines)


def _percent(share: Sequence[float]) -> str:
    value, low, high = (100 * part for part in share)
    return f"{value:.1f} % ({low:.0f} to {high:.0f})"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path, metavar="ROWS.csv.gz", help="of eval.compact_rows")
    parser.add_argument(
        "observed", type=Path, nargs="+", metavar="PATH", help="folder or .jsonl.gz of eval.limit's rows"
    )
    parser.add_argument("--report", type=Path, metavar="NAME", help="without suffix: where the results go")
    options = parser.parse_args()
    rows = [row for path in options.observed for row in read_rows(path / ROWS if path.is_dir() else path)]
    (environment,) = {row["environment"] for row in rows}
    formulas = {name: make(environment).task(name).text for name in make(environment).tasks}
    table, observed = costs_of(options.table), observed_costs(rows, formulas)
    tasks = {name: compare(table, observed, formula) for name, formula in formulas.items()}
    found = {
        "provenance": provenance() | {"versions": versions_of(row["versions"] for row in rows)},
        "commits": sorted({row["commit"] for row in rows}),
        "audited": len(rows),
        "outcomes": Counter(row["outcome"] for row in rows),
        "tasks": tasks,
    }
    print(markdown(tasks))
    if options.report is not None:
        options.report.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
