"""``potlp estimator``: what an estimator is, and how good it is."""

import dataclasses
import importlib.util
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from potlp_jax.cli.group import Command, command_app
from potlp_jax.cli.options import Json
from potlp_jax.cli.output import FAILED, console, fail, file_console, make_folder, print_json, progress_bar, to_json
from potlp_jax.learning.made_from import (
    map_shape_of,
    mapping_in,
    number_in,
    text_in,
    trained_before_on,
    trained_on,
)

if TYPE_CHECKING:
    from potlp_jax.learning.dataset import Samples
    from potlp_jax.learning.learner import Learner
    from potlp_jax.learning.metrics import Prior, Report
    from potlp_jax.learning.network import Params
    from potlp_jax.learning.predictions import Predictions

logger = logging.getLogger(__name__)

SHOWN: int = 4
"""Panoramas of each kind in predictions.png."""

app = command_app("estimator", "Describe or evaluate a trained estimator.")
EstimatorArgument = Annotated[
    Path,
    typer.Argument(
        metavar="ESTIMATOR", help="An estimator (.npz), as `potlp fit` writes it; or the name of one that is shipped."
    ),
]


@app.command(
    "evaluate",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp estimator evaluate out/fit/estimator.npz data/validation[/cyan]

[cyan]potlp estimator evaluate out/fit/estimator.npz data/validation --ablate all --out out/figures[/cyan]

[dim]Needs the extra: pip install 'potlp-jax\\[train]'. docs/estimator.md says what the figures mean.[/dim]
""",
)
def evaluate_estimator(
    estimator: EstimatorArgument,
    dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of samples from `potlp collect`.")],
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
    # Asked before the long imports; without pyarrow the error would name a module instead of what to install.
    if importlib.util.find_spec("pyarrow") is None:
        fail("data sets are Parquet files, and pyarrow is not installed: pip install 'potlp-jax[train]'", FAILED)
    from potlp_jax.codec import finite_or_null
    from potlp_jax.learning.ablations import INTACT
    from potlp_jax.learning.dataset_reading import read_dataset
    from potlp_jax.learning.estimator import estimator_file
    from potlp_jax.learning.learners import learner_of
    from potlp_jax.learning.metrics import evaluate, prior_of
    from potlp_jax.learning.predictions import answerable, check_fit
    from potlp_jax.learning.serialization import load_estimator
    from potlp_jax.sweep.rows import provenance

    # Before the file is read and the network compiled, like every check of words.
    variants = _read_variants(ablate)
    estimator = estimator_file(estimator)
    params, config, domain, metadata = load_estimator(estimator)
    samples = read_dataset(dataset)
    # An estimator asked about propositions that it does not know would answer without meaning.
    check_fit(config, domain, samples, str(estimator), str(dataset), metadata)
    _warn(metadata, samples)
    folder = None if out is None else make_folder(out)
    learner = learner_of(config)
    samples = answerable(learner, samples)
    predictions = _predict(learner, params, samples, variants)
    # Skill is measured against this constant; the training data's is honest, since the samples' own would be fitted.
    prior = prior_of(metadata, samples)
    reports = {name: evaluate(samples, entry, prior) for name, entry in predictions.items()}
    found = finite_or_null(
        {
            "provenance": provenance(),
            "estimator": str(estimator),
            "dataset": str(dataset),
            "environment": samples.metadata.environment,
            "split": samples.metadata.split,
            "panoramas": len(samples.images),
            "unit": samples.metadata.unit,
            "prior": prior.value,
            "prior_source": prior.source,
            "figures": {name: report.to_dict() for name, report in reports.items()},
        }
    )
    heading = _heading(estimator, samples, prior)
    if folder is not None:
        (folder / "evaluation.json").write_text(to_json(found) + "\n", "utf-8")
        _write(folder, heading, reports=reports, samples=samples, predictions=predictions[INTACT])
    if json:
        print_json(found)
        return
    _print_reports(console(), heading, reports, [INTACT])
    if folder is not None:
        pictures = "reliability.png, costs.png and predictions.png"
        console().print(f"wrote evaluation.json, table.txt, {pictures} in {folder}")


def _read_variants(ablate: str) -> tuple[str, ...]:
    from potlp_jax.learning.ablations import ABLATIONS, INTACT

    chosen = {"none": (), "all": ABLATIONS, **{name: (name,) for name in ABLATIONS}}
    if ablate not in chosen:
        fail(f"unknown ablation {ablate!r}; choose from: {', '.join(chosen)}")
    return (INTACT, *chosen[ablate])


def _warn(metadata: Mapping[str, Any], samples: "Samples") -> None:
    """Say what makes the figures mean less, or more, than one may think."""
    from potlp_jax.cli.inputs import warn_of_test_worlds
    from potlp_jax.environments.splits import Split

    own = (samples.metadata.environment, samples.metadata.split)
    sources = [*trained_on(metadata), *trained_before_on(metadata)]
    # By name and split: other worlds of the same split are still worlds that training may have seen.
    if any((source.get("environment"), source.get("split")) == own for source in sources):
        logger.warning(
            f"the estimator was trained on {'/'.join(own)}: these figures say nothing about worlds it has not seen"
        )
    if samples.metadata.split == Split.TEST:
        warn_of_test_worlds()


def _predict(
    learner: "Learner", params: "Params", samples: "Samples", variants: tuple[str, ...]
) -> "dict[str, Predictions]":
    from potlp_jax.learning.ablations import ablated
    from potlp_jax.learning.predictions import predict

    predictions = {}
    with progress_bar() as progress:
        for name in variants:
            bar = progress.add_task(f"samples, {name}", total=len(samples.success))
            predictions[name] = predict(
                learner,
                params,
                ablated(samples, name),
                # Bound now: a closure would show the last bar's progress for all.
                lambda done, bar=bar: progress.update(bar, completed=done),
            )
    return predictions


def _heading(path: Path, samples: "Samples", prior: "Prior") -> str:
    of_what = "the training data" if prior.source == "training" else "these samples"
    return (
        f"{path.name} on {samples.metadata.environment}/{samples.metadata.split}: {len(samples.images)} panoramas, "
        f"{len(samples.success)} samples; constant prior {prior.value:.3f}, the mean P_S of {of_what}"
    )


def _print_reports(out: Console, heading: str, reports: "Mapping[str, Report]", variants: Sequence[str]) -> None:
    from potlp_jax.view.calibration import VARIANTS, ablation_table, cost_bin_table, cost_table, probability_table

    out.print(heading, style="bold")
    for name in variants:
        out.print(probability_table(reports[name], VARIANTS[name]))
        out.print(cost_table(reports[name], VARIANTS[name]))
        out.print(cost_bin_table(reports[name], VARIANTS[name]))
    if len(reports) > 1:
        out.print(ablation_table(reports))


def _write(
    folder: Path, heading: str, *, reports: "Mapping[str, Report]", samples: "Samples", predictions: "Predictions"
) -> None:
    from potlp_jax.learning.ablations import INTACT
    from potlp_jax.learning.predictions import most_confident
    from potlp_jax.view.calibration import draw_costs, draw_reliability
    from potlp_jax.view.predictions import draw_predictions
    from potlp_jax.view.style import save_figure

    with (folder / "table.txt").open("w", encoding="utf-8") as file:
        _print_reports(file_console(file, width=160), heading, reports, list(reports))
    # The confident ones, right and wrong, show most of what the network has learned.
    chosen = most_confident(samples, predictions, SHOWN)
    save_figure(draw_reliability(reports, heading), folder / "reliability.png")
    save_figure(draw_costs(samples, predictions, reports[INTACT], heading), folder / "costs.png")
    save_figure(draw_predictions(samples, predictions, chosen, heading), folder / "predictions.png")


@app.command(
    "info",
    cls=Command,
    epilog="""
[bold]Examples[/bold]

[cyan]potlp estimator info out/fit/estimator.npz[/cyan]

[cyan]potlp estimator info firefighting[/cyan] - the shipped one

[cyan]potlp estimator info out/fit/estimator.npz --json[/cyan]
""",
)
def show_estimator(estimator: EstimatorArgument, json: Json = False) -> None:
    """Show what an estimator knows, how large it is and how it was trained."""
    from potlp_jax.codec import finite_or_null
    from potlp_jax.learning.architectures import architecture_of
    from potlp_jax.learning.estimator import estimator_file
    from potlp_jax.learning.network import parameter_count
    from potlp_jax.learning.serialization import load_estimator

    estimator = estimator_file(estimator)
    params, config, domain, metadata = load_estimator(estimator)
    architecture = architecture_of(config)
    # What a map costs goes by its size; 64 × 192 cells where the file does not say of what maps it learned.
    shape = map_shape_of(metadata) or (64, 192)
    description = {
        "estimator": str(estimator),
        "bytes": estimator.stat().st_size,
        "parameters": parameter_count(params),
        "operations": architecture.operations(config, shape),
        "architecture": architecture.name,
        "network": dataclasses.asdict(config),
        "domain": dataclasses.asdict(domain),
        "metadata": metadata,
    }
    if json:
        print_json(finite_or_null(description))
        return
    out = console()
    out.print(str(estimator), style="bold")
    table = Table(box=SIMPLE_HEAD, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column()
    for name, value in _rows(description):
        table.add_row(name, value)
    out.print(table)


def _sizes(description: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The sizes of the network, by its architecture."""
    network = description["network"]
    if description["architecture"] == "building":
        return [
            ("convolutions", f"{_list(network['widths'])} channels, with {_list(network['blocks'])} residual blocks"),
            ("way back, head", f"{network['decoder']} channels, {network['head']} units"),
        ]
    from potlp_jax.learning.fovea import ABOVE, BAND, BELOW

    reach = network["fovea"]
    fovea = f"{2 * reach + 1} columns × {(ABOVE + BELOW) * BAND} rows around each subgoal" if reach else "nothing"
    return [
        ("fovea", fovea),
        ("convolutions", f"{_list(network['first_widths'])}, then {_list(network['second_widths'])} channels"),
        ("fully connected", f"{_list(network['dense_widths'])} units"),
    ]


def _rows(description: dict[str, Any]) -> list[tuple[str, str]]:
    """Names and values for people; what the file does not say is left out."""
    network, domain, metadata = (description[name] for name in ("network", "domain", "metadata"))
    operations = description["operations"]
    return [
        ("propositions", ", ".join(network["propositions"])),
        ("serves", f"worlds of {domain['family'] or 'no named family'}, costs in {domain['unit']}"),
        ("panorama", " × ".join(map(str, network["image_shape"])) + " pixels"),
        ("file", f"{description['bytes'] / 1e6:.2f} MB, {description['parameters']:,} parameters"),
        ("arithmetic", "; ".join(f"{count / 1e6:.2f} MFLOP {what}" for what, count in operations.items())),
        ("architecture", description["architecture"]),
        *_sizes(description),
        *_rows_of_making(metadata),
    ]


def _rows_of_making(metadata: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """How an estimator was made. Files of others may lack any entry, or have something else in its place."""
    if initial := text_in(metadata, "initial"):
        yield "goes on from", initial
    for name, sources in (("trained on", trained_on(metadata)), ("before that on", trained_before_on(metadata))):
        yield from zip([name, *[""] * (len(sources) - 1)], map(_in_words, sources), strict=False)
    counts = [(name, number_in(metadata, name)) for name in ("panoramas", "samples")]
    if counted := ", ".join(f"{count:,} {name}" for name, count in counts if count is not None):
        yield "", counted
    if training := _training_in_words(metadata):
        yield "training", training
    prior = number_in(metadata, "prior")
    if prior is not None:
        yield "mean P_S of the data", f"{prior:.4f}"
    figures = mapping_in(metadata, "figures")
    for name in figures:
        value = number_in(figures, name)
        if value is not None and name.startswith("validation_") and name != "validation_samples":
            yield name.replace("_", " "), f"{value:.4f}"
    if versions := mapping_in(metadata, "versions"):
        yield "versions", ", ".join(f"{name} {value}" for name, value in versions.items())


def _training_in_words(metadata: Mapping[str, Any]) -> str:
    """How long a training was and how it ended; empty where the file does not say how many steps it had."""
    steps, seconds, best = (number_in(metadata, name) for name in ("steps", "seconds", "best_step"))
    if steps is None:
        return ""
    words = f"{steps:,} steps"
    if seconds is not None:
        words += f" in {seconds / 60:.0f} minutes"
    if ended_by := text_in(metadata, "ended_by"):
        words += f", ended by {ended_by}"
    return words if best is None else f"{words}; best at step {best:,}"


def _in_words(source: Mapping[str, Any]) -> str:
    words = "/".join(text_in(source, name) or "not named" for name in ("environment", "split"))
    worlds, first = number_in(source, "worlds"), number_in(source, "first_world")
    if worlds is not None:
        words += f", {worlds} worlds"
    if driver := text_in(source, "driver"):
        asked = text_in(source, "estimator")
        words += (
            (f" from {first}" if first is not None else "") + f", by {driver}" + (f" with {asked}" if asked else "")
        )
    return words


def _list(values: Sequence[int]) -> str:
    return ", ".join(map(str, values))
