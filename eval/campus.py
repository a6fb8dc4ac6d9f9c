"""Deliveries in the test worlds of other families and sizes of buildings than those of ``eval.delivery``.

    python -m eval.campus --out out/campus
    python -m eval.campus --out out/campus --worlds 20 --families campus-large campus-large-parcels

Known map, baseline and PO-TLP, with the shipped estimators, in all tasks of each family. The same command goes on where
it was stopped, also with more worlds. ``--report`` writes NAME.json beside what is printed.
"""

import argparse
import os
from pathlib import Path

from eval.delivery import WITHOUT_ORACLE, results_of, run_group, tell
from potlp_jax.environments.registry import make

FAMILIES = (
    "parcels",
    "campus-small",
    "campus-small-parcels",
    "campus-medium",
    "campus-medium-parcels",
    "campus-large",
    "campus-large-parcels",
)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweeps")
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=list(FAMILIES), metavar="FAMILY")
    parser.add_argument("--worlds", type=int, default=80, help="test worlds of each family and task")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--report", type=Path, help="without suffix: where the results go")
    options = parser.parse_args()
    found = {}
    for family in options.families:
        tasks = list(make(family).tasks.values())
        rows = run_group(options.out / family, family, tasks, WITHOUT_ORACLE, options.worlds, options.processes)
        found[family] = results_of(rows, family, tasks)
    tell(found, options.report)


if __name__ == "__main__":
    main()
