"""Matches between numbered keypoints -> tracks of at most one keypoint per image.

Keypoints of the whole collection are numbered 0..K-1, image by image.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from sgam_sfm.alignment import align_keypoints
from sgam_sfm.compiled import compiled
from sgam_sfm.grid import cells_around, grid_of

# What is known of a keypoint is in one row of 32 bytes, since most of the time goes into fetching it from memory.
_PARENT, _NEXT, _IMAGE, _STANDS = 0, 1, 2, 3  # a track's root has minus the number of its members as its parent
_X, _Y, _SIGMA, _WEIGHT = 4, 5, 6, 7
_COLUMNS = 8


class Tracks:
    """Tracks of keypoints, each with at most one keypoint in an image; every keypoint is one of its own to begin with.

    It takes 32 bytes a keypoint and nothing for a match.

    points (K, 2), images (K,), sigmas (K,): of the keypoints. weights (K,): of their points, 1 when left out. radius:
    matcher pixels within which two keypoints of an image may become one.
    """

    def __init__(
        self,
        points: np.ndarray,
        images: np.ndarray,
        sigmas: np.ndarray,
        radius: float,
        weights: np.ndarray | None = None,
    ) -> None:
        self._begin(len(images), int(images.max(initial=-1)) + 1, radius)
        self._fill(0, points, images, sigmas, np.ones(len(images)) if weights is None else weights)

    @classmethod
    def of_images(cls, bounds: np.ndarray, keypoints: Callable[[int, int], np.ndarray], radius: float) -> Tracks:
        """The same for keypoints that are read image by image.

        Args: bounds: (N + 1,) where those of each image begin. keypoints: place, sigma and weight (n, 4) of a number of
            keypoints from one on.
        """
        tracks = cls.__new__(cls)
        tracks._begin(int(bounds[-1]), len(bounds) - 1, radius)
        for image, (begin, end) in enumerate(pairwise(bounds.tolist())):
            told = keypoints(begin, end - begin)
            tracks._fill(begin, told[:, :2], np.full(end - begin, image), told[:, 2], told[:, 3])
        return tracks

    def _begin(self, count: int, num_images: int, radius: float) -> None:
        self._rows = np.empty((count, _COLUMNS), np.int32)
        self._values = self._rows.view(np.float32)
        self._stamps = np.full(num_images, -1, np.int32)
        self._radius = radius

    def _fill(
        self, begin: int, points: np.ndarray, images: np.ndarray, sigmas: np.ndarray, weights: np.ndarray
    ) -> None:
        here = slice(begin, begin + len(images))
        self._rows[here, _PARENT], self._rows[here, _IMAGE] = -1, images
        self._rows[here, _NEXT] = self._rows[here, _STANDS] = np.arange(here.start, here.stop)
        self._values[here, _X : _Y + 1], self._values[here, _SIGMA] = points, sigmas
        self._values[here, _WEIGHT] = weights

    def track(self, keypoints: np.ndarray | None = None) -> Int[np.ndarray, " K"]:
        """The keypoint that gives each of some keypoints' track its number; of all when left out."""
        return _roots(self._rows, np.arange(len(self._rows)) if keypoints is None else keypoints)

    def representative(self, keypoints: np.ndarray | None = None) -> Int[np.ndarray, " K"]:
        """The keypoint of the same image and track that each has become part of, itself for most."""
        return _standing(self._rows, np.arange(len(self._rows)) if keypoints is None else keypoints)

    def points(self, keypoints: np.ndarray | slice) -> Float[np.ndarray, "K 2"]:
        """Where keypoints lie."""
        return self._values[keypoints, _X : _Y + 1].astype(np.float64)

    def join(self, edges: Int[np.ndarray, "E 2"], min_shared: int = 0) -> None:
        """Make one track of those of each edge's keypoints, unless that needs one keypoint at two distant spots.

        The edges are taken one after the other.

        min_shared: number of images that both tracks of an edge must be in.
        """
        _join(self._rows, self._values, self._stamps, edges, self._radius, min_shared)

    def settle(self, octave: float) -> None:
        """End joining: put every standing keypoint to the mean of those that became part of it, by weight.

        octave: those whose sigma is so many times its own have no say.
        """
        _settle(self._rows, self._values, octave)
        self._rows[:, _NEXT] = -1

    def align(
        self, index: np.ndarray, tracks: np.ndarray, offsets: np.ndarray, affine: np.ndarray, weights: np.ndarray
    ) -> None:
        """Move the keypoints of whole tracks to where their matches agree, once they are settled.

        See `align_keypoints`.
        """
        points, sigmas, slots = self._values[:, _X : _Y + 1], self._values[:, _SIGMA], self._rows[:, _NEXT]
        align_keypoints(points, sigmas, slots, index, tracks, offsets, affine, weights)

    def mark_used(self, keypoints: np.ndarray) -> None:
        """Mark keypoints as used, once all are aligned."""
        self._rows[keypoints, _NEXT] = 0

    def number_used(self, begin: int, end: int) -> Int[np.ndarray, " N"]:
        """The used ones among the keypoints of an image, which are numbered 0, 1, ... from now on."""
        used = np.flatnonzero(self._rows[begin:end, _NEXT] >= 0) + begin
        self._rows[used, _NEXT] = np.arange(len(used))
        return used

    def number(self, keypoints: np.ndarray) -> Int[np.ndarray, " *_"]:
        """The numbers of used keypoints in their images."""
        return self._rows[keypoints, _NEXT]

    def side_by_side(self, begin: int, end: int) -> tuple[Int[np.ndarray, "T 2"], Float[np.ndarray, " T"]]:
        """Pairs of tracks, smaller number first, with keypoints of one image within the radius, and their distances.

        begin, end: the keypoints of the image. Distances are in units of the radius.
        """
        return _near_tracks(self._rows, self._values, begin, end, self._radius)


