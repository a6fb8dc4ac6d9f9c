"""Make each fault of ``eval.mutants.core`` in a copy of the tree and run the tests that are to notice it.

    python -m eval.mutants --out out/mutants
    python -m eval.mutants --only 'pending cost' --out out/mutants

A mutant is caught where a test fails, or runs into the time limit: run this on a tree whose tests pass. Results are
kept in FOLDER/mutants.json, so that the same command again goes on where it was stopped; mutants whose text or tests
have changed run again. FOLDER/mutants.md has the table. Ends with exit code 1 where a mutant survives, or is stale: its
text does not occur exactly once.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.mutants.core import MUTANTS, Mutant
from potlp_jax.sweep.rows import provenance

ROOT = Path(__file__).parents[2]
LIMIT: float = 600.0
"""Seconds that the tests of one mutant may take: many times what they take, for a mutant may never end."""

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


def run_tests(folder: Path, tests: Sequence[str], only: str) -> tuple[int, str]:
    """Exit code of the tests in a copy of the tree, and the first one that failed; 124 at the time limit."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    command += ["-k", only] if only else []
    # The copy is what is imported, whatever is installed.
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False
        )
    except subprocess.TimeoutExpired:
        return 124, "the time limit"
    failed = re.search(r"^(?:FAILED|ERROR) tests/(\S+)", done.stdout, re.M)
    return done.returncode, failed[1] if failed else ""


def judge(mutant: Mutant, folder: Path) -> dict[str, Any]:
    """Make the fault in the copy, run its tests, and take it back."""
    file, begun = folder / mutant.file, time.monotonic()
    sound = file.read_text()
    try:
        file.write_text(sound.replace(mutant.old, mutant.new))
        code, failed = run_tests(folder, mutant.tests, mutant.only)
    finally:
        file.write_text(sound)
    # 5: no test was selected, which is no survivor but a mutant that nothing has looked at.
    verdict = {0: "survived", 5: "not tested"}.get(code, "caught")
    return {"verdict": verdict, "by": failed, "seconds": round(time.monotonic() - begun, 1)}


def identity(mutant: Mutant) -> str:
    """Changes with the mutant, its file and its tests."""
    texts = [repr(dataclasses.astuple(mutant)), *((ROOT / name).read_text() for name in (mutant.file, *mutant.tests))]
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


def run(mutants: Sequence[Mutant], out: Path) -> list[dict[str, Any]]:
    """Judge those that are not judged yet; returns the rows of all."""
    results = out / "mutants.json"
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
                rows[known] = about | judge(mutant, folder)
                # After every mutant: all of them take the better part of an hour.
                ours = [rows[key] for key in map(identity, MUTANTS) if key in rows]
                results.write_text(json.dumps({"provenance": provenance(), "rows": ours}, indent=1) + "\n")
            row = rows[known]
            print(f"{number}/{len(mutants)} {row['verdict']} ({row['seconds']} s): {mutant.says}", flush=True)
    return [rows[identity(mutant)] for mutant in mutants]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as Markdown, by part of the core."""
    caught = sum(row["verdict"] == "caught" for row in rows)
    lines = [f"{caught} of {len(rows)} mutants are caught."]
    for part in dict.fromkeys(row["part"] for row in rows):
        lines += ["", f"### {part[0].upper()}{part[1:]}", "", "| fault | in | noticed by |", "|---|---|---|"]
        for row in rows:
            if row["part"] == part:
                found = f"`{row['by']}`" if row["verdict"] == "caught" else f"**{row['verdict']}**"
                lines.append(f"| {row['fault']} | `{row['file'].removeprefix('potlp_jax/')}` | {found} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="folder of the results")
    parser.add_argument("--only", default="", help="mutants whose description contains this")
    arguments = parser.parse_args()
    mutants = [mutant for mutant in MUTANTS if arguments.only in mutant.says]
    wrong = [reason for mutant in mutants if (reason := stale(mutant))]
    if wrong:
        print("\n".join(wrong), file=sys.stderr)
        return 1
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = run(mutants, arguments.out)
    (arguments.out / "mutants.md").write_text(table(rows))
    survivors = [row for row in rows if row["verdict"] != "caught"]
    print("".join(f"{row['verdict']}: {row['fault']}\n" for row in survivors) or "every mutant is caught")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
