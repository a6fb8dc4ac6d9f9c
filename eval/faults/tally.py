"""Counts of how cases ended, kept in a file between runs, and the table of them."""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from eval.faults import GOOD, Kind, Verdict
from eval.faults.worker import Ending
from potlp_jax.errors import ConfigurationError
from potlp_jax.sweep.rows import provenance

TALLY: str = "faults.json"
"""Name of the file of counts in the folder of a run."""

_EXAMPLES = 5
"""Messages of each kind and verdict that are kept to look at."""


@dataclass
class Row:
    """How the cases of one kind ended.

    Attributes:
        unit: what a case is, in the plural.
        cases: how many were run; the next one has this number.
        counts: cases by verdict.
        slowest: seconds of the case that took longest.
        examples: some messages by verdict.
        bad: numbers of the cases that ended badly.
    """

    unit: str
    cases: int = 0
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(Verdict, 0))
    slowest: float = 0.0
    examples: dict[str, list[str]] = field(default_factory=dict)
    bad: list[int] = field(default_factory=list)

    def add(self, ending: Ending) -> None:
        """Count the next case."""
        self.counts[ending.verdict] += 1
        self.slowest = max(self.slowest, round(ending.seconds, 3))
        examples = self.examples.setdefault(ending.verdict, [])
        if ending.text and len(examples) < _EXAMPLES and ending.text not in examples:
            examples.append(ending.text)
        if ending.verdict not in GOOD:
            self.bad.append(self.cases)
        self.cases += 1


@dataclass
class Tally:
    """The counts of all kinds of a part, and by which command, code and versions they were made."""

    seed: int
    provenance: dict[str, Any]
    rows: dict[str, Row] = field(default_factory=dict)

    def row(self, kind: Kind) -> Row:
        """The row of a kind, begun if there is none."""
        return self.rows.setdefault(kind.name, Row(kind.unit))

    def sums(self) -> dict[str, Row]:
        """All rows of equal units as one, by unit."""
        return {
            unit: summed([row for row in self.rows.values() if row.unit == unit], unit)
            for unit in sorted({row.unit for row in self.rows.values()})
        }

    def write(self, file: Path) -> None:
        """Replace the file."""
        temporary = file.with_name(f"{file.name}.part")
        temporary.write_text(json.dumps(dataclasses.asdict(self), indent=1) + "\n", "utf-8")
        temporary.replace(file)


def summed(rows: Sequence[Row], unit: str) -> Row:
    """The counts of some rows together."""
    counts: dict[str, int] = {verdict: sum(row.counts[verdict] for row in rows) for verdict in Verdict}
    return Row(unit, sum(row.cases for row in rows), counts, max(row.slowest for row in rows))


def read_tally(file: Path) -> Tally:
    """The counts that a file holds."""
    data: dict[str, Any] = json.loads(file.read_text("utf-8"))
    return Tally(data["seed"], data["provenance"], {name: Row(**row) for name, row in data["rows"].items()})


def open_tally(folder: Path, seed: int) -> Tally:
    """The counts in a folder, to be continued, or new ones.

    Raises:
        ConfigurationError: those in the folder are of another seed or commit: a table would mix the two.
    """
    now = Tally(seed, provenance())
    if not (folder / TALLY).exists():
        return now
    found = read_tally(folder / TALLY)
    pairs = (("seed", found.seed, seed), ("commit", found.provenance["commit"], now.provenance["commit"]))
    for name, before, given in pairs:
        if before != given:
            raise ConfigurationError(f"{folder}: was made with {name} {before}, not {given}: give another --out")
    return found


def table(tally: Tally) -> str:
    """The counts as a table in Markdown, with all sums of equal units."""
    titles = ["kind", "unit", "cases", *Verdict, "slowest"]
    lines = [" | ".join(["", *titles, ""]).strip(), "|---|---|" + "---:|" * (len(titles) - 2)]
    lines += [_line(name, row) for name, row in sorted(tally.rows.items(), key=lambda item: (item[1].unit, item[0]))]
    lines += [_line("**all**", row) for row in tally.sums().values()]
    return "\n".join([*lines, ""])


def _line(name: str, row: Row) -> str:
    cells = [name, row.unit, f"{row.cases:,}", *(f"{row.counts[verdict]:,}" for verdict in Verdict)]
    return "| " + " | ".join([*cells, f"{row.slowest:.2f} s"]) + " |"
