"""Sequences of encoded images on disk, so that the memory of a fit does not grow with its data set."""

import bisect
import itertools
import os
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Generic, Protocol, SupportsIndex, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Int64

from potlp_jax.errors import DatasetError

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


@runtime_checkable
class Entries(Protocol[T_co]):
    """What a list and the sequences below have in common."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: SupportsIndex, /) -> T_co: ...
    def __iter__(self) -> Iterator[T_co]: ...


class ImageFile:
    """A file without a name in the temporary folder (``TMPDIR``), which is gone when the process ends, however it ends.

    Any thread may read it.
    """

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
        try:
            bounds = [
                list(itertools.accumulate(map(self._file.write, entry), initial=self._file.tell())) for entry in entries
            ]
            # Entries are read past the buffer.
            self._file.flush()
        except OSError as error:
            raise DatasetError(
                f"the images of a data set cannot be kept in {tempfile.gettempdir()} ({error.strerror}): free space "
                "there, or set TMPDIR to another folder"
            ) from error
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
        file: takes them.
        make: an entry of its byte strings.
        entries: the byte strings of each entry, equally many.

    Raises:
        DatasetError: there is no space for them.
    """

    def __init__(self, file: ImageFile, make: Callable[..., T], entries: Iterable[Sequence[bytes]]) -> None:
        self._file, self._make = file, make
        self._bounds = file.write(entries)

    def __len__(self) -> int:
        return len(self._bounds)

    def __getitem__(self, index: SupportsIndex) -> T:
        return self._make(*self._file.read(self._bounds[index]))

    def __iter__(self) -> Iterator[T]:
        return map(self.__getitem__, range(len(self)))


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
