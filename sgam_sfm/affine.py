"""How a small step in one image continues in the other, from the matches around."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from sgam_sfm.compiled import compiled
from sgam_sfm.grid import grid_of

_NEIGHBOURS = 12  # matches that a local affine map is fitted to
_ROUNDS = 4  # reweighted least squares settles in three to four


def local_affine(
    points0: Float[np.ndarray, "M 2"], points1: Float[np.ndarray, "M 2"], trusted: Bool[np.ndarray, " M"]
) -> Float[np.ndarray, "M 2 2"]:
    """How a small step from each match in image 0 continues in image 1.

    A reweighted least-squares fit to the nearest trusted matches, drawn to one map of the whole pair; the identity
    where fewer than four are trusted.

    Args: points of one pair's matches, pixels. trusted: which may be fitted to; outliers among them weigh less.
    Returns: (M, 2, 2) Jacobians of the map from image 0 to image 1.
    """
    base0, base1 = points0[trusted], points1[trusted]
    if len(base0) < 4:
        return np.tile(np.eye(2), (len(points0), 1, 1))
    # Steps across the pair: long against the noise, and no outlier can shift an origin. In no order: matches may come
    # row by row of a grid, where a fixed distance in their order is a fixed step, which tells one direction only.
    far = np.random.default_rng(0).permutation(len(base0))
    spare = np.empty((2, len(far)))
    whole = _reweighted_affine(base0[far] - base0, base1[far] - base1, (1.0, 0.0, 0.0, 1.0), spare)
    return _around(points0, points1, base0, base1, whole)


@compiled
def _reweighted_affine(
    steps0: np.ndarray, steps1: np.ndarray, prior: tuple[float, float, float, float], spare: np.ndarray
) -> tuple[float, float, float, float]:
    """The linear map, row by row, from steps0 (k, 2) to steps1 (k, 2), steps that disagree weighing less.

    Args: prior: what it is drawn to. spare: memory for (2, k).
    """
    count = len(steps0)
    residual, ordered = spare[0], spare[1]
    for row in range(count):
        ordered[row] = steps0[row, 0] ** 2 + steps0[row, 1] ** 2
    size = max(_median(ordered), 1e-12)
    a, b, c, d = prior
    for _ in range(_ROUNDS):
        for row in range(count):
            x, y = steps0[row, 0], steps0[row, 1]
            residual[row] = (steps1[row, 0] - a * x - b * y) ** 2 + (steps1[row, 1] - c * x - d * y) ** 2
            ordered[row] = residual[row]
        scale = 1 / max(_median(ordered), 1e-18)
        xx, xy, yy = size, 0.0, size
        ux, uy, vx, vy = prior[0] * size, prior[1] * size, prior[2] * size, prior[3] * size
        for row in range(count):
            x, y, u, v = steps0[row, 0], steps0[row, 1], steps1[row, 0], steps1[row, 1]
            weight = 1 / (1 + residual[row] * scale)
            xx, xy, yy = xx + weight * x * x, xy + weight * x * y, yy + weight * y * y
            ux, uy, vx, vy = ux + weight * u * x, uy + weight * u * y, vx + weight * v * x, vy + weight * v * y
        inverse = 1 / (xx * yy - xy * xy)
        a, b = (ux * yy - uy * xy) * inverse, (uy * xx - ux * xy) * inverse
        c, d = (vx * yy - vy * xy) * inverse, (vy * xx - vx * xy) * inverse
    return a, b, c, d


@compiled
def _median(values: np.ndarray) -> float:
    """The upper of the two in the middle of an even number; changes the order of the values."""
    count = len(values)
    if count > 32:
        return float(np.partition(values, count // 2)[count // 2])
    for row in range(1, count):
        value, place = values[row], row
        while place > 0 and values[place - 1] > value:
            values[place] = values[place - 1]
            place -= 1
        values[place] = value
    return float(values[count // 2])


@compiled
def _around(
    points0: np.ndarray,
    points1: np.ndarray,
    base0: np.ndarray,
    base1: np.ndarray,
    whole: tuple[float, float, float, float],
) -> np.ndarray:
    wanted = min(_NEIGHBOURS + 1, len(base0))
    frame, start, order = grid_of(base0, 0.0)
    columns, rows = int(frame[3]), int(frame[4])
    result = np.empty((len(points0), 2, 2))
    squared, near = np.empty(wanted), np.empty(wanted, np.int64)
    steps0, steps1, spare = np.empty((wanted, 2)), np.empty((wanted, 2)), np.empty((2, wanted))
    for match in range(len(points0)):
        x, y = points0[match, 0], points0[match, 1]
        column = min(max(int((x - frame[0]) / frame[2]), 0), columns - 1)
        row = min(max(int((y - frame[1]) / frame[2]), 0), rows - 1)
        found, ring = 0, 0
        while True:
            for there in range(max(column - ring, 0), min(column + ring + 1, columns)):
                whole_line = abs(there - column) == ring
                step = 1 if whole_line or ring == 0 else 2 * ring
                for line in range(row - ring, row + ring + 1, step):
                    if line < 0 or line >= rows:
                        continue
                    for place in range(start[there * rows + line], start[there * rows + line + 1]):
                        other = order[place]
                        distance = (base0[other, 0] - x) ** 2 + (base0[other, 1] - y) ** 2
                        if found == wanted and distance >= squared[wanted - 1]:
                            continue
                        found = min(found + 1, wanted)
                        slot = found - 1
                        while slot > 0 and squared[slot - 1] > distance:
                            squared[slot], near[slot] = squared[slot - 1], near[slot - 1]
                            slot -= 1
                        squared[slot], near[slot] = distance, other
            # All points within this distance have been seen.
            reach = frame[2] * ring + min(
                x - frame[0] - column * frame[2],
                frame[0] + (column + 1) * frame[2] - x,
                y - frame[1] - row * frame[2],
                frame[1] + (row + 1) * frame[2] - y,
            )
            if found == wanted and reach > 0 and squared[wanted - 1] <= reach * reach:
                break
            ring += 1
            if ring > max(columns, rows):
                break
        for slot in range(wanted):
            other = near[slot]
            steps0[slot, 0], steps0[slot, 1] = base0[other, 0] - x, base0[other, 1] - y
            steps1[slot, 0] = base1[other, 0] - points1[match, 0]
            steps1[slot, 1] = base1[other, 1] - points1[match, 1]
        a, b, c, d = _reweighted_affine(steps0, steps1, whole, spare)
        result[match, 0, 0], result[match, 0, 1], result[match, 1, 0], result[match, 1, 1] = a, b, c, d
    return result
