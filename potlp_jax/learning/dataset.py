"""Records for training the estimator, on disk: Parquet shards, made by simulation or from a robot's log.

A dataset is a folder. Shard ``S`` is three files: ``worlds-SSSSS.parquet`` (one row a true map),
``views-SSSSS.parquet`` (one row a panorama, with what was known and painted on the map when it was taken) and
``samples-SSSSS.parquet`` (one row a (view, subgoal, outcome class)). Each is written under a temporary name and
renamed, the samples last: a shard exists when its samples file does. Every file carries the dataset's metadata as JSON
in its schema, under the key ``potlp``. ``docs/dataset.md`` describes the columns.
"""

import contextlib
import dataclasses
import functools
import itertools
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float32, Int8, Int32, Int64, UInt8

from potlp_jax.errors import DatasetError
from potlp_jax.files import reading, require_file
from potlp_jax.images import decode_image
from potlp_jax.learning.dataset_metadata import DatasetMetadata, DataSource, data_source
from potlp_jax.learning.map_images import MAP_COLUMNS, EncodedView, EncodedWorld
from potlp_jax.learning.on_disk import Chained, ColumnFile, Entries, ImageFile, OnDisk

JPEG_QUALITY: int = 92

_METADATA_KEY = b"potlp"

_TEMPORARY = ".tmp"

# Rows of a file, and bytes, that are read at once.
_ROWS = 64
_BUFFER = 1 << 20
# Samples that are looked at together.
_SAMPLES = 1 << 18

_REMEDY = "delete all files of the shard and collect or convert it again"

# docs/dataset.md says what the columns mean; who changes them changes dataset_metadata.SCHEMA_VERSION.
WORLDS_SCHEMA = pa.schema(
    {"world": pa.int64(), "rows": pa.int32(), "columns": pa.int32(), "cells": pa.binary(), "letters": pa.binary()}
)

VIEWS_SCHEMA = pa.schema(
    {
        "view": pa.int64(),
        "world": pa.int64(),
        "step": pa.int32(),
        "row": pa.int32(),
        "column": pa.int32(),
        "format": pa.string(),
        "image": pa.binary(),
        **dict.fromkeys(MAP_COLUMNS, pa.binary()),
    }
)

SAMPLES_SCHEMA = pa.schema(
    {
        "view": pa.int64(),
        "task": pa.string(),
        "outcome_class": pa.int32(),
        "row": pa.int32(),
        "column": pa.int32(),
        "in_view": pa.bool_(),
        "bearing": pa.float32(),
        "distance": pa.float32(),
        "phi_stay": pa.list_(pa.int8()),
        "phi_go": pa.list_(pa.int8()),
        "success_probability": pa.float32(),
        "success_cost": pa.float32(),
        "failure_cost": pa.float32(),
        "success_weight": pa.float32(),
        "failure_weight": pa.float32(),
    }
)


