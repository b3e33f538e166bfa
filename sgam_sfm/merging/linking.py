"""Which matches, and which tracks side by side, are to be joined, in the order in which they are."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.raw import ROWS_A_PART, VARIANCE, PairRows, RawMatches, batches_of, ends_of, weights_of
from sgam_sfm.merging.scratch import Scratch
from sgam_sfm.merging.sorting import stable_order
from sgam_sfm.merging.tracks import Tracks
from sgam_sfm.threads import in_order

_STEPS = 4  # of strength in an octave: a stronger match joins first, those alike in the order of their pairs
_MIDDLE = 2**13  # the level of strength 1; that of any number of single precision is within it
_SHARED = 1000  # no two tracks share more images, as far as their order is concerned
_DISTANCES = 32  # of tracks side by side that are told apart


def strongest_first(raw: RawMatches, scratch: Scratch) -> Iterator[np.ndarray]:
    """The different matches (E, 2) of keypoints: those with an inlier first, then by their sum of strength."""
    levels = scratch.sorted("edges", 2, np.int32)
    for edges, level in in_order(lambda batch: _edges_of(raw, batch), batches_of(raw)):
        levels.put(level, edges)
    return levels.take()


def _edges_of(raw: RawMatches, batch: list[PairRows]) -> tuple[np.ndarray, np.ndarray]:
    rows = raw.rows_of(batch)
    return _strengths(raw.index_of(batch), weights_of(rows), rows[:, VARIANCE], ends_of(batch))


@compiled
def _strengths(
    index: np.ndarray, weights: np.ndarray, variances: np.ndarray, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The different matches (E, 2) of keypoints, sorted in every pair, and their levels: smaller ones join first.

    Args: ends: of the matches of every pair.
    """
    edges, levels = np.empty((len(index), 2), np.int32), np.empty(len(index), np.int64)
    count, begin = 0, 0
    for end in ends:
        keys = (index[begin:end, 0].astype(np.int64) << 32) | index[begin:end, 1].astype(np.int64)
        order = np.argsort(keys, kind="mergesort")
        place = 0
        while place < len(order):
            key, support, num_inliers = keys[order[place]], 0.0, 0
            while place < len(order) and keys[order[place]] == key:
                variance = np.float64(variances[begin + order[place]])
                support += np.float64(weights[begin + order[place]]) / abs(variance)
                if variance > 0:
                    num_inliers += 1
                place += 1
            edges[count, 0], edges[count, 1] = key >> 32, key & 0xFFFFFFFF
            octave = np.floor(np.log2(support))
            step = np.floor((support / 2.0**octave - 1) * _STEPS)
            levels[count] = (0 if num_inliers else 2 * _MIDDLE) + _MIDDLE - int(octave * _STEPS + step)
            count += 1
        begin = end
    return edges[:count], levels[:count]


def side_by_side(tracks: Tracks, bounds: np.ndarray, min_shared: int, scratch: Scratch) -> Iterator[np.ndarray]:
    """Pairs of tracks (T, 2) near each other in at least `min_shared` images: most images first, then nearest."""
    num_parts = max(1, int(bounds[-1]) // ROWS_A_PART)
    parts = scratch.sorted("near", 3, np.int32)
    images = [(begin, end) for begin, end in pairwise(bounds.tolist()) if end > begin]
    for pairs, distances in in_order(lambda image: tracks.side_by_side(*image), images):
        rows = np.empty((len(pairs), 3), np.int32)
        rows[:, :2] = pairs
        rows.view(np.float32)[:, 2] = distances
        parts.put(pairs[:, 0].astype(np.int64) * num_parts // int(bounds[-1]), rows)
    levels = scratch.sorted("side_by_side", 2, np.int32)

    def shared_by(part: int) -> tuple[np.ndarray, np.ndarray]:
        rows = parts.take_label(part)
        keys = (rows[:, 0].astype(np.int64) << 32) | rows[:, 1]
        return _shared(rows, rows.view(np.float32)[:, 2], stable_order(keys), min_shared)

    for pairs, level in in_order(shared_by, parts.finish()):
        levels.put(level, pairs)
    return levels.take()


@compiled
def _shared(
    rows: np.ndarray, distances: np.ndarray, order: np.ndarray, min_shared: int
) -> tuple[np.ndarray, np.ndarray]:
    """The different pairs of tracks (T, 2) that are near in enough images, and their levels: smaller ones join first.

    Args: rows, distances: the pairs and their distances in one image each; order: such that equal ones follow.
    """
    pairs, levels, count, place = np.empty((len(rows), 2), np.int32), np.empty(len(rows), np.int64), 0, 0
    while place < len(order):
        one, other = rows[order[place], 0], rows[order[place], 1]
        shared, total = 0, 0.0
        while place < len(order) and rows[order[place], 0] == one and rows[order[place], 1] == other:
            total += distances[order[place]]
            shared += 1
            place += 1
        if shared >= min_shared:
            pairs[count, 0], pairs[count, 1] = one, other
            mean = min(int(total / shared * _DISTANCES), _DISTANCES - 1)
            levels[count] = (_SHARED - min(shared, _SHARED)) * _DISTANCES + mean
            count += 1
    return pairs[:count], levels[:count]
