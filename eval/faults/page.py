"""The page of results: what was attacked with how much, and how the cases ended, from the counts of all parts."""

import dataclasses
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from eval.faults import GOOD, LIMIT, LONGEST_MESSAGE, MEMORY, Verdict
from eval.faults.tally import TALLY, Tally, read_tally, summed, table
from eval.provenance import RESULTS, lines_of
from potlp_jax.files import MIB

PAGE: str = "faults.md"
"""Name of the page in the folder of results."""

_DATA = "faults"
"""Name of the folder of the counts beside it."""


@dataclass(frozen=True)
class Part:
    """A part of the attack, which runs by itself.

    Attributes:
        title: of its section on the page.
        modules: that have its kinds of cases. To add a kind, write it into a module; to add a module, name it here.
        about: what its cases are, and what a wrong answer would be, for the page.
    """

    title: str
    modules: tuple[str, ...]
    about: str


PARTS: Mapping[str, Part] = MappingProxyType(
    {
        "files": Part(
            "Damaged files",
            ("eval.faults.files", "eval.faults.commands"),
            "Whole files of every kind that is read, written by the library itself, with one to five kinds of damage "
            "each: flipped bits, parts cut out, cut off, overwritten, repeated, moved or taken from another file, "
            "sizes and counts at the ends of their types, numbers that no float holds, thousands of levels of nesting. "
            "Beside them folders, pipes, devices and endless files in the place of files, and bombs: images of 65,535 "
            "squared, archives that unpack to gigabytes, arrays that promise 2^60 numbers, aliases of aliases. Where a "
            "format has checksums, what is read from a damaged file must be what was in the whole one; reading it as "
            "anything else is a wrong answer. *Command line* runs commands on such files and looks at what they print.",
        ),
        "texts": Part(
            "Texts",
            ("eval.faults.texts", "eval.faults.options"),
            "The same for texts that stay texts: automata, YAML, XML, settings, options of commands, and JSON that is "
            "changed as values, with checksums made right again.",
        ),
        "formulas": Part(
            "Formulas",
            ("eval.faults.formulas",),
            "Formulas at random, and such that grow: chains, many parts, ranges, repeated signs.",
        ),
        "kills": Part(
            "Kills",
            ("eval.faults.kills",),
            "Sweeps that are killed and continued: every row that was finished must be there, and be the same.",
        ),
    }
)


def write_page(counts: Path, results: Path = RESULTS) -> Path:
    """Copy the counts of the parts that were run beside the page, and write the page from all that are there.

    Args:
        counts: the folder that the parts were run with.
        results: where the page is.

    Returns:
        The page.
    """
    (results / _DATA).mkdir(exist_ok=True)
    for name in PARTS:
        if (counts / name / TALLY).exists():
            tally = read_tally(counts / name / TALLY)
            # Examples name files of the machine that they were made on.
            rows = {kind: dataclasses.replace(row, examples={}) for kind, row in tally.rows.items()}
            dataclasses.replace(tally, rows=rows).write(results / _DATA / f"{name}.json")
    (results / PAGE).write_text(page(results), "utf-8")
    return results / PAGE


def page(results: Path = RESULTS) -> str:
    """The text of the page, from the counts beside it."""
    tallies = {name: read_tally(results / _DATA / f"{name}.json") for name in PARTS if _counted(results, name)}
    lines = [*_head(tallies), *(line for name in tallies for line in _section(name, tallies[name]))]
    return lines_of("\n".join(map(_wrapped, lines)), results)


def _wrapped(line: str) -> str:
    """A paragraph in lines of the width that pages have; rows of tables and what stands in code stay as they are."""
    return line if line.startswith(("|", "<")) else textwrap.fill(line, 120, break_on_hyphens=False)


def _counted(results: Path, name: str) -> bool:
    return (results / _DATA / f"{name}.json").exists()


def _head(tallies: Mapping[str, Tally]) -> Iterator[str]:
    yield "# Bad input, and kills"
    yield ""
    yield (
        "Whatever the library is given ends in an answer or in one clear line, soon. `python -m eval.faults` attacks "
        "it with damaged inputs and kills running sweeps; anyone can run it for some minutes (`--minutes`), and each "
        "case again by its number (`--replay`)."
    )
    yield ""
    yield from _totals(tallies)
    yield ""
    yield (
        f"A *clear error* is a `PotlpError` of at most {LONGEST_MESSAGE:,} characters, which the command line shows as "
        "one line. Any other exception, a message that cannot be shown, and a process that dies count as a "
        f"*traceback*. A *hang* takes longer than {LIMIT:g} s, or the limit of its kind, twice. Each case may add "
        f"{MEMORY // MIB:,} MiB to the memory of its process. Seconds in which a case waited for a core do not count."
    )
    yield ""


def _totals(tallies: Mapping[str, Tally]) -> Iterator[str]:
    """All cases by what they are, whatever part they are of."""
    for unit in sorted({unit for tally in tallies.values() for unit in tally.sums()}):
        row = summed([tally.sums()[unit] for tally in tallies.values() if unit in tally.sums()], unit)
        yield f"- {row.cases:,} {unit}: {', '.join(f'{row.counts[verdict]:,} {verdict}' for verdict in Verdict)}"


def _section(name: str, tally: Tally) -> Iterator[str]:
    yield f"## {PARTS[name].title}"
    yield ""
    yield PARTS[name].about
    yield ""
    yield table(tally)
    yield f"<!-- made: {_DATA}/{name}.json -->"
    yield ""
    bad = {kind: row for kind, row in tally.rows.items() if any(row.counts[v] for v in Verdict if v not in GOOD)}
    if bad:
        numbers = "; ".join(f"{kind}: {', '.join(map(str, row.bad))}" for kind, row in bad.items())
        yield f"Cases that ended badly, by number (seed {tally.seed}): {numbers}."
        yield ""
