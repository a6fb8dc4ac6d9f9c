"""``potlp view``: a recorded trial as a page in the browser."""

import webbrowser
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from potlp_jax.cli.output import console, fail, note
from potlp_jax.cli.run import RECORD
from potlp_jax.trials.record import Trial, load_trial
from potlp_jax.trials.replay import panorama_at
from potlp_jax.view.replay_page import replay_page

PAGE: str = "replay.html"
"""Name of the page beside the record, unless another is given."""


def view_trial(record: Path, out: Path | None, open_it: bool) -> None:
    """Write the replay of a trial and, unless told otherwise, open it."""
    file = record / RECORD if record.is_dir() else record
    trial = load_trial(file)
    page = out or file.with_name(PAGE)
    if page.suffix != ".html":
        fail(f"--out {page}: give a name that ends in .html")
    page.write_text(replay_page(trial, panoramas_of(trial)), "utf-8")
    console().print(f"wrote {page}", markup=False)
    if open_it and not webbrowser.open(page.resolve().as_uri()):
        note("there is no browser to open it with")


def panoramas_of(trial: Trial) -> dict[int, UInt8[np.ndarray, "rows columns 3"]]:
    """What the camera saw at the decisions whose panoramas were used, by number; none for policies that do not look."""
    looks = sorted({look for decision in trial.decisions for look in decision.observations})
    return {look: np.asarray(panorama_at(trial, trial.decisions[look])) for look in looks}
