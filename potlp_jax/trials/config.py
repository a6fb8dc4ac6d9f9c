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

    Attributes:
        decision: how a policy decides.
        sensor: what a simulated robot observes.
        camera: the panoramas of a simulated robot.
        disturbance: of these panoramas.
        replan_distance: cells travelled after which a changed map is worth a new decision.
        budget_factor: times the map's ``height + width`` is the number of cells that may be travelled.
        revealed: whether a simulated robot knows the whole map from the start.
    """

    decision: DecisionConfig = DecisionConfig()
    sensor: SensorConfig = SensorConfig()
    camera: CameraConfig = CameraConfig()
    disturbance: Disturbance = Disturbance()
    # Both are part of the model (docs/model.md section 7): another value gives other trials.
    replan_distance: float = 4.0
    budget_factor: float = 20.0
    revealed: bool = False


def trial_config_for(source: World | Generator) -> TrialConfig:
    """What trials in a world, or in the worlds of a family, call for."""
    return with_settings(TrialConfig(), source.settings)
