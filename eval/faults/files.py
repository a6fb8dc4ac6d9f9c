"""Files that are damaged: every kind that the library reads, through the functions that commands read it with.

Where a format has checksums, what is read from a damaged file must be what was in the whole one, or be refused; where
it has none (PGM images, ROS 1 bags, YAML), a flipped bit in a value is a value, and nobody can tell.
"""

import contextlib
import os
import shutil
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from eval.faults import Kind, WrongAnswerError, seeds
from eval.faults.mutations import damaged, pick
from eval.faults.seeds import Tree, kept, write_tree
from potlp_jax.environments.campus.floor_plan_xml import read_plan
from potlp_jax.environments.ros.map_settings import load_settings
from potlp_jax.environments.ros.occupancy_map import load_map
from potlp_jax.environments.ros.places import load_places, load_regions
from potlp_jax.environments.ros.ros_map import RosMap, RosMapConfig
from potlp_jax.errors import PotlpError
from potlp_jax.files import read_yaml
from potlp_jax.learning.serialization import load_estimator
from potlp_jax.sweep.specification import read_specification
from potlp_jax.task.reading import read_task
from potlp_jax.trials.record import load_trial

Read = Callable[[Path], Any]
"""Reads what lies in a folder, as a command would."""


def _case(
    trees: Callable[[Path], list[Tree]],
    read: Read,
    checksums: bool,
    random: np.random.Generator,
    folder: Path,
) -> None:
    """Damage one file of one tree, and read it.

    Args:
        trees: the whole files to choose from, given the scratch folder.
        read: reads them.
        checksums: whether what is read from damaged files must equal what is read from whole ones.
        random: chooses and damages.
        folder: for the files.
    """
    found = trees(folder)
    tree = pick(random, found)
    names = sorted(tree)
    name = pick(random, names)
    others = [contents for other in found for contents in other.values()]
    write_tree({**tree, name: damaged(random, tree[name], others)}, folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        answer = read(folder)
        if checksums and answer != _whole(tree, read, folder):
            raise WrongAnswerError(f"{name} was damaged, and read without a word as something else")


def _whole(tree: Tree, read: Read, folder: Path) -> Any:
    """What is read from the files as they were."""
    whole = folder / "whole"
    write_tree(tree, whole)
    try:
        return read(whole)
    finally:
        shutil.rmtree(whole)


def _summary(value: Any) -> Any:
    """Values that can be compared: arrays, also those within pytrees, as their bytes."""
    leaves, structure = jax.tree.flatten(value)
    return str(structure), [
        (str(np.asarray(leaf).dtype), np.asarray(leaf).shape, np.asarray(leaf).tobytes())
        if isinstance(leaf, np.ndarray | jax.Array)
        else leaf
        for leaf in leaves
    ]


# Maps and plans.


def _map_trees(kind: str, folder: Path) -> list[Tree]:
    return [{f"map.{kind}": seeds.encoded(kind)}]


def _read_image(kind: str, folder: Path) -> Any:
    (folder / "map.yaml").write_text(seeds.map_yaml(f"map.{kind}"))
    found = load_map(folder / "map.yaml")
    return _summary((found.occupancy, found.free, found.occupied))


def _whole_map_trees(folder: Path) -> list[Tree]:
    return [
        {
            "map.yaml": seeds.map_yaml("map.png").encode(),
            "map.places.yaml": seeds.places_yaml(folder).encode(),
        }
    ]


def _read_whole_map(folder: Path) -> None:
    (folder / "map.png").write_bytes(seeds.encoded("png"))
    generator = RosMap(RosMapConfig(folder / "map.yaml"))
    generator.generate(jax.random.key(0))


def _read_plan(folder: Path) -> None:
    from potlp_jax.environments.campus.floor_plan_xml import read_kinds
    from potlp_jax.environments.campus.plan_floor import rasterise

    kinds = read_kinds(folder / "kinds.yaml")
    rasterise(read_plan(folder / "plan.xml"), kinds, 0.25)


def _plan_trees(folder: Path) -> list[Tree]:
    return [{"plan.xml": seeds.floor_plan_xml().encode(), "kinds.yaml": seeds.KINDS_YAML.encode()}]


def _rooms_trees(folder: Path) -> list[Tree]:
    return [{"map.rooms.yaml": seeds.ROOMS_YAML.encode()}]


# Logs.


def _bag_trees(kind: str, folder: Path) -> list[Tree]:
    return [kept(folder, kind, lambda made: seeds.make_bag(made, kind))]


def _read_log(kind: str, folder: Path) -> Any:
    from potlp_jax.logs.drive import read_drive
    from potlp_jax.logs.inspection import inspect
    from potlp_jax.logs.log import Log

    log = Log(folder / ("drive.bag" if kind == "ros1" else "drive"))
    inspect(log)
    # Problems that are told are no wrong answer, whatever was lost.
    told = bool(log.problems)
    maps = [message.occupancy for message in log.read_maps()]
    pictures = [picture for _, picture in log.read_pictures()]
    drive = read_drive(log, seeds.places())
    return None if told else _summary((maps, pictures, drive.path))


# Tasks, records and configurations.


def _hoa_trees(folder: Path) -> list[Tree]:
    from potlp_jax.task.shipped import shipped_tasks
    from potlp_jax.task.task import Task

    return [{"task.hoa": Task.shipped(name).to_hoa().encode()} for name in list(shipped_tasks())[:4]]


def _record_trees(folder: Path) -> list[Tree]:
    return [kept(folder, "record", seeds.make_record)]


def _read_record(folder: Path) -> Any:
    return load_trial(folder / "trial.json").to_dict()


def _store_trees(folder: Path) -> list[Tree]:
    return [kept(folder, "store", seeds.make_store)]


def _read_store(folder: Path) -> Any:
    """What ``potlp sweep show`` reads."""
    from potlp_jax.sweep.runner import RESULTS
    from potlp_jax.sweep.store import Store

    with contextlib.closing(Store(folder / RESULTS, read_only=True)) as store:
        return store.facts(), store.rows(), store.possible("toy", "F goal")


def _read_recipe(folder: Path) -> None:
    from potlp_jax.recipes.recipe import read_recipe

    read_recipe(folder / "recipe.yaml")


def _read_training(folder: Path) -> None:
    from potlp_jax.recipes.fitting import FitConfig, planned_steps
    from potlp_jax.recipes.journal import Display, Journal

    planned_steps(folder, 10, FitConfig(epochs=2), lambda: 1.0)
    journal = Journal(folder, 20, Display())
    journal.start(20)
    journal.close()


# What is learned.


def _estimator_trees(folder: Path) -> list[Tree]:
    return [kept(folder, "estimator", seeds.make_estimator)]


def _read_estimator(folder: Path) -> Any:
    params, config, domain, metadata = load_estimator(folder / "estimator.npz")
    return _summary((params, str(config), str(domain), metadata))


def _checkpoint_trees(folder: Path) -> list[Tree]:
    return [kept(folder, "checkpoint", seeds.make_checkpoint)]


def _read_checkpoint(folder: Path) -> Any:
    from potlp_jax.learning.checkpoints import load_checkpoint

    return _summary(load_checkpoint(folder, 3, seeds.checkpoint_state(), seeds.CHECKPOINT_IDENTITY))


def _dataset_trees(folder: Path) -> list[Tree]:
    return [kept(folder, "dataset", seeds.make_dataset)]


def _read_dataset(folder: Path) -> Any:
    from potlp_jax.learning.dataset import decode
    from potlp_jax.learning.dataset_reading import read_dataset

    samples = read_dataset(folder)
    for image in samples.images:
        decode(image)
    # What stays on disk is equal only to itself; a record of the maps is compared by its contents.
    on_disk = {name: list(getattr(samples, name)) for name in ("images", "maps", "worlds")}
    return _summary({**vars(samples), "metadata": None, **on_disk})


def _export_trees(folder: Path) -> list[Tree]:
    return [kept(folder, "export", seeds.make_export)]


def _read_export(folder: Path) -> None:
    from potlp_jax.export import load_program

    load_program(folder, "plan", ("fire", "extinguisher"))


# Paths that are no files at all.

_READERS: dict[str, tuple[str, Read]] = {
    "map": ("map.yaml", lambda folder: load_settings(folder / "map.yaml")),
    "image": ("map.pgm", partial(_read_image, "pgm")),
    "places": ("map.places.yaml", lambda folder: load_places(folder / "map.places.yaml")),
    "rooms": ("map.rooms.yaml", lambda folder: load_regions(folder / "map.rooms.yaml", ("rooms",))),
    "plan": ("plan.xml", lambda folder: read_plan(folder / "plan.xml")),
    "task": ("task.hoa", lambda folder: read_task(str(folder / "task.hoa"))),
    "record": ("trial.json", _read_record),
    "sweep": ("sweep.yaml", lambda folder: read_specification(folder / "sweep.yaml")),
    "recipe": ("recipe.yaml", _read_recipe),
    "estimator": ("estimator.npz", _read_estimator),
    "views": ("views-00000.parquet", _read_dataset),
    "samples": ("samples-00000.parquet", _read_dataset),
    "manifest": ("manifest.json", _read_export),
    "program": ("plan.jaxexport", _read_export),
    "checkpoint": ("3", _read_checkpoint),
    "bag": ("drive.bag", partial(_read_log, "ros1")),
    "database": ("drive/drive.db3", partial(_read_log, "ros2")),
    "mcap": ("drive/drive.mcap", partial(_read_log, "mcap")),
}


def _not_a_file(random: np.random.Generator, folder: Path) -> None:
    """A folder, a pipe, a device, a link to itself, nothing, or an endless file in the place of a file."""
    name, read = _READERS[pick(random, sorted(_READERS))]
    # Where several files are read, the others are whole.
    for tree in (_dataset_trees(folder), _export_trees(folder)):
        if name in tree[0]:
            # Of one shard: a shard without samples is one that was never finished, and the others are read.
            write_tree({other: contents for other, contents in tree[0].items() if "00001" not in other}, folder)
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    kind = random.integers(7)
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        os.mkfifo(path)
    elif kind < 5:
        path.symlink_to(("/dev/zero", "/dev/null", name)[kind - 2])
    elif kind == 5:
        path.write_bytes(b"")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read(folder)
    raise WrongAnswerError(f"{name}: what is no such file was read as one")


# Inputs that are large once they are read.


def _bomb(random: np.random.Generator, folder: Path) -> None:
    """Small files that stand for gigabytes, and files whose headers promise them."""
    kind = pick(random, sorted(_BOMBS))
    try:
        _BOMBS[kind](random, folder)
    except PotlpError:
        raise
    raise WrongAnswerError(f"{kind} was read")


def _image_bomb(random: np.random.Generator, folder: Path) -> None:
    import cv2

    # 30,000 squared, of which the file has the header and nothing else that is true.
    size = pick(random, (8_000, 30_000, 65_535))
    kind = pick(random, ("pgm", "ascii", "png", "bmp"))
    contents = bytearray(seeds.encoded(kind))
    if kind in ("pgm", "ascii"):
        contents = bytearray(contents.replace(b"60 40", f"{size} {size}".encode()))
    elif kind == "png":
        small = cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes()
        assert small[12:16] == b"IHDR"
        contents[16:24] = size.to_bytes(4, "big") * 2
    else:
        contents[18:26] = size.to_bytes(4, "little") * 2
    (folder / f"map.{kind}").write_bytes(contents)
    _read_image(kind, folder)


def _zip_bomb(random: np.random.Generator, folder: Path) -> None:
    import zipfile

    # A gigabyte and a half of zeros in a megabyte and a half.
    source = kept(folder, "bomb", _make_zip_bomb)
    write_tree(source, folder)
    assert zipfile.is_zipfile(folder / "estimator.npz")
    load_estimator(folder / "estimator.npz")


def _make_zip_bomb(folder: Path) -> None:
    import zipfile

    with (
        zipfile.ZipFile(folder / "estimator.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("header.npy", "w", force_zip64=True) as member,
    ):
        for _ in range(1500):
            member.write(bytes(1 << 20))


def _shape_bomb(random: np.random.Generator, folder: Path) -> None:
    """An array whose header promises more than there is memory."""
    import io
    import zipfile

    stream = io.BytesIO()
    shape = (1 << int(random.integers(30, 62)), int(random.integers(1, 1 << 20)))
    np.lib.format.write_array_header_1_0(stream, {"shape": shape, "fortran_order": False, "descr": "<f4"})
    with zipfile.ZipFile(folder / "estimator.npz", "w") as archive:
        archive.writestr("header.npy", stream.getvalue() + bytes(64))
    load_estimator(folder / "estimator.npz")


def _alias_bomb(random: np.random.Generator, folder: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    count = int(random.integers(8, 30))
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, count)]
    (folder / "sweep.yaml").write_text("\n".join(lines))
    read_yaml(folder / "sweep.yaml", PotlpError)


def _entity_bomb(random: np.random.Generator, folder: Path) -> None:
    entities = "".join(f'<!ENTITY e{n + 1} "{f"&e{n};" * 10}">' for n in range(int(random.integers(6, 20))))
    (folder / "plan.xml").write_text(f'<!DOCTYPE b [<!ENTITY e0 "xxxxxxxxxx">{entities}]><building>&e6;</building>')
    read_plan(folder / "plan.xml")


def _large_file(random: np.random.Generator, folder: Path) -> None:
    # Sparse: it takes no space on the disk.
    name, read = _READERS[pick(random, ("map", "image", "places", "plan", "task", "record", "sweep", "estimator"))]
    with (folder / name).open("wb") as stream:
        stream.truncate(int(random.integers(2 << 30, 1 << 40)))
    read(folder)


_BOMBS: dict[str, Callable[[np.random.Generator, Path], None]] = {
    "an image of 30,000 squared": _image_bomb,
    "an archive of zeros": _zip_bomb,
    "an array of 2^60 numbers": _shape_bomb,
    "aliases of aliases": _alias_bomb,
    "entities of entities": _entity_bomb,
    "a file of gigabytes": _large_file,
}


def _kind(name: str, trees: Callable[[Path], list[Tree]], read: Read, checksums: bool = False) -> Kind:
    return Kind(name, partial(_case, trees, read, checksums))


KINDS = (
    *(
        _kind(f"map image, {kind}", partial(_map_trees, kind), partial(_read_image, kind), kind == "png")
        for kind in ("pgm", "ascii", "png", "bmp", "jpg")
    ),
    _kind("map and places", _whole_map_trees, _read_whole_map),
    _kind("rooms", _rooms_trees, lambda folder: load_regions(folder / "map.rooms.yaml", ("rooms",))),
    _kind("floor plan and kinds", _plan_trees, _read_plan),
    _kind("ROS 1 bag", partial(_bag_trees, "ros1"), partial(_read_log, "ros1")),
    _kind("ROS 2 bag", partial(_bag_trees, "ros2"), partial(_read_log, "ros2")),
    _kind("MCAP", partial(_bag_trees, "mcap"), partial(_read_log, "mcap")),
    _kind("automaton", _hoa_trees, lambda folder: read_task(str(folder / "task.hoa"))),
    _kind("trial record", _record_trees, _read_record, True),
    _kind(
        "sweep",
        lambda folder: [{"sweep.yaml": seeds.SWEEP_YAML.encode()}],
        lambda folder: read_specification(folder / "sweep.yaml"),
    ),
    _kind("store of a sweep", _store_trees, _read_store, True),
    _kind("recipe", lambda folder: [{"recipe.yaml": seeds.RECIPE_YAML.encode()}], _read_recipe),
    _kind("training plan and table", lambda folder: [kept(folder, "plan", seeds.make_plan)], _read_training),
    _kind("estimator", _estimator_trees, _read_estimator, True),
    _kind("checkpoint", _checkpoint_trees, _read_checkpoint, True),
    _kind("dataset", _dataset_trees, _read_dataset, True),
    _kind("exported program", _export_trees, _read_export),
    Kind("no file at all", _not_a_file),
    Kind("bomb", _bomb),
)
