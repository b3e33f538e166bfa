"""Point matches per pair -> keypoints per image and index matches per pair, as COLMAP needs them.

A semi-dense matcher gives every pair points of its own, so its raw matches make tracks of two images. Four steps:

1. `merge_image`: points of one image that coincide become one keypoint.
2. `Tracks`: matches link keypoints into tracks of at most one keypoint per image, strongest match first. Tracks that
   run side by side through several images show the same spot on different grids and are joined, too: without that, the
   tracks of a matcher that puts one side of each match on a grid end wherever an image changes sides.
3. `align_keypoints`: a joined keypoint lies between the points it was made of, so all keypoints move, by fractions of
   a matcher pixel, to where the matches of their track agree best; each match is carried to its keypoints along the
   local affine map of its pair.
4. Matches that still disagree with their keypoints are dropped.

With the photos, step 3 is done once more: each match is measured again at its keypoints, by aligning the patches around
them at full resolution.

Distances are in matcher pixels (image pixels / sigma), so that coarse and fine matches are judged alike. The input is
only read: merging can be repeated with other options.

Memory does not grow with the matches. They are kept in one file, a row each, which every step reads again, pair by pair
or image by image; what must be in another order is sorted on disk. In memory are 24 bytes a keypoint, at times up to
1 GiB more, and small records of images and pairs. Results do not depend on the order of the pairs, nor on the number of
threads.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from sgam_core.errors import InputError, ShapeError
from sgam_core.types import Matches
from sgam_sfm.matchers.subpixel import refine
from sgam_sfm.merging.affine import local_affine
from sgam_sfm.merging.alignment import offsets_of
from sgam_sfm.merging.clusters import finest_and_weight, merge_image
from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.keypoints import CollectionKeypoints, KeypointOptions
from sgam_sfm.merging.scratch import Rows, Scratch, batches, in_order
from sgam_sfm.merging.sorting import stable_order
from sgam_sfm.merging.tracks import Tracks
from sgam_sfm.pairs import Pair

_log = logging.getLogger(__name__)

_FOLDER = ".merging"
_MIN_WEIGHT = 1e-3  # a match of score 0 still has a place
_OCTAVE = 2.0  # points whose sigma is so many times the finest have no say in where a keypoint lies
_AT_ONCE = 2**15  # matches in one go
_ROWS_A_PART = 2**18  # rows that are sorted in memory
_STEPS = 16  # of strength in an octave: a stronger match joins first, those alike in the order of their pairs
_MIDDLE = 2**13  # the level of strength 1; that of any number of single precision is within it
_SHARED = 1000  # no two tracks share more images, as far as their order is concerned

_PATCHES_AT_ONCE = 2**13
_LARGEST_MOVE = 2.0  # matcher pixels: what moves further has slid along an edge
_SURE_CORRELATION = 0.85  # of two patches whose alignment counts
_MEASURED_VARIANCE = 0.05  # of a match that was measured again, against what it was before

# The columns of a match: its points, sigmas and score, its variance in squared image-1 pixels (below 0 for one that
# does not agree with the geometry of its pair) and the local affine map from image 0 to image 1.
_POINTS, _SIGMAS, _SCORE, _VARIANCE, _AFFINE = slice(0, 4), slice(4, 6), 6, 7, slice(8, 12)
_WIDTH = 12

RawPair = tuple[Pair, Matches, np.ndarray | None]
"""A pair, its matches, and (M,) which of them agree with its geometry; None for all."""

Photos = Callable[[str], np.ndarray]
"""The gray values (H, W) of an image, uint8, by its name; threads may ask."""

Key = TypeVar("Key")


class _PairRows(NamedTuple):
    """Where the matches of a pair are; image0 < image1 are rows in the sorted names."""

    pair: Pair
    image0: int
    image1: int
    begin: int
    length: int


@dataclass(frozen=True, kw_only=True, slots=True)
class _Raw:
    """All matches; index: the keypoints of both sides of every match, once these are known."""

    names: list[str]
    pairs: list[_PairRows]
    rows: Rows
    index: tuple[Rows, Rows]

    def index_of(self, pair: _PairRows) -> np.ndarray:
        """(M, 2) keypoints of a pair's matches."""
        return np.concatenate([side.read(pair.begin, pair.length) for side in self.index], axis=1)


