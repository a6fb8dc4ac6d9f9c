"""Compiled programs kept between processes: jax's persistent compilation cache, for programs' entry points.

Importing the package never turns the cache on; ``potlp`` and the scripts in ``eval/`` do, unless the environment
variable ``POTLP_NO_CACHE`` is set. A cache made on one machine is never read on another: compiled code uses what the
processor offers, so each kind of processor has its own folder.
"""

import contextlib
import hashlib
import os
import platform
from pathlib import Path

SWITCH: str = "POTLP_NO_CACHE"
"""Environment variable that turns the cache off, whatever its value unless empty or 0."""

LEAST_COMPILE_SECONDS: float = 0.5
"""What compiles faster is not worth a file."""

# Linux says there, of each processor, what it is and what it can do, on x86 and on ARM. The model decides what the
# compiler prefers.
_PROCESSORS = Path("/proc/cpuinfo")
_TOLD = ("cpu family", "model", "flags", "Features", "CPU implementer", "CPU part")

LOG_LEVEL: str = "TF_CPP_MIN_LOG_LEVEL"
"""Environment variable from which XLA takes the least severe messages that it writes (3: none but fatal ones)."""


def enable_compilation_cache(folder: Path | None = None) -> Path | None:
    """Keep compiled programs in ``folder`` (default: ``cache_folder()``) and use those that are there.

    A cache that jax has been given already, as by JAX_COMPILATION_CACHE_DIR, stays in use. A folder that cannot be
    made, or that others may write to, is not used: whoever can write there can run code here. This also keeps XLA's
    messages on loaded programs from stderr.

    Returns:
      The folder in use; None where there is none.
    """
    if is_switched_on(SWITCH):
        return None
    # Imported here, so that programs that only offer the cache start without jax.
    import jax

    _quiet_xla()
    chosen = jax.config.values["jax_compilation_cache_dir"]
    if chosen:
        return Path(chosen)
    folder = cache_folder() if folder is None else folder
    if folder is None or not is_private_folder(folder):
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_COMPILE_SECONDS)
    return folder


def cache_folder() -> Path | None:
    """The user's cache folder for this kind of machine: ``$XDG_CACHE_HOME`` or ``~/.cache``, then ``potlp-jax``.

    None for a user without a home, as in a container that runs under a number.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        root = Path(base) if base else Path.home() / ".cache"
    except RuntimeError:
        return None
    return root / "potlp-jax" / machine_fingerprint()


def machine_fingerprint() -> str:
    """The same for processors that offer the same instructions. jax's own keys tell versions and flags apart."""
    # The same model in a virtual machine may offer fewer instructions, so its flags count as well as its name.
    words = {platform.system(), platform.machine(), platform.processor()}
    with contextlib.suppress(OSError), _PROCESSORS.open(encoding="utf-8", errors="replace") as lines:
        words.update(line for line in lines if line.startswith(_TOLD))
    return hashlib.sha256("\n".join(sorted(words)).encode()).hexdigest()[:16]


def is_switched_on(variable: str) -> bool:
    """Whether an environment variable is set, and neither empty nor 0."""
    return os.environ.get(variable, "0") not in ("", "0")


def is_private_folder(folder: Path) -> bool:
    """Make the folder if it is not there; whether it can be used and nobody else may write to it."""
    # Mode 700 at once, and tested afterwards: the folder may have been there before.
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except OSError:
        return False
    # Windows has neither owners nor these modes; there the user's profile is private.
    own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    return own and not found.st_mode & 0o022 and os.access(folder, os.W_OK)


def _quiet_xla() -> None:
    """Keep XLA from reporting each program that it loads from the cache, here and in processes that this one starts.

    On many processors XLA takes two of its compiler's preferences (no gather, no scatter) for instructions that the
    processor lacks. It then writes a page on them to stderr for each program, although the program was compiled on the
    same machine and runs (https://github.com/openxla/xla/issues/44565). The messages are of level "error"; failures are
    raised as exceptions and are not affected. A level that the user has chosen stays.
    """
    import jax

    # jax sets 1 where nobody has set another, and its own level is that of its loggers.
    if os.environ.get(LOG_LEVEL, "1") != "1" or jax.config.values["jax_logging_level"] not in (None, "NOTSET"):
        return
    os.environ[LOG_LEVEL] = "3"
    # XLA has read the variable when jax was imported. To set no level undoes that of Python's loggers and not XLA's.
    jax.config.update("jax_logging_level", "CRITICAL")
    jax.config.update("jax_logging_level", "NOTSET")
