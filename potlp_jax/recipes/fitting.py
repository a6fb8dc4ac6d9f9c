"""Trains an estimator from a data set: the second of the two commands that make one.

    python -m train.fit DATASET --validation DATASET --out DIR [--epochs N] [--minutes M] [--seed N] [...]

``DIR`` then holds ``estimator.npz`` (the best parameters by validation loss: what is shipped), ``log.csv`` (one row
per epoch), ``curves.png``, ``tensorboard/``, ``plan.json`` and ``checkpoints/``. The same command again resumes after
an interruption, also by SIGKILL, and ends with the same parameters, bit for bit, as without it.

With ``--minutes`` the speed is measured first, and as many steps are planned as fit, at most ``--epochs``; the learning
rate's schedule ends with the plan. The plan is written once, so that a resumed training follows it. Training is cut
short only where it would take a fifth longer than asked.
"""

import argparse
import csv
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from tensorboardX import SummaryWriter
from tqdm import tqdm

from potlp_jax.errors import CheckpointError, DatasetError, NetworkError, TrainingError
from potlp_jax.learning.dataset import Samples, decode, read_dataset
from potlp_jax.learning.loss import DataScale, network_config
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig, operation_counts, parameter_count
from potlp_jax.learning.serialization import save_estimator
from potlp_jax.learning.training import Progress, Trained, TrainingConfig, seconds_per_step, steps_per_epoch, train

# Of the time asked for: what validation, checkpoints and a busy machine may take.
_RESERVE = 0.1
_OVERRUN = 1.2
_OPTIONS = {field.name: field for field in dataclasses.fields(TrainingConfig) if field.name not in ("steps", "seed")}


class Journal:
    """The record of a training: progress bar, table, curves. Rows after the resumed step are made again.

    Args:
        folder: where the files go.
        total: planned steps.
    """

    def __init__(self, folder: Path, total: int) -> None:
        self._folder, self._total = folder, total
        self._rows: list[dict[str, float]] = []
        self._bar: tqdm[Any] | None = None
        self._writer: SummaryWriter | None = None

    def start(self, step: int) -> None:
        """Training starts with ``step`` steps done."""
        if step:
            print(f"resumed at step {step}", flush=True)
        self._rows = [row for row in _read_rows(self._folder / "log.csv") if row["step"] <= step]
        self._bar = tqdm(total=self._total, initial=step, unit="step", mininterval=1.0, file=sys.stderr)
        self._writer = SummaryWriter(str(self._folder / "tensorboard"), purge_step=step + 1)

    def step(self, step: int, loss: float) -> None:
        """One step is done."""
        assert self._bar is not None
        self._bar.update()
        if step % 10 == 0:
            self._bar.set_postfix(loss=f"{loss:.3f}", refresh=False)

    def evaluation(self, progress: Progress) -> None:
        """An epoch is done."""
        row = _row_of(progress)
        self._rows.append(row)
        self._write_table()
        draw_curves(self._rows, self._folder / "curves.png")
        assert self._writer is not None
        for name, value in row.items():
            if name != "step":
                self._writer.add_scalar(name.replace("_", "/", 1), value, progress.step)
        self._writer.flush()
        tqdm.write(describe(progress))

    def close(self) -> None:
        """Training is over."""
        if self._bar is not None:
            self._bar.close()
        if self._writer is not None:
            self._writer.close()

    def best(self, step: int) -> dict[str, float]:
        """The row of this step."""
        return next((row for row in self._rows if row["step"] == step), {})

    def _write_table(self) -> None:
        temporary = self._folder / "log.csv.tmp"
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(self._rows[0]))
            writer.writeheader()
            writer.writerows(self._rows)
        temporary.replace(self._folder / "log.csv")


