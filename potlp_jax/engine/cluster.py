"""Work on a Dask cluster: processes of this machine, machines by ssh, a batch system, or a scheduler that is there.

Dask's scheduler hands out units, notices workers that are gone, and gives their units to others. This module keeps a
few units ahead for every worker, begins again what a scheduler has forgotten, and gives up units that kill workers.
Workers have one thread and one core each, and are spawned.

References:
    Rocklin, Dask: parallel computation with blocked algorithms and task scheduling, SciPy 2015.
"""

import contextlib
import importlib.util
import itertools
import logging
import math
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import dask.config
import distributed
from distributed.client import FutureCancelledError
from distributed.deploy.cluster import Cluster
from distributed.scheduler import KilledWorker

from potlp_jax.cache import enable_compilation_cache
from potlp_jax.engine.engine import MOST_KILLED, Broken, Result, Shared, Unit
from potlp_jax.errors import EngineError

logger = logging.getLogger(__name__)

# With fewer a worker would wait for the next unit while its results travel; more would be begun again in vain.
_AHEAD = 2
# Seconds between looks at whether scheduler and workers are still there, while nothing is reported.
_LOOK = 1.0
# Seconds in which the first worker has to come: batch systems may let jobs wait for hours, and say so themselves.
_PATIENCE = 300.0
ANSWER: float = 10.0
"""Seconds in which a scheduler has to answer."""

# Seconds that workers have to end.
_GRACE = 1.0

SETTINGS: Mapping[str, Any] = MappingProxyType(
    {
        # An XLA compilation may hold the interpreter for as long; a worker that is silent for longer is reported.
        "distributed.admin.tick.limit": "60s",
        "distributed.worker.multiprocessing-method": "spawn",
        # Memory that XLA holds is none that a worker could free or spill: the system ends one that takes too much.
        "distributed.worker.memory.terminate": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.target": False,
    }
)
"""Of Dask, for schedulers and workers that are begun here."""


class DaskEngine:
    """Units go to the workers of a Dask cluster.

    Args:
        connect: gives the address of a scheduler, or a cluster of one's own; asked again where a scheduler was lost.
        cores: of this machine, one for each worker by its number; none where the workers are elsewhere.
    """

    def __init__(self, where: str | Cluster, cores: tuple[int, ...] = ()) -> None:
        self._where, self._cores = where, cores
        self._client = self._connected()
        self._known: frozenset[str] = frozenset()
        self._looked = -math.inf

    @property
    def workers(self) -> int:
        """Those that the scheduler knows, as of a moment ago."""
        self._look_after_workers()
        return len(self._known)

    @property
    def dashboard(self) -> str | None:
        """The address of Dask's own page; None where there is none."""
        # A scheduler without bokeh answers there too, with the advice to install it.
        return self._client.dashboard_link if self._client.run_on_scheduler(_has_page) else None

    def run(
        self, work: Callable[[Shared, Unit], Iterable[Result]], shared: Shared, units: Iterable[Unit]
    ) -> Iterator[tuple[Unit, list[Result] | Broken]]:
        """Each unit's results when it is done, in whatever order."""
        self._await_worker()
        running = _Running(self, work, shared)
        suspects: list[Unit] = []
        try:
            # Of a worker that dies, what it did and what it was to do next are not told apart. So the second death only
            # casts suspicion,
            for unit, found in running.through(iter(units), together=True):
                if isinstance(found, Broken):
                    suspects.append(unit)
                else:
                    yield unit, found
            # and the third, alone, decides.
            for unit in suspects:
                yield from running.through(iter([unit]), together=False)
        finally:
            running.cancel()

    def close(self) -> None:
        """End the workers that were begun here; those of a scheduler that was there stay."""
        with contextlib.suppress(Exception):
            self._client.close(timeout=_GRACE)
        if isinstance(self._where, Cluster):
            with contextlib.suppress(Exception):
                self._where.close(timeout=_GRACE)

    @property
    def client(self) -> distributed.Client:
        """Connected, as far as is known."""
        return self._client

    def is_connected(self) -> bool:
        """Whether the scheduler is there."""
        return self._client.status == "running"

    def reconnect(self) -> None:
        """Wait for the scheduler to come back. Raises EngineError where it does not, or was one of this process."""
        if isinstance(self._where, Cluster):
            raise EngineError("Dask's scheduler in this process has ended: give the same command again")
        logger.warning(f"the scheduler at {self._where} does not answer; waiting for it for {_PATIENCE:g} s")
        with contextlib.suppress(Exception):
            self._client.close(timeout=_GRACE)
        until = time.monotonic() + _PATIENCE
        while True:
            try:
                self._client = self._connected()
            except EngineError:
                if time.monotonic() > until:
                    raise
                time.sleep(_LOOK)
            else:
                self._await_worker()
                return

    def _connected(self) -> distributed.Client:
        try:
            with dask.config.set(SETTINGS):
                client = distributed.Client(self._where, timeout=ANSWER, set_as_default=False)
        except (OSError, TimeoutError) as error:
            raise EngineError(
                f"no Dask scheduler answers at {self._where} ({error}): start one with `dask scheduler`, and workers "
                "with `dask worker --nthreads 1`"
            ) from error
        return client

    def prepare(self, shared: Any, deaths: int) -> None:
        """Tell workers, also those that come later, what units share, and the scheduler when a unit is given up."""
        self._client.run_on_scheduler(_give_up_after, deaths)
        self._client.register_plugin(_Prepared(self._cores, shared), name=_Prepared.name)

    def _look_after_workers(self) -> None:
        """Ask who is there, and say who is gone."""
        now = time.monotonic()
        if now - self._looked < _LOOK or not self.is_connected():
            return
        self._looked, before = now, self._known
        self._known = frozenset(self._client.scheduler_info(n_workers=-1)["workers"])
        if lost := len(before - self._known):
            logger.warning(f"{lost} of {len(before)} workers ended; what they had begun begins again elsewhere")

    def _await_worker(self) -> None:
        """Raises EngineError where no worker comes."""
        try:
            self._client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise EngineError(f"no worker came within {_PATIENCE:g} s: look at what the cluster says of it") from error


