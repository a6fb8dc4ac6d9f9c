"""A finished trial as a row of the store."""

import shlex
import subprocess
import sys
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int32, PRNGKeyArray

from potlp_jax.sweep.specification import configuration_hash
from potlp_jax.sweep.store import Item, Row
from potlp_jax.trials.batch import Finished
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.loop import versions as library_versions
from potlp_jax.trials.record import Trial
from potlp_jax.world.grid import World, world_digest
from potlp_jax.world.moves import NEIGHBOURS


def trial_row(
    item: Item,
    trial: Finished,
    world: World,
    key: PRNGKeyArray,
    config: TrialConfig,
    versions: Mapping[str, str],
) -> Row:
    """The row of a finished trial.

    Args:
        item: which trial of the sweep it was.
        trial: how it went.
        world: in which it ran.
        key: the trial's own, before any folding; the row keeps its words, so that the trial can be run again.
        config: its settings; the row keeps their hash.
        versions: of the libraries, and of the estimator that was asked.

    Returns:
        The row, with the commit of the sources that run now.
    """
    return Row(
        item=item,
        outcome=trial.outcome.value,
        cost=trial.cost,
        budget=trial_budget(world, config.budget_factor),
        steps=len(trial.path) - 1,
        decisions=trial.decisions,
        fallbacks=trial.fallbacks,
        status=trial.status,
        key=_words(key),
        path=path_text(trial.path),
        configuration=configuration_hash(config),
        versions=dict(versions),
        commit=source_commit(),
        seconds=trial.seconds,
        world_digest=world_digest(world),
    )


def differences_of(row: Row, trial: Trial) -> list[str]:
    """In what a trial that was run once more is not that of its row.

    Args:
        row: of the store.
        trial: of the same item.

    Returns:
        Of outcome, path, number of decisions and of fallbacks, and status those that differ, by name.
    """
    now = {
        "outcome": trial.outcome.value,
        "path": path_text(np.array(trial.path, np.int32)),
        "decisions": len(trial.decisions),
        "fallbacks": trial.summary()["fallbacks"],
        "status": trial.status,
    }
    return [name for name, value in now.items() if getattr(row, name) != value]


def trial_budget(world: World, factor: float) -> float:
    """The cost at which a trial in this world is given up (docs/model.md, section 7)."""
    # On the host and in metres; `trials.rules.budget` is the same on the device, in cells.
    return factor * float(np.sum(np.asarray(world.extent))) * float(world.resolution)


def path_text(path: Int32[np.ndarray, "steps 2"]) -> str:
    """A path as text: its first cell, and one digit for each move, by its place in ``world.moves.NEIGHBOURS``."""
    # A byte a move instead of a dozen: rows of thousands of trials with paths of hundreds of cells stay small.
    numbers = {move: str(number) for number, move in enumerate(NEIGHBOURS)}
    moves = np.diff(path, axis=0).tolist()
    return f"{path[0, 0]},{path[0, 1]}:" + "".join(numbers[row, column] for row, column in moves)


def read_path(text: str) -> Int32[np.ndarray, "steps 2"]:
    """The cells of a path that ``path_text`` wrote."""
    start, _, moves = text.partition(":")
    steps = [tuple(map(int, start.split(","))), *(NEIGHBOURS[int(move)] for move in moves)]
    return np.cumsum(np.array(steps, np.int32), axis=0, dtype=np.int32)


@lru_cache(maxsize=1)
def source_commit() -> str:
    """The commit that the package was run from, with ``+`` where files were changed; empty where git holds no such."""
    folder = Path(__file__).parents[1]

    # Once a process: a worker that runs for hours writes the commit it was started from.
    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        # An installed package may lie in the folder of a repository that is of something else.
        git("ls-files", "--error-unmatch", str(Path(__file__)))
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", str(folder)) else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


def provenance() -> dict[str, Any]:
    """Where a result comes from: the command that runs, the commit of the package and the versions, JSON-able."""
    # As it was typed, but without the folders of the interpreter and of an installed script.
    interpreted = sys.orig_argv[1:2] != [] and not sys.orig_argv[1].startswith("-")
    program, *arguments = sys.orig_argv[1:] if interpreted else ["python", *sys.orig_argv[1:]]
    return {
        "command": shlex.join([Path(program).name, *arguments]),
        "commit": source_commit(),
        "versions": library_versions(),
    }


def _words(key: PRNGKeyArray) -> tuple[int, int]:
    # Threefry keys have two words; keys of another kind would not unpack, rather than lose a word.
    first, second = np.asarray(jax.random.key_data(key)).tolist()
    return int(first), int(second)
