"""``potlp fit``: an estimator from a dataset, or from nothing but a recipe."""

import dataclasses
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from potlp_jax.cli.collect import collection_bars, require_training_extra
from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import ClusterName, Processes, RecipeName, Settings
from potlp_jax.cli.output import console, fail, make_folder, progress_bar

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from potlp_jax.recipes.journal import Display

logger = logging.getLogger(__name__)

app = command_app()


@app.command(
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp fit --recipe firefighting --out out/firefighting --processes 2[/cyan] - collect, then fit

[cyan]potlp fit data/training --validation data/validation --out out/fit --epochs 7[/cyan]

[cyan]potlp fit data/training --validation data/validation --out out/fit --set training.learning_rate=1e-3[/cyan]

[cyan]srun --ntasks 8 potlp fit data/training --validation data/validation --out out/fit[/cyan] - shared by 8 processes

[dim]The same command again resumes after an interruption and ends with the same parameters. --out then holds
estimator.npz, log.csv, curves.png and what TensorBoard shows. Needs the extra: pip install 'potlp-jax\\[train]'.
docs/estimator.md says more.[/dim]
""",
)
def fit(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for everything that is written.")],
    datasets: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="DATASET...",
            help="Folders that `potlp collect` or `potlp log to-dataset` wrote; none: collect as the recipe says.",
        ),
    ] = None,
    validation: Annotated[
        Path | None, typer.Option("--validation", help="Dataset of other worlds; decides which parameters are kept.")
    ] = None,
    recipe: RecipeName = None,
    epochs: Annotated[
        int | None,
        typer.Option(
            "--epochs",
            min=1,
            help="Passes over the panoramas, at most. Rounds of a recipe say their own.",
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            "--minutes", help="Plan as many steps as fit into this time; with a recipe's rounds, in the fit of each."
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Of parameters, order and augmentation.")] = None,
    initial: Annotated[
        Path | None,
        typer.Option(
            "--initial", help="An estimator to go on from, or a shipped one's name. Not with a recipe that collects."
        ),
    ] = None,
    processes: Processes = 1,
    cluster: ClusterName = None,
    join: Annotated[
        str | None,
        typer.Option(
            "--join",
            metavar="HOST:PORT,INDEX,COUNT",
            help="Share the fit with other processes: where the first one listens, this one's number, how many there "
            "are. Not needed under srun and mpirun.",
        ),
    ] = None,
    settings: Settings = None,
) -> None:
    """Fit an estimator to a dataset, or make one from nothing with --recipe."""
    require_training_extra()
    import jax

    from potlp_jax.codec import settings_from_words, with_settings
    from potlp_jax.learning.dataset_reading import joined, read_dataset
    from potlp_jax.learning.devices import is_first, join_processes
    from potlp_jax.learning.estimator import estimator_file
    from potlp_jax.recipes import fitting
    from potlp_jax.recipes.recipe import follow, read_recipe

    if bool(datasets) != (validation is not None):
        fail("give a DATASET and, with --validation, another of other worlds: both, or neither with --recipe")
    if not datasets and recipe is None:
        fail("give a DATASET and --validation, or a recipe with --recipe")
    if initial is not None and not datasets:
        fail("--initial goes on from an estimator with a DATASET; a recipe makes one from nothing")
    network = [word for word in settings or [] if word.startswith("network")]
    if initial is not None and any(not word.startswith("network.own_within=") for word in network):
        fail("--initial keeps the network of its estimator as it is, but for own_within: leave out --set network")
    if datasets and processes > 1:
        fail(
            "--processes is for collecting, as a recipe does: a fit of a DATASET uses all cores by itself; leave it out"
        )
    given = None if recipe is None else read_recipe(recipe)
    if cluster is not None and datasets:
        fail("--cluster is for collecting, as a recipe does: a fit is shared by processes that join (--join)")
    changes = settings_from_words(settings or [])
    if given is not None and given.rounds and not datasets and (epochs is not None or "epochs" in changes):
        fail(
            "each round of a recipe has epochs of its own: change `epochs` of `fit` and of each round in a copy of its "
            "file; leave out --epochs"
        )
    config = with_settings(fitting.FitConfig() if given is None else given.fit, changes, "--set")
    options = {"epochs": epochs, "minutes": minutes}
    config = with_settings(config, _given(**options) | {"training": _given(seed=seed)}, "options")
    join_processes(join)
    if not datasets and jax.process_count() > 1:
        fail("several processes share a fit of a DATASET: collect first (`potlp collect --recipe`), then fit")
    folder = make_folder(out) if is_first() else out
    with progress_bar() as progress:
        if datasets and validation is not None:
            training = joined([read_dataset(dataset) for dataset in datasets])
            shown, begin = _display(progress), None if initial is None else estimator_file(initial)
            trained = fitting.fit(training, read_dataset(validation), folder, config, shown, initial=begin)
        else:
            assert given is not None
            chosen = dataclasses.replace(given, fit=config)
            trained = follow(chosen, folder, processes, cluster, collection_bars(progress), _display(progress))
    if not is_first():
        return
    console().print(
        f"{folder / fitting.ESTIMATOR}: step {trained.best_step} of {trained.steps}, validation loss "
        f"{trained.best_loss:.4f}; ended by {trained.reason} after {trained.seconds / 60:.1f} min",
        soft_wrap=True,
    )


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _display(progress: "Progress") -> "Display":
    """A bar of steps, a line about each epoch, and the picture of the curves; nothing of a process beside the first."""
    from potlp_jax.learning.devices import is_first
    from potlp_jax.recipes.journal import Display
    from potlp_jax.view.training_curves import draw_curves

    if not is_first():
        return Display()
    bars: list[TaskID] = []

    def advance(done: int, planned: int) -> None:
        if not bars:
            bars.append(progress.add_task("steps", total=planned))
        progress.update(bars[0], completed=done)

    return Display(say=logger.info, advance=advance, draw=draw_curves)
