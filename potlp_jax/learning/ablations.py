"""What is left of a data set without its pictures or its questions.

A network that does not look answers as well with its pictures blacked out; one that does not heed the question answers
as well with the vectors phi of other samples. Groups and labels stay those of the intact samples (``metrics``).
"""

import dataclasses

import numpy as np

from potlp_jax.errors import EvaluationError
from potlp_jax.learning.dataset import Samples, decode, encode
from potlp_jax.learning.map_images import without_painting

INTACT = "intact"

ABLATIONS: tuple[str, ...] = ("image", "phi")

# Fixed, so that the ablation of a data set is the same for every estimator.
SHUFFLE_SEED: int = 0


def ablated(samples: Samples, ablation: str) -> Samples:
    """The samples without what ``ablation`` takes away.

    ``image``: all panoramas black, and nothing painted on the maps. ``phi``: each sample has the pair of vectors phi of
    another one, by a permutation drawn from ``SHUFFLE_SEED``. ``intact``: the samples themselves.
    """
    if ablation == INTACT:
        return samples
    if ablation == "image":
        # As PNG: JPEG may not give back what is exactly black.
        black = encode(np.zeros_like(decode(samples.images[0])), "png")
        blank = [without_painting(view) for view in samples.maps]
        return dataclasses.replace(samples, images=[black] * len(samples.images), maps=blank)
    if ablation == "phi":
        # A permutation keeps how often each pair occurs: only its connection with the sample is gone.
        order = np.random.default_rng(SHUFFLE_SEED).permutation(len(samples.view_of))
        return dataclasses.replace(samples, phi_stay=samples.phi_stay[order], phi_go=samples.phi_go[order])
    raise EvaluationError(f"unknown ablation {ablation!r}; choose from: {', '.join(ABLATIONS)}")
