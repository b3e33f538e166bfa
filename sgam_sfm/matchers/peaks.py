"""Keypoints of a map of scores: its strongest local maxima, below the pixel."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from kornia.geometry.subpix import nms2d
from torch import Tensor

from sgam_core.types import Crop


def peaks(
    scores: Float[Tensor, "h w"], crop: Crop, count: int, *, minimum: float, radius: int = 2
) -> Int[Tensor, "K 2"]:
    """The pixels (x, y) of the `count` highest maxima, highest first, within the crop and its mask.

    Args: scores: of the crop, padded to the right and the bottom at most. minimum: maxima exceed it. radius: pixels
        around a maximum that are lower, and that it is away from the crop's border.
    """
    width, height = crop.size
    side = 2 * radius + 1
    found = nms2d(scores[None, None], (side, side), mask_only=True)[0, 0] & (scores > minimum)
    inner = torch.zeros_like(found)
    inner[radius : max(height - radius, 0), radius : max(width - radius, 0)] = True
    if (mask := crop.mask()) is not None:
        inner[:height, :width] &= torch.from_numpy(mask).to(inner.device)
    rows, columns = torch.nonzero(found & inner, as_tuple=True)
    best = scores[rows, columns].argsort(descending=True, stable=True)[:count]
    return torch.stack([columns, rows], 1)[best]


def parabola(scores: Float[Tensor, "h w"], pixels: Int[Tensor, "K 2"]) -> Float[Tensor, "K 2"]:
    """How far from each pixel's centre the maximum lies, by a parabola through the neighbours along each axis."""
    x, y = pixels.T
    here = scores[y, x]
    shifts = []
    for dx, dy in ((1, 0), (0, 1)):
        before, after = scores[y - dy, x - dx], scores[y + dy, x + dx]
        bend = (2 * here - before - after).clamp(min=torch.finfo(scores.dtype).tiny)
        shifts.append(((after - before) / (2 * bend)).clamp(-0.5, 0.5))
    return torch.stack(shifts, 1)
