"""Settings of a trial."""

import dataclasses

from potlp_jax.codec import with_settings
from potlp_jax.environments.base import Generator
from potlp_jax.planning.policies import DecisionConfig
from potlp_jax.world.camera import CameraConfig, Disturbance
from potlp_jax.world.grid import World
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
    # docs/model.md section 7.
    replan_distance: float = 4.0
    budget_factor: float = 20.0
    revealed: bool = False


def trial_config_for(source: World | Generator) -> TrialConfig:
    """What trials in a world, or in the worlds of a family, call for."""
    return with_settings(TrialConfig(), source.settings)
