"""One fit on several numbers of devices and processes: is the loss curve the same, and do they go on with each other's
checkpoints?
"""

import csv
import dataclasses
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.scale.disturbed import free_port
from potlp_jax.recipes.journal import TABLE
from potlp_jax.view.style import new_figure, save_figure

POTLP = (sys.executable, "-c", "from potlp_jax.cli import main; main()")
SMALL_CAMERA = ("--set", "camera.height=64", "--set", "camera.width=128")
TRAINING_WORLDS, VALIDATION_WORLDS = 24, 8


@dataclasses.dataclass(frozen=True)
class Way:
    """How a fit is run.

    Attributes:
        devices: that a processor counts as, in each process.
        processes: that share the fit.
        slurm: whether Slurm begins the processes, each on a node of its own, and they find each other by it.
    """

    devices: int = 1
    processes: int = 1
    slurm: bool = False

    def __str__(self) -> str:
        devices = f"{self.devices} device{'s' if self.devices > 1 else ''}"
        if self.slurm:
            return f"{self.processes} nodes of Slurm, {devices} each"
        return devices if self.processes == 1 else f"{self.processes} processes, {devices} each"

    @property
    def folder(self) -> str:
        """A name for its files."""
        return f"{self.processes}{'-nodes' if self.slurm else ''}-{self.devices}"


WAYS = (Way(1), Way(2), Way(4), Way(1, 2))
HANDED_ON = ((Way(1), Way(4)), (Way(4), Way(1, 2)), (Way(1, 2), Way(1)))
ON_SLURM = Way(1, 2, slurm=True)
"""A fit that was begun in one way, was killed, and was ended in the other."""


def collected(folder: Path) -> dict[str, Path]:
    """Small data sets of the two-room environment."""
    worlds = {"training": TRAINING_WORLDS, "validation": VALIDATION_WORLDS}
    for split, count in worlds.items():
        words = ["toy", "--split", split, "--worlds", str(count), "--out", str(folder / split), *SMALL_CAMERA]
        subprocess.run([*POTLP, "collect", *words], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return {split: folder / split for split in worlds}


def begin(data: Mapping[str, Path], out: Path, way: Way, epochs: int) -> list[subprocess.Popen[bytes]]:
    """The processes of a fit."""
    words = [str(data["training"]), "--validation", str(data["validation"]), "--out", str(out), "--epochs", str(epochs)]
    words += ["--set", "network.kind=panorama", "--set", "training.views_per_batch=8", "--set", "training.patience=0"]
    command = [*POTLP, "fit", *words]
    address = f"127.0.0.1:{free_port()}"
    if way.slurm:
        nodes, tasks = f"--nodes={way.processes}", f"--ntasks={way.processes}"
        commands = [["srun", "--quiet", nodes, tasks, "--ntasks-per-node=1", *command]]
    elif way.processes > 1:
        commands = [[*command, "--join", f"{address},{index},{way.processes}"] for index in range(way.processes)]
    else:
        commands = [command]
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={way.devices}".strip()
    return [
        subprocess.Popen(
            command,
            env={**os.environ, "XLA_FLAGS": flags},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for command in commands
    ]


def curve(out: Path) -> dict[str, list[float]]:
    """Steps and losses of a fit, an evaluation after each epoch."""
    with (out / TABLE).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = ("step", "training_loss", "validation_loss")
    return {name: [float(row[name]) for row in rows] for name in names}


def fitted(data: Mapping[str, Path], out: Path, way: Way, epochs: int) -> dict[str, list[float]]:
    """The curve of a fit that runs, or goes on, to its end."""
    processes = begin(data, out, way, epochs)
    if any([process.wait() for process in processes]):
        raise SystemExit(f"{out}: a fit with {way} has failed; run it by itself to see why")
    return curve(out)


def kill_after(data: Mapping[str, Path], out: Path, way: Way, epochs: int, rows: int) -> None:
    """A fit that is killed once it has so many evaluations, and a checkpoint."""
    processes = begin(data, out, way, epochs)
    while not (out / TABLE).exists() or len(curve(out)["step"]) < rows:
        if any(process.poll() is not None for process in processes):
            raise SystemExit(f"{out}: a fit with {way} ended before it could be killed")
        time.sleep(0.2)
    for process in processes:
        # What Slurm began ends by itself only if its command can say so.
        process.terminate() if way.slurm else process.kill()
        process.wait()


def difference(found: Mapping[str, Sequence[float]], like: Mapping[str, Sequence[float]]) -> float:
    """The largest relative difference of the losses of two curves."""
    assert found["step"] == like["step"]
    names = ("training_loss", "validation_loss")
    return max(abs(a - b) / b for name in names for a, b in zip(found[name], like[name], strict=True))


def same_curves(out: Path, epochs: int) -> list[dict[str, Any]]:
    """The curve of every way, and of every fit that was handed on, with its difference from that of one device.

    Where ``SLURM_CONF`` names a Slurm, its nodes are one way more.
    """
    data = collected(out / "data")
    slurm = "SLURM_CONF" in os.environ
    runs = []
    for way in (*WAYS, ON_SLURM) if slurm else WAYS:
        folder = out / f"fit-{way.folder}"
        shutil.rmtree(folder, ignore_errors=True)
        runs.append({"run": str(way), "curve": fitted(data, folder, way, epochs)})
    for first, second in (*HANDED_ON, (ON_SLURM, Way(4))) if slurm else HANDED_ON:
        folder = out / f"fit-{first.folder}-then-{second.folder}"
        shutil.rmtree(folder, ignore_errors=True)
        kill_after(data, folder, first, epochs, epochs // 2)
        runs.append({"run": f"{first}, then {second}", "curve": fitted(data, folder, second, epochs)})
    for run in runs:
        run["difference"] = difference(run["curve"], runs[0]["curve"])
    return runs


def draw(runs: Sequence[Mapping[str, Any]], file: Path) -> None:
    """All curves on one plot, and below it how far each is from the first."""
    figure = new_figure(9.0, 5.6)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    figure.subplots_adjust(right=0.66)
    reference = runs[0]["curve"]
    for number, run in enumerate(runs):
        steps, losses = run["curve"]["step"], run["curve"]["validation_loss"]
        # Wider lines first: where curves coincide all of them stay visible.
        style = {"linewidth": 2 * (len(runs) - number), "alpha": 0.5, "label": run["run"]}
        above.plot(steps, losses, **style)
        apart = [max(abs(a - b) / b, 1e-9) for a, b in zip(losses, reference["validation_loss"], strict=True)]
        if number:
            below.semilogy(steps, apart, marker="o", color=above.lines[-1].get_color())
    above.set_ylabel("validation loss")
    # Beside the curves: they coincide, and a legend on one of them would hide all.
    for line in above.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5)).get_lines():
        line.set_linewidth(2)
    # Figures of ours take texts literally, and matplotlib writes powers of ten as mathematics.
    below.yaxis.set_major_formatter("{x:.0e}")
    below.set_ylabel(f"relative difference\nfrom {runs[0]['run']}")
    below.set_xlabel("steps")
    save_figure(figure, file)
