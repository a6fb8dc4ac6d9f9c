"""Texts that are damaged as texts: settings, places, plans, automata and JSON, through the functions that read them.

Unlike the files of ``eval.faults.files`` these stay texts, so that more of them get beyond the first check. JSON is
changed as values: records, metadata and manifests have the right checksums here, and wrong contents.
"""

import json
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from eval.faults import Kind, seeds
from eval.faults.mutations import EXTREMES, damaged_text, pick
from eval.faults.seeds import kept, write_tree
from potlp_jax.codec import settings_from_words, with_settings
from potlp_jax.environments.campus.floor_plan_xml import read_kinds, read_plan
from potlp_jax.environments.campus.plan_floor import rasterise
from potlp_jax.environments.ros.map_settings import load_settings
from potlp_jax.environments.ros.places import load_places, load_regions, place_letters
from potlp_jax.learning.serialization import load_estimator
from potlp_jax.sweep.specification import read_specification
from potlp_jax.task.shipped import shipped_tasks
from potlp_jax.task.task import Task
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.record import load_trial, record_checksum

Read = Callable[[str, Path], object]
"""Reads a text, with a folder for files."""


def _text_case(texts: Callable[[Path], Sequence[str]], read: Read, random: np.random.Generator, folder: Path) -> None:
    """Damage one of some texts, and read it; what was read is kept in the folder."""
    found = texts(folder)
    text = damaged_text(random, pick(random, found), found)
    (folder / "text").write_bytes(text.encode("utf-8", "surrogatepass"))
    read(text, folder)


def _file(name: str, read: Callable[[Path], object]) -> Read:
    """A reader of files as one of texts."""

    def read_text(text: str, folder: Path) -> object:
        (folder / "text").rename(folder / name)
        return read(folder / name)

    return read_text


@cache
def _automata() -> list[str]:
    return [Task.shipped(name).to_hoa() for name in shipped_tasks()]


@cache
def _places_text(folder: Path) -> str:
    return seeds.places_yaml(folder)


def _read_places(file: Path) -> None:
    free = seeds.picture() == 254
    place_letters(load_places(file), free, seeds.frame())


def _read_map(file: Path) -> None:
    (file.parent / "map.png").write_bytes(seeds.encoded("png"))
    load_settings(file)


def _read_plan(file: Path) -> None:
    (file.parent / "kinds.yaml").write_text(seeds.KINDS_YAML)
    rasterise(read_plan(file), read_kinds(file.parent / "kinds.yaml"), 0.25)


_WORDS = (
    "replan_distance=4",
    "decision.search.simulations=300",
    "decision={search: {kind: uct}}",
    "camera.height=64",
    "decision.frontiers.max_subgoals=32",
)


def _read_words(text: str, folder: Path) -> None:
    with_settings(TrialConfig(), settings_from_words(text.split("\n")), "--set")


# JSON, changed as values.


def changed(random: np.random.Generator, value: Any) -> Any:
    """A JSON value in which one value somewhere is another: an extreme, of another type, missing, or moved.

    Args:
        random: chooses.
        value: nested lists and dictionaries.

    Returns:
        A copy with the change.
    """
    # Down to a random depth, so that values near the top change as often as the many at the bottom.
    if isinstance(value, dict) and value and random.random() < 0.85:
        name = pick(random, sorted(value))
        return {**value, name: changed(random, value[name])}
    if isinstance(value, list) and value and random.random() < 0.85:
        place = int(random.integers(len(value)))
        return [*value[:place], changed(random, value[place]), *value[place + 1 :]]
    return _another(random, value)


def _another(random: np.random.Generator, value: Any) -> Any:
    odd: list[Any] = [None, True, 0, -1, 1 << 40, 1 << 70, 1e308, "inf", "nan", "", "\ud800", [], {}, [[]], {"": 0}]
    odd += [pick(random, EXTREMES), "x" * 10_000]
    if isinstance(value, dict) and value and random.random() < 0.5:
        name = pick(random, sorted(value))
        return {other: entry for other, entry in value.items() if other != name}
    if isinstance(value, list) and value and random.random() < 0.5:
        return value[: random.integers(len(value))] if random.random() < 0.5 else value * 2
    if isinstance(value, int | float) and random.random() < 0.5:
        return value + (1 if random.random() < 0.5 else -1)
    if isinstance(value, str) and random.random() < 0.5:
        return damaged_text(random, value)
    return pick(random, odd)


