"""Matches between numbered keypoints -> tracks of at most one keypoint per image, and keypoints moved to agree.

Arrays only: keypoints of the whole collection are numbered 0..K-1, `images` (K,) says which image each lies in.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

_PRIOR_WEIGHT = 0.005  # pull of a keypoint to its own points, against 0.5 for a sure match; a track could drift else
_NEIGHBOURS = 12  # matches that a local affine map is fitted to
_EDGES_AT_ONCE = 2**14  # more take more rounds, fewer take more passes over the keypoints
_AFFINE_ROUNDS = 4  # reweighted least squares settles in three to four


class Tracks:
    """Tracks of keypoints, each with at most one keypoint in an image; every keypoint is one of its own to begin with.

    points (K, 2), images (K,), sigmas (K,): of the keypoints. radius: matcher pixels within which two keypoints of an
    image may become one.
    """

    def __init__(self, points: np.ndarray, images: np.ndarray, sigmas: np.ndarray, radius: float) -> None:
        self._points, self._images, self._sigmas, self._radius = points, images, sigmas, radius
        self._parent = np.arange(len(images))
        self._replaced_by = np.arange(len(images))

    def track(self) -> Int[np.ndarray, " K"]:
        """The keypoint that gives every keypoint's track its number."""
        return _follow(self._parent)

    def representative(self) -> Int[np.ndarray, " K"]:
        """The keypoint of the same image and track that each has become part of, itself for most."""
        return _follow(self._replaced_by)

    def join(self, edges: Int[np.ndarray, "E 2"], min_shared: int = 0) -> None:
        """Make one track of those of each edge's keypoints, unless that needs one keypoint at two distant spots.

        The outcome is that of taking the edges one after the other. Both tracks of an edge are as they will be then as
        soon as no edge before it touches them, so all such edges are taken at once, round after round.

        min_shared: number of images that both tracks of an edge must be in.
        """
        for begin in range(0, len(edges), _EDGES_AT_ONCE):
            self._join_some(edges[begin : begin + _EDGES_AT_ONCE], min_shared)

    def _join_some(self, edges: np.ndarray, min_shared: int) -> None:
        self._parent = _follow(self._parent)
        roots, ends = np.unique(self._parent[edges], return_inverse=True)
        ends = ends.reshape(-1, 2)  # tracks are numbered by the row of their root from here on
        number = np.full(len(self._parent), -1)
        number[roots] = np.arange(len(roots))
        number = number[self._parent]
        members = np.flatnonzero((number >= 0) & (self._replaced_by == np.arange(len(number))))
        track = number[members]
        parent, first = np.arange(len(roots)), np.empty(len(roots), np.int64)
        while len(ends := ends[ends[:, 0] != ends[:, 1]]):
            place = np.arange(len(ends))
            first[ends[::-1].ravel()] = np.repeat(
                place[::-1], 2
            )  # of several the last assignment stays: the first edge
            now = (first[ends] == place[:, None]).all(axis=1)
            kept, gone = self._join_apart(ends[now], members, track, len(roots), min_shared)
            parent[gone] = kept
            standing = self._replaced_by[members] == members
            members, track = members[standing], parent[track[standing]]
            ends = parent[ends[~now]]
        self._parent[roots] = roots[_follow(parent)]

    def _join_apart(
        self, edges: np.ndarray, members: np.ndarray, track: np.ndarray, num_tracks: int, min_shared: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Join tracks along edges (E, 2) that have no track in common, where they may be.

        Args: members, track: keypoints that stand for their track in an image, and that track.
        Returns: the tracks that were joined: those that stay, the larger ones, and those that became part of them.
        """
        edge_of = np.full(num_tracks, -1)
        edge_of[edges] = np.arange(len(edges))[:, None]
        own = np.flatnonzero(edge_of[track] >= 0)
        own = own[np.lexsort((self._images[members[own]], edge_of[track[own]]))]
        edge = edge_of[track[own]]
        own, at = members[own], track[own]
        size = np.bincount(at, minlength=num_tracks)[edges]
        kept, gone = np.where(size[:, :1] >= size[:, 1:], edges, edges[:, ::-1]).T
        twice = np.flatnonzero((np.diff(edge) == 0) & (np.diff(self._images[own]) == 0))
        one, other, shared = own[twice], own[twice + 1], edge[twice]
        reach = self._radius * np.maximum(self._sigmas[one], self._sigmas[other])
        near = np.linalg.norm(self._points[one] - self._points[other], axis=1) <= reach
        count = np.bincount(shared, minlength=len(edges))
        fine = (count >= min_shared) & (np.bincount(shared, near, len(edges)) == count)
        one, other = np.where(at[twice] == kept[shared], (one, other), (other, one))[:, fine[shared]]
        stays, goes = np.where(self._sigmas[other] < self._sigmas[one], (other, one), (one, other))
        self._replaced_by[goes] = stays
        return kept[fine], gone[fine]


def _follow(links: np.ndarray) -> np.ndarray:
    target = links
    while not np.array_equal(further := target[target], target):
        target = further
    return target


def link_tracks(
    points: Float[np.ndarray, "K 2"],
    images: Int[np.ndarray, " K"],
    sigmas: Float[np.ndarray, " K"],
    edges: Int[np.ndarray, "E 2"],
    radius_px: float,
    min_shared_images: int,
) -> tuple[Int[np.ndarray, " K"], Int[np.ndarray, " K"]]:
    """Join keypoints into tracks that hold at most one keypoint per image.

    Two tracks are joined along an edge, strongest edge first, unless they have keypoints further apart than the radius
    in one image; nearer ones become one. Then tracks that run within the radius of each other in every image they
    share, at least `min_shared_images` of them, are joined too: without that, the tracks of a matcher that puts one
    side of each match on a grid end wherever an image changes sides.

    Args: points: image pixels. sigmas: image pixels per matcher pixel. edges: matched keypoints, strongest first.
        radius_px: matcher pixels, the coarser of two keypoints; 0 joins none. min_shared_images: 0 skips the second
        step.
    Returns: track (K,): a number that the keypoints of a track share. representative (K,): the keypoint that each has
        become part of, itself for most; one per track and image.
    """
    tracks = Tracks(points, images, sigmas, radius_px)
    tracks.join(edges)
    if radius_px > 0 and min_shared_images > 0:
        roots = tracks.track()
        tracks.join(_side_by_side(points, images, sigmas, roots, radius_px, min_shared_images), min_shared_images)
    return tracks.track(), tracks.representative()


def _side_by_side(
    points: np.ndarray, images: np.ndarray, sigmas: np.ndarray, roots: np.ndarray, radius_px: float, min_shared: int
) -> np.ndarray:
    """Pairs of tracks (T, 2) near each other in at least `min_shared` images: most images first, then nearest."""
    keys, distances = [np.zeros(0, np.int64)], [np.zeros(0)]
    order = np.argsort(images, kind="stable")
    for here in np.split(order, np.flatnonzero(np.diff(images[order])) + 1):
        if not len(here):
            continue
        near = here[cKDTree(points[here]).query_pairs(radius_px * sigmas[here].max(), output_type="ndarray")]
        distance = np.linalg.norm(points[near[:, 0]] - points[near[:, 1]], axis=1) / sigmas[near].max(axis=1)
        pair = np.sort(roots[near], axis=1)
        wanted = (distance <= radius_px) & (pair[:, 0] != pair[:, 1])
        keys.append(pair[wanted, 0] * len(points) + pair[wanted, 1])
        distances.append(distance[wanted])
    key, index, shared = np.unique(np.concatenate(keys), return_inverse=True, return_counts=True)
    mean_distance = np.bincount(index, np.concatenate(distances), len(key)) / np.maximum(shared, 1)
    best_first = np.lexsort((key, mean_distance, -shared))
    key = key[best_first][shared[best_first] >= min_shared]
    return np.stack([key // max(len(points), 1), key % max(len(points), 1)], axis=1)


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
    # Steps across half the pair: long against the noise, and no outlier can shift an origin.
    far = np.roll(np.arange(len(base0)), len(base0) // 2)
    whole = _reweighted_affine((base0[far] - base0)[None], (base1[far] - base1)[None], np.eye(2))[0]
    _, rows = cKDTree(base0).query(points0, min(_NEIGHBOURS + 1, len(base0)))
    return _reweighted_affine(base0[rows] - points0[:, None], base1[rows] - points1[:, None], whole)


def _reweighted_affine(steps0: np.ndarray, steps1: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Linear maps (N, 2, 2) from steps0 (N, k, 2) to steps1 (N, k, 2), steps that disagree weighing less."""
    size = np.maximum(np.median((steps0**2).sum(axis=2), axis=1), 1e-12)[:, None, None] * np.eye(2)
    linear = np.broadcast_to(prior, (len(steps0), 2, 2))
    for _ in range(_AFFINE_ROUNDS):
        residual = np.linalg.norm(steps1 - steps0 @ linear.transpose(0, 2, 1), axis=2)
        scale = np.maximum(np.median(residual, axis=1, keepdims=True), 1e-9)
        weighted = steps0 / (1 + (residual / scale) ** 2)[:, :, None]
        linear = (steps1.transpose(0, 2, 1) @ weighted + prior @ size) @ np.linalg.inv(
            steps0.transpose(0, 2, 1) @ weighted + size
        )
    return linear


def align_keypoints(
    keypoints: Float[np.ndarray, "K 2"],
    sigmas: Float[np.ndarray, " K"],
    index: Int[np.ndarray, "2 M"],
    points: Float[np.ndarray, "2 M 2"],
    affine: Float[np.ndarray, "M 2 2"],
    variances: Float[np.ndarray, " M"],
    weights: Float[np.ndarray, " M"],
) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, " M"]]:
    """Move keypoints to where the matches between them agree best.

    Least squares over x1 = p1 + A (x0 - p0), which holds when keypoints x0, x1 show the same spot near the match
    p0, p1 with local map A, each equation weighing weight / variance, and a weak pull to where a keypoint started.

    Args: keypoints, sigmas: start and image pixels per matcher pixel. index: the keypoints of both sides of a match.
        variances: squared image-1 pixels.
    Returns: the aligned keypoints; for every match the residual in standard deviations.
    """
    count, (side0, side1) = len(keypoints), index
    offset = points[1] - np.einsum("mij,mj->mi", affine, points[0])
    root_weight = np.sqrt(weights / variances)
    row = 2 * np.arange(len(side0))
    entries = [
        (row + axis, column, root_weight * factor)
        for axis in (0, 1)
        for column, factor in (
            (2 * side1 + axis, np.ones(len(side0))),
            (2 * side0, -affine[:, axis, 0]),
            (2 * side0 + 1, -affine[:, axis, 1]),
        )
    ]
    rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
    system = csr_matrix((values, (rows, columns)), shape=(2 * len(side0), 2 * count))
    prior = np.repeat(_PRIOR_WEIGHT / np.where(np.isfinite(sigmas), sigmas, 1.0) ** 2, 2)
    normal = (system.T @ system + diags(prior)).tocsr()
    right = system.T @ (root_weight[:, None] * offset).ravel() + prior * keypoints.ravel()
    start = keypoints.ravel()
    solution, _ = cg(normal, right, x0=start, rtol=1e-7, maxiter=300, M=diags(1 / normal.diagonal()))
    aligned = solution.reshape(-1, 2)
    residual = aligned[side1] - offset - np.einsum("mij,mj->mi", affine, aligned[side0])
    return aligned, np.linalg.norm(residual, axis=1) / np.sqrt(variances)
