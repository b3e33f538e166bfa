"""Sparse matching: features of every crop, found once and kept, and a rule that assigns those of two crops.

A sparse matcher is an extractor and an assignment; each adapter brings its own or takes one that exists.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sgam_core.errors import OptionError
from sgam_core.types import Crop, Matches
from sgam_sfm.matchers.feature_cache import FeatureCache
from sgam_sfm.matchers.masks import wanted

CACHE_BYTES = 512 * 2**20
MIN_SIDE = 32  # pixels of a crop, below which networks give no features
CUDA_BATCH = 8  # crops, or pairs of them, that go through a network together


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """The sparse features of one crop.

    points: (K, 2) crop pixels, corner origin. descriptors: (K, C). size: (width, height) of the crop. sigmas: (K,) crop
    pixels at the resolution at which each was found. frames: (K, 2) scale in pixels and angle in radians; None where
    the detector knows neither.
    """

    points: Float[Tensor, "K 2"]
    descriptors: Float[Tensor, "K C"]
    size: tuple[int, int]
    sigmas: Float[Tensor, " K"]
    frames: Float[Tensor, "K 2"] | None = None

    @staticmethod
    def of(points: Float[Tensor, "K 2"], descriptors: Float[Tensor, "K C"], crop: Crop) -> Features:
        """Features found at the crop's own resolution."""
        return Features(points, descriptors, crop.size, points.new_ones(len(points)))

    @staticmethod
    def none(crop: Crop, channels: int, device: torch.device) -> Features:
        """No features."""
        return Features.of(torch.zeros(0, 2, device=device), torch.zeros(0, channels, device=device), crop)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def nbytes(self) -> int:
        parts = (self.points, self.descriptors, self.sigmas, self.frames)
        return sum(part.nbytes for part in parts if part is not None)


@dataclass(frozen=True, slots=True, eq=False)
class Assignment:
    """Which features of two crops belong together: rows of both sides, each at most once, and scores in [0, 1]."""

    rows0: Int[Tensor, " M"]
    rows1: Int[Tensor, " M"]
    scores: Float[Tensor, " M"]


Extract = Callable[[Sequence[Crop]], list[Features]]
"""The features of crops of one size."""
Assign = Callable[[Sequence[tuple[Features, Features]]], list[Assignment]]
"""The assignments of pairs of crops, in their order."""
Refine = Callable[[Crop, Crop, Matches], Matches]
"""The matches of two crops, moved; see `subpixel.aligned`."""


class SparseMatcher:
    """Point matcher (`sgam_core.protocols.PointMatcher`) of sparse features.

    Features of a crop are extracted once and kept, least recently used dropped first, until `reset()`. Crops of equal
    size are extracted in batches, and pairs assigned in batches where the assignment can; on the CPU one by one, which
    keeps results independent of what else is asked for or kept. Equal input after a `reset()` gives equal output.

    Args:
        extract, assign: see `Extract` and `Assign`.
        refine: what moves the matches of two crops in the end, for detectors whose keypoints are not precise.
        batch_size: crops that are extracted together.
        cache_bytes: bound of the kept features.

    Attributes:
        features: what is kept of the crops.
    """

    def __init__(
        self,
        extract: Extract,
        assign: Assign,
        *,
        refine: Refine | None = None,
        batch_size: int = 1,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        self.features: FeatureCache[Features] = FeatureCache(extract, batch_size=batch_size, max_bytes=cache_bytes)
        self._assign = assign
        self._refine = refine

    @property
    def pixels_extracted(self) -> int:
        """Crop pixels that features were extracted from so far, for cost reports."""
        return self.features.pixels_extracted

    @property
    def repeatable(self) -> bool:
        """Whether what a pair gives does not depend on what was matched before it."""
        return self.features.repeatable

    @property
    def concurrent(self) -> bool:
        """Whether threads may match at once."""
        return self.features.repeatable

    def reset(self) -> None:
        """Forget all features."""
        self.features.clear()

    @torch.inference_mode()
    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """Match every pair of crops; see `PointMatcher.match`."""
        self.features.fetch([crop for pair in pairs for crop in pair])
        sides = [(self.features.of(crop0), self.features.of(crop1)) for crop0, crop1 in pairs]
        assigned = self._assign(sides)
        found = [_matches(*pair, *side, rows) for pair, side, rows in zip(pairs, sides, assigned, strict=True)]
        if self._refine is None:
            return found
        return [self._refine(*pair, matches) for pair, matches in zip(pairs, found, strict=True)]


def batch_size(device: torch.device, asked: int = 0) -> int:
    """What goes through a network together: as asked, or 1 on the CPU, where more is no faster."""
    if asked < 0:
        raise OptionError(f"batch_size is {asked}; expected at least 0")
    return asked or (1 if device.type == "cpu" else CUDA_BATCH)


def checked_count(max_features: int) -> int:
    """The number of features. Raises: OptionError when it is none."""
    if max_features < 1:
        raise OptionError(f"max_features is {max_features}; expected at least 1")
    return max_features


def _matches(crop0: Crop, crop1: Crop, features0: Features, features1: Features, found: Assignment) -> Matches:
    points0, points1 = _numpy(features0.points[found.rows0]), _numpy(features1.points[found.rows1])
    good = wanted(crop0, points0) & wanted(crop1, points1)
    return Matches(
        points0=points0[good],
        points1=points1[good],
        scores=_numpy(found.scores)[good].clip(0, 1),
        sigmas0=_numpy(features0.sigmas[found.rows0])[good],
        sigmas1=_numpy(features1.sigmas[found.rows1])[good],
    )


def _numpy(values: Tensor) -> np.ndarray:
    array: np.ndarray = values.float().cpu().numpy()
    return array
