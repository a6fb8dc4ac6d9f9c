"""Settings of a trial."""

import dataclasses

from potlp_jax.planning.policies import DecisionConfig
from potlp_jax.world.camera import CameraConfig, Disturbance
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
