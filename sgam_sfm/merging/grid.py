"""Points sorted into the cells of a grid, to find those near a place."""

from __future__ import annotations

import numpy as np

from sgam_sfm.merging.compiled import compiled


@compiled
def grid_of(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sort points (N, 2) into cells no smaller than `cell` and no more than about N.

    Returns: frame (5,): origin x and y, width of a cell, columns, rows. start (cells + 1,) and order (N,): the points
        of cell c, `column * rows + row`, are order[start[c]:start[c + 1]].
    """
    count = len(points)
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for row in range(count):
        low_x, high_x = min(low_x, points[row, 0]), max(high_x, points[row, 0])
        low_y, high_y = min(low_y, points[row, 1]), max(high_y, points[row, 1])
    if count == 0:
        low_x = low_y = high_x = high_y = 0.0
    width = max(cell, np.sqrt((high_x - low_x) * (high_y - low_y) / max(count, 1)), 1e-9)
    width = max(width, (high_x - low_x + high_y - low_y) / (count + 1))  # points on a line
    columns, rows = int((high_x - low_x) / width) + 1, int((high_y - low_y) / width) + 1
    frame = np.array([low_x, low_y, width, columns, rows], np.float64)
    cells = np.empty(count, np.int64)
    start = np.zeros(columns * rows + 1, np.int64)
    for row in range(count):
        column, line = int((points[row, 0] - low_x) / width), int((points[row, 1] - low_y) / width)
        cells[row] = min(column, columns - 1) * rows + min(line, rows - 1)
        start[cells[row] + 1] += 1
    for number in range(columns * rows):
        start[number + 1] += start[number]
    place = start[:-1].copy()
    order = np.empty(count, np.int64)
    for row in range(count):
        order[place[cells[row]]] = row
        place[cells[row]] += 1
    return frame, start, order


@compiled
def cells_around(frame: np.ndarray, x: float, y: float, radius: float) -> tuple[int, int, int, int]:
    """The columns from and to and the rows from and to, ends left out, of the cells within a radius of a place."""
    columns, rows = int(frame[3]), int(frame[4])
    left, top = (x - radius - frame[0]) / frame[2], (y - radius - frame[1]) / frame[2]
    right, bottom = (x + radius - frame[0]) / frame[2], (y + radius - frame[1]) / frame[2]
    return (
        int(min(max(left, 0.0), columns)),
        int(min(max(right + 1, 0.0), columns)),
        int(min(max(top, 0.0), rows)),
        int(min(max(bottom + 1, 0.0), rows)),
    )


@compiled
def nearest(
    points: np.ndarray, frame: np.ndarray, start: np.ndarray, order: np.ndarray, x: float, y: float, radius: float
) -> int:
    """The point of a grid that is nearest to a place and within a radius of it, -1 for none; the first of several."""
    found, best = -1, radius * radius
    left, right, top, bottom = cells_around(frame, x, y, radius)
    rows = int(frame[4])
    for column in range(left, right):
        for place in range(start[column * rows + top], start[column * rows + bottom]):
            other = order[place]
            squared = (points[other, 0] - x) ** 2 + (points[other, 1] - y) ** 2
            if squared < best or (squared == best and (found < 0 or other < found)):
                found, best = other, squared
    return found
