"""Frontiers by flood fill, centroids in fractions."""

import math
from fractions import Fraction

UNKNOWN, FREE = -1, 0


def frontier_cells(cells, reachable):
    """Set of frontier cells; ``cells`` and ``reachable`` are lists of lists."""
    height, width = len(cells), len(cells[0])

    def unknown(row, column):
        return not (0 <= row < height and 0 <= column < width) or cells[row][column] == UNKNOWN

    return {
        (row, column)
        for row in range(height)
        for column in range(width)
        if cells[row][column] == FREE
        and reachable[row][column]
        and any(unknown(row + dr, column + dc) for dr, dc in ((-1, 0), (1, 0), (0, -1), (0, 1)))
    }


def components(frontier):
    """List of 8-connected sets of cells."""
    left, found = set(frontier), []
    while left:
        queue = [left.pop()]
        component = set(queue)
        while queue:
            row, column = queue.pop()
            around = {(row + dr, column + dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1)} & left
            left -= around
            component |= around
            queue.extend(around)
        found.append(component)
    return found


def nearest_to_centroid(component):
    """The component's cell nearest its centroid, the first in row-major order of equally near ones."""
    row = Fraction(sum(cell[0] for cell in component), len(component))
    column = Fraction(sum(cell[1] for cell in component), len(component))
    return min(sorted(component), key=lambda cell: (cell[0] - row) ** 2 + (cell[1] - column) ** 2)


def find_subgoals(cells, reachable, distance, max_subgoals, min_size):
    """List of (subgoal, component, distance), nearest first, and whether some were left out."""
    found = components(frontier_cells(cells, reachable))
    large = [component for component in found if len(component) >= min_size]
    kept = [(nearest_to_centroid(component), component) for component in (large or found)]
    ordered = sorted((distance[cell[0]][cell[1]], cell, component) for cell, component in kept)
    assert all(not math.isnan(entry[0]) for entry in ordered)
    result = [(cell, component, cost) for cost, cell, component in ordered[:max_subgoals]]
    return result, len(kept) > max_subgoals
