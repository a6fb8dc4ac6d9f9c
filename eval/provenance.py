"""What pages of results say below their tables: with which command, at which commit and with which versions.

    python -m eval.provenance           # write the lines
    python -m eval.provenance --check   # say which are not those of the data; exit code 1 if any

Below each table of a page in docs/results stands ``<!-- made: FILE -->``, with the file of the data behind it (or
several, joined by commas; ``-`` where there is none), and a line that this program makes from it. What a file does not
hold, because it was made before its command kept it, is said to be not recorded.
"""

import argparse
import gzip
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "docs" / "results"
UNRECORDED: str = "not recorded"
_LINE = re.compile(r"^(<!-- made: (?P<files>[^>]+) -->)\n(?:\*Made [^\n]*\*\n)?", re.M)


def made_line(made_by: Mapping[str, Any]) -> str:
    """The line of one result.

    Args:
        made_by: what ``sweep.rows.provenance`` gave, or what is known of it: ``command``, ``commits`` in place of one
            ``commit``, and ``versions``.

    Returns:
        A sentence in Markdown.
    """
    if not any(made_by.values()):
        return "*Made before results kept their command, commit and versions.*"
    commits = made_by.get("commits") or [commit for commit in [made_by.get("commit")] if commit]
    # With ``+`` the package had changes that no commit holds.
    named = ", ".join(
        f"`{commit.rstrip('+')[:7]}`{' with changes' if commit.endswith('+') else ''}" for commit in commits
    )
    versions = ", ".join(f"{name} {number}" for name, number in sorted(made_by.get("versions", {}).items()))
    command = f"`{made_by['command']}`" if made_by.get("command") else UNRECORDED
    return f"*Made by command: {command}; commit: {named or UNRECORDED}; versions: {versions or UNRECORDED}.*"


def made_by_of(data: Any) -> dict[str, Any]:
    """What a file of results holds about how it was made, wherever in it."""
    found = dict(data.get("provenance", {})) if isinstance(data, Mapping) else {}
    # Trials of one table may be of several commits: those count, not the one that wrote the report.
    commits = sorted(set(_values(data, "commits")))
    if commits:
        found["commits"] = commits
    if isinstance(data, Mapping) and "versions" not in found:
        found["versions"] = data.get("versions", {name: data[name] for name in ("jax",) if name in data})
    return found


def _values(data: Any, name: str) -> Iterator[str]:
    """All entries of lists called ``name``, at any depth."""
    if isinstance(data, Mapping):
        for key, value in data.items():
            if key == name and isinstance(value, list):
                yield from value
            else:
                yield from _values(value, name)
    elif isinstance(data, list):
        for value in data:
            yield from _values(value, name)


def lines_of(page: str, folder: Path = RESULTS) -> str:
    """A page with the line below each mark made anew.

    Args:
        page: its text.
        folder: of the files that its marks name.

    Returns:
        The text.
    """

    def renew(mark: re.Match[str]) -> str:
        known = [made_by_of(_read(folder / name.strip())) for name in mark["files"].split(",") if name.strip() != "-"]
        # Several files of one table: what they agree in, and the commits of all.
        merged = {name: value for made_by in known for name, value in made_by.items()}
        merged["commits"] = sorted({commit for made_by in known for commit in _commits(made_by)})
        merged["versions"] = _versions(known)
        if len({made_by.get("command") for made_by in known}) > 1:
            merged.pop("command", None)
        return f"{mark[1]}\n{made_line(merged)}\n"

    return _LINE.sub(renew, page)


def _versions(known: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """By package, all versions that the files name."""
    found: dict[str, set[str]] = {}
    for made_by in known:
        for package, version in made_by.get("versions", {}).items():
            found.setdefault(package, set()).add(version)
    return {package: " and ".join(sorted(versions)) for package, versions in found.items()}


def _commits(made_by: Mapping[str, Any]) -> list[str]:
    return made_by.get("commits") or [commit for commit in [made_by.get("commit")] if commit]


def _read(file: Path) -> Any:
    text = gzip.decompress(file.read_bytes()).decode() if file.suffix == ".gz" else file.read_text("utf-8")
    # Of rows, one line each, the first may say where they come from.
    return json.loads(text.splitlines()[0]) if ".jsonl" in file.name else json.loads(text)


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    arguments = parser.parse_args()
    stale = []
    for page in sorted(RESULTS.glob("*.md")):
        text = page.read_text("utf-8")
        renewed = lines_of(text)
        if renewed != text:
            stale.append(page.name)
            if not arguments.check:
                page.write_text(renewed, "utf-8")
    print("".join(f"{name}: {'not those of the data' if arguments.check else 'written'}\n" for name in stale), end="")
    return int(arguments.check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
