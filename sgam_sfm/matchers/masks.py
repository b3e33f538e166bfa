"""Which points of a crop a matcher may return."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from sgam_core.types import Crop


def wanted(crop: Crop, points: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
    """Which points (N, 2), in crop pixels, lie on the crop and where its mask is True."""
    inside = crop.contains(points)
    if (mask := crop.mask()) is not None:
        x, y = points[inside].astype(int).T
        inside[inside] = mask[y, x]
    return inside
