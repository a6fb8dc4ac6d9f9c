"""The architectures of estimators: what a file's configuration is, what its parameters are, and how a trial begins."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from potlp_jax.learning.building_config import BuildingConfig
from potlp_jax.learning.building_estimator import BuildingEstimator
from potlp_jax.learning.building_network import BuildingNetwork, building_operations
from potlp_jax.learning.memory import empty_memory
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig, Params, operation_counts
from potlp_jax.learning.observing import ObservingEstimator
from potlp_jax.learning.painting import blank_painting
from potlp_jax.learning.panorama_estimator import NetworkEstimator

EstimatorConfig = NetworkConfig | BuildingConfig
"""Configuration of an estimator's network."""


@dataclasses.dataclass(frozen=True)
class Architecture:
    """One architecture.

    Attributes:
        name: as files have it.
        config: class of its configurations.
        network: the network of a configuration, with ``init``.
        operations: from a configuration, and rows and columns of a map: floating-point operations forward, by what
            they are done for.
        start: from parameters, configuration, rows and columns of the map's array, panoramas that are remembered, and
            the side of a cell in the unit of cost: the estimator for a new trial.
        before: fields of the configuration that files lack which were written before the network had what they size,
            and what such files stand for.
    """

    name: str
    config: type[Any]
    network: Callable[[Any], Any]
    operations: Callable[[Any, tuple[int, int]], dict[str, int]]
    start: Callable[[Params, Any, int, int, int, float], ObservingEstimator]
    before: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def _panorama_operations(config: NetworkConfig, _: tuple[int, int]) -> dict[str, int]:
    return dict(zip(("a panorama", "a subgoal and class"), operation_counts(config), strict=True))


def _building_operations(config: BuildingConfig, shape: tuple[int, int]) -> dict[str, int]:
    height, width = shape
    names = (f"a map of {height} × {width} cells", "a subgoal", "a subgoal and class")
    return dict(zip(names, building_operations(config, height, width), strict=True))


def _start_panorama(
    params: Params, config: NetworkConfig, height: int, width: int, panoramas: int, _: float
) -> NetworkEstimator:
    # What a panorama shows is measured in the unit of cost, whatever the cells are.
    memory = empty_memory(panoramas, config.feature_shape, height, width)
    return NetworkEstimator(params=params, memory=memory, config=config)


def _start_building(
    params: Params, config: BuildingConfig, height: int, width: int, _: int, resolution: float
) -> BuildingEstimator:
    # A painting holds any number of panoramas.
    scale = resolution / config.step
    return BuildingEstimator(
        params=params,
        memory=blank_painting(height, width),
        config=config,
        # Sides of cells are float32 in worlds, and float64 in files.
        scale=1.0 if math.isclose(scale, 1.0, rel_tol=1e-4) else round(scale, 6),
    )


ARCHITECTURES: Mapping[str, Architecture] = MappingProxyType(
    {
        architecture.name: architecture
        for architecture in (
            Architecture("panorama", NetworkConfig, EstimatorNetwork, _panorama_operations, _start_panorama),
            Architecture(
                "building",
                BuildingConfig,
                BuildingNetwork,
                _building_operations,
                _start_building,
                before={"contrast": 0, "raw": 0, "glances": False, "own_within": 2},
            ),
        )
    }
)
"""By name: ``panorama`` answers from one panorama (Bradley et al. 2021), ``building`` from all that was seen."""


def architecture_of(config: EstimatorConfig) -> Architecture:
    """The architecture that a configuration is of."""
    return next(found for found in ARCHITECTURES.values() if isinstance(config, found.config))
