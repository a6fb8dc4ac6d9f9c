"""Pages of the site that follow from the sources: the API by package, the notebooks, how to contribute, what changed.

mkdocs calls ``on_config``, ``on_files`` and ``on_page_markdown`` (`hooks` in mkdocs.yml). Generated pages never go
stale when a module moves.
"""

import ast
import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "potlp_jax"
NOT_FOR_CALLERS = ("cli",)
"""Rooms without an API page: the command line is called by its commands."""
_PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md"}
_NOTEBOOK, _PUBLIC = r"notebooks/\w+\.ipynb", "potlp_jax/__init__.py"


def on_config(config: Any) -> Any:
    """Put the generated pages into the navigation, where mkdocs.yml has a bare ``API`` and ``Notebooks``."""
    pages = {
        "API": [{"By use": "api/index.md"}, *({package: f"api/{package}.md"} for package in packages())],
        "Notebooks": [{title_of(notebook): f"notebooks/{notebook.stem}.md"} for notebook in notebooks()],
    }
    config.nav = [{name: pages.get(name, value) for name, value in entry.items()} for entry in config.nav]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages."""
    # Here, so that what does not build the site, such as tests, can read this module without mkdocs.
    from mkdocs.structure.files import File

    content = {
        "api/index.md": public_names(),
        # Their links start at the root of the repository.
        "contributing.md": (ROOT / "CONTRIBUTING.md").read_text().replace("](docs/", "]("),
        "changes.md": (ROOT / "CHANGELOG.md").read_text().replace("](docs/", "]("),
    }
    content |= {f"api/{package}.md": api_page(package) for package in packages()}
    content |= {f"notebooks/{notebook.stem}.md": notebook_page(notebook) for notebook in notebooks()}
    for path, text in content.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links to files of the repository to their pages; keep numbers, units and errors of a cell on one line."""
    lines = to_pages(markdown, "../" * page.file.src_uri.count("/")).split("\n")
    return "\n".join(
        re.sub(r"(?<=\d) (?=%|± )|(?<=±) ", "\N{NO-BREAK SPACE}", line) if line.startswith("|") else line
        for line in lines
    )


def to_pages(markdown: str, up: str) -> str:
    """A page whose links to notebooks, to the package and to texts at the root lead to the pages made of them.

    Args:
        markdown: the page.
        up: the way from its folder to ``docs/``.
    """

    def led(link: re.Match[str]) -> str:
        file = Path(link["file"])
        if file.parts[0] == "notebooks":
            page = f"notebooks/{file.stem}.md"
        else:
            page = "api/index.md" if file.name == "__init__.py" else _PAGES[file.name]
        return f"]({up}{page}{link['anchor'] or ''})"

    files = "|".join((*_PAGES, _NOTEBOOK, _PUBLIC))
    return re.sub(rf"\]\({re.escape(up)}\.\./(?P<file>{files})(?P<anchor>#[\w-]+)?\)", led, markdown)


def packages() -> list[str]:
    """Packages and single modules at the top of the library, by name."""
    names = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    return sorted(names - {"__init__", *NOT_FOR_CALLERS})


def notebooks() -> list[Path]:
    """In the order of their numbers."""
    return sorted((ROOT / "notebooks").glob("*.ipynb"))


def modules_of(package: str) -> list[str]:
    """Dotted names of a package's modules, packages before their members; those without a public name are left out."""
    single = PACKAGE / f"{package}.py"
    paths = [single] if single.exists() else sorted((PACKAGE / package).rglob("*.py"))
    names = []
    for path in paths:
        if any(part.startswith("_") and part != "__init__.py" for part in path.relative_to(PACKAGE).parts):
            continue
        if path.name == "__init__.py" and not _defines_names(path):
            continue
        parts = path.relative_to(ROOT).with_suffix("").parts
        names.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return names


def _defines_names(path: Path) -> bool:
    defining = (ast.FunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign)
    return any(isinstance(node, defining) for node in ast.parse(path.read_text()).body)


def _summary(path: Path) -> str:
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    return " ".join(text.split("\n\n")[0].split())


def api_page(package: str) -> str:
    """A package's page: what it is for, then every module with its public names."""
    source = PACKAGE / f"{package}.py" if (PACKAGE / f"{package}.py").exists() else PACKAGE / package / "__init__.py"
    lines = [f"# {package}", ""]
    if source.name == "__init__.py":
        lines += [_summary(source), ""]
    return "\n".join([*lines, *(f"::: {name}\n" for name in modules_of(package))])


def public_names() -> str:
    """``potlp_jax.__all__`` with its comments as headings, each name linked to the page of its package."""
    path = PACKAGE / "__init__.py"
    homes = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("potlp_jax.")
        for alias in node.names
    }
    listed = path.read_text().split("__all__ = [", 1)[1].split("\n]", 1)[0]
    lines = ["# The public names, by use", "", "All of these are imported from `potlp_jax`.", ""]
    for line in listed.splitlines()[1:]:
        text = line.strip()
        if text.startswith("#"):
            lines += ["", f"## {text.lstrip('# ').rstrip('.')}", ""]
        elif name := text.strip('",'):
            lines.append(f"- [`{name}`][{homes[name]}]" if name in homes else f"- `{name}`")
    return "\n".join([*lines, "", "The other pages of this section list every module of a package, with types."])


def title_of(notebook: Path) -> str:
    """The heading of a notebook's first cell."""
    return "".join(_cells(notebook)[0]["source"]).splitlines()[0].lstrip("# ")


def _cells(notebook: Path) -> list[dict[str, Any]]:
    return json.loads(notebook.read_text())["cells"]


def notebook_page(notebook: Path) -> str:
    """A notebook as a page: its text, and its code as blocks. Links to notebooks and ``docs/`` lead to their pages."""
    parts = []
    for cell in _cells(notebook):
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
    where = f"*This page is the notebook `notebooks/{notebook.name}` of the repository.*"
    return "\n\n".join([parts[0], where, *parts[1:]]).replace(".ipynb)", ".md)").replace("](../docs/", "](../")
