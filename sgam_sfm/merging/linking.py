"""Which matches, and which tracks side by side, are to be joined, in the order in which they are."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.raw import ROWS_A_PART, VARIANCE, PairRows, RawMatches, batches_of, weights_of
from sgam_sfm.merging.scratch import Scratch
from sgam_sfm.merging.sorting import stable_order
from sgam_sfm.merging.tracks import Tracks
from sgam_sfm.threads import in_order

_STEPS = 16  # of strength in an octave: a stronger match joins first, those alike in the order of their pairs
_MIDDLE = 2**13  # the level of strength 1; that of any number of single precision is within it
_SHARED = 1000  # no two tracks share more images, as far as their order is concerned


def strongest_first(raw: RawMatches, scratch: Scratch) -> Iterator[np.ndarray]:
    """The different matches (E, 2) of keypoints: those with an inlier first, then by their sum of strength."""
    levels = scratch.sorted("edges", 2, np.int32)
    for edges, level in in_order(lambda batch: _edges_of(raw, batch), batches_of(raw)):
        levels.put(level, edges)
    return levels.take()


def _edges_of(raw: RawMatches, batch: list[PairRows]) -> tuple[np.ndarray, np.ndarray]:
    found = []
    for pair in batch:
        rows, index = raw.rows.read(pair.begin, pair.length), raw.index_of(pair)
        found.append(_strengths(index, weights_of(rows), rows[:, VARIANCE]))
    edges, levels = zip(*found, strict=True)
    return np.concatenate(edges), np.concatenate(levels)


@compiled
def _strengths(index: np.ndarray, weights: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different matches (E, 2) of a pair's keypoints, sorted, and the level of each: smaller levels join first."""
    keys = (index[:, 0].astype(np.int64) << 32) | index[:, 1].astype(np.int64)
    order = np.argsort(keys, kind="mergesort")
    edges, levels = np.empty((len(keys), 2), np.int32), np.empty(len(keys), np.int64)
    count, place = 0, 0
    while place < len(order):
        key, support, num_inliers = keys[order[place]], 0.0, 0
        while place < len(order) and keys[order[place]] == key:
            variance = np.float64(variances[order[place]])
            support += np.float64(weights[order[place]]) / abs(variance)
            if variance > 0:
                num_inliers += 1
            place += 1
        edges[count, 0], edges[count, 1] = key >> 32, key & 0xFFFFFFFF
        octave = np.floor(np.log2(support))
        step = np.floor((support / 2.0**octave - 1) * _STEPS)
        levels[count] = (0 if num_inliers else 2 * _MIDDLE) + _MIDDLE - int(octave * _STEPS + step)
        count += 1
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
        parts.put(pairs[:, 0] * num_parts // int(bounds[-1]), rows)
    levels = scratch.sorted("side_by_side", 2, np.int32)
    for pairs, shared, distance in in_order(lambda part: _shared(parts.take_label(part)), parts.finish()):
        level = (_SHARED - np.minimum(shared, _SHARED)) * 2 * _STEPS + (distance * 2 * _STEPS).astype(np.int64)
        wanted = shared >= min_shared
        levels.put(level[wanted], pairs[wanted])
    return levels.take()


def _shared(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The different pairs of tracks (T, 2), in how many images they are near, and their mean distance there."""
    keys = (rows[:, 0].astype(np.int64) << 32) | rows[:, 1].astype(np.int64)
    order = stable_order(keys)
    begins = np.flatnonzero(np.diff(keys[order], prepend=-1))
    distances = rows.view(np.float32)[order, 2].astype(np.float64)
    shared = np.diff(begins, append=len(keys))
    mean = np.add.reduceat(distances, begins) / shared if len(begins) else distances
    return rows[order[begins], :2], shared, np.minimum(mean, 1 - 1e-9)
