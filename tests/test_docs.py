"""What the documentation says is true: examples run, commands parse, paths and links exist, figures are the data's.

Examples are the fenced blocks of README and docs. A comment before a block says how it is tested, invisible to readers:

    <!-- test: parse -->    Python that needs data or minutes: its syntax is checked, and its imports are made
    <!-- test: skip -->     a shell block with placeholders

All other Python blocks of a page run in one namespace, in order. Every ``potlp ...`` line has to parse.
"""

import ast
import copy
import csv
import functools
import gzip
import json
import re
import runpy
import shlex
from pathlib import Path

import pytest
import yaml

from eval import settings_page
from potlp_jax.learning.panorama_learner import PanoramaOptions
from potlp_jax.planning.search.config import UctConfig
from potlp_jax.recipes.collection import CollectConfig
from potlp_jax.recipes.fitting import FitConfig
from potlp_jax.recipes.recipe import Beside, Recipe, Round
from potlp_jax.trials.config import TrialConfig
from tests.reference.mentions import parse_module, parse_potlp

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
BLOCK = re.compile(
    r"^(?:<!-- test: (?P<how>\w+) -->\n+)?(?P<indent> *)```(?P<language>\w*)\n(?P<code>.*?)^(?P=indent)```$",
    re.M | re.S,
)
KNOWN_PROGRAMS = {
    "pip",
    "conda",
    "make",
    "taskset",
    "mkdocs",
    "pre-commit",
    "git",
    "ruff",
    "pyright",
    "pytest",
    "python",
    "apt-get",
    "export",
    "local_slurm.sh",
    "srun",
    ".",
}
FOLDERS = ("docs", "eval", "tests", "notebooks", "examples", "potlp_jax")


def _name(path):
    return str(path.relative_to(ROOT))


def _blocks(page, *languages):
    return [match for match in BLOCK.finditer(page.read_text()) if match["language"] in languages]


def _prose(page):
    """A page without its fenced blocks."""
    return BLOCK.sub("", page.read_text())


@functools.cache
def _python_pages():
    return [page for page in PAGES if _blocks(page, "python")]


@pytest.mark.long
@pytest.mark.parametrize("page", _python_pages(), ids=_name)
def test_python_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "example"}
    for block in _blocks(page, "python"):
        tree = compile(block["code"], _name(page), "exec", ast.PyCF_ONLY_AST)
        if block["how"] == "parse":
            imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
            tree = ast.Module(imports, [])
        else:
            assert block["how"] is None, f"unknown test: {block['how']}"
        exec(compile(tree, _name(page), "exec"), namespace)


def _commands(page):
    """Shell commands of a page's blocks and of its inline code that begins with ``potlp``, as lists of words."""
    lines = []
    for block in _blocks(page, "sh", "bash", "console", ""):
        if block["how"] == "skip":
            continue
        code = block["code"].replace("\\\n", " ")
        if block["language"] in ("console", "") and "$ " in code:
            # A transcript: lines with a prompt are commands, the others what they print.
            lines += [line[2:] for line in code.splitlines() if line.startswith("$ ")]
        elif block["language"] in ("sh", "bash"):
            lines += code.splitlines()
    inline = re.findall(r"(?<!`)`(potlp (?!\.\.\.)[^`]+)`(?!`)", re.sub(r"\n *", " ", _prose(page)))
    # A command that is only mentioned has no arguments: it has to exist.
    lines += [f"{line} --help" if re.fullmatch(r"[a-z -]+", line) else line for line in inline if "..." not in line]
    for line in lines:
        tokens = shlex.shlex(line, posix=True, punctuation_chars="&|;")
        tokens.whitespace_split, tokens.commenters = True, "#"
        command = []
        for token in [*tokens, "&"]:
            if set(token) <= set("&|;"):
                if command:
                    yield line, command
                command = []
            else:
                command.append(token)


PAGES_WITH_COMMANDS = [page for page in PAGES if any(_commands(page))]


@pytest.mark.parametrize("page", PAGES_WITH_COMMANDS, ids=_name)
def test_command_lines_parse(page):
    for line, words in _commands(page):
        for word in words:
            if word.split("/")[0] in FOLDERS and Path(word).suffix:
                assert (ROOT / word).exists(), f"{line}: {word} does not exist"
        program = Path(words[0]).name
        if program == "potlp":
            if words[1:] and words[1].isupper():
                continue  # `potlp COMMAND --help`
            wrong = parse_potlp(words[1:])
            assert wrong is None, f"{line}: {wrong}"
        elif program == "python" and words[1:2] == ["-m"]:
            wrong = parse_module(words[2], words[3:])
            assert wrong is None, f"{line}: {wrong}"
        elif program == "make":
            targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M)
            assert set(words[1:]) <= set(targets), f"{line}: the Makefile has {targets}"
        else:
            assert program in KNOWN_PROGRAMS or words[0].startswith(".") or "=" in words[0], f"{line}: {program}?"


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_paths_in_code_exist(page):
    # Paths from the root on: tests/test_mentions.py.
    packages = {path.name for path in (ROOT / "potlp_jax").iterdir() if path.is_dir()}
    for word in re.findall(r"(?<!`)`([\w./*-]+/[\w./*-]+)`(?!`)", _prose(page)):
        first = word.split("/")[0]
        if first in packages and word.endswith((".py", "/")):
            assert list((ROOT / "potlp_jax").glob(word)), f"{word} does not exist in potlp_jax"


