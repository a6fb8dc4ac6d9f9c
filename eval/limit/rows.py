"""Trials of different answers, kept as JSON lines, so that a command goes on where it was killed."""

import gzip
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from potlp_jax.trials.record import Outcome

ROWS = "trials.jsonl"


def read_rows(file: Path) -> list[dict[str, Any]]:
    """Rows written so far, packed or not; a line that was cut off by a kill is left out, and its trial runs again."""
    if not file.exists():
        return []
    contents = gzip.decompress(file.read_bytes()) if file.suffix == ".gz" else file.read_bytes()
    rows = []
    for line in contents.decode("utf-8").splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def charged(row: Mapping[str, Any]) -> float:
    """What a trial counts for: its cost, or its budget where it did not end satisfied."""
    return row["cost"] if row["outcome"] == Outcome.SATISFIED else row["budget"]


def append_row(file: Path, row: Mapping[str, Any]) -> None:
    """Write a row behind the others; makes the folder and the file where they are missing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", encoding="utf-8") as stream:
        # A new line first: the last one may have been cut off by a kill.
        stream.write(f"\n{json.dumps(row)}\n")
