"""How a small step in one image continues in the other, from the matches around."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.grid import grid_of

_NEIGHBOURS = 12  # matches that a local affine map is fitted to
_ROUNDS = 4  # reweighted least squares settles in three to four
_AT_ONCE = 64  # maps that are fitted side by side, so that one instruction serves several


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
    steps = np.concatenate([base0[far] - base0, base1[far] - base1], axis=1, dtype=np.float64).T[:, :, None]
    whole = _reweighted_affine(np.ascontiguousarray(steps), np.array([1.0, 0.0, 0.0, 1.0]))[:, 0]
    return _around(points0, points1, base0, base1, whole).reshape(-1, 2, 2)


@compiled
def _reweighted_affine(steps: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Linear maps (4, n), row by row, of steps in image 0 to those in image 1, steps that disagree weighing less.

    Args: steps: (4, k, n), x and y in image 0 and in image 1 of the k steps of each map. prior: (4,) what all are
        drawn to.
    """
    _, count, maps = steps.shape
    residual, sums = np.empty((count, maps)), np.empty((7, maps))
    for row in range(count):
        for one in range(maps):
            residual[row, one] = steps[0, row, one] ** 2 + steps[1, row, one] ** 2
    size = np.maximum(_medians(residual), 1e-12)
    fit = np.empty((4, maps))
    for entry in range(4):
        fit[entry] = prior[entry]
    for _ in range(_ROUNDS):
        for row in range(count):
            for one in range(maps):
                x, y, u, v = steps[0, row, one], steps[1, row, one], steps[2, row, one], steps[3, row, one]
                off_x, off_y = u - fit[0, one] * x - fit[1, one] * y, v - fit[2, one] * x - fit[3, one] * y
                residual[row, one] = off_x**2 + off_y**2
        scale = 1 / np.maximum(_medians(residual.copy()), 1e-18)
        sums[0], sums[1], sums[2] = size, 0, size
        for entry in range(4):
            sums[3 + entry] = prior[entry] * size
        for row in range(count):
            for one in range(maps):
                x, y, u, v = steps[0, row, one], steps[1, row, one], steps[2, row, one], steps[3, row, one]
                weight = 1 / (1 + residual[row, one] * scale[one])
                sums[0, one] += weight * x * x
                sums[1, one] += weight * x * y
                sums[2, one] += weight * y * y
                sums[3, one] += weight * u * x
                sums[4, one] += weight * u * y
                sums[5, one] += weight * v * x
                sums[6, one] += weight * v * y
        for one in range(maps):
            xx, xy, yy = sums[0, one], sums[1, one], sums[2, one]
            inverse = 1 / (xx * yy - xy * xy)
            for entry in (0, 2):
                along, across = sums[3 + entry, one], sums[4 + entry, one]
                fit[entry, one] = (along * yy - across * xy) * inverse
                fit[entry + 1, one] = (across * xx - along * xy) * inverse
    return fit


@compiled
def _medians(values: np.ndarray) -> np.ndarray:
    """Of every column (k, n), the upper of the two in the middle of an even number; changes the order of the values."""
    count, columns = values.shape
    half = count // 2
    if columns == 1:
        return np.partition(values[:, 0], half)[half : half + 1]
    # The smallest half moves up by exchanges that are the same for all columns.
    for row in range(half + 1):
        for other in range(row + 1, count):
            for column in range(columns):
                one, two = values[row, column], values[other, column]
                values[row, column] = one if one < two else two
                values[other, column] = two if one < two else one
    return values[half]


@compiled
def _around(
    points0: np.ndarray,
    points1: np.ndarray,
    base0: np.ndarray,
    base1: np.ndarray,
    whole: np.ndarray,
) -> np.ndarray:
    wanted = min(_NEIGHBOURS + 1, len(base0))
    frame, start, order = grid_of(base0, 0.0)
    sorted0, sorted1 = base0[order], base1[order]
    columns, rows = int(frame[3]), int(frame[4])
    result = np.empty((len(points0), 4))
    squared, near = np.empty(wanted), np.empty(wanted, np.int64)
    steps = np.empty((4, wanted, _AT_ONCE))
    for match in range(len(points0)):
        x, y = points0[match, 0], points0[match, 1]
        column = min(max(int((x - frame[0]) / frame[2]), 0), columns - 1)
        row = min(max(int((y - frame[1]) / frame[2]), 0), rows - 1)
        found, ring, widest = 0, 0, np.inf
        while True:
            for there in range(max(column - ring, 0), min(column + ring + 1, columns)):
                at_side = abs(there - column) == ring
                for end in range(1 if at_side else 2):  # cells of a column follow each other
                    top = row - ring if at_side or end == 0 else row + ring
                    bottom = row + ring if at_side or end == 1 else row - ring
                    top, bottom = max(top, 0), min(bottom, rows - 1)
                    if top > bottom:
                        continue
                    for place in range(start[there * rows + top], start[there * rows + bottom + 1]):
                        distance = (sorted0[place, 0] - x) ** 2 + (sorted0[place, 1] - y) ** 2
                        if distance >= widest:
                            continue
                        found = min(found + 1, wanted)
                        slot = found - 1
                        while slot > 0 and squared[slot - 1] > distance:
                            squared[slot], near[slot] = squared[slot - 1], near[slot - 1]
                            slot -= 1
                        squared[slot], near[slot] = distance, place
                        if found == wanted:
                            widest = squared[wanted - 1]
            # All points within this distance have been seen.
            reach = frame[2] * ring + min(
                x - frame[0] - column * frame[2],
                frame[0] + (column + 1) * frame[2] - x,
                y - frame[1] - row * frame[2],
                frame[1] + (row + 1) * frame[2] - y,
            )
            if reach > 0 and widest <= reach * reach:
                break
            ring += 1
            if ring > max(columns, rows):
                break
        lane = match % _AT_ONCE
        for slot in range(wanted):
            other = near[slot]
            steps[0, slot, lane], steps[1, slot, lane] = sorted0[other, 0] - x, sorted0[other, 1] - y
            steps[2, slot, lane] = sorted1[other, 0] - points1[match, 0]
            steps[3, slot, lane] = sorted1[other, 1] - points1[match, 1]
        if lane == _AT_ONCE - 1 or match == len(points0) - 1:
            result[match - lane : match + 1] = _reweighted_affine(steps, whole)[:, : lane + 1].T
    return result