def _row_of(progress: Progress) -> dict[str, float]:
    row: dict[str, float] = {
        "step": progress.step,
        "epoch": progress.epoch,
        "seconds": progress.seconds,
        "learning_rate": progress.learning_rate,
    }
    for name, evaluation in (("training", progress.training), ("validation", progress.validation)):
        row.update({f"{name}_{key}": value for key, value in dataclasses.asdict(evaluation).items()})
    return row


def _read_rows(path: Path) -> list[dict[str, float]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def describe(progress: Progress) -> str:
    """One line about an epoch."""
    found, own = progress.validation, progress.training
    return (
        f"epoch {progress.epoch:5.1f}  {progress.seconds / 60:5.1f} min  loss {own.loss:.3f} / {found.loss:.3f}  "
        f"(cross-entropy {own.cross_entropy:.3f} / {found.cross_entropy:.3f}, R_S {own.success_loss:.3f} / "
        f"{found.success_loss:.3f}, R_F {own.failure_loss:.3f} / {found.failure_loss:.3f})  "
        f"Brier {found.brier:.4f}  skill {found.skill:+.3f}  RMSE R_S {found.success_rmse:.1f} R_F "
        f"{found.failure_rmse:.1f}" + ("  *" if progress.best_step == progress.step else "")
    )


def draw_curves(rows: list[dict[str, float]], path: Path) -> None:
    """The curves of a training as a picture: training (augmented) and validation."""
    panels = {"loss": "loss", "cross_entropy": "weighted cross-entropy", "skill": "Brier skill over the constant prior"}
    panels |= {"success_rmse": "RMSE of R_S", "failure_rmse": "RMSE of R_F"}
    figure, axes = plt.subplots(1, len(panels), figsize=(4 * len(panels), 3.2), layout="constrained")
    for axis, (key, title) in zip(axes, panels.items(), strict=True):
        for name in ("training", "validation"):
            axis.plot([row["epoch"] for row in rows], [row[f"{name}_{key}"] for row in rows], ".-", label=name)
        axis.set_title(title)
        axis.set_xlabel("epoch")
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def planned_steps(
    folder: Path, epoch: int, epochs: int, minutes: float | None, seed: int, measure: Callable[[], float]
) -> int:
    """Steps to plan; with a time to keep, what was planned at the first start.

    Args:
        folder: where ``plan.json`` is.
        epoch: steps per epoch.
        measure: gives the seconds that a step takes; called where a plan must be made for a time.

    Raises:
        TrainingError: there is a plan for other options.
    """
    asked = {"epochs": epochs, "minutes": minutes, "seed": seed}
    path = folder / "plan.json"
    if path.exists():
        plan = json.loads(path.read_text())
        if plan["asked"] != asked:
            raise TrainingError(f"{path} was made for {plan['asked']}, not for {asked}: choose another --out")
        return int(plan["steps"])
    plan = {"asked": asked, "steps": epochs * epoch}
    if minutes is not None:
        plan["seconds_per_step"] = measure()
        fitting = int(minutes * 60 * (1 - _RESERVE) / plan["seconds_per_step"])
        plan["steps"] = max(1, min(plan["steps"], fitting))
    temporary = path.with_suffix(".json.tmp")
    temporary.write_text(json.dumps(plan))
    temporary.replace(path)
    return int(plan["steps"])


def fit(training: Samples, validation: Samples, out: Path, arguments: argparse.Namespace) -> Trained:
    """Everything after reading the data."""
    config = TrainingConfig(steps=1, seed=arguments.seed, **{name: getattr(arguments, name) for name in _OPTIONS})
    rows, columns, _ = decode(training.images[0]).shape
    network = EstimatorNetwork(
        network_config(
            training,
            (rows, columns),
            exclusive_within=arguments.exclusive_within,
            fovea=arguments.fovea,
            second_widths=tuple(arguments.second_widths),
        )
    )
    out.mkdir(parents=True, exist_ok=True)
    epoch = steps_per_epoch(training, config)
    began = time.perf_counter()
    steps = planned_steps(
        out,
        epoch,
        arguments.epochs,
        arguments.minutes,
        arguments.seed,
        lambda: seconds_per_step(network, training, config),
    )
    config = dataclasses.replace(config, steps=steps)
    first, second = operation_counts(network.config)
    print(
        f"{len(training.images)} panoramas, {len(training.success)} samples; {steps} steps of {epoch} per epoch; "
        f"{first / 1e6:.1f} MFLOP per panorama and {second / 1e6:.1f} per sample, forward",
        flush=True,
    )
    journal = Journal(out, steps)
    budget = float("inf")
    if arguments.minutes is not None:
        budget = arguments.minutes * 60 * _OVERRUN - (time.perf_counter() - began)
    try:
        trained = train(
            network,
            training,
            validation,
            config,
            folder=out / "checkpoints",
            budget_seconds=budget,
            on_start=journal.start,
            on_step=journal.step,
            on_evaluation=journal.evaluation,
        )
    finally:
        journal.close()
    metadata = {
        "training": dataclasses.asdict(config),
        "data": dataclasses.asdict(training.metadata),
        "validation_split": validation.metadata.split,
        "panoramas": len(training.images),
        "samples": len(training.success),
        "prior": DataScale.of(training).prior,
        "parameters": parameter_count(trained.params),
        "steps": trained.steps,
        "best_step": trained.best_step,
        "ended_by": trained.reason,
        "seconds": trained.seconds,
        "figures": journal.best(trained.best_step),
        "versions": {name: version(name) for name in ("potlp-jax", "jax", "flax", "optax")},
    }
    save_estimator(out / "estimator.npz", trained.params, network.config, metadata)
    return trained


def parser() -> argparse.ArgumentParser:
    """The command's options; those of ``TrainingConfig`` carry its defaults."""
    found = argparse.ArgumentParser(prog="python -m train.fit", description="Train an estimator from a data set.")
    found.add_argument("dataset", type=Path, help="folder made by train.collect")
    found.add_argument("--validation", type=Path, required=True, help="data set of other worlds")
    found.add_argument("--out", type=Path, required=True, help="folder for everything that is written")
    found.add_argument("--epochs", type=int, default=10, help="passes over the panoramas, at most (default 10)")
    found.add_argument("--minutes", type=float, help="plan as many steps as fit into this time")
    found.add_argument("--seed", type=int, default=0, help="of parameters, order and augmentation (default 0)")
    found.add_argument(
        "--exclusive-within",
        type=float,
        default=0.0,
        help="cells within which subgoals exclude each other, as eval.exclusion measures it (default 0: nowhere)",
    )
    found.add_argument(
        "--fovea", type=int, default=0, help="columns of pixels beside the subgoal to look at closely (default 0: none)"
    )
    found.add_argument(
        "--second-widths",
        type=int,
        nargs=8,
        default=NetworkConfig.second_widths,
        metavar="N",
        help=f"channels of the eight convolutions after phi is joined (default {NetworkConfig.second_widths})",
    )
    for name, field in _OPTIONS.items():
        found.add_argument(
            f"--{name.replace('_', '-')}", type=field.type, default=field.default, help=argparse.SUPPRESS
        )
    found.epilog = "Also, as in TrainingConfig: " + ", ".join(f"--{name.replace('_', '-')}" for name in _OPTIONS)
    return found


def main() -> int:
    """Run the command; the exit status."""
    arguments = parser().parse_args()
    try:
        training, validation = read_dataset(arguments.dataset), read_dataset(arguments.validation)
        trained = fit(training, validation, arguments.out, arguments)
    except (CheckpointError, DatasetError, NetworkError, TrainingError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(
        f"{arguments.out / 'estimator.npz'}: step {trained.best_step} of {trained.steps}, validation loss "
        f"{trained.best_loss:.4f}; ended by {trained.reason} after {trained.seconds / 60:.1f} min"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
