"""Floors of campus buildings of all sizes that real ones have, up to 224 m long: the families ``campus-...``.

A building has one of the outlines of ``outlines``, rooms as wide as its style says, and whatever ``campus_builder``
draws beside them. People, light and colours are those of the ``delivery`` floors, so that the same tasks are set here
and an estimator of one knows what it sees in the other.

Arrays of a family have one shape, and what a decision costs grows with it whatever the building's size. So there are
three families, each with arrays that fit its buildings: small, medium and large. docs/delivery.md says what they cost.

All lengths are in cells of ``CampusConfig.resolution`` metres; costs are in metres.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from potlp_jax.environments.campus.campus_builder import CampusBuilder, CampusFloor, CampusStyle
from potlp_jax.environments.campus.delivery import DELIVERY_FAMILY, PARCELS_FAMILY
from potlp_jax.environments.campus.floor_generator import FloorGenerator
from potlp_jax.environments.campus.furnishing import PARCELS, PEOPLE, Errand, FurnishConfig
from potlp_jax.environments.campus.outlines import LEAST_COURT, Outline, Site, draw_wings, least_height, least_width
from potlp_jax.errors import WorldError
from potlp_jax.world.settings import Settings

SIZES: tuple[str, ...] = ("small", "medium", "large")
"""Of buildings, by their long side: 24 to 64 m, 64 to 128 m, 128 to 224 m."""

NARROW_DOORS: Settings = Settings({"decision": {"frontiers": {"max_subgoals": 96, "min_size": 1}}, "panoramas": 128})
"""Settings of trials, as for real buildings: a door may be as narrow as one cell."""


@dataclasses.dataclass(frozen=True)
class CampusConfig:
    """Sizes in cells. Bounds are of what is drawn once a building, uniformly.

    Attributes:
        long_side: bounds of the building's longer side, outer walls included.
        largest: rows and columns of the arrays.
        aspect: bounds of the shorter side, as a share of the longer; more where the outline needs it.
        wing_depth: bounds, drawn once a wing.
        outlines: how often each is drawn, relative to the others that the building is large enough for.
        grain, row_depth: bounds of what ``CampusStyle`` says.
        hallway_width: bounds of the width of its narrowest hallway; others are up to two cells wider.
        closed, narrow_door: bounds of what ``CampusStyle`` says.
        style: what is the same in all buildings; what has bounds here is replaced.
        resolution: side of a cell in metres.
        furnishing: people, light and colours.
    """

    long_side: tuple[int, int]
    largest: tuple[int, int]
    outlines: tuple[tuple[Outline, float], ...]
    aspect: tuple[float, float] = (0.3, 0.9)
    wing_depth: tuple[int, int] = (24, 46)
    grain: tuple[float, float] = (1.0, 2.2)
    row_depth: tuple[int, int] = (14, 22)
    hallway_width: tuple[int, int] = (3, 6)
    closed: tuple[float, float] = (0.0, 0.15)
    narrow_door: tuple[float, float] = (0.0, 0.8)
    style: CampusStyle = CampusStyle(split=0.06, severed=0.1, outdoors=0.06, lobby=0.08, room_behind=0.4)
    resolution: float = 0.5
    furnishing: FurnishConfig = FurnishConfig()

    def __post_init__(self) -> None:
        deepest = self.wing_depth[1]
        drawn = (self.long_side, self.aspect, self.wing_depth, self.grain, self.row_depth)
        drawn += (self.hallway_width, self.closed, self.narrow_door)
        rules = (
            (all(0 <= low <= high for low, high in drawn), "bounds must not be negative, and be in increasing order"),
            (self.long_side[0] >= 40, "long_side must be at least 40"),
            (self.wing_depth[0] >= 18, "wing_depth must be at least 18"),
            (self.row_depth[0] >= 10, "row_depth must be at least 10"),
            (1 <= self.hallway_width[0] and self.hallway_width[1] <= 6, "hallway_width must lie in 1 to 6"),
            (self.aspect[1] <= 1 and self.closed[1] <= 1 and self.narrow_door[1] <= 1, "a share must not exceed 1"),
            (self.resolution > 0, "resolution must be positive"),
            (self.long_side[1] <= self.largest[1], f"largest {self.largest} must have long_side's columns"),
            (
                any(self._fits(outline, self.long_side[0]) for outline, weight in self.outlines if weight > 0),
                "no outline fits the smallest building; give larger sides, or shallower wings",
            ),
            (
                all(least_height(outline, deepest) <= self.largest[0] for outline, weight in self.outlines if weight),
                f"largest {self.largest} has too few rows for the outlines with wings {deepest} cells deep",
            ),
        )
        broken = [message for holds, message in rules if not holds]
        if broken:
            raise WorldError("not a campus building: " + "; ".join(broken))

    def outlines_of(self, width: int) -> tuple[tuple[Outline, float], ...]:
        """The outlines for which a building of so many columns is large enough."""
        return tuple((outline, weight) for outline, weight in self.outlines if self._fits(outline, width))

    def _fits(self, outline: Outline, width: int) -> bool:
        return least_width(outline, self.wing_depth[1]) <= width


_SMALL = CampusConfig(
    long_side=(48, 128),
    largest=(96, 128),
    wing_depth=(20, 36),
    outlines=(
        (Outline.BAR, 0.3),
        (Outline.BLOCK, 0.3),
        (Outline.L, 0.2),
        (Outline.T, 0.1),
        (Outline.U, 0.15),
        (Outline.H, 0.05),
    ),
)
_MEDIUM = CampusConfig(
    long_side=(128, 256),
    largest=(160, 256),
    outlines=(
        (Outline.BAR, 0.12),
        (Outline.BLOCK, 0.14),
        (Outline.L, 0.16),
        (Outline.T, 0.12),
        (Outline.U, 0.14),
        (Outline.H, 0.1),
        (Outline.COMB, 0.08),
        (Outline.RING, 0.1),
        (Outline.STEPPED, 0.08),
    ),
)
_LARGE = CampusConfig(
    long_side=(256, 448),
    largest=(224, 448),
    aspect=(0.15, 0.6),
    outlines=(
        (Outline.BAR, 0.12),
        (Outline.L, 0.14),
        (Outline.T, 0.12),
        (Outline.U, 0.14),
        (Outline.H, 0.12),
        (Outline.COMB, 0.16),
        (Outline.RING, 0.1),
        (Outline.STEPPED, 0.1),
    ),
)
CONFIGS: Mapping[str, CampusConfig] = MappingProxyType(dict(zip(SIZES, (_SMALL, _MEDIUM, _LARGE), strict=True)))
"""By size."""


class Campus(FloorGenerator):
    """Generator of campus buildings of one size, with people to find: by default those of ``delivery``."""

    settings = NARROW_DOORS

    def __init__(
        self, config: CampusConfig = _MEDIUM, name: str = "campus-medium", errand: Errand = PEOPLE, family: str = ""
    ) -> None:
        """Of this configuration.

        Args:
            config: sizes and chances.
            name: the family's; it goes into the keys of its worlds.
            errand: who is to be found, and where they can be.
            family: whose worlds these look like, to an estimator; by default ``delivery``.
        """
        super().__init__(config, config.largest, config.furnishing, name, errand)
        self.family = family or DELIVERY_FAMILY

    @classmethod
    def of_size(cls, size: str) -> "Campus":
        """Buildings of one of the ``SIZES``, with people in rooms of their kind."""
        return cls(CONFIGS[size], f"campus-{size}")

    @classmethod
    def parcels_of_size(cls, size: str) -> "Campus":
        """Buildings of one of the ``SIZES``, with a document and a package to deliver; nothing but light tells where."""
        plain = dataclasses.replace(CONFIGS[size], furnishing=FurnishConfig(coloured=False))
        return cls(plain, f"campus-parcels-{size}", PARCELS, PARCELS_FAMILY)

    def build(self, rng: np.random.Generator) -> CampusFloor:
        """A building whose size, outline and style are drawn first."""
        config: CampusConfig = self.config
        width = int(rng.integers(config.long_side[0], config.long_side[1] + 1))
        outlines, weights = zip(*config.outlines_of(width), strict=True)
        outline = outlines[int(rng.choice(len(outlines), p=np.array(weights) / sum(weights)))]
        site = Site(self._draw_height(outline, width, rng), width, config.wing_depth, rng)
        builder = CampusBuilder(self._draw_style(rng), rng, (site.height, site.width))
        return builder.build(outline, draw_wings(outline, site), config.resolution)

    def _draw_height(self, outline: Outline, width: int, rng: np.random.Generator) -> int:
        config: CampusConfig = self.config
        if outline is Outline.BAR:
            return int(rng.integers(config.wing_depth[0], config.wing_depth[1] + 1))
        height = round(width * rng.uniform(*config.aspect))
        return int(np.clip(height, least_height(outline, config.wing_depth[1]), config.largest[0]))

    def _draw_style(self, rng: np.random.Generator) -> CampusStyle:
        config: CampusConfig = self.config
        narrowest = int(rng.integers(config.hallway_width[0], config.hallway_width[1] + 1))
        return dataclasses.replace(
            config.style,
            hallway_width=(narrowest, narrowest + 2),
            row_depth=int(rng.integers(config.row_depth[0], config.row_depth[1] + 1)),
            grain=float(rng.uniform(*config.grain)),
            closed=float(rng.uniform(*config.closed)),
            narrow_door=float(rng.uniform(*config.narrow_door)),
        )
