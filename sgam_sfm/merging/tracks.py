"""Matches between numbered keypoints -> tracks of at most one keypoint per image.

Keypoints of the whole collection are numbered 0..K-1, image by image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from sgam_core.types import Box
from sgam_sfm.merging.alignment import align_keypoints, offsets_of
from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.grid import cells_around, grid_of

# What is known of a keypoint is in one row of 24 bytes, since most of the time goes into fetching it from memory. The
# keypoints that stand for a track in their images are linked in a ring; one that does not stand any more has minus its
# image, minus 1, and a link to what it became part of. A track's root has minus its number of members as its parent.
_PARENT, _LINK, _IMAGE, _X, _Y, _SIGMA = range(6)
_COLUMNS = 6
_MOST_REARRANGED = 2**26  # keypoints, which takes 1 GiB more: beyond, memory is worth more than time


class Tracks:
    """Tracks of keypoints, each with at most one keypoint in an image; every keypoint is one of its own to begin with.

    It takes 24 bytes a keypoint and nothing for a match; up to 1 GiB more while tracks are joined with each other.

    points (K, 2), images (K,), sigmas (K,): of the keypoints. radius: matcher pixels within which two keypoints of an
    image may become one.
    """

    def __init__(self, points: np.ndarray, images: np.ndarray, sigmas: np.ndarray, radius: float) -> None:
        self._begin(len(images), int(images.max(initial=-1)) + 1, radius)
        self._fill(0, points, images, sigmas)

    @classmethod
    def of_images(cls, bounds: np.ndarray, keypoints: Callable[[int, int], np.ndarray], radius: float) -> Tracks:
        """The same for keypoints that are read image by image.

        Args: bounds: (N + 1,) where those of each image begin. keypoints: place and sigma (n, 3) of a number of
            keypoints from one on; more columns are left alone.
        """
        tracks = cls.__new__(cls)
        tracks._begin(int(bounds[-1]), len(bounds) - 1, radius)
        for image, (begin, end) in enumerate(pairwise(bounds.tolist())):
            told = keypoints(begin, end - begin)
            tracks._fill(begin, told[:, :2], np.full(end - begin, image), told[:, 2])
        return tracks

    def _begin(self, count: int, num_images: int, radius: float) -> None:
        self._rows = np.empty((count, _COLUMNS), np.int32)
        self._values = self._rows.view(np.float32)
        self._num_images = num_images
        self._radius = radius

    def _fill(self, begin: int, points: np.ndarray, images: np.ndarray, sigmas: np.ndarray) -> None:
        here = slice(begin, begin + len(images))
        self._rows[here, _PARENT], self._rows[here, _IMAGE] = -1, images
        self._rows[here, _LINK] = np.arange(here.start, here.stop)
        self._values[here, _X : _Y + 1], self._values[here, _SIGMA] = points, sigmas

    def linked(self, index: Int[np.ndarray, "M 2"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The matches whose keypoints are in one track.

        Returns: their rows (L,); the keypoints (L, 2) that theirs have become part of, themselves for most; the track
        of each (L,), by the keypoint that gives it its number.
        """
        return _linked(self._rows, index)

    def offsets(
        self, index: Int[np.ndarray, "M 2"], matches: Float[np.ndarray, "M 4"], affine: Float[np.ndarray, "M 4"]
    ) -> Float[np.ndarray, "M 2"]:
        """How far keypoints lie from where their matches put them, see `offsets_of`."""
        return offsets_of(self._values[:, _X : _Y + 1], index, matches, affine)

    def points(self, keypoints: np.ndarray | slice) -> Float[np.ndarray, "K 2"]:
        """Where keypoints lie."""
        return self._values[keypoints, _X : _Y + 1].astype(np.float64)

    def join(self, edges: Int[np.ndarray, "E 2"]) -> None:
        """Make one track of those of each edge's keypoints, unless that needs one keypoint at two distant spots.

        The edges are taken one after the other.
        """
        _join(self._rows, self._values, self._num_images, edges, self._radius, 0)

    def join_tracks(self, edges: Iterable[np.ndarray], min_shared: int) -> None:
        """The same for edges (E, 2) that come in parts, between tracks that have grown already.

        min_shared: number of images that both tracks of an edge must be in.
        """
        if len(self._rows) > _MOST_REARRANGED:
            for part in edges:
                _join(self._rows, self._values, self._num_images, part, self._radius, min_shared)
            return
        place = _track_by_track(self._rows)  # those of a track next to each other are in reach of each other
        origin = np.empty_like(place)
        origin[place] = np.arange(len(place), dtype=np.int32)
        _rearrange(self._rows, place, origin)
        for part in edges:
            _join(self._rows, self._values, self._num_images, place[part], self._radius, min_shared)
        _rearrange(self._rows, origin, place)

    def settle(self, begin: int, weights: np.ndarray, octave: float) -> None:
        """End joining: put every standing keypoint of an image to the mean of those that became part of it.

        begin: the first keypoint of the image. weights: of its keypoints. octave: those whose sigma is so many times
        that of the standing one have no say.
        """
        _settle(self._rows, self._values, begin, weights.astype(np.float64), octave)

    def align(
        self, index: np.ndarray, tracks: np.ndarray, offsets: np.ndarray, affine: np.ndarray, weights: np.ndarray
    ) -> None:
        """Move the keypoints of whole tracks to where their matches agree, once they are settled.

        See `align_keypoints`.
        """
        points, sigmas, slots = self._values[:, _X : _Y + 1], self._values[:, _SIGMA], self._rows[:, _LINK]
        align_keypoints(points, sigmas, slots, index, tracks, offsets, affine, weights)

    def leave_out(self, begin: int, end: int, mask: Bool[np.ndarray, "H W"]) -> None:
        """Put the keypoints of an image that are not where its mask is True nowhere: no match agrees with them.

        begin, end: the keypoints of the image. All are aligned.
        """
        points = self._values[begin:end, _X : _Y + 1]
        wanted = Box(x0=0, y0=0, x1=mask.shape[1], y1=mask.shape[0]).contains(points)
        x, y = points[wanted].astype(int).T
        wanted[wanted] = mask[y, x]
        points[~wanted] = np.nan

    def mark_used(self, keypoints: np.ndarray) -> None:
        """Mark keypoints as used, once all are aligned."""
        self._rows[keypoints, _LINK] = 0

    def number_used(self, begin: int, end: int) -> Int[np.ndarray, " N"]:
        """The used ones among the keypoints of an image, which are numbered 0, 1, ... from now on."""
        used = np.flatnonzero((self._rows[begin:end, [_LINK, _IMAGE]] >= 0).all(axis=1)) + begin
        self._rows[used, _LINK] = np.arange(len(used))
        return used

    def number(self, keypoints: np.ndarray) -> Int[np.ndarray, " *_"]:
        """The numbers of used keypoints in their images."""
        return self._rows[keypoints, _LINK]

    def side_by_side(self, begin: int, end: int) -> tuple[Int32[np.ndarray, "T 2"], Float32[np.ndarray, " T"]]:
        """Pairs of tracks, smaller number first, with keypoints of one image within the radius, and their distances.

        begin, end: the keypoints of the image. Distances are in units of the radius.
        """
        return _near_tracks(self._rows, self._values, begin, end, self._radius)


