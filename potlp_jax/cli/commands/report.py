"""Options and help of ``potlp report``."""

from pathlib import Path
from typing import Annotated

import typer

from potlp_jax.cli.output import clear_errors

app = typer.Typer()


@app.command(
    "report",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp report out/validation[/cyan] - writes out/validation/report.html

[cyan]potlp report out/validation --replays 0 --out table.html[/cyan] - tables and plots alone, a small file
""",
)
@clear_errors
def report_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a sweep, finished or not.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Page to write; default: report.html in DIR.")] = None,
    replays: Annotated[
        int, typer.Option(min=0, help="Worst and as many best trials of each task to replay; about 1 MB each.")
    ] = 2,
) -> None:
    """Write a sweep as one page: tables, plots, and the worst and best trials as replays."""
    from potlp_jax.cli.report import write_report

    write_report(folder, out, replays)
