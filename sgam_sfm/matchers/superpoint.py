"""SuperPoint with LightGlue (DeTone et al., CVPRW 2018; Lindenberger et al., ICCV 2023).

The network is written anew after the paper; its published weights are for research only. Keypoints are whole pixels,
out of cells as XFeat's are, and are placed below the pixel in the same two ways.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import grid_sample, max_pool2d, normalize, pixel_shuffle, relu

from sgam_core.types import Crop
from sgam_sfm.matchers.frames import ready, rgb_frames
from sgam_sfm.matchers.lightglue import with_lightglue
from sgam_sfm.matchers.peaks import parabola, peaks
from sgam_sfm.matchers.sparse import MIN_SIDE, Features, checked_count
from sgam_sfm.matchers.state_dicts import fill, read_tensors
from sgam_sfm.weights import SUPERPOINT, SUPERPOINT_LIGHTGLUE

CELL = 8
CHANNELS = 256
RADIUS = 4
MIN_PROBABILITY = 0.0005  # of a keypoint within its cell, as with LightGlue
_STAGES = (("1", 1, 64), ("2", 64, 64), ("3", 64, 128), ("4", 128, 128))  # two convolutions each, pooled between
_LUMA = (0.299, 0.587, 0.114)


class SuperPointNet(nn.Module):
    """A shared encoder of eight convolutions with a head for keypoints and one for descriptors."""

    def __init__(self) -> None:
        super().__init__()
        for name, channels, width in _STAGES:
            self.add_module(f"conv{name}a", nn.Conv2d(channels, width, 3, padding=1))
            self.add_module(f"conv{name}b", nn.Conv2d(width, width, 3, padding=1))
        for head, channels in (("P", CELL**2 + 1), ("D", CHANNELS)):
            self.add_module(f"conv{head}a", nn.Conv2d(128, 256, 3, padding=1))
            self.add_module(f"conv{head}b", nn.Conv2d(256, channels, 1))

    def forward(self, gray: Float[Tensor, "B 1 H W"]) -> tuple[Tensor, Tensor]:
        """The probability of a keypoint (B, 1, H, W), and descriptors of cells (B, 256, H / 8, W / 8)."""
        maps = gray
        for name, _, _ in _STAGES:
            maps = maps if name == "1" else max_pool2d(maps, 2)
            maps = relu(self._modules[f"conv{name}b"](relu(self._modules[f"conv{name}a"](maps))))  # type: ignore[misc]
        logits, descriptors = (
            self._modules[f"conv{head}b"](relu(self._modules[f"conv{head}a"](maps)))  # type: ignore[misc]
            for head in ("P", "D")
        )
        # The last channel of a cell stands for none of its pixels.
        return pixel_shuffle(logits.softmax(1)[:, :-1], CELL), normalize(descriptors, dim=1)


class SuperPointExtractor:
    """SuperPoint features of crops, the likeliest `max_features`."""

    def __init__(self, path: Path, max_features: int, device: torch.device) -> None:
        net = SuperPointNet()
        fill(net, read_tensors(path, "SuperPoint"), path, "SuperPoint")
        self._net = ready(net, device)
        self._count = checked_count(max_features)
        self._device = device

    def __call__(self, crops: Sequence[Crop]) -> list[Features]:
        if min(crops[0].size) < MIN_SIDE:
            return [Features.none(crop, CHANNELS, self._device) for crop in crops]
        weights = torch.tensor(_LUMA, device=self._device)[:, None, None]
        gray = (rgb_frames(crops, CELL, self._device) * weights).sum(1, keepdim=True)
        probability, maps = self._net(gray)
        return [self._features(*each) for each in zip(crops, probability[:, 0], maps, strict=True)]

    def _features(self, crop: Crop, probability: Float[Tensor, "h w"], own_map: Float[Tensor, "C y x"]) -> Features:
        pixels = peaks(probability, crop, self._count, minimum=MIN_PROBABILITY, radius=RADIUS)
        if not len(pixels):
            return Features.none(crop, CHANNELS, self._device)
        # As LightGlue was trained: cell i is centred on pixel 8 i + 3.5, and the last pixel on the last cell.
        spans = torch.tensor(probability.shape[::-1], device=self._device) - (CELL + 1) / 2
        grid = 2 * (pixels - (CELL - 1) / 2) / spans - 1
        descriptors = grid_sample(own_map[None], grid[None, None], mode="bilinear", align_corners=True)[0, :, 0].T
        points = pixels + 0.5 + parabola(probability.clamp(min=1e-9).log(), pixels)
        return Features.of(points, normalize(descriptors, dim=1), crop)


superpoint_lightglue = partial(
    with_lightglue, SuperPointExtractor, (SUPERPOINT, SUPERPOINT_LIGHTGLUE), input_dim=CHANNELS
)
"""SuperPoint with LightGlue; arguments and errors: see `with_lightglue`."""
