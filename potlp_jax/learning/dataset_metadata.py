"""What a data set says of itself, in every file, and what identifies it among those that an estimator was fitted to."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from potlp_jax.codec import config_from_dict, differences, json_copy
from potlp_jax.errors import ConfigurationError, DatasetError
from potlp_jax.files import one_line, short
from potlp_jax.learning.domain import FLOOR, Domain, unit_of
from potlp_jax.world.camera import CameraConfig

SCHEMA_VERSION: int = 2
"""Changes when a column or its meaning does."""


@dataclass(frozen=True)
class DatasetMetadata:
    """What all shards of a dataset share. Nested values are JSON-able.

    Attributes:
        propositions: Sigma: the order of the entries of ``phi_stay`` and ``phi_go``.
        environment: name of the worlds as it was given, or of the building.
        family: what kind of worlds they are (``Generator.family``); ``learning.domain.LOGS`` for robots' logs.
        generator: the family's configuration.
        split: name of the split that the worlds are from (``environments.splits``); for real data any name.
        camera: geometry of the panorama.
        disturbance: what was added to the clean image.
        encoding: format and quality of the encoded images.
        weights: the bounds of ``success_weight`` and ``failure_weight``: ``low`` and ``high``.
        collection: how poses, tasks and classes were drawn, seeds included.
        versions: of the libraries.
        unit: the unit of every distance, cost and weight.
        resolution: side of a cell in that unit.
        shape: rows and columns of the array that all maps are padded to.
        source: ``simulation``, or what else made the records.
        schema_version: ``SCHEMA_VERSION`` at the time of writing.
    """

    propositions: tuple[str, ...]
    environment: str
    family: str
    generator: Mapping[str, Any]
    split: str
    camera: Mapping[str, Any]
    disturbance: Mapping[str, Any]
    encoding: Mapping[str, Any]
    weights: Mapping[str, float]
    collection: Mapping[str, Any]
    versions: Mapping[str, str]
    shape: tuple[int, int]
    unit: str = "cells"
    resolution: float = 1.0
    source: str = "simulation"
    schema_version: int = SCHEMA_VERSION

    def to_json(self) -> str:
        """Canonical text: equal metadata give equal text."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> "DatasetMetadata":
        """The metadata that ``to_json`` wrote. Raises DatasetError where the text is something else."""
        try:
            data = json.loads(text)
            version = data["schema_version"]
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise DatasetError(f"not the metadata of a dataset: {one_line(error)}") from error
        # Before the other fields: those of another version may well have other names.
        if version != SCHEMA_VERSION:
            raise DatasetError(
                f"schema version {short(version)}; this library reads {SCHEMA_VERSION}: collect the dataset again, or "
                "use the version of the library that wrote it"
            )
        try:
            return config_from_dict(cls, data, "metadata")
        except ConfigurationError as error:
            raise DatasetError(f"not the metadata of a dataset: {error}") from error

    @property
    def domain(self) -> Domain:
        """What an estimator serves that learns from this dataset; its camera is not known where it has no ``FLOOR``.

        Raises:
            DatasetError: ``camera`` is none.
        """
        if any(name not in self.camera for name in FLOOR):
            return Domain(self.family, None, unit_of(self.resolution))
        try:
            camera = config_from_dict(CameraConfig, self.camera, "camera")
        except ConfigurationError as error:
            raise DatasetError(f"not the metadata of a dataset: {error}") from error
        return Domain.of_cells(self.family, camera, self.resolution)

    @property
    def glances(self) -> bool:
        """Whether cells of which a part alone was in sight are painted, too (``learning.painting.paint``)."""
        # Data sets that do not say it were recorded when there was no other way.
        return bool(self.collection.get("glances", False))

    @property
    def nearest(self) -> bool:
        """Whether by the labels the nearest ways to a class alone count (``learning.labels.nearest_ways``)."""
        return bool(self.collection.get("nearest", False))

    def differences(self, other: "DatasetMetadata") -> list[str]:
        """What differs, with both values: of this dataset, and of the other."""
        return differences(json_copy(dataclasses.asdict(self)), json_copy(dataclasses.asdict(other)))


@dataclass(frozen=True, kw_only=True)
class DataSource:
    """A data set without the folder that it lies in, which is another one on another machine.

    Attributes:
        environment, split: where the worlds are from.
        worlds, views, samples: numbers of rows.
        first_world: index in the split of the first world; None for robots' logs.
        driver: what drove; None for robots' logs.
        estimator: identity of the one that the driver asked; empty for none.
        digest: of the metadata and the samples.
    """

    environment: str
    split: str
    worlds: int
    views: int
    samples: int
    first_world: int | None
    driver: str | None
    estimator: str
    digest: str


def data_source(metadata: DatasetMetadata, worlds: int, views: int, columns: Iterable[np.ndarray]) -> DataSource:
    """What identifies a data set.

    Args:
        metadata: of the data set.
        worlds, views: their numbers.
        columns: of the samples, at least one.

    Returns:
        Equal for equal data sets.
    """
    # With the samples: collections of two versions of a program may have the same metadata, and so may two logs.
    digest, rows = hashlib.sha256(metadata.to_json().encode()), 0
    for column in columns:
        # Without a copy: a column may be mapped from disk.
        digest.update(np.ascontiguousarray(column).data)
        rows = len(column)
    return DataSource(
        environment=metadata.environment,
        split=metadata.split,
        worlds=worlds,
        views=views,
        samples=rows,
        first_world=metadata.collection.get("first_world"),
        driver=metadata.collection.get("driver"),
        estimator=metadata.collection.get("estimator", ""),
        digest=digest.hexdigest()[:12],
    )
