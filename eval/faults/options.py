"""Words of the command line that are damaged: names, numbers, formulas and options of every command.

Commands run up to where their work begins: what they then do is for other tests.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np

from eval.faults import Kind, seeds
from eval.faults.commands import run_command
from eval.faults.mutations import damaged_text, pick
from eval.faults.seeds import kept, write_tree

_LONGEST_WORD = 300
"""Characters of a word: usage errors quote it whole, and are wrapped to the width of a terminal."""

# Files are named without folders: a damaged path must not lead out of the folder of the case.
_LINES: tuple[tuple[str, ...], ...] = (
    ("task", "!fire U extinguisher & F fire", "--propositions", "fire,extinguisher,exit"),
    ("task", "firefighting-2", "--max-positive-literals", "1", "--json"),
    ("run", "toy", "--task", "2", "--policy", "oracle", "--world", "3", "--split", "validation"),
    ("run", "map:map.yaml,resolution=0.2,radius=0.1", "--simulations", "30", "--search", "uct", "--task", "1"),
    ("run", "floorplan:plan.xml", "--estimator", "estimator.npz", "--no-animation", "--out", "out"),
    ("compare", "toy", "--policies", "oracle,optimistic", "--trials", "3", "--processes", "1", "--out", "out"),
    ("compare", "rooms", "-n", "2", "--picture", "1", "--out", "out", "--camera", "collections:OrderedDict"),
    ("sweep", "sweep.yaml", "--out", "out", "--processes", "1", "--json"),
    ("sweep", "show", "out"),
    ("sweep", "export", "out", "--out", "table.csv"),
    ("report", "out", "--no-open"),
    ("audit", "trial.json", "--json"),
    ("explain", "trial.json:0", "--json"),
    ("collect", "firefighting", "--worlds", "2", "--split", "training", "--out", "out", "--set", "seed=4"),
    ("collect", "--recipe", "recipe.yaml", "--processes", "1", "--out", "out"),
    ("fit", "dataset", "--validation", "dataset", "--out", "out", "--epochs", "2", "--minutes", "0.5"),
    ("fit", "--recipe", "firefighting", "--out", "out", "--set", "training.patience=10", "--epochs", "3"),
    ("estimator", "info", "estimator.npz", "--json"),
    ("map", "inspect", "map.yaml", "--resolution", "0.2", "--radius", "0.1", "--start", "0.5,0.5"),
    ("map", "clean", "map.yaml", "--out", "clean.yaml", "--radius", "0.1"),
    ("map", "label", "map.yaml", "--place", "goal=0.5,-0.5,0.3", "--task", "1=F goal", "--start", "0.5,0.5"),
    ("map", "label", "map.yaml", "--room", "lab=-0.3,-1.3 1.9,-1.3 1.9,-0.4", "--out", "new.places.yaml", "--add"),
    ("log", "inspect", "drive.bag", "--map-topic", "/map", "--free", "25", "--occupied", "65", "--json"),
    ("log", "replay", "drive.bag", "--labels", "map.places.yaml", "--task", "F document", "--out", "out"),
    ("export", "F goal", "--out", "out", "--subgoals", "8", "--batch", "any", "--platforms", "cpu,cuda"),
    ("export", "F goal", "--out", "out", "--height", "40", "--width", "60", "--simulations", "30"),
    ("bench", "--parts", "search,distances", "--batches", "1,16", "--family", "two", "--subgoals", "4"),
    ("bench", "--parts", "decision", "--environment", "rooms", "--size", "33", "--core", "0", "--repeats", "2"),
)
_WORDS = sorted({word for line in _LINES for word in line})

_WORK = (
    "potlp_jax.cli.inputs.make_world",
    "potlp_jax.trials.loop.run_trial",
    "potlp_jax.sweep.runner.run_sweep",
    "potlp_jax.recipes.collection.collect",
    "potlp_jax.recipes.fitting.fit",
    "potlp_jax.recipes.recipe.follow",
    "potlp_jax.bench.planner.measure_search",
    "potlp_jax.bench.planner.make_world",
    "potlp_jax.export.export_planner",
    "potlp_jax.logs.replaying.replay",
    "webbrowser.open",
)
"""Where the work of commands begins."""


class _WorkBegins(BaseException):
    """All words were taken: the rest of the command is work. No ``Exception``, which the command may catch."""


@contextlib.contextmanager
def _without_work() -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for name in _WORK:
            stack.enter_context(patch(name, side_effect=_WorkBegins))
        # Cores are of the process, which runs other cases afterwards.
        stack.enter_context(patch("os.sched_setaffinity"))
        stack.enter_context(contextlib.suppress(_WorkBegins))
        yield


def damaged_words(random: np.random.Generator, words: tuple[str, ...]) -> list[str]:
    """The words of a command with one to three changes.

    Args:
        random: chooses.
        words: a command that can be run.

    Returns:
        Words that a shell could give: without null characters, and not of any length.
    """
    changed = list(words)
    for _ in range(int(random.integers(1, 4))):
        place = int(random.integers(len(changed)))
        kind = random.random()
        if kind < 0.5:
            changed[place] = damaged_text(random, changed[place], _WORDS)
        elif kind < 0.65:
            del changed[place]
        elif kind < 0.8:
            changed[place] = pick(random, _WORDS)
        elif kind < 0.9:
            changed.insert(place, pick(random, _WORDS))
        else:
            changed[place] = ""
        changed = changed or [""]
    # Nothing is written outside of the folder of the case.
    return [word.replace("\x00", "")[:_LONGEST_WORD].lstrip("/") for word in changed]


def _make_files(folder: Path) -> None:
    write_tree(
        {
            "map.yaml": seeds.map_yaml("map.png").encode(),
            "map.png": seeds.encoded("png"),
            "map.places.yaml": seeds.places_yaml(folder).encode(),
            "plan.xml": seeds.floor_plan_xml().encode(),
            "sweep.yaml": seeds.SWEEP_YAML.encode(),
            "recipe.yaml": seeds.RECIPE_YAML.encode(),
        },
        folder,
    )
    seeds.make_bag(folder, "ros1")
    seeds.make_record(folder)
    seeds.make_estimator(folder)
    seeds.make_dataset(folder / "dataset")


def _options(random: np.random.Generator, folder: Path) -> None:
    """One command with damaged words, in a folder that has the files which they name."""
    write_tree(kept(folder, "options", _make_files), folder)
    words = damaged_words(random, pick(random, _LINES))
    (folder / "words.txt").write_bytes("\n".join(words).encode("utf-8", "surrogatepass"))
    with contextlib.chdir(folder), _without_work():
        run_command(words)


KINDS = (Kind("words of the command line", _options, "texts", limit=10.0, weight=0.1),)
