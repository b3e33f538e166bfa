"""SIFT with LightGlue, on OpenCV and kornia's model (Lowe, IJCV 2004; Lindenberger et al., ICCV 2023)."""

from __future__ import annotations

from pathlib import Path

from sgam_sfm.machine import find_device
from sgam_sfm.matchers.lightglue import LightGlueAssignment
from sgam_sfm.matchers.sift import CHANNELS, SIFTExtractor
from sgam_sfm.matchers.sparse import SparseMatcher, batch_size
from sgam_sfm.weights import SIFT_LIGHTGLUE, find_weights


def sift_lightglue(
    *,
    weights: Path | None = None,
    device: str = "cpu",
    seed: int = 0,
    max_features: int = 2048,
    min_score: float = 0.1,
    batch: int = 0,
) -> SparseMatcher:
    """SIFT with LightGlue.

    Args: weights: LightGlue's file; found by itself when omitted. Others, and errors: as `with_lightglue`.
    """
    place, together = find_device(device), batch_size(find_device(device), batch)
    assign = LightGlueAssignment(
        find_weights(SIFT_LIGHTGLUE, weights),
        place,
        batch_size=together,
        min_score=min_score,
        input_dim=CHANNELS,
        add_scale_ori=True,
    )
    return SparseMatcher(SIFTExtractor(max_features, place), assign, batch_size=together)