class OnDisk(Mapping[Key, np.ndarray]):
    """Arrays that are read when they are asked for."""

    def __init__(self, keys: Mapping[Key, int], read: Callable[[int], np.ndarray]) -> None:
        self._keys, self._read = keys, read

    def __getitem__(self, key: Key) -> np.ndarray:
        return self._read(self._keys[key])

    def __iter__(self) -> Iterator[Key]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)


def merge_keypoints(
    pairs: Mapping[Pair, Matches],
    options: KeypointOptions | None = None,
    inliers: Mapping[Pair, np.ndarray] | None = None,
) -> CollectionKeypoints:
    """Merge the matches of all pairs into keypoints per image and one-to-one index matches per pair, all in memory.

    Args: pairs: raw matches in full-image pixels; each is read once, so a mapping that loads from disk will do.
        options: the defaults when None. inliers: (M,) bool for some or all pairs, which matches agree with the pair's
        robust geometry; the others join tracks last.
    Returns: keypoints of every image of the pairs and matches of every pair; the order of the mapping does not matter.
    Raises: InputError when a pair holds one image twice or comes in both orders; ShapeError for a mask that does not
        fit its matches.
    """
    raw = ((pair, pairs[pair], (inliers or {}).get(pair)) for pair in pairs)
    with tempfile.TemporaryDirectory() as folder, merging(raw, Path(folder), options) as merged:
        return replace(
            merged, keypoints=dict(merged.keypoints), matches=dict(merged.matches), scores=dict(merged.scores)
        )


@contextmanager
def merging(
    pairs: Iterable[RawPair], output: Path, options: KeypointOptions | None = None, photos: Photos | None = None
) -> Iterator[CollectionKeypoints]:
    """`merge_keypoints` for collections of any size: the arrays are read from disk when they are asked for.

    Args: output: gets a folder of up to about 130 bytes a match, which is removed at the end of the context.
        photos: asked for when the options say `refine`.
    """
    options = options or KeypointOptions()
    with Scratch(output / _FOLDER) as scratch:
        raw = _collect(pairs, scratch)
        bounds, told = _merge_images(raw, options.cluster_radius_px, scratch)
        tracks = Tracks.of_images(bounds, told.read, options.track_radius_px)
        for edges in _strongest_first(raw, scratch):
            tracks.join(edges)
        if options.track_radius_px > 0 and options.min_shared_images > 0:
            near = _side_by_side(tracks, bounds, options.min_shared_images, scratch)
            tracks.join_tracks(near, options.min_shared_images)
        for begin, end in pairwise(bounds.tolist()):
            tracks.settle(begin, told.read(begin, end - begin)[:, 3], _OCTAVE)
        num_conflicts = _align(raw, tracks, scratch)
        if options.refine and photos is not None:
            _measure_again(raw, tracks, photos, options.max_residual_sigmas)
            _align(raw, tracks, scratch)
        merged = _export(raw, tracks, bounds, options.max_residual_sigmas, num_conflicts, scratch)
        del tracks
        _log.info(
            "%d raw matches -> %d between %d keypoints (%d duplicates, %d conflicts, %d inconsistent)",
            merged.num_raw,
            merged.num_matches,
            sum(map(len, merged.keypoints.values())),
            merged.num_duplicates,
            merged.num_conflicts,
            merged.num_inconsistent,
        )
        yield merged


def _collect(pairs: Iterable[RawPair], scratch: Scratch) -> _Raw:
    rows = scratch.rows("matches.rows", _WIDTH, np.float32)
    found: dict[Pair, tuple[Pair, int, int]] = {}
    for pair, part in in_order(_rows_of, pairs):
        key = (min(pair), max(pair))
        if key in found:
            raise InputError(f"the pair of '{key[0]}' and '{key[1]}' comes in both orders; keep one of them")
        found[key] = (pair, rows.count, len(part))
        rows.append(part)
    names = sorted({name for key in found for name in key})
    row_of = {name: row for row, name in enumerate(names)}
    sides = [scratch.rows(f"keypoints{side}.rows", 1, np.int32) for side in (0, 1)]
    return _Raw(
        names=names,
        pairs=[_PairRows(pair, row_of[a], row_of[b], *where) for (a, b), (pair, *where) in sorted(found.items())],
        rows=rows,
        index=(sides[0], sides[1]),
    )


