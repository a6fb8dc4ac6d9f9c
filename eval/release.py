"""What a release holds, and what it costs to install: wheel and source distribution, built, checked and measured.

    python -m eval.release --out out/release
    python -m eval.release --out out/release --report docs/results/release

Both archives are built of what git has at the commit that is checked out, and checked by ``twine`` and
``check-wheel-contents``; the wheel has to hold every file of the package that git tracks, and nothing else. Then the
wheel is installed in fresh virtual environments, whole and for planning alone, and measured there, away from the
repository: the disk that each takes, seconds of imports, and seconds from the beginning of the installation to the
first decision, which is a plan from arrays as the README has it. Downloads count where nothing is cached
(``--no-cache`` forgets what is), and so does whatever else the machine does; the load stands beside the seconds.
NAME.json has all.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import time
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from potlp_jax.sweep.rows import provenance

ROOT = Path(__file__).parents[1]
PLANNER = "requirements-planner.txt"
"""The dependencies of planning alone."""

TOOLS = ("build", "twine", "check-wheel-contents")
IMPORTS: Mapping[str, str] = {
    "the package": "import potlp_jax",
    "jax alone": "import jax",
    "planning": "from potlp_jax import BestFirstConfig, PlanningProblem, Task, plan_actions",
}
"""What is imported in a process of its own, by what it is called in the results."""

REPEATS = 5
"""Imports of each kind; the first one, which may compile modules, is kept apart."""

LARGEST = 8
"""Packages that are listed by their size."""


def first_plan(page: str) -> str:
    """The code of a page's plan from arrays: the one Python block that makes a ``PlanningProblem``."""
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (code,) = [block for block in blocks if "PlanningProblem" in block]
    return code


def contents(names: Iterable[str], tracked: Iterable[str]) -> dict[str, Any]:
    """What a wheel holds, beside what it should.

    Args:
        names: of its members.
        tracked: files of the package that git knows.

    Returns:
        How many ``files`` of the package it has, how many of each ``kinds``, and which are ``missing`` or ``foreign``.
    """
    packed = {name for name in names if ".dist-info/" not in name}
    return {
        "files": len(packed),
        "kinds": dict(sorted(Counter(Path(name).suffix or Path(name).name for name in packed).items())),
        "missing": sorted(set(tracked) - packed),
        "foreign": sorted(packed - set(tracked)),
    }


def disk(folder: Path) -> dict[str, Any]:
    """MB that an installation takes, compiled modules included, and its largest entries."""
    sizes: Counter[str] = Counter()
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink():
            sizes[path.relative_to(folder).parts[0]] += path.stat().st_size
    largest = {name: _megabytes(size) for name, size in sizes.most_common(LARGEST)}
    return {"megabytes": _megabytes(sizes.total()), "largest": largest}


def seconds_of(times: Sequence[float]) -> dict[str, float]:
    """Of several runs: the first, and the median of the others."""
    return {"first": round(times[0], 2), "median": round(statistics.median(times[1:]), 2)}


def markdown(results: Mapping[str, Any]) -> str:
    """The tables for a page."""
    archives, installed = results["archives"], results["installations"]
    lines = ["| archive | MB | unpacked, MB |", "|---|---|---|"]
    lines += [f"| {name} | {found['megabytes']} | {found.get('unpacked', '')} |" for name, found in archives.items()]
    kinds = [*next(iter(installed.values()))["imports"]]
    heads = ["installation", "packages", "MB", "installing, s", "first decision, s", "again, s"]
    heads += [f"import of {kind}, s" for kind in kinds]
    lines += ["", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name, found in installed.items():
        figures = [found["packages"], found["disk"]["megabytes"], found["install_s"], found["first_decision_s"]]
        figures += [found["decision_again_s"], *(found["imports"][kind]["median"] for kind in kinds)]
        lines.append(f"| {name} | {' | '.join(map(str, figures))} |")
    return "\n".join(lines)


def _megabytes(size: int) -> float:
    return round(size / 1e6, 1)


def _run(*command: str | Path, cwd: Path | None = None, environment: Mapping[str, str] | None = None) -> str:
    """What a command prints; its errors end the program, with all that it said."""
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}: exit code {done.returncode}\n{done.stdout}")
    return done.stdout


def _seconds(*command: str | Path, cwd: Path | None = None, environment: Mapping[str, str] | None = None) -> float:
    begun = time.monotonic()
    _run(*command, cwd=cwd, environment=environment)
    return time.monotonic() - begun


