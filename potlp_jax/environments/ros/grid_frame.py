"""Where a grid of cells lies in the world: metres to cells and back."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

BOUNDARY_DECIMALS = 6
"""Cell coordinates are rounded to so many decimals: a point on a cell's edge stays there in spite of floating point."""


@dataclass(frozen=True)
class GridFrame:
    """Where a grid lies in the world: the pose of its lower left corner, in metres and radians.

    Rows count from the top, so a cell ``(row, col)`` has ``height - 1 - row`` rows of cells below it. ``yaw`` turns the
    grid counter-clockwise about its lower left corner.
    """

    height: int
    width: int
    resolution: float
    x: float
    y: float
    yaw: float = 0.0

    def to_grid(self, points: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Metres (x, y) to cells from the lower left corner: along the grid's columns and, upwards, its rows."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        # The inverse turn: into the grid's own axes.
        shifted = points - np.array([[self.x, self.y]])
        along = shifted @ np.array([[cos, -sin], [sin, cos]])
        return np.round(along / self.resolution, BOUNDARY_DECIMALS)

    def metres_to_cell(self, x: float | int, y: float | int) -> tuple[int, int]:
        """Cell (row, col) that holds a point; outside of the grid where the point is (see `contains`).

        A point on an edge belongs to the cell of larger x and larger y (of the grid's own axes).
        """
        # To the cell of larger y means to the lower row number: rows count from the top.
        across, up = self.to_grid(np.array([[x, y]], dtype=np.float64))[0]
        return self.height - 1 - math.floor(up), math.floor(across)

    def cell_to_metres(self, row: int, col: int) -> tuple[float, float]:
        """Centre of a cell in metres (x, y)."""
        return self._corner_to_metres(col + 0.5, self.height - 1 - row + 0.5)

    def contains(self, row: int, col: int) -> bool:
        """Whether (row, col) is a cell of the grid."""
        return 0 <= row < self.height and 0 <= col < self.width

    def window(self, top: int, left: int, height: int, width: int) -> "GridFrame":
        """Frame of a part of the grid; it may reach beyond it.

        Args:
            top, left: first row and first column.
            height, width: rows and columns.

        Returns:
            The same axes and size of cells, with the lower left corner of the part.
        """
        # Of the window's lower left corner, as that of every frame is given.
        x, y = self._corner_to_metres(left, self.height - top - height)
        return GridFrame(height, width, self.resolution, x, y, self.yaw)

    def _corner_to_metres(self, across: float | int, up: float | int) -> tuple[float, float]:
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        right, above = across * self.resolution, up * self.resolution
        return self.x + cos * right - sin * above, self.y + sin * right + cos * above
