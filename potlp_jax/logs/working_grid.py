"""The final map of a log on the planner's cells, and when each of them was first known.

A working cell of several pixels is free where all its pixels are, after obstacles were grown by the robot's radius, and
known where all its pixels are. It is an obstacle where an obstacle's pixel, grown, lies in it, and known once one of
those is.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from jaxtyping import Bool, Int32, Shaped
from scipy import ndimage

from potlp_jax.environments.ros.cleaning import inflate, resample
from potlp_jax.environments.ros.grid_frame import BOUNDARY_DECIMALS, GridFrame
from potlp_jax.errors import LogError
from potlp_jax.logs.log import Log, MapMessage

RESOLUTION = 0.2
"""Metres a cell, unless the map is coarser or another is asked for: as for ``map:`` worlds."""

NEVER = np.iinfo(np.int32).max
"""Number of the map that first shows a cell which none does."""


@dataclass(frozen=True)
class GridConfig:
    """The planner's grid: metres a cell (None: 0.2, or the map's where that is coarser), and the robot's radius, by
    which obstacles grow."""

    resolution: float | None = None
    radius: float = 0.1

    def __post_init__(self) -> None:
        numbers = [self.radius] if self.resolution is None else [self.radius, self.resolution]
        if not all(math.isfinite(number) and number >= 0 for number in numbers) or self.resolution == 0:
            raise LogError(f"resolution and radius are metres, the resolution above 0, found {self}")


class WorkingGrid:
    """The final map on working cells, and how earlier maps are laid on it.

    ``free`` and ``obstacle`` exclude each other; cells that are neither were never seen.
    """

    def __init__(self, final: MapMessage, log: Log, config: GridConfig) -> None:
        self._final, self._log = final, log
        # Fractions, so that 0.2 m are four pixels of 0.05 m and not 3.9999.
        pixel = Fraction(str(final.frame.resolution))
        wanted = (
            max(Fraction(str(RESOLUTION)), pixel) if config.resolution is None else Fraction(str(config.resolution))
        )
        if wanted < pixel:
            raise LogError(
                f"{log.path}: cells of {float(wanted):g} m are finer than the map's, {float(pixel):g} m: give a larger "
                "--resolution"
            )
        self._ratio, self._radius = wanted / pixel, Fraction(str(config.radius)) / pixel
        # As many pixels as whole cells take, and enough that nothing from beyond the map grows into it.
        self._margin = self._ratio.numerator * math.ceil((self._radius + 1) / self._ratio.numerator)
        self._free_pixels, self._obstacle_pixels = final.free(log.config), final.obstacles(log.config)
        # Free is free in all pixels, an obstacle is one in any: in doubt a robot stays away.
        free = ~self._cells(self._grown(~self._free_pixels, beyond=True), np.logical_or, beyond=True)
        obstacle = self._cells(self._grown(self._obstacle_pixels, beyond=False), np.logical_or, beyond=False)
        height, width = free.shape
        frame = GridFrame(height, width, float(wanted), final.frame.x, final.frame.y, final.frame.yaw)
        # Outside of a grid is unobserved: its edge would be a frontier for ever.
        self._ring = bool(free[0].any() or free[-1].any() or free[:, 0].any() or free[:, -1].any())
        # The ring is put on only where free cells touch the edge: most maps have a margin of their own.
        self.frame = frame.window(-1, -1, frame.height + 2, frame.width + 2) if self._ring else frame
        self.free, self.obstacle = self._ringed(free, False), self._ringed(obstacle & ~free, False)
        if not self.free.any():
            raise LogError(
                f"{log.path}: nothing is left free with cells of {float(wanted):g} m and a radius of "
                f"{config.radius:g} m; make them smaller"
            )

    @property
    def seen(self) -> Bool[np.ndarray, "H W"]:
        """What the final map knows."""
        return self.free | self.obstacle

    def first_known(self, maps: Iterable[MapMessage]) -> tuple[Int32[np.ndarray, "H W"], list[MapMessage], float]:
        """Number of the first map that shows each cell (``NEVER``: none does), and the maps without their pixels.

        Third, the largest share of a map's known pixels that the final map shows otherwise.
        """
        first = np.full(self._free_pixels.shape, NEVER, np.int32)
        heads: list[MapMessage] = []
        most = 0.0
        for number, earlier in enumerate(maps):
            free = self._on_final(earlier.free(self._log.config), earlier)
            obstacles = self._on_final(earlier.obstacles(self._log.config), earlier)
            # The first map that shows a pixel counts, whatever it says: the value is the final map's.
            known = free | obstacles
            first[known & (first == NEVER)] = number
            changed = (free & self._obstacle_pixels) | (obstacles & self._free_pixels)
            most = max(most, float(changed.sum() / max(known.sum(), 1)))
            # Without pixels, which nobody needs any more: there may be thousands of maps.
            heads.append(replace(earlier, occupancy=earlier.occupancy[:0]))
        # A free cell is known once all its pixels are, an obstacle once one of its own is: hence the latest map and the
        # earliest one.
        as_free = self._cells(np.pad(first, self._margin, constant_values=NEVER), np.maximum, beyond=NEVER)
        # Obstacles are grown by the robot's radius, so a cell may be blocked by a pixel beside it.
        walls = np.where(self._obstacle_pixels, first, NEVER)
        near = ndimage.minimum_filter(
            np.pad(walls, self._margin, constant_values=NEVER), footprint=self._disc(), mode="nearest"
        )
        as_obstacle = self._cells(near, np.minimum, beyond=NEVER)
        known_at = np.where(self.free, self._ringed(as_free, NEVER), self._ringed(as_obstacle, NEVER))
        return np.where(self.seen, known_at, NEVER).astype(np.int32), heads, most

    def _disc(self) -> Bool[np.ndarray, "side side"]:
        """The pixels within the robot's radius of a pixel."""
        # In whole pixels, as ``inflate`` grows obstacles.
        reach = int(self._radius)
        offset = np.arange(-reach, reach + 1)
        return offset[:, None] ** 2 + offset[None, :] ** 2 <= int(self._radius * self._radius)

    def _grown(self, pixels: Bool[np.ndarray, "h w"], beyond: bool) -> Bool[np.ndarray, "h2 w2"]:
        """With a margin around the map, all within the robot's radius of the pixels."""
        return inflate(np.pad(pixels, self._margin, constant_values=beyond), self._radius)

    def _cells(
        self, pixels: Shaped[np.ndarray, "h2 w2"], reduce: np.ufunc, beyond: bool | int
    ) -> Shaped[np.ndarray, "H W"]:
        """Working cells of the map, from pixels with its margin."""
        # Cells are counted from the lower left corner of the map, where its origin is: hence from the end of the rows.
        coarse = resample(pixels, self._ratio, reduce, beyond)
        margin = int(self._margin / self._ratio)
        height, width = (int(-(-size // self._ratio)) for size in self._free_pixels.shape)
        return coarse[len(coarse) - margin - height : len(coarse) - margin, margin : margin + width]

    def _on_final(self, pixels: Bool[np.ndarray, "h w"], earlier: MapMessage) -> Bool[np.ndarray, "H W"]:
        """Pixels of an earlier map, at the centres of the final map's pixels."""
        mine, its = self._final.frame, earlier.frame
        # Mapping moves the origin of a growing map, but never turns it.
        if abs(math.remainder(mine.yaw - its.yaw, 2 * math.pi)) > 1e-6:
            raise LogError(
                f"{self._log.path}: {self._log.map_topic}: the maps are turned against each other, by {its.yaw:g} and "
                f"{mine.yaw:g} radians: give a log of one mapping session"
            )
        if earlier.frame_id != self._final.frame_id:
            raise LogError(
                f"{self._log.path}: {self._log.map_topic}: the maps are in several frames, {earlier.frame_id!r} and "
                f"{self._final.frame_id!r}: choose a topic with one, --map-topic"
            )
        across, up = its.to_grid(np.array([mine.cell_to_metres(mine.height - 1, 0)]))[0]
        scale = mine.resolution / its.resolution
        # Rounded first: a centre that falls on a boundary by construction must not fall beside it by float.
        columns = np.floor(np.round(across + scale * np.arange(mine.width), BOUNDARY_DECIMALS)).astype(int)
        from_below = np.floor(np.round(up + scale * np.arange(mine.height), BOUNDARY_DECIMALS)).astype(int)
        rows = its.height - 1 - from_below[::-1]
        inside = ((rows >= 0) & (rows < its.height))[:, None] & ((columns >= 0) & (columns < its.width))[None, :]
        taken = pixels[np.clip(rows, 0, its.height - 1)][:, np.clip(columns, 0, its.width - 1)]
        return taken & inside

    def _ringed(self, cells: Shaped[np.ndarray, "h w"], beyond: bool | int) -> Shaped[np.ndarray, "H W"]:
        return np.pad(cells, 1, constant_values=beyond) if self._ring else cells
