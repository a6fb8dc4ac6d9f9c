"""Slow and obvious true labels of docs/model.md section 6: Dijkstra over (cell, phase) of an allowed path."""

import math

from tests.reference.dijkstra import dijkstra, grid_moves


def true_label(free, letters, observed, frontier, own_frontier, cell, stay, go):
    """(P_S, R_S, R_F) in cells of one subgoal and class; ``stay`` and ``go`` are sets of letters.

    A path moves on the subgoal's own frontier and the known cells beside it ("porch"), then in unobserved cells, then
    perhaps through a foreign frontier in observed space.
    """
    height, width = len(free), len(free[0])
    porch = {
        (i + di, j + dj)
        for i in range(height)
        for j in range(width)
        if own_frontier[i][j]
        for di in (-1, 0, 1)
        for dj in (-1, 0, 1)
        if 0 <= i + di < height and 0 <= j + dj < width and observed[i + di][j + dj]
    }

    def phase_after(phase, following):
        i, j = following
        if not observed[i][j]:
            return "hidden" if phase in ("porch", "hidden") else None
        if phase == "porch":
            return "porch" if following in porch else None
        if own_frontier[i][j]:
            return None
        if phase == "hidden":
            return "seen" if frontier[i][j] else None
        return "seen"

    def moves(node):
        here, phase = node
        if phase == "done":
            return
        for following, step in grid_moves(free, here):
            i, j = following
            next_phase = phase_after(phase, following) if free[i][j] else None
            if next_phase is None:
                continue
            if letters[i][j] in go and next_phase != "porch":
                yield (following, "done"), step
            elif letters[i][j] in stay:
                yield (following, next_phase), step

    costs = dijkstra((tuple(cell), "porch"), moves)
    success = min((cost for (_, phase), cost in costs.items() if phase == "done"), default=math.inf)
    farthest = max((cost for (_, phase), cost in costs.items() if phase == "hidden"), default=0.0)
    return (1.0, success, farthest) if math.isfinite(success) else (0.0, None, farthest)