class _Running:
    """The units that a scheduler has, and what becomes of them."""

    def __init__(self, engine: DaskEngine, work: Callable[[Any, Any], Iterable[Any]], shared: Any) -> None:
        self._engine, self._work, self._shared = engine, work, shared
        self._reports: queue.SimpleQueue[distributed.Future] = queue.SimpleQueue()
        self._units: dict[distributed.Future, Any] = {}
        self._deaths = 0

    def through(self, remaining: Iterator[Any], together: bool) -> Iterator[tuple[Any, list[Any] | Broken]]:
        """All that remain, several at a time or each alone: given up at the last death, or before it."""
        self._deaths = MOST_KILLED - 1 if together else 1
        self._engine.prepare(self._shared, self._deaths)
        while True:
            most = _AHEAD * max(self._engine.workers, 1) if together else 1
            while len(self._units) < most and (found := list(itertools.islice(remaining, 1))):
                self._submit(found[0])
            if not self._units:
                return
            yield from self._ended()

    def cancel(self) -> None:
        """Nobody waits for the rest."""
        with contextlib.suppress(Exception):
            self._engine.client.cancel(list(self._units), force=True)
        self._units.clear()

    def _ended(self) -> Iterator[tuple[Any, list[Any] | Broken]]:
        """What has ended, at least after a while."""
        try:
            future = self._reports.get(timeout=_LOOK)
        except queue.Empty:
            self._look_after_the_lost()
            return
        # Reported by a scheduler that is gone: begun again already.
        if future not in self._units:
            return
        if future.status == "finished":
            # The bytes travel only now, and worker or scheduler may be lost meanwhile: then it is begun again.
            with contextlib.suppress(FutureCancelledError, OSError):
                results = future.result()
                yield self._units.pop(future), results
        elif future.status == "error":
            # Dask's types know of the asynchronous method alone.
            error: Any = future.exception()
            unit = self._units.pop(future)
            if isinstance(error, _UnpreparedError):
                # By a scheduler that has come back.
                self._engine.prepare(self._shared, self._deaths)
                self._submit(unit)
            elif isinstance(error, KilledWorker):
                yield unit, Broken(f"{MOST_KILLED} workers that began it died")
            else:
                raise error

    def _submit(self, unit: Any) -> None:
        # Not pure to Dask, which would otherwise give a unit that comes again its old result.
        future = self._engine.client.submit(_done, self._work, unit, pure=False)
        self._units[future] = unit
        future.add_done_callback(self._reports.put)

    def _look_after_the_lost(self) -> None:
        """Hand out again what a scheduler has forgotten."""
        if not self._engine.is_connected():
            self._engine.reconnect()
            gone = list(self._units)
        else:
            gone = [future for future in self._units if future.status in ("cancelled", "lost")]
        if gone:
            logger.warning(f"the scheduler was lost, or has forgotten {len(gone)} units; they begin again")
            self._engine.prepare(self._shared, self._deaths)
        for future in gone:
            self._submit(self._units.pop(future))


class _UnpreparedError(Exception):
    """The worker has not been told what units share."""


def _done(work: Callable[[Any, Any], Iterable[Any]], unit: Any) -> list[Any]:
    prepared = distributed.get_worker().plugins.get(_Prepared.name)
    if not isinstance(prepared, _Prepared):
        raise _UnpreparedError
    return list(work(prepared.shared, unit))


def _give_up_after(deaths: int, dask_scheduler: Any) -> None:
    # Dask counts those that are allowed.
    dask_scheduler.allowed_failures = deaths - 1


def _has_page(dask_scheduler: Any) -> bool:
    return importlib.util.find_spec("bokeh") is not None and "dashboard" in dask_scheduler.services


class _Prepared(distributed.WorkerPlugin):
    """What a worker knows before its first unit."""

    name = "potlp"

    def __init__(self, cores: tuple[int, ...], shared: Any) -> None:
        self._cores, self.shared = cores, shared

    def setup(self, worker: Any) -> None:
        """Keep to one core, and to what was compiled before."""
        # An interrupt from the terminal reaches all processes, and the one that asked for the work ends the others. A
        # worker that is a thread of that one has nothing to ignore.
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        if self._cores and isinstance(worker.name, int):
            # Before XLA starts, which then uses one thread.
            os.sched_setaffinity(0, {self._cores[worker.name % len(self._cores)]})
        enable_compilation_cache()
