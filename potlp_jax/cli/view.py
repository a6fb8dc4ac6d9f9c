"""``potlp view``: a recorded trial as a page in the browser."""

from pathlib import Path
from typing import Annotated

import typer

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import EstimatorName, OpenPage, TrialFile
from potlp_jax.cli.output import console, fail, open_page

PAGE: str = "replay.html"
"""Name of the page beside the record, unless another is given."""

app = command_app()


@app.command(
    "view",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp view out/fire[/cyan] - out/fire/replay.html, opened in the browser

[cyan]potlp view out/fire/trial.json --out page.html --no-open[/cyan]

[dim]The page is one file. Arrow keys go by steps, Page Up and Page Down by decisions.[/dim]
""",
)
def view_trial(
    trial: TrialFile,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Page to write; default: replay.html beside it.")
    ] = None,
    estimator: EstimatorName = None,
    open_it: OpenPage = True,
) -> None:
    """Replay a trial in the browser: the map as it was revealed, the actions and panoramas of every decision.

    Where the estimator has them, the map also shows what the camera painted on it and what is imagined of the rest.
    """
    from potlp_jax.cli.inputs import read_estimator, record_file
    from potlp_jax.trials.record import load_trial
    from potlp_jax.trials.replay import views_of
    from potlp_jax.view.replay_page import replay_page

    # Panoramas are not in the record: they are rendered again from its world.
    file = record_file(trial)
    recorded = load_trial(file)
    page = out or file.with_name(PAGE)
    # A browser goes by the ending of a file's name.
    if page.suffix != ".html":
        fail(f"--out {page}: give a name that ends in .html")
    page.write_text(replay_page(recorded, views_of(recorded, read_estimator(estimator))), "utf-8")
    console().print(f"wrote {page}")
    if open_it:
        open_page(page)
