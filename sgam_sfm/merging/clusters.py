"""Points that many pairs found in one image -> keypoints."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.grid import cells_around, grid_of, nearest
from sgam_sfm.merging.sorting import stable_order

_CELLS_A_RADIUS = 8  # points of a matcher's grid coincide: a spot each keeps the number of neighbours small


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
    spot_of, spots, frame, start = _spots(points, weights, radius)
    densest = stable_order(-_density(spots, frame, start, radius))
    seed_of, count = _nearest_seeds(spots, densest, frame, start, radius)
    labels = seed_of[spot_of]
    return _means(labels, points, weights, count), labels


@compiled
def _spots(
    points: np.ndarray, weights: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The spot of every point (M,); place and weight of the spots (S, 3), sorted into a grid: its frame and start."""
    frame, start, order = grid_of(points, radius)
    spot_of, spots = np.empty(len(points), np.int64), np.zeros((len(points), 3))
    fine = np.empty((len(points), 2), np.int64)
    count = 0
    for cell in range(len(start) - 1):
        begin, first = start[cell], count
        start[cell] = first
        for place in range(begin, start[cell + 1]):
            row = order[place]
            column = int(np.floor(points[row, 0] * (_CELLS_A_RADIUS / radius) + 0.5))
            line = int(np.floor(points[row, 1] * (_CELLS_A_RADIUS / radius) + 0.5))
            spot = first
            while spot < count and (fine[spot, 0] != column or fine[spot, 1] != line):
                spot += 1
            if spot == count:
                fine[count, 0], fine[count, 1] = column, line
                count += 1
            spot_of[row] = spot
            spots[spot, 0] += weights[row] * points[row, 0]
            spots[spot, 1] += weights[row] * points[row, 1]
            spots[spot, 2] += weights[row]
    start[len(start) - 1] = count
    for spot in range(count):
        spots[spot, :2] /= spots[spot, 2]
    return spot_of, spots[:count], frame, start


@compiled
def _density(spots: np.ndarray, frame: np.ndarray, start: np.ndarray, radius: float) -> np.ndarray:
    """The sum of weights within a radius of every spot."""
    rows = int(frame[4])
    density = np.zeros(len(spots))
    for spot in range(len(spots)):
        left, right, top, bottom = cells_around(frame, spots[spot, 0], spots[spot, 1], radius)
        for column in range(left, right):
            for other in range(start[column * rows + top], start[column * rows + bottom]):
                step_x, step_y = spots[other, 0] - spots[spot, 0], spots[other, 1] - spots[spot, 1]
                if step_x * step_x + step_y * step_y <= radius * radius:
                    density[spot] += spots[other, 2]
    return density


@compiled
def _nearest_seeds(
    spots: np.ndarray, wanted: np.ndarray, frame: np.ndarray, start: np.ndarray, radius: float
) -> tuple[np.ndarray, int]:
    """The seed nearest to every spot, and the number of seeds.

    Spots become seeds one after the other as `wanted`, unless one is within the radius; so all have one in reach.
    """
    rows = int(frame[4])
    closed, seeds = np.zeros(len(spots), np.bool_), np.full(len(spots), -1)
    for spot in wanted:
        if closed[spot]:
            continue
        seeds[spot] = 0
        left, right, top, bottom = cells_around(frame, spots[spot, 0], spots[spot, 1], radius)
        for column in range(left, right):
            for other in range(start[column * rows + top], start[column * rows + bottom]):
                step_x, step_y = spots[other, 0] - spots[spot, 0], spots[other, 1] - spots[spot, 1]
                if step_x * step_x + step_y * step_y <= radius * radius:
                    closed[other] = True
    count = 0
    for spot in range(len(spots)):
        if seeds[spot] == 0:
            seeds[spot] = count
            count += 1
    nearest_seeds = np.empty(len(spots), np.int64)
    for spot in range(len(spots)):
        best = np.inf
        left, right, top, bottom = cells_around(frame, spots[spot, 0], spots[spot, 1], radius)
        for column in range(left, right):
            for other in range(start[column * rows + top], start[column * rows + bottom]):
                step_x, step_y = spots[other, 0] - spots[spot, 0], spots[other, 1] - spots[spot, 1]
                squared = step_x * step_x + step_y * step_y
                if seeds[other] >= 0 and squared < best:
                    best, nearest_seeds[spot] = squared, seeds[other]
    return nearest_seeds, count


@compiled
def _means(labels: np.ndarray, points: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    sums, total = np.zeros((count, 2)), np.zeros(count)
    for row in range(len(labels)):
        total[labels[row]] += weights[row]
        sums[labels[row], 0] += weights[row] * points[row, 0]
        sums[labels[row], 1] += weights[row] * points[row, 1]
    for label in range(count):
        sums[label] /= total[label]
    return sums


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
