"""Compiled programs kept between processes: jax's persistent compilation cache, for programs' entry points.

Importing the package never turns the cache on; ``potlp`` and the scripts in ``eval/`` do, unless the environment
variable ``POTLP_NO_CACHE`` is set. A cache made on one machine is never read on another: compiled code uses what the
processor offers, so each kind of processor has its own folder.
"""

import contextlib
import hashlib
import importlib
import os
import platform
import re
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

SWITCH: str = "POTLP_NO_CACHE"
"""Environment variable that turns the cache off, whatever its value unless empty or 0."""

LEAST_COMPILE_SECONDS: float = 0.5
"""What compiles faster is not worth a file."""

_TUNING = re.compile(rb"Target machine feature \+prefer-no-(gather|scatter) is not")
_stderr = threading.Lock()


def enable_compilation_cache(folder: Path | None = None) -> Path | None:
    """Keep compiled programs in ``folder`` (default: ``cache_folder()``) and use those that are there.

    A cache that jax has been given already, as by JAX_COMPILATION_CACHE_DIR, stays in use. A folder that cannot be
    made, or that others may write to, is not used: whoever can write there can run code here.

    Returns:
      The folder in use; None where there is none.
    """
    if os.environ.get(SWITCH, "0") not in ("", "0"):
        return None
    chosen = jax.config.values["jax_compilation_cache_dir"]
    if chosen:
        return Path(chosen)
    folder = cache_folder() if folder is None else folder
    if not _is_private_folder(folder):
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_COMPILE_SECONDS)
    _hide_tuning_messages()
    return folder


def cache_folder() -> Path:
    """The user's cache folder for this kind of machine: ``$XDG_CACHE_HOME`` or ``~/.cache``, then ``potlp-jax``."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(base) if base else Path.home() / ".cache"
    return root / "potlp-jax" / machine_fingerprint()


def machine_fingerprint() -> str:
    """The same for processors that offer the same instructions. jax's own keys tell versions and flags apart."""
    words = {platform.system(), platform.machine(), platform.processor()}
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
        told = (line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part")))
        words.update(told)
    return hashlib.sha256("\n".join(sorted(words)).encode()).hexdigest()[:16]


def _is_private_folder(folder: Path) -> bool:
    """Make the folder if it is not there; whether it can be used and nobody else may write to it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except OSError:
        return False
    own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    return own and not found.st_mode & 0o022 and os.access(folder, os.W_OK)


def _hide_tuning_messages() -> None:
    """Keep XLA from reporting each program that it loads on some Intel processors.

    There it takes two compiler preferences (no gather, no scatter) for instructions that the processor lacks, and
    writes a page on them to stderr, although the program was compiled on the same machine and is used
    (https://github.com/openxla/xla/issues/44565). Any other message passes.
    """
    try:
        cache: Any = importlib.import_module("jax._src.compilation_cache")
    except ImportError:  # not part of jax's public interface: without it the messages merely show
        return
    load = getattr(cache, "get_executable_and_time", None)
    if load is None or load.__name__ == "load_quietly":
        return

    def load_quietly(*arguments: Any, **options: Any) -> Any:
        with _without_tuning_messages():
            return load(*arguments, **options)

    cache.get_executable_and_time = load_quietly


@contextlib.contextmanager
def _without_tuning_messages() -> Iterator[None]:
    """Hold back what is written to stderr, by C++ too, and pass it on without the lines on tuning."""
    with _stderr, tempfile.TemporaryFile() as held:
        stderr = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            held.seek(0)
            for line in held:
                if not _TUNING.search(line):
                    os.write(2, line)
