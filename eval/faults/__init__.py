"""Attacks on whatever the library reads, and on running sweeps: `python -m eval.faults --help`.

A module of this folder attacks one part. It has a tuple ``KINDS``; each `Kind` makes one case from random numbers and
runs it. The command gives every case a time limit and a memory limit in a process of its own, counts how the cases
end, and keeps the inputs of those that end badly.

A case ends

- *fine*: nothing was raised;
- with a *clear error*: a ``PotlpError`` whose message is at most `LONGEST_MESSAGE` characters long;
- with a *traceback*: any other exception, a message that is no message, or a process that died;
- as a *hang*: it took longer than the limit, twice;
- with a *wrong answer* or *lost rows*: it raised `WrongAnswerError` or `LostRowsError`, because it can tell.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

LIMIT: float = 5.0
"""Seconds that reading an input may take at most."""

MEMORY: int = 1 << 30
"""Bytes of address space that a case may add to those of its process."""

LONGEST_MESSAGE: int = 1000
"""Characters of a message above which nobody finds in it what is wrong."""


class Verdict(StrEnum):
    """How a case ended."""

    FINE = "fine"
    CLEAR = "clear errors"
    TRACEBACK = "tracebacks"
    HANG = "hangs"
    WRONG = "wrong answers"
    LOST = "lost rows"


GOOD = (Verdict.FINE, Verdict.CLEAR)
"""The two ways in which every case should end."""


class WrongAnswerError(Exception):
    """The case was accepted and answered, and the answer is known to be wrong; the message says how."""


class LostRowsError(Exception):
    """Results that had been finished are gone; the message says which."""


@dataclass(frozen=True)
class Kind:
    """Cases of one kind.

    Attributes:
        name: unique among all kinds; one row of the table.
        run: makes a case from the random numbers, writes what it needs into the folder, which is empty, and runs it.
            Returns if the case is fine, and raises whatever the library raised otherwise. What it wrote into the folder
            is kept if the case ends badly. The folder around it stays for the whole run: whatever is expensive to make
            and the same for all cases may lie there.
        unit: what a case is, in the plural.
        limit: seconds that a case may take.
        memory: bytes that a case may add to the address space of its process; None: as many as there are.
        weight: cases of this kind for one of another kind of its part; less than 1 for slow ones.
        warm_up: cases that nobody counts, run first in each process, so that imports are not measured.
    """

    name: str
    run: Callable[[np.random.Generator, Path], None]
    unit: str = "files"
    limit: float = LIMIT
    memory: int | None = MEMORY
    weight: float = 1.0
    warm_up: int = 5
