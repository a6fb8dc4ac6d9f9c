"""Whether sweeps that were run at earlier commits would come out the same today: some of their trials run again.

    python -m eval.confirm out/delivery/generated out/delivery/office --trials 60 --out out/confirm \
        --report out/confirm/report

Of every sweep trials are drawn, as many of each policy, and run again with the sweep's own specification. A trial is
the same if its world, outcome, path, number of decisions and status are. If none of n differs, fewer than 3 in n of
all do, with 95 % confidence. What was run is kept: the same command at the same commit goes on where it was stopped.
``--report`` writes NAME.json.
"""

import argparse
import dataclasses
import hashlib
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.limit.rows import append_row, read_rows
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.sweep.rows import provenance, source_commit
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.specification import Specification, specification_from_store
from potlp_jax.sweep.store import Row, Store
from potlp_jax.sweep.work import Work

COMPARED = ("world_digest", "outcome", "path", "cost", "decisions", "status")
"""Fields of a row that make a trial what it is. Seconds, commit and versions may differ, and settings get new names."""

_AT_ONCE = 8
"""Trials of one environment and policy that run in a batch, and are kept together."""


def drawn(rows: Sequence[Row], trials: int, seed: int = 0) -> list[Row]:
    """Some of a sweep's rows: as many of each policy, any of its environments, tasks and worlds.

    Args:
        rows: of one sweep.
        trials: how many at most; of each policy the same number, rounded up.
        seed: of the draw.

    Returns:
        Ordered by environment and policy, as they are run.
    """
    by_policy = defaultdict(list)
    for row in sorted(rows, key=lambda row: row.item):
        by_policy[row.item.policy].append(row)
    random, found = np.random.default_rng(seed), []
    for of_policy in by_policy.values():
        count = min(-(-trials // len(by_policy)), len(of_policy))
        found += [of_policy[index] for index in random.choice(len(of_policy), count, replace=False)]
    return sorted(found, key=lambda row: (row.item.environment, row.item.policy, row.item))


def differences(before: Row, now: Row) -> list[str]:
    """The fields in which a trial differs from what it was."""
    return [name for name in COMPARED if getattr(before, name) != getattr(now, name)]


def run_again(specification: Specification, rows: Sequence[Row]) -> Iterator[tuple[Row, Row]]:
    """Each row with that of the same trial today, a batch at a time; in the order of environments and policies."""
    work = Work(specification)
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row.item.environment, row.item.policy].append(row)
    for (environment, policy), group in groups.items():
        before = {row.item: row for row in group}
        for start in range(0, len(group), _AT_ONCE):
            items = [row.item for row in group[start : start + _AT_ONCE]]
            for now in work.rows(items, environment, policy):
                yield before[now.item], now


def confirm(folder: Path, trials: int, kept: Path) -> dict[str, Any]:
    """Run some trials of a sweep again.

    Args:
        folder: of the sweep.
        trials: how many.
        kept: file of what was run already, which is written.

    Returns:
        ``trials``, ``same``, ``commits`` of the rows of before, and ``different``: those that are not the same, with
        the fields in which they differ.
    """
    store = Store(folder / RESULTS, read_only=True)
    facts, rows = store.facts(), drawn(store.rows(), trials)
    store.close()
    found = _read(kept)
    missing = [row for row in rows if _key(row) not in found]
    for before, now in run_again(specification_from_store(facts["specification"]), missing):
        found[_key(before)] = differences(before, now)
        append_row(kept, {"commit": source_commit(), "row": _key(before), "differs": found[_key(before)]})
    different = [{**dataclasses.asdict(row.item), "differs": found[_key(row)]} for row in rows if found[_key(row)]]
    return {
        "trials": len(rows),
        "same": len(rows) - len(different),
        "commits": sorted({row.commit for row in rows}),
        "different": different,
    }


def _key(row: Row) -> str:
    """Tells rows apart that differ in anything that is compared: what was found of one is nothing about another."""
    values = [*dataclasses.astuple(row.item), row.configuration, *(getattr(row, name) for name in COMPARED)]
    return hashlib.sha256(repr(values).encode()).hexdigest()


def _read(kept: Path) -> dict[str, list[str]]:
    """What was run at this commit; of changes that are not committed nothing is kept: they may have changed again."""
    found: dict[str, list[str]] = {}
    if source_commit().endswith("+"):
        return found
    for entry in read_rows(kept):
        if entry["commit"] == source_commit():
            found[entry["row"]] = entry["differs"]
    return found


def markdown(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The table as it stands in docs/results."""
    lines = ["| sweep | of commit | trials run again | the same |", "|---|---|---|---|"]
    for name, sweep in found.items():
        commits = ", ".join(f"`{commit[:7]}`" for commit in sweep["commits"])
        lines.append(f"| {name} | {commits} | {sweep['trials']} | {sweep['same']} |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sweeps", nargs="+", type=Path, help="folders of sweeps")
    parser.add_argument("--trials", type=int, default=60, help="of each sweep")
    parser.add_argument("--out", type=Path, required=True, help="folder for what was run")
    parser.add_argument("--report", type=Path, metavar="NAME", help="without suffix: where the results go")
    options = parser.parse_args()
    missing = [str(folder) for folder in options.sweeps if not (folder / RESULTS).is_file()]
    if missing:
        parser.error(f"no sweep in {', '.join(missing)}: name folders that potlp sweep --out wrote")
    enable_compilation_cache()
    names = ["/".join(folder.resolve().parts[-2:]) for folder in options.sweeps]
    if len(set(names)) < len(names):
        parser.error(f"two of the sweeps have one name: {', '.join(names)}; run them apart")
    found = {}
    for name, folder in zip(names, options.sweeps, strict=True):
        found[name] = confirm(folder, options.trials, options.out / f"{name.replace('/', '-')}.jsonl")
        print(f"{name}: {found[name]['same']} of {found[name]['trials']} the same", flush=True)
    print(markdown(found))
    if options.report is not None:
        options.report.with_suffix(".json").write_text(
            json.dumps({"provenance": provenance(), "sweeps": found}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
