"""Table I of Bradley et al. 2021: four tasks in buildings never seen, one network, every policy in the same worlds.

    python -m eval.table1 --out out/table1                       # 4 tasks × 750 test worlds × 5 policies
    python -m eval.table1 --out out/rehearsal --split validation --first-world 1000 --worlds 60
    python -m eval.table1 --out out/table1 --report docs/results/table1/test
    python -m eval.table1 --out out/panorama --estimator firefighting-panorama
    python -m eval.table1 --out out/table1 --as-it-is            # what is finished so far; nothing is run

The sweep is killed once with SIGKILL, workers and all, and started again; the same command goes on where it stopped.
Then every word is judged by an evaluator that shares no code with the library, and every path's moves and cost are
checked.
``--report`` writes NAME.json and NAME.png beside what is printed.
"""

import argparse
import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.savings import SWEEP_COMMAND, audit, figures, policy_row, versions_of, worlds_left_out, write_specification
from potlp_jax.environments.registry import make
from potlp_jax.environments.splits import Split
from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.results import compare_pairs, pair_rows
from potlp_jax.sweep.rows import provenance
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.statistics import PolicyRow
from potlp_jax.sweep.store import Row, Store, has_tables
from potlp_jax.view.comparisons import scatter_costs
from potlp_jax.view.style import new_figure, save_figure

ENVIRONMENT = "firefighting"
POLICIES = [policy.value for policy in Policy]
PAPER = {
    "1": {"known-map": 187.0, "baseline": 264.6, "share": 0.49, "net": 0.142, "trial": 0.144},
    "2": {"known-map": 392.1, "baseline": 696.0, "share": 0.77, "net": 0.337, "trial": 0.284},
    "3": {"known-map": 364.3, "baseline": 539.3, "share": 0.39, "net": 0.126, "trial": 0.061},
    "4": {"known-map": 171.2, "baseline": 269.1, "share": 0.67, "net": 0.245, "trial": 0.146},
}
"""Averages of the paper's Table I: known map, baseline, share of the attainable savings, net and per-trial savings."""


def run(folder: Path, split: Split, worlds: int, first_world: int, processes: int, estimator: str | None) -> None:
    """Run the sweep to its end, with one kill on the way, and keep when it ran."""
    specification = {
        "environments": [ENVIRONMENT],
        "tasks": [int(task) for task in PAPER],
        "policies": POLICIES,
        "worlds": worlds,
        "split": split.value,
        "first_world": first_world,
    }
    if estimator is not None:
        specification["estimator"] = estimator
    file = write_specification(folder, specification)
    command = [*SWEEP_COMMAND, str(file), "--out", str(folder), "--processes", str(processes)]
    kill_at = len(PAPER) * len(POLICIES) * worlds // 3
    while not _is_done(folder, len(PAPER) * len(POLICIES) * worlds):
        _run_once(command, folder, kill_at if not _spans(folder) else None)


def _run_once(command: Sequence[str], folder: Path, kill_at: int | None) -> None:
    """Run until done, or until there are ``kill_at`` rows and the whole group of processes is killed."""
    began, before = time.time(), _count(folder)
    process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)
    killed = False
    while process.poll() is None:
        time.sleep(1.0)
        if kill_at is not None and _count(folder) >= kill_at:
            os.killpg(process.pid, signal.SIGKILL)
            killed = True
            process.wait()
    span = {"seconds": time.time() - began, "rows": _count(folder) - before, "killed": killed}
    (folder / "spans.json").write_text(json.dumps([*_spans(folder), span]))
    if process.returncode and not killed:
        raise SystemExit(f"the sweep ended with exit code {process.returncode}; what is finished is kept in {folder}")


def _spans(folder: Path) -> list[dict[str, Any]]:
    file = folder / "spans.json"
    return json.loads(file.read_text()) if file.exists() else []


def _is_done(folder: Path, trials: int) -> bool:
    """Whether so many trials have rows, or were given up."""
    if not has_tables(folder / RESULTS):
        return False
    with contextlib.closing(Store(folder / RESULTS, read_only=True)) as store:
        return store.count() + len(store.broken()) >= trials


def _count(folder: Path) -> int:
    if not has_tables(folder / RESULTS):
        return 0
    with contextlib.closing(Store(folder / RESULTS, read_only=True)) as store:
        return store.count()


