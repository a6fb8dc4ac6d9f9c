"""Outlines of buildings: the wings that they are made of, in the forms that architects build.

A wing is a rectangle with a hallway along it. Wings are listed so that each but the first, or the first two, ends at
wings before it; neighbours share the wall between them. Outlines are drawn lying down, their long side along the
columns and open towards higher rows; builders mirror them.
"""

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from potlp_jax.environments.campus.blocks import Box

LEAST_COURT: int = 14
"""Cells between two wings, at least: 7 m of daylight at half a metre a cell."""


class Outline(enum.StrEnum):
    """The form of a building as seen from above."""

    BAR = "bar"
    L = "L"
    T = "T"
    U = "U"
    H = "H"
    COMB = "comb"
    RING = "ring"
    STEPPED = "stepped"
    BLOCK = "block"


@dataclass(frozen=True)
class Wing:
    """A part of a building.

    Attributes:
        box: its cells, outer walls included.
        turned: whether it runs from top to bottom, so that its hallway is along the columns of ``box.turned``.
        deep: whether it has hallways around a core in place of one in its middle.
    """

    box: Box
    turned: bool = False
    deep: bool = False


@dataclass(frozen=True)
class Site:
    """What outlines are drawn from.

    Attributes:
        height, width: of the rectangle that the building fills; the width is the longer.
        depth: bounds of the depth of wings with one hallway.
        deep: bounds of the depth of those with a core.
        deep_chance: how likely a wing is one of these, where there is space, and nothing has to be joined to it.
        rng: draws everything.
    """

    height: int
    width: int
    depth: tuple[int, int]
    deep: tuple[int, int]
    deep_chance: float
    rng: np.random.Generator

    def draw_depth(self, most: int) -> int:
        """Of a wing, where there is no more space than this."""
        low, high = self.depth
        return int(self.rng.integers(low, max(min(high, most), low) + 1))

    def draw_first_depth(self, most: int) -> tuple[int, bool]:
        """Of a wing that need not be joined to others, and whether it is deep."""
        if self.deep[0] <= most and self.rng.random() < self.deep_chance:
            return int(self.rng.integers(self.deep[0], min(self.deep[1], most) + 1)), True
        return self.draw_depth(most), False

    def row(self, top: int, bottom: int, left: int = 0, right: int | None = None, *, deep: bool = False) -> Wing:
        """A wing that runs from left to right, its hallway along the rows.

        Args:
            top, bottom: its first row and the one after its last, outer walls included.
            left, right: its first column and the one after its last; by default it is as wide as the site.
            deep: whether it has two hallways around a core, which takes ``LEAST_DEEP`` rows or more.

        Returns:
            The wing; nothing is drawn from ``rng``.
        """
        return Wing(Box(top, bottom, left, self.width if right is None else right), deep=deep)

    def column(self, left: int, right: int, top: int, bottom: int | None = None) -> Wing:
        """A wing that runs from top to bottom, with one hallway along the columns.

        Args:
            left, right: its first column and the one after its last, outer walls included.
            top, bottom: its first row and the one after its last; by default it ends where the site does.

        Returns:
            The wing; nothing is drawn from ``rng``.
        """
        return Wing(Box(top, self.height if bottom is None else bottom, left, right), turned=True)


LEAST_DEEP: int = 40
"""Depth of a wing with two hallways, at least: 20 m."""

_NEEDED: Mapping[Outline, tuple[tuple[int, int], tuple[int, int]]] = MappingProxyType(
    {
        Outline.BAR: ((1, 0), (1, 0)),
        Outline.BLOCK: ((1, 0), (1, 0)),
        Outline.L: ((1, 1), (1, 1)),
        Outline.T: ((1, 1), (1, 1)),
        Outline.U: ((1, 1), (2, 1)),
        Outline.COMB: ((1, 1), (3, 2)),
        Outline.H: ((1, 2), (2, 1)),
        Outline.RING: ((2, 1), (2, 1)),
        Outline.STEPPED: ((2, 1), (3, 0)),
    }
)
"""Wings and courts from the first row to the last, and from the first column to the last."""


def least_height(outline: Outline, deepest: int) -> int:
    """Rows that a building of this outline has at least, where no wing with one hallway is deeper than this."""
    return max(_least(_NEEDED[outline][0], deepest), LEAST_DEEP if outline is Outline.BLOCK else 0)


def least_width(outline: Outline, deepest: int) -> int:
    """Columns that a building of this outline has at least."""
    return _least(_NEEDED[outline][1], deepest)


def _least(needed: tuple[int, int], deepest: int) -> int:
    wings, courts = needed
    return wings * deepest + courts * LEAST_COURT


