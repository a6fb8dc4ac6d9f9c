"""How long a function takes: tracing, compiling and running apart, medians of repeats.

    timing = measure(plan_actions, problem, key, config, repeats=5, static_argnums=2)
    print(timing.compile_s, timing.run_s)

Every measurement traces and compiles anew: jax's caches are emptied first, and its persistent cache is left out.
"""

import contextlib
import dataclasses
import importlib.metadata
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache


@dataclasses.dataclass(frozen=True)
class Timing:
    """What one function cost.

    Attributes:
      trace_s: seconds to trace the function and to lower it to StableHLO.
      compile_s: seconds that XLA took.
      runs_s: seconds of each timed run, in order, each to the end of the last device operation.
      memory: bytes by ``memory_analysis`` of the compiled program (``arguments``, ``outputs``, ``temporaries``,
        ``code``), or None where the platform offers none.
    """

    trace_s: float
    compile_s: float
    runs_s: tuple[float, ...]
    memory: dict[str, int] | None

    @property
    def run_s(self) -> float:
        """Median of the runs in seconds."""
        return statistics.median(self.runs_s)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able, with the median and the spread of the runs."""
        return {
            "trace_s": self.trace_s,
            "compile_s": self.compile_s,
            "run_s": self.run_s,
            "run_min_s": min(self.runs_s),
            "run_max_s": max(self.runs_s),
            "repeats": len(self.runs_s),
            "memory": self.memory,
        }


@dataclasses.dataclass(frozen=True)
class CompiledCall:
    """A function compiled for, and bound to, its arguments."""

    run: Callable[[], Any]
    trace_s: float
    compile_s: float
    memory: dict[str, int] | None

    def timing(self, repeats: int) -> Timing:
        """Run once to warm up, then ``repeats`` times with the clock running."""
        if repeats < 1:
            raise ValueError(f"repeats is {repeats}, must be at least 1")
        # The first run allocates, and on some platforms still compiles.
        jax.block_until_ready(self.run())
        return Timing(self.trace_s, self.compile_s, timed_runs(self.run, repeats), self.memory)


def measure(
    function: Callable[..., Any],
    *arguments: Any,
    repeats: int = 5,
    static_argnums: int | Sequence[int] = (),
) -> Timing:
    """Compile ``function`` for the arguments, run it once to warm up, then time ``repeats`` runs.

    Args:
      function: what to measure; it is jitted as it stands. Jitted parts of it become parts of one program.
      arguments: what to call it with, static ones included.
      repeats: timed runs.
      static_argnums: positions of arguments that are configuration rather than arrays.

    Returns:
      The times of tracing, compiling and each run.
    """
    return compile_call(function, *arguments, static_argnums=static_argnums).timing(repeats)


def compile_call(
    function: Callable[..., Any], *arguments: Any, static_argnums: int | Sequence[int] = ()
) -> CompiledCall:
    """Trace and compile ``function`` for the arguments, with the clock running; nothing is run yet.

    Side effect: all functions that the process has compiled before are forgotten, so that none of their parts makes
    this measurement shorter.

    Args:
      function: what to compile.
      arguments: what to call it with, static ones included.
      static_argnums: positions of arguments that are configuration rather than arrays.

    Returns:
      The compiled call with the seconds that it took to make.
    """
    # Static arguments are closed over; what jax compiles is a function of arrays alone.
    static = (static_argnums,) if isinstance(static_argnums, int) else tuple(static_argnums)
    dynamic = [None if index in static else argument for index, argument in enumerate(arguments)]
    leaves, structure = jax.tree.flatten(dynamic)
    results: list[Any] = []

    # Of plain arrays to plain arrays: jax describes compiled arguments by what classes that check types do not take.
    def flat(*leaves: Any) -> list[Any]:
        filled = list(jax.tree.unflatten(structure, leaves))
        for index in static:
            filled[index] = arguments[index]
        outputs, results[:] = _flatten(function(*filled))
        return outputs

    # A jitted part that was compiled before would be taken from the cache and missing from the clock.
    jax.clear_caches()
    with _without_persistent_cache():
        # Tracing and lowering are Python's work and grow with the size of the program; compiling is XLA's.
        start = time.perf_counter()
        lowered = jax.jit(flat).lower(*leaves)
        traced = time.perf_counter()
        compiled = lowered.compile()
        done = time.perf_counter()
    # Inputs are on the device before the clock of a run starts.
    placed = jax.block_until_ready(jax.device_put(leaves))

    def run() -> Any:
        return jax.tree.unflatten(results[0], compiled(*placed))

    return CompiledCall(run, traced - start, done - traced, _memory_of(compiled))


def _flatten(outputs: Any) -> tuple[list[Any], list[Any]]:
    """Leaves, and the structure in a list."""
    leaves, structure = jax.tree.flatten(outputs)
    return leaves, [structure]


def timed_runs(run: Callable[[], Any], repeats: int) -> tuple[float, ...]:
    """Seconds of each of ``repeats`` runs; a run ends when its results are ready. For code other than jax's as well."""
    # Every run is waited for: jax returns as soon as work is queued.
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - start)
    return tuple(seconds)


def environment() -> dict[str, Any]:
    """Where a measurement was made: versions, processor, and the cores that this process may use. JSON-able.

    XLA starts as many threads as the process may use cores when jax is first used: pinned to one core, it is
    single-threaded.
    """
    device = jax.devices()[0]
    # What decides about times: versions, processor, threads and XLA's flags.
    usable = usable_cores()
    return {
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxlib": importlib.metadata.version("jaxlib"),
        "numpy": np.__version__,
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "usable_cores": usable,
        "threads": "one" if usable == 1 else "default",
        "platform": device.platform,
        "device": device.device_kind,
        "devices": jax.device_count(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


# Pinned processes and containers have fewer cores than the machine.
def usable_cores() -> int | None:
    """Cores that this process may run on, None where the system does not tell."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count()


def processor_name() -> str:
    """The processor's model as Linux names it, elsewhere what Python knows."""
    # ``platform.processor`` is empty on most Linux systems.
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor()


@contextlib.contextmanager
def _without_persistent_cache() -> Iterator[None]:
    """Compile for real, also where the process uses jax's persistent cache."""
    enabled = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    # jax decides once whether it uses the cache; reset makes it decide again.
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", enabled)
        compilation_cache.reset_cache()


def _memory_of(compiled: jax.stages.Compiled) -> dict[str, int] | None:
    """Bytes of a compiled program, None where the platform does not tell."""
    # Not every backend implements the analysis, and some return nothing.
    try:
        analysis = compiled.memory_analysis()
    except (NotImplementedError, jax.errors.JaxRuntimeError):
        return None
    if analysis is None:
        return None
    return {
        "arguments": int(analysis.argument_size_in_bytes),
        "outputs": int(analysis.output_size_in_bytes),
        "temporaries": int(analysis.temp_size_in_bytes),
        "code": int(analysis.generated_code_size_in_bytes),
    }
