"""Memory of a fit by the size of its data set: images, maps and columns stay on disk, whatever their number."""

import os
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.scale.fits import POTLP
from potlp_jax.learning.dataset import finished_shards, samples_file, views_file, worlds_file
from potlp_jax.learning.dataset_reading import read_dataset


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
        Of each part, its size and the largest memory of the process that was fitted to it.
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
            found.append(row | _fit(here, validation, Path(folder) / f"fit-{part}"))
    return found


def one_in(data: Path, part: int, folder: Path) -> Path:
    """One shard in so many of a data set, as links in a new folder; returns the folder."""
    folder.mkdir()
    for shard in sorted(finished_shards(data))[::part]:
        for named in (worlds_file, views_file, samples_file):
            named(folder, shard).symlink_to(named(data, shard).resolve())
    return folder


def _fit(data: Path, validation: Path, out: Path) -> dict[str, Any]:
    command = [*POTLP, "fit", str(data), "--validation", str(validation), "--out", str(out), "--minutes", "1"]
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} ended with {status}")
    # Kibibytes, on Linux.
    return {"memory_mib": used.ru_maxrss / 1024, "seconds": time.perf_counter() - began}
