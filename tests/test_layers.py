"""Dependencies run one way: a package imports only from itself and from packages above it (docs/architecture.md)."""

import ast
from pathlib import Path

import pytest

import potlp_jax

ORDER = (
    "types",
    "errors",
    "checks",
    "precision",
    "compiling",
    "files",
    "images",
    "plugins",
    "codec",
    "cache",
    "native",
    "engine",
    "task",
    "world",
    "environments",
    "planning",
    "export",
    "learning",
    "trials",
    "rl",
    "verify",
    "sweep",
    "recipes",
    "logs",
    "drive",
    "bench",
    "view",
    "cli",
)
PACKAGE = Path(potlp_jax.__file__).parent


def _package(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if parts[0] == "potlp_jax" and len(parts) > 1 else None


def _imports(path: Path) -> list[str]:
    modules = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            modules += [f"{node.module}.{alias.name}" for alias in node.names]
    return modules


SOURCES = [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_package_imports_only_from_packages_above(path):
    own = path.relative_to(PACKAGE).with_suffix("").parts[0]
    for module in _imports(path):
        package = _package(module)
        if package is not None:
            assert ORDER.index(package) <= ORDER.index(own), f"{path.relative_to(PACKAGE)} imports {module}"


def test_only_one_module_imports_each_heavy_neighbour():
    # Spot is imported where formulas become automata, typer by the command line alone, rosbags where logs are read.
    for library, packages in {
        "spot": {"task"},
        "typer": {"cli"},
        "matplotlib": {"view"},
        "rosbags": {"logs"},
        "roslibpy": {"drive"},
        "distributed": {"engine"},
    }.items():
        users = {
            path.relative_to(PACKAGE).with_suffix("").parts[0]
            for path in SOURCES
            if any(module.split(".")[0] == library for module in _imports(path))
        }
        assert users <= packages, f"{library} is imported by {users - packages}"


def test_one_module_imports_orbax_and_the_two_networks_the_modules_of_flax():
    networks = ["learning/building_network.py", "learning/network.py"]
    for prefix, modules in {"orbax": ["learning/checkpoints.py"], "flax.linen": networks}.items():
        users = [path for path in SOURCES if any(f"{name}.".startswith(f"{prefix}.") for name in _imports(path))]
        assert sorted(str(path.relative_to(PACKAGE)) for path in users) == modules


def test_nothing_imports_the_tests():
    root = PACKAGE.parent
    for folder in (PACKAGE, root / "eval", root / "train"):
        for path in folder.rglob("*.py"):
            assert not any(module.split(".")[0] == "tests" for module in _imports(path)), path


def test_the_auditor_shares_no_code_with_the_planner():
    # It reads the planner's data - worlds, tasks, records - and judges them by rules of its own.
    allowed = ("task.task", "trials.record", "world.grid", "world.settings", "verify.", "errors.")
    for path in (PACKAGE / "verify").glob("*.py"):
        for module in _imports(path):
            if _package(module) is not None:
                assert module.removeprefix("potlp_jax.").startswith(allowed), f"{path.name} imports {module}"
