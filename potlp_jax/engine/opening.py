"""Engines by how they are asked for on the command line."""

import contextlib
import importlib
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from potlp_jax.engine.engine import Engine, Here
from potlp_jax.errors import EngineError


class BatchSystem(NamedTuple):
    """A batch system.

    Attributes:
        cluster: the class of dask-jobqueue.
        submit: the command that begins a job.
    """

    cluster: str
    submit: str


BATCH_SYSTEMS: Mapping[str, BatchSystem] = MappingProxyType(
    {
        "slurm": BatchSystem("SLURMCluster", "sbatch"),
        "pbs": BatchSystem("PBSCluster", "qsub"),
        "sge": BatchSystem("SGECluster", "qsub"),
        "lsf": BatchSystem("LSFCluster", "bsub"),
        "oar": BatchSystem("OARCluster", "oarsub"),
    }
)
"""By their name in ``--cluster``."""

SCHEDULERS: tuple[str, ...] = ("tcp", "tls", "ucx", "ws", "wss")
"""How addresses of a Dask scheduler begin."""

# Of a batch system's options, what other words mean to dask-jobqueue; which of its own are lists, and which numbers.
_WORDS = MappingProxyType({"partition": "queue"})
_LISTS = (
    *("job_extra_directives", "job_directives_skip", "job_script_prologue", "job_script_epilogue"),
    "worker_extra_args",
)
_NUMBERS = ("cores", "processes")
# The batch system keeps to the memory that a job has asked for. A worker of Dask would wait, near it, for memory that
# XLA never gives back.
_UNLIMITED = ("--memory-limit", "0")


def available_cores() -> tuple[int, ...]:
    """The cores that this process may use, which on a cluster are fewer than the machine has; empty: nobody knows."""
    return tuple(sorted(os.sched_getaffinity(0))) if hasattr(os, "sched_getaffinity") else ()


@contextlib.contextmanager
def open_engine(processes: int | None = 1, cluster: str | None = None) -> Iterator[Engine]:
    """An engine for the length of a block.

    Args:
        processes: 1 for this process, more for so many of this machine, None for one per core.
        cluster: ``tcp://HOST:PORT`` of a Dask scheduler, ``ssh:HOST,HOST``, or a batch system with options of
            dask-jobqueue such as ``slurm:partition=cpu,walltime=02:00:00,workers=64``; None for this machine.

    Raises:
        EngineError: there is no such cluster, or it cannot be begun.
    """
    if cluster is None:
        processes = processes or len(available_cores()) or os.cpu_count() or 1
        engine = Here() if processes == 1 else _local(processes)
    else:
        engine = _elsewhere(cluster)
    try:
        yield engine
    finally:
        engine.close()


def _local(processes: int) -> Engine:
    # Dask takes half a second to import, which commands that need none should not wait for.
    import dask.config
    from distributed import LocalCluster

    from potlp_jax.engine.cluster import SETTINGS, DaskEngine

    try:
        with dask.config.set(SETTINGS):
            cluster = LocalCluster(
                n_workers=processes,
                threads_per_worker=1,
                memory_limit=0,
                # A page of a machine's own work is nobody else's business.
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.ERROR,
            )
    except (OSError, RuntimeError) as error:
        raise EngineError(f"no workers could be started ({error}): give fewer --processes") from error
    return DaskEngine(cluster, available_cores())


def _elsewhere(cluster: str) -> Engine:
    from potlp_jax.engine.cluster import DaskEngine

    kind, _, rest = cluster.partition(":")
    if kind in SCHEDULERS:
        return DaskEngine(cluster)
    if kind == "ssh":
        return DaskEngine(_by_ssh([host for host in rest.split(",") if host]))
    if kind in BATCH_SYSTEMS:
        return DaskEngine(_of_batch_system(kind, _options(cluster, rest)))
    known = ", ".join(["tcp://HOST:PORT", "ssh:HOST,HOST", *(f"{name}:OPTION=VALUE,..." for name in BATCH_SYSTEMS)])
    raise EngineError(f"--cluster {cluster}: unknown; give one of {known}")


def _by_ssh(hosts: list[str]) -> Any:
    _require("asyncssh")
    from distributed import SSHCluster

    if not hosts:
        raise EngineError("--cluster ssh: name the machines, as in ssh:first,second")
    # The scheduler runs on the first one, beside its worker.
    options = {"nthreads": 1, "memory_limit": 0}
    return _begun(lambda: SSHCluster([hosts[0], *hosts], worker_options=options), f"by ssh on {', '.join(hosts)}")


def _of_batch_system(kind: str, options: dict[str, str]) -> Any:
    jobqueue = _require("dask_jobqueue")
    workers = _whole_number(options.pop("workers", "1"), f"--cluster {kind}: workers")
    given: dict[str, Any] = {_WORDS.get(name, name): value for name, value in options.items()}
    given |= {name: [given[name]] for name in _LISTS if name in given}
    given |= {name: _whole_number(given[name], f"--cluster {kind}: {name}") for name in _NUMBERS if name in given}
    given = {"cores": 1, "processes": 1, "memory": "4GB", **given}
    given["worker_extra_args"] = [*_UNLIMITED, *given.get("worker_extra_args", [])]
    # dask-jobqueue would go on without workers: what it says about a command that is missing is said in the background.
    system = BATCH_SYSTEMS[kind]
    if shutil.which(system.submit) is None:
        raise EngineError(f"--cluster {kind}: there is no {system.submit} here: give the command where jobs are begun")
    made = _begun(lambda: getattr(jobqueue, system.cluster)(**given), f"as jobs of {kind}")
    # Jobs that end before the work does, as at their time limit, are replaced.
    made.adapt(minimum_jobs=workers, maximum_jobs=workers)
    return made


def _begun(make: Any, how: str) -> Any:
    try:
        return make()
    except Exception as error:
        raise EngineError(f"workers cannot be begun {how}: {type(error).__name__}: {error}") from error


def _options(cluster: str, text: str) -> dict[str, str]:
    options = {}
    for entry in filter(None, text.split(",")):
        name, separator, value = entry.partition("=")
        if not separator or not name or not value:
            raise EngineError(f"--cluster {cluster}: {entry!r} is no OPTION=VALUE")
        options[name] = value
    return options


def _whole_number(text: str, what: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise EngineError(f"{what}: give a whole number of at least 1, found {text}")
    return int(text)


def _require(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise EngineError(f"this needs {module}: pip install 'potlp-jax[cluster]'") from error
