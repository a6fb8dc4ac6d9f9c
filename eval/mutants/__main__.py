"""Make each fault of ``eval.mutants.core`` in a copy of the tree and run the tests that are to notice it.

    python -m eval.mutants --report docs/results/mutants
    python -m eval.mutants --only 'pending cost' --report out/mutants

A mutant is caught where a test fails, or runs into the time limit: run this on a tree whose tests pass. Results are
kept in PREFIX.json, so that the same command again goes on where it was stopped; mutants whose file or tests have
changed run again. The page about them stands beside it. Ends with exit code 1 where a mutant survives, or is stale: its
text does not occur exactly once.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.mutants.core import MUTANTS
from eval.mutants.mutant import Mutant
from eval.provenance import lines_of
from potlp_jax.sweep.rows import provenance, source_commit

ROOT = Path(__file__).parents[2]
LIMIT: int = 600
"""Seconds of the processor for the tests of one mutant: many times what they take, for a mutant may never end."""

KEPT = ("potlp_jax", "eval", "train", "tests", "docs", "examples", "pyproject.toml", "README.md", "Makefile")
"""Of the tree: what the tests of mutants need."""


def stale(mutant: Mutant, root: Path = ROOT) -> str | None:
    """Why a mutant cannot be made; None where it can."""
    file = root / mutant.file
    count = file.read_text().count(mutant.old) if file.is_file() else 0
    if count != 1:
        return f"{mutant.says}: the text occurs {count} times in {mutant.file}"
    missing = [test for test in mutant.tests if not (root / test).is_file()]
    return f"{mutant.says}: there is no {missing[0]}" if missing else None


def run_tests(folder: Path, mutant: Mutant) -> tuple[str, str]:
    """The verdict of a mutant's tests in a copy of the tree, and the first one that failed, or the time limit."""
    # How many passed is read below, so it is no quieter than the tree has it.
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", *mutant.tests]
    command += ["-k", mutant.only] if mutant.only else []
    # The copy is what is imported, whatever is installed.
    environment = os.environ | {
        "PYTHONPATH": str(folder),
        "PYTHONDONTWRITEBYTECODE": "1",
        "HYPOTHESIS_PROFILE": "mutants",
        "POTLP_NATIVE": "1" if mutant.beside_kernels or Path(mutant.file).parent.name == "kernels" else "0",
    }
    done = subprocess.run(
        command, cwd=folder, env=environment, preexec_fn=_limit, capture_output=True, text=True, check=False
    )
    if done.returncode == -signal.SIGXCPU:
        return "caught", "the time limit"
    if done.returncode in (0, 5):
        # Where no test was selected, or each one skipped itself, nothing has looked at the mutant.
        return "survived" if re.search(r"\b\d+ passed\b", done.stdout) else "not tested", ""
    failed = re.search(r"^(?:FAILED|ERROR) tests/(.+?)(?: - .*)?$", done.stdout, re.M)
    return "caught", failed[1] if failed else ""


def _limit() -> None:
    # Not of the clock: on a busy machine a sound test would run into it, and the mutant count as caught.
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT + 10))


def judge(mutant: Mutant, folder: Path) -> dict[str, Any]:
    """Make the fault in the copy, run its tests, and take it back."""
    file, begun = folder / mutant.file, time.monotonic()
    sound = file.read_text()
    try:
        file.write_text(sound.replace(mutant.old, mutant.new))
        verdict, failed = run_tests(folder, mutant)
    finally:
        file.write_text(sound)
    return {"verdict": verdict, "by": failed, "seconds": round(time.monotonic() - begun, 1)}


def identity(mutant: Mutant) -> str:
    """Changes with the mutant, its file and its tests."""
    texts = [repr(dataclasses.astuple(mutant)), *((ROOT / name).read_text() for name in (mutant.file, *mutant.tests))]
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


def run(mutants: Sequence[Mutant], results: Path) -> list[dict[str, Any]]:
    """Judge those that the file of results does not have yet; returns the rows of all."""
    rows = {row["identity"]: row for row in json.loads(results.read_text())["rows"]} if results.exists() else {}
    with tempfile.TemporaryDirectory(prefix="potlp-mutants-") as temporary:
        folder = Path(temporary)
        for name in KEPT:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, folder / name)
        for number, mutant in enumerate(mutants, start=1):
            known = identity(mutant)
            if known not in rows:
                about = {"identity": known, "part": mutant.part, "fault": mutant.says, "file": mutant.file}
                rows[known] = about | judge(mutant, folder) | {"commit": source_commit()}
                # After every mutant: all of them take the better part of an hour.
                write([rows[key] for key in map(identity, MUTANTS) if key in rows], results)
            row = rows[known]
            print(f"{number}/{len(mutants)} {row['verdict']} ({row['seconds']} s): {mutant.says}", flush=True)
    return [rows[identity(mutant)] for mutant in mutants]


def write(rows: Sequence[dict[str, Any]], results: Path) -> None:
    """The file of results: the rows, and the commits at which they were judged."""
    commits = sorted({row["commit"] for row in rows})
    results.write_text(json.dumps({"provenance": provenance(), "commits": commits, "rows": rows}, indent=1) + "\n")


PAGE: str = """# Mutation check of the core

**Question.** Would the tests notice a small fault in the core: in what a rollout knows and costs, the searches,
sensing, frontiers, distances, automata, labels, the loss, the rules of a trial, the auditor?

**Answer.** {caught} of {all} faults are noticed. Each is made alone in a copy of the repository, and the tests that are
to notice it run there; the last column names the first one that failed. The faults, with the exchange of text that
makes each, are in `eval/mutants/core/`.

**Command.**

```sh
python -m eval.mutants --report docs/results/mutants
```

{table}
<!-- made: {data} -->
"""
"""The page of results."""


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as Markdown, in the order of the parts of the core."""
    lines = ["| part | fault | in | noticed by |", "|---|---|---|---|"]
    for row in rows:
        found = f"`{row['by']}`" if row["verdict"] == "caught" else f"**{row['verdict']}**"
        lines.append(f"| {row['part']} | {row['fault']} | `{row['file'].removeprefix('potlp_jax/')}` | {found} |")
    return "\n".join(lines) + "\n"


def page(rows: Sequence[dict[str, Any]], results: Path) -> str:
    """The page about the rows that a file of results holds."""
    caught = sum(row["verdict"] == "caught" for row in rows)
    text = PAGE.format(caught=caught, all=len(rows), table=table(rows), data=results.name)
    return lines_of(text, results.parent)


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--report", type=Path, required=True, metavar="PREFIX", help="of the results' files")
    parser.add_argument("--only", default="", help="mutants whose description contains this")
    arguments = parser.parse_args()
    mutants = [mutant for mutant in MUTANTS if arguments.only in mutant.says]
    wrong = [reason for mutant in mutants if (reason := stale(mutant))]
    if wrong:
        print("\n".join(wrong), file=sys.stderr)
        return 1
    results = arguments.report.with_suffix(".json")
    results.parent.mkdir(parents=True, exist_ok=True)
    rows = run(mutants, results)
    results.with_suffix(".md").write_text(page(rows, results))
    survivors = [row for row in rows if row["verdict"] != "caught"]
    print("".join(f"{row['verdict']}: {row['fault']}\n" for row in survivors) or "every mutant is caught")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
