"""Trials of the arms that are missing in a file of rows, and those of one experiment in it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.limit.arms import Arm, Experiment, key_of, missing_rows
from eval.limit.rows import append_row, read_rows


def run(file: Path, experiment: Experiment, arms: Sequence[Arm], worlds: int) -> None:
    """Append what is missing."""
    for row in missing_rows(experiment, arms, worlds, read_rows(file)):
        append_row(file, row)
        print(f"task {row['task']} world {row['world']} {row['arm']}: {row['outcome']}, {row['cost']:.1f}", flush=True)


def own_rows(file: Path, experiment: Experiment, arms: Sequence[Arm]) -> list[dict[str, Any]]:
    """The rows of these arms with this estimator."""
    return [
        row
        for row in read_rows(file)
        if Arm(row["arm"]) in arms
        and row["task"] in experiment.tasks
        and key_of(row) == experiment.key(row["task"], row["world"], Arm(row["arm"]))
    ]
