"""The command line as a tree: every command and group with its words, for tests that go through all of them."""

from collections.abc import Iterator
from typing import Any

import typer

from potlp_jax.cli import app


def all_commands() -> dict[tuple[str, ...], Any]:
    """Words after ``potlp``, and the command or group that they name; no words name ``potlp`` itself."""
    return dict(_below((), typer.main.get_command(app)))


def _below(words: tuple[str, ...], command: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield words, command
    # A group imports its commands when they are asked for; what has no list of commands is no group.
    for name in command.list_commands(None) if hasattr(command, "list_commands") else ():
        yield from _below((*words, name), command.get_command(None, name))
