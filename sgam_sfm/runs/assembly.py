"""What follows once pairs are matched: keypoints and a database from the raw matches, then COLMAP's stages.

`match`, `aggregate` and `reconstruct` share these steps.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np

from sgam_core.geometry import residuals
from sgam_sfm.colmap.mapping import MappingOptions, MappingSummary, map_images
from sgam_sfm.colmap.reading import read_camera_ids, read_counts, read_match_counts
from sgam_sfm.colmap.verification import VerificationOptions, VerificationSummary, verify
from sgam_sfm.hloc_files import matches_h5_size, write_keypoints_h5, write_matches_h5
from sgam_sfm.images import read_image, read_mask_of_any_size
from sgam_sfm.merging.keypoints import CollectionKeypoints, KeypointOptions
from sgam_sfm.merging.merge import merging
from sgam_sfm.merging.raw import RawPair
from sgam_sfm.merging.settling import Photos
from sgam_sfm.progress import Advance, Stages
from sgam_sfm.runs.store import PairRecord

_log = logging.getLogger(__name__)

_LARGEST_MATCHES_H5 = 2**31  # bytes
_PHOTOS_IN_MEMORY = 32  # of one byte a pixel


@contextmanager
def merged_records(
    records: Iterable[PairRecord],
    options: KeypointOptions,
    max_residual: float,
    output: Path,
    images: Path,
    masks: Path | None = None,
) -> Iterator[CollectionKeypoints]:
    """Keypoints from the raw matches of all pairs; their arrays can be read inside the context.

    Args: max_residual: of an inlier of its pair's geometry, see `GeometryOptions`. output: is given a folder for the
        arrays, which is removed at the end. images: folder of the photos, read when keypoints are refined. masks: that
        of their masks.
    """
    raw = (_raw_pair(record, max_residual) for record in records if record.result and len(record.result.matches))
    wanted = None if masks is None else partial(read_mask_of_any_size, masks)
    with merging(raw, output, options, _photos(images), wanted) as merged:
        yield merged


def _photos(folder: Path) -> Photos:
    @lru_cache(_PHOTOS_IN_MEMORY)
    def gray(name: str) -> np.ndarray:
        return cv2.cvtColor(read_image(folder / name, sys.maxsize), cv2.COLOR_RGB2GRAY)

    return gray


def _raw_pair(record: PairRecord, max_residual: float) -> RawPair:
    """The matches of a pair, and which of them agree with its geometry."""
    assert record.result is not None
    matches, model = record.result.matches, record.result.two_view
    return record.pair, matches, None if model is None else residuals(model.F, matches) <= max_residual


def write_for_hloc(merged: CollectionKeypoints, output: Path, *, large: bool = False) -> None:
    """OUT/keypoints.h5 and OUT/matches.h5.

    The latter has a group for every pair and a number for every keypoint of its first image, matched or not. When that
    is many times the database, it is left out unless `large`, and an older one is removed, since it would be taken for
    it.
    """
    write_keypoints_h5(output / "keypoints.h5", merged.keypoints)
    counts = {name: len(points) for name, points in merged.keypoints.items()}
    size, path = matches_h5_size(merged.matches, counts), output / "matches.h5"
    if size > _LARGEST_MATCHES_H5 and not large:
        _log.warning(
            "%s is left out: in hloc's layout the matches of %d pairs take about %.1f GB; if you need it, "
            "`sgam-sfm aggregate '%s' --hloc` writes it (the database is whole)",
            *(path.name, len(merged.matches), size / 1e9, output),
        )
        path.unlink(missing_ok=True)
        return
    write_matches_h5(path, merged.matches, merged.scores, counts)


def verify_pairs(
    database: Path, options: VerificationOptions, stages: Stages, *, anew: bool = True
) -> VerificationSummary:
    """COLMAP's verification of all pairs, or with `anew` False of those that it has not looked at."""
    pairs = read_match_counts(database)
    inliers = read_counts(database, failed=True).inliers
    if not anew and pairs.keys() <= inliers.keys():
        good = {pair: count for pair, count in inliers.items() if count}
        return VerificationSummary(inliers=good, num_pairs=len(pairs), seconds=0.0, peak_memory_mb=None)
    with stages.stage("Verifying pairs", len(pairs)) as advance:
        return verify(database, options, _relative(advance), anew=anew)


def build_models(
    database: Path,
    images: Path,
    sparse: Path,
    options: MappingOptions,
    stages: Stages,
    *,
    known_camera_ids: Collection[int] = (),
    input_model: Path | None = None,
) -> MappingSummary:
    """COLMAP's mapper; see `map_images`."""
    with stages.stage("Mapping", len(read_camera_ids(database))) as advance:
        return map_images(
            database,
            images,
            sparse,
            options,
            _relative(advance),
            known_camera_ids=known_camera_ids,
            input_model=input_model,
        )


def _relative(advance: Advance) -> Callable[[str, int, int], None]:
    """COLMAP's stages tell how far they are, a progress bar wants to know what is new."""
    shown = 0

    def progress(step: str, done: int, total: int) -> None:
        nonlocal shown
        advance(done - shown)
        shown = done

    return progress
