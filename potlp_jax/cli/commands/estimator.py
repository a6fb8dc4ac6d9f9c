"""Options and help of ``potlp estimator``."""

from pathlib import Path
from typing import Annotated

import typer

from potlp_jax.cli.commands.options import Json
from potlp_jax.cli.output import clear_errors

app = typer.Typer(
    name="estimator", no_args_is_help=True, rich_markup_mode="rich", help="Describe or evaluate a trained estimator."
)
Estimator = Annotated[Path, typer.Argument(metavar="CHECKPOINT", help="An estimator (.npz), as train.fit writes it.")]


@app.command(
    "evaluate",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp estimator evaluate out/fit/estimator.npz data/validation[/cyan]

[cyan]potlp estimator evaluate out/fit/estimator.npz data/validation --ablate all --out out/figures[/cyan]

[dim]Needs the extra: pip install 'potlp-jax\\[train]'. docs/estimator.md says what the figures mean.[/dim]
""",
)
@clear_errors
def estimator_evaluate_command(
    checkpoint: Estimator,
    dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of samples, as train.collect writes it.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for evaluation.json, table.txt and three pictures."),
    ] = None,
    ablate: Annotated[
        str,
        typer.Option("--ablate", help="Also without the [cyan]image[/cyan], with shuffled [cyan]phi[/cyan], or all."),
    ] = "none",
    json: Json = False,
) -> None:
    """Measure an estimator on worlds it has not seen: skill, calibration, errors of costs."""
    from potlp_jax.cli.estimator import evaluate_estimator

    evaluate_estimator(checkpoint, dataset, out, ablate, json)


@app.command(
    "info",
    epilog="""
[bold]Examples[/bold]

[cyan]potlp estimator info out/fit/estimator.npz[/cyan]

[cyan]potlp estimator info out/fit/estimator.npz --json[/cyan]
""",
)
@clear_errors
def estimator_info_command(checkpoint: Estimator, json: Json = False) -> None:
    """Show what an estimator knows, how large it is and how it was trained."""
    from potlp_jax.cli.estimator import show_estimator

    show_estimator(checkpoint, json)
