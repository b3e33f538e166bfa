"""Keypoints moved to where the matches of their track agree best."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.sorting import stable_order

_PRIOR_WEIGHT = 0.005  # pull of a keypoint to its own points, against 0.5 for a sure match; a track could drift else
_TOLERANCE = 1e-4  # of the moves, which are fractions of a pixel
_MAX_ROUNDS = 300


def align_keypoints(
    keypoints: Float[np.ndarray, "K 2"],
    sigmas: Float[np.ndarray, " K"],
    slots: Int[np.ndarray, " K"],
    index: Int[np.ndarray, "M 2"],
    tracks: Int[np.ndarray, " M"],
    offsets: Float[np.ndarray, "M 2"],
    affine: Float[np.ndarray, "M 4"],
    weights: Float[np.ndarray, " M"],
) -> None:
    """Move keypoints to where the matches between them agree best, in place.

    Least squares over d1 = A d0 - offset, which holds when keypoints moved by d0 and d1 show the same spot near a match
    with local map A, and a weak pull to where a keypoint started. Tracks have nothing to do with each other: each is
    solved by itself, and threads may solve different tracks of the same keypoints.

    Args: keypoints, sigmas: start and image pixels per matcher pixel. slots: memory, -1 before and after. index: the
        keypoints of both sides of a match. tracks: a number that the matches of a track share. offsets: how far the
        keypoint of side 1 starts from where the match puts it, see `offsets_of`. affine: A, row by row. weights: per
        squared image-1 pixel.
    """
    order = stable_order(tracks)
    ends = np.flatnonzero(np.diff(tracks[order], append=-1)) + 1
    _solve(order, ends, index, offsets, affine, weights, sigmas, keypoints, slots)


@compiled
def offsets_of(points: np.ndarray, index: np.ndarray, matches: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """How far keypoints of side 1 lie from where matches carry those of side 0: x1 - p1 - A (x0 - p0), (M, 2).

    Args: points: (K, 2) of the keypoints. index: (M, 2) the keypoints of every match. matches: (M, 4) its points p0,
        p1. affine: (M, 4), row by row.
    """
    result = np.empty((len(index), 2))
    for row in range(len(index)):
        one, other = points[index[row, 0]], points[index[row, 1]]
        x, y = np.float64(one[0]) - matches[row, 0], np.float64(one[1]) - matches[row, 1]
        for axis in range(2):
            carried = affine[row, 2 * axis] * x + affine[row, 2 * axis + 1] * y
            result[row, axis] = np.float64(other[axis]) - matches[row, 2 + axis] - carried
    return result


@compiled
def _solve(
    order: np.ndarray,
    ends: np.ndarray,
    index: np.ndarray,
    offsets: np.ndarray,
    affine: np.ndarray,
    weights: np.ndarray,
    sigmas: np.ndarray,
    keypoints: np.ndarray,
    slot: np.ndarray,
) -> None:
    """Conjugate gradients track by track."""
    begin, longest = 0, 0
    for end in ends:
        longest, begin = max(longest, end - begin), end
    # Memory for any track: its keypoints get places 0, 1, ...
    members, prior = np.empty(2 * longest, np.int64), np.empty(2 * longest)
    diagonal, residual, solution = np.empty((2 * longest, 2)), np.empty((2 * longest, 2)), np.empty((2 * longest, 2))
    direction, product = np.empty((2 * longest, 2)), np.empty((2 * longest, 2))
    sides = np.empty((longest, 2), np.int64)
    begin = 0
    for end in ends:
        count = 0
        for place in range(begin, end):
            for side in range(2):
                keypoint = index[order[place], side]
                if slot[keypoint] < 0:
                    slot[keypoint] = count
                    members[count] = keypoint
                    count += 1
                sides[place - begin, side] = slot[keypoint]
        for place in range(count):
            prior[place] = _PRIOR_WEIGHT / np.float64(sigmas[members[place]]) ** 2
            for axis in range(2):
                diagonal[place, axis] = prior[place]
                residual[place, axis] = solution[place, axis] = 0
        for place in range(begin, end):
            row, one, other = order[place], sides[place - begin, 0], sides[place - begin, 1]
            weight = weights[row]
            for axis in range(2):
                residual[other, axis] -= weight * offsets[row, axis]
                diagonal[other, axis] += weight
                for column in range(2):
                    residual[one, column] += weight * affine[row, 2 * axis + column] * offsets[row, axis]
                    diagonal[one, column] += weight * affine[row, 2 * axis + column] ** 2
        energy = 0.0
        for place in range(count):
            for axis in range(2):
                direction[place, axis] = residual[place, axis] / diagonal[place, axis]
                energy += residual[place, axis] * direction[place, axis]
        enough = _TOLERANCE**2 * energy
        for _ in range(_MAX_ROUNDS):
            if energy <= enough or energy <= 1e-24:
                break
            for place in range(count):
                for axis in range(2):
                    product[place, axis] = prior[place] * direction[place, axis]
            for place in range(begin, end):
                row, one, other = order[place], sides[place - begin, 0], sides[place - begin, 1]
                weight = weights[row]
                x, y = direction[one, 0], direction[one, 1]
                for axis in range(2):
                    error = direction[other, axis] - affine[row, 2 * axis] * x - affine[row, 2 * axis + 1] * y
                    product[other, axis] += weight * error
                    product[one, 0] -= weight * affine[row, 2 * axis] * error
                    product[one, 1] -= weight * affine[row, 2 * axis + 1] * error
            curvature = 0.0
            for place in range(count):
                for axis in range(2):
                    curvature += direction[place, axis] * product[place, axis]
            length, before, energy = energy / curvature, energy, 0.0
            for place in range(count):
                for axis in range(2):
                    solution[place, axis] += length * direction[place, axis]
                    residual[place, axis] -= length * product[place, axis]
                    energy += residual[place, axis] * (residual[place, axis] / diagonal[place, axis])
            for place in range(count):
                for axis in range(2):
                    scaled = residual[place, axis] / diagonal[place, axis]
                    direction[place, axis] = scaled + (energy / before) * direction[place, axis]
        for place in range(count):
            for axis in range(2):
                keypoints[members[place], axis] += solution[place, axis]
            slot[members[place]] = -1
        begin = end
