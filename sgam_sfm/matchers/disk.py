"""DISK with LightGlue, on kornia's models (Tyszkiewicz et al., NeurIPS 2020; Lindenberger et al., ICCV 2023).

DISK's keypoints are whole pixels; here a parabola through its scores places them below the pixel. They lie a quarter of
a pixel to the right of what they mark and half of one below it, at any scale, so that a change of scale between the
images would show: where the patches of a match look alike, they decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from kornia import feature
from torch.nn.functional import normalize

from sgam_core.errors import WeightsError
from sgam_core.types import Crop
from sgam_sfm.matchers.frames import ready, rgb_frames
from sgam_sfm.matchers.lightglue import with_lightglue
from sgam_sfm.matchers.peaks import parabola, peaks
from sgam_sfm.matchers.sparse import MIN_SIDE, Features, checked_count
from sgam_sfm.matchers.state_dicts import fill, read_tensors
from sgam_sfm.weights import DISK, DISK_LIGHTGLUE

CHANNELS = 128
MULTIPLE = 16


class DISKExtractor:
    """DISK features of crops, the strongest `max_features`."""

    def __init__(self, path: Path, max_features: int, device: torch.device) -> None:
        net = feature.DISK(CHANNELS)
        content = read_tensors(path, "DISK")
        state = content.get("extractor", content)
        if not isinstance(state, dict):
            raise WeightsError(f"'{path}' holds no state dict of DISK but a {type(state).__name__}")
        fill(net, state, path, "DISK")
        self._net = ready(net, device)
        self._count = checked_count(max_features)
        self._device = device

    def __call__(self, crops: Sequence[Crop]) -> list[Features]:
        if min(crops[0].size) < MIN_SIDE:
            return [Features.none(crop, CHANNELS, self._device) for crop in crops]
        scores, maps = self._net.heatmap_and_dense_descriptors(rgb_frames(crops, MULTIPLE, self._device))
        found = []
        for crop, own_scores, own_map in zip(crops, scores[:, 0], maps, strict=True):
            pixels = peaks(own_scores, crop, self._count, minimum=0)
            descriptors = normalize(own_map[:, pixels[:, 1], pixels[:, 0]].T, dim=1)
            found.append(Features.of(pixels + 0.5 + parabola(own_scores, pixels), descriptors, crop))
        return found


disk_lightglue = partial(with_lightglue, DISKExtractor, (DISK, DISK_LIGHTGLUE), input_dim=CHANNELS)
"""DISK (depth) with LightGlue; arguments and errors: see `with_lightglue`."""