def results(folder: Path) -> dict[str, Any]:
    """Table, audit and times of what is finished."""
    with contextlib.closing(Store(folder / RESULTS, read_only=True)) as store:
        specification, rows = store.specification(), store.rows()
        facts, given_up = store.facts(), store.broken()
    split = Split(specification["split"])
    tasks = make(ENVIRONMENT).tasks
    tables = {}
    for number in PAPER:
        pairs = pair_rows([row for row in rows if row.item.task == tasks[number]], POLICIES)
        comparison = compare_pairs(pairs, POLICIES)
        tables[number] = {"task": tasks[number], "paper": PAPER[number], **comparison.to_dict()}
    problems = audit(rows, make(ENVIRONMENT), split)
    return {
        "specification": specification,
        "estimator": facts["estimator"],
        "provenance": provenance() | {"versions": versions_of(row.versions for row in rows)},
        "given_up": [{**dataclasses.asdict(item), "error": error} for item, error in sorted(given_up.items())],
        "commits": sorted({row.commit for row in rows}),
        "tables": tables,
        "audited": len(rows),
        "violations": sum(problem.startswith("violates") for problem in problems),
        "problems": problems,
        "spans": _spans(folder),
        "times": _times(rows),
    }


def _times(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    by_policy = defaultdict(list)
    for row in rows:
        by_policy[row.item.policy].append(row)
    return {
        policy: {
            "trials": len(found),
            "seconds_per_trial": float(np.mean([row.seconds for row in found])),
            "decisions_per_trial": float(np.mean([row.decisions for row in found])),
            "fallbacks": sum(row.fallbacks for row in found),
        }
        for policy, found in sorted(by_policy.items())
    }


def markdown(found: dict[str, Any]) -> str:
    """The tables as they stand in docs/results."""
    lines = ["| task | policy | mean cost | share of attainable savings (95 %) | net | per trial | the paper |"]
    lines.append("|---|---|---|---|---|---|---|")
    for number, table in found["tables"].items():
        for entry in table["satisfied"]["rows"]:
            row = policy_row(entry)
            lines.append(f"| {number} | {row.policy} | {row.mean_cost:.1f} | {figures(row)} | {_paper(number, row)} |")
        if left_out := worlds_left_out(table):
            lines.append(f"| {number} | {left_out} | | | | | |")
    spans = ", ".join(
        f"{span['rows']} rows in {span['seconds'] / 60:.1f} min{' (killed)' if span['killed'] else ''}"
        for span in found["spans"]
    )
    lines += [
        "",
        f"{found['audited']} trials audited: {len(found['problems'])} problems, {found['violations']} violations.",
    ]
    if found["given_up"]:
        lines.append(f"{len(found['given_up'])} trials were given up.")
    lines += [f"Runs: {spans}.", "", "| policy | trials | seconds a trial | decisions a trial |", "|---|---|---|---|"]
    for policy, times in found["times"].items():
        lines.append(
            f"| {policy} | {times['trials']} | {times['seconds_per_trial']:.2f} | {times['decisions_per_trial']:.1f} |"
        )
    return "\n".join(lines)


def _paper(number: str, row: PolicyRow) -> str:
    paper = PAPER[number]
    if row.policy == Policy.POTLP:
        return f"{paper['share']:.0%}; net {paper['net']:.1%}, per trial {paper['trial']:.1%}"
    return f"{paper[row.policy]}" if row.policy in paper else ""


def draw(folder: Path, file: Path) -> None:
    """PO-TLP's cost over the baseline's in every world, a panel for each task, as in the paper."""
    store = Store(folder / RESULTS, read_only=True)
    figure = new_figure(11.0, 11.6)
    for index, (number, formula) in enumerate(make(ENVIRONMENT).tasks.items()):
        pairs = pair_rows(store.rows(ENVIRONMENT, formula), POLICIES)
        axes = figure.add_subplot(2, 2, index + 1)
        scatter_costs(axes, pairs, [Policy.BASELINE.value, Policy.POTLP.value])
        axes.set_title(f"task {number}: {formula}", fontsize=9)
    store.close()
    save_figure(figure, file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweep")
    parser.add_argument("--split", type=Split, default=Split.TEST)
    parser.add_argument("--worlds", type=int, default=750, help="per task")
    parser.add_argument("--first-world", type=int, default=0)
    parser.add_argument("--estimator", help="what potlp asks; default: the shipped one")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--report", type=Path, help="without suffix: where results and picture go")
    parser.add_argument("--as-it-is", action="store_true", help="report what is finished in the folder, run nothing")
    arguments = parser.parse_args()
    if not arguments.as_it_is:
        asked = (arguments.processes, arguments.estimator)
        run(arguments.out, arguments.split, arguments.worlds, arguments.first_world, *asked)
    found = results(arguments.out)
    print(markdown(found))
    for problem in found["problems"]:
        print(problem)
    if arguments.report is not None:
        arguments.report.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")
        draw(arguments.out, arguments.report.with_suffix(".png"))


if __name__ == "__main__":
    main()
