"""Do frontiers exclude each other? How often one of two subgoals succeeds where the other has failed.

Pairs of subgoals that one panorama shows, asked for the same outcome class, by their distance from each other: how
often both succeed and any does, beside what independent chances and their sum say. The
``exclusive_within`` of an estimator, and ``learning.exclusion.SURE``, come from here.

    python -m eval.exclusion potlp_jax/learning/data/firefighting-panorama.npz data/validation data/calibration
"""

import argparse
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from potlp_jax.learning.dataset_reading import read_dataset
from potlp_jax.learning.learners import learner_of
from potlp_jax.learning.predictions import answerable, predict
from potlp_jax.learning.serialization import load_estimator

EDGES = (0, 10, 16, 25, 40, 80, 200)
"""Of the classes of distance, in cells."""

MIDDLE = (0.3, 0.7)
"""Chances that leave it open which of two it is."""


def pairs_of(estimator: Path, dataset: Path) -> Float64[np.ndarray, "pairs 5"]:
    """Distance in cells, and of both subgoals P_S as predicted and whether it succeeded, for every pair."""
    params, config, _, _ = load_estimator(estimator)
    samples = read_dataset(dataset)
    learner = learner_of(config)
    samples = answerable(learner, samples)
    logits = np.asarray(predict(learner, params, samples).success_logit, float)
    chances, truth = 1.0 / (1.0 + np.exp(-logits)), np.asarray(samples.success, float)
    together: dict[tuple, dict[tuple[int, int], int]] = {}
    for index, view in enumerate(samples.view_of.tolist()):
        question = view, tuple(samples.phi_stay[index].tolist()), tuple(samples.phi_go[index].tolist())
        row, column = samples.cells[index].tolist()
        together.setdefault(question, {})[row, column] = index
    found = []
    for subgoals in together.values():
        for (first, i), (second, j) in combinations(subgoals.items(), 2):
            apart = float(np.hypot(first[0] - second[0], first[1] - second[1]))
            found.append((apart, chances[i], truth[i], chances[j], truth[j]))
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("estimator", type=Path)
    parser.add_argument("datasets", type=Path, nargs="+", help="that the estimator was not trained on")
    arguments = parser.parse_args()
    pairs = np.concatenate([pairs_of(arguments.estimator, dataset) for dataset in arguments.datasets])
    print("| cells apart | pairs | both | both, if independent | any | any, if independent | any, by the sum |")
    print("|---|---|---|---|---|---|---|")
    for low, high in pairwise(EDGES):
        chosen = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high)]
        _print(f"{low} to {high}", chosen)
        middle = np.all((chosen[:, [1, 3]] > MIDDLE[0]) & (chosen[:, [1, 3]] < MIDDLE[1]), axis=1)
        _print(f"- both {MIDDLE[0]} to {MIDDLE[1]}", chosen[middle])


def _print(name: str, pairs: Float64[np.ndarray, "pairs 5"]) -> None:
    if not len(pairs):
        return
    _, p, hit, q, other = pairs.T
    independent, by_sum = 1 - (1 - p) * (1 - q), np.minimum(p + q, 1)
    figures = [hit * other, p * q, np.maximum(hit, other), independent, by_sum]
    print(f"| {name} | {len(pairs)} | " + " | ".join(f"{np.mean(figure):.3f}" for figure in figures) + " |")


if __name__ == "__main__":
    main()
