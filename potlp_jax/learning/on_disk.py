"""Images, maps and columns of a data set on disk, so that the memory of a fit does not grow with it.

All files are without a name in the temporary folder (``TMPDIR``), and gone when the process ends, however it ends.
"""

import bisect
import contextlib
import itertools
import os
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Generic, Protocol, SupportsIndex, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Int64, Shaped

from potlp_jax.errors import DatasetError

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


@runtime_checkable
class Entries(Protocol[T_co]):
    """What a list and the sequences below have in common."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: SupportsIndex, /) -> T_co: ...
    def __iter__(self) -> Iterator[T_co]: ...


@contextlib.contextmanager
def _kept() -> Iterator[None]:
    """Name what is not kept, and where, as when the disk is full."""
    try:
        yield
    except OSError as error:
        raise DatasetError(
            f"the images of a data set cannot be kept in {tempfile.gettempdir()} ({error.strerror}): free space "
            "there, or set TMPDIR to another folder"
        ) from error


class ImageFile:
    """Byte strings. Any thread may read them."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as this object lives
        weakref.finalize(self, self._file.close)

    def write(self, entries: Iterable[Sequence[bytes]]) -> Int64[np.ndarray, "N ..."]:
        """Append entries of some byte strings each, equally many.

        Returns:
            Of each entry, a row: where its byte strings begin, and where the last one ends.

        Raises:
            DatasetError: there is no space.
        """
        with _kept():
            bounds = [
                list(itertools.accumulate(map(self._file.write, entry), initial=self._file.tell())) for entry in entries
            ]
            # Entries are read past the buffer.
            self._file.flush()
        return np.array(bounds, np.int64)

    def read(self, bounds: Int64[np.ndarray, " entries"]) -> list[bytes]:
        """The byte strings of an entry, by its row of what ``write`` returned."""
        first, *_, last = bounds.tolist()
        # One call without a position, which threads would share.
        data = os.pread(self._file.fileno(), last - first, first)
        return [data[one:other] for one, other in itertools.pairwise((bounds - first).tolist())]


class OnDisk(Generic[T]):
    """Entries that are read when they are asked for.

    Args:
        file: has them.
        make: an entry of its byte strings.
        bounds: of the entries, as ``ImageFile.write`` gave them.
    """

    def __init__(self, file: ImageFile, make: Callable[..., T], bounds: Int64[np.ndarray, "N ..."]) -> None:
        self._file, self._make, self._bounds = file, make, bounds

    def __len__(self) -> int:
        return len(self._bounds)

    def __getitem__(self, index: SupportsIndex) -> T:
        return self._make(*self._file.read(self._bounds[index]))

    def __iter__(self) -> Iterator[T]:
        return map(self.__getitem__, range(len(self)))


class ColumnFile:
    """One column of the samples, which grows by pieces and is mapped into memory at the end.

    What is mapped counts as memory of the process while it is looked at, and the system takes it back when it needs it.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed when it is mapped
        self._like, self._rows = np.zeros(0), 0

    def append(self, piece: Shaped[np.ndarray, "n ..."]) -> None:
        """Write further rows, of the same type and row shape. Raises DatasetError where there is no space."""
        with _kept():
            self._file.write(np.ascontiguousarray(piece).data)
        self._like, self._rows = piece[:0], self._rows + len(piece)

    def mapped(self) -> Shaped[np.ndarray, "N ..."]:
        """All rows, read only."""
        with _kept():
            self._file.flush()
        shape = (self._rows, *self._like.shape[1:])
        # Nothing cannot be mapped.
        if not np.prod(shape):
            self._file.close()
            return np.empty(shape, self._like.dtype)
        with self._file:
            return np.asarray(np.memmap(self._file, self._like.dtype, "r", shape=shape))


class Chained(Generic[T]):
    """Sequences one after another, without a copy of their entries."""

    def __init__(self, parts: Iterable[Entries[T]]) -> None:
        self._parts = list(parts)
        self._starts = list(itertools.accumulate(map(len, self._parts), initial=0))

    def __len__(self) -> int:
        return self._starts[-1]

    def __getitem__(self, index: SupportsIndex) -> T:
        # The range counts from the end where the index is negative, and refuses what is out of range.
        index = range(len(self))[index]
        # The last part that starts here or before: parts without entries start where the next one does.
        part = bisect.bisect_right(self._starts, index) - 1
        return self._parts[part][index - self._starts[part]]

    def __iter__(self) -> Iterator[T]:
        return itertools.chain.from_iterable(self._parts)
