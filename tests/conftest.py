"""Strict modes for every test: no silent rank promotion, no silent dtype promotion."""

import atexit
import importlib.metadata
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

# Nearly all of the suite's time is compilation. XLA's optimiser takes half of it, and the newer emitters of fused loops
# a third of what is left. XLA refuses to start with a flag that it does not know, so the second is for the pinned
# version alone. Before jax is imported; the processes that tests start inherit both. XLA_FLAGS="" in the environment
# runs the suite with the optimiser.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    if importlib.metadata.version("jaxlib").startswith("0.10.")
    else "--xla_backend_optimization_level=0",
)

import jax
import pytest
from hypothesis import Phase, settings

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


@pytest.fixture(scope="module", autouse=True)
def forget_programs() -> Iterator[None]:
    """Compiled programs go when their module is done: a worker's memory would grow to several gigabytes."""
    yield
    jax.clear_caches()
