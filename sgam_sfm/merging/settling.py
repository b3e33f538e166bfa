"""Keypoints of tracks moved to where their matches agree, and matches measured again in the photos."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sgam_sfm.matchers.subpixel import refine
from sgam_sfm.merging.affine import local_affine
from sgam_sfm.merging.raw import (
    AFFINE,
    POINTS,
    ROWS_A_PART,
    SIGMAS,
    VARIANCE,
    PairRows,
    RawMatches,
    batches_of,
    weights_of,
)
from sgam_sfm.merging.scratch import Scratch
from sgam_sfm.merging.tracks import Tracks
from sgam_sfm.threads import in_order

_LARGEST_MOVE = 2.0  # matcher pixels: what moves further has slid along an edge
_SURE_CORRELATION = 0.85  # of two patches whose alignment counts
_MEASURED_VARIANCE = 0.05  # of a match that was measured again, against what it was before

Photos = Callable[[str], np.ndarray]
"""The gray values (H, W) of an image, uint8, by its name; threads may ask."""


def align(raw: RawMatches, tracks: Tracks, scratch: Scratch) -> int:
    """Move the keypoints to where their matches agree. Returns: the matches that are in no track."""
    num_matches, num_linked = sum(pair.length for pair in raw.pairs), 0
    parts = scratch.sorted("tracks", 10, np.float32)
    num_parts = np.uint64(1 + num_matches // ROWS_A_PART)

    def equations(batch: list[PairRows]) -> tuple[np.ndarray, np.ndarray]:
        kept, index, roots = tracks.linked(raw.index_of(batch))
        rows = raw.rows_of(batch)[kept]
        made = np.empty((len(kept), 10), np.float32)
        made.view(np.int32)[:, 0:2], made.view(np.int32)[:, 2] = index, roots
        made[:, 3:7] = rows[:, AFFINE]
        made[:, 7] = weights_of(rows) / np.abs(rows[:, VARIANCE])
        made[:, 8:10] = tracks.offsets(index, rows[:, POINTS], rows[:, AFFINE])
        return made, roots

    for rows, roots in in_order(equations, batches_of(raw)):
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


def measure_again(raw: RawMatches, tracks: Tracks, photos: Photos, max_residual_sigmas: float) -> None:
    """Replace the points of matches by their keypoints in image 0 and what looks most like these in image 1.

    Matches that disagree with their keypoints, or whose patches do not look alike, stay as they are.
    """

    def of_pair(pair: PairRows) -> None:
        kept, index, _ = tracks.linked(raw.index_of([pair]))
        rows = raw.rows_of([pair])
        part = rows[kept]
        agree = agreeing(tracks, index, part, max_residual_sigmas)
        kept, part = kept[agree], part[agree]
        points = tracks.points(index[agree].ravel()).reshape(-1, 2, 2)
        points0, points1 = points[:, 0], points[:, 1]
        affine = local_affine(points0, points1, part[:, VARIANCE] > 0)
        coarsest = 2 ** int(np.ceil(np.log2(max(float(np.median(part[:, SIGMAS])), 1.0)))) if len(part) else 1
        strides = tuple(stride for stride in (8, 4, 2, 1) if stride <= coarsest)
        gray0, gray1 = (photos(name).astype(np.float32) for name in sorted(pair.pair))
        found, correlation = refine(gray0, gray1, points0, points1, affine, strides=strides)
        near = np.linalg.norm(found - points1, axis=1) <= _LARGEST_MOVE * part[:, SIGMAS][:, 1]
        sure = near & (correlation > _SURE_CORRELATION)
        changed = part[sure]
        changed[:, POINTS] = np.column_stack([points0, found])[sure]
        changed[:, AFFINE] = affine[sure].reshape(-1, 4)
        changed[:, VARIANCE] *= _MEASURED_VARIANCE
        rows[kept[sure]] = changed
        raw.rows.write(pair.begin, rows)

    for _ in in_order(of_pair, (pair for pair in raw.pairs if pair.length)):
        pass


def agreeing(tracks: Tracks, index: np.ndarray, rows: np.ndarray, max_residual_sigmas: float) -> np.ndarray:
    """Which matches lie where their keypoints say; none whose keypoint lies nowhere."""
    error = np.linalg.norm(tracks.offsets(index, rows[:, POINTS], rows[:, AFFINE]), axis=1)
    return error <= (max_residual_sigmas or np.inf) * np.sqrt(np.abs(rows[:, VARIANCE]))
