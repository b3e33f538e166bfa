"""SIFT by OpenCV, with descriptors to be compared as RootSIFT (Arandjelovic & Zisserman, CVPR 2012)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8


def strongest_sift(
    gray: UInt8[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"] | None, count: int, **settings: Any
) -> tuple[Sequence[cv2.KeyPoint], Float32[np.ndarray, "N 128"]]:
    """The strongest SIFT keypoints of an image inside its mask, and their descriptors, of length 1.

    Args: count: most of them. settings: of OpenCV's detector.
    """
    if mask is None:
        found, descriptors = cv2.SIFT.create(nfeatures=count, **settings).detectAndCompute(gray, None)
    else:  # OpenCV would count those under the mask, too
        found, descriptors = cv2.SIFT.create(nfeatures=0, **settings).detectAndCompute(gray, mask.astype(np.uint8))
        best = np.argsort([-keypoint.response for keypoint in found], kind="stable")[:count]
        found, descriptors = [found[row] for row in best], descriptors[best] if len(best) else descriptors
    if not found:
        return [], np.zeros((0, 128), np.float32)
    return found, np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6))
