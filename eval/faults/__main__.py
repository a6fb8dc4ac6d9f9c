"""Attack the library for some minutes, count how it bears it, and write the page of results.

    python -m eval.faults files --cases 5000 --out out/faults     # damaged files; goes on where it was stopped
    python -m eval.faults texts --minutes 5 --only "HOA text" --seed 2 --out out/faults
    python -m eval.faults files --replay "map image, png" 17      # one case again, in this process
    python -m eval.faults page --out out/faults                   # docs/results/faults.md from the counts of all parts

FOLDER/PART has the counts (faults.json), the table (faults.md) and the inputs of the cases that ended badly, each with
its traceback (bad/KIND-NUMBER/). Exit code 1 if there are such cases.
"""

import argparse
import math
import shutil
import tempfile
import time
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from eval.faults import GOOD, Kind
from eval.faults.page import PARTS, write_page
from eval.faults.tally import TALLY, Tally, open_tally, table
from eval.faults.worker import Worker, all_kinds
from eval.provenance import made_line
from potlp_jax.errors import PotlpError

_PAGE = "page"
_TURN = 60.0
"""Seconds after which it is the next kind's turn: a process costs seconds to start, so turns are not short."""


def main() -> int:
    """Entry point."""
    arguments = _parser().parse_args()
    if arguments.part == _PAGE:
        print(f"wrote {write_page(arguments.out)}")
        return 0
    kinds = all_kinds(PARTS[arguments.part].modules)
    if arguments.replay:
        name, number = arguments.replay
        return _replay(kinds[name], int(number), arguments.seed)
    chosen = [kind for kind in kinds.values() if not arguments.only or kind.name in arguments.only]
    unknown = set(arguments.only or ()) - set(kinds)
    if unknown or not chosen:
        print(f"unknown kinds: {', '.join(sorted(unknown))}; known: {', '.join(kinds)}")
        return 2
    folder: Path = arguments.out / arguments.part
    folder.mkdir(parents=True, exist_ok=True)
    try:
        tally = open_tally(folder, arguments.seed)
    except PotlpError as error:
        print(error)
        return 2
    attack = _Attack(PARTS[arguments.part].modules, tally, folder)
    attack.run(_shares(chosen, arguments.cases), time.monotonic() + 60 * arguments.minutes)
    print(table(tally))
    return int(any(row.bad for row in tally.rows.values()))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m eval.faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=[*PARTS, _PAGE], help="what to attack, or the page of results")
    parser.add_argument("--minutes", type=float, default=600.0, help="how long, for all kinds together")
    parser.add_argument("--cases", type=int, default=5_000, help="of all kinds together, each has its share")
    parser.add_argument("--only", nargs="+", metavar="KIND", help="these kinds alone; default: all of the part")
    parser.add_argument("--seed", type=int, default=1, help="of all random numbers")
    parser.add_argument("--out", type=Path, default=Path("out/faults"), metavar="FOLDER", help="for counts and inputs")
    parser.add_argument("--replay", nargs=2, metavar=("KIND", "NUMBER"), help="run one case again and show its end")
    return parser


def _shares(kinds: Sequence[Kind], cases: int) -> dict[Kind, int]:
    """How many cases each kind has of all, by its weight; rounded up, so that they are not fewer in all."""
    weights = sum(kind.weight for kind in kinds)
    return {kind: math.ceil(cases * kind.weight / weights) for kind in kinds}


class _Attack:
    """Cases of one part, counted in a folder."""

    def __init__(self, modules: tuple[str, ...], tally: Tally, folder: Path) -> None:
        self._modules, self._tally, self._folder = modules, tally, folder
        self._scratch = folder / "scratch"

    def run(self, shares: Mapping[Kind, int], until: float) -> None:
        """The kinds in turns, until the time is over or each has its share."""
        while time.monotonic() < until:
            waiting = [kind for kind, share in shares.items() if self._tally.row(kind).cases < share]
            if not waiting:
                return
            for kind in waiting:
                self._turn(kind, shares[kind], until)

    def _turn(self, kind: Kind, share: int, until: float) -> None:
        worker = Worker(self._modules, kind, self._tally.seed, self._scratch)
        try:
            worker.start()
            ends = min(until, time.monotonic() + max(_TURN, 2 * kind.limit))
            while time.monotonic() < ends and self._tally.row(kind).cases < share:
                self._case(worker, kind)
        finally:
            worker.close()
            # After each turn: stopping the command loses the counts of one turn, and those are made again.
            self._tally.write(self._folder / TALLY)
            made = made_line(self._tally.provenance)
            (self._folder / "faults.md").write_text(f"{table(self._tally)}\n{made}\n", "utf-8")

    def _case(self, worker: Worker, kind: Kind) -> None:
        row = self._tally.row(kind)
        number = row.cases
        ending = worker.run(number)
        row.add(ending)
        if ending.verdict not in GOOD:
            kept = self._folder / "bad" / f"{kind.name.replace(' ', '-').replace('/', '-')}-{number}"
            shutil.rmtree(kept, ignore_errors=True)
            kept.parent.mkdir(exist_ok=True)
            shutil.move(self._scratch, kept)
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