def _json_case(
    name: str, make: Callable[[Path], None], file: str, read: Callable[[Path], object], seal: Callable[[Any], Any]
) -> Callable[[np.random.Generator, Path], None]:
    """Cases of a JSON file among others.

    Args:
        name: under which the whole files are kept.
        make: writes them.
        file: the one that is changed.
        read: reads the folder.
        seal: puts right whatever checksum there is.

    Returns:
        What runs one case.
    """

    def run(random: np.random.Generator, folder: Path) -> None:
        tree = kept(folder, name, make)
        write_tree(tree, folder)
        value = json.loads(tree[file])
        for _ in range(int(random.integers(1, 3))):
            value = changed(random, value)
        text = damaged_text(random, tree[file].decode()) if random.random() < 0.05 else json.dumps(seal(value))
        (folder / file).write_bytes(text.encode("utf-8", "surrogatepass"))
        read(folder)

    return run


def _seal_record(value: Any) -> Any:
    return {**value, "checksum": record_checksum(value)} if isinstance(value, dict) else value


def _use_record(folder: Path) -> None:
    """What ``potlp explain`` and ``potlp view`` do with a record."""
    from potlp_jax.view.decisions import task_of

    trial = load_trial(folder / "trial.json")
    trial.summary()
    task_of(trial)
    for step in range(len(trial.path)):
        trial.belief_at(step)


def _read_metadata(text: str, folder: Path) -> None:
    from potlp_jax.learning.dataset_metadata import DatasetMetadata

    DatasetMetadata.from_json(text)


def _metadata_text(folder: Path) -> str:
    from potlp_jax.learning.dataset import read_metadata

    folder = folder / "dataset"
    write_tree(kept(folder.parent, "dataset", seeds.make_dataset), folder)
    return read_metadata(folder).to_json()


def _header_case(random: np.random.Generator, folder: Path) -> None:
    """An estimator whose zip is whole and whose header is not."""
    tree = kept(folder, "estimator", seeds.make_estimator)
    write_tree(tree, folder)
    with np.load(folder / "estimator.npz") as archive:
        arrays = dict(archive)
    header = changed(random, json.loads(arrays["header"].tobytes()))
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(folder / "estimator.npz", **arrays)
    load_estimator(folder / "estimator.npz")


def _read_manifest(folder: Path) -> None:
    from potlp_jax.export import load_program

    load_program(folder, "plan", ("fire", "extinguisher"))


def _kind(name: str, texts: Callable[[Path], Sequence[str]], read: Read) -> Kind:
    return Kind(name, partial(_text_case, texts, read), "texts")


KINDS = (
    _kind("HOA text", lambda folder: _automata(), lambda text, folder: Task.from_hoa(text)),
    _kind("map settings text", lambda folder: [seeds.map_yaml("map.png")], _file("map.yaml", _read_map)),
    _kind("places text", lambda folder: [_places_text(folder)], _file("map.places.yaml", _read_places)),
    _kind(
        "rooms text",
        lambda folder: [seeds.ROOMS_YAML],
        _file("map.rooms.yaml", lambda file: load_regions(file, ("rooms",))),
    ),
    _kind("kinds of rooms text", lambda folder: [seeds.KINDS_YAML], _file("kinds.yaml", read_kinds)),
    _kind("floor plan text", lambda folder: [seeds.floor_plan_xml()], _file("plan.xml", _read_plan)),
    _kind("sweep text", lambda folder: [seeds.SWEEP_YAML], _file("sweep.yaml", read_specification)),
    _kind("settings in words", lambda folder: ["\n".join(_WORDS)], _read_words),
    _kind("dataset's metadata text", lambda folder: [_metadata_text(folder)], _read_metadata),
    Kind(
        "values of a trial record",
        _json_case("record", seeds.make_record, "trial.json", _use_record, _seal_record),
        "texts",
        weight=0.2,
    ),
    Kind(
        "values of a manifest",
        _json_case("export", seeds.make_export, "manifest.json", _read_manifest, lambda value: value),
        "texts",
    ),
    Kind("values of an estimator's header", _header_case, "texts", weight=0.2),
)
