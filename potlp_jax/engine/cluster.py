"""Work on a Dask cluster: processes of this machine, machines by ssh, a batch system, or a scheduler that is there.

Dask's scheduler hands out units, notices workers that are gone, and gives their units to others. This module keeps a
few units ahead for every worker, begins again what a scheduler has forgotten, and gives up units that kill workers.
Workers have one thread and one core each, and are spawned.

References:
    Rocklin, Dask: parallel computation with blocked algorithms and task scheduling, SciPy 2015.
"""

import contextlib
import dataclasses
import importlib.util
import itertools
import logging
import math
import os
import queue
import signal
import threading
import time
import uuid
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import distributed
from distributed.client import FutureCancelledError
from distributed.deploy.cluster import Cluster
from distributed.scheduler import KilledWorker

from potlp_jax.cache import enable_compilation_cache
from potlp_jax.engine.engine import MOST_KILLED, Broken, Result, Shared, Unit
from potlp_jax.errors import EngineError
from potlp_jax.files import one_line

logger = logging.getLogger(__name__)

# With fewer a worker would wait for the next unit while its results travel; more would be begun again in vain.
_AHEAD = 2
# Seconds between looks at whether scheduler and workers are still there, while nothing is reported.
_LOOK = 1.0
# Seconds in which a scheduler that was lost has to come back.
_PATIENCE = 300.0
# Seconds between notes that there is no worker.
_REMINDER = 60.0
ANSWER: float = 10.0
"""Seconds in which a scheduler has to answer."""

# Seconds that workers have to end.
_GRACE = 1.0

LOST: tuple[type[BaseException], ...] = (OSError, TimeoutError, FutureCancelledError)
"""What Dask raises where a scheduler does not answer any more, or has forgotten what it was asked."""

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
        where: the address of a scheduler, or a cluster that ends with the engine.
        cores: of this machine, one for each worker by its number; none where the workers are elsewhere.

    Raises:
        EngineError: no scheduler answers.
    """

    def __init__(self, where: str | Cluster, cores: tuple[int, ...] = ()) -> None:
        self._where, self._cores = where, cores
        self._known: frozenset[str] = frozenset()
        self._looked, self._missed = -math.inf, time.monotonic()
        with contextlib.ExitStack() as begun:
            # Otherwise jobs and machines would go on with nobody to work for,
            begun.callback(self._close_cluster)
            self.client = self._connected()
            """Connected, as far as is known."""
            # and a connection with nobody to use it.
            begun.callback(self.close)
            self.look_after_workers()
            begun.pop_all()

    @property
    def workers(self) -> int:
        """Those that the scheduler knew a moment ago."""
        return len(self._known)

    @property
    def dashboard(self) -> str | None:
        """The address of Dask's own page; None where there is none."""
        # A scheduler without bokeh answers there too, with the advice to install it.
        return self.client.dashboard_link if self.client.run_on_scheduler(_has_page) else None

    def run(
        self, work: Callable[[Shared, Unit], Iterable[Result]], shared: Shared, units: Iterable[Unit]
    ) -> Iterator[tuple[Unit, list[Result] | Broken]]:
        """Do ``work(shared, unit)`` for every unit, on the workers of the cluster.

        Args:
            work: a function of a module that workers can import; pure, because a unit whose worker or scheduler is lost
                begins again. It is given up when ``MOST_KILLED`` workers have died of it; when more have, where others
                use the same scheduler and allow more meanwhile.
            shared: picklable; goes to each worker once, also to those that join later.
            units: picklable; asked for one by one, so that each worker has one in hand and one to go on with.

        Yields:
            Each unit with all of its results, in the order in which units are done; one without results comes with an
            empty list. Units that are suspected of killing workers come last, done alone; those that are given up with
            ``Broken``.

        Raises:
            Exception: whatever ``work`` raised; what has not ended by then is cancelled.
            EngineError: a scheduler that was lost has not come back within five minutes.
        """
        running = _Running(self, work, shared)
        suspects: list[tuple[Unit, _Killed]] = []
        try:
            # Of a worker that dies, what it did and what it was to do next are not told apart. So the second death only
            # casts suspicion,
            for unit, found in running.through(iter(units), together=True):
                if isinstance(found, _Killed):
                    suspects.append((unit, found))
                else:
                    yield unit, found
            # and the third, alone, decides.
            for suspect, before in suspects:
                for unit, found in running.through(iter([suspect]), together=False):
                    yield unit, found.together_with(before) if isinstance(found, _Killed) else found
        finally:
            running.cancel()

    def close(self) -> None:
        """End the workers that were begun here; those of a scheduler that was there stay."""
        with contextlib.suppress(Exception):
            self.client.close(timeout=_GRACE)
        self._close_cluster()

    def _close_cluster(self) -> None:
        if isinstance(self._where, Cluster):
            with contextlib.suppress(Exception):
                self._where.close(timeout=_GRACE)

    def reconnect(self, why: BaseException) -> None:
        """Wait for a scheduler that was lost. Raises EngineError where it stays away."""
        told = one_line(why) or type(why).__name__
        logger.warning(f"the scheduler was lost ({told}); what it had been given begins again")
        until = time.monotonic() + _PATIENCE
        while True:
            with contextlib.suppress(Exception):
                self.client.close(timeout=_GRACE)
            try:
                self.client = self._connected()
            except EngineError:
                if time.monotonic() > until:
                    raise
                time.sleep(_LOOK)
            else:
                return

    def prepare(self, name: str, shared: Any, deaths: int) -> None:
        """Tell workers, also those that come later, what units share, and the scheduler when a unit is given up.

        Args:
            name: under which workers find what is shared; another one for every run, because others may use the same
                scheduler.
            shared: what ``work`` is given beside each unit; picklable.
            deaths: how many workers may die of a unit: at the last of these it is given up. A setting of the scheduler,
                for everybody who uses it, until ``restore``.

        Raises:
            OSError, TimeoutError, FutureCancelledError: the scheduler does not answer (``LOST``).
        """
        self.client.run_on_scheduler(_give_up_after, deaths, name, self.client.id)
        self.client.register_plugin(_Prepared(name, self._cores, shared))

    def restore(self, name: str) -> None:
        """Leave workers and scheduler as they were before ``prepare``."""
        self.client.run_on_scheduler(_give_up_as_before, name)
        self.client.unregister_worker_plugin(name)

    def look_after_workers(self) -> None:
        """Ask who is there, not too often, and say who is gone."""
        now = time.monotonic()
        if now - self._looked < _LOOK:
            return
        self._looked, before = now, self._known
        # Not client.scheduler_info: what Dask refreshes in the background, without workers, may come between.
        # Dask types it as a coroutine too, which a client that blocks never gives.
        self._known = frozenset(cast(list[str], self.client.run_on_scheduler(_addresses)))
        if lost := len(before - self._known):
            logger.warning(f"{lost} of {len(before)} workers ended; what they had begun begins again elsewhere")
        # A batch system may let jobs wait for hours, so that this is no error.
        if self._known:
            self._missed = now
        elif now - self._missed >= _REMINDER:
            self._missed = now
            logger.warning("no worker is there; waiting for one: look at what the cluster says of them")

    def _connected(self) -> distributed.Client:
        try:
            return distributed.Client(self._where, timeout=ANSWER, set_as_default=False)
        except LOST as error:
            raise EngineError(
                f"no Dask scheduler answers at {self._where} ({error}): start one with `dask scheduler`, and workers "
                "with `dask worker --nthreads 1 --memory-limit 0`"
            ) from error


