"""What any text of the repository mentions exists: files, commands with their options, targets of make, names.

Pages, docstrings, comments, messages and help are read; commands are parsed by the real parsers and not run.
"""

import dataclasses
import importlib
import os
import re
from pathlib import Path

import pytest

from potlp_jax import plugins
from potlp_jax.cli import completion
from potlp_jax.environments.families import FAMILIES
from potlp_jax.planning.move import MoveKind
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.search.config import UctConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.move_record import KIND_NAMES
from potlp_jax.trials.record import Decision
from potlp_jax.view.decisions import KINDS
from tests.reference.command_line import all_commands
from tests.reference.mentions import ROOT, found, known_options, parse_module, parse_potlp, texts, words_of

FOLDERS = "docs|eval|tests|examples|notebooks|train|potlp_jax"
OTHERS = {
    "pip": {"--no-deps", "--no-cache-dir", "--disable-pip-version-check"},
    "venv, build and twine": {"--clear", "--outdir", "--strict"},
    "git": {"--porcelain", "--error-unmatch"},
    "CSS": {"--faint"},
    "XLA": {"--xla"},
    "dask": {"--nthreads", "--host", "--port", "--no-dashboard", "--no-nanny", "--death-timeout", "--memory-limit"},
    "Slurm": {"--noheader", "--format", "--full", "--signal", "--user", "--ntasks", "--nodes", "--ntasks-per-node"},
}
"""Options in our texts that are of others; those of the browser that draws pictures stand in one file of their own."""
MADE = {
    "contributing.md": "docs/site_hooks.py",
    "changes.md": "docs/site_hooks.py",
    "api/index.md": "docs/site_hooks.py",
    "regret.md": "eval/bench/regret_report.py",
    "faults.md": "eval/faults/__main__.py",
    "X.md": "eval/bench/throughput.py",
    "NAME.md": "eval/fair_settings/__main__.py",
}
"""Files that are not there before something writes them, and what does."""
PUBLISHED = DecisionConfig(search=UctConfig())


def test_texts_of_every_kind_are_read():
    places = {place.split(":")[0] for place, _ in texts()}
    for name in ("README.md", "docs/maps.md", "potlp_jax/types.py", "eval/table1.py", "Makefile"):
        assert name in places
    # A docstring, a comment, and a message with a value.
    every = "\n".join(text for _, text in texts())
    for part in ("Names shared by every package", "Rows of results hold these numbers", "there is no shipped task X"):
        assert part in every


def test_files_exist():
    missing, files = [], _files()
    for place, path in found(rf"(?<![\w/.$<{{=-])((?:{FOLDERS})/[\w./*-]*[\w*])"):
        if path not in MADE and not list(ROOT.glob(path)) and not list(ROOT.glob(f"{path}.*")):
            missing.append(f"{place}: {path}")
    for place, name in found(r"(?<![\w/*.-])((?:[\w-]+/)*[\w-]+\.(?:md|py|ipynb))\b(?!:\w)"):
        # Code blocks of pages show files of the reader's own.
        known = name in MADE or place.startswith(".ci/") or _is_the_readers(place, name)
        if not known and not any(f"/{file}".endswith(f"/{name}") for file in files):
            missing.append(f"{place}: {name}")
    assert not missing, "\n".join(missing)


def _files() -> list[str]:
    """The project's own: what is installed or made beside them must not stand in for a file that is missing."""
    found_files = []
    for folder, folders, names in os.walk(ROOT):
        folders[:] = [name for name in folders if name not in (".venv", ".git", "out", "__pycache__")]
        found_files += [(Path(folder) / name).relative_to(ROOT).as_posix() for name in names]
    return found_files


def _is_the_readers(place: str, name: str) -> bool:
    shown = rf"""(?:# |Path[(]"){re.escape(name)}\b"""
    return place.endswith(".md") and re.search(shown, (ROOT / place).read_text()) is not None


