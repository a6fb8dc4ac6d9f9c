"""How an estimator is trained: what a user may set, with values that are checked."""

import dataclasses

from potlp_jax.checks import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, SEED, SHARE, require_fields
from potlp_jax.errors import TrainingError
from potlp_jax.learning.augmentation import Augmentation


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """How to train, apart from how long.

    Attributes:
        seed: of the parameters, the order of the data and the augmentation.
        views_per_batch, samples_per_view: views in a batch, and samples of each; a view with more samples gives
            a new random choice in every epoch, one with fewer is padded.
        learning_rate: the peak, after a linear rise, then a cosine to 0.
        warmup: share of all steps over which the learning rate rises.
        weight_decay: of AdamW.
        clip_norm: the gradient is scaled down to this norm.
        average_decay: of the moving average of the parameters that is evaluated and kept; 0 for none.
        weighting: 1: the cross-entropy weighted by what mistakes cost; 0: not weighted; anything between is a mix.
        cost_share: factor of both cost terms.
        view_share: factor of what the network says of a view beside its answers.
        augmentation: how views are varied.
        patience: evaluations without a better validation loss before training stops; 0 for never.
        checkpoint_steps: steps between checkpoints; there is one after every epoch too.
    """

    seed: int = 0
    views_per_batch: int = 16
    samples_per_view: int = 16
    learning_rate: float = 2e-3
    warmup: float = 0.05
    weight_decay: float = 1e-3
    clip_norm: float = 1.0
    average_decay: float = 0.995
    weighting: float = 0.25
    cost_share: float = 0.5
    view_share: float = 1.0
    augmentation: Augmentation = Augmentation()
    patience: int = 6
    checkpoint_steps: int = 200

    def __post_init__(self) -> None:
        names = ("views_per_batch", "samples_per_view", "checkpoint_steps")
        require_fields(self, names, AT_LEAST_ONE, TrainingError)
        require_fields(self, ("weighting", "warmup", "average_decay"), SHARE, TrainingError)
        require_fields(self, ("learning_rate", "clip_norm"), POSITIVE, TrainingError)
        require_fields(self, ("weight_decay", "cost_share", "view_share", "patience"), NOT_NEGATIVE, TrainingError)
        require_fields(self, ("seed",), SEED, TrainingError)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingConfig(TrainingOptions):
    """How to train, and how long.

    Attributes:
        steps: planned optimiser steps; the learning rate ends at 0 there.
    """

    # Apart from the options: a plan for a time knows the number only when the speed has been measured.
    steps: int

    def __post_init__(self) -> None:
        super().__post_init__()
        require_fields(self, ["steps"], AT_LEAST_ONE, TrainingError)
