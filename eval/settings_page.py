"""The page of all settings, docs/settings.md, from the classes that hold them.

    python -m eval.settings_page            # write it
    python -m eval.settings_page --check    # exit code 1 if it is not that of the code

A setting is a field of a dataclass; its meaning is what the ``Attributes`` of the class say of it, or those of a class
that it derives from.
"""

import argparse
import dataclasses
import inspect
import json
import re
import sys
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.building_learner import BuildingOptions
from potlp_jax.learning.panorama_learner import PanoramaOptions
from potlp_jax.planning.search.config import UctConfig
from potlp_jax.recipes.collection import CollectConfig
from potlp_jax.recipes.fitting import FitConfig
from potlp_jax.recipes.recipe import Beside, Recipe, Round
from potlp_jax.trials.config import TrialConfig
from potlp_jax.world.camera import CameraConfig, Disturbance
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.sensing import SensorConfig

PAGE: Path = Path("docs/settings.md")

# A class of options whose fields another class explains.
_MEANT: dict[type, type] = {BuildingOptions: BuildingConfig}

_HEAD = """# All settings

Every setting with its name, its default and its meaning, as the code has them (`python -m eval.settings_page` writes
this page). A dot leads into a group: in a file `decision.frontiers.min_size` is
`{decision: {frontiers: {min_size: 2}}}`. Unknown names, and values that do not fit, are refused before anything runs.
Environments have defaults of their own for some of them, which `settings` of their generators hold.
"""

# The tables of each section: what stands before it, whose settings, and of which group.
_SECTIONS: tuple[tuple[str, tuple[tuple[str, type, str], ...]], ...] = (
    (
        "Trials",
        (
            (
                """Given as `settings` of a [sweep's file](sweeps.md#the-file), as `TrialConfig` in Python, or as
`settings` of [an environment of your own](environments.md). `potlp run` and `potlp compare` take `--simulations`,
`--search` and `--camera`.""",
                TrialConfig,
                "",
            ),
            (
                "With `decision.search: uct`, the paper's search, in place of `decision.search.*`:",
                UctConfig,
                "decision.search.",
            ),
        ),
    ),
    (
        "Collecting",
        (
            (
                """Given with `--set NAME=VALUE` to [`potlp collect`](dataset.md), or as `collect` of a recipe. What
trials have, too, is as in the family's trials where nothing else is said.""",
                CollectConfig,
                "",
            ),
        ),
    ),
    (
        "Fitting",
        (
            ("Given with `--set NAME=VALUE` to [`potlp fit`](estimator.md), or as `fit` of a recipe.", FitConfig, ""),
            (
                "With `network.kind=panorama`, the network of one panorama, in place of `network.*`:",
                PanoramaOptions,
                "network.",
            ),
        ),
    ),
    (
        "Recipes",
        (
            ("A [recipe](estimator.md) is a file with these.", Recipe, ""),
            ("Of each of the list `rounds`:", Round, ""),
            ("Of each of the list `beside`:", Beside, ""),
        ),
    ),
)

# Groups that stand in one place, and are named in others.
_ELSEWHERE: dict[type, str] = {
    FrontierConfig: "as `decision.frontiers` of trials",
    CameraConfig: "as `camera` of trials",
    Disturbance: "as `disturbance` of trials",
    SensorConfig: "as `sensor` of trials",
    CollectConfig: "as in *Collecting*",
    FitConfig: "as in *Fitting*",
}


def meanings(owner: type) -> dict[str, str]:
    """What the docstring of a class, or of one that it derives from, says of each of its fields."""
    found: dict[str, str] = {}
    for base in reversed(inspect.getmro(owner)):
        found |= _attributes(base)
    return _attributes(_MEANT[owner]) | found if owner in _MEANT else found


def _attributes(owner: type) -> dict[str, str]:
    names_of_fields = {field.name for field in dataclasses.fields(owner)} if dataclasses.is_dataclass(owner) else set()
    text = inspect.cleandoc(owner.__doc__ or "")
    _, _, listed = text.partition("Attributes:\n")
    found: dict[str, str] = {}
    # An entry begins at the least indentation, and may go on in lines that are indented further.
    width = len(listed) - len(listed.lstrip(" "))
    for entry in re.split(rf"\n(?= {{{width}}}\S)", listed) if width else ():
        # "a, b: of both", or "a: of a; b: of b".
        for part in re.split(rf";\s+(?=(?:{'|'.join(names_of_fields)}): )", " ".join(entry.split())):
            names, _, meaning = part.partition(": ")
            found |= {name: meaning for name in names.split(", ") if name in names_of_fields}
    return found


def rows_of(
    owner: type, before: str = "", elsewhere: Mapping[type, str] = _ELSEWHERE
) -> Iterator[tuple[str, str, str]]:
    """Name, default and meaning of every setting of a class.

    Args:
        owner: the class.
        before: of the names.
        elsewhere: groups that are named and not listed, and where they are listed.

    Yields:
        The settings of a group stand in its place.
    """
    said, kinds = meanings(owner), typing.get_type_hints(owner)
    for field in dataclasses.fields(owner):
        name = f"{before}{field.name}"
        if kinds[field.name] in elsewhere:
            yield f"{name}.*", "", elsewhere[kinds[field.name]]
        elif dataclasses.is_dataclass(field.default):
            yield from rows_of(type(field.default), f"{name}.", elsewhere)
        else:
            yield name, _told(field.default), said.get(field.name, "")


def _told(default: Any) -> str:
    if default is dataclasses.MISSING:
        return "needed"
    # As a file of settings has it.
    return json.dumps(default).strip('"') or "empty"


def page() -> str:
    """The text of the page."""
    lines = [_HEAD]
    for title, tables in _SECTIONS:
        lines += [f"## {title}", ""]
        for introduction, owner, before in tables:
            lines += [introduction, "", "| setting | default | meaning |", "|---|---|---|"]
            for name, default, meaning in rows_of(owner, before, {} if owner is TrialConfig else _ELSEWHERE):
                # A bar would end the cell.
                lines.append(f"| `{name}` | {default} | {meaning.replace('``', '`').replace('|', '&#124;')} |")
            lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    if not parser.parse_args().check:
        PAGE.write_text(page(), "utf-8")
    return int(PAGE.read_text("utf-8") != page())


if __name__ == "__main__":
    sys.exit(main())
