"""``potlp collect``: a dataset for the estimator, from simulated worlds."""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from potlp_jax.cli.completion import complete_environment, complete_split
from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import ClusterName, Processes, RecipeName, Settings
from potlp_jax.cli.output import FAILED, console, fail, make_folder, progress_bar

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from potlp_jax.environments.splits import Split
    from potlp_jax.recipes.collection import Collected
    from potlp_jax.recipes.recipe import Recipe

app = command_app()


@app.command(
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp collect firefighting --worlds 1300 --out data/training[/cyan]

[cyan]potlp collect --recipe parcels --split validation --out data/validation[/cyan]

[cyan]potlp collect mine:environment --worlds 100 --out data/mine --set views_per_world=6[/cyan]

[dim]The same command again continues a collection that was interrupted. Needs the extra: pip install
'potlp-jax\\[train]'. docs/dataset.md describes the files.[/dim]
""",
)
def collect(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the dataset.")],
    environment: Annotated[
        str | None,
        typer.Argument(
            metavar="ENV",
            help="An environment, also one of your own ([cyan]module:attribute[/cyan]). Not with --recipe.",
            autocompletion=complete_environment,
        ),
    ] = None,
    recipe: RecipeName = None,
    worlds: Annotated[
        int | None, typer.Option("--worlds", min=1, help="How many worlds of the split; default: as in the recipe.")
    ] = None,
    split: Annotated[
        str,
        typer.Option(
            "--split",
            help="From which worlds: training, validation, calibration or test.",
            autocompletion=complete_split,
        ),
    ] = "training",
    processes: Processes = 1,
    cluster: ClusterName = None,
    settings: Settings = None,
) -> None:
    """Record panoramas of simulated worlds with the true answers about what lies beyond each frontier."""
    require_training_extra()
    from potlp_jax.cli.inputs import read_split
    from potlp_jax.codec import settings_from_words, with_settings
    from potlp_jax.engine.opening import open_engine
    from potlp_jax.environments.registry import make
    from potlp_jax.learning.dataset_reading import read_dataset
    from potlp_jax.learning.recording import overflow_in_words
    from potlp_jax.recipes import collection

    chosen = _chosen(environment, recipe)
    generator = make(chosen.environment)
    of_split = read_split(split, generator)
    number = worlds or chosen.worlds(of_split)
    if not number:
        fail(f"how many worlds of the split {split}? Give --worlds")
    folder = make_folder(out)
    config = with_settings(chosen.collect, settings_from_words(settings or []), "--set")
    told = [collection.Collected(0, 0, 0)]
    with progress_bar() as progress, open_engine(processes, cluster) as engine:
        show = collection_bars(progress)

        def tell(collected: "Collected") -> None:
            told.append(collected)
            show(of_split, collected)

        collection.collect(generator, chosen.environment, of_split, number, folder, config, engine, tell)
    console().print(collection.summary(read_dataset(folder)))
    most, now = config.frontiers.max_subgoals, told[-1]
    if overflow := overflow_in_words(now.views, now.overflowed, most, "--set frontiers.max_subgoals="):
        console().print(overflow, soft_wrap=True)


def _chosen(environment: str | None, recipe: str | None) -> "Recipe":
    from potlp_jax.recipes.recipe import read_recipe, recipe_for

    if environment is not None and recipe is None:
        return recipe_for(environment)
    if recipe is not None and environment is None:
        return read_recipe(recipe)
    fail("name an environment, or a recipe with --recipe: one of the two")


def require_training_extra() -> None:
    """End with a message where what training needs is not installed."""
    missing = [name for name in ("pyarrow", "tensorboardX") if importlib.util.find_spec(name) is None]
    if missing:
        fail(f"training needs {' and '.join(missing)}, not installed: pip install 'potlp-jax[train]'", FAILED)


def collection_bars(progress: "Progress") -> "Callable[[Split, Collected], None]":
    """What shows where the collections of splits stand, each as a bar of ``progress``."""
    bars: dict[str, TaskID] = {}

    def show(split: "Split", collected: "Collected") -> None:
        if split not in bars:
            bars[split] = progress.add_task("", total=collected.of)
        cut = f", {collected.overflowed} with more subgoals than are recorded" if collected.overflowed else ""
        text = f"worlds of {split}, {collected.views} views{cut}"
        progress.update(bars[split], completed=collected.worlds, description=text)

    return show
