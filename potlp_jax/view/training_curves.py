"""The curves of a training as a picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt

PANELS: Mapping[str, str] = {
    "loss": "loss",
    "cross_entropy": "weighted cross-entropy",
    "skill": "Brier skill over the constant prior",
    "success_rmse": "RMSE of R_S",
    "failure_rmse": "RMSE of R_F",
}
"""What is drawn, by the name in the journal's rows."""


def draw_curves(rows: Sequence[Mapping[str, int | float]], path: Path) -> None:
    """Draw each figure over the epochs: of the training batches (augmented) and of the validation data.

    Args:
        rows: of the journal (``recipes.journal``), one for each epoch.
        path: the picture's file.
    """
    figure, axes = plt.subplots(1, len(PANELS), figsize=(4 * len(PANELS), 3.2), layout="constrained")
    for axis, (key, title) in zip(axes, PANELS.items(), strict=True):
        for name in ("training", "validation"):
            axis.plot([row["epoch"] for row in rows], [row[f"{name}_{key}"] for row in rows], ".-", label=name)
        axis.set_title(title)
        axis.set_xlabel("epoch")
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(path, dpi=90)
    plt.close(figure)
