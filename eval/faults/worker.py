"""Cases in a process of their own, which may hang, die or eat all memory without harm to the one that counts."""

import contextlib
import importlib
import multiprocessing
import os
import resource
import shutil
import signal
import time
import traceback
import zlib
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import jax
import numpy as np

from eval.faults import LONGEST_MESSAGE, Kind, LostRowsError, Verdict, WrongAnswerError
from potlp_jax.errors import PotlpError
from potlp_jax.files import one_line

_START = 300.0
"""Seconds that a process may take to import what it attacks, on a machine that does much else."""

_LOOK = 0.2
"""Seconds between looks at what the processes of a case have waited for a core, which is known while they live."""


@dataclass(frozen=True)
class Ending:
    """How a case ended: the message or traceback, and the seconds that it took."""

    verdict: Verdict
    text: str
    seconds: float


def all_kinds(modules: tuple[str, ...]) -> dict[str, Kind]:
    """The kinds of these modules by name."""
    kinds = [kind for module in modules for kind in importlib.import_module(module).KINDS]
    names = [kind.name for kind in kinds]
    assert len(set(names)) == len(names), "two kinds have one name"
    return {kind.name: kind for kind in kinds}


class _Clock:
    """Seconds of a process without those in which it, or a process that it began, waited for a core.

    While one works the other waits for its answer, so what they waited adds up. To be read now and then: what a process
    waited is known as long as it lives.
    """

    def __init__(self, process: BaseProcess | None) -> None:
        self._process = os.getpid() if process is None else process.pid
        self._began, self._before = time.monotonic(), self._waits()
        self._longest: dict[int, float] = {}

    def seconds(self) -> float:
        """Since this was made. Of several threads of a process, the one counts that waited longest."""
        for process, threads in self._waits().items():
            before = self._before.get(process, {})
            waited = max((wait - before.get(thread, 0.0) for thread, wait in threads.items()), default=0.0)
            self._longest[process] = max(self._longest.get(process, 0.0), waited)
        return time.monotonic() - self._began - sum(self._longest.values())

    def _waits(self) -> dict[int, dict[str, float]]:
        """Seconds of waiting by process and thread; none where the system does not tell."""
        if self._process is None:
            return {}
        return {process: _waits_of(process) for process in (self._process, *_children(self._process))}


def _waits_of(process: int) -> dict[str, float]:
    found = {}
    # Threads end while they are read.
    with contextlib.suppress(OSError, IndexError):
        for task in Path(f"/proc/{process}/task").iterdir():
            found[task.name] = int((task / "schedstat").read_text().split()[1]) / 1e9
    return found


def _children(process: int) -> list[int]:
    found = []
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{process}/task").iterdir():
            found += [int(child) for child in (task / "children").read_text().split()]
    return found


class Worker:
    """One process that runs cases of one kind in a folder, begun again when a case has killed it."""

    def __init__(self, modules: tuple[str, ...], kind: Kind, seed: int, folder: Path) -> None:
        self._modules, self._kind, self._seed, self._folder = modules, kind, seed, folder
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None

    def run(self, number: int) -> Ending:
        """One case; its input lies in the folder afterwards. A case that hangs is run once more, in a new process.

        The machine may have been busy with something else: only a case that hangs twice is counted as a hang.
        """
        ending = self._attempt(number)
        return ending if ending.verdict is not Verdict.HANG else self._attempt(number)

    def close(self) -> None:
        """End the process and whatever it started."""
        if self._process is not None and self._process.pid is not None:
            # The process leads a group of its own (`_serve`), which outlives it if its children hang.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.join()
        self._process = self._connection = None

    def _attempt(self, number: int) -> Ending:
        connection = self._connection or self.start()
        _empty(self._folder)
        clock = _Clock(self._process)
        connection.send(number)
        try:
            while (left := self._kind.limit - clock.seconds()) > 0:
                if connection.poll(min(left, _LOOK)):
                    verdict, text = connection.recv()
                    return Ending(Verdict(verdict), text, clock.seconds())
        except EOFError:
            seconds = clock.seconds()
            self.close()
            return Ending(Verdict.TRACEBACK, "the process died", seconds)
        self.close()
        return Ending(Verdict.HANG, f"no end after {self._kind.limit:g} s", self._kind.limit)

    def start(self) -> Connection:
        """Begin the process, and wait until it can run cases. Raises TimeoutError."""
        # Spawned, not forked: libraries with threads of their own do not survive a fork.
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        arguments = (theirs, self._modules, self._kind.name, self._seed, self._folder)
        process = context.Process(target=_serve, args=arguments)
        process.start()
        self._process = process
        theirs.close()
        if not ours.poll(_START):
            self.close()
            raise TimeoutError(f"the process for {self._kind.name} did not start within {_START:g} s")
        ours.recv()
        self._connection = ours
        return ours


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)


def _serve(connection: Connection, modules: tuple[str, ...], name: str, seed: int, folder: Path) -> None:
    """Run cases by number until nobody asks any more."""
    os.setsid()
    kind = all_kinds(modules)[name]
    # Some cases that nobody counts, so that imports and compilation are not measured, and the threads of jax have got
    # their memory before it is limited.
    jax.random.key(0).block_until_ready()
    # Libraries in C write remarks about damaged input to the error stream; the table has no place for them.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    for number in range(kind.warm_up):
        _empty(folder)
        judged(kind, seed, number, folder)
    if kind.memory is not None:
        size = _address_space() + kind.memory
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
    connection.send("ready")
    while True:
        try:
            number = connection.recv()
        except EOFError:
            return
        connection.send(judged(kind, seed, number, folder))


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def judged(kind: Kind, seed: int, number: int, folder: Path) -> tuple[str, str]:
    # Every case has random numbers of its own: it can be run again without those before it.
    random = np.random.default_rng([seed, zlib.crc32(kind.name.encode()), number])
    try:
        kind.run(random, folder)
    except PotlpError as error:
        text = str(error)
        # Half of a surrogate pair cannot be written to any terminal.
        cannot_be_shown = any("\ud800" <= char <= "\udfff" for char in text)
        if not text.strip() or len(text) > LONGEST_MESSAGE or cannot_be_shown:
            return Verdict.TRACEBACK, f"no clear message ({len(text)} characters): {one_line(text, LONGEST_MESSAGE)}"
        return Verdict.CLEAR, text
    except WrongAnswerError as error:
        return Verdict.WRONG, str(error)
    except LostRowsError as error:
        return Verdict.LOST, str(error)
    # Whatever else comes out of the library would have reached a user as a traceback: this is what is looked for.
    except BaseException:
        return Verdict.TRACEBACK, traceback.format_exc()[-20_000:]
    return Verdict.FINE, ""
