"""What experiments on savings share: a sweep by its command, its tables clustered by building, its audit."""

import html
import json
import subprocess
import sys
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from potlp_jax.environments.base import Generator
from potlp_jax.environments.splits import Split
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.audit import audit_rows
from potlp_jax.sweep.results import Pair, compare_pairs, pair_rows, reliable_pairs, world_of
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.statistics import BASELINE, KNOWN_MAP, PolicyRow
from potlp_jax.sweep.store import Row, Store
from potlp_jax.trials.loop import versions as library_versions
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
    store = Store(folder / RESULTS, read_only=True)
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
    """The comparison of the first worlds of a task, clustered by ``building(world)``.

    ``buildings`` counts those of the worlds in which every policy ended satisfied and reliably. Without ``building``
    all worlds are of one, and the figures are of that one.
    """
    pairs = pair_rows([row for row in rows if row.item.task == task], policies)[:worlds]
    clusters = None if building is None else [building(world_of(pair)) for pair in pairs]
    comparison = compare_pairs(pairs, policies, clusters)
    told = {building(world_of(pair)) for pair in pairs if is_satisfied(pair)} if building is not None else {0}
    return {"task": task, "buildings": len(told), **comparison.to_dict()}


def is_satisfied(pair: Pair) -> bool:
    """Whether every policy ended satisfied and reliably."""
    return bool(reliable_pairs([pair])) and all(row.outcome == Outcome.SATISFIED for row in pair.values())


def pairs_of(rows: Sequence[Row], policies: Sequence[str]) -> dict[int, dict[str, float]]:
    """Costs by world and policy, of one task, in the worlds in which every policy ended satisfied and reliably."""
    found: dict[int, dict[str, float]] = {}
    for pair in pair_rows(rows, policies):
        if is_satisfied(pair):
            found[world_of(pair)] = {policy: row.cost for policy, row in pair.items()}
    return found


def audit(rows: Sequence[Row], generator: Generator, split: Split) -> list[str]:
    """What is wrong with any trial. Violations of the task among it begin with 'violates'."""
    return [f"{problem}: {row.item}" for row, problem in audit_rows(rows, split, generator_of=lambda _: generator)]


def table_lines(table: Mapping[str, Any], policies: Sequence[str]) -> list[str]:
    """Rows of a Markdown table below ``TABLE_HEAD``; the last says which worlds are not in the others."""
    found = {entry["policy"]: entry for entry in table["satisfied"]["rows"]}
    task, lines = _code(table["task"]), []
    for policy in policies:
        row = policy_row(found[policy])
        buildings = table["buildings"]
        worlds = f"{table['satisfied']['pairs']} in {buildings} building{'s' if buildings > 1 else ''}"
        lines.append(f"| {task} | {policy} | {worlds} | {row.mean_cost:.1f} | {figures(row)} |")
    if left_out := worlds_left_out(table):
        lines.append(f"| {task} | {left_out} | | | | | |")
    return lines


def _code(formula: str) -> str:
    # A bar would end the cell, and the site would show the backslash before one.
    return f"<code>{html.escape(formula).replace('|', '&#124;')}</code>" if "|" in formula else f"`{formula}`"


def worlds_left_out(table: Mapping[str, Any]) -> str:
    """What a table of ``Comparison.to_dict`` does not hold, in words; empty where it holds all."""
    counts = {
        "not satisfied": table["satisfied"]["dropped"] - table["charged"]["dropped"],
        "cut short": table["charged"]["dropped"],
    }
    told = [f"{count} {why}" for why, count in counts.items() if count]
    if not told:
        return ""
    rows = [policy_row(entry) for entry in table["charged"]["rows"] if entry["policy"] not in (KNOWN_MAP, BASELINE)]
    shares = "; ".join(f"{row.policy} {_share(row)}" for row in rows)
    return f"worlds left out: {', '.join(told)}; shares with unsatisfied trials charged their budgets: {shares}"


def versions_of(rows: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """By library, the versions that made the rows."""
    found: dict[str, set[str]] = {name: set() for name in library_versions()}
    for versions in rows:
        for name in found.keys() & versions.keys():
            found[name].add(versions[name])
    return {name: " and ".join(sorted(known)) for name, known in found.items() if known}


def policy_row(entry: Mapping[str, Any]) -> PolicyRow:
    """A row as ``Comparison.to_dict`` wrote it."""
    known: dict[str, Any] = {name: np.nan if value is None else value for name, value in entry.items()}
    return PolicyRow(**known)


def figures(row: PolicyRow) -> str:
    """Share, net and per-trial savings, as cells of a table; the baseline has none."""
    if row.policy == Policy.BASELINE:
        return "| |"
    # One building has none.
    error = "no error" if np.isnan(row.trial_savings_error) else f"± {100 * row.trial_savings_error:.1f}"
    return f"{_share(row)} | {100 * row.net_savings:.1f} % | {100 * row.trial_savings:.1f} {error} %"


def _share(row: PolicyRow) -> str:
    if np.isnan(row.attainable_low):
        return f"{100 * row.attainable_share:.1f} % (no interval)"
    return f"{100 * row.attainable_share:.1f} % ({100 * row.attainable_low:.0f} to {100 * row.attainable_high:.0f})"


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
