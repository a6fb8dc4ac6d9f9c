"""What the commands share: consoles, messages and progress on stderr, JSON on stdout, errors as one line.

What only some commands need is imported where it is used: help and completion load this file too.
"""

import errno
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

import typer
from rich.console import Console

from potlp_jax.errors import PotlpError, PotlpWarning

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.table import Table

logger = logging.getLogger(__name__)

# Exit codes, as the help of `potlp` lists them. 130 is what the shell reports after an interrupt.
FAILED = 1
BAD_INPUT = 2

# Systems do not say which file they could not write on.
_OF_DISKS = (errno.ENOSPC, errno.EDQUOT, errno.EIO)

PIPE_COLUMNS: int = 160
"""Width of what is printed where stdout is no terminal: the widest table of the commands fits."""


def console() -> Console:
    """Where results go; what is no terminal gets lines as long as they need to be."""
    # In a pipe Rich would wrap tables at 80 columns, where whoever reads them next wants whole lines.
    output = _literal_console()
    return output if output.is_terminal else _literal_console(width=PIPE_COLUMNS)


def error_console() -> Console:
    """Where progress, notes and errors go."""
    return _literal_console(stderr=True)


def print_next(output: Console, command: str) -> None:
    """What one would do next, on one line however long it is: it is copied and run."""
    output.print(f"next: {command}", style="dim", soft_wrap=True)


def file_console(file: TextIO, width: int) -> Console:
    """Writes tables into a text file with lines of up to ``width`` columns: a file has no terminal to ask."""
    return _literal_console(file=file, width=width)


def print_table(output: Console, table: "Table") -> None:
    """A table, where the terminal is narrower than its numbers at their own width: Rich would cut digits off."""
    wide = output.options.update(max_width=PIPE_COLUMNS)
    for column in table.columns:
        if column.no_wrap:
            # Rich takes the longest word for the least width of any column.
            column.min_width = max(
                output.measure(cell, options=wide).maximum for cell in (column.header, *column.cells)
            )
    least = output.measure(table, options=wide).minimum
    if least > output.width:
        table.width = least
    output.print(table, crop=False)


def _literal_console(**options: Any) -> Console:
    # What is printed holds names, paths and formulas of users: `map:plans/office` or `[a]` must come out as they were
    # typed, and Rich would read pictograms and styles in them. It would also colour numbers and paths wherever it sees
    # them; here colour has a meaning, and is given as `style` or in a `rich.text.Text`.
    return Console(markup=False, emoji=False, highlight=False, **options)


def package_version() -> str:
    """The version of the installed package."""
    import importlib.metadata

    return importlib.metadata.version("potlp-jax")


def to_json(data: Any) -> str:
    """A JSON document; infinities and NaN are refused."""
    # NaN and Infinity are no JSON: a parser other than Python's would refuse the document.
    return json.dumps(data, indent=2, allow_nan=False)


def print_json(data: Any) -> None:
    """One JSON document on stdout."""
    # Not through Rich, which would wrap long lines within strings.
    typer.echo(to_json(data))


class _Messages(logging.Handler):
    """Log records as lines on stderr: what is worth knowing in yellow, what only ``--verbose`` asks for faint."""

    def emit(self, record: logging.LogRecord) -> None:
        # A console of its own for each line: who runs commands in one process, as tests do, may exchange stderr.
        style = "dim" if record.levelno < logging.INFO else "yellow"
        error_console().print(self.format(record), style=style, soft_wrap=True)


def set_verbosity(level: int) -> None:
    """Show the package's log messages from this level on; progress is shown from ``logging.INFO`` on."""
    package = logging.getLogger("potlp_jax")
    package.setLevel(level)
    # The handler stays for the process; commands that run one after another must not each add one.
    if not any(isinstance(handler, _Messages) for handler in package.handlers):
        package.addHandler(_Messages())
        # With none of its own the root logger is given one by the first library that logs there, which would say all
        # of this again.
        logging.getLogger().addHandler(logging.NullHandler())


def shows_progress() -> bool:
    """Whether progress is wanted: not with ``--quiet``."""
    return logging.getLogger("potlp_jax").isEnabledFor(logging.INFO)


def fail(message: str, code: int = BAD_INPUT) -> NoReturn:
    """End the command with one clear message on stderr."""
    error_console().print(f"potlp: {_printable(message)}", style="red", soft_wrap=True)
    raise typer.Exit(code)


def _printable(message: str) -> str:
    """Without what a terminal obeys or cannot show: names in damaged files may be any bytes."""
    return "".join(
        char if char.isprintable() or char == "\n" else char.encode("unicode_escape").decode() for char in message
    )


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn errors about the user's input and files into one message without a traceback, and warnings into notes."""
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            yield
    # All errors that the library raises about what it was given derive from this one; any other is a fault of the
    # program and keeps its traceback.
    except PotlpError as error:
        fail(str(error))
    except OSError as error:
        if error.filename is not None:
            fail(f"{error.filename}: {error.strerror}", FAILED)
        if error.errno in _OF_DISKS:
            fail(f"{error.strerror}: what was finished is kept; make room, and give the same command again", FAILED)
        # Any other error of the system that is about no file is such a fault too.
        raise


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, *rest: TextIO | str | None
) -> None:
    """A warning about the user's input as a note, without the place in the program; any other as Python shows it."""
    if issubclass(category, PotlpWarning):
        logger.warning(message)
    # Warnings of other libraries keep file and line, without which they say little.
    else:
        logger.warning(warnings.formatwarning(message, category, filename, lineno))


def progress_bar() -> "Progress":
    """A progress display on stderr that leaves nothing behind; silent with --quiet and where stderr is no terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    # On stderr, so that stdout holds results alone and can go to a file or a pipe.
    terminal = error_console()
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=terminal,
        transient=True,
        disable=not (terminal.is_terminal and shows_progress()),
    )


def make_folder(folder: Path) -> Path:
    """The folder for results, made if it is not there."""
    if folder.exists() and not folder.is_dir():
        fail(f"--out {folder} is a file; give a folder")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def open_page(page: Path) -> None:
    """Open a page in the browser, if there is one."""
    import webbrowser

    if not webbrowser.open(page.resolve().as_uri()):
        logger.warning("there is no browser to open it with")
