"""Point matches per pair -> keypoints per image and index matches per pair, as COLMAP needs them.

A semi-dense matcher gives every pair points of its own, so its raw matches make tracks of two images. Four steps:

1. `merge_image`: points of one image that coincide become one keypoint.
2. `link_tracks`: matches link keypoints into tracks of at most one keypoint per image. Tracks that run side by side
   through several images show the same spot on different grids and are joined.
3. `align_keypoints`: a joined keypoint lies between the points it was made of, so all keypoints move, by fractions of
   a matcher pixel, to where the matches of their track agree best; each match is carried to its keypoints along the
   local affine map of its pair.
4. Matches that still disagree with their keypoints are dropped.

Distances are in matcher pixels (image pixels / sigma), so that coarse and fine matches are judged alike. The input is
only read: merging can be repeated with other options.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int, UInt32
from scipy.spatial import cKDTree

from sgam_core.errors import InputError, OptionError, ShapeError
from sgam_core.types import Matches
from sgam_sfm.pairs import Pair
from sgam_sfm.tracks import align_keypoints, link_tracks, local_affine

logger = logging.getLogger(__name__)

_MIN_WEIGHT = 1e-3  # a match of score 0 still has a place
_OCTAVE = 2.0  # points whose sigma is so many times the finest have no say in where a keypoint lies


@dataclass(frozen=True, kw_only=True, slots=True)
class KeypointOptions:
    """How far the points of one image may lie apart and still be one keypoint; radii in matcher pixels."""

    cluster_radius_px: float = 0.33  # points of one image within it are one keypoint
    track_radius_px: float = 5.0  # keypoints of one image within it may become one in a track; 0: never
    min_shared_images: int = 1  # join two tracks that run within the track radius in so many images; 0: never
    max_residual_sigmas: float = 1.0  # drop a match further from its aligned keypoints; sigma: 1 px either side; 0: off

    def __post_init__(self) -> None:
        if not self.cluster_radius_px > 0:
            raise OptionError(f"cluster_radius_px is {self.cluster_radius_px}; expected a positive number")
        for name in ("track_radius_px", "min_shared_images", "max_residual_sigmas"):
            if not getattr(self, name) >= 0:
                raise OptionError(f"{name} is {getattr(self, name)}; expected 0 (off) or a positive number")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CollectionKeypoints:
    """What goes into COLMAP's database.

    keypoints: image name -> (N, 2) pixels, corner origin. matches: pair -> (M, 2) rows in the two images' keypoints,
    one-to-one. scores: pair -> (M,) the best raw score of each. The raw matches are the exported ones, plus
    num_duplicates (fell together with an exported one), num_conflicts (would have put two spots of an image into one
    track) and num_inconsistent (too far from the keypoints of their track).
    """

    keypoints: Mapping[str, Float[np.ndarray, "N 2"]]
    matches: Mapping[Pair, UInt32[np.ndarray, "M 2"]]
    scores: Mapping[Pair, Float[np.ndarray, " M"]]
    num_raw: int
    num_duplicates: int
    num_conflicts: int
    num_inconsistent: int


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Columns:
    """All raw matches of a collection in one table of M rows; side 0 is the image whose name sorts first."""

    names: list[str]  # images, sorted
    pairs: list[Pair]  # as the caller orients them
    images: np.ndarray  # (2, M) row in `names`
    pair: np.ndarray  # (M,) row in `pairs`
    points: np.ndarray  # (2, M, 2) image pixels
    sigmas: np.ndarray  # (2, M) image pixels per matcher pixel
    scores: np.ndarray  # (M,)
    weights: np.ndarray  # (M,) scores, but never 0
    inlier: np.ndarray  # (M,) consistent with the robust geometry of its pair
    affine: np.ndarray  # (M, 2, 2) local map from side 0 to side 1


def merge_keypoints(
    pairs: Mapping[Pair, Matches],
    options: KeypointOptions | None = None,
    inliers: Mapping[Pair, np.ndarray] | None = None,
) -> CollectionKeypoints:
    """Merge the matches of all pairs into keypoints per image and one-to-one index matches per pair.

    Args: pairs: raw matches in full-image pixels; each is read once, so a mapping that loads from disk will do. Memory
        is linear in the matches. options: the defaults when None. inliers: (M,) bool for some or all pairs, which
        matches agree with the pair's robust geometry; the others join tracks last.
    Returns: keypoints of every image of the pairs and matches of every pair; the order of the mapping does not matter.
    Raises: InputError when a pair holds one image twice or comes in both orders; ShapeError for a mask that does not
        fit its matches.
    """
    options = options or KeypointOptions()
    raw = _collect(pairs, inliers or {})
    keypoints, image, index = _merge_images(raw, options.cluster_radius_px)
    finest = _finest(index, raw.sigmas, len(keypoints))

    variances = raw.sigmas[1] ** 2 + np.abs(np.linalg.det(raw.affine)) * raw.sigmas[0] ** 2
    edges = _strongest_first(index, raw.weights / variances, raw.inlier)
    track, joined = link_tracks(keypoints, image, finest, edges, options.track_radius_px, options.min_shared_images)
    linked = track[index[0]] == track[index[1]]

    index = joined[index]
    start = _means(index, raw, len(keypoints))
    finest = _finest(index, raw.sigmas, len(keypoints))
    aligned, residuals = align_keypoints(
        start,
        finest,
        index[:, linked],
        raw.points[:, linked],
        raw.affine[linked],
        variances[linked],
        raw.weights[linked],
    )
    exported = linked.copy()
    if options.max_residual_sigmas > 0:
        exported[linked] = residuals <= options.max_residual_sigmas
    return _export(raw, aligned, image, index, linked, exported)


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
    keypoints = np.zeros((0, 2))
    index = np.full(len(points), -1)
    octaves = np.floor(np.log2(sigmas) + 0.25)  # the quarter keeps sigmas around 1 in one octave
    for octave in np.unique(octaves):
        rows = np.flatnonzero(octaves == octave)
        radius = radius_px * float(np.median(sigmas[rows]))
        if len(keypoints):
            distances, nearest = cKDTree(keypoints).query(points[rows])
            near = distances <= radius
            index[rows[near]] = nearest[near]
            rows = rows[~near]
        means, labels = _cluster(points[rows], scores[rows] / sigmas[rows] ** 2, radius)
        index[rows] = labels + len(keypoints)
        keypoints = np.concatenate([keypoints, means])
    return keypoints, index


def _cluster(points: np.ndarray, weights: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Means (N, 2) of the clusters around the densest points, and the cluster of every point."""
    if not len(points):
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    # Points of a grid coincide: one representative a fine cell keeps the number of neighbours small.
    _, cells = np.unique(np.floor(points / (radius / 8) + 0.5), axis=0, return_inverse=True)
    cells = cells.reshape(-1)
    spots, spot_weights = _weighted_means(cells, points, weights)
    tree = cKDTree(spots)
    seeds = spots[_densest(len(spots), tree.query_pairs(radius, output_type="ndarray"), spot_weights)]
    _, label = cKDTree(seeds).query(spots)
    means, _ = _weighted_means(label[cells], points, weights)
    return means, label[cells]


