"""The rows of a sweep in little space: what a table needs of them, without the paths.

potlp sweep export out/table1 --out out/rows.csv
python -m eval.compact_rows out/rows.csv docs/results/table1/rows.csv.gz
"""

import argparse
import csv
import gzip
from pathlib import Path

COLUMNS = ("task", "policy", "world", "outcome", "cost", "steps", "decisions", "fallbacks", "status", "seconds")
"""Left out: what is the same in every row (the sweep's JSON has it), and paths, which are nine tenths of the file."""
DECIMALS = {"cost": 3, "seconds": 2}


def compact(source: Path, target: Path) -> None:
    """Write the rows of ``source``, a CSV of ``potlp sweep export``, to ``target`` with fewer columns and digits."""
    # No file name and no time in the header, so that equal rows give equal bytes and git sees no change.
    with (
        source.open(newline="") as file,
        target.open("wb") as raw,
        gzip.GzipFile(filename="", fileobj=raw, mode="wb", mtime=0) as packed,
    ):
        packed.write((",".join(COLUMNS) + "\n").encode())
        for row in csv.DictReader(file):
            values = [_short(row[name], DECIMALS.get(name)) for name in COLUMNS]
            packed.write((",".join(values) + "\n").encode())


def _short(value: str, decimals: int | None) -> str:
    # Formulas hold no comma, so that nothing needs quotes; this fails loudly should one appear.
    if "," in value or '"' in value:
        raise ValueError(f"a value that would need quotes in a CSV: {value}")
    return value if decimals is None else f"{float(value):.{decimals}f}"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, metavar="ROWS.csv")
    parser.add_argument("target", type=Path, metavar="ROWS.csv.gz")
    arguments = parser.parse_args()
    compact(arguments.source, arguments.target)


if __name__ == "__main__":
    main()
