"""The one process that writes to a folder, where work of hours is kept."""

import contextlib
import fcntl
import logging
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from potlp_jax.errors import PotlpError

logger = logging.getLogger(__name__)

LOCK: str = "writer.lock"
"""Name of the file that is locked; it stays in the folder, and means nothing unless a process holds it."""


@contextlib.contextmanager
def only_writer(folder: Path, error: type[PotlpError]) -> Iterator[None]:
    """Hold a folder for the length of a block. The system lets go of it when the process ends, however it ends.

    Args:
        folder: exists already.
        error: what is raised.

    Raises:
        PotlpError: of the kind ``error``: another command holds the folder, or it cannot be written.
    """
    try:
        file = (folder / LOCK).open("a+", encoding="utf-8")
    except OSError as cause:
        raise error.of_file(folder / LOCK, f"cannot be written ({cause.strerror}): look after the folder") from cause
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as cause:
            file.seek(0)
            raise error.of_file(
                folder, f"another command works on it ({file.read(200).strip() or 'not named'}): wait for it, or end it"
            ) from cause
        # Some network file systems have no locks.
        except OSError as cause:
            logger.warning(f"{folder}: cannot be locked ({cause.strerror}): give no second command the same folder")
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield
