"""From the shards on disk to ``Samples``: every file and value is checked, and what is large stays on disk."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Int8, Int32, Int64

from potlp_jax.errors import DatasetError
from potlp_jax.learning.dataset import (
    SAMPLES_SCHEMA,
    VIEWS_SCHEMA,
    WORLDS_SCHEMA,
    Samples,
    finished_shards,
    read_metadata,
    samples_file,
    views_file,
    worlds_file,
)
from potlp_jax.learning.dataset_metadata import DatasetMetadata
from potlp_jax.learning.map_images import MAP_COLUMNS, EncodedView, EncodedWorld
from potlp_jax.learning.on_disk import Chained, ColumnFile, ImageFile, OnDisk
from potlp_jax.learning.shard_files import broken_shard, checked_rows, read_table


def read_dataset(folder: Path | str) -> Samples:
    """All finished shards of a dataset, in the order of their numbers.

    Raises:
        DatasetError: no shards, a file that is truncated or has other columns, another schema version, shards with
            different metadata, samples without a view, values out of range, or no space for the images in the
            temporary folder.
    """
    metadata = read_metadata(folder)
    # Images and maps are most of a dataset: 25 KB a view, 1.3 GB for 51,000 views.
    kept = ImageFile()
    # One shard at a time: its columns are on disk before the next one is read.
    return _one_after_another(_read_shard(folder, shard, metadata, kept) for shard in sorted(finished_shards(folder)))


def joined(parts: Sequence[Samples]) -> Samples:
    """Several data sets as one, in this order; the metadata are the first one's, with arrays as large as any has.

    Raises:
        DatasetError: what decides the meaning of a row differs: propositions, family, camera, unit, resolution,
            glances or nearest.
    """
    first = parts[0].metadata
    for part in parts[1:]:
        for name in ("propositions", "family", "camera", "unit", "resolution", "glances", "nearest"):
            mine, other = getattr(first, name), getattr(part.metadata, name)
            if mine != other:
                raise DatasetError(f"data sets that differ in {name} cannot be joined: {mine} and {other}")
    sources = tuple(source for part in parts for source in part.sources)
    rows, columns = (max(sides) for sides in zip(*(part.metadata.shape for part in parts), strict=True))
    metadata = dataclasses.replace(first, shape=(rows, columns))
    return dataclasses.replace(_one_after_another(parts), metadata=metadata, joined_from=sources)


def _one_after_another(parts: Iterable[Samples]) -> Samples:
    """Several as one; at least one."""
    columns: dict[str, ColumnFile] = {}
    images, maps, worlds, metadata = [], [], [], []
    for part in parts:
        shifts = {"view_of": sum(map(len, images)), "world_of": sum(map(len, worlds))}
        for field in dataclasses.fields(Samples):
            column = getattr(part, field.name)
            if isinstance(column, np.ndarray):
                shift = shifts.get(field.name)
                shifted = column if shift is None else column + np.int32(shift)
                columns.setdefault(field.name, ColumnFile()).append(shifted)
        images.append(part.images)
        maps.append(part.maps)
        worlds.append(part.worlds)
        metadata.append(part.metadata)
    mapped: dict[str, Any] = {name: column.mapped() for name, column in columns.items()}
    return Samples(images=Chained(images), maps=Chained(maps), worlds=Chained(worlds), metadata=metadata[0], **mapped)


def _read_shard(folder: Path | str, shard: int, metadata: DatasetMetadata, kept: ImageFile) -> Samples:
    """A shard whose images, maps and worlds are kept in a file."""
    paths = worlds_file(folder, shard), views_file(folder, shard), samples_file(folder, shard)
    worlds, sizes, of_worlds = _read_worlds(paths[0], kept)
    views, world_of_views, images, maps = _read_views(paths[1], kept)
    columns = _sample_columns(read_table(paths[2], SAMPLES_SCHEMA), len(metadata.propositions), paths[2])
    view_of = _index_of(columns.pop("view"), views, "view", paths[2])
    world_of = _index_of(world_of_views, worlds, "world", paths[1])
    cells = columns["cells"]
    inside = np.all((cells >= 0) & (cells < sizes[world_of[view_of]]), axis=1)
    _require({"row and column must be of a cell of the world's map": inside}, paths[2])
    return Samples(
        images=images, maps=maps, worlds=of_worlds, world_of=world_of, view_of=view_of, metadata=metadata, **columns
    )


def _read_worlds(
    path: Path, kept: ImageFile
) -> tuple[Int64[np.ndarray, " worlds"], Int32[np.ndarray, "worlds 2"], OnDisk[EncodedWorld]]:
    """Numbers of a shard's worlds, rows and columns of their maps, and the maps on disk."""
    numbers, bounds = [np.zeros(0, np.int64)], [np.zeros((0, 4), np.int64)]
    sizes = [np.zeros((0, 2), np.int32)]
    for rows in checked_rows(path, WORLDS_SCHEMA, WORLDS_SCHEMA.names):
        numbers.append(rows["world"].to_numpy())
        sizes.append(np.stack([rows["rows"].to_numpy(), rows["columns"].to_numpy()], axis=-1))
        maps = (rows[name].to_pylist() for name in ("cells", "letters"))
        bounds.append(kept.write(zip(map(np.ndarray.tobytes, sizes[-1]), *maps, strict=True)))
    return np.concatenate(numbers), np.concatenate(sizes), OnDisk(kept, _world, np.concatenate(bounds))


