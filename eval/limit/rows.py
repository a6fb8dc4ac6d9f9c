"""Trials of different answers, kept as JSON lines, so that a command goes on where it was killed."""

import gzip
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from potlp_jax.trials.record import Outcome

ROWS = "trials.jsonl"


def read_rows(file: Path) -> list[Any]:
    """What ``append_row`` has written so far, packed or not, without a line that a kill has cut off: it runs again.

    Rows that were written together come one by one, as those do that had a line each.
    """
    if not file.exists():
        return []
    contents = gzip.decompress(file.read_bytes()) if file.suffix == ".gz" else file.read_bytes()
    rows = []
    for line in contents.decode("utf-8").splitlines():
        try:
            found = json.loads(line)
        except json.JSONDecodeError:
            continue
        rows += found if isinstance(found, list) else [found]
    return rows


def charged(row: Mapping[str, Any]) -> float:
    """What a trial counts for: its cost, or its budget where it did not end satisfied."""
    return row["cost"] if row["outcome"] == Outcome.SATISFIED else row["budget"]


def append_row(file: Path, row: Mapping[str, Any] | Sequence[Mapping[str, Any]]) -> None:
    """Write a row, or several that belong together, behind the others; makes folder and file where they lack."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", encoding="utf-8") as stream:
        # A new line first: the last one may have been cut off by a kill.
        stream.write(f"\n{json.dumps(row)}\n")
