"""ALIKED with LightGlue, on kornia's models (Zhao et al., TIM 2023; Lindenberger et al., ICCV 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from kornia import feature
from torch import Tensor

from sgam_core.types import Crop
from sgam_sfm.matchers.frames import ready, rgb_frames
from sgam_sfm.matchers.lightglue import with_lightglue
from sgam_sfm.matchers.peaks import parabola, peaks
from sgam_sfm.matchers.sparse import MIN_SIDE, Features, checked_count
from sgam_sfm.matchers.state_dicts import fill, read_tensors
from sgam_sfm.weights import ALIKED, ALIKED_LIGHTGLUE

MODEL = "aliked-n16"
CHANNELS = 128
MULTIPLE = 32
_GRID = "dkd.hw_grid"  # a constant of the architecture, in no file


class ALIKEDExtractor:
    """ALIKED features of crops, the strongest `max_features`."""

    def __init__(self, path: Path, max_features: int, device: torch.device) -> None:
        net = feature.ALIKED(MODEL)
        fill(net, {_GRID: net.state_dict()[_GRID]} | read_tensors(path, "ALIKED"), path, "ALIKED")
        self._net = ready(net, device)
        self._count = checked_count(max_features)
        self._device = device

    def __call__(self, crops: Sequence[Crop]) -> list[Features]:
        if min(crops[0].size) < MIN_SIDE:
            return [Features.none(crop, CHANNELS, self._device) for crop in crops]
        maps, scores = self._net.extract_dense_map(rgb_frames(crops, MULTIPLE, self._device))
        return [self._features(*each) for each in zip(crops, maps, scores[:, 0], strict=True)]

    def _features(self, crop: Crop, dense: Float[Tensor, "C h w"], scores: Float[Tensor, "h w"]) -> Features:
        pixels = peaks(scores, crop, self._count, minimum=0)
        if not len(pixels):
            return Features.none(crop, CHANNELS, self._device)
        points = pixels + parabola(torch.logit(scores, eps=1e-6), pixels)
        sides = torch.tensor([scores.shape[1] - 1, scores.shape[0] - 1], device=self._device)
        (descriptors,), _ = self._net.desc_head(dense[None], [2 * points / sides - 1])
        return Features.of(points + 0.5, descriptors, crop)


aliked_lightglue = partial(with_lightglue, ALIKEDExtractor, (ALIKED, ALIKED_LIGHTGLUE), input_dim=CHANNELS)
"""ALIKED (n16) with LightGlue; arguments and errors: see `with_lightglue`."""
