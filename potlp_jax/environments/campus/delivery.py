"""Generated academic floors for the delivery task of Bradley et al. 2021, section V-B.

A floor is a rectangle that hallways divide and rooms fill (``environments.campus.blocks``); blocks that stay outdoors
leave wings, courtyards and notches. ``environments.campus.campus`` has floors of other outlines and sizes.

All lengths are in cells of ``DeliveryConfig.resolution`` metres; costs are in metres. Worlds differ in ``extent`` and
are padded to one shape.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from potlp_jax.environments.campus.blocks import BlockBuilder, BlockStyle
from potlp_jax.environments.campus.floor_generator import FloorGenerator
from potlp_jax.environments.campus.furnishing import MANY_DOORS, PARCELS, PEOPLE, Errand, Floor, FurnishConfig
from potlp_jax.world.camera import CameraConfig

DELIVERY_FAMILY: str = "delivery"
PARCELS_FAMILY: str = "parcels"
"""Names of the two families: floors with people in rooms of their kind, and floors with two parcels to deliver."""

REPLAN_DISTANCE: float = 4.0
"""Cells between decisions, as in every family: 2 m."""


@dataclasses.dataclass(frozen=True)
class DeliveryConfig(BlockStyle):
    """Sizes in cells.

    Attributes:
        smallest, largest: bounds of the floor's rows and columns, outer walls included; arrays have the largest size.
        resolution: side of a cell in metres.
        furnishing: people, light and colours.
    """

    smallest: tuple[int, int] = (48, 72)
    largest: tuple[int, int] = (80, 136)
    resolution: float = 0.5
    furnishing: FurnishConfig = FurnishConfig()

    def rules(self) -> Iterator[tuple[bool, str]]:
        """What must hold, and how it is said where it does not."""
        yield (
            all(24 <= low <= high for low, high in zip(self.smallest, self.largest, strict=True)),
            f"smallest {self.smallest} must be at least 24 and not exceed largest {self.largest}",
        )
        yield self.resolution > 0, "resolution must be positive"
        yield from super().rules()


def scaled_to(resolution: float) -> dict[str, Any]:
    """Settings of trials with which cells of another size, in metres, are seen and decided upon as those of the family.

    The camera and the distance between decisions count in cells: their lengths are scaled, so that a picture shows the
    same metres and the robot decides as often.
    """
    scale = DeliveryConfig().resolution / resolution
    return {"camera": CameraConfig().lengths(scale), "replan_distance": REPLAN_DISTANCE * scale}


class Delivery(FloorGenerator):
    """Generator of academic floors with people to find: by default the three of section V-B."""

    settings = MANY_DOORS

    def __init__(
        self, config: DeliveryConfig | None = None, name: str = DELIVERY_FAMILY, errand: Errand = PEOPLE
    ) -> None:
        config = DeliveryConfig() if config is None else config
        super().__init__(config, config.largest, config.furnishing, name, errand)

    @classmethod
    def toy(cls) -> "Delivery":
        """Floors of 36 to 48 rows and 48 to 64 columns."""
        return cls(DeliveryConfig(smallest=(36, 48), largest=(48, 64)))

    @classmethod
    def parcels(cls) -> "Delivery":
        """Floors with a document and a package to deliver in two rooms of any kind, which nothing but light tells."""
        return cls(DeliveryConfig(furnishing=FurnishConfig(coloured=False)), PARCELS_FAMILY, PARCELS)

    def build(self, rng: np.random.Generator) -> Floor:
        """A rectangle of a size drawn between the bounds."""
        config = self.config
        height, width = (
            int(rng.integers(low, high + 1)) for low, high in zip(config.smallest, config.largest, strict=True)
        )
        return BlockBuilder(config, rng, (height, width)).build_rectangle(config.resolution)
