"""What a network's configuration takes from its training data: the camera, and units of distances and costs."""

from typing import Any

import numpy as np
from jaxtyping import Bool

from potlp_jax.errors import TrainingError
from potlp_jax.learning.dataset import Samples, decode
from potlp_jax.learning.domain import FLOOR


def image_shape(samples: Samples) -> tuple[int, int]:
    """Rows and columns of the panoramas. Raises TrainingError where there are none."""
    if not samples.images:
        raise TrainingError("the dataset has no panoramas: collect more worlds")
    # All panoramas of a dataset have the size of the first.
    rows, columns, _ = decode(samples.images[0]).shape
    return rows, columns


def cost_scales(samples: Samples, usable: Bool[np.ndarray, "N"] | None = None) -> dict[str, Any]:
    """``success_cost_scale``, ``failure_cost_scale``: each cost's spread where it counts in the loss; and ``step``.

    Args:
        samples: the training data.
        usable: those that are learned from; all by default.
    """
    step = float(samples.metadata.resolution)
    succeeded, failed = samples.success > 0, (samples.success < 1) & np.isfinite(samples.failure_cost)
    if usable is not None:
        succeeded, failed = succeeded & usable, failed & usable
    # Scales are rounded nowhere: they are part of what the network answers and stored with it.
    return {
        "success_cost_scale": spread(samples.success_cost[succeeded], step),
        "failure_cost_scale": spread(samples.failure_cost[failed], step),
        "step": step,
    }


def camera_geometry(samples: Samples, asker: str) -> dict[str, Any]:
    """``horizon``, ``far`` and ``fold`` of the camera, in cells.

    Args:
        samples: the training data.
        asker: what needs them, in the message.

    Raises:
        TrainingError: the data do not say how their camera sees the floor. Real data need not.
    """
    camera = samples.metadata.camera
    missing = [name for name in FLOOR if name not in camera]
    if missing:
        raise TrainingError(
            f"{asker} needs {', '.join(missing)} of the data set's camera (docs/camera.md): collect it again, or train "
            "a panorama network without a fovea"
        )
    return {name: float(camera[name]) for name in FLOOR}


def spread(values: np.ndarray, least: float) -> float:
    """Standard deviation, at least ``least``."""
    # In float64: a sum of a million squares in float32 loses digits. At least a cell, should all values be equal.
    return max(float(np.std(values, dtype=np.float64)), least) if len(values) else least
