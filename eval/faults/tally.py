"""Counts of how cases ended, kept in a file between runs, and the table of them."""

import dataclasses
import json
import platform
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from eval.faults import GOOD, Kind, Verdict
from eval.faults.worker import Ending
from potlp_jax.errors import ConfigurationError
from potlp_jax.sweep.rows import source_commit
from potlp_jax.trials.loop import versions

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
    """The counts of all kinds, and by which code they were made."""

    seed: int
    commit: str
    versions: dict[str, str]
    rows: dict[str, Row] = field(default_factory=dict)

    def row(self, kind: Kind) -> Row:
        """The row of a kind, begun if there is none."""
        return self.rows.setdefault(kind.name, Row(kind.unit))

    def write(self, folder: Path) -> None:
        """Replace the file in the folder."""
        temporary = folder / f"{TALLY}.part"
        temporary.write_text(json.dumps(dataclasses.asdict(self), indent=1) + "\n", "utf-8")
        temporary.replace(folder / TALLY)


def open_tally(folder: Path, seed: int) -> Tally:
    """The counts in a folder, to be continued, or new ones.

    Raises:
        ConfigurationError: those in the folder are of another seed or commit: a table would mix the two.
    """
    now = Tally(seed, source_commit(), {"python": platform.python_version(), **versions()})
    if not (folder / TALLY).exists():
        return now
    data: dict[str, Any] = json.loads((folder / TALLY).read_text("utf-8"))
    for name, value in (("seed", seed), ("commit", now.commit)):
        if data[name] != value:
            raise ConfigurationError(f"{folder}: was made with {name} {data[name]}, not {value}: give another --out")
    return dataclasses.replace(now, rows={name: Row(**row) for name, row in data["rows"].items()})


def table(tally: Tally) -> str:
    """The counts as a table in Markdown, with all sums of equal units."""
    titles = ["kind", "unit", "cases", *Verdict, "slowest"]
    lines = [" | ".join(["", *titles, ""]).strip(), "|---|---|" + "---:|" * (len(titles) - 2)]
    lines += [_line(name, row) for name, row in sorted(tally.rows.items(), key=lambda item: (item[1].unit, item[0]))]
    for unit in sorted({row.unit for row in tally.rows.values()}):
        rows = [row for row in tally.rows.values() if row.unit == unit]
        counts: dict[str, int] = {verdict: sum(row.counts[verdict] for row in rows) for verdict in Verdict}
        total = Row(unit, sum(row.cases for row in rows), counts, max(row.slowest for row in rows))
        lines.append(_line("**all**", total))
    made = ", ".join(f"{name} {version}" for name, version in tally.versions.items())
    return "\n".join([*lines, "", f"Seed {tally.seed}, commit {tally.commit}; {made}.", ""])


def _line(name: str, row: Row) -> str:
    cells = [name, row.unit, f"{row.cases:,}", *(f"{row.counts[verdict]:,}" for verdict in Verdict)]
    return "| " + " | ".join([*cells, f"{row.slowest:.2f} s"]) + " |"