def draw_wings(outline: Outline, site: Site) -> tuple[Wing, ...]:
    """Wings of a building that fills the site.

    Args:
        outline: its form.
        site: not smaller than ``least_height`` and ``least_width`` say.

    Returns:
        The wings, which touch all four sides of the site.
    """
    return _OUTLINES[outline](site)


def _bar(site: Site) -> tuple[Wing, ...]:
    return (site.row(0, site.height),)


def _block(site: Site) -> tuple[Wing, ...]:
    return (site.row(0, site.height, deep=True),)


def _l(site: Site) -> tuple[Wing, ...]:
    return _with_legs(site, [0.0])


def _t(site: Site) -> tuple[Wing, ...]:
    return _with_legs(site, [float(site.rng.uniform(0.25, 0.75))])


def _u(site: Site) -> tuple[Wing, ...]:
    return _with_legs(site, [0.0, 1.0])


def _comb(site: Site) -> tuple[Wing, ...]:
    most = (site.width + LEAST_COURT) // (site.depth[1] + LEAST_COURT)
    count = int(site.rng.integers(3, max(min(most, 6), 3) + 1))
    return _with_legs(site, list(np.linspace(0, 1, count)), regular=True)


def _with_legs(site: Site, places: list[float], *, regular: bool = False) -> tuple[Wing, ...]:
    """A wing along the site and others that stand on it, at these shares of its length; equally long if ``regular``."""
    main, deep = site.draw_first_depth(site.height - LEAST_COURT)
    wings = [site.row(0, main, deep=deep)]
    longest = int(site.rng.integers(len(places)))
    for number, place in enumerate(places):
        # No leg is wider than what there is for each: the courts between them stay.
        wide = site.draw_depth((site.width - LEAST_COURT * (len(places) - 1)) // len(places))
        left = round(place * (site.width - wide))
        # One leg reaches the site's end, others may be shorter, as long as they are wings at all.
        least = main + LEAST_COURT
        short = regular or number == longest or least >= site.height
        bottom = site.height if short else int(site.rng.integers(least, site.height + 1))
        # Wings share a wall: that of the main wing is the first row of the leg.
        wings.append(site.column(left, left + wide, main - 1, bottom))
    return tuple(wings)


def _h(site: Site) -> tuple[Wing, ...]:
    first, last = (site.draw_depth(site.width // 2 - LEAST_COURT) for _ in range(2))
    deep = site.draw_depth(site.height - 2 * LEAST_COURT)
    top = int(site.rng.integers(0, site.height - deep + 1))
    bar = site.row(top, top + deep, first - 1, site.width - last + 1)
    return site.column(0, first, 0), site.column(site.width - last, site.width, 0), bar


def _ring(site: Site) -> tuple[Wing, ...]:
    above, deep = site.draw_first_depth((site.height - LEAST_COURT) // 2)
    below = site.draw_depth((site.height - LEAST_COURT) // 2)
    first, last = (site.draw_depth((site.width - LEAST_COURT) // 2) for _ in range(2))
    sides = [site.column(0, first, above - 1, site.height - below + 1)]
    sides.append(site.column(site.width - last, site.width, above - 1, site.height - below + 1))
    # A long ring has a wing across its courtyard.
    inner = site.width - first - last
    if inner >= site.depth[1] + 4 * LEAST_COURT and site.rng.random() < 0.5:
        wide = site.draw_depth(site.depth[1])
        left = first + int((inner - wide) * site.rng.uniform(0.3, 0.7))
        sides.append(site.column(left, left + wide, above - 1, site.height - below + 1))
    return site.row(0, above, deep=deep), site.row(site.height - below, site.height), *sides


def _stepped(site: Site) -> tuple[Wing, ...]:
    """Two parallel wings that overlap by the width of a third, which joins them."""
    above, below = (site.draw_depth((site.height - LEAST_COURT) // 2) for _ in range(2))
    wide = site.draw_depth(site.width // 3)
    left = int((site.width - wide) * site.rng.uniform(0.3, 0.6))
    return (
        site.row(0, above, 0, left + wide),
        site.row(site.height - below, site.height, left, site.width),
        site.column(left, left + wide, above - 1, site.height - below + 1),
    )


_OUTLINES: Mapping[Outline, Callable[[Site], tuple[Wing, ...]]] = MappingProxyType(
    {
        Outline.BAR: _bar,
        Outline.BLOCK: _block,
        Outline.L: _l,
        Outline.T: _t,
        Outline.U: _u,
        Outline.H: _h,
        Outline.COMB: _comb,
        Outline.RING: _ring,
        Outline.STEPPED: _stepped,
    }
)
