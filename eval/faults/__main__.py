"""Attack the library for some minutes and count how it bears it.

    python -m eval.faults --minutes 10 --seed 1 --out out/faults              # goes on where it was stopped
    python -m eval.faults --minutes 5 --only "map image" --seed 1 --out out/faults
    python -m eval.faults --replay "map image" 17 --seed 1                    # one case again, in this process

The folder has the counts (faults.json), the table (faults.md) and the inputs of the cases that ended badly, each with
its traceback (bad/KIND-NUMBER/). Exit code 1 if there are such cases.
"""

import argparse
import shutil
import tempfile
import time
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eval.faults import GOOD, Kind
from eval.faults.tally import Tally, open_tally, table
from eval.faults.worker import Worker, all_kinds
from potlp_jax.errors import PotlpError

MODULES = ("eval.faults.files", "eval.faults.texts", "eval.faults.commands", "eval.faults.formulas")
"""The modules that have kinds of cases. To add one, write it and a line here."""

_TURN = 60.0
"""Seconds after which it is the next kind's turn: a process costs seconds to start, so turns are not short."""


def main() -> int:
    """Entry point."""
    arguments = _parser().parse_args()
    kinds = all_kinds(MODULES)
    if arguments.replay:
        name, number = arguments.replay
        return _replay(kinds[name], int(number), arguments.seed)
    chosen = [kind for kind in kinds.values() if not arguments.only or kind.name in arguments.only]
    unknown = set(arguments.only or ()) - set(kinds)
    if unknown or not chosen:
        print(f"unknown kinds: {', '.join(sorted(unknown))}; known: {', '.join(kinds)}")
        return 2
    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    try:
        tally = open_tally(folder, arguments.seed)
    except PotlpError as error:
        print(error)
        return 2
    _attack(chosen, tally, folder, time.monotonic() + 60 * arguments.minutes, arguments.cases)
    print(table(tally))
    return int(any(row.bad for row in tally.rows.values()))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m eval.faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="how long, for all kinds together")
    parser.add_argument("--cases", type=int, default=10_000, help="of each kind at most")
    parser.add_argument("--only", nargs="+", metavar="KIND", help="these kinds alone; default: all")
    parser.add_argument("--seed", type=int, default=1, help="of all random numbers")
    parser.add_argument("--out", type=Path, default=Path("out/faults"), metavar="FOLDER", help="for counts and inputs")
    parser.add_argument("--replay", nargs=2, metavar=("KIND", "NUMBER"), help="run one case again and show its end")
    return parser


def _attack(kinds: Sequence[Kind], tally: Tally, folder: Path, until: float, cases: int) -> None:
    """The kinds in turns, until the time is over or each has its cases."""
    while time.monotonic() < until and any(tally.row(kind).cases < cases for kind in kinds):
        for kind in [kind for kind in kinds if tally.row(kind).cases < cases]:
            worker = Worker(MODULES, kind, tally.seed, folder / "scratch")
            try:
                worker.start()
                turn_ends = min(until, time.monotonic() + max(_TURN, 2 * kind.limit))
                while time.monotonic() < turn_ends and tally.row(kind).cases < cases:
                    _run_case(worker, kind, tally, folder)
            finally:
                worker.close()
                # After each turn: stopping the command loses the counts of one turn, and those are made again.
                tally.write(folder)
                (folder / "faults.md").write_text(table(tally), "utf-8")


def _run_case(worker: Worker, kind: Kind, tally: Tally, folder: Path) -> None:
    row, scratch = tally.row(kind), folder / "scratch"
    number = row.cases
    ending = worker.run(number)
    row.add(ending)
    if ending.verdict not in GOOD:
        kept = folder / "bad" / f"{kind.name.replace(' ', '-').replace('/', '-')}-{number}"
        shutil.rmtree(kept, ignore_errors=True)
        kept.parent.mkdir(exist_ok=True)
        shutil.move(scratch, kept)
        (kept / "ending.txt").write_text(f"{ending.verdict} after {ending.seconds:.2f} s\n{ending.text}\n", "utf-8")


def _replay(kind: Kind, number: int, seed: int) -> int:
    """One case again, without limits, so that a debugger can be used; what it raises is shown as it is."""
    random = np.random.default_rng([seed, zlib.crc32(kind.name.encode()), number])
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "scratch"
        folder.mkdir()
        kind.run(random, folder)
    print("fine")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
