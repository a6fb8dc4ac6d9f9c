"""One small fault of the core."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """A fault and the tests that are to notice it.

    Attributes:
        part: of the core.
        says: the fault in words.
        file: in which it is made, from the root of the repository.
        old: text that occurs once in the file.
        new: what stands there in the mutant.
        tests: files of tests; narrow, so that a mutant costs seconds.
        only: names of tests, as ``pytest -k`` takes them; all of the files where it is empty.
        beside_kernels: the tests compare twins with kernels. Where a kernel does the work of a function in Python, a
            fault of the function would change nothing: kernels are off for faults in Python without this.
    """

    part: str
    says: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    only: str = ""
    beside_kernels: bool = False