@dataclass
class Samples:
    """A dataset on the host. Of one that was read from files images, maps, worlds and columns stay on disk; images and
    maps are encoded until a batch is made.

    Attributes:
        images: one per view.
        maps: one per view: what was known of the map, and painted on it.
        worlds: the true maps.
        world_of: of each view, index into ``worlds``.
        view_of: index into ``images`` and ``maps``.
        cells: row and column of the subgoal.
        in_view: whether the panorama of the view shows the subgoal; the map may show it in any case.
        bearing: direction of the subgoal in the map's frame, radians, 0 along increasing columns, growing clockwise
            on a map with row 0 on top.
        distance: known-space geodesic from the pose, letters ignored.
        phi_stay, phi_go: the outcome class's vectors over ``metadata.propositions``, entries -1, 0, 1.
        success: the true P_S.
        success_cost: the true R_S, NaN where P_S = 0.
        failure_cost: the true R_F.
        success_weight, failure_weight: cost of missing a success and of taking a failure.
        metadata: what the shards share; of several data sets the first one's.
        joined_from: what identifies each data set, where several were joined.
    """

    images: Entries[bytes]
    maps: Entries[EncodedView]
    worlds: Entries[EncodedWorld]
    world_of: Int32[np.ndarray, " views"]
    view_of: Int32[np.ndarray, "N"]
    cells: Int32[np.ndarray, "N 2"]
    in_view: Bool[np.ndarray, "N"]
    bearing: Float32[np.ndarray, "N"]
    distance: Float32[np.ndarray, "N"]
    phi_stay: Int8[np.ndarray, "N P"]
    phi_go: Int8[np.ndarray, "N P"]
    success: Float32[np.ndarray, "N"]
    success_cost: Float32[np.ndarray, "N"]
    failure_cost: Float32[np.ndarray, "N"]
    success_weight: Float32[np.ndarray, "N"]
    failure_weight: Float32[np.ndarray, "N"]
    metadata: DatasetMetadata
    joined_from: tuple[DataSource, ...] = ()

    @property
    def sources(self) -> tuple[DataSource, ...]:
        """What identifies the data set, or each of those that were joined."""
        # Views and worlds are counted, and every column of the samples counts.
        arrays = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        columns = [array for name, array in arrays.items() if name != "world_of"]
        return self.joined_from or (data_source(self.metadata, len(self.worlds), len(self.images), columns),)

    @functools.cached_property
    def most_subgoals(self) -> int:
        """Subgoals that are asked about in one view, at most."""
        return self._most_in_a_view(self.cells)

    @functools.cached_property
    def most_lanes(self) -> int:
        """Pairs of a subgoal and a ``phi_stay`` that are asked about in one view, at most."""
        return self._most_in_a_view(self.cells, self.phi_stay)

    def _most_in_a_view(self, *columns: Int32[np.ndarray, "N _"] | Int8[np.ndarray, "N _"]) -> int:
        most = 1
        for block in self._blocks():
            table = np.column_stack([self.view_of[block], *(column[block] for column in columns)])
            distinct = np.unique(table, axis=0)
            most = max(most, int(np.unique(distinct[:, 0], return_counts=True)[1].max(initial=1)))
        return most

    def _blocks(self) -> Iterator[slice]:
        """All samples in pieces, each view in one of them: a table of all would be as large as memory allows."""
        count, steps = len(self.view_of), np.diff(self.view_of)
        # Where samples are not in the order of their views, as collections write them, one piece is the only safe one.
        starts = np.flatnonzero(steps) + 1 if np.all(steps >= 0) else np.zeros(0, np.int64)
        first = np.searchsorted(starts, np.arange(_SAMPLES, count, _SAMPLES))
        cuts = starts[first[first < len(starts)]].tolist()
        yield from itertools.starmap(slice, itertools.pairwise([0, *dict.fromkeys(cuts), count]))


