"""Slow and obvious: Dijkstra with a heap on the product of a grid and an automaton given as plain lists."""

import heapq
import math
from collections.abc import Callable

MOVES = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]


def grid_moves(free, cell):
    """Neighbours of a cell and the cost of going there; no corner is cut."""
    row, column = cell
    for di, dj in MOVES:
        i, j = row + di, column + dj
        if not (0 <= i < len(free) and 0 <= j < len(free[0])):
            continue
        if di and dj and not (free[row][j] and free[i][column]):
            continue
        yield (i, j), math.sqrt(2.0) if di and dj else 1.0


def dijkstra(source, moves: Callable):
    """Costs of all nodes reachable from ``source``; ``moves(node)`` yields (node, cost)."""
    best = {}
    queue = [(0.0, source)]
    while queue:
        cost, node = heapq.heappop(queue)
        if node in best:
            continue
        best[node] = cost
        for following, step in moves(node):
            if following not in best:
                heapq.heappush(queue, (cost + step, following))
    return best


def product_distances(free, letters, transitions, trap, source_cell, source_state):
    """Costs of all product states reachable from (cell, state); traps and obstacles are never entered."""

    def moves(node):
        cell, state = node
        for following, step in grid_moves(free, cell):
            if not free[following[0]][following[1]]:
                continue
            next_state = int(transitions[state][letters[following[0]][following[1]]])
            if not trap[next_state]:
                yield (following, next_state), step

    return dijkstra((tuple(source_cell), int(source_state)), moves)


def optimistic_distances(free, unknown, letters, transitions, trap, source_cell, source_state):
    """As above where an unknown cell is free and carries any letter, or keeps the state."""
    states = range(len(transitions))
    passable = [[f or u for f, u in zip(*rows, strict=True)] for rows in zip(free, unknown, strict=True)]

    def moves(node):
        cell, state = node
        for following, step in grid_moves(passable, cell):
            row, column = following
            if unknown[row][column]:
                reached = {int(z) for z in transitions[state]} | {state}
            elif free[row][column]:
                reached = {int(transitions[state][letters[row][column]])}
            else:
                reached = set()
            for next_state in states:
                if next_state in reached and not trap[next_state]:
                    yield (following, next_state), step

    return dijkstra((tuple(source_cell), int(source_state)), moves)
