"""Points that many pairs found in one image -> keypoints."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.grid import cells_around, grid_of, nearest
from sgam_sfm.merging.sorting import stable_order

_CELLS_A_RADIUS = 8  # points of a matcher's grid coincide: one spot a fine cell keeps the number of neighbours small


def merge_image(
    points: Float[np.ndarray, "M 2"],
    sigmas: Float[np.ndarray, " M"],
    scores: Float[np.ndarray, " M"],
    radius_px: float,
) -> tuple[Float[np.ndarray, "N 2"], Int[np.ndarray, " M"]]:
    """Cluster the points that all pairs found in one image.

    Fine points come first, an octave of sigma at a time: the densest spots become clusters, and every point goes to the
    nearest cluster within the radius. Coarser points join a finer cluster in reach without moving it.

    Args: points: pixels. sigmas: image pixels per matcher pixel. scores: above 0. radius_px: in matcher pixels.
    Returns: keypoints, the means of the points of the cluster's finest octave weighted by score / sigma^2; the keypoint
        of every point.
    """
    octaves = np.floor(np.log2(sigmas) + 0.25).astype(np.int64)  # the quarter keeps sigmas around 1 in one octave
    keypoints, index = np.zeros((0, 2)), np.full(len(points), -1)
    weights = scores / np.square(sigmas, dtype=np.float64)
    for octave in np.unique(octaves):
        rows = np.flatnonzero(octaves == octave)
        radius = radius_px * float(np.median(sigmas[rows]))
        if len(keypoints):
            found = _nearest_of(keypoints, points[rows].astype(np.float64), radius)
            index[rows] = found
            rows = rows[found < 0]
        means, labels = _cluster(points[rows].astype(np.float64), weights[rows].astype(np.float64), radius)
        index[rows] = labels + len(keypoints)
        keypoints = np.concatenate([keypoints, means])
    return keypoints, index


@compiled
def _nearest_of(keypoints: np.ndarray, points: np.ndarray, radius: float) -> np.ndarray:
    frame, start, order = grid_of(keypoints, radius)
    found = np.empty(len(points), np.int64)
    for row in range(len(points)):
        found[row] = nearest(keypoints, frame, start, order, points[row, 0], points[row, 1], radius)
    return found


def _cluster(points: np.ndarray, weights: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Means (N, 2) of the clusters around the densest points, and the cluster of every point."""
    if not len(points):
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    spot_of = _fine_cells(points, radius / _CELLS_A_RADIUS)
    spots, spot_weights = _means(spot_of, points, weights, spot_of.max() + 1)
    frame, start, order = grid_of(spots, radius)
    density = _density(spots, spot_weights, frame, start, order, radius)
    seeds = spots[_seeds(spots, stable_order(-density), frame, start, order, radius)]
    labels = _nearest_of(seeds, spots, radius * (1 + 1e-9))[spot_of]
    means, _ = _means(labels, points, weights, len(seeds))
    return means, labels


def _fine_cells(points: np.ndarray, width: float) -> np.ndarray:
    """The cell of every point (M,), numbered 0, 1, ... without gaps."""
    columns, rows = np.floor(points / width + 0.5).astype(np.int64).T
    keys = columns * (rows.max() - rows.min() + 1) + (rows - rows.min())
    order = stable_order(keys)
    cells = np.empty(len(points), np.int64)
    cells[order] = np.cumsum(np.diff(keys[order], prepend=keys[order[:1]]) != 0)
    return cells


@compiled
def _density(
    spots: np.ndarray, weights: np.ndarray, frame: np.ndarray, start: np.ndarray, order: np.ndarray, radius: float
) -> np.ndarray:
    """The sum of weights within a radius of every spot."""
    rows = int(frame[4])
    density = np.zeros(len(spots))
    for spot in range(len(spots)):
        left, right, top, bottom = cells_around(frame, spots[spot, 0], spots[spot, 1], radius)
        for column in range(left, right):
            for place in range(start[column * rows + top], start[column * rows + bottom]):
                other = order[place]
                step_x, step_y = spots[other, 0] - spots[spot, 0], spots[other, 1] - spots[spot, 1]
                if step_x * step_x + step_y * step_y <= radius * radius:
                    density[spot] += weights[other]
    return density


@compiled
def _seeds(
    spots: np.ndarray, wanted: np.ndarray, frame: np.ndarray, start: np.ndarray, order: np.ndarray, radius: float
) -> np.ndarray:
    """Which spots become seeds: one after the other as `wanted`, unless it is within the radius of one."""
    rows = int(frame[4])
    closed, chosen = np.zeros(len(spots), np.bool_), np.zeros(len(spots), np.bool_)
    for spot in wanted:
        if closed[spot]:
            continue
        chosen[spot] = True
        left, right, top, bottom = cells_around(frame, spots[spot, 0], spots[spot, 1], radius)
        for column in range(left, right):
            for place in range(start[column * rows + top], start[column * rows + bottom]):
                other = order[place]
                step_x, step_y = spots[other, 0] - spots[spot, 0], spots[other, 1] - spots[spot, 1]
                if step_x * step_x + step_y * step_y <= radius * radius:
                    closed[other] = True
    return chosen


@compiled
def _means(labels: np.ndarray, points: np.ndarray, weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    sums, total = np.zeros((count, 2)), np.zeros(count)
    for row in range(len(labels)):
        total[labels[row]] += weights[row]
        sums[labels[row], 0] += weights[row] * points[row, 0]
        sums[labels[row], 1] += weights[row] * points[row, 1]
    for label in range(count):
        sums[label] /= total[label]
    return sums, total


@compiled
def finest_and_weight(
    index: np.ndarray, sigmas: np.ndarray, weights: np.ndarray, count: int, octave: float
) -> tuple[np.ndarray, np.ndarray]:
    """Of every keypoint the smallest sigma of its points, and the sum of weight / sigma^2 of those near the smallest.

    Args: index: the keypoint of every point. octave: points whose sigma is so many times the smallest do not count.
    """
    finest, total = np.full(count, np.inf), np.zeros(count)
    for row in range(len(index)):
        finest[index[row]] = min(finest[index[row]], sigmas[row])
    for row in range(len(index)):
        if sigmas[row] < octave * finest[index[row]]:
            total[index[row]] += weights[row] / sigmas[row] ** 2
    return finest, total