@compiled
def _root(rows: np.ndarray, keypoint: int) -> int:
    root = keypoint
    while rows[root, _PARENT] >= 0:
        root = rows[root, _PARENT]
    while keypoint != root:
        above = rows[keypoint, _PARENT]
        rows[keypoint, _PARENT] = root
        keypoint = above
    return root


@compiled
def _roots(rows: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    found = np.empty(len(keypoints), np.int64)
    for place in range(len(keypoints)):
        root = keypoints[place]
        while rows[root, _PARENT] >= 0:
            root = rows[root, _PARENT]
        found[place] = root
    return found


@compiled
def _standing(rows: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    found = np.empty(len(keypoints), np.int64)
    for place in range(len(keypoints)):
        keypoint = keypoints[place]
        while rows[keypoint, _STANDS] != keypoint:
            keypoint = rows[keypoint, _STANDS]
        found[place] = keypoint
    return found


@compiled
def _join(
    rows: np.ndarray, values: np.ndarray, stamps: np.ndarray, edges: np.ndarray, radius: float, min_shared: int
) -> None:
    """The standing keypoints of a track are linked in a ring by `_NEXT`."""
    for edge in range(len(edges)):
        kept, gone = _root(rows, edges[edge, 0]), _root(rows, edges[edge, 1])
        if kept == gone:
            continue
        if rows[kept, _PARENT] > rows[gone, _PARENT]:
            kept, gone = gone, kept
        # The ring of a track may begin at a keypoint that no longer stands: `_NEXT` of the root still leads into it.
        first = rows[gone, _NEXT]
        member = first
        while True:
            stamps[rows[member, _IMAGE]] = member
            member = rows[member, _NEXT]
            if member == first:
                break
        shared, fine = 0, True
        entry = rows[kept, _NEXT]
        member = entry
        while True:
            other = stamps[rows[member, _IMAGE]]
            if other >= 0:
                shared += 1
                step_x = np.float64(values[member, _X]) - values[other, _X]
                step_y = np.float64(values[member, _Y]) - values[other, _Y]
                reach = radius * max(values[member, _SIGMA], values[other, _SIGMA])
                if step_x**2 + step_y**2 > reach**2:
                    fine = False
                    break
            member = rows[member, _NEXT]
            if member == entry:
                break
        if fine and shared >= min_shared:
            _unite(rows, values, stamps, kept, gone, first, shared)
        else:
            member = first
            while True:
                stamps[rows[member, _IMAGE]] = -1
                member = rows[member, _NEXT]
                if member == first:
                    break


@compiled
def _unite(
    rows: np.ndarray, values: np.ndarray, stamps: np.ndarray, kept: int, gone: int, first: int, shared: int
) -> None:
    """One ring of two, with the finer of two keypoints in an image; clears the stamps."""
    before = rows[kept, _NEXT]  # a keypoint of the ring: walk it once, dropping those that do not stand any more
    ring_first, ring_last, count = -1, -1, 0
    member = before
    while True:
        follower = rows[member, _NEXT]
        image = rows[member, _IMAGE]
        other = stamps[image]
        if other >= 0 and values[other, _SIGMA] < values[member, _SIGMA]:
            rows[member, _STANDS] = other
        else:
            if other >= 0:
                rows[other, _STANDS] = member
                stamps[image] = -1
            if ring_first < 0:
                ring_first = member
            else:
                rows[ring_last, _NEXT] = member
            ring_last = member
            count += 1
        member = follower
        if member == before:
            break
    member = first
    while True:
        follower = rows[member, _NEXT]
        if stamps[rows[member, _IMAGE]] == member:
            stamps[rows[member, _IMAGE]] = -1
            if ring_first < 0:
                ring_first = member
            else:
                rows[ring_last, _NEXT] = member
            ring_last = member
            count += 1
        member = follower
        if member == first:
            break
    rows[ring_last, _NEXT] = ring_first
    # Where the root itself no longer stands it keeps a way into the ring.
    if rows[kept, _STANDS] != kept:
        rows[kept, _NEXT] = ring_first
    rows[kept, _PARENT] = -count
    rows[gone, _PARENT] = kept


@compiled
def _settle(rows: np.ndarray, values: np.ndarray, octave: float) -> None:
    for keypoint in range(len(rows)):
        stands = keypoint
        while rows[stands, _STANDS] != stands:
            stands = rows[stands, _STANDS]
        if stands == keypoint or values[keypoint, _SIGMA] >= octave * values[stands, _SIGMA]:
            continue
        share = values[keypoint, _WEIGHT] / (values[keypoint, _WEIGHT] + values[stands, _WEIGHT])
        for axis in (_X, _Y):
            values[stands, axis] += share * (values[keypoint, axis] - values[stands, axis])
        values[stands, _WEIGHT] += values[keypoint, _WEIGHT]


@compiled
def _near_tracks(
    rows: np.ndarray, values: np.ndarray, begin: int, end: int, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    coarsest, count = np.float64(0.0), 0
    standing, roots = np.empty(end - begin, np.int64), np.empty(end - begin, np.int64)
    points = np.empty((end - begin, 2))
    for keypoint in range(begin, end):
        if rows[keypoint, _STANDS] != keypoint:
            continue
        coarsest = max(coarsest, np.float64(values[keypoint, _SIGMA]))
        points[count, 0], points[count, 1] = values[keypoint, _X], values[keypoint, _Y]
        root = keypoint
        while rows[root, _PARENT] >= 0:
            root = rows[root, _PARENT]
        standing[count], roots[count] = keypoint, root
        count += 1
    points = points[:count]
    widest = radius * coarsest
    frame, start, order = grid_of(points, widest / 2)
    lines = int(frame[4])
    pairs, distances = np.empty((64, 2), np.int64), np.empty(64)
    count = 0
    for one in range(len(points)):
        left, right, top, bottom = cells_around(frame, points[one, 0], points[one, 1], widest)
        for column in range(left, right):
            for place in range(start[column * lines + top], start[column * lines + bottom]):
                other = order[place]
                if other <= one:
                    continue
                sigma = max(values[standing[one], _SIGMA], values[standing[other], _SIGMA])
                reach = radius * np.float64(sigma)
                squared = (points[one, 0] - points[other, 0]) ** 2 + (points[one, 1] - points[other, 1]) ** 2
                if squared > reach * reach:
                    continue
                if count == len(pairs):
                    pairs, distances = np.concatenate((pairs, pairs)), np.concatenate((distances, distances))
                pairs[count, 0], pairs[count, 1] = min(roots[one], roots[other]), max(roots[one], roots[other])
                distances[count] = np.sqrt(squared) / reach
                count += 1
    return pairs[:count], distances[:count]
