"""``potlp sweep``: thousands of paired trials, resumable, in one store."""

import csv
import dataclasses
import json as json_module
import os
import time
from pathlib import Path
from typing import Any

from potlp_jax.cli.output import console, fail, note, output_folder, print_json, progress_bar
from potlp_jax.environments.splits import Split
from potlp_jax.sweep.results import compare_pairs, pair_rows
from potlp_jax.sweep.runner import RESULTS, Progress, run_sweep
from potlp_jax.sweep.specification import read_specification
from potlp_jax.sweep.store import Row, Store
from potlp_jax.view.comparisons import loss_lines, outcome_table, savings_table

PLAIN_SECONDS: float = 10.0
"""Seconds between lines of progress where stderr is no terminal."""


def sweep(file: Path, out: Path, processes: int | None, json: bool) -> None:
    """Run what is missing of a sweep, then print its tables."""
    specification = read_specification(file)
    if specification.split is Split.TEST:
        note("worlds of the test split are for reported figures: log this run")
    folder = output_folder(out)
    assert folder is not None
    run_sweep(specification, folder, processes or _cores(), _Reporter().report)
    show_sweep(folder, json)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Reporter:
    """Progress on stderr: a line now and then, with the rate since the start and the time that is left."""

    def __init__(self) -> None:
        self._start, self._first, self._said = time.monotonic(), -1, 0.0
        self._bar = progress_bar()
        self._task: Any = None

    def report(self, progress: Progress) -> None:
        if self._first < 0:
            self._first = progress.done
            self._bar.start()
            self._task = self._bar.add_task("trials (the first ones compile)", total=progress.total)
        text = self._rate(progress)
        self._bar.update(self._task, completed=progress.done, description=f"trials{text}")
        finished = progress.done >= progress.total
        now = time.monotonic()
        if self._bar.disable and (finished or now - self._said >= PLAIN_SECONDS):
            self._said = now
            note(f"{progress.done} of {progress.total} trials{text}")
        if finished:
            self._bar.stop()

    def _rate(self, progress: Progress) -> str:
        seconds, done = time.monotonic() - self._start, progress.done - self._first
        if done < 1:
            return ""
        left = (progress.total - progress.done) * seconds / done
        return f" ({done / seconds:.2f} a second, {_duration(left)} left)"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{round(seconds)} s" if seconds < 90 else f"{minutes} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def open_store(folder: Path) -> Store:
    """The store of a sweep that has been begun."""
    if not (folder / RESULTS).is_file():
        fail(
            f"{folder}: there is no sweep in here (no {RESULTS}); begin one with `potlp sweep FILE.yaml --out {folder}`"
        )
    return Store(folder / RESULTS)


def show_sweep(folder: Path, json: bool) -> None:
    """Print the tables of what is finished: one per environment and task."""
    store = open_store(folder)
    specification = store.facts()["specification"]
    comparisons = {
        (cell["environment"], cell["task"]): compare_pairs(
            pair_rows(store.rows(cell["environment"], cell["task"]), specification["policies"]),
            specification["policies"],
        )
        for cell in specification["cells"]
    }
    store.close()
    if json:
        print_json(
            {
                "specification": specification,
                "cells": [
                    {"environment": environment, "task": task, **comparison.to_dict()}
                    for (environment, task), comparison in comparisons.items()
                ],
            }
        )
        return
    out = console()
    for (environment, task), comparison in comparisons.items():
        out.print(f"{environment}/{specification['split']}, task {task}", markup=False, style="bold")
        satisfied, charged = comparison.satisfied, comparison.charged
        out.print(savings_table(satisfied, f"{satisfied.pairs} worlds that every policy satisfied"))
        if satisfied.dropped:
            title = f"all {charged.pairs} worlds, unsatisfied trials charged their budget"
            out.print(savings_table(charged, title))
            out.print(outcome_table(comparison))
        for line in loss_lines(comparison):
            out.print(line, markup=False)


def export_sweep(folder: Path, file: Path) -> None:
    """Write the finished trials to a .csv or .parquet file."""
    store = open_store(folder)
    rows = [_flat(row) for row in store.rows()]
    store.close()
    if file.suffix == ".csv":
        _write_csv(rows, file)
    elif file.suffix == ".parquet":
        _write_parquet(rows, file)
    else:
        fail(f"--out {file}: give a name that ends in .csv or .parquet")
    console().print(f"wrote {len(rows)} trials to {file}", markup=False)


def _flat(row: Row) -> dict[str, Any]:
    """One level of plain values."""
    values = dataclasses.asdict(row)
    item = values.pop("item")
    values |= {"key": " ".join(map(str, row.key)), "versions": json_module.dumps(values["versions"], sort_keys=True)}
    return {**item, **values}


def _write_csv(rows: list[dict[str, Any]], file: Path) -> None:
    names = list(rows[0]) if rows else ["environment", "task", "policy", "world"]
    with file.open("w", encoding="utf-8", newline="") as opened:
        writer = csv.DictWriter(opened, names)
        writer.writeheader()
        writer.writerows(rows)


def _write_parquet(rows: list[dict[str, Any]], file: Path) -> None:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        fail("Parquet files need pyarrow: pip install 'potlp-jax[train]', or write a .csv")
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), file)
