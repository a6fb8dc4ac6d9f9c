"""Memory by the size of a data set, of a fit and of its reader: images, maps and columns stay on disk."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.scale.fits import POTLP
from potlp_jax.learning.batches import prefetched
from potlp_jax.learning.building_learner import BuildingOptions
from potlp_jax.learning.dataset import finished_shards, samples_file, views_file, worlds_file
from potlp_jax.learning.dataset_reading import read_dataset
from potlp_jax.learning.training import batches_of
from potlp_jax.learning.training_options import TrainingConfig


def memory_by_size(
    data: Path, validation: Path, out: Path, parts: Sequence[int] = (100, 10, 1)
) -> list[dict[str, Any]]:
    """A fit of a minute to each part of a data set.

    Args:
        data: what is learned from; as large as may be.
        validation: of the fit.
        out: folder in which the parts, which are links, and what is fitted lie for the time of it.
        parts: each takes one shard in so many.

    Returns:
        Of each part, its size and the largest memory of a process that was fitted to it, and of one that made an
        epoch's batches of it, and nothing else.
    """
    found = []
    out.mkdir(parents=True, exist_ok=True)
    # A folder that is new: a fit would go on from what an earlier run left, and be measured by its rest.
    with tempfile.TemporaryDirectory(dir=out) as folder:
        for part in parts:
            here = one_in(data, part, Path(folder) / f"one-in-{part}")
            samples = read_dataset(here)
            row = {
                "worlds": len(samples.worlds),
                "views": len(samples.images),
                "samples": len(samples.view_of),
                "gigabytes": sum(file.stat().st_size for file in here.glob("*.parquet")) / 1e9,
            }
            fitted = _measured([*POTLP, *_fit(here, validation, Path(folder) / f"fit-{part}")])
            read = _measured([sys.executable, "-m", "eval.scale.reading", str(here)])
            found.append(row | fitted | {f"reader_{name}": value for name, value in read.items()})
    return found


def one_in(data: Path, part: int, folder: Path) -> Path:
    """One shard in so many of a data set, as links in a new folder; returns the folder."""
    folder.mkdir()
    for shard in sorted(finished_shards(data))[::part]:
        for named in (worlds_file, views_file, samples_file):
            named(folder, shard).symlink_to(named(data, shard).resolve())
    return folder


def _fit(data: Path, validation: Path, out: Path) -> list[str]:
    return ["fit", str(data), "--validation", str(validation), "--out", str(out), "--minutes", "1"]


def _measured(command: Sequence[str]) -> dict[str, float]:
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} ended with {status}")
    # Kibibytes, on Linux.
    return {"memory_mib": used.ru_maxrss / 1024, "seconds": time.perf_counter() - began}


def read_through(data: Path) -> int:
    """Make the training batches of an epoch, as a fit of the building network is shown them; returns how many."""
    samples = read_dataset(data)
    batches = batches_of(BuildingOptions().learner(samples), samples, TrainingConfig(steps=1))
    return sum(1 for _ in prefetched(batches.training_batch, 0, batches.per_epoch))


if __name__ == "__main__":
    read_through(Path(sys.argv[1]))
