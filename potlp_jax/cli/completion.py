"""What the shell proposes for a word of a command line. Nothing here imports jax: TAB answers at once.

Tasks, policies and splits repeat what `environments`, `planning.policies` and `environments.splits` define, because
those import jax; ``tests/test_cli.py`` compares them.
"""

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

from potlp_jax.environments.families import NAMED, PREFIXED

TASKS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "toy": ("1", "2"),
        "firefighting": ("1", "2", "3", "4"),
        "delivery": ("1",),
        "parcels": ("1", "2"),
        "rooms": ("1", "2"),
        **dict.fromkeys(("campus-small", "campus-medium", "campus-large"), ("1",)),
        **dict.fromkeys(("campus-small-parcels", "campus-medium-parcels", "campus-large-parcels"), ("1", "2")),
    }
)
"""Numbers of the tasks of the environments that need no file."""

POLICIES = ("known-map", "baseline", "optimistic", "oracle", "potlp")
SEARCHES = ("best-first", "uct")
SPLITS = ("calibration", "training", "validation", "test")


def complete_environment(incomplete: str) -> list[str]:
    """Names of environments, those that other installed packages declare among them."""
    # Reading what is installed takes as long as the rest; help, which completes nothing, does without it.
    from potlp_jax import plugins

    return _starting([*NAMED, *PREFIXED, *plugins.entry_points(plugins.ENVIRONMENTS)], incomplete)


def complete_task(ctx: Any, incomplete: str) -> list[str]:
    """Numbers of the tasks of the environment that stands before; of all environments where none does."""
    # Typer hands over its context by the name `ctx`; what it passes is no `typer.Context`.
    environment = ctx.params.get("environment")
    known = TASKS.get(environment, ()) if environment else {task for tasks in TASKS.values() for task in tasks}
    return _starting(sorted(known), incomplete)


def complete_policy(incomplete: str) -> list[str]:
    """Names of policies, those that other installed packages declare among them."""
    return _starting(_policies(), incomplete)


def complete_policies(incomplete: str) -> list[str]:
    """Names of policies after those that are there already, joined by commas."""
    *before, last = incomplete.split(",")
    # The shell replaces the whole word, so that what stands before the last comma is part of every proposal.
    return [",".join([*before, name]) for name in _starting(_policies(), last) if name not in before]


def complete_recipe(incomplete: str) -> list[str]:
    """Shipped recipes."""
    folder = Path(str(resources.files("potlp_jax.recipes"))) / "data"
    return _starting([path.stem for path in sorted(folder.glob("*.yaml"))], incomplete)


def complete_search(incomplete: str) -> list[str]:
    """Names of the searches of policies that search."""
    return _starting(SEARCHES, incomplete)


def complete_split(incomplete: str) -> list[str]:
    """Names of splits."""
    return _starting(SPLITS, incomplete)


def _policies() -> list[str]:
    from potlp_jax import plugins

    return [*POLICIES, *plugins.entry_points(plugins.POLICIES)]


def _starting(words: Sequence[str], incomplete: str) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]