def _rows_of(raw: RawPair) -> tuple[Pair, np.ndarray]:
    """The matches of a pair as they are kept."""
    pair, matches, mask = raw
    if pair[0] == pair[1]:
        raise InputError(f"pair ('{pair[0]}', '{pair[1]}') matches an image with itself; remove it from the pairs")
    mask = np.ones(len(matches), bool) if mask is None else mask
    if mask.shape != (len(matches),) or mask.dtype != np.bool_:
        raise ShapeError(
            f"inliers of pair {pair} are {mask.dtype} {mask.shape}; expected bool ({len(matches)},), one per match"
        )
    matches = matches if pair[0] < pair[1] else matches.swapped()
    rows = np.empty((len(matches), _WIDTH), np.float32)
    rows[:, 0:2], rows[:, 2:4] = matches.points0, matches.points1
    rows[:, 4], rows[:, 5], rows[:, _SCORE] = matches.sigmas0, matches.sigmas1, matches.scores
    affine = local_affine(matches.points0, matches.points1, mask).reshape(-1, 4)
    rows[:, _AFFINE] = affine
    determinant = affine[:, 0] * affine[:, 3] - affine[:, 1] * affine[:, 2]
    variances = matches.sigmas1.astype(np.float64) ** 2 + np.abs(determinant) * matches.sigmas0**2
    rows[:, _VARIANCE] = np.where(mask, variances, -variances)
    return pair, rows


def _weights(rows: np.ndarray) -> np.ndarray:
    return np.maximum(rows[:, _SCORE], np.float32(_MIN_WEIGHT))


def _merge_images(raw: _Raw, radius_px: float, scratch: Scratch) -> tuple[np.ndarray, Rows]:
    """Where the keypoints of every image begin (N + 1,), and of all place, finest sigma and weight (K, 4)."""
    sides: list[list[tuple[int, int, int]]] = [[] for _ in raw.names]
    for pair in raw.pairs:
        sides[pair.image0].append((0, pair.begin, pair.length))
        sides[pair.image1].append((1, pair.begin, pair.length))

    def keypoints_of(image: int) -> tuple[int, np.ndarray, np.ndarray]:
        parts = [(side, raw.rows.read(begin, count)) for side, begin, count in sides[image]]
        points = np.concatenate([rows[:, 2 * side : 2 * side + 2] for side, rows in parts])
        sigmas = np.concatenate([rows[:, 4 + side] for side, rows in parts])
        weights = np.concatenate([_weights(rows) for _, rows in parts])
        merged, labels = merge_image(points, sigmas, weights, radius_px)
        finest = finest_and_weight(labels, sigmas, weights, len(merged), _OCTAVE)
        return image, np.column_stack([merged, *finest]), labels

    told = scratch.rows("merged.rows", 4, np.float32)
    bounds = np.zeros(len(raw.names) + 1, np.int64)
    for image, keypoints, labels in in_order(keypoints_of, range(len(raw.names))):
        begin_of_labels = 0
        for side, begin, count in sides[image]:
            part = labels[begin_of_labels : begin_of_labels + count, None] + told.count
            raw.index[side].write(begin, part)
            begin_of_labels += count
        told.append(keypoints)
        bounds[image + 1] = told.count
    return bounds, told


def _strongest_first(raw: _Raw, scratch: Scratch) -> Iterator[np.ndarray]:
    """The different matches (E, 2) of keypoints: those with an inlier first, then by their sum of strength."""
    levels = scratch.sorted("edges", 2, np.int32)
    for edges, level in in_order(lambda batch: _edges_of(raw, batch), _batches(raw)):
        levels.put(level, edges)
    return levels.take()


def _batches(raw: _Raw) -> Iterator[list[_PairRows]]:
    return batches((pair for pair in raw.pairs if pair.length), lambda pair: pair.length, _AT_ONCE)


def _edges_of(raw: _Raw, batch: list[_PairRows]) -> tuple[np.ndarray, np.ndarray]:
    found = []
    for pair in batch:
        rows, index = raw.rows.read(pair.begin, pair.length), raw.index_of(pair)
        found.append(_strengths(index, _weights(rows), rows[:, _VARIANCE]))
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