@compiled
def _seen_root(rows: np.ndarray, keypoint: int) -> int:
    """The root of a keypoint, nothing changed: threads may ask."""
    while rows[keypoint, _PARENT] >= 0:
        keypoint = rows[keypoint, _PARENT]
    return keypoint


@compiled
def _root(rows: np.ndarray, keypoint: int) -> int:
    """The same, and a shorter way to it from now on."""
    root = _seen_root(rows, keypoint)
    while keypoint != root:
        above = rows[keypoint, _PARENT]
        rows[keypoint, _PARENT] = root
        keypoint = above
    return root


@compiled
def _stands(rows: np.ndarray, keypoint: int) -> int:
    while rows[keypoint, _IMAGE] < 0:
        keypoint = rows[keypoint, _LINK]
    return keypoint


@compiled
def _linked(rows: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    kept, standing = np.empty(len(index), np.int64), np.empty((len(index), 2), np.int64)
    tracks, count = np.empty(len(index), np.int64), 0
    for row in range(len(index)):
        root = _seen_root(rows, index[row, 0])
        if root == _seen_root(rows, index[row, 1]):
            kept[count], tracks[count] = row, root
            standing[count, 0], standing[count, 1] = _stands(rows, index[row, 0]), _stands(rows, index[row, 1])
            count += 1
    return kept[:count], standing[:count], tracks[:count]


@compiled
def _track_by_track(rows: np.ndarray) -> np.ndarray:
    """A place (K,) for every keypoint such that those of a track that stand for it are next to each other."""
    place, count = np.full(len(rows), -1, np.int32), 0
    for root in range(len(rows)):
        if rows[root, _PARENT] >= 0:
            continue
        first = _stands(rows, root)
        member = first
        while True:
            place[member] = count
            count += 1
            member = rows[member, _LINK]
            if member == first:
                break
    for keypoint in range(len(rows)):
        if place[keypoint] < 0:
            place[keypoint] = count
            count += 1
    return place


def _rearrange(rows: np.ndarray, place: np.ndarray, origin: np.ndarray) -> None:
    """Move every keypoint to its place, and all that refers to it along.

    Args: origin: the keypoint that comes to every place.
    """
    words = rows.view(np.int64)
    for column in range(words.shape[1]):  # one after the other: there is no memory for all of them twice
        words[:, column] = words[origin, column]
    _rename(rows, place)


@compiled
def _rename(rows: np.ndarray, names: np.ndarray) -> None:
    for row in range(len(rows)):
        if rows[row, _PARENT] >= 0:
            rows[row, _PARENT] = names[rows[row, _PARENT]]
        rows[row, _LINK] = names[rows[row, _LINK]]


@compiled
def _join(
    rows: np.ndarray, values: np.ndarray, num_images: int, edges: np.ndarray, radius: float, min_shared: int
) -> None:
    # Of every image the last edge whose second track was in it, and the keypoint of that track there.
    stamps = np.full((num_images, 2), -1, np.int64)
    for edge in range(len(edges)):
        kept, gone = _root(rows, edges[edge, 0]), _root(rows, edges[edge, 1])
        if kept == gone:
            continue
        if rows[kept, _PARENT] > rows[gone, _PARENT]:
            kept, gone = gone, kept
        first = _stands(rows, gone)
        member = first
        while True:
            image = rows[member, _IMAGE]
            stamps[image, 0], stamps[image, 1] = edge, member
            member = rows[member, _LINK]
            if member == first:
                break
        shared, fine = 0, True
        entry = _stands(rows, kept)
        member = entry
        while True:
            image = rows[member, _IMAGE]
            if stamps[image, 0] == edge:
                other = stamps[image, 1]
                shared += 1
                step_x = np.float64(values[member, _X]) - values[other, _X]
                step_y = np.float64(values[member, _Y]) - values[other, _Y]
                reach = radius * max(values[member, _SIGMA], values[other, _SIGMA])
                if step_x**2 + step_y**2 > reach**2:
                    fine = False
                    break
            member = rows[member, _LINK]
            if member == entry:
                break
        if not fine or shared < min_shared:
            continue
        if shared:
            rows[kept, _PARENT] = -_one_ring(rows, values, stamps, edge, entry, first)
        else:
            rows[entry, _LINK], rows[first, _LINK] = rows[first, _LINK], rows[entry, _LINK]
            rows[kept, _PARENT] += rows[gone, _PARENT]
        rows[gone, _PARENT] = kept


@compiled
def _one_ring(rows: np.ndarray, values: np.ndarray, stamps: np.ndarray, edge: int, entry: int, first: int) -> int:
    """One ring of two, with the finer of two keypoints of an image.

    Args: entry, first: a keypoint of either. stamps: the second ring's, see `_join`; they are changed.
    Returns: the length of the ring.
    """
    head, last, count = -1, -1, 0
    for start in (entry, first):
        member = start
        while True:
            follower, image = rows[member, _LINK], rows[member, _IMAGE]
            other, stays = stamps[image, 1], True
            if start == entry and stamps[image, 0] == edge:
                stays = values[other, _SIGMA] >= values[member, _SIGMA]
                if stays:
                    stamps[image, 1] = -2 - member  # told to the other one when its turn comes
                else:
                    rows[member, _LINK] = other
            elif start == first:
                stays = other >= 0
                if not stays:
                    rows[member, _LINK] = -2 - other
            if not stays:
                rows[member, _IMAGE] = -1 - image
            else:
                if head < 0:
                    head = member
                else:
                    rows[last, _LINK] = member
                last = member
                count += 1
            member = follower
            if member == start:
                break
    rows[last, _LINK] = head
    return count


@compiled
def _settle(rows: np.ndarray, values: np.ndarray, begin: int, weights: np.ndarray, octave: float) -> None:
    for place in range(len(weights)):
        keypoint = begin + place
        stands = _stands(rows, keypoint)
        if stands == keypoint or values[keypoint, _SIGMA] >= octave * values[stands, _SIGMA]:
            continue
        share = weights[place] / (weights[place] + weights[stands - begin])
        for axis in (_X, _Y):
            values[stands, axis] += share * (values[keypoint, axis] - values[stands, axis])
        weights[stands - begin] += weights[place]
    for keypoint in range(begin, begin + len(weights)):
        if rows[keypoint, _IMAGE] >= 0:
            rows[keypoint, _LINK] = -1


@compiled
def _near_tracks(
    rows: np.ndarray, values: np.ndarray, begin: int, end: int, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    coarsest, count = np.float64(0.0), 0
    standing, roots = np.empty(end - begin, np.int64), np.empty(end - begin, np.int64)
    points = np.empty((end - begin, 2))
    for keypoint in range(begin, end):
        if rows[keypoint, _IMAGE] < 0:
            continue
        coarsest = max(coarsest, np.float64(values[keypoint, _SIGMA]))
        points[count, 0], points[count, 1] = values[keypoint, _X], values[keypoint, _Y]
        standing[count], roots[count] = keypoint, _seen_root(rows, keypoint)
        count += 1
    points = points[:count]
    widest = radius * coarsest
    frame, start, order = grid_of(points, widest / 2)
    lines = int(frame[4])
    pairs, distances = np.empty((64, 2), np.int32), np.empty(64, np.float32)
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
