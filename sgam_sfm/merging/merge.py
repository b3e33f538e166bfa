"""Point matches per pair -> keypoints per image and index matches per pair, as COLMAP needs them.

A semi-dense matcher gives every pair points of its own, so its raw matches make tracks of two images. Four steps:

1. `merge_image`: points of one image that coincide become one keypoint.
2. `Tracks`: matches link keypoints into tracks of at most one keypoint per image, strongest match first. Tracks that
   run side by side through several images show the same spot on different grids and are joined, too: without that, the
   tracks of a matcher that puts one side of each match on a grid end wherever an image changes sides.
3. `align_keypoints`: a joined keypoint lies between the points it was made of, so all keypoints move, by fractions of
   a matcher pixel, to where the matches of their track agree best; each match is carried to its keypoints along the
   local affine map of its pair.
4. Matches that still disagree with their keypoints, or have one in masked ground, are dropped.

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
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from sgam_core.errors import InputError
from sgam_core.types import Matches
from sgam_sfm.merging.clusters import finest_and_weight, merge_image
from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.keypoints import CollectionKeypoints, KeypointOptions
from sgam_sfm.merging.linking import side_by_side, strongest_first
from sgam_sfm.merging.raw import SCORE, PairRows, RawMatches, RawPair, batches_of, collect, ends_of, weights_of
from sgam_sfm.merging.scratch import Rows, Scratch
from sgam_sfm.merging.settling import Photos, agreeing, align, measure_again
from sgam_sfm.merging.tracks import Tracks
from sgam_sfm.pairs import Pair
from sgam_sfm.threads import in_order

_log = logging.getLogger(__name__)

_FOLDER = ".merging"
_MOST_KEYPOINTS = 2**31 - 1  # that have a number
_OCTAVE = 2.0  # points whose sigma is so many times the finest have no say in where a keypoint lies

Key = TypeVar("Key")

Masks = Callable[[str], np.ndarray | None]
"""Where an image (H, W) may have keypoints, True, by its name; None for anywhere. Threads may ask."""


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
    Raises: InputError when a pair holds one image twice or comes in both orders, or for more keypoints than have
        numbers; ShapeError for a mask that does not fit its matches.
    """
    raw = ((pair, pairs[pair], (inliers or {}).get(pair)) for pair in pairs)
    with tempfile.TemporaryDirectory() as folder, merging(raw, Path(folder), options) as merged:
        return replace(
            merged, keypoints=dict(merged.keypoints), matches=dict(merged.matches), scores=dict(merged.scores)
        )


@contextmanager
def merging(
    pairs: Iterable[RawPair],
    output: Path,
    options: KeypointOptions | None = None,
    photos: Photos | None = None,
    masks: Masks | None = None,
) -> Iterator[CollectionKeypoints]:
    """`merge_keypoints` for collections of any size: the arrays are read from disk when they are asked for.

    Args: output: gets a folder of up to about 130 bytes a match, which is removed at the end of the context.
        photos: asked for when the options say `refine`. masks: matches are expected outside of masked ground, but their
        keypoints, which move by some matcher pixels, need not be.
    """
    options = options or KeypointOptions()
    with Scratch(output / _FOLDER) as scratch:
        raw = collect(pairs, scratch)
        bounds, told = _merge_images(raw, options.cluster_radius_px, scratch)
        tracks = Tracks.of_images(bounds, told.read, options.track_radius_px)
        for edges in strongest_first(raw, scratch):
            tracks.join(edges)
        if options.track_radius_px > 0 and options.min_shared_images > 0:
            near = side_by_side(tracks, bounds, options.min_shared_images, scratch)
            tracks.join_tracks(near, options.min_shared_images)
        for begin, end in pairwise(bounds.tolist()):
            tracks.settle(begin, told.read(begin, end - begin)[:, 3], _OCTAVE)
        num_conflicts = align(raw, tracks, scratch)
        if options.refine and photos is not None:
            measure_again(raw, tracks, photos, options.max_residual_sigmas)
            align(raw, tracks, scratch)
        if masks is not None:
            ends = pairwise(bounds.tolist())
            for (begin, end), mask in zip(ends, in_order(masks, raw.names), strict=True):
                if mask is not None:
                    tracks.leave_out(begin, end, mask)
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


def _merge_images(raw: RawMatches, radius_px: float, scratch: Scratch) -> tuple[np.ndarray, Rows]:
    """Where the keypoints of every image begin (N + 1,), and of all place, finest sigma and weight (K, 4)."""
    sides: list[list[tuple[int, int, int]]] = [[] for _ in raw.names]
    for pair in raw.pairs:
        sides[pair.image0].append((0, pair.begin, pair.length))
        sides[pair.image1].append((1, pair.begin, pair.length))

    def keypoints_of(image: int) -> tuple[int, np.ndarray, np.ndarray]:
        rows = raw.rows.read_parts([(begin, count) for _, begin, count in sides[image]])
        second = np.repeat([side == 1 for side, _, _ in sides[image]], [count for _, _, count in sides[image]])
        points = np.where(second[:, None], rows[:, 2:4], rows[:, 0:2])
        sigmas, weights = np.where(second, rows[:, 5], rows[:, 4]), weights_of(rows)
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
        if told.count > _MOST_KEYPOINTS:
            raise InputError(
                f"matches have more than {_MOST_KEYPOINTS} keypoints in {image + 1} of {len(raw.names)} images; match "
                "the collection in parts, or with fewer matches (--preset fast)"
            )
    return bounds, told


def _export(
    raw: RawMatches,
    tracks: Tracks,
    bounds: np.ndarray,
    max_residual_sigmas: float,
    num_conflicts: int,
    scratch: Scratch,
) -> CollectionKeypoints:
    """Keep the matches that agree with their keypoints, and number the keypoints that they use."""

    def found_in(batch: list[PairRows]) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        kept, index, _ = tracks.linked(raw.index_of(batch))
        rows = raw.rows_of(batch)[kept]
        agree = np.flatnonzero(agreeing(tracks, index, rows, max_residual_sigmas))
        ends = np.searchsorted(kept[agree], ends_of(batch))
        return *_best_of(index[agree], rows[agree, SCORE], ends), len(agree)

    matches, scores = scratch.rows("merged_matches.rows", 2, np.int32), scratch.rows("scores.rows", 1, np.float32)
    begins = [0]
    num_agreeing = 0
    for index, best, ends, count in in_order(found_in, batches_of(raw)):
        tracks.mark_used(index)
        num_agreeing += count
        begins += (begins[-1] + ends).tolist()
        matches.append(index)
        scores.append(best[:, None])
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
def _best_of(index: np.ndarray, scores: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The different matches (E, 2) of keypoints, sorted in every pair, the best score of each, and the pairs' ends.

    Args: ends: of the matches of every pair.
    """
    edges, best = np.empty((len(index), 2), np.int32), np.zeros(len(index), np.float32)
    ends_found, count, begin = np.empty(len(ends), np.int64), 0, 0
    for pair, end in enumerate(ends):
        keys = (index[begin:end, 0] << 32) | index[begin:end, 1]
        order = np.argsort(keys, kind="mergesort")
        for place in range(len(order)):
            row = begin + order[place]
            if place == 0 or keys[order[place]] != keys[order[place - 1]]:
                edges[count, 0], edges[count, 1] = index[row, 0], index[row, 1]
                count += 1
            best[count - 1] = max(best[count - 1], scores[row])
        ends_found[pair], begin = count, end
    return edges[:count], best[:count], ends_found