def test_what_writes_the_files_that_are_made_exists():
    assert all((ROOT / maker).is_file() for maker in MADE.values())


def test_sections_of_the_model_exist():
    sections = set(re.findall(r"^## (\d+)\.", (ROOT / "docs/model.md").read_text(), re.M))
    cited = found(r"docs/model\.md[,)]?\s+(?:\()?sections?\s+(\d+)")
    assert cited
    assert not [f"{place}: {number}" for place, number in cited if number not in sections]


POTLP = [
    *found(r"(?s)(?:(?<!`)`|\[cyan\]|``)(potlp [^`\[]+?)(?:`|\[/cyan\])"),
    # Indented in a docstring: to the end of the line, which a backslash continues.
    *((place, line.replace("\\ ", "")) for place, line in found(r"(?m)^ {4,}(potlp (?:[^\n\\]|\\\n)+)$")),
]
MODULES = found(r"python -m ([\w.]+(?:[ \t]+[^`\n#&|;()]+)?)")


@pytest.mark.parametrize(("place", "line"), POTLP)
def test_potlp_commands_parse(place, line):
    if "..." in line or re.match(r"potlp [A-Z]+\b", line):
        return  # a form, such as `potlp COMMAND --help`
    words = ["1" if re.fullmatch("[A-Z]+", word) else word for word in words_of(line)[1:]]
    wrong = parse_potlp(words)
    assert wrong is None or _is_a_mention(wrong), f"{place}: {line}: {wrong}"


def _is_a_mention(wrong: str) -> bool:
    """Whether a line is only too short: a sentence may name a command, or one with an option, without the rest."""
    too_short = "Missing (option|argument)|requires an argument|arguments are required|─ Commands ─"
    return re.search(too_short, wrong) is not None


def test_indented_commands_are_read():
    command = "potlp run firefighting --camera examples.own_camera:thermal --estimator firefighting"
    assert ("examples/own_camera.py:1", command) in POTLP


def test_what_is_no_command_is_refused():
    for line in ("run toy --no-such-option", "no-such-command", "run toy --world x", "sweep show --csv"):
        wrong = parse_potlp(line.split())
        assert wrong is not None, line
        assert not _is_a_mention(wrong)
    for module, words in (("eval.table1", ["--out", "x", "--seed", "1"]), ("eval.no_such_module", [])):
        wrong = parse_module(module, words)
        assert wrong is not None
        assert not _is_a_mention(wrong)


@pytest.mark.parametrize(("place", "line"), MODULES)
def test_modules_commands_parse(place, line):
    module, *words = words_of(line)
    if module.split(".")[-1].isupper() or "{" in line or "..." in words:
        return  # a form, such as `python -m examples.NAME`, or one that the program fills in (tests/test_all.py)
    wrong = parse_module(module.rstrip("."), words)
    assert wrong is None or _is_a_mention(wrong), f"{place}: {line}: {wrong}"


def test_targets_of_make_exist():
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M))
    mentioned = found(r"`make (\w+)`") + found(r"(?m)^make (\w+)")
    assert {target for _, target in mentioned} >= {"demo", "test"}
    assert not [f"{place}: make {target}" for place, target in mentioned if target not in targets]


def test_options_exist():
    known = known_options().union(*OTHERS.values())
    scripts = (".ci/", ".github/", "Makefile", "eval/pictures.py")
    every = found(r"(?<![\w-])(--[a-z][a-z-]+)")
    ours = [(place, option) for place, option in every if not place.startswith(scripts)]
    assert {option for _, option in ours} >= {"--world", "--processes", "--report"}
    assert not [f"{place}: {option}" for place, option in ours if option not in known]