@dataclasses.dataclass(frozen=True)
class _Killed:
    """That so many workers have died of a unit."""

    workers: int

    def together_with(self, before: "_Killed") -> Broken:
        """Given up, with what is said of it."""
        return Broken(f"{before.workers + self.workers} workers that began it died")


class _Running:
    """The units that a scheduler has, and what becomes of them."""

    def __init__(self, engine: DaskEngine, work: Callable[[Any, Any], Iterable[Any]], shared: Any) -> None:
        self._engine, self._work, self._shared = engine, work, shared
        # Of its own: others may use the same scheduler at the same time, for other work.
        self._name = f"potlp-{uuid.uuid4().hex}"
        self._numbers = itertools.count()
        self._reports: queue.SimpleQueue[distributed.Future] = queue.SimpleQueue()
        self._units: dict[distributed.Future, Any] = {}
        self._again: list[Any] = []

    def through(self, remaining: Iterator[Any], together: bool) -> Iterator[tuple[Any, list[Any] | _Killed]]:
        """All that remain, several at a time or each alone: given up at the last death, or before it."""
        prepared = False
        while True:
            try:
                if not prepared:
                    self._engine.prepare(self._name, self._shared, MOST_KILLED - 1 if together else 1)
                    prepared = True
                self._engine.look_after_workers()
                self._fill(remaining, _AHEAD * max(self._engine.workers, 1) if together else 1)
                if not self._units:
                    return
                ended = self._ended()
            # The scheduler was lost, in whatever was asked of it.
            except LOST as error:
                self._begin_again(error)
                prepared = False
                continue
            if ended is not None:
                unit, found = ended
                if isinstance(found, BaseException):
                    raise found
                yield unit, found

    def cancel(self) -> None:
        """Nobody waits for the rest."""
        # One that was closed first, as where an error ends everything, would never answer.
        with contextlib.suppress(Exception):
            if self._engine.client.status != "closed":
                self._engine.client.cancel(list(self._units), force=True)
                self._engine.restore(self._name)
        self._units.clear()

    def _fill(self, remaining: Iterator[Any], most: int) -> None:
        """Hand out units until there are so many."""
        while len(self._units) < most:
            # What was lost first.
            if not self._again:
                self._again += itertools.islice(remaining, 1)
            if not self._again:
                return
            # A unit that comes again has another key: Dask would otherwise give it its old result.
            key = f"{self._name}-{next(self._numbers)}"
            future = self._engine.client.submit(_done, self._work, self._name, self._again[-1], key=key)
            self._units[future] = self._again.pop()
            future.add_done_callback(self._reports.put)

    def _ended(self) -> tuple[Any, list[Any] | _Killed | BaseException] | None:
        """A unit that has ended; None where none has for a while."""
        try:
            future = self._reports.get(timeout=_LOOK)
        except queue.Empty:
            if any(future.status in ("cancelled", "lost") for future in self._units):
                raise ConnectionError("units were forgotten") from None
            return None
        # Reported by a scheduler that is gone: begun again already.
        if future not in self._units:
            return None
        if future.status not in ("finished", "error"):
            raise ConnectionError("a unit was forgotten")
        # The bytes travel only now; until they are here the unit counts as begun.
        found: list[Any] | _Killed | BaseException
        try:
            found = future.result()
        except KilledWorker as killed:
            # Not what was asked for: others may have asked the scheduler for more.
            found = _Killed(killed.allowed_failures + 1)
        except (_UnpreparedError, *LOST) as error:
            # Whether an error is the unit's or the cluster's is known by where it comes from.
            if future.status == "error" and not isinstance(error, _UnpreparedError):
                found = error
            else:
                raise ConnectionError("a unit was forgotten, or its scheduler what it was told") from error
        except Exception as error:
            found = error
        return self._units.pop(future), found

    def _begin_again(self, why: BaseException) -> None:
        """Everything that a scheduler had which was lost."""
        self._engine.reconnect(why)
        self._again += self._units.values()
        self._units.clear()


