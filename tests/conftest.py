"""Strict modes for every test, and how each module's programs are compiled.

No silent rank promotion, no silent dtype promotion. Modules marked ``optimised`` are compiled as users' programs are;
those marked ``numbers`` too by ``make numbers``, which is part of CI, as ``make long`` is.
"""

import atexit
import ctypes
import functools
import gc
import importlib.metadata
import importlib.util
import logging
import os
import shutil
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TypeVar

import jax
import pytest
from hypothesis import Phase, settings
from jax._src import compiler
from jaxtyping import _array_types as jaxtyping_annotations
from jaxtyping import _decorator as jaxtyping_decorator

_Report = TypeVar("_Report", pytest.TestReport, pytest.CollectReport)

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# The same examples in every run; HYPOTHESIS_PROFILE=default draws new ones.
settings.register_profile("same", derandomize=True)
# The first failure is enough to know that a mutant is caught (`eval.mutants`): nobody reads its smallest example.
settings.register_profile("mutants", derandomize=True, phases=[Phase.explicit, Phase.generate])
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


# jaxtyping and beartype write a checker for a function whenever its ``def`` is executed: a function within a function
# costs milliseconds, and memory that is never freed, at each call of the outer one. The signature alone decides on the
# checker, so that it is written once for each; for that, equal annotations must be the same object.
def _once_per_signature(make):
    made = functools.cache(make)

    @functools.wraps(make)
    def make_or_reuse(*arguments, **options):
        try:
            return made(*arguments, **options)
        except TypeError:  # A default that cannot be hashed, or an annotation that is refused.
            return make(*arguments, **options)

    return make_or_reuse


for _module, _name in (
    (jaxtyping_annotations, "_make_array"),
    (jaxtyping_decorator, "_make_fn_with_signature"),
    (jaxtyping_decorator, "_apply_typechecker"),
):
    setattr(_module, _name, _once_per_signature(getattr(_module, _name)))


# Within one run the same program is compiled once, whichever test needs it first: the process that begins the run makes
# a cache for itself and its workers, and takes it away.
_CACHE = "POTLP_TEST_CACHE"
if _CACHE not in os.environ:
    os.environ[_CACHE] = tempfile.mkdtemp(prefix="potlp-tests-")
    atexit.register(shutil.rmtree, os.environ[_CACHE], ignore_errors=True)
jax.config.update("jax_compilation_cache_dir", os.environ[_CACHE])
# Each module forgets its programs (`compiled_as_marked`), so that what compiles in less than jax's second is met often.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@pytest.fixture(scope="session")
def external_data() -> Path:
    """Folder with maps and reference data made by others; tests that need it are skipped without it."""
    folder = os.environ.get("POTLP_EXTERNAL_DATA")
    if not folder:
        pytest.skip("POTLP_EXTERNAL_DATA is not set: data made by others is not part of the repository")
    return Path(folder)


# Nearly all of the suite's time is compilation. XLA's optimiser takes most of it, and the newer emitters of fused loops
# half of what is left. XLA refuses a flag that it does not know, so the second is for the pinned version alone.
_UNOPTIMISED: dict[str, int | bool] = {"xla_backend_optimization_level": 0}
if importlib.metadata.version("jaxlib").startswith("0.10."):
    _UNOPTIMISED["xla_cpu_use_fusion_emitters"] = False

# XLA reads its flags once in a process. It does so here, because `compiled_as_marked` sets flags for the processes that
# tests start, which are not for this one.
_XLA_FLAGS = os.environ.get("XLA_FLAGS", "")
jax.devices()

# No public setting does this for all programs of a process and can be changed: `jax_disable_most_optimizations` leaves
# the emitters on, `compiler_options` belongs to one `jax.jit`. `test_optimiser.py` and `test_unoptimised.py` notice a
# version of jax in which this does nothing.
_compile_options = compiler.get_compile_options


def _unoptimised_options(*arguments, env_options_overrides=None, **options):
    overrides = {**_UNOPTIMISED, **(env_options_overrides or {})}
    return _compile_options(*arguments, env_options_overrides=overrides, **options)


compiler.get_compile_options = _unoptimised_options


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--optimised", action="store_true", help="compile every module with XLA's optimiser")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", "numbers: the module compares numbers and takes minutes to optimise; `make numbers` does"
    )
    config.addinivalue_line(
        "markers",
        "long: the test takes many seconds; `make long` runs it, or `make numbers` where its module has that mark",
    )
    config.addinivalue_line(
        "markers", "optimised: the module compares numbers, so it and the processes it starts run with XLA's optimiser"
    )


# There is no wheel of Spot for the newest Python. What needs it cannot be tested there, wherever in a test, or in a
# command that the test runs, the formula is made.
_HAS_SPOT = importlib.util.find_spec("spot") is not None
_NEEDS_SPOT = "this formula needs Spot, which is not installed"


def _skipped_without_spot(report: _Report) -> _Report:
    """The report of a test, or of a module that is collected; skipped where it failed by a formula without Spot."""
    told = (report.longreprtext, *(text for _, text in report.sections))
    if report.failed and not _HAS_SPOT and any(_NEEDS_SPOT in text for text in told):
        report.outcome = "skipped"
        report.longrepr = (report.nodeid.partition("::")[0], 0, f"Skipped: {_NEEDS_SPOT}")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return _skipped_without_spot((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return _skipped_without_spot((yield))


# glibc's alone: it keeps freed memory, most of it XLA's compiler's, for the thread that had it.
_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None)


def _forget_programs() -> None:
    """Free what earlier modules compiled, and give the memory back to the system."""
    jax.clear_caches()
    gc.collect()
    if _TRIM is not None:
        _TRIM(0)


# Two workers and the processes that they start then fit into a small machine. A test adds up to half a gigabyte.
_MOST_RESIDENT = 1.25e9
# What forgetting did not give back stays: without room above it every test would begin without programs. But a process
# may have 2 GB at most, with what one test adds.
_ROOM, _LIMIT = 0.3e9, 1.6e9
_STATM = Path("/proc/self/statm")
_kept = 0.0


def _resident() -> float:
    return int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if _STATM.exists() else 0.0


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown() -> None:
    """A module with programs of many shapes begins anew where they take too much memory."""
    global _kept
    if _resident() > min(max(_MOST_RESIDENT, _kept + _ROOM), _LIMIT):
        _forget_programs()
        _kept = _resident()


@pytest.fixture(autouse=True)
def as_much_is_logged_as_before() -> Iterator[None]:
    """A command that is run within the process may be told to be quiet; the next test is not."""
    package = logging.getLogger("potlp_jax")
    level = package.level
    yield
    package.setLevel(level)


@pytest.fixture(scope="module", autouse=True)
def compiled_as_marked(request: pytest.FixtureRequest) -> Iterator[None]:
    """XLA's optimiser is on in modules marked ``optimised``, or in all by an option; off in what collecting compiles.

    Each module begins without compiled programs: some are of the other kind, and a worker's memory would grow to
    several gigabytes.
    """
    _forget_programs()
    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("optimised") or request.config.getoption("optimised"):
            patch.setattr(compiler, "get_compile_options", _compile_options)
        else:
            flags = " ".join(f"--{name}={str(value).lower()}" for name, value in _UNOPTIMISED.items())
            patch.setenv("XLA_FLAGS", f"{flags} {_XLA_FLAGS}".strip())
        yield
