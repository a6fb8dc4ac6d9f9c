"""Damaged files given to ``potlp``: what a user of the command line sees of them.

Only commands that read first and compute little: what they read with is attacked by ``eval.faults.files`` in numbers.
"""

import contextlib
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from eval.faults import Kind, seeds
from eval.faults.mutations import damaged, pick
from eval.faults.seeds import Tree, kept, write_tree
from potlp_jax.cli import app
from potlp_jax.errors import PotlpError

_MOST_LINES = 12
"""Lines of an error: most have one; those about places end with an example."""


def _maps(folder: Path) -> Tree:
    return {
        "map.yaml": seeds.map_yaml("map.png").encode(),
        "map.png": seeds.encoded("png"),
        "map.places.yaml": seeds.places_yaml(folder).encode(),
    }


def _bag(folder: Path) -> Tree:
    return kept(folder, "ros1", lambda made: seeds.make_bag(made, "ros1"))


def _record(folder: Path) -> Tree:
    return kept(folder, "record", seeds.make_record)


def _automaton(folder: Path) -> Tree:
    from potlp_jax.task.task import Task

    return {"task.hoa": Task.shipped("firefighting-2").to_hoa().encode()}


def _estimator(folder: Path) -> Tree:
    return kept(folder, "estimator", seeds.make_estimator)


_COMMANDS: tuple[tuple[Callable[[Path], Tree], tuple[str, ...]], ...] = (
    (_maps, ("map", "inspect", "{}/map.yaml")),
    (_maps, ("map", "preview", "{}/map.yaml", "--out", "{}/preview.png")),
    (_maps, ("map", "clean", "{}/map.yaml", "--out", "{}/clean.yaml")),
    (_bag, ("log", "inspect", "{}/drive.bag")),
    (_bag, ("log", "inspect", "{}/drive.bag", "--json")),
    (_record, ("explain", "{}/trial.json:0")),
    (_record, ("explain", "{}/trial.json:0", "--json")),
    (_automaton, ("task", "{}/task.hoa")),
    (_estimator, ("estimator", "info", "{}/estimator.npz")),
)


def run_command(words: Sequence[str]) -> None:
    """One command in this process, as the script would run it.

    Args:
        words: after ``potlp``.

    Raises:
        PotlpError: it ended with a clear error, whose line is the message.
        AssertionError: it ended with a code and no word, or with more lines than anybody reads.
    """
    out, errors = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
            app(words)
    # The command line always ends with a code.
    except SystemExit as ending:
        code = ending.code
    else:
        raise AssertionError("no exit code")
    lines = errors.getvalue().splitlines()
    # What nobody can send to a terminal fails here, as it would there.
    (out.getvalue() + errors.getvalue()).encode()
    said = [line for line in lines if line.startswith("potlp: ") or "Error" in line]
    if code and not said and not out.getvalue():
        raise AssertionError(f"code {code} without a word")
    if len(lines) > _MOST_LINES or "Traceback" in errors.getvalue():
        raise AssertionError(errors.getvalue())
    if code and lines:
        # Counted as the clear error that it is.
        raise PotlpError(lines[-1])


def _command(random: np.random.Generator, folder: Path) -> None:
    """One command with one damaged file."""
    make, words = pick(random, _COMMANDS)
    tree = make(folder)
    name = pick(random, sorted(tree))
    write_tree({**tree, name: damaged(random, tree[name], list(tree.values()))}, folder)
    run_command([word.format(folder) for word in words])


KINDS = (Kind("command line", _command),)
