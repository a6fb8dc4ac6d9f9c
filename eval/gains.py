"""What changed from one table of trials to another: costs by policy, and PO-TLP's share, paired by world.

    git show COMMIT:docs/results/table1/rows.csv.gz > out/before.csv.gz
    python -m eval.gains out/before.csv.gz docs/results/table1/rows.csv.gz

Both are files of ``eval.compact_rows``. A share is of what known map saves over the baseline, as in the tables, which
must cost the same in both; its interval draws whole worlds.
"""

import argparse
import csv
import gzip
import itertools
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from potlp_jax.planning.policies import Policy
from potlp_jax.sweep.statistics import UNRELIABLE
from potlp_jax.trials.record import Outcome
from potlp_jax.types import status_of

SAME = 1e-3
"""Costs that differ by less are the same: what a row holds is rounded."""

_DRAWS = 2000
_NEEDED = {Policy.KNOWN_MAP.value, Policy.BASELINE.value, Policy.POTLP.value}

Costs = dict[tuple[str, int], dict[str, float]]
"""Of each policy, by task and world."""


def costs_of(file: Path) -> Costs:
    """The costs in a file of rows, of the trials that ended satisfied and reliably."""
    found: Costs = defaultdict(dict)
    with gzip.open(file, "rt", newline="") as lines:
        for row in csv.DictReader(lines):
            if row["outcome"] == Outcome.SATISFIED and not _status(row["status"]) & UNRELIABLE:
                found[row["task"], int(row["world"])][row["policy"]] = float(row["cost"])
    return dict(found)


def _status(text: str) -> int:
    # Files of 0.1 hold the bits as a number.
    return int(text) if text.isdecimal() else status_of(text.split())


def changes(before: Costs, after: Costs) -> Iterator[tuple[str, int, int, int]]:
    """Each policy with its trials in both tables, and how many of them are cheaper and dearer in the second."""
    shared = [(before[name], after[name]) for name in before.keys() & after.keys()]
    for policy in sorted({policy for costs in after.values() for policy in costs}):
        differences = [now[policy] - then[policy] for then, now in shared if policy in then and policy in now]
        cheaper, dearer = sum(found < -SAME for found in differences), sum(found > SAME for found in differences)
        yield policy, len(differences), cheaper, dearer


def worlds_of_both(before: Costs, after: Costs, task: str) -> list[tuple[str, int]]:
    """The task's worlds in which both files have known map, baseline and PO-TLP."""
    shared = {name: before[name].keys() & after[name].keys() for name in before.keys() & after.keys()}
    return sorted(name for name, policies in shared.items() if name[0] == task and policies >= _NEEDED)


def gain(before: Costs, after: Costs, task: str, seed: int = 0) -> tuple[float, float, float]:
    """How much PO-TLP's share of the attainable savings has risen in a task, and the 95 % interval; 1 is all of it.

    There must be a world to compare (``worlds_of_both``).

    Raises:
        ValueError: known map or baseline cost otherwise, so that shares before and after are of different savings.
    """
    worlds = worlds_of_both(before, after, task)
    for name, policy in itertools.product(worlds, (Policy.KNOWN_MAP, Policy.BASELINE)):
        if abs(before[name][policy] - after[name][policy]) > SAME:
            raise ValueError(
                f"{policy} costs otherwise in world {name[1]} of task {task}: the shares are of other savings"
            )
    saved = np.array([before[name][Policy.POTLP] - after[name][Policy.POTLP] for name in worlds])
    attainable = np.array([after[name][Policy.BASELINE] - after[name][Policy.KNOWN_MAP] for name in worlds])
    drawn = np.random.default_rng(seed).integers(0, len(worlds), (_DRAWS, len(worlds)))
    low, high = np.percentile(saved[drawn].sum(axis=1) / attainable[drawn].sum(axis=1), [2.5, 97.5])
    return float(saved.sum() / attainable.sum()), float(low), float(high)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    options = parser.parse_args()
    before, after = costs_of(options.before), costs_of(options.after)
    print("| policy | trials in both | cheaper | dearer |\n|---|---|---|---|")
    for row in changes(before, after):
        print("| " + " | ".join(map(str, row)) + " |")
    print("\n| task | points of the share gained (95 %) |\n|---|---|")
    for task in sorted({task for task, _ in before.keys() | after.keys()}):
        if not worlds_of_both(before, after, task):
            print(f"| `{task}` | no world of both has known map, baseline and PO-TLP |")
            continue
        found, low, high = (100 * value for value in gain(before, after, task))
        print(f"| `{task}` | {found:.1f} ({low:.1f} to {high:.1f}) |")


if __name__ == "__main__":
    main()
