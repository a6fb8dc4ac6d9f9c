"""What each part of the fire-fighting estimator is good for, in answers and in trials.

    python -m eval.ablations --out out/ablations --views own=out/own explored=out/explored --processes 2
    python -m eval.ablations --out out/ablations --views own=out/own --report docs/results/ablations
    python -m eval.ablations --out out/ablations --views own=out/own --report docs/results/ablations --as-it-is

Networks are fitted to the same views of generated buildings, alike but for the one thing that each lacks
(``eval.ablations.variants``), evaluated on data sets of other buildings (``--views NAME=FOLDER``), and drive in one set
of validation worlds. Each step is a command of ``potlp``; the same command goes on where it was stopped. ``--report``
writes NAME.json, NAME.png and NAME.md.
"""

import argparse
import os
from pathlib import Path

from eval.ablations.report import write_report
from eval.ablations.running import run
from eval.ablations.variants import VARIANTS
from potlp_jax.cache import enable_compilation_cache


def _named(text: str) -> tuple[str, Path]:
    name, _, folder = text.partition("=")
    if not (name and folder):
        raise argparse.ArgumentTypeError(f"{text!r}: give a name and a folder, as in own=out/own")
    return name, Path(folder)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of data, fits and trials")
    parser.add_argument("--views", type=_named, nargs="+", default=[], metavar="NAME=FOLDER", help="to evaluate on")
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS), metavar="VARIANT")
    parser.add_argument("--worlds", type=int, default=60, help="of the split validation, for trials")
    parser.add_argument("--first-world", type=int, default=7000)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--report", type=Path, metavar="NAME", help="without suffix: where the results go")
    parser.add_argument(
        "--beside", type=Path, metavar="FILE.json", help="what --report wrote of other fits, to compare"
    )
    parser.add_argument("--as-it-is", action="store_true", help="report what is finished, run nothing")
    options = parser.parse_args()
    views = dict(options.views)
    if not options.as_it_is:
        enable_compilation_cache()
        run(options.out, views, options.worlds, options.first_world, options.processes, options.only)
    if options.report is not None:
        write_report(options.out, list(views), options.report, options.beside)


if __name__ == "__main__":
    main()
