"""How far estimators are from what could be known: by the moves made before, and by what is asked for.

A data set whose labels are means over the buildings that a robot may be in (``potlp collect --set posterior=16``) says
what an ideal observer answers. The Brier score of an estimator in these buildings is the observer's doubt, which nobody
takes away, and its excess over that: its mean squared distance from the observer. Means over n buildings that are drawn
independently have noise of their own: where all that is asked for is drawn so, the doubt shown is too small by its
``n - 1``-th part, and the excess too large by as much.

    potlp collect firefighting --split validation --worlds 40 --out data/means --set posterior=16 --set driver=potlp \
        --set estimator=firefighting --set drives=1 --set views_per_world=20 --set spacing=[4,40]
    python -m eval.limit.excess firefighting --data data/means --report out/excess
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
from jaxtyping import Bool, Float64, Int64

from potlp_jax.errors import EvaluationError
from potlp_jax.learning.dataset import Samples, finished_shards, views_file
from potlp_jax.learning.dataset_reading import read_dataset
from potlp_jax.learning.estimator import TrainedEstimator, named_estimator
from potlp_jax.learning.learners import learner_of
from potlp_jax.learning.predictions import check_fit, predict
from potlp_jax.sweep.rows import provenance

STEPS = ((0, 10), (10, 40), (40, 100), (100, None))
"""Moves made before the question: from, and until which number; None: any."""


def moves_of(folder: Path, samples: Samples) -> Int64[np.ndarray, " N"]:
    """How many moves the robot had made before each sample."""
    files = [views_file(folder, shard) for shard in sorted(finished_shards(folder))]
    steps = np.concatenate([pyarrow.parquet.read_table(file, columns=["step"])["step"].to_numpy() for file in files])
    return steps.astype(np.int64)[np.asarray(samples.view_of)]


def groups(samples: Samples, moves: Int64[np.ndarray, " N"]) -> Iterator[tuple[str, Bool[np.ndarray, " N"]]]:
    """Names of groups of samples, and which belong to them."""
    yield "all", np.ones(len(moves), bool)
    for first, until in STEPS:
        name = f"{first} moves or more" if until is None else f"{first} to {until - 1} moves"
        yield name, (moves >= first) & (moves < (np.inf if until is None else until))
    for index, name in enumerate(samples.metadata.propositions):
        yield f"for {name}", np.asarray(samples.phi_go[:, index] > 0)


def excess_of(name: str, samples: Samples) -> Float64[np.ndarray, " N"]:
    """The squared distance of an estimator from each label.

    Raises:
        EvaluationError: it was not trained here, or from other pictures, maps, labels or units than those of the
            samples.
    """
    estimator = named_estimator(name)
    if not isinstance(estimator, TrainedEstimator):
        raise EvaluationError(f"{name}: only estimators that were trained with this library answer data sets")
    check_fit(estimator.config, estimator.domain, samples, name, "the data set", estimator.metadata)
    answers = predict(learner_of(estimator.config), estimator.params, samples).success
    return (answers - np.asarray(samples.success, np.float64)) ** 2


def results_of(names: list[str], folder: Path) -> dict[str, Any]:
    """Doubt and excess of every group.

    Raises:
        EvaluationError: the labels of the data set are of single buildings.
    """
    samples = read_dataset(folder)
    if not samples.metadata.collection.get("posterior"):
        raise EvaluationError(f"{folder}: its labels are of single buildings; collect with --set posterior=16")
    labels = np.asarray(samples.success, np.float64)
    excess = {name: excess_of(name, samples) for name in names}
    rows = [
        {
            "group": group,
            "questions": int(chosen.sum()),
            "doubt": _mean((labels * (1 - labels))[chosen]),
            "excess": {name: _mean(values[chosen]) for name, values in excess.items()},
        }
        for group, chosen in groups(samples, moves_of(folder, samples))
    ]
    return {
        "provenance": provenance(),
        "views": len(samples.images),
        "worlds": len(np.unique(samples.world_of)),
        "rows": rows,
    }


def _mean(values: Float64[np.ndarray, " N"]) -> float | None:
    """None where there are no values."""
    return float(np.mean(values)) if len(values) else None


def markdown(results: dict[str, Any]) -> str:
    """The table of a page."""
    names = list(results["rows"][0]["excess"])
    lines = [f"| questions | number | doubt | {' | '.join(f'excess of {name}' for name in names)} |"]
    lines.append("|---" * (3 + len(names)) + "|")
    for row in results["rows"]:
        figures = [row["doubt"], *(row["excess"][name] for name in names)]
        shown = " | ".join("-" if figure is None else f"{figure:.4f}" for figure in figures)
        lines.append(f"| {row['group']} | {row['questions']:,} | {shown} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("estimators", nargs="+", help="names or files")
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--report", type=Path, help="without suffix: where the results go")
    options = parser.parse_args()
    results = results_of(options.estimators, options.data)
    print(markdown(results))
    if options.report is not None:
        options.report.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