def encode(
    image: UInt8[np.ndarray, "rows columns 3"], image_format: str = "jpeg", quality: int = JPEG_QUALITY
) -> bytes:
    """The RGB image as a file's bytes.

    Args:
        image: pixels.
        image_format: ``jpeg``, or ``png`` (without loss).
        quality: of JPEG, 0 to 100.

    Returns:
        The encoded image.

    Raises:
        DatasetError: another format, or an image that cannot be encoded.
    """
    if image_format not in ("jpeg", "png"):
        raise DatasetError(f"unknown image format {image_format!r}; choose jpeg or png")
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if image_format == "jpeg" else []
    extension = ".jpg" if image_format == "jpeg" else ".png"
    # OpenCV's images are BGR.
    done, data = cv2.imencode(extension, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise DatasetError(f"OpenCV could not encode an image of shape {image.shape} as {image_format}")
    return data.tobytes()


def decode(image: bytes) -> UInt8[np.ndarray, "rows columns 3"]:
    """The RGB image; may be called from several threads."""
    with reading("a panorama of the dataset", DatasetError, "an image"):
        return cv2.cvtColor(decode_image(image, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def writer_versions() -> dict[str, str]:
    """Versions of the libraries that encode the images and write the files."""
    return {"pyarrow": pa.__version__, "opencv": cv2.__version__}


def worlds_file(folder: Path | str, shard: int) -> Path:
    """The file of a shard's true maps."""
    return Path(folder) / f"worlds-{shard:05d}.parquet"


def views_file(folder: Path | str, shard: int) -> Path:
    """The file of a shard's views."""
    return Path(folder) / f"views-{shard:05d}.parquet"


def samples_file(folder: Path | str, shard: int) -> Path:
    """The file of a shard's samples; it exists where the shard is finished."""
    return Path(folder) / f"samples-{shard:05d}.parquet"


def view_id(shard: int, index: int) -> int:
    """The number of view ``index`` of a shard: unique in the dataset."""
    # No shard has 2**32 views, and readers in other languages have signed 64-bit integers.
    return shard << 32 | index


def finished_shards(folder: Path | str) -> set[int]:
    """Numbers of the shards that are complete; none where there is no such folder."""
    names = (re.fullmatch(r"samples-(\d{5})\.parquet", path.name) for path in Path(folder).glob("samples-*.parquet"))
    return {int(name[1]) for name in names if name}


def write_shard(
    folder: Path | str,
    number: int,
    worlds: Mapping[str, Any],
    views: Mapping[str, Any],
    samples: Mapping[str, Any],
    metadata: DatasetMetadata,
) -> None:
    """Write the files of a shard.

    A process that is killed at any time leaves the shard either complete or not there.

    Args:
        folder: the dataset; made if it is not there.
        number: of the shard.
        worlds, views, samples: columns as in ``WORLDS_SCHEMA``, ``VIEWS_SCHEMA`` and ``SAMPLES_SCHEMA``.
        metadata: what all shards of the dataset share.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    # The samples last: a shard exists when its samples file does.
    _write_table(worlds_file(folder, number), worlds, WORLDS_SCHEMA, metadata)
    _write_table(views_file(folder, number), views, VIEWS_SCHEMA, metadata)
    _write_table(samples_file(folder, number), samples, SAMPLES_SCHEMA, metadata)


def remove_unfinished_files(folder: Path | str) -> None:
    """Remove what processes that were killed had begun to write; nobody may be writing to the folder."""
    for path in Path(folder).glob(f"*.parquet.*{_TEMPORARY}"):
        path.unlink()


def read_metadata(folder: Path | str) -> DatasetMetadata:
    """The metadata that all finished shards share.

    Raises:
        DatasetError: no shards, a file that cannot be read, another schema version, or shards that differ.
    """
    shards = sorted(finished_shards(folder))
    if not shards:
        raise DatasetError(f"there is no dataset in {folder}: no finished shard (samples-*.parquet)")
    # Every file carries the metadata: shards of two collections in one folder are found out.
    paths = [path(folder, shard) for shard in shards for path in (worlds_file, views_file, samples_file)]
    first = _metadata_of(paths[0], _schema_of(paths[0]))
    for path in paths[1:]:
        found = first.differences(_metadata_of(path, _schema_of(path)))
        if found:
            raise DatasetError(f"{path.name} is from another dataset than {paths[0].name}: {'; '.join(found)}")
    return first


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
        DatasetError: what decides the meaning of a row differs: propositions, family, camera, unit or resolution.
    """
    first = parts[0].metadata
    for part in parts[1:]:
        for name in ("propositions", "family", "camera", "unit", "resolution"):
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
    worlds, of_worlds = _read_worlds(paths[0], kept)
    views, world_of_views, images, maps = _read_views(paths[1], kept)
    columns = _sample_columns(_read_table(paths[2], SAMPLES_SCHEMA), len(metadata.propositions), paths[2])
    view_of = _index_of(columns.pop("view"), views, "view", paths[2])
    world_of = _index_of(world_of_views, worlds, "world", paths[1])
    return Samples(
        images=images, maps=maps, worlds=of_worlds, world_of=world_of, view_of=view_of, metadata=metadata, **columns
    )


def _read_worlds(path: Path, kept: ImageFile) -> tuple[Int64[np.ndarray, " worlds"], OnDisk[EncodedWorld]]:
    """Numbers of a shard's worlds, and their maps on disk."""
    numbers, bounds = [np.zeros(0, np.int64)], [np.zeros((0, 4), np.int64)]
    for rows in _pieces(path, WORLDS_SCHEMA, WORLDS_SCHEMA.names):
        numbers.append(rows["world"].to_numpy())
        sizes = np.stack([rows["rows"].to_numpy(), rows["columns"].to_numpy()], axis=-1)
        maps = (rows[name].to_pylist() for name in ("cells", "letters"))
        bounds.append(kept.write(zip(map(np.ndarray.tobytes, sizes), *maps, strict=True)))
    return np.concatenate(numbers), OnDisk(kept, _world, np.concatenate(bounds))


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
    for rows in _pieces(path, VIEWS_SCHEMA, names):
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


def _write_table(path: Path, columns: Mapping[str, Any], schema: pa.Schema, metadata: DatasetMetadata) -> None:
    table = pa.Table.from_pydict(dict(columns), schema.with_metadata({_METADATA_KEY: metadata.to_json().encode()}))
    # With the process's number: two that write the same shard by mistake do not write into one file.
    temporary = path.with_name(f"{path.name}.{os.getpid()}{_TEMPORARY}")
    with temporary.open("wb") as file:
        # With checksums of the pages, so that a flipped bit is found when they are read.
        pq.write_table(table, file, compression="zstd", write_page_checksum=True)
        file.flush()
        # Before the rename: otherwise a power cut could leave the name without the contents.
        os.fsync(file.fileno())
    temporary.replace(path)


def _broken(path: Path, why: str) -> DatasetError:
    return DatasetError(f"{path} {why}: {_REMEDY}")


def _schema_of(path: Path) -> pa.Schema:
    if not path.exists():
        raise _broken(path, "is missing")
    require_file(path, DatasetError)
    with _reading(path):
        return pq.read_schema(path)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """As ``files.reading``, with what to do about a shard that is damaged."""
    try:
        with reading(path, DatasetError, "a shard of a dataset"):
            yield
    except DatasetError as error:
        raise DatasetError(f"{error}: {_REMEDY}") from error


def _metadata_of(path: Path, schema: pa.Schema) -> DatasetMetadata:
    text = (schema.metadata or {}).get(_METADATA_KEY)
    if text is None:
        raise DatasetError(f"{path} has no metadata of a dataset in its schema (key '{_METADATA_KEY.decode()}')")
    try:
        return DatasetMetadata.from_json(text.decode("utf-8", "replace"))
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from error


def _pieces(path: Path, schema: pa.Schema, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """The rows of a file, some at a time, each checked; other columns than the schema's are left out."""
    found = _schema_of(path)
    wrong = [field.name for field in schema if field.name not in found.names or found.field(field.name) != field]
    # More columns than the schema's are no harm: data from elsewhere may keep what they need.
    if wrong:
        raise _broken(path, f"has other columns than the schema: {', '.join(wrong)}")
    # Through a buffer, and not a file's column as a whole: a shard may be larger than memory.
    options: dict[str, Any] = {"buffer_size": _BUFFER, "pre_buffer": False, "page_checksum_verification": True}
    with _reading(path), pq.ParquetFile(path, **options) as file:
        for rows in file.iter_batches(_ROWS, columns=list(columns), use_threads=False):
            # Offsets that point beyond their values would be followed later.
            rows.validate(full=True)
            if any(column.null_count for column in rows.columns):
                raise _broken(path, "has missing values")
            if len(rows):
                yield rows


def _read_table(path: Path, schema: pa.Schema) -> pa.Table:
    return pa.Table.from_batches(_pieces(path, schema, schema.names), schema)


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
            raise _broken(path, f"has {name} whose length is not the number of propositions, {propositions}")
        columns[name] = lists.flatten().to_numpy().reshape(-1, propositions)
    _check_values(columns, path)
    return columns


def _check_values(columns: Mapping[str, np.ndarray], path: Path) -> None:
    # NaN fails every comparison, so that it is refused wherever a rule does not allow it by name.
    success = columns["success"] > 0
    positive = ("success_weight", "failure_weight")
    rules = {
        "success_probability must lie in [0, 1]": (columns["success"] >= 0) & (columns["success"] <= 1),
        "success_cost must be a positive number where success_probability > 0": ~success
        | (np.isfinite(columns["success_cost"]) & (columns["success_cost"] > 0)),
        "failure_cost must be a number >= 0": np.isfinite(columns["failure_cost"]) & (columns["failure_cost"] >= 0),
        "distance must be a number >= 0": np.isfinite(columns["distance"]) & (columns["distance"] >= 0),
        "bearing must be a number": np.isfinite(columns["bearing"]),
        **{f"{name} must be a positive number": np.isfinite(columns[name]) & (columns[name] > 0) for name in positive},
    }
    for rule, holds in rules.items():
        if not holds.all():
            raise DatasetError(f"{path}, row {int(np.argmin(holds))}: {rule}")


def _index_of(wanted: np.ndarray, known: np.ndarray, what: str, path: Path) -> Int32[np.ndarray, "N"]:
    """Position of each row's view, or world, among those of the shard."""
    # Files from elsewhere may number them as they like.
    position = {number: index for index, number in enumerate(known.tolist())}
    if len(position) < len(known):
        raise _broken(path, f"belongs to {what}s that occur twice")
    try:
        return np.array([position[number] for number in wanted.tolist()], np.int32)
    except KeyError as error:
        raise _broken(path, f"has rows of {what} {error}, which is not in the shard") from error
