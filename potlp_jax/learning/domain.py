"""What an estimator serves: worlds that look, are seen and are measured like those that it learned from.

Propositions alone do not tell: somebody's own map may have places called ``document`` and ``package``, in other light,
in front of another camera. An estimator's file names its domain, and every world has one to compare it with.
"""

import dataclasses
import math
from collections.abc import Iterator

from potlp_jax.environments.families import MAP_PREFIX
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.grid import World

_TOLERANCE: float = 1e-4
"""Relative, between lengths of cameras: resolutions are float32."""


@dataclasses.dataclass(frozen=True)
class Domain:
    """Where worlds come from, how they are seen and in what they are measured.

    Attributes:
        family: of worlds (``World.family``), ``LOGS`` for robots' logs, empty where it is not known.
        camera: with its lengths in the unit of cost, so that cells of other sizes can be compared; None where it is not
            known.
        unit: of costs (``unit_of``).
    """

    family: str
    camera: CameraConfig | None
    unit: str

    @classmethod
    def of_cells(cls, family: str, camera: CameraConfig, resolution: float) -> "Domain":
        """Of worlds of a family, with cells of this size, seen by a camera whose lengths are in cells.

        Args:
            family: as ``World.family``.
            camera: its lengths are in cells.
            resolution: side of a cell.

        Returns:
            The domain, with the camera's lengths in the unit of ``resolution``.
        """
        in_unit = dataclasses.replace(camera, **camera.lengths(resolution))
        return cls(family, in_unit, unit_of(resolution))

    @classmethod
    def of_world(cls, world: World, camera: CameraConfig) -> "Domain":
        """Of a world, seen by a camera whose lengths are in cells."""
        return cls.of_cells(world.family, camera, float(world.resolution))

    @classmethod
    def of_robot(cls, resolution: float) -> "Domain":
        """Of a robot's map whose cells have this size: what it looks like, and the camera, is not known."""
        return cls("", None, unit_of(resolution))

    def misfits(self, here: "Domain") -> tuple[str, ...]:
        """Why an estimator of this domain does not serve another; empty where it does."""
        return (*self.family_misfits(here), *self.measure_misfits(here))

    def family_misfits(self, here: "Domain") -> tuple[str, ...]:
        """How the kinds of worlds differ, in words."""
        # A family that nobody named is none that anything is known of. What robots have seen is asked by robots, and on
        # their maps.
        of_robots = not here.family or here.family.startswith(MAP_PREFIX)
        if here.family == self.family != "" or (self.family == LOGS and of_robots):
            return ()
        found = f"are of {here.family}" if here.family else "are a robot's, of no named family"
        return (f"it learned from worlds of {self.family or 'no named family'}, and these {found}",)

    def measure_misfits(self, here: "Domain") -> tuple[str, ...]:
        """How camera and unit differ, in words: what pictures and numbers mean."""
        misfits = []
        if self.unit != here.unit:
            misfits.append(f"it counts in {self.unit}, and here costs are in {here.unit}")
        # Lengths in different units would differ in any case.
        elif self.camera is not None and here.camera is not None:
            differing = ", ".join(_differing(self.camera, here.camera))
            misfits += [f"its camera has another {differing}"] if differing else []
        return tuple(misfits)


FLOOR: tuple[str, ...] = ("horizon", "far", "fold")
"""Fields of a camera that say how it sees the floor. Data from elsewhere need not have them."""

LOGS: str = "log"
"""Family of the worlds that are read from robots' logs."""


def unit_of(resolution: float) -> str:
    """The unit of cost where a cell has this size."""
    return "cells" if resolution == 1.0 else "metres"


def _differing(mine: CameraConfig, other: CameraConfig) -> Iterator[str]:
    """Fields that differ, with both values."""
    for field in dataclasses.fields(CameraConfig):
        one, two = getattr(mine, field.name), getattr(other, field.name)
        same = math.isclose(one, two, rel_tol=_TOLERANCE) if isinstance(one, float) else one == two
        if not same:
            yield f"{field.name} ({_shown(one)}, here {_shown(two)})"


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else repr(value)