def _anchors(page):
    """What mkdocs makes of headings."""
    anchors = set()
    for heading in re.findall(r"^#+ (.+)$", _prose(page), re.M):
        text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
        anchors.add(re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text.replace("`", "")).strip().lower()))
    return anchors


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_resolve(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", _prose(page)):
        if re.match(r"https?:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{target} does not exist"
        if anchor:
            assert anchor in _anchors(file), f"{target}: {_name(file)} has {sorted(_anchors(file))}"


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_no_formula_in_a_table_has_a_backslash(page):
    """The site would show it; ``<code>`` with ``&#124;`` is read alike there and in the repository."""
    for line in page.read_text("utf-8").splitlines():
        assert not (line.startswith("|") and re.search(r"`[^`|]*\\\|[^`]*`", line)), line


def test_the_page_of_settings_is_that_of_the_code():
    told = "python -m eval.settings_page writes it"
    assert (ROOT / settings_page.PAGE).read_text("utf-8") == settings_page.page(), told


def test_every_setting_has_a_meaning():
    owners = (TrialConfig, UctConfig, CollectConfig, FitConfig, PanoramaOptions, Recipe, Round, Beside)
    rows = [row for owner in owners for row in settings_page.rows_of(owner)]
    assert {"decision.commitment", "spacing", "training.warmup", "explored.pursued"} <= {name for name, _, _ in rows}
    assert [name for name, _, meaning in rows if not meaning] == []


@pytest.mark.parametrize("up", ["", "../"])
def test_links_to_files_of_the_repository_lead_to_the_pages_of_the_site(up):
    page = f"[a]({up}../notebooks/1_first_plan.ipynb) [b]({up}../CHANGELOG.md#fixed) "
    page += f"[c]({up}../potlp_jax/__init__.py) [d](x.md)"
    site = f"[a]({up}notebooks/1_first_plan.md) [b]({up}changes.md#fixed) [c]({up}api/index.md) [d](x.md)"
    # By its path: a folder without __init__.py gives way to any package called docs.
    assert runpy.run_path(str(ROOT / "docs" / "site_hooks.py"))["to_pages"](page, up) == site


def test_the_navigation_has_every_page():
    listed = set(re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text())) - {"contributing.md", "changes.md"}
    assert listed == {str(page.relative_to(ROOT / "docs")) for page in PAGES if page.is_relative_to(ROOT / "docs")}


def test_the_picture_of_the_house_has_every_package():
    picture = (ROOT / "docs" / "architecture.md").read_text().split("```text\n", 1)[1].split("```", 1)[0]
    drawn = set(re.findall(r"^  (\w+)(?:/|\.py)", picture, re.M))
    package = ROOT / "potlp_jax"
    packages = {path.stem for path in package.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert drawn == packages - {"__init__"}


QUOTED = yaml.safe_load((ROOT / "docs" / "quoted.yaml").read_text())


def _value(data, path):
    head, _, rest = path.partition(".")
    for step in f"{QUOTED['names'].get(head, head)}{'.' if rest else ''}{rest}".split("."):
        if step.startswith("["):
            key, _, wanted = step[1:-1].partition("=")
            (data,) = [entry for entry in data if str(entry[key]) == wanted]
        else:
            data = data[int(step)] if isinstance(data, list) else data[step]
    return data


def _render(text, data):
    """A quoted text with its placeholders filled from data."""

    def value(match):
        number = _value(data, match[1])
        return f"{100 * number if match[2] else number:.{match[3]}f}"

    return re.sub(r"\{([^:}]+):(%?)(\d)\}", value, text)


def _flat(page):
    return re.sub(r"\s+", " ", (ROOT / page).read_text())


def _quotes():
    return [
        (entry["source"], page, text)
        for entry in QUOTED["quotes"]
        for page in entry["pages"]
        for text in entry["texts"]
    ]


@pytest.mark.parametrize(("source", "page", "text"), _quotes())
def test_quoted_figures_are_those_of_the_data(source, page, text):
    rendered = _render(text, json.loads((ROOT / source).read_text()))
    assert rendered in _flat(page), f"{page} does not say what {source} has: {rendered}"


def test_another_figure_in_the_data_is_noticed():
    source, page, text = _quotes()[0]
    data = json.loads((ROOT / source).read_text())
    other = copy.deepcopy(data)
    _value(other, "t3")["attainable_low"] += 0.02
    assert _render(text, data) in _flat(page)
    assert _render(text, other) not in _flat(page)


def test_wins_and_ties_are_those_of_the_rows():
    costs = {}
    with gzip.open(ROOT / "docs/results/table1/rows.csv.gz", "rt", newline="") as file:
        for row in csv.DictReader(file):
            costs.setdefault((row["task"], row["world"]), {})[row["policy"]] = float(row["cost"])
    page = (ROOT / "docs/results/table1.md").read_text()
    tasks = json.loads((ROOT / "docs/results/table1/test.json").read_text())["tables"]
    for number, table in tasks.items():
        # Costs in the file are rounded to three decimals, and equal paths have equal costs.
        gains = [world["baseline"] - world["potlp"] for (task, _), world in costs.items() if task == table["task"]]
        counts = [sum(gain > 0 for gain in gains), sum(gain == 0 for gain in gains), sum(gain < 0 for gain in gains)]
        shares = [100 * count / len(gains) for count in counts]
        assert f"| {number} | {' | '.join(f'{share:.1f} %' for share in shares)} |" in page


@pytest.mark.parametrize("page", list(QUOTED["complete"]))
def test_no_percentage_of_a_front_page_is_without_a_source(page):
    text = _flat(page)
    for source, quoted, template in _quotes():
        if quoted == page:
            text = text.replace(_render(template, json.loads((ROOT / source).read_text())), "")
    found = set(re.findall(r"[\d.,]*\d %", text))
    assert found == set(QUOTED["complete"][page])
