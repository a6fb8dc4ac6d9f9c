"""What experiments on savings share: a sweep by its command, its tables clustered by building, its audit."""

import html
import json
import subprocess
import sys
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from potlp_jax.environments.base import Generator
from potlp_jax.environments.splits import Split
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.audit import audit_rows
from potlp_jax.sweep.results import compare_pairs, pair_rows, reliable_pairs
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.statistics import PolicyRow
from potlp_jax.sweep.store import Row, Store
from potlp_jax.trials.record import Outcome
from potlp_jax.types import Status

SWEEP_COMMAND = (sys.executable, "-c", "from potlp_jax.cli import main; main()", "sweep")
"""``potlp sweep``, by the interpreter that runs."""

TABLE_HEAD = (
    "| task | policy | worlds | mean cost | share of attainable savings (95 %) | net | per trial (± SE) |\n"
    "|---|---|---|---|---|---|---|"
)


def write_specification(folder: Path, specification: Mapping[str, Any]) -> Path:
    """A sweep's file in its folder; JSON is YAML."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "sweep.yaml"
    estimator = Path(str(specification.get("estimator")))
    # A specification's files lie beside it; those of a command beside where it is given.
    found = {"estimator": str(estimator.resolve())} if estimator.is_file() else {}
    file.write_text(json.dumps({**specification, **found}))
    return file


def sweep(folder: Path, specification: Mapping[str, Any], processes: int) -> None:
    """Run what is missing of a sweep. Raises SystemExit where the command fails."""
    file = write_specification(folder, specification)
    command = [*SWEEP_COMMAND, str(file), "--out", str(folder), "--processes", str(processes)]
    if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
        raise SystemExit(f"the sweep of {folder} failed; what is finished is kept there")


def read_rows(folder: Path) -> list[Row]:
    """All rows of a sweep."""
    store = Store(folder / RESULTS)
    rows = store.rows()
    store.close()
    return rows


def compare_first(
    rows: Sequence[Row],
    task: str,
    policies: Sequence[str],
    worlds: int,
    building: Callable[[int], Hashable] | None = None,
) -> dict[str, Any]:
    """The comparison of the first worlds of a task, clustered by ``building(world)``; ``buildings`` counts them.

    Without it all worlds are of one building, and the figures are of that one.
    """
    pairs = pair_rows([row for row in rows if row.item.task == task], policies)[:worlds]
    clusters = None if building is None else [building(pair[Policy.BASELINE].item.world) for pair in pairs]
    comparison = compare_pairs(pairs, policies, clusters)
    return {"task": task, "buildings": 1 if clusters is None else len(set(clusters)), **comparison.to_dict()}


def pairs_of(rows: Sequence[Row], policies: Sequence[str]) -> dict[int, dict[str, float]]:
    """Costs by world and policy, of one task, in the worlds in which every policy ended satisfied and reliably."""
    found: dict[int, dict[str, float]] = {}
    for pair in reliable_pairs(pair_rows(rows, policies)):
        if all(row.outcome == Outcome.SATISFIED for row in pair.values()):
            found[pair[policies[0]].item.world] = {policy: row.cost for policy, row in pair.items()}
    return found


def audit(rows: Sequence[Row], generator: Generator, split: Split) -> list[str]:
    """What is wrong with any trial. Violations of the task among it begin with 'violates'."""
    return [f"{problem}: {row.item}" for row, problem in audit_rows(rows, split, generator_of=lambda _: generator)]


def table_lines(table: Mapping[str, Any], policies: Sequence[str]) -> list[str]:
    """Rows of a Markdown table below ``TABLE_HEAD``."""
    found = {entry["policy"]: entry for entry in table["satisfied"]["rows"]}
    task, lines = _code(table["task"]), []
    for policy in policies:
        row = policy_row(found[policy])
        buildings = table["buildings"]
        worlds = f"{table['satisfied']['pairs']} in {buildings} building{'s' if buildings > 1 else ''}"
        lines.append(f"| {task} | {policy} | {worlds} | {row.mean_cost:.1f} | {figures(row)} |")
    return lines


def _code(formula: str) -> str:
    # A bar would end the cell, and the site would show the backslash before one.
    return f"<code>{html.escape(formula).replace('|', '&#124;')}</code>" if "|" in formula else f"`{formula}`"


def policy_row(entry: Mapping[str, Any]) -> PolicyRow:
    """A row as ``Comparison.to_dict`` wrote it."""
    known: dict[str, Any] = {name: np.nan if value is None else value for name, value in entry.items()}
    return PolicyRow(**known)


def figures(row: PolicyRow) -> str:
    """Share, net and per-trial savings, as cells of a table; the baseline has none."""
    if row.policy == Policy.BASELINE:
        return "| |"
    share = f"{100 * row.attainable_share:.1f} % ({100 * row.attainable_low:.0f} to {100 * row.attainable_high:.0f})"
    return (
        f"{share} | {100 * row.net_savings:.1f} % | "
        f"{100 * row.trial_savings:.1f} ± {100 * row.trial_savings_error:.1f} %"
    )


def decisions_of(rows: Sequence[Row], policies: Sequence[str]) -> dict[str, dict[str, Any]]:
    """By policy: decisions, seconds of one on a core (compilation and the way to the next in it), trials flagged."""
    found = {}
    for policy in policies:
        own = [row for row in rows if row.item.policy == policy]
        number = sum(row.decisions for row in own)
        found[policy] = {
            "trials": len(own),
            "number": number,
            "seconds": sum(row.seconds for row in own) / max(number, 1),
            "flagged": {flag.name: sum(bool(row.status & flag) for row in own) for flag in Status},
        }
    return found


def decision_lines(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """How long each policy thinks, and in how many trials it met a limit."""
    lines = []
    for policy, entry in found.items():
        flagged = ", ".join(
            f"{count} of {entry['trials']} trials {name}" for name, count in entry["flagged"].items() if count
        )
        lines.append(
            f"- {policy}: {entry['number']} decisions of {entry['seconds']:.2f} s; {flagged or 'no limit was met'}"
        )
    return lines
