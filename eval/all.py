"""The experiments behind docs/results, one after the other, on one commit.

    python -m eval.all --list                                   # what there is, what it writes, how long it takes
    python -m eval.all --out out/all --data DATA --processes 2
    python -m eval.all --out out/all --data DATA --only table1 limit worst

``DATA`` is the folder with the maps and floor plans of others; without it the experiments that read them are left out,
and named, as are those on Slurm where none is started (eval/scale/local_slurm.sh). Each experiment is a command of its
own, as its page quotes it, and has a log in ``--out``; those that work in steps keep them in a folder there. Killed,
the same command goes on: what was finished at this commit is not run again, and what was begun goes on from its own
folder. One that fails is named at the end, and does not stop the others. Some commands write their page's data, others
print tables: those are in the log, and are carried to the page by hand. Experiments that read what another one has
written come after it in the list.
"""

import argparse
import dataclasses
import fcntl
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

from eval.experiments import EXPERIMENTS
from potlp_jax.errors import ConfigurationError
from potlp_jax.sweep.rows import source_commit

# Those of this environment, whatever else is called so.
_PROGRAMS = {"python": sys.executable, "potlp": str(Path(sys.executable).with_name("potlp"))}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What all experiments of one run share."""

    out: Path
    data: Path | None
    processes: int
    commit: str

    def words(self, name: str) -> list[str]:
        """The command of an experiment."""
        return [self._filled(word, name) for word in shlex.split(EXPERIMENTS[name].command)]

    def variables(self, name: str) -> dict[str, str]:
        """What the experiment's environment has beside what is there."""
        return {key: self._filled(value, name) for key, value in EXPERIMENTS[name].variables.items()}

    def done_file(self, name: str) -> Path:
        """Where it is written that an experiment is finished."""
        return self.out / f"{name}.json"

    def is_done(self, name: str) -> bool:
        """Whether it was finished at this commit, by this command."""
        file = self.done_file(name)
        if not file.exists():
            return False
        done = json.loads(file.read_text("utf-8"))
        return (done["commit"], done["words"]) == (self.commit, self.words(name))

    def _filled(self, text: str, name: str) -> str:
        return text.format(out=self.out / name, all=self.out, data=self.data, processes=self.processes)


def left_out(run: Run, names: Iterable[str]) -> dict[str, str]:
    """The experiments that cannot run here, and why: they need what is not there, or read what such ones write."""
    missing: dict[str, str] = {}
    # In the order of the list, in which what is read comes first.
    for name in names:
        unwritten = [source for source in EXPERIMENTS[name].reads if source in missing]
        if EXPERIMENTS[name].needs_data and run.data is None:
            missing[name] = "it reads maps or plans of others: name their folder with --data"
        elif (needed := EXPERIMENTS[name].needs) is not None and needed not in os.environ:
            missing[name] = f"it needs a service that {needed} names: start it, and set the variable"
        elif unwritten:
            missing[name] = f"it reads what is left out: {', '.join(unwritten)}"
    return missing


def perform(run: Run, names: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Run what is not done, one after the other; gives the name of each and what is written down of it.

    Output goes to a log for each. Only what ended well is written down as done.

    Raises:
        ConfigurationError: an experiment still runs that an earlier call began, which was killed.
    """
    run.out.mkdir(parents=True, exist_ok=True)
    for name in names:
        if run.is_done(name):
            continue
        (run.out / name).mkdir(exist_ok=True)
        began, words = time.monotonic(), run.words(name)
        with (run.out / f"{name}.log").open("a", encoding="utf-8") as log:
            _lock(log)
            code = _run(run, name, log)
        ended = {"words": words, "commit": run.commit, "seconds": round(time.monotonic() - began, 1), "code": code}
        if code == 0:
            written = run.done_file(name).with_suffix(".tmp")
            written.write_text(json.dumps(ended, indent=1) + "\n", "utf-8")
            # A call that is killed leaves the whole file or none.
            written.replace(run.done_file(name))
        yield name, ended


def _lock(log: TextIO) -> None:
    # The experiment has the log as its output and so holds the lock, too, as long as it lives.
    try:
        fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ConfigurationError(f"{log.name}: the experiment still runs; wait for its end, or end it") from None


def _run(run: Run, name: str, log: TextIO) -> int:
    """Run an experiment to its end; returns its exit code."""
    program, *words = run.words(name)
    process = subprocess.Popen(
        [_PROGRAMS[program], *words],
        stdout=log,
        stderr=subprocess.STDOUT,
        env={**os.environ, **run.variables(name)},
    )
    # Its threads come later and inherit this. Only Linux can; elsewhere the system places the process.
    if EXPERIMENTS[name].one_core and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(process.pid, {min(os.sched_getaffinity(0))})
    try:
        return process.wait()
    except BaseException:
        process.kill()
        raise


def listing() -> str:
    """The table of ``--list``."""
    rows = [("experiment", "page", "minutes", "command")]
    for name, experiment in EXPERIMENTS.items():
        rows.append((name, experiment.page, str(experiment.minutes or "?"), experiment.command))
    names, pages = (max(len(row[column]) for row in rows) for column in (0, 1))
    lines = [f"{name:{names}}  {page:{pages}}  {minutes:>7}  {command}" for name, page, minutes, command in rows]
    known = [experiment.minutes for experiment in EXPERIMENTS.values() if experiment.minutes]
    unknown = len(EXPERIMENTS) - len(known)
    lines.append(f"Together {sum(known) / 60:.0f} hours, and {unknown} experiments that were not run in one go.")
    return "\n".join(lines)


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="print what there is and stop")
    parser.add_argument("--out", type=Path, help="folder of logs and of what the experiments keep")
    parser.add_argument("--data", type=Path, help="folder with maps/ and floorplans/ of others")
    parser.add_argument("--only", nargs="+", choices=list(EXPERIMENTS), default=list(EXPERIMENTS), metavar="NAME")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    if arguments.list:
        print(listing())
        return 0
    if arguments.out is None:
        parser.error("name a folder with --out, or use --list")
    # As they were typed: results hold the command that made them, and no folder of one machine.
    data = arguments.data
    if data is not None and not (data / "maps").is_dir():
        parser.error(f"{data} has no folder maps; name the folder with maps/ and floorplans/ in it")
    run = Run(out=arguments.out, data=data, processes=arguments.processes, commit=source_commit())
    missing = left_out(run, arguments.only)
    for name, why in missing.items():
        print(f"{name}: left out: {why}", flush=True)
    try:
        failed = _told(run, [name for name in arguments.only if name not in missing])
    except ConfigurationError as error:
        parser.error(str(error))
    return int(bool(failed or missing))


def _told(run: Run, names: Sequence[str]) -> list[str]:
    """Run experiments, with a line for each; returns those that failed."""
    failed = []
    for name, ended in perform(run, names):
        how = "done" if ended["code"] == 0 else f"failed with exit code {ended['code']}: see {run.out / name}.log"
        print(f"{name}: {how}, {ended['seconds'] / 60:.1f} minutes", flush=True)
        failed += [name] if ended["code"] else []
    return failed


if __name__ == "__main__":
    sys.exit(main())
