"""k-means in a projected feature space, and how many clusters are stable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float32, Int
from scipy.cluster import vq
from scipy.special import comb


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Projection:
    """A linear map to the first principal components: (x - mean) @ basis."""

    mean: Float32[np.ndarray, " C"]
    basis: Float32[np.ndarray, "C D"]

    def __call__(self, features: Float32[np.ndarray, "*grid C"]) -> Float32[np.ndarray, "*grid D"]:
        return (features - self.mean) @ self.basis


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Clusters:
    """A result of k-means: K centres, the nearest of them for every point, and the sum of squared distances to it."""

    centers: Float32[np.ndarray, "K D"]
    assignment: Int[np.ndarray, " N"]
    inertia: float


def principal_components(samples: Float32[np.ndarray, "N C"], num_components: int) -> Projection:
    """The projection that keeps most of the variance of the samples."""
    mean = samples.mean(axis=0)
    centered = samples - mean
    _, vectors = np.linalg.eigh(centered.T @ centered)  # eigenvalues ascend
    return Projection(mean=mean, basis=np.ascontiguousarray(vectors[:, : -num_components - 1 : -1]))


def kmeans(points: Float32[np.ndarray, "N D"], num_clusters: int, rng: np.random.Generator) -> Clusters:
    """k-means from a k-means++ start; fewer clusters when there are not enough different points."""
    # From given centres SciPy draws nothing at random, and it drops those that lose all their points.
    centers, _ = vq.kmeans(points, _spread_start(points, num_clusters, rng))
    assignment, distances = vq.vq(points, centers)
    return Clusters(centers=centers, assignment=assignment, inertia=float(np.square(distances, dtype=np.float64).sum()))


def stable_clusters(
    points: Float32[np.ndarray, "N D"], candidates: Sequence[int], num_runs: int, tolerance: float, seed: int
) -> tuple[Clusters, Mapping[int, float]]:
    """The number of clusters on which independent runs of k-means agree best, and that number's best run.

    Agreement is the mean adjusted Rand index over pairs of runs; among numbers within `tolerance` of the best
    agreement the largest is taken.
    Returns: the clusters of least inertia for that number, and the agreement of every candidate.
    """
    runs = {
        k: [kmeans(points, k, np.random.default_rng([seed, k, run])) for run in range(num_runs)] for k in candidates
    }
    agreement = {
        k: float(
            np.mean([adjusted_rand_index(a.assignment, b.assignment) for a, b in combinations(runs[k], 2)] or [1.0])
        )
        for k in candidates
    }
    chosen = max(k for k in candidates if agreement[k] >= max(agreement.values()) - tolerance)
    return min(runs[chosen], key=lambda run: run.inertia), agreement


def adjusted_rand_index(labels0: Int[np.ndarray, " N"], labels1: Int[np.ndarray, " N"]) -> float:
    """Agreement of two partitions: 1 when equal up to names, 0 on average for unrelated ones.

    Source: Hubert & Arabie, Comparing partitions, 1985.
    """
    table = np.zeros((labels0.max() + 1, labels1.max() + 1))
    np.add.at(table, (labels0, labels1), 1)
    together = comb(table, 2).sum()
    pairs0, pairs1 = comb(table.sum(axis=1), 2).sum(), comb(table.sum(axis=0), 2).sum()
    expected = pairs0 * pairs1 / max(comb(len(labels0), 2), 1)
    largest = (pairs0 + pairs1) / 2
    return 1.0 if largest == expected else float((together - expected) / (largest - expected))


def _spread_start(points: np.ndarray, num_centers: int, rng: np.random.Generator) -> np.ndarray:
    """k-means++ (Arthur & Vassilvitskii, 2007): each next centre is drawn in proportion to its squared distance."""
    centers = [points[rng.integers(len(points))]]
    nearest = np.full(len(points), np.inf)
    while len(centers) < num_centers:
        nearest = np.minimum(nearest, np.square(points - centers[-1]).sum(axis=1, dtype=np.float64))
        if not nearest.any():
            break
        centers.append(points[rng.choice(len(points), p=nearest / nearest.sum())])
    return np.stack(centers)
