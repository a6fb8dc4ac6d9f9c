"""Strict modes for every test, and how each module's programs are compiled.

No silent rank promotion, no silent dtype promotion. Modules marked ``optimised`` are compiled as users' programs are;
those marked ``numbers`` too by ``make numbers``, which is part of CI.
"""

import atexit
import importlib.metadata
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from hypothesis import Phase, settings
from jax._src import compiler

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# The same examples in every run; HYPOTHESIS_PROFILE=default draws new ones.
settings.register_profile("same", derandomize=True)
# The first failure is enough to know that a mutant is caught (`eval.mutants`): nobody reads its smallest example.
settings.register_profile("mutants", derandomize=True, phases=[Phase.explicit, Phase.generate])
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


# Within one run the same program is compiled once, whichever test needs it first: the process that begins the run makes
# a cache for itself and its workers, and takes it away.
_CACHE = "POTLP_TEST_CACHE"
if _CACHE not in os.environ:
    os.environ[_CACHE] = tempfile.mkdtemp(prefix="potlp-tests-")
    atexit.register(shutil.rmtree, os.environ[_CACHE], ignore_errors=True)
jax.config.update("jax_compilation_cache_dir", os.environ[_CACHE])


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
        "markers", "optimised: the module compares numbers, so it and the processes it starts run with XLA's optimiser"
    )


@pytest.fixture(scope="module", autouse=True)
def compiled_as_marked(request: pytest.FixtureRequest) -> Iterator[None]:
    """XLA's optimiser is on in modules marked ``optimised``, or in all by an option; off in what collecting compiles.

    Each module begins without compiled programs: some are of the other kind, and a worker's memory would grow to
    several gigabytes.
    """
    jax.clear_caches()
    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("optimised") or request.config.getoption("optimised"):
            patch.setattr(compiler, "get_compile_options", _compile_options)
        else:
            flags = " ".join(f"--{name}={str(value).lower()}" for name, value in _UNOPTIMISED.items())
            patch.setenv("XLA_FLAGS", f"{flags} {_XLA_FLAGS}".strip())
        yield
