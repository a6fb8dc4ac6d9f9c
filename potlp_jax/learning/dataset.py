"""What a dataset is, on disk and in memory: records for training the estimator, by simulation or from a robot's log.

A dataset is a folder. Shard ``S`` is three files: ``worlds-SSSSS.parquet`` (one row a true map),
``views-SSSSS.parquet`` (one row a panorama, with what was known and painted on the map when it was taken) and
``samples-SSSSS.parquet`` (one row a (view, subgoal, outcome class)). Each is written under a temporary name and
renamed, the samples last: a shard exists when its samples file does. Every file carries the dataset's metadata as JSON
in its schema, under the key ``potlp``. ``docs/dataset.md`` describes the columns, ``dataset_reading`` reads them.
"""

import functools
import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float32, Int8, Int32, UInt8

from potlp_jax.errors import DatasetError
from potlp_jax.files import TEMPORARY, reading
from potlp_jax.images import decode_image
from potlp_jax.learning.dataset_metadata import DatasetMetadata, DataSource, data_source
from potlp_jax.learning.map_images import MAP_COLUMNS, EncodedView, EncodedWorld
from potlp_jax.learning.on_disk import Entries
from potlp_jax.learning.shard_files import metadata_of, write_table

JPEG_QUALITY: int = 92

IMAGE_FORMATS: tuple[str, ...] = ("jpeg", "png")
"""Of panoramas; ``png`` is without loss."""

# Samples that are looked at together.
_SAMPLES = 1 << 18

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
    if image_format not in IMAGE_FORMATS:
        raise DatasetError(f"unknown image format {image_format!r}; choose {' or '.join(IMAGE_FORMATS)}")
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
    # Five digits at least: a larger number has as many as it needs.
    names = (re.fullmatch(r"samples-(\d{5,})\.parquet", path.name) for path in Path(folder).glob("samples-*.parquet"))
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
    write_table(worlds_file(folder, number), worlds, WORLDS_SCHEMA, metadata)
    write_table(views_file(folder, number), views, VIEWS_SCHEMA, metadata)
    write_table(samples_file(folder, number), samples, SAMPLES_SCHEMA, metadata)


def remove_unfinished_files(folder: Path | str) -> None:
    """Remove what processes that were killed had begun to write; nobody may be writing to the folder."""
    for path in Path(folder).glob(f"*.parquet.*{TEMPORARY}"):
        path.unlink()


def read_metadata(folder: Path | str) -> DatasetMetadata:
    """The metadata that all finished shards share.

    Raises:
        DatasetError: no shards, a file that cannot be read, another schema version, or shards that differ.
    """
    shards = sorted(finished_shards(folder))
    if not shards:
        raise DatasetError(f"there is no dataset in {folder}: no finished shard (samples-*.parquet)")
    # Every file carries the metadata: shards of two collections in one folder are found out. The file of samples comes
    # first, because other versions of the schema have it, too: the version is what is wrong, not what they lack.
    paths = [path(folder, shard) for shard in shards for path in (samples_file, worlds_file, views_file)]
    first = metadata_of(paths[0])
    for path in paths[1:]:
        found = first.differences(metadata_of(path))
        if found:
            raise DatasetError(f"{path.name} is from another dataset than {paths[0].name}: {'; '.join(found)}")
    return first