def _fresh_python(folder: Path) -> Path:
    """The interpreter of a new virtual environment."""
    _run(sys.executable, "-m", "venv", "--clear", folder)
    return folder / "bin" / "python"


def built(out: Path) -> tuple[Path, Path]:
    """Build both archives from a clone of the commit, so that nothing that lies about is packed, and check them.

    Returns:
        The wheel and the source distribution.
    """
    tools, source, archives = out / "tools" / "bin", out / "source", out / "dist"
    _run(_fresh_python(tools.parent), "-m", "pip", "install", "--quiet", *TOOLS)
    _run("rm", "-rf", source, archives)
    _run("git", "clone", "--quiet", ROOT, source)
    # The wheel is made from the unpacked source distribution, which shows whether that is complete.
    _run(tools / "python", "-m", "build", "--outdir", archives, source)
    (wheel,), (sdist,) = archives.glob("*.whl"), archives.glob("*.tar.gz")
    _run(tools / "twine", "check", "--strict", wheel, sdist)
    _run(tools / "check-wheel-contents", wheel, cwd=source)
    return wheel, sdist


def measured(out: Path, steps: Sequence[Sequence[str]], cached: bool) -> dict[str, Any]:
    """Install in a fresh virtual environment and measure there.

    Args:
        out: a folder for all of it.
        steps: what ``pip install`` is given, one call after the other.
        cached: whether pip may take downloads from its cache.

    Returns:
        Packages, disk, seconds and load.
    """
    out.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[0]
    begun = time.monotonic()
    python = _fresh_python(out / "venv")
    for step in steps:
        _run(python, "-m", "pip", "install", "--quiet", *([] if cached else ["--no-cache-dir"]), *step)
    install = time.monotonic() - begun
    (out / "plan.py").write_text(first_plan((ROOT / "README.md").read_text("utf-8")), "utf-8")
    # Neither the repository nor programs that were compiled before.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["XDG_CACHE_HOME"] = str(out / "cache")
    _run("rm", "-rf", out / "cache")
    first = _seconds(python, "plan.py", cwd=out, environment=environment)
    again = _seconds(python, "plan.py", cwd=out, environment=environment)
    imports = {
        name: seconds_of([_seconds(python, "-c", line, cwd=out, environment=environment) for _ in range(REPEATS)])
        for name, line in IMPORTS.items()
    }
    versions = json.loads(_run(python, "-m", "pip", "list", "--format", "json", "--disable-pip-version-check"))
    (packages,) = (out / "venv" / "lib").glob("python*/site-packages")
    return {
        "packages": len(versions),
        "disk": disk(packages),
        "install_s": round(install, 1),
        "plan_s": round(first, 1),
        "first_decision_s": round(install + first, 1),
        "decision_again_s": round(again, 1),
        "imports": imports,
        "load": round(load, 1),
        "versions": {entry["name"]: entry["version"] for entry in versions},
    }


def release(out: Path, cached: bool) -> dict[str, Any]:
    """All of it; ends the program where a check fails."""
    # Of the commit that is cloned now: another may be checked out before the end.
    made_by = provenance()
    wheel, sdist = built(out)
    tracked = _run("git", "-C", ROOT, "ls-files", "potlp_jax").split()
    with zipfile.ZipFile(wheel) as archive:
        held = contents(archive.namelist(), tracked)
        unpacked = _megabytes(sum(entry.file_size for entry in archive.infolist()))
    if held["missing"] or held["foreign"]:
        sys.exit(f"{wheel.name}: {held['missing']} are missing, {held['foreign']} do not belong in it")
    whole, alone = [[str(wheel)]], [["-r", str(ROOT / PLANNER)], ["--no-deps", str(wheel)]]
    return {
        "archives": {
            wheel.name: {"megabytes": _megabytes(wheel.stat().st_size), "unpacked": unpacked, **held},
            sdist.name: {"megabytes": _megabytes(sdist.stat().st_size)},
        },
        "checks": ["twine check --strict", "check-wheel-contents", "every file of the package that git tracks"],
        "installations": {
            "whole": measured(out / "whole", whole, cached),
            "planning alone": measured(out / "planner", alone, cached),
        },
        "python": sys.version.split()[0],
        "cached": cached,
        "provenance": made_by,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of archives and virtual environments")
    parser.add_argument("--no-cache", action="store_true", help="download everything anew")
    parser.add_argument("--report", type=Path, help="without suffix: where the results go")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    results = release(options.out.resolve(), not options.no_cache)
    print(markdown(results))
    if options.report is not None:
        options.report.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
