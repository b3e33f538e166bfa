"""What follows once pairs are matched: keypoints and a database from the raw matches, then COLMAP's stages.

`match`, `aggregate` and `reconstruct` share these steps.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from pathlib import Path

import numpy as np

from sgam_core import Matches
from sgam_core.geometry import residuals
from sgam_sfm.colmap_reading import read_camera_ids, read_counts, read_match_counts
from sgam_sfm.hloc_files import write_keypoints_h5, write_matches_h5
from sgam_sfm.keypoints import CollectionKeypoints, KeypointOptions, merge_keypoints
from sgam_sfm.mapping import (
    MappingOptions,
    MappingSummary,
    VerificationOptions,
    VerificationSummary,
    map_images,
    verify,
)
from sgam_sfm.pairs import Pair
from sgam_sfm.progress import Advance, Stages
from sgam_sfm.store import PairRecord


def merge_records(
    records: Iterable[PairRecord], options: KeypointOptions, max_residual: float, output: Path
) -> CollectionKeypoints:
    """Keypoints from the raw matches of all pairs, in OUT/keypoints.h5 and OUT/matches.h5 too.

    Args: max_residual: of an inlier of its pair's geometry, see `GeometryOptions`.
    """
    matches, inliers = stored_matches(records, max_residual)
    merged = merge_keypoints(matches, options, inliers)
    write_keypoints_h5(output / "keypoints.h5", merged.keypoints)
    counts = {name: len(points) for name, points in merged.keypoints.items()}
    write_matches_h5(output / "matches.h5", merged.matches, merged.scores, counts)
    return merged


def stored_matches(
    records: Iterable[PairRecord], max_residual: float
) -> tuple[dict[Pair, Matches], dict[Pair, np.ndarray]]:
    """The point matches of every pair that has any, and (M,) which of them agree with the pair's geometry."""
    matches, inliers = {}, {}
    for record in records:
        if record.result is not None and len(record.result.matches):
            matches[record.pair] = record.result.matches
            model = record.result.two_view
            if model is not None:
                inliers[record.pair] = residuals(model.F, record.result.matches) <= max_residual
    return matches, inliers


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
