"""Floors of campus buildings of all sizes that real ones have, up to 224 m long: the families ``campus-...``.

A building has one of the outlines of ``outlines``, rooms as wide as its style says, and whatever ``campus_builder``
draws beside them. People, light and colours are those of the ``delivery`` floors, so that the same tasks are set here
and an estimator of one knows what it sees in the other.

Arrays of a family have one shape, and what a decision costs grows with it whatever the building's size. So there are
three families, each with arrays that fit its buildings: small, medium and large. docs/delivery.md says what they cost.

All lengths are in cells of ``CampusConfig.resolution`` metres; costs are in metres.
"""

import dataclasses

import numpy as np

from potlp_jax.checks import require_rules
from potlp_jax.environments.campus.campus_builder import CampusBuilder, CampusFloor, CampusStyle
from potlp_jax.environments.campus.delivery import DELIVERY_FAMILY, PARCELS_FAMILY
from potlp_jax.environments.campus.floor_generator import FloorGenerator
from potlp_jax.environments.campus.furnishing import NARROW_DOORS, PARCELS, PEOPLE, Errand, FurnishConfig
from potlp_jax.environments.campus.outlines import LEAST_DEEP, Outline, Site, draw_wings, least_height, least_width
from potlp_jax.errors import WorldError

_DEPARTMENTS = (1.0, 0.5, 1.6, 0.5)
"""Of the Dirichlet distribution from which a building's departments are drawn: most have one or two kinds of them."""


