"""XFeat's sparse keypoints with LighterGlue, on kornia's models (Potje et al., CVPR 2024).

The keypoints are whole pixels. Here a parabola through the logarithm of their scores places them below the pixel, and
where the patches of a match look alike, they decide the rest: the keypoints alone are 0.2 pixels off, and biased.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from kornia.feature.xfeat import InterpolateSparse2d
from torch import Tensor
from torch.nn.functional import interpolate, normalize, pixel_shuffle

from sgam_core.types import Crop
from sgam_sfm.matchers.frames import rgb_frames
from sgam_sfm.matchers.lightglue import with_lightglue
from sgam_sfm.matchers.peaks import parabola, peaks
from sgam_sfm.matchers.sparse import MIN_SIDE, Features, checked_count
from sgam_sfm.matchers.xfeat import CELL, MULTIPLE, load_xfeat
from sgam_sfm.weights import LIGHTERGLUE, XFEAT

CHANNELS = 64
MIN_PROBABILITY = 0.05  # of a keypoint within its cell, as published
CONFIG: dict[str, Any] = {
    "input_dim": CHANNELS,
    "descriptor_dim": 96,
    "n_layers": 6,
    "num_heads": 1,
    "depth_confidence": -1,
}


class XFeatExtractor:
    """XFeat's sparse features of crops, the `max_features` with the highest probability times reliability."""

    def __init__(self, path: Path, max_features: int, device: torch.device) -> None:
        self._net = load_xfeat(path, sparse=True).to(device)
        self._sample = InterpolateSparse2d("bicubic")
        self._count = checked_count(max_features)
        self._device = device

    def __call__(self, crops: Sequence[Crop]) -> list[Features]:
        if min(crops[0].size) < MIN_SIDE:
            return [Features.none(crop, CHANNELS, self._device) for crop in crops]
        maps, logits, reliability = self._net(rgb_frames(crops, MULTIPLE, self._device))
        probability = pixel_shuffle(logits.softmax(1)[:, : CELL**2], CELL)  # the last channel stands for none
        weight = interpolate(reliability, scale_factor=CELL, mode="bilinear", align_corners=False)
        each = zip(crops, normalize(maps, dim=1), probability[:, 0], weight[:, 0], strict=True)
        return [self._features(*one) for one in each]

    def _features(
        self,
        crop: Crop,
        own_map: Float[Tensor, "C y x"],
        probability: Float[Tensor, "h w"],
        reliability: Float[Tensor, "h w"],
    ) -> Features:
        likely = peaks(probability, crop, probability.numel(), minimum=MIN_PROBABILITY)
        scores = (probability * reliability)[likely[:, 1], likely[:, 0]]
        pixels = likely[scores.argsort(descending=True, stable=True)[: self._count]]
        if not len(pixels):
            return Features.none(crop, CHANNELS, self._device)
        height, width = probability.shape
        descriptors = self._sample(own_map[None], pixels[None].float(), H=height, W=width)[0]
        points = pixels + 0.5 + parabola(probability.clamp(min=1e-9).log(), pixels)
        return Features.of(points, normalize(descriptors, dim=1), crop)


xfeat_lighterglue = partial(with_lightglue, XFeatExtractor, (XFEAT, LIGHTERGLUE), max_features=4096, **CONFIG)
"""XFeat's sparse keypoints with LighterGlue, a small LightGlue; arguments and errors: see `with_lightglue`."""
