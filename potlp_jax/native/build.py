"""From C++ sources to a shared library in the user's cache, by the system's compiler.

Compiled on the user's machine, and not shipped compiled, because then the package stays one file for all systems, the
headers are always those of the jaxlib that is installed, the kernels use all that the processor offers, and installing
needs no compiler. Numba would tie the versions of Python and NumPy and compiles for longer than a C++ compiler does.

A library's file name holds a hash of all that it was made from, and one of its own bytes: what is outdated, broken or
half written is never loaded. Any number of processes may build at the same time: each writes a file of its own and
renames it.
"""

import atexit
import dataclasses
import hashlib
import importlib.metadata
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from potlp_jax.cache import SWITCH as CACHE_SWITCH
from potlp_jax.cache import cache_folder, is_private_folder, is_switched_on

KERNELS: Path = Path(__file__).parent / "kernels"
"""Where the sources lie."""

# No contraction to fused multiply-adds and no fast mathematics: a kernel rounds as its twin does.
FLAGS: tuple[str, ...] = ("-std=c++17", "-O3", "-march=native", "-ffp-contract=off", "-shared", "-fPIC", "-w")

COMPILERS: tuple[str, ...] = ("c++", "g++", "clang++")
"""Tried in this order, unless the environment variable CXX names one, with words such as ``ccache`` if need be."""

MOST_SECONDS: float = 300.0
"""What takes longer to compile is given up."""

_DIGEST_CHARACTERS = 16


class BuildError(Exception):
    """A library could not be built; the message says why. Never leaves the package: the twin runs instead."""


class NoCompilerError(BuildError):
    """There is no compiler, which is no fault: nothing here needs one."""


@dataclasses.dataclass(frozen=True)
class Compiler:
    """A C++ compiler.

    Attributes:
      command: the program's path, and words that always follow it.
      version: all that it says of itself.
    """

    command: tuple[str, ...]
    version: str


def find_compiler() -> Compiler:
    """The system's C++ compiler, or the one that CXX names.

    Raises:
      NoCompilerError: there is none, and none was named.
      BuildError: the one that was named cannot be found, or the compiler does not run.
    """
    chosen = os.environ.get("CXX", "").strip()
    command = _named_command(chosen) if chosen else _first_command(COMPILERS)
    return Compiler(command=command, version=_run([*command, "--version"]))


def _first_command(names: Sequence[str]) -> tuple[str, ...]:
    path = next((found for found in map(shutil.which, names) if found), None)
    if path is None:
        raise NoCompilerError(f"no C++ compiler: none of {', '.join(names)} is on PATH")
    return (path,)


def _named_command(chosen: str) -> tuple[str, ...]:
    """The command that CXX names: a program whose path may have spaces, or one with words behind it."""
    try:
        choices = [[chosen], shlex.split(chosen)]
    # A quote that is never closed.
    except ValueError as error:
        raise BuildError(f"CXX is {chosen!r}, which is no command: {error}") from error
    for program, *words in choices:
        path = shutil.which(program)
        if path is not None:
            return (path, *words)
    raise BuildError(f"CXX is {chosen!r}, and {choices[-1][0]!r} cannot be found")


def built_library(name: str) -> Path:
    """The shared library made from ``kernels/NAME.cc``, compiled if the cache does not hold it.

    Args:
      name: of the source, without ``.cc``.

    Returns:
      Its file: in the cache, or in a temporary folder of this process where the cache is switched off or not private.

    Raises:
      BuildError: there is no compiler, or it fails.
    """
    compiler = find_compiler()
    prefix = f"{name}-{_key(name, compiler)}-"
    folder = _folder()
    for file in sorted(folder.glob(f"{prefix}*.so")):
        if file.stem == prefix + _digest(file.read_bytes()):
            return file
        # Broken, as by a full disk.
        file.unlink(missing_ok=True)
    return _compile(name, compiler, folder, prefix)


def _folder() -> Path:
    """Where libraries are kept."""
    # Whoever can write to the folder can run code here.
    cache = None if is_switched_on(CACHE_SWITCH) else cache_folder()
    if cache is not None and is_private_folder(cache) and is_private_folder(cache / "native"):
        return cache / "native"
    folder = tempfile.mkdtemp(prefix="potlp-native-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _key(name: str, compiler: Compiler) -> str:
    """All that the library depends on besides the processor, which the cache's folder is for."""
    sources = [KERNELS / f"{name}.cc", *sorted(KERNELS.glob("*.h"))]
    texts = [source.read_text("utf-8") for source in sources]
    return _digest(
        "\0".join([*texts, *compiler.command, compiler.version, *FLAGS, importlib.metadata.version("jaxlib")]).encode()
    )


def _compile(name: str, compiler: Compiler, folder: Path, prefix: str) -> Path:
    import jax.ffi

    # Of this process alone, in the same folder, so that the rename is atomic.
    handle, text = tempfile.mkstemp(prefix=f"{name}-", suffix=".part", dir=folder)
    os.close(handle)
    part = Path(text)
    try:
        # The headers as the system's: their warnings are nobody's here.
        headers = ["-isystem", jax.ffi.include_dir(), f"-I{KERNELS}"]
        _run([*compiler.command, *FLAGS, *headers, str(KERNELS / f"{name}.cc"), "-o", text])
        file = folder / f"{prefix}{_digest(part.read_bytes())}.so"
        part.rename(file)
    finally:
        part.unlink(missing_ok=True)
    return file


def _run(command: list[str]) -> str:
    """What a command prints. Raises BuildError if it fails."""
    try:
        result = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=MOST_SECONDS)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"{command[0]} cannot be run: {error}") from error
    if result.returncode != 0:
        raise BuildError(f"{command[0]} failed: {result.stderr.strip() or f'exit status {result.returncode}'}")
    return result.stdout


def _digest(contents: bytes) -> str:
    return hashlib.sha256(contents).hexdigest()[:_DIGEST_CHARACTERS]