@dataclasses.dataclass(frozen=True)
class CampusConfig:
    """Sizes in cells. Bounds are of what is drawn once a building, uniformly.

    Attributes:
        long_side: bounds of the building's longer side, outer walls included.
        largest: rows and columns of the arrays.
        aspect: bounds of the shorter side, as a share of the longer; more where the outline needs it.
        wing_depth: bounds, drawn once a wing that has one hallway.
        deep_wing, deep_chance: bounds of the depth of wings with hallways around a core, and how likely they are.
        outlines: how often each is drawn, relative to the others that the building is large enough for.
        grain, row_depth: bounds of what ``CampusStyle`` says.
        hallway_width: bounds of the width of its narrowest hallway; others are up to two cells wider.
        closed, narrow_door, joining_door: bounds of what ``CampusStyle`` says.
        style: what is the same in all buildings; what has bounds here is replaced.
        resolution: side of a cell in metres.
        furnishing: people, light and colours.
    """

    long_side: tuple[int, int]
    largest: tuple[int, int]
    outlines: tuple[tuple[Outline, float], ...]
    aspect: tuple[float, float] = (0.3, 0.9)
    wing_depth: tuple[int, int] = (26, 52)
    deep_wing: tuple[int, int] = (56, 90)
    deep_chance: float = 0.45
    grain: tuple[float, float] = (1.3, 2.8)
    row_depth: tuple[int, int] = (16, 26)
    hallway_width: tuple[int, int] = (4, 6)
    closed: tuple[float, float] = (0.0, 0.15)
    narrow_door: tuple[float, float] = (0.0, 0.8)
    joining_door: tuple[float, float] = (0.0, 0.2)
    style: CampusStyle = CampusStyle()
    resolution: float = 0.5
    furnishing: FurnishConfig = FurnishConfig()

    def __post_init__(self) -> None:
        deepest = self.wing_depth[1]
        drawn = (self.long_side, self.aspect, self.wing_depth, self.grain, self.row_depth)
        chances = (self.closed, self.narrow_door, self.joining_door)
        drawn += (self.hallway_width, *chances)
        rules = (
            (all(0 <= low <= high for low, high in drawn), "bounds must not be negative, and be in increasing order"),
            (self.long_side[0] >= 40, "long_side must be at least 40"),
            (self.wing_depth[0] >= 18, "wing_depth must be at least 18"),
            (self.deep_wing[0] >= LEAST_DEEP, f"deep_wing must be at least {LEAST_DEEP}"),
            (self.row_depth[0] >= 10, "row_depth must be at least 10"),
            (self.hallway_width[0] >= 1 and self.hallway_width[1] <= 6, "hallway_width must lie in 1 to 6"),
            (all(high <= 1 for _, high in (self.aspect, *chances)), "a share must not exceed 1"),
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
        require_rules(rules, "a campus building", WorldError)

    def outlines_of(self, width: int) -> tuple[tuple[Outline, float], ...]:
        """The outlines for which a building of so many columns is large enough."""
        return tuple((outline, weight) for outline, weight in self.outlines if self._fits(outline, width))

    def _fits(self, outline: Outline, width: int) -> bool:
        return least_width(outline, self.wing_depth[1]) <= width


SMALL: CampusConfig = CampusConfig(
    long_side=(48, 128),
    largest=(96, 128),
    wing_depth=(22, 44),
    outlines=(
        (Outline.BAR, 0.3),
        (Outline.BLOCK, 0.3),
        (Outline.L, 0.2),
        (Outline.T, 0.1),
        (Outline.U, 0.15),
        (Outline.H, 0.05),
    ),
)
MEDIUM: CampusConfig = CampusConfig(
    long_side=(128, 256),
    largest=(160, 256),
    aspect=(0.3, 0.75),
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
LARGE: CampusConfig = CampusConfig(
    long_side=(256, 448),
    largest=(224, 448),
    aspect=(0.15, 0.45),
    deep_chance=0.3,
    grain=(1.6, 3.4),
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


class Campus(FloorGenerator):
    """Generator of campus buildings of one size, with people to find, or parcels to deliver."""

    settings = NARROW_DOORS

    def __init__(self, config: CampusConfig, name: str, errand: Errand = PEOPLE, family: str = DELIVERY_FAMILY) -> None:
        """Of this configuration.

        Args:
            config: sizes and chances.
            name: the family's; it goes into the keys of its worlds.
            errand: who is to be found, and where they can be.
            family: whose worlds these look like, to an estimator.
        """
        super().__init__(config, config.largest, config.furnishing, name, errand)
        self.family = family

    @classmethod
    def small(cls) -> "Campus":
        """Buildings 24 to 64 m long."""
        return cls(SMALL, "campus-small")

    @classmethod
    def medium(cls) -> "Campus":
        """Buildings 64 to 128 m long."""
        return cls(MEDIUM, "campus-medium")

    @classmethod
    def large(cls) -> "Campus":
        """Buildings 128 to 224 m long."""
        return cls(LARGE, "campus-large")

    @classmethod
    def small_parcels(cls) -> "Campus":
        """Small buildings with a document and a package to deliver in two rooms, which nothing but light tells."""
        return cls(_grey(SMALL), "campus-small-parcels", PARCELS, PARCELS_FAMILY)

    @classmethod
    def medium_parcels(cls) -> "Campus":
        """The same in medium buildings."""
        return cls(_grey(MEDIUM), "campus-medium-parcels", PARCELS, PARCELS_FAMILY)

    @classmethod
    def large_parcels(cls) -> "Campus":
        """The same in large buildings."""
        return cls(_grey(LARGE), "campus-large-parcels", PARCELS, PARCELS_FAMILY)

    def build(self, rng: np.random.Generator) -> CampusFloor:
        """A building whose size, outline and style are drawn first."""
        config: CampusConfig = self.config
        width = int(rng.integers(config.long_side[0], config.long_side[1] + 1))
        outlines, weights = zip(*config.outlines_of(width), strict=True)
        outline = outlines[int(rng.choice(len(outlines), p=np.array(weights) / sum(weights)))]
        style = self._draw_style(rng)
        # As deep as two rows of rooms and their hallway, at most: deeper ones have two hallways.
        deepest = min(config.wing_depth[1], 2 * style.row_depth + style.hallway_width[0])
        depth = min(config.wing_depth[0], deepest), deepest
        height = self._draw_height(outline, width, depth, rng)
        site = Site(height, width, depth, config.deep_wing, config.deep_chance, rng)
        builder = CampusBuilder(style, rng, (height, width))
        return builder.build(outline, draw_wings(outline, site), config.resolution)

    def _draw_height(self, outline: Outline, width: int, depth: tuple[int, int], rng: np.random.Generator) -> int:
        config: CampusConfig = self.config
        if outline is Outline.BAR:
            return int(rng.integers(depth[0], depth[1] + 1))
        height = round(width * rng.uniform(*config.aspect))
        return int(np.clip(height, least_height(outline, depth[1]), config.largest[0]))

    def _draw_style(self, rng: np.random.Generator) -> CampusStyle:
        config: CampusConfig = self.config
        narrowest = int(rng.integers(config.hallway_width[0], config.hallway_width[1] + 1))
        return dataclasses.replace(
            config.style,
            hallway_width=(narrowest, narrowest + 2),
            row_depth=int(rng.integers(config.row_depth[0], config.row_depth[1] + 1)),
            departments=tuple(rng.dirichlet(_DEPARTMENTS).tolist()),
            grain=float(rng.uniform(*config.grain)),
            closed=float(rng.uniform(*config.closed)),
            narrow_door=float(rng.uniform(*config.narrow_door)),
            joining_door=float(rng.uniform(*config.joining_door)),
        )


def _grey(config: CampusConfig) -> CampusConfig:
    """The same buildings, in which all rooms look alike."""
    return dataclasses.replace(config, furnishing=dataclasses.replace(config.furnishing, coloured=False))