class _UnpreparedError(Exception):
    """The worker has not been told what units share."""


def _done(work: Callable[[Any, Any], Iterable[Any]], name: str, unit: Any) -> list[Any]:
    prepared = distributed.get_worker().plugins.get(name)
    if not isinstance(prepared, _Prepared):
        raise _UnpreparedError
    return list(work(prepared.shared, unit))


class _Allowed(NamedTuple):
    """What a run asks of a scheduler.

    Attributes:
        deaths: so many workers may die of a unit, and one more ends it.
        client: that the run is connected by; None of what was there before all runs.
    """

    deaths: int
    client: str | None


_ALLOWED: weakref.WeakKeyDictionary[Any, dict[str, _Allowed]] = weakref.WeakKeyDictionary()
"""Of a scheduler, in its own process: what each run allows, and under ``_BEFORE`` what was allowed before."""

_BEFORE = ""


def _give_up_after(deaths: int, name: str, client: str, dask_scheduler: Any) -> None:
    allowed = _ALLOWED.setdefault(dask_scheduler, {_BEFORE: _Allowed(dask_scheduler.allowed_failures, None)})
    # Dask counts those that are allowed.
    allowed[name] = _Allowed(deaths - 1, client)
    _allow_most(dask_scheduler)


def _give_up_as_before(name: str, dask_scheduler: Any) -> None:
    # A scheduler that came back after it was lost has not been told.
    if dask_scheduler in _ALLOWED:
        _ALLOWED[dask_scheduler].pop(name, None)
        _allow_most(dask_scheduler)


def _allow_most(dask_scheduler: Any) -> None:
    """The most that a run allows: of several that use a scheduler none gives a unit up before it is to."""
    allowed = _ALLOWED[dask_scheduler]
    before = allowed.pop(_BEFORE)
    # A run that was killed has not said that it is over, and its client is gone.
    runs = {name: entry for name, entry in allowed.items() if entry.client in dask_scheduler.clients}
    dask_scheduler.allowed_failures = max((entry.deaths for entry in runs.values()), default=before.deaths)
    if runs:
        _ALLOWED[dask_scheduler] = {_BEFORE: before, **runs}
    else:
        del _ALLOWED[dask_scheduler]


def _addresses(dask_scheduler: Any) -> list[str]:
    return list(dask_scheduler.workers)


def _has_page(dask_scheduler: Any) -> bool:
    return importlib.util.find_spec("bokeh") is not None and "dashboard" in dask_scheduler.services


class _Prepared(distributed.WorkerPlugin):
    """What a worker knows before its first unit."""

    def __init__(self, name: str, cores: tuple[int, ...], shared: Any) -> None:
        self.name, self._cores, self.shared = name, cores, shared

    def setup(self, worker: Any) -> None:
        """Keep to one core, and to what was compiled before."""
        # What a unit raises is raised again where its result is asked for, and told there.
        logging.getLogger("distributed.worker").addFilter(self._lets_pass)
        # An interrupt from the terminal reaches all processes, and the one that asked for the work ends the others. A
        # worker that is a thread of that one has nothing to ignore.
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        if self._cores and isinstance(worker.name, int):
            # Before XLA starts, which then uses one thread.
            os.sched_setaffinity(0, {self._cores[worker.name % len(self._cores)]})
        enable_compilation_cache()

    def teardown(self, worker: Any) -> None:
        """Let the worker say again what it said before."""
        logging.getLogger("distributed.worker").removeFilter(self._lets_pass)

    def _lets_pass(self, record: logging.LogRecord) -> bool:
        """Whether a worker says something else than that a unit of this run raised an error, with its traceback."""
        said = record.getMessage()
        # Keys of units hold the name of their run.
        return not (said.startswith("Compute Failed") and self.name in said)