def _side_by_side(tracks: Tracks, bounds: np.ndarray, min_shared: int, scratch: Scratch) -> Iterator[np.ndarray]:
    """Pairs of tracks (T, 2) near each other in at least `min_shared` images: most images first, then nearest."""
    num_parts = max(1, int(bounds[-1]) // _ROWS_A_PART)
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


def _linked(raw: _Raw, tracks: Tracks, pair: _PairRows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The matches of a pair that lie in one track: rows in the pair, keypoints (M, 2), track of each."""
    index = raw.index_of(pair)
    root = tracks.track(index.ravel()).reshape(-1, 2)
    kept = np.flatnonzero(root[:, 0] == root[:, 1])
    return kept, tracks.representative(index[kept].ravel()).reshape(-1, 2), root[kept, 0]


def _align(raw: _Raw, tracks: Tracks, scratch: Scratch) -> int:
    """Move the keypoints to where their matches agree. Returns: the matches that are in no track."""
    num_matches, num_linked = sum(pair.length for pair in raw.pairs), 0
    parts = scratch.sorted("tracks", 10, np.float32)
    num_parts = np.uint64(1 + num_matches // _ROWS_A_PART)

    def equations(batch: list[_PairRows]) -> tuple[np.ndarray, np.ndarray]:
        found, roots = [], []
        for pair in batch:
            kept, index, root = _linked(raw, tracks, pair)
            rows = raw.rows.read(pair.begin, pair.length)[kept]
            made = np.empty((len(kept), 10), np.float32)
            made.view(np.int32)[:, 0:2], made.view(np.int32)[:, 2] = index, root
            made[:, 3:7] = rows[:, _AFFINE]
            made[:, 7] = _weights(rows) / np.abs(rows[:, _VARIANCE])
            made[:, 8:10] = _offsets(tracks, index, rows)
            found.append(made)
            roots.append(root)
        return np.concatenate(found), np.concatenate(roots)

    for rows, roots in in_order(equations, _batches(raw)):
        # A multiplicative hash: roots crowd where images do.
        hashed = roots.astype(np.uint64) * np.uint64(2654435761) & np.uint64(0xFFFFFFFF)
        parts.put((hashed * num_parts >> np.uint64(32)).astype(np.int64), rows)
        num_linked += len(rows)

    def solve(part: int) -> None:
        rows = parts.take_label(part)
        numbers = rows.view(np.int32)
        tracks.align(numbers[:, :2], numbers[:, 2], rows[:, 8:10], rows[:, 3:7], rows[:, 7])

    for _ in in_order(solve, parts.finish()):
        pass
    return num_matches - num_linked


def _measure_again(raw: _Raw, tracks: Tracks, photos: Photos, max_residual_sigmas: float) -> None:
    """Replace the points of matches by their keypoints in image 0 and what looks most like these in image 1.

    Matches that disagree with their keypoints, or whose patches do not look alike, stay as they are.
    """

    def of_pair(pair: _PairRows) -> None:
        kept, index, _ = _linked(raw, tracks, pair)
        rows = raw.rows.read(pair.begin, pair.length)
        part = rows[kept]
        agree = _agreeing(tracks, index, part, max_residual_sigmas)
        kept, part = kept[agree], part[agree]
        points = tracks.points(index[agree].ravel()).reshape(-1, 2, 2)
        affine = local_affine(points[:, 0], points[:, 1], part[:, _VARIANCE] > 0)
        coarsest = 2 ** int(np.ceil(np.log2(max(float(np.median(part[:, _SIGMAS])), 1.0)))) if len(part) else 1
        strides = tuple(stride for stride in (8, 4, 2, 1) if stride <= coarsest)
        gray0, gray1 = (photos(name).astype(np.float32) for name in sorted(pair.pair))
        for begin in range(0, len(part), _PATCHES_AT_ONCE):
            here = slice(begin, begin + _PATCHES_AT_ONCE)
            points0, points1 = points[here, 0], points[here, 1]
            found, correlation = refine(gray0, gray1, points0, points1, affine[here], strides=strides)
            near = np.linalg.norm(found - points1, axis=1) <= _LARGEST_MOVE * part[here, _SIGMAS][:, 1]
            sure = near & (correlation > _SURE_CORRELATION)
            changed = part[here][sure]
            changed[:, _POINTS] = np.column_stack([points0, found])[sure]
            changed[:, _AFFINE] = affine[here][sure].reshape(-1, 4)
            changed[:, _VARIANCE] *= _MEASURED_VARIANCE
            rows[kept[here][sure]] = changed
        raw.rows.write(pair.begin, rows)

    for _ in in_order(of_pair, (pair for pair in raw.pairs if pair.length)):
        pass


def _agreeing(tracks: Tracks, index: np.ndarray, rows: np.ndarray, max_residual_sigmas: float) -> np.ndarray:
    """Which matches lie where their keypoints say."""
    if max_residual_sigmas <= 0:
        return np.ones(len(rows), bool)
    error = np.linalg.norm(_offsets(tracks, index, rows), axis=1)
    return error <= max_residual_sigmas * np.sqrt(np.abs(rows[:, _VARIANCE]))


def _offsets(tracks: Tracks, index: np.ndarray, rows: np.ndarray) -> np.ndarray:
    points = tracks.points(index.ravel())
    places = np.arange(2 * len(index)).reshape(-1, 2)
    return offsets_of(points, places, rows[:, _POINTS], rows[:, _AFFINE])


def _export(
    raw: _Raw, tracks: Tracks, bounds: np.ndarray, max_residual_sigmas: float, num_conflicts: int, scratch: Scratch
) -> CollectionKeypoints:
    """Keep the matches that agree with their keypoints, and number the keypoints that they use."""

    def agreeing(batch: list[_PairRows]) -> list[tuple[np.ndarray, np.ndarray, int]]:
        found = []
        for pair in batch:
            kept, index, _ = _linked(raw, tracks, pair)
            rows = raw.rows.read(pair.begin, pair.length)[kept]
            agree = _agreeing(tracks, index, rows, max_residual_sigmas)
            index, rows = index[agree], rows[agree]
            found.append((*_best_of(index, rows[:, _SCORE]), len(index)))
        return found

    matches, scores = scratch.rows("merged_matches.rows", 2, np.int32), scratch.rows("scores.rows", 1, np.float32)
    begins = [0]
    num_agreeing = 0
    for found in in_order(agreeing, _batches(raw)):
        for index, best, count in found:
            tracks.mark_used(index)
            num_agreeing += count
            begins.append(begins[-1] + len(best))
        matches.append(np.concatenate([index for index, _, _ in found]))
        scores.append(np.concatenate([best for _, best, _ in found])[:, None])
    keypoints, first = scratch.rows("keypoints.rows", 2, np.float32), [0]
    for begin, end in pairwise(bounds.tolist()):
        keypoints.append(tracks.points(tracks.number_used(begin, end)))
        first.append(keypoints.count)
    filled = [pair for pair in raw.pairs if pair.length]
    for pair, (begin, end) in zip(filled, pairwise(begins), strict=True):
        rows = tracks.number(matches.read(begin, end - begin))
        matches.write(begin, rows if pair.pair[0] < pair.pair[1] else rows[:, ::-1])
    where = {pair.pair: row for row, pair in enumerate(filled)}
    empty = [pair.pair for pair in raw.pairs if not pair.length]
    begins += begins[-1:] * len(empty)
    where |= {pair: len(filled) + row for row, pair in enumerate(empty)}
    where = {pair.pair: where[pair.pair] for pair in raw.pairs}

    def matches_of(row: int) -> np.ndarray:
        return matches.read(begins[row], begins[row + 1] - begins[row]).astype(np.uint32)

    return CollectionKeypoints(
        keypoints=OnDisk(
            {name: row for row, name in enumerate(raw.names)},
            lambda row: keypoints.read(first[row], first[row + 1] - first[row]),
        ),
        matches=OnDisk(where, matches_of),
        scores=OnDisk(where, lambda row: scores.read(begins[row], begins[row + 1] - begins[row])[:, 0]),
        num_raw=sum(pair.length for pair in raw.pairs),
        num_duplicates=num_agreeing - begins[-1],
        num_conflicts=num_conflicts,
        num_inconsistent=sum(pair.length for pair in raw.pairs) - num_conflicts - num_agreeing,
    )


@compiled
def _best_of(index: np.ndarray, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different matches (E, 2) of keypoints, sorted, and the best score of each."""
    keys = (index[:, 0] << 32) | index[:, 1]
    order = np.argsort(keys, kind="mergesort")
    edges, best = np.empty((len(keys), 2), np.int32), np.zeros(len(keys), np.float32)
    count = 0
    for place in range(len(order)):
        row = order[place]
        if place == 0 or keys[row] != keys[order[place - 1]]:
            edges[count, 0], edges[count, 1] = index[row, 0], index[row, 1]
            count += 1
        best[count - 1] = max(best[count - 1], scores[row])
    return edges[:count], best[:count]
