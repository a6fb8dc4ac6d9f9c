"""What ``potlp estimator evaluate`` does; apart, because its imports need the extra ``train``."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from potlp_jax.cli.output import console, fail, note, output_folder, print_json, progress_bar, to_json
from potlp_jax.codec import finite_or_null
from potlp_jax.environments.splits import Split
from potlp_jax.errors import CheckpointError, DatasetError, EvaluationError, NetworkError, TrainingError
from potlp_jax.learning.dataset import Samples, read_dataset
from potlp_jax.learning.metrics import (
    ABLATIONS,
    INTACT,
    Predictions,
    Prior,
    Report,
    ablated,
    check_fit,
    evaluate,
    most_confident,
    predict,
    prior_of,
)
from potlp_jax.learning.network import EstimatorNetwork, Params
from potlp_jax.learning.serialization import load_estimator
from potlp_jax.view.calibration import (
    VARIANTS,
    ablation_table,
    cost_table,
    draw_costs,
    draw_predictions,
    draw_reliability,
    probability_table,
)
from potlp_jax.view.style import save_figure

SHOWN: int = 4
"""Panoramas of each kind in predictions.png."""

_ERRORS = (CheckpointError, DatasetError, EvaluationError, NetworkError, TrainingError)


def run_evaluation(path: Path, dataset: Path, out: Path | None, ablate: str, json: bool) -> None:
    """Evaluate, print, and write what was asked for."""
    variants = _read_variants(ablate)
    try:
        params, config, metadata = load_estimator(path)
        samples = read_dataset(dataset)
        check_fit(config, metadata, samples, str(path), str(dataset))
        _warn(metadata, samples)
        folder = output_folder(out)
        predictions = _predict(EstimatorNetwork(config), params, samples, variants)
    except _ERRORS as error:
        fail(str(error))
    prior = prior_of(metadata, samples)
    reports = {name: evaluate(samples, entry, prior) for name, entry in predictions.items()}
    found = finite_or_null(
        {
            "estimator": str(path),
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
    heading = _heading(path, samples, prior)
    if folder is not None:
        _write(folder, found, heading, reports, samples, predictions[INTACT])
    if json:
        print_json(found)
        return
    _print(console(), heading, reports, [INTACT])
    if folder is not None:
        pictures = "reliability.png, costs.png and predictions.png"
        console().print(f"wrote evaluation.json, table.txt, {pictures} in {folder}", markup=False)


def _read_variants(ablate: str) -> tuple[str, ...]:
    chosen = {"none": (), "all": ABLATIONS, **{name: (name,) for name in ABLATIONS}}
    if ablate not in chosen:
        fail(f"unknown ablation {ablate!r}; choose from: {', '.join(chosen)}")
    return (INTACT, *chosen[ablate])


def _warn(metadata: Mapping[str, Any], samples: Samples) -> None:
    """Say what makes the figures mean less, or more, than one may think."""
    trained_on = metadata.get("data", {})
    own = (samples.metadata.environment, samples.metadata.split)
    if (trained_on.get("environment"), trained_on.get("split")) == own:
        note(f"the estimator was trained on {'/'.join(own)}: these figures say nothing about worlds it has not seen")
    if samples.metadata.split == Split.TEST:
        note("worlds of the test split are for reported figures: log this run")


def _predict(
    network: EstimatorNetwork, params: Params, samples: Samples, variants: tuple[str, ...]
) -> dict[str, Predictions]:
    predictions = {}
    with progress_bar() as progress:
        for name in variants:
            bar = progress.add_task(f"samples, {name}", total=len(samples.success))
            predictions[name] = predict(
                network,
                params,
                ablated(samples, name),
                lambda done, bar=bar: progress.update(bar, completed=done),
            )
    return predictions


def _heading(path: Path, samples: Samples, prior: Prior) -> str:
    of_what = "the training data" if prior.source == "training" else "these samples"
    return (
        f"{path.name} on {samples.metadata.environment}/{samples.metadata.split}: {len(samples.images)} panoramas, "
        f"{len(samples.success)} samples; constant prior {prior.value:.3f}, the mean P_S of {of_what}"
    )


def _print(out: Console, heading: str, reports: Mapping[str, Report], variants: Sequence[str]) -> None:
    out.print(heading, markup=False, style="bold")
    for name in variants:
        out.print(probability_table(reports[name], VARIANTS[name]))
        out.print(cost_table(reports[name], VARIANTS[name]))
    if len(reports) > 1:
        out.print(ablation_table(reports))


def _write(
    folder: Path,
    found: Mapping[str, Any],
    heading: str,
    reports: Mapping[str, Report],
    samples: Samples,
    predictions: Predictions,
) -> None:
    (folder / "evaluation.json").write_text(to_json(found) + "\n", "utf-8")
    with (folder / "table.txt").open("w", encoding="utf-8") as file:
        _print(Console(file=file, width=160, highlight=False), heading, reports, list(reports))
    chosen = most_confident(samples, predictions, SHOWN)
    save_figure(draw_reliability(reports, heading), folder / "reliability.png")
    save_figure(draw_costs(samples, predictions, reports[INTACT].overall, heading), folder / "costs.png")
    save_figure(draw_predictions(samples, predictions, chosen, heading), folder / "predictions.png")
