"""A sweep on a scheduler and workers of their own, whose processes are killed at random: are all rows there, once?"""

import contextlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from eval.faults.kills import workers_of
from eval.savings import SWEEP_COMMAND
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.store import Item, Row, Store

SPECIFICATION = {"environments": ["toy"], "tasks": [1, 2], "policies": ["optimistic"], "worlds": 400, "seed": 3}


class Kept:
    """A process that is begun again whenever it has ended, as a batch system or a service manager does."""

    def __init__(self, *words: str, pause: float = 0.5, log: Path = Path(os.devnull)) -> None:
        self._words, self._pause, self._log = words, pause, log
        self.process: subprocess.Popen[bytes] | None = None
        self.look()

    def look(self) -> None:
        """Begin it where it does not run."""
        if self.process is None or self.process.poll() is not None:
            # A supervisor waits a little, too.
            time.sleep(self._pause if self.process else 0.0)
            with self._log.open("a") as log:
                self.process = subprocess.Popen(self._words, stdout=subprocess.DEVNULL, stderr=log)

    def last_words(self) -> str:
        """The end of what it wrote."""
        return self._log.read_text(encoding="utf-8", errors="replace")[-500:]

    def kill(self) -> None:
        """The process, and whatever it has spawned."""
        assert self.process is not None
        for child in workers_of(self.process.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        self.process.kill()
        self.process.wait()


def free_port() -> int:
    """One on which nobody listens."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextlib.contextmanager
def cluster(workers: int) -> Iterator[tuple[str, Kept, list[Kept]]]:
    """``dask scheduler`` and ``dask worker`` over TCP: the address, and the processes."""
    port = str(free_port())
    address = f"tcp://127.0.0.1:{port}"
    python = sys.executable, "-m"
    scheduler = Kept(*python, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    unlimited = "--nthreads", "1", "--memory-limit", "0"
    command = (*python, "distributed.cli.dask_worker", address, *unlimited, "--no-dashboard", "--no-nanny")
    members = [Kept(*command) for _ in range(workers)]
    try:
        yield address, scheduler, members
    finally:
        for member in (*members, scheduler):
            member.kill()


def rows_of(folder: Path) -> dict[Item, tuple[Any, ...]]:
    """What must be the same in every run."""
    with contextlib.closing(Store(folder / RESULTS, read_only=True)) as store:
        return {row.item: _result(row) for row in store.rows()}


def _result(row: Row) -> tuple[Any, ...]:
    return row.outcome, row.cost, row.budget, row.steps, row.decisions, row.status, row.key, row.path, row.world_digest


def undisturbed(out: Path) -> tuple[Path, dict[Item, tuple[Any, ...]]]:
    """The sweep's file, and its rows where nothing is killed, run here."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "sweep.yaml"
    file.write_text(json.dumps(SPECIFICATION))
    folder = _emptied(out / "whole")
    subprocess.run([*SWEEP_COMMAND, str(file), "--out", str(folder), "--json"], check=True, capture_output=True)
    return file, rows_of(folder)


def require_same(found: Mapping[Item, Any], whole: Mapping[Item, Any], where: Path) -> None:
    """Raises AssertionError where a row is lost, or says something else."""
    assert len(found) == len(whole), f"{where}: {len(whole) - len(found)} rows lost"
    assert found == whole, f"{where}: rows differ"


def on_a_scheduler(out: Path, kills: Mapping[str, int], workers: int = 4, seed: int = 0) -> dict[str, Any]:
    """On ``dask scheduler`` and workers over TCP, of which processes are killed; sweeps go on until all are.

    Args:
        out: folder of the sweeps.
        kills: how many of ``worker``, ``driver`` and ``scheduler``.
        workers: of the cluster.
        seed: of the moments.
    """
    file, whole = undisturbed(out)
    draw = random.Random(seed)
    left = [kind for kind, count in kills.items() for _ in range(count)]
    draw.shuffle(left)
    sweeps = 0
    with cluster(workers) as (address, scheduler, members):
        while left:
            folder = _emptied(out / f"disturbed-{sweeps}")
            command = (*SWEEP_COMMAND, str(file), "--out", str(folder), "--cluster", address, "--json")
            driver = Kept(*command, log=out / "driver.log")
            try:
                _disturb(driver, scheduler, members, left, draw)
            finally:
                driver.kill()
            require_same(rows_of(folder), whole, folder)
            sweeps += 1
    return {"kills": dict(kills), "workers": workers, "sweeps": sweeps, "rows": len(whole), "lost": 0, "different": 0}


# dask-jobqueue replaces jobs whose workers had come; one that ends before is not missed (docs/clusters.md).
_SETTLED = 10.0
"""Seconds after which a job's worker has come."""


def on_a_batch_system(out: Path, where: str, kills: int, seed: int = 0) -> dict[str, Any]:
    """On a batch system of this machine, whose jobs' processes are killed; sweeps go on until all kills are done.

    Args:
        out: folder of the sweeps.
        where: as for ``--cluster``.
        kills: how many.
        seed: of the moments.
    """
    file, whole = undisturbed(out)
    draw, left, sweeps = random.Random(seed), kills, 0
    while left:
        folder = _emptied(out / f"batch-{sweeps}")
        command = [*SWEEP_COMMAND, str(file), "--out", str(folder), "--cluster", where, "--json"]
        log, others = out / "driver.log", _processes_with("distributed.cli.dask_worker")
        with log.open("a") as errors:
            driver = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)
        since: dict[int, float] = {}
        while driver.poll() is None:
            time.sleep(draw.expovariate(1 / 2.0))
            now = time.monotonic()
            # Of this sweep alone: workers of others may be on the same machine.
            workers = _processes_with("distributed.cli.dask_worker") - others
            since = {job: since.get(job, now) for job in workers}
            settled = [job for job, began in since.items() if now - began > _SETTLED]
            if left and settled:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(draw.choice(settled), signal.SIGKILL)
                    left -= 1
        assert driver.returncode == 0, f"the sweep ended with code {driver.returncode}: {log.read_text()[-500:]}"
        require_same(rows_of(folder), whole, folder)
        sweeps += 1
    return {"cluster": where, "kills": kills, "sweeps": sweeps, "rows": len(whole), "lost": 0, "different": 0}


def _emptied(folder: Path) -> Path:
    """A folder without a sweep of before, which would be found finished and be disturbed in nothing."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def _processes_with(words: str) -> set[int]:
    found = set()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if words.encode() in path.read_bytes():
                found.add(int(path.parent.name))
    return found


def _disturb(driver: Kept, scheduler: Kept, members: list[Kept], left: list[str], draw: random.Random) -> None:
    """Kill until the sweep has ended by itself; what was killed is begun again."""
    while driver.process is not None and (code := driver.process.poll()) != 0:
        if code is not None and code != -signal.SIGKILL:
            raise AssertionError(f"the sweep ended with code {code}: {driver.last_words()}")
        for member in (scheduler, *members, driver):
            member.look()
        if left:
            kind = left.pop()
            victim = {"driver": driver, "scheduler": scheduler, "worker": draw.choice(members)}[kind]
            victim.kill()
        time.sleep(draw.expovariate(1 / 1.5))
