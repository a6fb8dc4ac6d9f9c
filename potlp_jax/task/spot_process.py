"""Spot in a process of its own (``task.spot_child``): what it does with a formula has limits of time and memory.

The process is begun by the first question and serves all later ones, in some milliseconds each. It ends with the one
that asked, whatever ends that one.
"""

import atexit
import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
from typing import Any

from potlp_jax.errors import SpotMissingError, TaskError
from potlp_jax.task import spot_child

_INSTALL_SPOT = (
    "install it with 'pip install spottl' (Linux x86_64, Python up to 3.13; the PyPI package 'spot' is something "
    "else) or elsewhere with 'conda install -c conda-forge spot'; formulas of shipped tasks, however they are written, "
    "and HOA files need no Spot"
)

SIMPLER: str = "leave parts out, or give them an order, as F(a & F b) does where F a & F b leaves it open"
"""What to do where a formula is too large: the automaton doubles with each part that may come at any time."""


class _SpotProcess:
    """A running process. One thread asks at a time."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self._lock = threading.Lock()
        # -P: the folder of the program holds modules of ours, with names that other libraries use too.
        self._process = subprocess.Popen(
            [sys.executable, "-P", spot_child.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            encoding="utf-8",
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PYTHONIOENCODING": "utf-8"},
        )
        # The process ends when its input does, so that this one may also end without a word.
        atexit.register(self.close)
        self.state = self._read()

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()

    def ask(self, ask: str, formula: str) -> Any:
        """The answer; None if the process has ended over the question."""
        with self._lock:
            try:
                print(json.dumps({"ask": ask, "formula": formula}), file=self._process.stdin, flush=True)
                return self._read()
            # An interrupt would leave an answer behind, for the next question to find.
            except BaseException:
                self.close()
                raise

    @property
    def ran_out_of_time(self) -> bool:
        """Whether it was the limit of time that ended the process."""
        return self._process.wait() == -signal.SIGPROF

    @property
    def is_alive(self) -> bool:
        return self._process.poll() is None

    def _read(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        return json.loads(line) if line else None


_running: _SpotProcess | None = None


def ask_spot(ask: str, formula: str) -> dict[str, Any]:
    """One question about a formula; ``task.spot_child`` describes questions and answers.

    Args:
        ask: ``parse`` or ``translate``.
        formula: in Spot's syntax.

    Returns:
        The answer.

    Raises:
        TaskError: the formula needs more time or memory than there is for one.
        SpotMissingError: Spot is missing, or another package of that name is installed.
    """
    process = _ready_process()
    answer = process.ask(ask, formula)
    if answer is None:
        what = "read" if ask == "parse" else "translate"
        why = (
            f"takes Spot more than {spot_child.SECONDS:g} s of computing"
            if process.ran_out_of_time
            else f"needs more than {spot_child.MEMORY >> 30} GiB of memory, or a deeper stack than Spot has"
        )
        raise TaskError(f"the formula is too large: to {what} it {why}; {SIMPLER}")
    return answer


def _ready_process() -> _SpotProcess:
    """The one that runs, or a new one."""
    global _running
    if not _may_be_installed():
        raise SpotMissingError(f"this formula needs Spot, which is not installed: {_INSTALL_SPOT}")
    # After a fork the pipes are shared with the other process, which would read our answers.
    if _running is None or _running.owner != os.getpid() or not _running.is_alive:
        _running = _SpotProcess()
    if _running.state == "missing":
        raise SpotMissingError(f"this formula needs Spot, which is not installed: {_INSTALL_SPOT}")
    if _running.state == "another":
        raise SpotMissingError(f"the installed module 'spot' is not the Spot library: {_INSTALL_SPOT}")
    if _running.state is None:
        raise SpotMissingError("Spot is installed and its process does not start; try `python -c 'import spot'`")
    return _running


def _may_be_installed() -> bool:
    """Whether a module of its name can be found: asked here, where no process has to be begun to learn that not."""
    try:
        return importlib.util.find_spec("spot") is not None
    # One without a specification was put together by a program.
    except ValueError:
        return True
