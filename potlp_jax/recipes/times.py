"""How long the steps of a recipe take, over all runs of it: what was spent before a run was killed counts, too."""

import csv
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from potlp_jax.errors import TrainingError
from potlp_jax.files import read_text, reading, write_whole

TIMES: str = "times.csv"
"""In the folder of a recipe that is followed: the stage, its step, and how many seconds all runs spent on it."""

EVERY: float = 30.0
"""Seconds after which the file is written again: a run that is killed loses as many at most."""


class Times:
    """The times of a recipe, kept in a file while they pass.

    Args:
        file: where; what stands there is of earlier runs and counts.
        every: seconds after which it is written again.
    """

    def __init__(self, file: Path, every: float = EVERY) -> None:
        self._file, self._every = file, every
        self._spent = read_times(file) if file.is_file() else {}

    @contextmanager
    def of(self, stage: int, step: str) -> Iterator[None]:
        """Count the time until the block ends, also by an error.

        Args:
            stage: its number.
            step: its name, such as ``fit``.
        """
        began, before = time.perf_counter(), self._spent.get((stage, step), 0.0)
        over = threading.Event()

        def keep() -> None:
            self._spent[stage, step] = before + time.perf_counter() - began
            self._write()

        def keep_on() -> None:
            while not over.wait(self._every):
                keep()

        # In a thread of its own: a fit does not come back before it ends.
        keeping = threading.Thread(target=keep_on, daemon=True)
        keeping.start()
        try:
            yield
        finally:
            over.set()
            keeping.join()
            keep()

    def _write(self) -> None:
        self._file.parent.mkdir(parents=True, exist_ok=True)
        lines = [f"{stage},{step},{seconds:.1f}\n" for (stage, step), seconds in self._spent.items()]
        write_whole(self._file, "".join(lines))


def read_times(file: Path) -> dict[tuple[int, str], float]:
    """Seconds by stage and step; a step that stands there several times took the sum.

    Args:
        file: that ``Times`` wrote.

    Returns:
        In the order in which the steps began.

    Raises:
        TrainingError: the file is damaged, or of something else.
    """
    found: dict[tuple[int, str], float] = {}
    lines = read_text(file, TrainingError).splitlines()
    with reading(file, TrainingError, "the times of a recipe"):
        for stage, step, spent in csv.reader(lines):
            key = (int(stage), step)
            found[key] = found.get(key, 0.0) + float(spent)
    return found
