"""What merging the matches of all pairs is told, and what it gives; `merge` does it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sgam_core.errors import OptionError
from sgam_sfm.pairs import Pair


@dataclass(frozen=True, kw_only=True, slots=True)
class KeypointOptions:
    """How far the points of one image may lie apart and still be one keypoint; radii in matcher pixels."""

    cluster_radius_px: float = 0.33  # points of one image within it are one keypoint
    track_radius_px: float = 5.0  # keypoints of one image within it may become one in a track; 0: never
    min_shared_images: int = 1  # join two tracks that run within the track radius in so many images; 0: never
    max_residual_sigmas: float = 1.0  # drop a match further from its aligned keypoints; sigma: 1 px either side; 0: off
    refine: bool = False  # move keypoints, in the end, to where the photos themselves agree best, at full resolution

    def __post_init__(self) -> None:
        if not self.cluster_radius_px > 0:
            raise OptionError(f"cluster_radius_px is {self.cluster_radius_px}; expected a positive number")
        for name in ("track_radius_px", "min_shared_images", "max_residual_sigmas"):
            if not getattr(self, name) >= 0:
                raise OptionError(f"{name} is {getattr(self, name)}; expected 0 (off) or a positive number")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CollectionKeypoints:
    """What goes into COLMAP's database.

    keypoints: image name -> (N, 2) pixels, float32, corner origin. matches: pair -> uint32 (M, 2) rows in the two
    images' keypoints, one-to-one. scores: pair -> float32 (M,) the best raw score of each. The raw matches are the
    exported ones, plus num_duplicates (fell together with an exported one), num_conflicts (would have put two spots of
    an image into one track) and num_inconsistent (too far from the keypoints of their track, or one of these in masked
    ground).
    """

    # Shapes are not in the types: what checks those would read from disk to do so.
    keypoints: Mapping[str, np.ndarray]
    matches: Mapping[Pair, np.ndarray]
    scores: Mapping[Pair, np.ndarray]
    num_raw: int
    num_duplicates: int
    num_conflicts: int
    num_inconsistent: int

    @property
    def num_matches(self) -> int:
        """Those exported."""
        return self.num_raw - self.num_duplicates - self.num_conflicts - self.num_inconsistent
