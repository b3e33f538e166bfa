"""How a small step in one image continues in the other, from the matches around."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from sgam_sfm.merging.compiled import compiled

_A_CELL = 2.0  # matches that a cell has on average; its map is fitted to those of the cells around as well
_ROUNDS = 2  # of reweighting: more change nothing
_PULL = 0.25  # matches that the map of the whole pair counts for in that of a cell
_LEAST_SPREAD = 0.01  # of a cell's size, squared: matches on one spot tell no map
_MOMENTS = 12


def local_affine(
    points0: Float[np.ndarray, "M 2"], points1: Float[np.ndarray, "M 2"], trusted: Bool[np.ndarray, " M"]
) -> Float[np.ndarray, "M 2 2"]:
    """How a small step from each match in image 0 continues in image 1.

    One affine map for every cell of a grid over image 0: a reweighted least-squares fit to the trusted matches in it
    and in the cells around it, drawn a little to one map of the whole pair; the identity where fewer than four are
    trusted.

    Args: points of one pair's matches, pixels. trusted: which may be fitted to; outliers among them weigh less.
    Returns: (M, 2, 2) Jacobians of the map from image 0 to image 1.
    """
    return affine_maps(points0, points1, trusted).reshape(-1, 2, 2)


@compiled
def affine_maps(points0: np.ndarray, points1: np.ndarray, trusted: np.ndarray) -> np.ndarray:
    """`local_affine`, row by row (M, 4)."""
    maps = np.empty((len(points0), 4))
    base0, base1 = points0[trusted], points1[trusted]
    count = len(base0)
    if count < 4:
        for row in range(len(maps)):
            maps[row] = (1.0, 0.0, 0.0, 1.0)
        return maps
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for row in range(count):
        low_x, high_x = min(low_x, base0[row, 0]), max(high_x, base0[row, 0])
        low_y, high_y = min(low_y, base0[row, 1]), max(high_y, base0[row, 1])
    wide, high = high_x - low_x, high_y - low_y
    width = max(np.sqrt(_A_CELL * wide * high / count), _A_CELL * (wide + high) / (count + 1), 1e-9)
    columns, rows = int(wide / width) + 1, int(high / width) + 1
    # About the middle, where sums of squares lose least.
    middle_u, middle_v = base1[:, 0].mean(), base1[:, 1].mean()
    steps, cells = np.empty((count, 4)), np.empty(count, np.int64)
    for row in range(count):
        x, y = base0[row, 0] - low_x, base0[row, 1] - low_y
        steps[row] = (x - wide / 2, y - high / 2, base1[row, 0] - middle_u, base1[row, 1] - middle_v)
        cells[row] = int(x / width) * rows + int(y / width)

    weights = np.ones(count)
    least, number = _LEAST_SPREAD * width**2, np.full(1, float(count))
    whole = np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    everywhere = np.zeros(count, np.int64)
    for _ in range(_ROUNDS + 1):
        _fit(_sums(steps, weights, everywhere, 1), number, np.array([1.0, 0.0, 0.0, 1.0]), least, whole)
        _reweigh(steps, everywhere, whole, weights)
    near = _with_neighbours(np.bincount(cells, minlength=columns * rows).astype(np.float64).reshape(columns, rows, 1))
    fits = np.empty((columns * rows, 6))
    for _ in range(_ROUNDS):
        sums = _sums(steps, weights, cells, columns * rows).reshape(columns, rows, _MOMENTS)
        fits[:] = whole[0]
        _fit(_with_neighbours(sums).reshape(-1, _MOMENTS), near.ravel(), whole[0, :4], least, fits)
        _reweigh(steps, cells, fits, weights)
    for row in range(len(maps)):
        column = min(max(int((points0[row, 0] - low_x) / width), 0), columns - 1)
        line = min(max(int((points0[row, 1] - low_y) / width), 0), rows - 1)
        maps[row] = fits[column * rows + line, :4]
    return maps


@compiled
def _sums(steps: np.ndarray, weights: np.ndarray, cells: np.ndarray, count: int) -> np.ndarray:
    """Weighted moments (count, 12) of the points (M, 4) in every cell: up to first order, then x x, x y, ..., v y."""
    sums = np.zeros((count, _MOMENTS))
    for row in range(len(steps)):
        weight, x, y, u, v = weights[row], steps[row, 0], steps[row, 1], steps[row, 2], steps[row, 3]
        here = sums[cells[row]]
        here[0] += weight
        here[1] += weight * x
        here[2] += weight * y
        here[3] += weight * u
        here[4] += weight * v
        here[5] += weight * x * x
        here[6] += weight * x * y
        here[7] += weight * y * y
        here[8] += weight * u * x
        here[9] += weight * u * y
        here[10] += weight * v * x
        here[11] += weight * v * y
    return sums


@compiled
def _with_neighbours(cells: np.ndarray) -> np.ndarray:
    """The sum (columns, rows, n) over every cell and the eight around it, those at a side by half, at a corner less."""
    columns, rows, width = cells.shape
    along, result = cells.copy(), np.empty_like(cells)
    for column in range(columns):
        for row in range(rows):
            for entry in range(width):
                if row > 0:
                    along[column, row, entry] += 0.5 * cells[column, row - 1, entry]
                if row < rows - 1:
                    along[column, row, entry] += 0.5 * cells[column, row + 1, entry]
    result[:] = along
    for column in range(columns):
        for row in range(rows):
            for entry in range(width):
                if column > 0:
                    result[column, row, entry] += 0.5 * along[column - 1, row, entry]
                if column < columns - 1:
                    result[column, row, entry] += 0.5 * along[column + 1, row, entry]
    return result


@compiled
def _fit(sums: np.ndarray, near: np.ndarray, prior: np.ndarray, least: float, fits: np.ndarray) -> None:
    """Affine maps (n, 6), the linear part first, of the moments (n, 12); those without points stay as they are.

    Args: near: (n,) how many points each has. prior: the linear part that all are drawn to. least: spread in squared
        pixels below which they follow it.
    """
    for row in range(len(sums)):
        total = sums[row, 0]
        if total <= 0:
            continue
        x, y, u, v = sums[row, 1] / total, sums[row, 2] / total, sums[row, 3] / total, sums[row, 4] / total
        xx, xy, yy = sums[row, 5] / total - x * x, sums[row, 6] / total - x * y, sums[row, 7] / total - y * y
        pull = _PULL * max(xx + yy, 0.0) / near[row] + least
        xx, yy = max(xx, 0.0) + pull, max(yy, 0.0) + pull
        inverse = 1 / (xx * yy - xy * xy)
        for axis in range(2):
            there = v if axis else u
            along = sums[row, 8 + 2 * axis] / total - there * x + pull * prior[2 * axis]
            across = sums[row, 9 + 2 * axis] / total - there * y + pull * prior[2 * axis + 1]
            fits[row, 2 * axis] = (along * yy - across * xy) * inverse
            fits[row, 2 * axis + 1] = (across * xx - along * xy) * inverse
            fits[row, 4 + axis] = there - fits[row, 2 * axis] * x - fits[row, 2 * axis + 1] * y


@compiled
def _reweigh(steps: np.ndarray, cells: np.ndarray, fits: np.ndarray, weights: np.ndarray) -> None:
    """Let points (M, 4) that disagree with the map of their cell weigh less, against the median of all."""
    squared = np.empty(len(steps))
    for row in range(len(steps)):
        fit, x, y = fits[cells[row]], steps[row, 0], steps[row, 1]
        off_x = steps[row, 2] - fit[0] * x - fit[1] * y - fit[4]
        off_y = steps[row, 3] - fit[2] * x - fit[3] * y - fit[5]
        squared[row] = off_x**2 + off_y**2
    half = len(steps) // 2
    scale = 1 / max(np.partition(squared, half)[half], 1e-18)
    for row in range(len(steps)):
        weights[row] = 1 / (1 + squared[row] * scale)
