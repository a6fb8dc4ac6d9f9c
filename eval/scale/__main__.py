"""How sweeps scale (docs/results/scale.md).

python -m eval.scale overhead --report docs/results/scale/overhead
python -m eval.scale store --report docs/results/scale/store
python -m eval.scale kills --out out/scale --report docs/results/scale/kills
python -m eval.scale fits --out out/scale-fits --report out/fits
python -m eval.scale reading --data data/training --validation data/validation --report docs/results/scale/reading
"""

import argparse
import json
from pathlib import Path
from typing import Any

from eval.scale.disturbed import on_a_batch_system, on_a_scheduler
from eval.scale.fits import draw, same_curves
from eval.scale.overhead import efficiency, store_of
from eval.scale.reading import memory_by_size
from potlp_jax.sweep.rows import provenance


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """The figures of one subject."""
    if options.subject == "overhead":
        return {"runs": [efficiency(options.workers, seconds, options.units) for seconds in (1.0, 0.1)]}
    if options.subject == "store":
        return {"runs": [store_of(rows) for rows in (10_000, options.rows)]}
    if options.subject == "fits":
        return {"runs": same_curves(options.out, options.epochs)}
    if options.subject == "reading":
        return {"runs": memory_by_size(options.data, options.validation, options.out)}
    if options.subject == "slurm":
        logs = options.out / "jobs"
        where = f"slurm:partition=cpu,walltime=01:00:00,workers=2,memory=2GB,log_directory={logs}"
        return {"runs": [on_a_batch_system(options.out, where, options.jobs_killed)]}
    kills = {"worker": options.workers_killed, "driver": options.drivers_killed, "scheduler": options.schedulers_killed}
    return {"runs": [on_a_scheduler(options.out, kills)]}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", choices=("overhead", "store", "kills", "slurm", "fits", "reading"))
    parser.add_argument("--workers", type=int, default=64, help="simulated workers")
    parser.add_argument("--units", type=int, default=20, help="for each worker")
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--workers-killed", type=int, default=200)
    parser.add_argument("--drivers-killed", type=int, default=20)
    parser.add_argument("--schedulers-killed", type=int, default=5)
    parser.add_argument("--jobs-killed", type=int, default=10)
    parser.add_argument("--epochs", type=int, default=6, help="of a fit")
    parser.add_argument("--data", type=Path, help="that is read: a folder that `potlp collect` wrote")
    parser.add_argument("--validation", type=Path, help="another one, for the fit")
    parser.add_argument("--out", type=Path, default=Path("out/scale"))
    parser.add_argument("--report", type=Path, help="NAME of NAME.json")
    options = parser.parse_args()
    if options.subject == "reading" and None in (options.data, options.validation):
        parser.error("give --data and --validation: folders that `potlp collect` wrote")
    found: dict[str, Any] = measured(options) | {"provenance": provenance()}
    print(json.dumps(found["runs"], indent=1))
    if options.report is not None:
        file = options.report.with_suffix(".json")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(found, indent=1) + "\n")
        if options.subject == "fits":
            draw(found["runs"], options.report.with_suffix(".png"))


if __name__ == "__main__":
    main()
