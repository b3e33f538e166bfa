"""How a small step in one image continues in the other, from the matches around."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from sgam_sfm.merging.compiled import compiled

_A_CELL = 2.0  # matches that a cell has on average; its map is fitted to those of the cells around as well
_ROUNDS = 2  # of reweighting: more change nothing
_PULL = 0.25  # matches that the map of the whole pair counts for in that of a cell
_LEAST_SPREAD = 0.01  # of a cell's size, squared: matches on one spot tell no map
_EXACT = 1e-3  # of a cell's width: no residual counts as smaller
_MAP = 6  # numbers of a map: its linear part row by row, then its offset
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
    maps = np.empty((len(points0), 4))
    fit_maps(points0, points1, trusted, 0, len(points0), maps)
    return maps.reshape(-1, 2, 2)


@compiled
def fit_maps(
    points0: np.ndarray, points1: np.ndarray, trusted: np.ndarray, begin: int, end: int, maps: np.ndarray
) -> None:
    """`local_affine` of one pair, whose matches are the rows from `begin` to `end` of all arrays; fills in its maps."""
    count, low_x, low_y, high_x, high_y = 0, np.inf, np.inf, -np.inf, -np.inf
    for row in range(begin, end):
        if trusted[row]:
            count += 1
            low_x, high_x = min(low_x, points0[row, 0]), max(high_x, points0[row, 0])
            low_y, high_y = min(low_y, points0[row, 1]), max(high_y, points0[row, 1])
    if count < 4:
        for row in range(begin, end):
            maps[row, 0] = maps[row, 3] = 1.0
            maps[row, 1] = maps[row, 2] = 0.0
        return
    wide, high = high_x - low_x, high_y - low_y
    width = max(np.sqrt(_A_CELL * wide * high / count), _A_CELL * (wide + high) / (count + 1), 1e-9)
    columns, rows = int(wide / width) + 1, int(high / width) + 1

    base, weights = np.empty((count, 4)), np.ones(count)
    cells, everywhere = np.empty(count, np.int64), np.zeros(count, np.int64)
    near, one = np.zeros((columns * rows, 1)), np.full((1, 1), float(count))
    place = 0
    for row in range(begin, end):
        if trusted[row]:
            base[place, 0], base[place, 1] = points0[row, 0] - low_x, points0[row, 1] - low_y
            base[place, 2], base[place, 3] = points1[row, 0], points1[row, 1]
            cells[place] = int(base[place, 0] / width) * rows + int(base[place, 1] / width)
            near[cells[place], 0] += 1
            place += 1
    _add_neighbours(near, columns, rows)

    least, exact = _LEAST_SPREAD * width**2, (_EXACT * width) ** 2
    whole, same = np.empty((1, _MAP)), np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    sums, fits = np.empty((columns * rows, _MOMENTS)), np.empty((columns * rows, _MAP))
    for _ in range(_ROUNDS + 1):
        _sum(base, weights, everywhere, sums[:1])
        _fit(sums[:1], one, same, least, whole)
        _reweigh(base, everywhere, whole, exact, weights)
    for _ in range(_ROUNDS):
        _sum(base, weights, cells, sums)
        _add_neighbours(sums, columns, rows)
        _fit(sums, near, whole[0], least, fits)
        _reweigh(base, cells, fits, exact, weights)
    for row in range(begin, end):
        column = min(max(int((points0[row, 0] - low_x) / width), 0), columns - 1)
        line = min(max(int((points0[row, 1] - low_y) / width), 0), rows - 1)
        for entry in range(4):
            maps[row, entry] = fits[column * rows + line, entry]


@compiled
def _sum(base: np.ndarray, weights: np.ndarray, cells: np.ndarray, sums: np.ndarray) -> None:
    """Weighted moments (n, 12) of the points (M, 4) in every cell: up to first order, then x x, x y, y y, u x, ..."""
    for cell in range(len(sums)):
        for entry in range(_MOMENTS):
            sums[cell, entry] = 0.0
    for row in range(len(base)):
        here, weight = sums[cells[row]], weights[row]
        x, y, u, v = base[row, 0], base[row, 1], base[row, 2], base[row, 3]
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


@compiled
def _add_neighbours(cells: np.ndarray, columns: int, rows: int) -> None:
    """Add to every cell (columns * rows, n) those around it: at a side by half, at a corner by a quarter."""
    for step, lines, length in ((1, columns, rows), (rows, rows, columns)):
        for line in range(lines):
            first = line * (rows if step == 1 else 1)
            for entry in range(cells.shape[1]):
                before = 0.0
                for place in range(length):
                    cell = first + place * step
                    here = cells[cell, entry]
                    after = cells[cell + step, entry] if place < length - 1 else 0.0
                    cells[cell, entry] = here + 0.5 * (before + after)
                    before = here


@compiled
def _fit(sums: np.ndarray, near: np.ndarray, prior: np.ndarray, least: float, fits: np.ndarray) -> None:
    """Affine maps (n, 6) of moments (n, 12).

    Args: near: (n, 1) how many points each has. prior: (6,) the map that all are drawn to, and have where there is no
        point. least: spread in squared pixels below which they follow its linear part.
    """
    for cell in range(len(sums)):
        total = sums[cell, 0]
        if total <= 0:
            for entry in range(_MAP):
                fits[cell, entry] = prior[entry]
            continue
        x, y = sums[cell, 1] / total, sums[cell, 2] / total
        xx, xy, yy = sums[cell, 5] / total - x * x, sums[cell, 6] / total - x * y, sums[cell, 7] / total - y * y
        pull = _PULL * max(xx + yy, 0.0) / near[cell, 0] + least
        xx, yy = max(xx, 0.0) + pull, max(yy, 0.0) + pull
        inverse = 1 / (xx * yy - xy * xy)
        for axis in range(2):
            there = sums[cell, 3 + axis] / total
            along = sums[cell, 8 + 2 * axis] / total - there * x + pull * prior[2 * axis]
            across = sums[cell, 9 + 2 * axis] / total - there * y + pull * prior[2 * axis + 1]
            a, b = (along * yy - across * xy) * inverse, (across * xx - along * xy) * inverse
            fits[cell, 2 * axis], fits[cell, 2 * axis + 1], fits[cell, 4 + axis] = a, b, there - a * x - b * y


@compiled
def _reweigh(base: np.ndarray, cells: np.ndarray, fits: np.ndarray, exact: float, weights: np.ndarray) -> None:
    """Let points (M, 4) that disagree with the map of their cell weigh less.

    As if residuals were of a Cauchy distribution: its squared scale is the geometric mean of their squares.
    """
    logs = 0.0
    for row in range(len(base)):
        fit, x, y = fits[cells[row]], base[row, 0], base[row, 1]
        off_x = base[row, 2] - fit[0] * x - fit[1] * y - fit[4]
        off_y = base[row, 3] - fit[2] * x - fit[3] * y - fit[5]
        weights[row] = max(off_x**2 + off_y**2, exact)
        logs += np.log(weights[row])
    scale = np.exp(logs / len(base))
    for row in range(len(base)):
        weights[row] = scale / (scale + weights[row])
