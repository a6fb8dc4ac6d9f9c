"""What the engine costs: units that sleep, on many simulated workers, and the rate at which one driver writes rows."""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from distributed import LocalCluster

from potlp_jax.engine.cluster import DaskEngine
from potlp_jax.sweep.runner import RESULTS
from potlp_jax.sweep.store import Item, Row, Store


def sleep(shared: float, unit: int) -> Iterator[int]:
    """A unit of so many seconds."""
    time.sleep(shared)
    yield unit


def efficiency(workers: int, seconds: float, each: int) -> dict[str, Any]:
    """Share of their time that workers spend in units.

    Args:
        workers: threads of this process, each a worker of its own to Dask.
        seconds: of a unit.
        each: units for each worker.
    """
    units = workers * each
    options = {"processes": False, "dashboard_address": "127.0.0.1:0", "memory_limit": 0}
    # Not as a context, of which type checkers know the asynchronous one alone.
    cluster = LocalCluster(n_workers=workers, threads_per_worker=1, **options)
    engine = DaskEngine(cluster)
    try:
        # Connections are made before the clock starts.
        list(engine.run(sleep, 0.0, range(workers)))
        began = time.perf_counter()
        found = {unit for unit, _ in engine.run(sleep, seconds, range(units))}
        wall = time.perf_counter() - began
    finally:
        engine.close()
    assert found == set(range(units))
    return {
        "workers": workers,
        "seconds": seconds,
        "units": units,
        "wall": wall,
        "efficiency": units * seconds / (workers * wall),
    }


def row(number: int) -> Row:
    """A row as long as most are."""
    item = Item("firefighting", "(!fire U extinguisher) & F exit", ("baseline", "potlp")[number % 2], number // 2)
    return Row(
        item=item,
        outcome="satisfied",
        cost=number / 7,
        budget=1000.0,
        steps=300,
        decisions=60,
        fallbacks=0,
        status=0,
        key=(0, number),
        path="30,3:" + "07" * 150,
        configuration="0123456789ab",
        versions={"jax": "0.10.1", "numpy": "2.4.6", "potlp-jax": "0.1.0"},
        commit="0" * 40,
        seconds=1.0,
        world_digest="0123456789abcdef",
    )


def store_of(rows: int, per_commit: int = 32) -> dict[str, Any]:
    """A store with so many rows: how fast they are written, and how long it takes to open and to read it."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / RESULTS
        store = Store(file)
        began = time.perf_counter()
        for first in range(0, rows, per_commit):
            store.finish([row(number) for number in range(first, min(first + per_commit, rows))])
        written = time.perf_counter() - began
        store.close()
        found: dict[str, Any] = {
            "rows": rows,
            "rows_a_second": rows / written,
            "bytes_a_row": file.stat().st_size / rows,
        }
        began = time.perf_counter()
        store = Store(file, read_only=True)
        found["seconds_to_open"] = time.perf_counter() - began
        began = time.perf_counter()
        assert len(store.items()) == rows
        found["seconds_to_resume"] = time.perf_counter() - began
        began = time.perf_counter()
        assert len(store.rows()) == rows
        found["seconds_to_read"] = time.perf_counter() - began
        store.close()
    return found
