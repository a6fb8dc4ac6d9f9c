"""Settings of a trial, and how they are read back from a record."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from potlp_jax.planning.policies import DecisionConfig
from potlp_jax.planning.search.config import SearchConfig, UctConfig
from potlp_jax.world.frontiers import FrontierConfig
from potlp_jax.world.panorama import CameraConfig, Disturbance
from potlp_jax.world.sensing import SensorConfig


@dataclasses.dataclass(frozen=True)
class TrialConfig:
    """Settings of a trial (docs/model.md section 7).

    ``replan_distance`` is in cells; ``budget_factor`` times the map's ``height + width`` cells may be travelled;
    ``revealed`` starts from the whole map. ``camera`` and ``disturbance`` matter to policies that look.
    """

    decision: DecisionConfig = DecisionConfig()
    sensor: SensorConfig = SensorConfig()
    camera: CameraConfig = CameraConfig()
    disturbance: Disturbance = Disturbance()
    replan_distance: float = 4.0
    budget_factor: float = 20.0
    revealed: bool = False


def with_settings(config: Any, settings: Mapping[str, Any]) -> Any:
    """A configuration with some of its fields changed, nested mappings for nested configurations.

    For settings that are known to be right, such as a generator's; ``sweep.specification`` checks those of users.
    """
    changes = {
        name: with_settings(getattr(config, name), value) if isinstance(value, Mapping) else value
        for name, value in settings.items()
    }
    return dataclasses.replace(config, **changes)


def trial_config_from_dict(data: Mapping[str, Any]) -> TrialConfig:
    """The configuration that a record keeps, as ``dataclasses.asdict`` wrote it."""
    decision = data["decision"]
    return TrialConfig(
        **{
            **data,
            "sensor": SensorConfig(**data["sensor"]),
            "camera": _camera_from_dict(data.get("camera", {})),
            "disturbance": Disturbance(**data.get("disturbance", {})),
            "decision": DecisionConfig(
                **{
                    "commitment": 0.0,  # of records older than the setting
                    **decision,
                    "frontiers": FrontierConfig(**decision["frontiers"]),
                    "search": _SEARCHES[decision["search"]["kind"]](**decision["search"]),
                }
            ),
        }
    )


_SEARCHES = {"best-first": SearchConfig, "uct": UctConfig}


def _camera_from_dict(data: Mapping[str, Any]) -> CameraConfig:
    """JSON has lists where the configuration has tuples."""
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in data.items()}
    return CameraConfig(**values)
