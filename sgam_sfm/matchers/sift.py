"""SIFT with mutual ratio matching: the classical baseline, without weights (Lowe, IJCV 2004).

Descriptors are compared as RootSIFT (Arandjelovic & Zisserman, CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from sgam_core.sift import strongest_sift
from sgam_core.types import Crop
from sgam_sfm.machine import find_device
from sgam_sfm.matchers.ratio import RatioAssignment
from sgam_sfm.matchers.sparse import Features, SparseMatcher, checked_count

CHANNELS = 128
CONTRAST = 0.02  # of a maximum: COLMAP's threshold of 0.02 / 3 a layer, in OpenCV's terms
FINEST_SIZE = 4.0  # diameter up to which a feature is as precise as a pixel


class SIFTExtractor:
    """SIFT features of crops, by OpenCV, the strongest `max_features`."""

    def __init__(self, max_features: int, device: torch.device) -> None:
        self._count = checked_count(max_features)
        self._device = device

    def __call__(self, crops: Sequence[Crop]) -> list[Features]:
        return [self._extract(crop) for crop in crops]

    def _extract(self, crop: Crop) -> Features:
        # With its precise upscaling, OpenCV has the first pixel centred on 0 in every octave.
        found, descriptors = strongest_sift(
            crop.gray(), crop.mask(), self._count, contrastThreshold=CONTRAST, enable_precise_upscale=True
        )
        if not found:
            return Features.none(crop, CHANNELS, self._device)
        points = np.array([keypoint.pt for keypoint in found], np.float32) + np.float32(0.5)
        sizes = np.array([keypoint.size for keypoint in found], np.float32)
        angles = np.deg2rad(np.array([keypoint.angle for keypoint in found], np.float32))
        arrays = (points, descriptors, np.maximum(sizes / FINEST_SIZE, 1), np.stack([sizes / 2, angles], 1))
        tensors = [torch.from_numpy(array.astype(np.float32)).to(self._device) for array in arrays]
        return Features(tensors[0], tensors[1], crop.size, tensors[2], tensors[3])


def sift(*, device: str = "cpu", seed: int = 0, max_features: int = 8192, max_ratio: float = 0.8) -> SparseMatcher:
    """SIFT with mutual ratio matching.

    Args: device: of the comparison; features are found on the CPU. seed: accepted as by every matcher, but nothing here
        is random. max_features: of a crop. max_ratio: nearest over second nearest distance, on both sides.
    """
    return SparseMatcher(SIFTExtractor(max_features, find_device(device)), RatioAssignment(max_ratio))
