"""Environments, policies, cameras and estimators of others, by ``module:attribute`` and by entry point."""

import sys

import pytest

from potlp_jax import plugins
from potlp_jax.environments.families import FAMILIES
from potlp_jax.environments.registry import make
from potlp_jax.environments.toy import Toy
from potlp_jax.errors import PluginError

MODULE = """
from potlp_jax.environments.toy import Toy, ToyConfig

class Small(Toy):
    name = "small"

    def __init__(self):
        super().__init__(ToyConfig(height=5, width=9))

made = Small()

def tall():
    return Toy(ToyConfig(height=11))

number = 3
"""


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """The current directory is one with modules in it that sys.path does not name, as for a console script."""
    (tmp_path / "foreign_worlds.py").write_text(MODULE)
    (tmp_path / "broken_worlds.py").write_text("import a_library_that_is_missing")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    yield tmp_path
    sys.modules.pop("foreign_worlds", None)


@pytest.fixture
def installed(elsewhere):
    """A package that is installed and declares entry points."""
    folder = elsewhere / "foreign-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign\nVersion: 1.0\n")
    lines = ["[potlp_jax.environments]", "small = foreign_worlds:Small", "gone = foreign_worlds:Gone"]
    (folder / "entry_points.txt").write_text("\n".join(lines))
    sys.path.insert(0, str(elsewhere))


@pytest.mark.parametrize(("name", "height"), [("Small", 5), ("made", 5), ("tall", 11)])
def test_an_environment_is_a_class_an_object_or_a_function(elsewhere, name, height):
    generator = make(f"foreign_worlds:{name}")
    assert isinstance(generator, Toy)
    assert generator.world(0).shape[0] == height


def test_an_environment_by_entry_point(installed):
    assert make("small").name == "small"
    assert plugins.entry_points("potlp_jax.environments") == ("gone", "small")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("mars", f"unknown environment 'mars'; choose one of: {', '.join([*FAMILIES, 'gone', 'small'])}; or write "),
        ("gone", "environment 'gone' (entry point 'foreign_worlds:Gone'): foreign_worlds has no attribute 'Gone'"),
        ("foreign_worlds:number", "environment 'foreign_worlds:number': int is no environment"),
        ("foreign_worlds:Big", "foreign_worlds has no attribute 'Big'"),
        ("no_such_worlds:Small", "importing no_such_worlds failed: ModuleNotFoundError: No module named 'no_such"),
        ("broken_worlds:Small", "importing broken_worlds failed: ModuleNotFoundError: No module named 'a_library"),
    ],
)
def test_errors_say_what_is_wrong(name, message):
    with pytest.raises(PluginError) as error:
        make(name)
    assert message in str(error.value)


def test_references_are_told_from_names_and_files():
    assert plugins.is_reference("package.module:Class.method")
    assert not any(map(plugins.is_reference, ("toy", "a file.npz", "C:\\maps\\x.npz", "map:office.yaml", "out/x:y/z")))
