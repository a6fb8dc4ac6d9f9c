"""Options and arguments that several commands share, each written once."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from potlp_jax.cli.completion import (
    complete_environment,
    complete_policy,
    complete_recipe,
    complete_search,
    complete_split,
    complete_task,
)
from potlp_jax.environments.families import FAMILIES

# How results are shown.
Json = Annotated[bool, typer.Option("--json", help="Write JSON, and nothing else, to stdout.")]
OpenPage = Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")]

# A type is an option with its names and help; a default is the command's, since commands differ in it.
# Which trial: environment, task, policy and world. Commands that have these give them the same short names.
Environment = Annotated[
    str,
    typer.Argument(
        metavar="ENV",
        help=", ".join(f"[cyan]{name}[/cyan]" for name in FAMILIES)
        + ", or [cyan]module:attribute[/cyan] of an environment of your own.",
        autocompletion=complete_environment,
    ),
]
TaskName = Annotated[
    str,
    typer.Option(
        "--task",
        "-t",
        help="Number of one of the environment's tasks, a formula, or a .hoa file.",
        autocompletion=complete_task,
    ),
]
PolicyName = Annotated[
    str | None,
    typer.Option(
        "--policy",
        "-p",
        help="potlp (the default where an estimator is shipped), known-map, baseline, optimistic, oracle, or "
        "module:attribute of a policy of your own.",
        show_default=False,
        autocompletion=complete_policy,
    ),
]
SplitName = Annotated[
    str | None,
    typer.Option(
        "--split",
        help="Which worlds to draw from: calibration, training, validation (the default) or test (all that floor plans "
        "are for).",
        show_default=False,
        autocompletion=complete_split,
    ),
]
# Not called a seed: worlds of a split are numbered, and seeds are of what a trial draws.
WorldNumber = Annotated[int, typer.Option("--world", "-w", min=0, help="Number of the world in the split.")]
Simulations = Annotated[
    int | None, typer.Option("--simulations", min=1, help="Simulations per decision of policies that search.")
]
SearchName = Annotated[
    str | None,
    typer.Option(
        "--search",
        help="For policies that search: best-first (the default, deterministic) or uct (the paper's PO-UCT, sampled).",
        show_default=False,
        autocompletion=complete_search,
    ),
]
EstimatorName = Annotated[
    str | None,
    typer.Option(
        "--estimator",
        metavar="FILE|NAME",
        help="What the policy potlp asks: a trained estimator's file, the name of a shipped one, or module:attribute; "
        "default: the one that is shipped for such worlds.",
        show_default=False,
    ),
]
CameraName = Annotated[
    str | None,
    typer.Option("--camera", metavar="NAME", help="module:attribute of a camera of your own.", show_default=False),
]

# A task on its own, without an environment that names its propositions.
Formula = Annotated[
    str,
    typer.Argument(
        metavar="FORMULA", help="A co-safe formula in Spot's syntax, the name of a shipped task, or a .hoa file."
    ),
]
Propositions = Annotated[
    str | None, typer.Option("--propositions", "-p", help="All propositions, in the order of a letter's bits: a,b.")
]

# What is written of one trial.
TrialFolder = Annotated[
    Path | None, typer.Option("--out", "-o", help="Folder for trial.json, trial.png and trial.gif.")
]
Animation = Annotated[bool, typer.Option(help="Make the animation, the slowest of the three files.")]

# What `potlp run` and `potlp sweep` wrote.
TrialFile = Annotated[Path, typer.Argument(metavar="TRIAL", help="Folder or file that `potlp run --out` wrote.")]
SweepFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a sweep, as --out named it.")]

# What makes estimators.
RecipeName = Annotated[
    str | None,
    typer.Option(
        "--recipe",
        "-r",
        help="What makes an estimator: the name of a shipped recipe ([cyan]firefighting[/cyan], "
        "[cyan]firefighting-panorama[/cyan], [cyan]delivery[/cyan], [cyan]parcels[/cyan]) or a file of your own.",
        autocompletion=complete_recipe,
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="Change a setting, such as training.patience=10; may be repeated."
    ),
]
ClusterName = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="WHERE",
        help="Other machines: tcp://HOST:PORT of a Dask scheduler, ssh:HOST,HOST or slurm:partition=...,workers=N "
        "(docs/clusters.md).",
    ),
]
Processes = Annotated[
    int,
    typer.Option(
        "--processes",
        min=1,
        help="Collect in so many processes, each on a core. A fit uses all cores by itself.",
    ),
]


def spread(parameter: str, group: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command a group of options: it receives them as one argument, the command line has one each.

    Args:
        parameter: the command's argument that takes the group.
        group: a dataclass; each field is an option, ``Annotated`` with ``typer.Option``, and its default.

    Returns:
        A decorator, to stand below that of typer.
    """
    fields = dataclasses.fields(group)

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def spreading(**given: Any) -> None:
            values = {field.name: given.pop(field.name) for field in fields}
            command(**given, **{parameter: group(**values)})

        own = [each for each in inspect.signature(command).parameters.values() if each.name != parameter]
        options = [
            inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type)
            for field in fields
        ]
        # Typer reads a command's options from its signature and its annotations; by keyword, because an option of the
        # group may have no default where one before it has.
        every = [*(each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in own), *options]
        vars(spreading)["__signature__"] = inspect.Signature(every)
        spreading.__annotations__ = {each.name: each.annotation for each in every}
        return spreading

    return decorate
