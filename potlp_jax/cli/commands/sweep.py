"""Options and help of ``potlp sweep``."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from potlp_jax.cli.commands.options import Json
from potlp_jax.cli.output import clear_errors


class _RunByDefault(TyperGroup):
    """A group whose first command runs where none is named: `potlp sweep FILE.yaml`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and not args[0].startswith("-") and args[0] not in self.commands:
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    name="sweep",
    cls=_RunByDefault,
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="Run many paired trials; show or export their results. [cyan]potlp sweep FILE.yaml --out DIR[/cyan] runs.",
)
SweepFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a sweep, as --out named it.")]


@app.command(
    "run",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp sweep eval/sweeps/validation.yaml --out out/validation[/cyan]

[cyan]potlp sweep mine.yaml --out out/mine --processes 1[/cyan]

[dim]Killed or interrupted, the same command again continues; several may run on one folder. docs/sweeps.md describes
the file.[/dim]
""",
)
@clear_errors
def sweep_run_command(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="What to run: docs/sweeps.md.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")],
    processes: Annotated[
        int | None, typer.Option(min=1, help="Workers, each on a core of its own; default: one per core.")
    ] = None,
    json: Json = False,
) -> None:
    """Run environments × tasks × policies × worlds, or what is missing of it."""
    from potlp_jax.cli.sweep import sweep

    sweep(file, out, processes, json)


@app.command("show")
@clear_errors
def sweep_show_command(folder: SweepFolder, json: Json = False) -> None:
    """Show the tables of what is finished."""
    from potlp_jax.cli.sweep import show_sweep

    show_sweep(folder, json)


@app.command("export")
@clear_errors
def sweep_export_command(
    folder: SweepFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write: .csv or .parquet.")],
) -> None:
    """Write one line per finished trial to a file."""
    from potlp_jax.cli.sweep import export_sweep

    export_sweep(folder, out)