def _densest(count: int, neighbours: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rows of which none neighbours another while every other row neighbours one; most weight around first."""
    a, b = neighbours.T
    density = weights + np.bincount(a, weights[b], count) + np.bincount(b, weights[a], count)
    rank = np.empty(count, np.int64)
    rank[np.lexsort((np.arange(count), -density))] = np.arange(count)
    chosen, open_ = np.zeros(count, bool), np.ones(count, bool)
    while open_.any():
        lowest = np.where(open_, rank, count)
        np.minimum.at(lowest, a, rank[b])
        np.minimum.at(lowest, b, rank[a])
        new = open_ & (lowest == rank)
        chosen |= new
        open_ &= ~new
        open_[b[new[a]]] = False
        open_[a[new[b]]] = False
        both = open_[a] & open_[b]
        a, b = a[both], b[both]
    return np.flatnonzero(chosen)


def _weighted_means(labels: np.ndarray, points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    total = np.bincount(labels, weights)
    sums = [np.bincount(labels, weights * points[:, axis]) for axis in (0, 1)]
    return np.stack(sums, axis=1) / total[:, None], total


def _collect(pairs: Mapping[Pair, Matches], inliers: Mapping[Pair, np.ndarray]) -> _Columns:
    by_names = {(min(pair), max(pair)): pair for pair in pairs}
    for a, b in pairs:
        if a == b:
            raise InputError(f"pair ('{a}', '{b}') matches an image with itself; remove it from the pairs")
        if by_names[min(a, b), max(a, b)] != (a, b):
            raise InputError(f"the pair of '{min(a, b)}' and '{max(a, b)}' comes in both orders; keep one of them")
    names = sorted({name for pair in pairs for name in pair})
    row_of = {name: row for row, name in enumerate(names)}
    images, points, sigmas, scores, inlier, affine = [], [], [], [], [], []
    for (first, second), pair in sorted(by_names.items()):
        matches = pairs[pair] if pair == (first, second) else pairs[pair].swapped()
        mask = inliers.get(pair, np.ones(len(matches), bool))
        if mask.shape != (len(matches),) or mask.dtype != np.bool_:
            raise ShapeError(
                f"inliers of pair {pair} are {mask.dtype} {mask.shape}; expected bool ({len(matches)},), one per match"
            )
        images.append(np.tile([[row_of[first]], [row_of[second]]], len(matches)))
        points.append(np.stack([matches.points0, matches.points1]))
        sigmas.append(np.stack([matches.sigmas0, matches.sigmas1]).astype(np.float64))
        scores.append(matches.scores)
        inlier.append(mask)
        affine.append(local_affine(matches.points0, matches.points1, mask))
    return _Columns(
        names=names,
        pairs=[by_names[key] for key in sorted(by_names)],
        images=np.concatenate([np.zeros((2, 0), np.int64), *images], axis=1),
        points=np.concatenate([np.zeros((2, 0, 2)), *points], axis=1),
        sigmas=np.concatenate([np.zeros((2, 0)), *sigmas], axis=1),
        scores=np.concatenate([np.zeros(0, np.float32), *scores]),
        weights=np.maximum(np.concatenate([np.zeros(0), *scores]), _MIN_WEIGHT),
        inlier=np.concatenate([np.zeros(0, bool), *inlier]),
        affine=np.concatenate([np.zeros((0, 2, 2)), *affine]),
        pair=np.repeat(np.arange(len(scores)), [len(part) for part in scores]),
    )


def _merge_images(raw: _Columns, radius_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All keypoints (K, 2), numbered image by image, the image of each (K,), the keypoints of every match (2, M)."""
    index = np.zeros(raw.images.size, np.int64)
    points, sigmas, scores = raw.points.reshape(-1, 2), raw.sigmas.ravel(), np.tile(raw.weights, 2)
    by_image = np.argsort(raw.images, axis=None, kind="stable")
    bounds = np.searchsorted(raw.images.ravel()[by_image], np.arange(len(raw.names) + 1))
    keypoints = [np.zeros((0, 2))]
    counts: list[int] = []
    for begin, end in pairwise(bounds):
        rows = by_image[begin:end]
        merged, labels = merge_image(points[rows], sigmas[rows], scores[rows], radius_px)
        index[rows] = labels + sum(counts)
        keypoints.append(merged)
        counts.append(len(merged))
    return np.concatenate(keypoints), np.repeat(np.arange(len(counts)), counts), index.reshape(2, -1)


def _finest(index: np.ndarray, sigmas: np.ndarray, count: int) -> np.ndarray:
    """The smallest sigma (count,) among the points of every keypoint; infinite for a keypoint without any."""
    finest = np.full(count, np.inf)
    np.minimum.at(finest, index, sigmas)
    return finest


def _strongest_first(index: np.ndarray, strength: np.ndarray, inlier: np.ndarray) -> np.ndarray:
    """The different matches (E, 2) of keypoints: those with an inlier first, then by their sum of strength."""
    edges, row = np.unique(index.T, axis=0, return_inverse=True)
    row = row.reshape(-1)
    support = np.bincount(row, strength, len(edges))
    outlier = np.bincount(row, inlier, len(edges)) == 0
    return edges[np.lexsort((edges[:, 1], edges[:, 0], -support, outlier))]


def _means(index: np.ndarray, raw: _Columns, count: int) -> np.ndarray:
    """Mean (count, 2) of the finest points of every keypoint; 0 for a keypoint that has none."""
    finest = _finest(index, raw.sigmas, count)
    fine = raw.sigmas < _OCTAVE * finest[index]
    weights = np.where(fine, raw.weights / raw.sigmas**2, 0.0).ravel()
    total = np.bincount(index.ravel(), weights, count)
    points = raw.points.reshape(-1, 2)
    sums = [np.bincount(index.ravel(), weights * points[:, axis], count) for axis in (0, 1)]
    return np.stack(sums, axis=1) / np.where(total > 0, total, 1)[:, None]


def _export(
    raw: _Columns, keypoints: np.ndarray, image: np.ndarray, index: np.ndarray, linked: np.ndarray, exported: np.ndarray
) -> CollectionKeypoints:
    used = np.unique(index[:, exported])
    bounds = np.searchsorted(image[used], np.arange(len(raw.names) + 1))
    number = np.zeros(len(keypoints), np.int64)  # of a keypoint within its image
    number[used] = np.arange(len(used)) - bounds[image[used]]
    matches, scores = {}, {}
    for row, pair in enumerate(raw.pairs):
        rows = slice(*np.searchsorted(raw.pair, [row, row + 1]))
        kept = np.flatnonzero(exported[rows]) + rows.start
        unique, inverse = np.unique(number[index[:, kept]].T, axis=0, return_inverse=True)
        best = np.zeros(len(unique), np.float32)
        np.maximum.at(best, inverse.reshape(-1), raw.scores[kept])
        oriented = unique if pair[0] < pair[1] else unique[:, ::-1]
        matches[pair], scores[pair] = np.ascontiguousarray(oriented, np.uint32), best
    num_exported = sum(map(len, matches.values()))
    result = CollectionKeypoints(
        keypoints={name: keypoints[used[bounds[row] : bounds[row + 1]]] for row, name in enumerate(raw.names)},
        matches=matches,
        scores=scores,
        num_raw=len(linked),
        num_duplicates=int(exported.sum()) - num_exported,
        num_conflicts=int((~linked).sum()),
        num_inconsistent=int((linked & ~exported).sum()),
    )
    logger.info(
        "%d raw matches -> %d between %d keypoints (%d duplicates, %d conflicts, %d inconsistent)",
        result.num_raw,
        num_exported,
        len(used),
        result.num_duplicates,
        result.num_conflicts,
        result.num_inconsistent,
    )
    return result
