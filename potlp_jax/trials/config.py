"""Settings of a trial."""

import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

from potlp_jax.checks import COUNT, FLAG, NOT_NEGATIVE, POSITIVE, WHOLE, as_python_numbers, require_fields
from potlp_jax.codec import with_settings
from potlp_jax.environments.base import Generator
from potlp_jax.errors import PotlpWarning
from potlp_jax.planning.situation import DecisionConfig
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
        panoramas: how many an estimator with a camera remembers. Where that is too few for the frontiers that are open
            the trial's status has ``VIEW_OVERFLOW``.
        look_every: on the way from one decision to the next, the number of cells after which the camera looks again,
            for an estimator that ``learning.observing.LooksOnTheWay``; 0: it looks at decisions alone.
        replan_distance: cells travelled after which a changed map is worth a new decision.
        budget_factor: times the map's ``height + width`` is the number of cells that may be travelled.
        revealed: whether a simulated robot knows the whole map from the start.
    """

    decision: DecisionConfig = DecisionConfig()
    sensor: SensorConfig = SensorConfig()
    camera: CameraConfig = CameraConfig()
    disturbance: Disturbance = Disturbance()
    # Panoramas that still show a frontier: at most 9 in fire-fighting buildings.
    panoramas: int = 32
    look_every: int = 1
    # Both are part of the model (docs/model.md section 7): another value gives other trials.
    replan_distance: float = 4.0
    budget_factor: float = 20.0
    revealed: bool = False

    def __post_init__(self) -> None:
        require_fields(self, ("revealed",), FLAG, ValueError)
        require_fields(self, ("panoramas",), COUNT, ValueError)
        require_fields(self, ("look_every",), WHOLE, ValueError)
        require_fields(self, ("replan_distance",), NOT_NEGATIVE, ValueError)
        # Infinity is no budget: a batch keeps paths of this length, and JSON has no such number.
        require_fields(self, ("budget_factor",), POSITIVE, ValueError)
        as_python_numbers(self)


def trial_config_for(source: World | Generator) -> TrialConfig:
    """The settings that trials in a world, or in the worlds of a family, call for: defaults but for ``settings``."""
    return with_settings(TrialConfig(), source.settings)


def config_in(world: World, given: TrialConfig | None) -> TrialConfig:
    """The settings of a trial in a world: those given, by default what the world calls for.

    Warns:
        PotlpWarning: the settings given have defaults where the world calls for something else. Too few panoramas,
            or a least frontier that is wider than doors, end no trial and raise no error: they only make every planner
            worse.
    """
    if given is None:
        return trial_config_for(world)
    unheeded = list(_unheeded(world.settings, given, TrialConfig()))
    if unheeded:
        warnings.warn(
            f"the world calls for {', '.join(unheeded)}, and the configuration has the defaults; begin with "
            "trial_config_for(world) and change what you need",
            PotlpWarning,
            stacklevel=3,
        )
    return given


def _unheeded(settings: Mapping[str, Any], given: Any, default: Any) -> Iterator[str]:
    """Settings of which the defaults are given although something else is called for."""
    for name, wanted in settings.items():
        value, usual = getattr(given, name), getattr(default, name)
        if isinstance(wanted, Mapping):
            yield from (f"{name}.{entry}" for entry in _unheeded(wanted, value, usual))
        elif value == usual != wanted:
            # A value that is neither was chosen by somebody, who may know better than the world.
            yield f"{name}={wanted}"