def _world(size: bytes, cells: bytes, letters: bytes) -> EncodedWorld:
    rows, columns = np.frombuffer(size, np.int32).tolist()
    return EncodedWorld(rows, columns, cells, letters)


def _read_views(
    path: Path, kept: ImageFile
) -> tuple[Int64[np.ndarray, " views"], Int64[np.ndarray, " views"], OnDisk[bytes], OnDisk[EncodedView]]:
    """Numbers of a shard's views and of their worlds; their images and maps on disk."""
    names = ("view", "world", "image", *MAP_COLUMNS)
    views, worlds = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    images, maps = [np.zeros((0, 2), np.int64)], [np.zeros((0, 1 + len(MAP_COLUMNS)), np.int64)]
    for rows in checked_rows(path, VIEWS_SCHEMA, names):
        views.append(rows["view"].to_numpy())
        worlds.append(rows["world"].to_numpy())
        images.append(kept.write((image,) for image in rows["image"].to_pylist()))
        maps.append(kept.write(zip(*(rows[name].to_pylist() for name in MAP_COLUMNS), strict=True)))
    return (
        np.concatenate(views),
        np.concatenate(worlds),
        OnDisk(kept, bytes, np.concatenate(images)),
        OnDisk(kept, EncodedView, np.concatenate(maps)),
    )


def _sample_columns(table: pa.Table, propositions: int, path: Path) -> dict[str, Any]:
    """Columns of ``Samples`` by name, and ``view``."""
    numbers = {
        "view": "view",
        "in_view": "in_view",
        "bearing": "bearing",
        "distance": "distance",
        "success": "success_probability",
        "success_cost": "success_cost",
        "failure_cost": "failure_cost",
        "success_weight": "success_weight",
        "failure_weight": "failure_weight",
    }
    columns = {name: table[column].to_numpy() for name, column in numbers.items()}
    columns["cells"] = np.stack([table["row"].to_numpy(), table["column"].to_numpy()], axis=-1)
    for name in ("phi_stay", "phi_go"):
        # All lists of a column are one array with offsets; equal steps between them mean equal lengths.
        lists = table[name].combine_chunks()
        if np.any(np.diff(np.asarray(lists.offsets)) != propositions):
            raise broken_shard(path, f"has {name} whose length is not the number of propositions, {propositions}")
        columns[name] = lists.flatten().to_numpy().reshape(-1, propositions)
    _check_values(columns, path)
    return columns


def _check_values(columns: Mapping[str, np.ndarray], path: Path) -> None:
    # NaN fails every comparison, so that it is refused wherever a rule does not allow it by name.
    success = columns["success"] > 0
    positive, vectors = ("success_weight", "failure_weight"), ("phi_stay", "phi_go")
    rules = {
        "success_probability must lie in [0, 1]": (columns["success"] >= 0) & (columns["success"] <= 1),
        "success_cost must be a positive number where success_probability > 0": ~success
        | (np.isfinite(columns["success_cost"]) & (columns["success_cost"] > 0)),
        "failure_cost must be a number >= 0": np.isfinite(columns["failure_cost"]) & (columns["failure_cost"] >= 0),
        "distance must be a number >= 0": np.isfinite(columns["distance"]) & (columns["distance"] >= 0),
        "bearing must be a number": np.isfinite(columns["bearing"]),
        **{f"{name} must have entries -1, 0 and 1": _all_signs(columns[name]) for name in vectors},
        **{f"{name} must be a positive number": np.isfinite(columns[name]) & (columns[name] > 0) for name in positive},
    }
    _require(rules, path)


def _all_signs(vectors: Int8[np.ndarray, "N P"]) -> Bool[np.ndarray, "N"]:
    # Not by the absolute value: that of -128 is no int8.
    return np.all((vectors >= -1) & (vectors <= 1), axis=1)


def _require(rules: Mapping[str, np.ndarray], path: Path) -> None:
    """Name the first row of the file for which a rule does not hold."""
    for rule, holds in rules.items():
        if not holds.all():
            raise DatasetError(f"{path}, row {int(np.argmin(holds))}: {rule}")


def _index_of(wanted: np.ndarray, known: np.ndarray, what: str, path: Path) -> Int32[np.ndarray, "N"]:
    """Position of each row's view, or world, among those of the shard."""
    # Files from elsewhere may number them as they like.
    position = {number: index for index, number in enumerate(known.tolist())}
    if len(position) < len(known):
        raise broken_shard(path, f"belongs to {what}s that occur twice")
    try:
        return np.array([position[number] for number in wanted.tolist()], np.int32)
    except KeyError as error:
        raise broken_shard(path, f"has rows of {what} {error}, which is not in the shard") from error
