"""Sweeps that are killed at random moments and begun again: rows must be those of a sweep that nobody disturbed.

A case is one kill. It begins or continues ``potlp sweep`` in a folder that all cases of its kind share, ends it by a
signal, and looks at the rows: those that were there before must be there, and each must be what the undisturbed sweep
has. When the sweep is finished, all rows are compared, and the next case begins another one.
"""

import contextlib
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from eval.faults import LIMIT, Kind, LostRowsError, WrongAnswerError
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.store import Item, Row, Store

_SPECIFICATION = {"environments": ["toy"], "tasks": [1, 2], "policies": ["optimistic"], "worlds": 60, "seed": 3}

_CASE_LIMIT = 900.0
"""Seconds of a case: the first one makes the undisturbed sweep, and each imports and loads compiled programs anew."""

_PATIENCE = 240.0
"""Seconds until a sweep shows its first new row, on a machine that does much else."""

_COMMAND = (sys.executable, "-c", "from potlp_jax.cli import main; main()", "--quiet", "sweep")


def _sweep(folder: Path, processes: int) -> subprocess.Popen[bytes]:
    specification = folder.parent / "sweep.yaml"
    if not specification.exists():
        specification.write_text(json.dumps(_SPECIFICATION))
    words = [*_COMMAND, str(specification), "--out", str(folder), "--processes", str(processes), "--json"]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def _rows(folder: Path) -> dict[Item, Row]:
    """Rows without what differs between runs."""
    if not (folder / RESULTS).exists():
        return {}
    with contextlib.closing(Store(folder / RESULTS)) as store:
        return {row.item: dataclasses.replace(row, seconds=0.0) for row in store.rows()}


def _whole(parent: Path) -> dict[Item, Row]:
    """The rows of the undisturbed sweep, which is run once."""
    folder = parent / "whole"
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        if _sweep(folder, 1).wait():
            raise AssertionError("the undisturbed sweep failed")
        (folder / "done").touch()
    return _rows(folder)


def _kill_command(number: signal.Signals, random: np.random.Generator, process: subprocess.Popen[bytes]) -> None:
    """One signal to the command; its workers have to end with it."""
    workers = workers_of(process.pid)
    process.send_signal(number)
    _require_end(process, workers, number)


def _kill_worker(random: np.random.Generator, process: subprocess.Popen[bytes]) -> None:
    """A worker dies, the sweep goes on with another for a while; then all is ended."""
    workers = workers_of(process.pid)
    if workers:
        with contextlib.suppress(ProcessLookupError):
            os.kill(workers[random.integers(len(workers))], signal.SIGKILL)
        time.sleep(random.uniform(0, 3))
        if process.poll() not in (None, 0):
            raise AssertionError(f"the sweep ended with code {process.poll()} over one dead worker")
    _kill_command(signal.SIGTERM, random, process)


def workers_of(parent: int) -> list[int]:
    """The processes that a command has spawned, by whichever of its threads."""
    found = []
    for children in Path("/proc", str(parent), "task").glob("*/children"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            found += [int(child) for child in children.read_text().split()]
    return [child for child in found if "spawn_main" in _words_of(child)]


def process_start(process: int) -> str | None:
    """When a process was started, in the system's own units; None where there is none.

    The system uses the number of a process again after a while, but not with the same start.
    """
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
    except FileNotFoundError:
        return None
    # Fields of /proc/PID/stat: number, name in brackets (which may hold anything), state, and as the 22nd the start.
    state, *fields = stat.rpartition(")")[2].split()
    return None if state == "Z" else fields[18]


def _words_of(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def _require_end(process: subprocess.Popen[bytes], workers: list[int], number: signal.Signals) -> None:
    starts = {worker: process_start(worker) for worker in workers}
    until = time.monotonic() + LIMIT
    process.wait(LIMIT)
    while left := [worker for worker, start in starts.items() if start and process_start(worker) == start]:
        if time.monotonic() > until:
            raise AssertionError(f"{len(left)} processes of the sweep outlived it by {LIMIT:g} s after {number.name}")
        time.sleep(0.02)


def _case(
    name: str,
    processes: int,
    kill: Callable[[np.random.Generator, subprocess.Popen[bytes]], None],
    random: np.random.Generator,
    folder: Path,
) -> None:
    """Continue the sweep, kill it, and compare its rows."""
    whole, running = _whole(folder.parent), folder.parent / f"running-{name}"
    before = _rows(running)
    process = _sweep(running, processes)
    try:
        # Every fifth at any moment of its beginning, the others among the writing of rows.
        if random.random() < 0.8:
            _await_row(running, len(before), process)
        time.sleep(random.exponential(0.3))
        kill(random, process)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    _compare(before, _rows(running), whole)
    if len(_rows(running)) == len(whole):
        shutil.rmtree(running)


def _await_row(folder: Path, rows: int, process: subprocess.Popen[bytes]) -> None:
    until = time.monotonic() + _PATIENCE
    while process.poll() is None and time.monotonic() < until:
        if (folder / RESULTS).exists():
            with contextlib.closing(Store(folder / RESULTS)) as store:
                if store.count() > rows:
                    return
        time.sleep(0.05)


def _compare(before: dict[Item, Row], after: dict[Item, Row], whole: dict[Item, Row]) -> None:
    lost = [item for item in before if item not in after]
    if lost:
        raise LostRowsError(f"{len(lost)} rows are gone, the first is {lost[0]}")
    wrong = [item for item, row in after.items() if whole.get(item) != row]
    if wrong:
        raise WrongAnswerError(f"{len(wrong)} rows are not those of the undisturbed sweep, the first is {wrong[0]}")


def _kind(name: str, processes: int, kill: Callable[..., None]) -> Kind:
    run = partial(_case, name.replace(" ", "-"), processes, kill)
    return Kind(name, run, unit="kills", limit=_CASE_LIMIT, memory=None, warm_up=0)


KINDS = (
    _kind("SIGKILL, one process", 1, partial(_kill_command, signal.SIGKILL)),
    _kind("SIGTERM, one process", 1, partial(_kill_command, signal.SIGTERM)),
    _kind("SIGKILL, two workers", 2, partial(_kill_command, signal.SIGKILL)),
    _kind("SIGTERM, two workers", 2, partial(_kill_command, signal.SIGTERM)),
    _kind("SIGKILL of a worker, then SIGTERM", 2, _kill_worker),
)
