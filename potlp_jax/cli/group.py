"""The group of commands, imported one at a time, and what every command does around its work."""

import importlib
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from potlp_jax.cli.output import clear_errors

COMMANDS: Mapping[str, str] = MappingProxyType(
    {
        "task": "potlp_jax.cli.task",
        "run": "potlp_jax.cli.run",
        "compare": "potlp_jax.cli.compare",
        "explain": "potlp_jax.cli.explain",
        "view": "potlp_jax.cli.view",
        "sweep": "potlp_jax.cli.sweep",
        "report": "potlp_jax.cli.report",
        "audit": "potlp_jax.cli.audit",
        "collect": "potlp_jax.cli.collect",
        "fit": "potlp_jax.cli.fit",
        "estimator": "potlp_jax.cli.estimator",
        "map": "potlp_jax.cli.maps",
        "log": "potlp_jax.cli.log",
        "drive": "potlp_jax.cli.drive",
        "export": "potlp_jax.cli.export",
        "bench": "potlp_jax.cli.bench",
    }
)
"""Module of each command, in the order of the help. A module has a ``typer.Typer`` called ``app``, made by
``command_app``, that holds the command or, for a group such as ``potlp map``, its subcommands. To add a command, write
the module and a line here."""


class CommandGroup(TyperGroup):
    """The commands of ``COMMANDS``: a module is imported when its command is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in the order of the help."""
        return list(COMMANDS)

    # Contexts and commands are `Any` here: typer brings its own copy of click, or uses an installed one, by version.
    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of this name; None where there is none."""
        if cmd_name not in self.commands and cmd_name in COMMANDS:
            module = importlib.import_module(COMMANDS[cmd_name])
            self.add_command(typer.main.get_command(module.app), cmd_name)
        return self.commands.get(cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As in any group; a mistyped name is compared with all commands, whether imported or not."""
        if args and args[0] not in COMMANDS:
            # Typer proposes similar names from those in `self.commands`.
            for name in COMMANDS:
                self.get_command(ctx, name)
        return super().resolve_command(ctx, args)


class Command(TyperCommand):
    """A command that reports errors as one line and uses the compilation cache where the script turned it on."""

    def __init__(self, *arguments: Any, epilog: str | None = None, **named: Any) -> None:
        # Line ends within a paragraph are the source's: the terminal has its own width.
        joined = None if epilog is None else re.sub(r"(?<=[^\n])\n(?=[^\n])", " ", epilog)
        super().__init__(*arguments, epilog=joined, **named)

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        with clear_errors():
            # Not earlier: help and completion end before a command is invoked, and must not import jax.
            if ctx.obj is not None and not ctx.find_root().params["no_cache"]:
                ctx.obj()
            return super().invoke(ctx)


def command_app(name: str | None = None, about: str | None = None, cls: type[TyperGroup] = TyperGroup) -> typer.Typer:
    """The ``app`` of a command's module.

    Args:
        name: name of a group of subcommands; None for a single command.
        about: what the subcommands of a group have in common, for its help.
        cls: class of a group.

    Returns:
        An application for ``COMMANDS``, still without commands.
    """
    # A group without arguments shows its help; a single command may need none. `potlp` alone installs completion.
    return typer.Typer(
        name=name, cls=cls, help=about, no_args_is_help=name is not None, rich_markup_mode="rich", add_completion=False
    )
