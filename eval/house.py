"""How readable the library is, in counts: function lengths, annotations, docstrings, Args and Returns, comments.

    python -m eval.house                       # this library, package by package
    python -m eval.house PACKAGE [PACKAGE ...]  # folders of other packages, for comparison

Comments are those of ``tokenize``, without pragmas (``noqa``, ``type:``, ``pragma``), per 100 lines that hold code. A
function counts as public if no part of its name begins with an underscore; ``self`` and ``cls`` are no arguments.
"""

import argparse
import ast
import dataclasses
import io
import statistics
import tokenize
from collections.abc import Iterator
from pathlib import Path

import potlp_jax

PRAGMAS = ("noqa", "type:", "pragma", "pyright:", "fmt:", "ruff:")
LONG = 3
"""Arguments from which on a public function should document them."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclasses.dataclass
class Counts:
    """Counts of some files, added up."""

    code_lines: int = 0
    comments: int = 0
    lengths: list[int] = dataclasses.field(default_factory=list)
    arguments: int = 0
    annotated: int = 0
    public: int = 0
    documented: int = 0
    words: list[int] = dataclasses.field(default_factory=list)
    long: int = 0
    with_args: int = 0
    with_returns: int = 0

    def add(self, path: Path) -> None:
        """Count one file."""
        text = path.read_text("utf-8")
        self._count_lines(text)
        for node, public in _definitions(ast.parse(text), True):
            self._count_docstring(node, public)
            if isinstance(node, Function):
                self._count_function(node, public)

    def _count_lines(self, text: str) -> None:
        code: set[int] = set()
        skipped = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                self.comments += not token.string.lstrip("# ").startswith(PRAGMAS)
            elif token.type not in skipped and not token.line.lstrip().startswith(('"""', 'r"""')):
                code.add(token.start[0])
        self.code_lines += len(code)

    def _count_docstring(self, node: ast.AST, public: bool) -> None:
        if public:
            text = ast.get_docstring(node) or ""  # pyright: ignore[reportArgumentType]
            self.public += 1
            self.documented += bool(text)
            self.words += [len(text.split())] if text else []

    def _count_function(self, node: Function, public: bool) -> None:
        first = 1 if ast.get_docstring(node) else 0
        body = node.body[first:]
        if body:
            self.lengths.append((body[-1].end_lineno or body[-1].lineno) - body[0].lineno + 1)
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        arguments = [argument for argument in arguments if argument.arg not in ("self", "cls")]
        self.arguments += len(arguments)
        self.annotated += sum(argument.annotation is not None for argument in arguments)
        # Commands of the command line document each option where it is declared, in its help.
        if public and len(arguments) >= LONG and not _is_command(node):
            text = ast.get_docstring(node) or ""
            self.long += 1
            self.with_args += "Args:" in text
            self.with_returns += "Returns:" in text or "Yields:" in text or _returns_nothing(node)

    def line(self, name: str) -> str:
        """One row of the table."""
        lengths = sorted(self.lengths) or [0]
        return (
            f"{name:24} {statistics.median(lengths):4.0f} / {lengths[int(0.95 * (len(lengths) - 1))]:3} / "
            f"{lengths[-1]:3}   {_share(self.annotated, self.arguments):>5}   "
            f"{_share(self.documented, self.public):>5} {statistics.median(self.words or [0]):4.0f}   "
            f"{self.long:4} {_share(self.with_args, self.long):>6} {_share(self.with_returns, self.long):>6}   "
            f"{100 * self.comments / max(self.code_lines, 1):5.1f}   {self.code_lines:6}"
        )


def _is_command(node: Function) -> bool:
    calls = [entry.func for entry in node.decorator_list if isinstance(entry, ast.Call)]
    return any(isinstance(call, ast.Attribute) and call.attr in ("command", "callback") for call in calls)


def _returns_nothing(node: Function) -> bool:
    return isinstance(node.returns, ast.Constant) and node.returns.value is None


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %" if whole else "-"


def _definitions(node: ast.AST, public: bool) -> Iterator[tuple[ast.AST, bool]]:
    """Classes and functions with whether they are public; what is defined within functions is not."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, Function | ast.ClassDef):
            visible = public and not child.name.startswith("_")
            yield child, visible
            yield from _definitions(child, visible and isinstance(child, ast.ClassDef))
        else:
            yield from _definitions(child, public)


def count(files: list[Path]) -> Counts:
    """The counts of these files."""
    counts = Counts()
    for path in files:
        counts.add(path)
    return counts


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Readability of packages, in counts.")
    parser.add_argument("packages", nargs="*", type=Path, help="folders of other packages")
    others = parser.parse_args().packages
    print(
        f"{'':24} median / p95 / longest   annotated   documented words   public >= {LONG} args: number, Args, Returns"
        "   comments per 100   lines of code"
    )
    library = Path(potlp_jax.__file__).parent
    for folder in sorted({path.parent for path in library.rglob("*.py")}):
        print(count(sorted(folder.glob("*.py"))).line(str(folder.relative_to(library.parent))))
    for package in (library, *others):
        print(count(sorted(package.rglob("*.py"))).line(f"{package.name} (all)"))


if __name__ == "__main__":
    main()
