"""The record of a training on disk: a table, curves, TensorBoard's files, and a line about each epoch."""

import csv
import dataclasses
import io
from collections.abc import Callable, Sequence
from pathlib import Path

from tensorboardX import SummaryWriter

from potlp_jax.errors import TrainingError
from potlp_jax.files import MOST_RECORD, read_text, reading, write_whole
from potlp_jax.learning.training import Progress

TABLE: str = "log.csv"
CURVES: str = "curves.png"

Row = dict[str, int | float]
"""Figures of one evaluation by name."""


@dataclasses.dataclass(frozen=True)
class Display:
    """How a training shows itself while it runs. The defaults show nothing.

    Attributes:
        say: one line of text.
        advance: steps done, and planned.
        draw: the journal's rows as a picture in a file.
    """

    say: Callable[[str], None] = lambda line: None
    advance: Callable[[int, int], None] = lambda done, planned: None
    draw: Callable[[Sequence[Row], Path], None] = lambda rows, path: None


class Journal:
    """Writes down a training as it goes. Rows after the step that is resumed from are written again."""

    def __init__(self, folder: Path, planned: int, display: Display) -> None:
        """A journal in ``folder`` for a training of so many ``planned`` steps."""
        self._folder, self._planned, self._display = folder, planned, display
        self._rows: list[Row] = []
        self._writer: SummaryWriter | None = None

    def observers(self) -> dict[str, Callable[..., None]]:
        """What ``learning.training.train`` tells how it goes."""
        return {"on_start": self.start, "on_step": self.step, "on_evaluation": self.evaluation}

    def start(self, step: int) -> None:
        """Training starts with ``step`` steps done."""
        if step:
            self._display.say(f"resumed at step {step}")
        # A process may have been killed after it wrote a row and before it saved the checkpoint.
        self._rows = [row for row in _read_rows(self._folder / TABLE) if row["step"] <= step]
        self._display.advance(step, self._planned)
        # TensorBoard drops what it shows after this step: the resumed training writes it again.
        self._writer = SummaryWriter(str(self._folder / "tensorboard"), purge_step=step + 1)

    def step(self, step: int, loss: float) -> None:
        """One step is done."""
        self._display.advance(step, self._planned)

    def evaluation(self, progress: Progress) -> None:
        """An epoch is done."""
        row = _row_of(progress)
        self._rows.append(row)
        self._write_table()
        # After every epoch, so that a long training can be watched.
        self._display.draw(self._rows, self._folder / CURVES)
        assert self._writer is not None
        for name, value in row.items():
            if name != "step":
                # TensorBoard groups curves by what stands before the first stroke: training or validation.
                self._writer.add_scalar(name.replace("_", "/", 1), value, progress.step)
        self._writer.flush()
        self._display.say(describe(progress))

    def close(self) -> None:
        """Training is over."""
        if self._writer is not None:
            self._writer.close()

    def row_of_step(self, step: int) -> Row:
        """The row of the evaluation at this step; empty where there was none."""
        return next((row for row in self._rows if row["step"] == step), {})

    def _write_table(self) -> None:
        table = io.StringIO(newline="")
        writer = csv.DictWriter(table, list(self._rows[0]))
        writer.writeheader()
        writer.writerows(self._rows)
        # Who reads the table while a training runs sees a whole one.
        write_whole(self._folder / TABLE, table.getvalue())


def _row_of(progress: Progress) -> Row:
    # Flat names: the table's header, TensorBoard's curves and the estimator's metadata share them.
    row: Row = {
        "step": progress.step,
        "epoch": progress.epoch,
        "seconds": progress.seconds,
        "learning_rate": progress.learning_rate,
    }
    for name, evaluation in (("training", progress.training), ("validation", progress.validation)):
        row.update({f"{name}_{key}": value for key, value in dataclasses.asdict(evaluation).items()})
    return row


def _read_rows(path: Path) -> list[Row]:
    if not path.exists():
        return []
    text = read_text(path, TrainingError, MOST_RECORD)
    with reading(path, TrainingError, "the table of a training"):
        rows = [{name: _number(value) for name, value in row.items()} for row in csv.DictReader(io.StringIO(text))]
        # Which rows are kept goes by it (`Journal.start`).
        if not all("step" in row for row in rows):
            raise ValueError("it has no column step")
    return rows


def _number(text: str) -> int | float:
    # As it was written: the figures of a training that is over stay the same when it is started again.
    return int(text) if text.isdigit() else float(text)


def describe(progress: Progress) -> str:
    """One line about an epoch; of two figures the first is of the training batches, the second of validation."""
    found, own = progress.validation, progress.training
    return (
        f"epoch {progress.epoch:5.1f}  {progress.seconds / 60:5.1f} min  loss {own.loss:.3f} / {found.loss:.3f}  "
        f"(cross-entropy {own.cross_entropy:.3f} / {found.cross_entropy:.3f}, R_S {own.success_loss:.3f} / "
        f"{found.success_loss:.3f}, R_F {own.failure_loss:.3f} / {found.failure_loss:.3f})  "
        f"Brier {found.brier:.4f}  skill {found.skill:+.3f}  RMSE R_S {found.success_rmse:.1f} R_F "
        f"{found.failure_rmse:.1f}" + ("  *" if progress.best_step == progress.step else "")
    )