def test_names_exist():
    groups = {plugins.ENVIRONMENTS, plugins.POLICIES, plugins.CAMERAS, plugins.ESTIMATORS}
    wrong = []
    for place, name in found(r"`(potlp_jax(?:\.\w+)+)`"):
        if name not in groups and not _exists(name):
            wrong.append(f"{place}: {name}")
    # Within the package names begin with the subpackage. `task` and `world` are variables too.
    packages = {path.parent.name for path in (ROOT / "potlp_jax").glob("*/__init__.py")}
    variables = {"task": ["task.task.Task", "task.task.TaskArrays"], "world": ["world.grid.World"]}
    for place, name in found(r"`((?:\w+\.)+\w+)(?:\(\))?`"):
        first, rest = name.split(".", 1)
        meanings = [name, *(f"{variable}.{rest}" for variable in variables.get(first, []))]
        if first in packages and not any(_exists(f"potlp_jax.{meaning}") for meaning in meanings):
            wrong.append(f"{place}: {name}")
    assert not wrong, "\n".join(wrong)


def test_settings_exist():
    sections = {field.name for field in dataclasses.fields(TrialConfig)}
    named = [(place, name) for place, name in found(r"`((?:\w+\.)+\w+)`") if place.endswith(".md")]
    settings = [(place, name) for place, name in named if name.split(".")[0] in sections]
    assert {name for _, name in settings} >= {"decision.commitment"}
    for place, name in settings:
        assert _holds(TrialConfig(), name) or _holds(TrialConfig(decision=PUBLISHED), name), f"{place}: {name}"


def _holds(value: object, name: str) -> bool:
    for part in name.split("."):
        if not hasattr(value, part):
            return False
        value = getattr(value, part)
    return True


def _exists(name: str) -> bool:
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if not hasattr(value, part) and part not in getattr(value, "__annotations__", {}):
                return False
            value = getattr(value, part, None)
        return True
    return False


def _help_of(command: tuple[str, ...], option: str) -> str:
    (parameter,) = [each for each in all_commands()[command].params if option in each.opts]
    return parameter.help


def test_lists_in_the_help_are_complete():
    commands = all_commands()
    for command in (("run",), ("compare",)):
        assert all(name in _help_of(command, "environment") for name in FAMILIES)
        assert all(name in _help_of(command, "--split") for name in completion.SPLITS)
        assert all(name in _help_of(command, "--search") for name in completion.SEARCHES)
    assert all(policy in _help_of(("run",), "--policy") for policy in Policy)
    assert all(policy in _help_of(("log", "replay"), "--policy") for policy in Policy if policy != Policy.KNOWN_MAP)
    recipes = completion.complete_recipe("")
    for command, each in commands.items():
        for parameter in each.params:
            if "--recipe" in parameter.opts:
                assert all(name in parameter.help for name in recipes), command
    sweeps = [path.stem for path in (ROOT / "potlp_jax/sweep/data").glob("*.yaml")]
    assert sweeps
    assert all(name in _help_of(("sweep", "run"), "file") for name in sweeps)


def test_kinds_of_decisions_are_listed_everywhere():
    kinds = {name.lower() for name in vars(MoveKind) if name.isupper()}
    assert set(KIND_NAMES.values()) == kinds
    # An attempt beyond a subgoal is described by its action.
    assert set(KINDS) == kinds - {"action"}
    assert set(re.findall(r'``"(\w+)"``', str(Decision.__doc__).split("kind:")[1].split("choice:")[0])) == kinds


def test_a_checkpoint_is_of_a_training():
    """What is shipped and asked is an estimator: other files than these have no checkpoints to speak of."""
    of_training = (
        "learning/checkpoints.py",
        "learning/training.py",
        "learning/training_options.py",
        "recipes/fitting.py",
        "recipes/journal.py",
    )
    speaking = {place.split(":")[0] for place, _ in found(r"(?i)(checkpoint)")}
    others = {place for place in speaking if not place.endswith(of_training)}
    # Errors names both; the estimator's file says that it is none; the lists of names and docs of training tell of it.
    allowed = {"potlp_jax/errors.py", "potlp_jax/learning/serialization.py"}
    assert {place for place in others if place.startswith("potlp_jax/")} <= allowed
