"""The curves of a training as a picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.ticker import MaxNLocator

from potlp_jax.view.style import INK, SERIES_COLOURS, new_figure, save_figure

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
    # Drawn anew at each evaluation, beside the thread that makes batches: pyplot's global state has no place here.
    figure = new_figure(4.0 * len(PANELS), 3.2)
    figure.set_layout_engine("constrained")
    panels = figure.subplots(1, len(PANELS))
    for axes, (key, title) in zip(panels, PANELS.items(), strict=True):
        # Each scale is its own: a loss, a skill and a cost have no common unit.
        for name, colour in zip(("training", "validation"), SERIES_COLOURS, strict=False):
            values = [row[f"{name}_{key}"] for row in rows]
            axes.plot([row["epoch"] for row in rows], values, ".-", color=colour, label=name)
        axes.set_title(title, size=11, color=INK)
        axes.set_xlabel("epoch", color=INK)
        # Epochs are whole; a tick at 1.5 would name none.
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    panels[0].legend()
    save_figure(figure, path)
