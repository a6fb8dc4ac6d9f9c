"""What the commands share: consoles, errors as one message, progress on stderr, JSON on stdout."""

import functools
import importlib.metadata
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TextIO

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from potlp_jax.errors import PotlpError, PotlpWarning

FAILED = 1
BAD_INPUT = 2


def console() -> Console:
    """Where results go; what is no terminal gets lines as long as they need to be."""
    output = Console(highlight=False)
    return output if output.is_terminal else Console(highlight=False, width=160)


def error_console() -> Console:
    """Where progress, notes and errors go."""
    return Console(stderr=True, highlight=False)


def package_version() -> str:
    """The version of the installed package."""
    return importlib.metadata.version("potlp-jax")


def to_json(data: Any) -> str:
    """A JSON document; infinities and NaN are refused."""
    return json.dumps(data, indent=2, allow_nan=False)


def print_json(data: Any) -> None:
    """One JSON document on stdout."""
    typer.echo(to_json(data))


def note(message: str) -> None:
    """A remark on stderr."""
    error_console().print(message, style="yellow", markup=False, soft_wrap=True)


def fail(message: str, code: int = BAD_INPUT) -> NoReturn:
    """End the command with one clear message on stderr."""
    error_console().print(f"potlp: {message}", style="red", markup=False, soft_wrap=True)
    raise typer.Exit(code)


def clear_errors(command: Callable[..., None]) -> Callable[..., None]:
    """Turn errors about the user's input and files into one message without a traceback, and warnings into notes."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> None:
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _show_warning
                command(*args, **kwargs)
        except PotlpError as error:
            fail(str(error))
        except OSError as error:
            if error.filename is None:
                raise
            fail(f"{error.filename}: {error.strerror}", FAILED)

    return wrapped


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, *rest: TextIO | str | None
) -> None:
    """A warning about the user's input as a note, without the place in the program; any other as Python shows it."""
    if issubclass(category, PotlpWarning):
        note(str(message))
    else:
        error_console().print(warnings.formatwarning(message, category, filename, lineno), markup=False)


def progress_bar() -> Progress:
    """A progress display on stderr that leaves nothing behind; silent where stderr is no terminal."""
    terminal = error_console()
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=terminal,
        transient=True,
        disable=not terminal.is_terminal,
    )


def output_folder(folder: Path | None) -> Path | None:
    """The folder for results, made if it is not there."""
    if folder is not None:
        if folder.exists() and not folder.is_dir():
            fail(f"--out {folder} is a file; give a folder")
        folder.mkdir(parents=True, exist_ok=True)
    return folder
