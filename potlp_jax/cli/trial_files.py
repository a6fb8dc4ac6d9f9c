"""What ``potlp run`` and ``potlp sweep trial`` write and print of one trial."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from potlp_jax.cli.output import console, fail, print_next, progress_bar

if TYPE_CHECKING:
    from potlp_jax.trials.record import Trial

# In this order, below the outcome.
_SHOWN = ("task", "environment", "world", "policy", "steps", "decisions", "fallbacks")


def require_folder(out: Path | None, animation: bool) -> None:
    """Refuse options of what would not be written."""
    if out is None and not animation:
        fail("--no-animation needs --out: without a folder there is no animation")


def write_trial(trial: "Trial", folder: Path, animation: bool) -> list[Path]:
    """Write a trial into a folder.

    Args:
        trial: that has ended.
        folder: which exists; what shows an earlier trial there is removed.
        animation: whether to draw that, too, which takes longest.

    Returns:
        The files: the record, the picture and the animation.
    """
    from potlp_jax.cli.inputs import RECORD
    from potlp_jax.cli.view import PAGE
    from potlp_jax.view.animation import save_animation
    from potlp_jax.view.maps import draw_trial
    from potlp_jax.view.style import save_figure

    files = [folder / RECORD, folder / "trial.png"]
    # What shows an earlier trial would stand beside the record of this one.
    for shown in ("trial.png", "trial.gif", PAGE):
        (folder / shown).unlink(missing_ok=True)
    # First of all: should drawing fail, the trial is not lost.
    trial.save(files[0])
    save_figure(draw_trial(trial), files[1])
    if animation:
        files.append(folder / "trial.gif")
        with progress_bar() as progress:
            bar = progress.add_task("drawing the animation")
            save_animation(
                trial, files[2], progress=lambda done, total: progress.update(bar, completed=done, total=total)
            )
    return files


def print_trial(trial: "Trial", files: list[Path]) -> None:
    """Print a trial's outcome, cost and counts, the files that were written, and what to do next with them."""
    from potlp_jax.trials.record import Outcome
    from potlp_jax.types import status_names

    out = console()
    # The colour repeats the word, so that nothing is lost without it.
    colour = "green" if trial.outcome is Outcome.SATISFIED else "red"
    out.print(Text.assemble((trial.outcome.value, f"bold {colour}"), f"  cost {trial.cost:.2f}"))
    summary = trial.summary()
    for name in _SHOWN:
        out.print(f"{name:12} {summary[name]}")
    # Flags say that an array or a loop was too small for this trial (`types.Status`); most trials have none.
    if trial.status:
        flags = ", ".join(status_names(trial.status)).replace("_", " ")
        out.print(f"{'status':12} {flags}")
    for file in files:
        out.print(f"wrote {file}")
    # What one would do next with these files; a newcomer need not look it up.
    if files:
        # A trial that ended where it began has no decision to explain.
        folder = str(files[0].parent)
        command = ["explain", f"{folder}:0"] if trial.decisions else ["view", folder]
        print_next(out, shlex.join(["potlp", *command]))
    else:
        out.print("add --out FOLDER for the record, a picture and an animation", style="dim")
