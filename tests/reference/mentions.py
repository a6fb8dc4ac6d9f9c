"""What the repository's own texts mention: files, commands, options and names, with the place that mentions them.

Texts are the pages, docstrings, comments, messages and help of the Python files, notebooks, shipped YAML files, the
Makefile and what CI runs. Tests are not read: they name what must not exist.
"""

import argparse
import ast
import functools
import importlib
import io
import json
import re
import shlex
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import typer.completion
import typer.core
from typer.testing import CliRunner

from potlp_jax.cli import app
from tests.reference.command_line import all_commands

ROOT = Path(__file__).parents[2]
CODE = ("potlp_jax", "eval", "train", "examples")
PLACEHOLDER = "X"
"""Stands for what a message fills in."""


@functools.cache
def texts() -> tuple[tuple[str, str], ...]:
    """Every text with its place, ``FILE`` or ``FILE:LINE``."""
    return tuple(_texts())


def _texts() -> Iterator[tuple[str, str]]:
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]:
        yield _name(page), page.read_text()
    for folder in CODE:
        for file in (ROOT / folder).rglob("*.py"):
            yield from _python_texts(file)
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        for cell in json.loads(notebook.read_text())["cells"]:
            yield _name(notebook), "".join(cell["source"])
    data = [*(ROOT / "potlp_jax").rglob("*.yaml"), *(ROOT / "eval").rglob("*.yaml"), *(ROOT / ".github").rglob("*.yml")]
    for file in [ROOT / "Makefile", ROOT / "mkdocs.yml", *(ROOT / ".ci").iterdir(), *data]:
        yield _name(file), file.read_text()


def _name(file: Path) -> str:
    return str(file.relative_to(ROOT))


def _python_texts(file: Path) -> Iterator[tuple[str, str]]:
    source = file.read_text()
    pieces = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.JoinedStr):
            # Its constants are walked too, but alone they would be cut at every value.
            pieces |= {id(value) for value in node.values}
            texts = (value.value if isinstance(value, ast.Constant) else PLACEHOLDER for value in node.values)
            yield f"{_name(file)}:{node.lineno}", "".join(map(str, texts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in pieces:
            yield f"{_name(file)}:{node.lineno}", node.value
    # Comments that follow one another are one text: a command may be broken over lines.
    block: list[str] = []
    last = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if block and token.start[0] != last + 1:
                yield f"{_name(file)}:{last}", " ".join(block)
                block = []
            block.append(token.string.lstrip("# "))
            last = token.start[0]
    if block:
        yield f"{_name(file)}:{last}", " ".join(block)


def found(pattern: str, group: int | str = 1) -> list[tuple[str, str]]:
    """Places and what a pattern finds in their texts, each once; line breaks within a match become spaces."""
    matches = {
        (place, re.sub(r"\s+", " ", match[group]).strip())
        for place, text in texts()
        for match in re.finditer(pattern, text)
    }
    return sorted(matches)


def words_of(line: str) -> list[str]:
    """Words of a command line up to a comment or the end of the command."""
    tokens = shlex.shlex(line, posix=True, punctuation_chars="&|;")
    tokens.whitespace_split, tokens.commenters = True, "#"
    words: list[str] = []
    for token in tokens:
        if set(token) <= set("&|;"):
            break
        words.append(token)
    return words


def parse_potlp(words: list[str]) -> str | None:
    """What is wrong with the words after ``potlp``, as the real parser says; None where nothing is. Runs nothing."""
    # Options that install completion do it while they are read, in the shell and the home folder of whoever tests.
    installed = mock.patch.object(typer.completion, "install", return_value=("a shell", Path("a file")))
    with mock.patch.object(typer.core.TyperCommand, "invoke", return_value=None), installed:
        result = CliRunner().invoke(app, words)
    return None if result.exit_code == 0 else f"exit code {result.exit_code}: {result.output}"


class _WouldBeginError(Exception):
    """The arguments were read; the program would begin its work."""


def parse_module(module: str, words: list[str]) -> str | None:
    """What is wrong with ``python -m MODULE WORDS``, as the module's own parser says; None where nothing is."""
    try:
        specification = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        specification = None
    if specification is None:
        return f"there is no module {module}"
    if not module.startswith("eval"):
        return None  # a tool of others, or a program without arguments
    name = f"{module}.__main__" if specification.submodule_search_locations else module
    program = importlib.import_module(name)
    source = Path(str(program.__file__)).read_text()
    assert "ArgumentParser" in source, f"{name} reads no arguments: running it here would start its work"
    return _parse_with(program, words)


def _parse_with(program: object, words: list[str]) -> str | None:
    real = argparse.ArgumentParser.parse_args

    def parse(self, *arguments, **options):
        real(self, *arguments, **options)
        raise _WouldBeginError

    told = io.StringIO()
    with (
        mock.patch.object(argparse.ArgumentParser, "parse_args", parse),
        mock.patch.object(sys, "argv", ["program", *words]),
        mock.patch.object(sys, "stderr", told),
        mock.patch.object(sys, "stdout", told),
        # Some turn the cache on before they read their arguments.
        mock.patch.object(program, "enable_compilation_cache", create=True),
    ):
        try:
            program.main()
        except _WouldBeginError:
            return None
        except SystemExit as end:
            return told.getvalue() if end.code else None
    raise AssertionError(f"{program} has begun its work without reading arguments")


@functools.cache
def known_options() -> frozenset[str]:
    """Every option of every ``potlp`` command, and of the programs in ``eval/``."""
    options = {
        option
        for command in all_commands().values()
        for parameter in command.params
        for option in [*parameter.opts, *parameter.secondary_opts]
    }
    for file in (ROOT / "eval").rglob("*.py"):
        options |= set(re.findall(r'add_argument\(\s*"(--[a-z-]+)"', file.read_text()))
    return frozenset(options) | {"--help"}
