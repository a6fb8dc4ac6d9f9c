"""Poses on a grid, of a log or of a robot that is driven: which cell a pose counts for, and what lies between two."""

import heapq
import math

import numpy as np
from jaxtyping import Bool

from potlp_jax.world.moves import Cell, legal_moves

FARTHEST_SNAP: float = 2.0
"""Cells, beyond the robot's radius, from the nearest free cell at which a pose still counts as being in it."""


def shortest(free: Bool[np.ndarray, "H W"], start: Cell, goal: Cell) -> list[Cell]:
    """Cells of a shortest path, the start left out.

    Args:
        free: True where the robot may be.
        start, goal: free cells.

    Returns:
        The cells in order, the goal last.

    Raises:
        KeyError: the ends are not in one component.
    """
    # A* with the straight distance, which never exceeds the length of a path.
    best, came_from = {start: 0.0}, {}
    queue = [(0.0, start)]
    while queue:
        _, cell = heapq.heappop(queue)
        if cell == goal:
            break
        for there, length in legal_moves(free, cell):
            cost = best[cell] + length
            if cost < best.get(there, math.inf):
                best[there], came_from[there] = cost, cell
                heapq.heappush(queue, (cost + math.dist(there, goal), there))
    path = [goal]
    while path[-1] != start:
        path.append(came_from[path[-1]])
    return path[-2::-1]
