"""Line of sight, one line and one cell at a time."""

import math

NEIGHBOURS = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if (row, column) != (0, 0)]


def visible(occupied, cell, range_cells):
    """Set of seen cells; ``occupied`` is a list of lists of bool."""
    height, width = len(occupied), len(occupied[0])
    half = max(1, math.ceil(range_cells))
    perimeter = [
        (row, column)
        for row in range(-half, half + 1)
        for column in range(-half, half + 1)
        if max(abs(row), abs(column)) == half
    ]

    def blocked(row, column):
        return not (0 <= row < height and 0 <= column < width) or occupied[row][column]

    seen_free = {tuple(cell)} - {at for at in [tuple(cell)] if blocked(*at)}
    for target in perimeter:
        row, column = cell
        for next_row, next_column in bresenham(target):
            next_row, next_column = cell[0] + next_row, cell[1] + next_column
            if math.hypot(next_row - cell[0], next_column - cell[1]) > range_cells or blocked(next_row, next_column):
                break
            diagonal = next_row != row and next_column != column
            if diagonal and blocked(next_row, column) and blocked(row, next_column):
                break
            row, column = next_row, next_column
            seen_free.add((row, column))
    seen = {tuple(cell)}
    for row_step, column_step in NEIGHBOURS:
        row, column = cell[0] + row_step, cell[1] + column_step
        if 0 <= row < height and 0 <= column < width:
            seen.add((row, column))
            if not occupied[row][column]:
                seen_free.add((row, column))
    for row, column in seen_free:
        for row_step, column_step in NEIGHBOURS:
            beside = (row + row_step, column + column_step)
            if 0 <= beside[0] < height and 0 <= beside[1] < width and occupied[beside[0]][beside[1]]:
                seen.add(beside)
    return seen | seen_free


def bresenham(target):
    """Offsets of the cells from (0, 0), itself excluded, to ``target``, by the classical running error."""
    rows, columns = abs(target[0]), abs(target[1])
    row_sign, column_sign = (1 if target[0] >= 0 else -1), (1 if target[1] >= 0 else -1)
    steep = rows >= columns
    long, short = (rows, columns) if steep else (columns, rows)
    cells, across, error = [], 0, 0
    for along in range(1, long + 1):
        error += 2 * short
        if error >= long:
            across += 1
            error -= 2 * long
        row, column = (along, across) if steep else (across, along)
        cells.append((row_sign * row, column_sign * column))
    return cells
