"""The end of a sweep that is asked to end (SIGTERM): soon, and with nothing lost."""

import contextlib
import functools
import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from typing import NoReturn

logger = logging.getLogger(__name__)

ENDED: int = 128 + signal.SIGTERM
"""What a shell reports of a process that the signal has ended."""

KEPT: str = "what is finished is kept: the same command goes on"
"""What messages say about rows."""

# With the reading of the store and the end of the process that is less than two seconds.
_GRACE: float = 1.0
"""Seconds between asking a process to end, or to tidy up at its end, and ending it."""


@contextlib.contextmanager
def ending_when_asked(kept: bool) -> Iterator[None]:
    """End the block by SIGTERM as by an error, so that it can tidy up, and the process soon, whatever it does.

    Args:
        kept: whether what is finished is there afterwards, which the message says then.

    Python runs a handler between its own steps alone, and compiling a program may be one step of a minute. So a thread
    ends the process if the handler has not done so in time: nothing is lost, as rows are written as they end.
    """
    # Elsewhere than in the main thread no handler can be set, and whoever runs it has an own way to end it.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    ended = threading.Event()
    thread = threading.Thread(target=_end_late, args=(reader, ended), daemon=True)
    before_fd = signal.set_wakeup_fd(writer.fileno())
    before = signal.signal(signal.SIGTERM, functools.partial(_end, kept))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(before_fd)
        signal.signal(signal.SIGTERM, before)
        writer.close()
        thread.join()
        reader.close()


def end_process_soon() -> None:
    """End this process, which was asked to end, in a second, should it not have ended by then.

    At the end of the interpreter Dask waits for processes that it was just beginning, for many seconds.
    """
    threading.Thread(target=_end_after_grace, daemon=True).start()


def _end_after_grace() -> NoReturn:
    time.sleep(_GRACE)
    os._exit(ENDED)


def _end(kept: bool, number: int, frame: object) -> NoReturn:
    # At once: closing what is open may take longer than the grace.
    logger.warning(f"ended by {signal.Signals(number).name}{f'; {KEPT}' if kept else ''}")
    raise SystemExit(ENDED)


def _end_late(reader: socket.socket, ended: threading.Event) -> None:
    """Wait for SIGTERM, and end the process if nothing else has a while after it. Ends when the other side closes."""
    while signals := reader.recv(1):
        if signals[0] == signal.SIGTERM and not ended.wait(_GRACE):
            os._exit(ENDED)
