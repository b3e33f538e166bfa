"""Keypoints moved to where the matches of their track agree best."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from sgam_sfm.compiled import compiled

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
    order = np.argsort(tracks, kind="stable")
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
        x = points[index[row, 0], 0] - matches[row, 0]
        y = points[index[row, 0], 1] - matches[row, 1]
        for axis in range(2):
            carried = affine[row, 2 * axis] * x + affine[row, 2 * axis + 1] * y
            result[row, axis] = points[index[row, 1], axis] - matches[row, 2 + axis] - carried
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
    begin = 0
    for end in ends:
        # The keypoints of the track get places 0, 1, ...
        members = np.empty(2 * (end - begin), np.int64)
        count = 0
        for place in range(begin, end):
            for side in range(2):
                keypoint = index[order[place], side]
                if slot[keypoint] < 0:
                    slot[keypoint] = count
                    members[count] = keypoint
                    count += 1
        prior, diagonal, residual = np.empty(count), np.empty((count, 2)), np.zeros((count, 2))
        for place in range(count):
            prior[place] = _PRIOR_WEIGHT / np.float64(sigmas[members[place]]) ** 2
            diagonal[place, 0] = diagonal[place, 1] = prior[place]
        for place in range(begin, end):
            row = order[place]
            one, other, weight = slot[index[row, 0]], slot[index[row, 1]], weights[row]
            for axis in range(2):
                residual[other, axis] -= weight * offsets[row, axis]
                diagonal[other, axis] += weight
                for column in range(2):
                    residual[one, column] += weight * affine[row, 2 * axis + column] * offsets[row, axis]
                    diagonal[one, column] += weight * affine[row, 2 * axis + column] ** 2
        solution = np.zeros((count, 2))
        direction, product = residual / diagonal, np.empty((count, 2))
        energy = np.sum(residual * direction)
        enough = _TOLERANCE**2 * energy
        for _ in range(_MAX_ROUNDS):
            if energy <= enough or energy <= 1e-24:
                break
            for place in range(count):
                for axis in range(2):
                    product[place, axis] = prior[place] * direction[place, axis]
            for place in range(begin, end):
                row = order[place]
                one, other, weight = slot[index[row, 0]], slot[index[row, 1]], weights[row]
                x, y = direction[one, 0], direction[one, 1]
                for axis in range(2):
                    error = direction[other, axis] - affine[row, 2 * axis] * x - affine[row, 2 * axis + 1] * y
                    product[other, axis] += weight * error
                    product[one, 0] -= weight * affine[row, 2 * axis] * error
                    product[one, 1] -= weight * affine[row, 2 * axis + 1] * error
            length = energy / np.sum(direction * product)
            solution += length * direction
            residual -= length * product
            scaled = residual / diagonal
            before, energy = energy, np.sum(residual * scaled)
            direction = scaled + (energy / before) * direction
        for place in range(count):
            for axis in range(2):
                keypoints[members[place], axis] += solution[place, axis]
            slot[members[place]] = -1
        begin = end
