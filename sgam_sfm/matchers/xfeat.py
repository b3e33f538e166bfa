"""XFeat*: semi-dense matching of learned features at two scales, on kornia's model (Potje et al., CVPR 2024).

Follows the paper's semi-dense mode with six differences, each measured:
- every crop is resized once per scale (not twice), so that a cell of the network is an exact affine map of crop pixels;
- descriptors are normalised before they are compared;
- the offset inside a cell is calibrated and applied to both sides. The network predicts where the reference point of
  the other image's cell lies in this image's cell, and its softmax expectation falls short of the true offset by a
  sixth. Asked both ways it gives two correspondences of one cell pair; their midpoint is again a correspondence of a
  locally affine map, with less noise, no bias, and no preference for one of the images;
- fewer of the features come from the coarse scale, whose cells cover 13 pixels;
- crops that are alike, in which things have one size, are seen at one scale;
- where the patches of a match look alike, they decide the last half pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from kornia.feature.xfeat import XFeatModel
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize, pad
from torch.nn.utils.fusion import fuse_conv_bn_eval

from sgam_core.errors import OptionError
from sgam_core.types import Crop, Matches
from sgam_sfm.machine import Precision, find_device, multiplies_bfloat16, runs_half
from sgam_sfm.matchers.feature_cache import FeatureCache
from sgam_sfm.matchers.masks import wanted
from sgam_sfm.matchers.sparse import batch_size as together
from sgam_sfm.matchers.state_dicts import fill, read_tensors
from sgam_sfm.matchers.subpixel import aligned
from sgam_sfm.weights import XFEAT, find_weights

CELL = 8  # pixels of the network's input per cell
MULTIPLE = 32  # the input's width and height are multiples of this
SOFTMAX_TEMPERATURE = 3.0  # of the 8 x 8 offset logits, as published
OFFSET_ROWS = 256  # matches go through the network by multiples: torch keeps code in memory for each different number
OFFSET_GAIN = 1.2  # true offset over expected offset: regressed on warps with exact ground truth
MIN_FEATURES = 64  # of a crop, however small


@dataclass(frozen=True, slots=True, eq=False)
class _Features:
    """The features of one crop, in crop pixels.

    descriptors: (K, 64), not normalised. centers: (K, 2), of their cells. steps: (K, 2), size of a network pixel. gray:
    (h, w), of the whole crop, which takes long to cut out of a photo again.
    """

    descriptors: Tensor
    centers: Tensor
    steps: Tensor
    gray: np.ndarray

    @property
    def nbytes(self) -> int:
        return self.descriptors.nbytes + self.centers.nbytes + self.steps.nbytes + self.gray.nbytes

    def select(self, rows: Tensor) -> _Features:
        return _Features(self.descriptors[rows], self.centers[rows], self.steps[rows], self.gray)


_Cells = tuple[Tensor, Tensor, Tensor]
"""Descriptors, centers and steps, as in `_Features`, of one scale."""


class XFeatStar:
    """Point matcher (`sgam_core.protocols.PointMatcher`): XFeat, semi-dense.

    Features of a crop are extracted once and kept, least recently used dropped first, until `reset()`. Crops of equal
    size go through the network in batches; on the CPU one by one, which is as fast and keeps results independent of
    what else is asked for or cached. Equal input after a `reset()` gives equal output; `seed` is accepted as by every
    matcher, but nothing here is random.

    The score of a match is cos^4 * sqrt(c0 * c1) * (1 + r) / 2: the cosine of its descriptors, the confidences of the
    two offsets, and the correlation of its patches. It ranks inliers better than any of them alone.

    Args:
        weights: the model file; found by itself when omitted.
        device: a torch device, such as `cpu` or `cuda:0`.
        precision: of the network; `auto`: half on CUDA, elsewhere full, but for offsets in bfloat16 on CPUs that
            multiply such numbers faster.
        features_per_megapixel: how many cells of a crop are kept, by reliability.
        scales: the two sizes at which a crop is seen, as factors of its own.
        alike_scale: the one size at which crops are seen that are alike.
        coarse_share: share of the features that comes from the first scale; 0 for the second scale alone.
        min_confidence: both offset confidences of a match exceed it; 0 disables.
        min_cosine: the descriptors' cosine exceeds it; -1 disables.
        photometric: align the patches of the matches in the end, on the CPU.
        batch_size: crops that go through the network together; 0: 1 on the CPU, 8 elsewhere.
        cache_bytes: bound of the kept features.

    Attributes:
        pixels_extracted: crop pixels that went through the network so far, for cost reports.
        features: what is kept of the crops.
    """

    def __init__(
        self,
        *,
        weights: Path | None = None,
        device: str = "cpu",
        seed: int = 0,
        precision: Precision = "auto",
        features_per_megapixel: int = 12_000,
        scales: tuple[float, float] = (0.6, 1.3),
        alike_scale: float = 1.15,
        coarse_share: float = 0.1,
        min_confidence: float = 0.25,
        min_cosine: float = 0.8,
        photometric: bool = True,
        batch_size: int = 0,
        cache_bytes: int = 512 * 2**20,
    ) -> None:
        if not 0 <= coarse_share < 1:
            raise OptionError(f"coarse_share is {coarse_share}; expected at least 0 and less than 1")
        if features_per_megapixel < 1:
            raise OptionError(f"features_per_megapixel is {features_per_megapixel}; expected at least 1")
        if min(*scales, alike_scale) <= 0:
            raise OptionError(f"scales are {scales} and alike_scale is {alike_scale}; expected positive factors")
        self.device = find_device(device)
        self._half = runs_half(precision, self.device)
        self.features_per_megapixel = features_per_megapixel
        self.shares = ((scales[0], coarse_share), (scales[1], 1 - coarse_share))
        self.alike_scale = alike_scale
        self.min_confidence = min_confidence
        self.min_cosine = min_cosine
        self.photometric = photometric
        self.features: FeatureCache[_Features] = FeatureCache(
            self._extract, batch_size=together(self.device, batch_size), max_bytes=cache_bytes
        )
        self._net = load_xfeat(find_weights(XFEAT, weights), sparse=False).to(self.device)
        bfloat16 = precision == "auto" and multiplies_bfloat16(self.device)
        self._offset_type = torch.bfloat16 if bfloat16 else torch.float32
        self._net.fine_matcher.to(self._offset_type)

    @property
    def pixels_extracted(self) -> int:
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
        return [self._match(crop0, crop1) for crop0, crop1 in pairs]

    def _match(self, crop0: Crop, crop1: Crop) -> Matches:
        features0, features1 = self.features.of(crop0), self.features.of(crop1)
        rows0, rows1, cosines = _mutual_nearest(features0.descriptors, features1.descriptors, self.min_cosine)
        side0, side1 = features0.select(rows0), features1.select(rows1)

        offsets0, confidences0 = self._offsets(side0, side1)
        sure = confidences0 > self.min_confidence  # the second pass is spent on those that can still pass
        side0, side1 = side0.select(sure), side1.select(sure)
        offsets1, confidences1 = self._offsets(side1, side0)
        points0 = (side0.centers + offsets0[sure] / 2).cpu().numpy()
        points1 = (side1.centers + offsets1 / 2).cpu().numpy()
        scores = (cosines[sure] ** 4 * torch.sqrt(confidences0[sure] * confidences1)).clamp(0, 1).cpu().numpy()

        good = (confidences1 > self.min_confidence).cpu().numpy() & wanted(crop0, points0) & wanted(crop1, points1)
        matches = Matches(points0=points0[good], points1=points1[good], scores=scores[good])
        return aligned(crop0, crop1, matches, (features0.gray, features1.gray)) if self.photometric else matches

    def _extract(self, crops: Sequence[Crop]) -> list[_Features]:
        """The features of crops of one size, all alike or none, which go through the network together."""
        width, height = crops[0].size
        grays = [crop.gray() for crop in crops]
        frames = torch.stack([torch.from_numpy(gray).to(self.device) for gray in grays])[:, None].float()
        budget = max(MIN_FEATURES, round(self.features_per_megapixel * width * height / 1e6))
        shares = ((self.alike_scale, 1.0),) if crops[0].alike else self.shares
        scales = [self._extract_at(scale, round(share * budget), frames, crops) for scale, share in shares if share]
        found = []
        for gray, parts in zip(grays, zip(*scales, strict=True), strict=True):
            descriptors, centers, steps = (torch.cat(of_scales) for of_scales in zip(*parts, strict=True))
            found.append(_Features(descriptors, centers, steps, gray))
        return found

    def _extract_at(self, scale: float, count: int, frames: Tensor, crops: Sequence[Crop]) -> list[_Cells]:
        """The `count` most reliable cells of each crop, seen at `scale` of its size."""
        size = crops[0].size
        width, height = (max(MULTIPLE, round(scale * side / MULTIPLE) * MULTIPLE) for side in size)
        images = interpolate(frames, (height, width), mode="bilinear", align_corners=False)
        with torch.autocast(self.device.type, torch.float16, enabled=self._half):
            maps, _, reliability = self._net(images.contiguous(memory_format=torch.channels_last))

        cells_y, cells_x = torch.meshgrid(*(torch.arange(n, device=self.device) for n in maps.shape[2:]), indexing="ij")
        step = torch.tensor([size[0] / width, size[1] / height], dtype=torch.float64, device=self.device)
        centers = (CELL * torch.stack([cells_x, cells_y], -1).reshape(-1, 2) + CELL / 2) * step
        found, places = [], centers.cpu().numpy()
        for crop, own_map, own_reliability in zip(crops, maps.float(), reliability.float(), strict=True):
            best = own_reliability.flatten().argsort(descending=True, stable=True)
            best = best[torch.from_numpy(wanted(crop, places)).to(self.device)[best]][:count]
            descriptors = own_map.flatten(1).T[best].contiguous()
            found.append((descriptors, centers[best], step.expand(len(best), 2)))
        return found

    def _offsets(self, here: _Features, there: _Features) -> tuple[Tensor, Tensor]:
        """Where the cell centres `there` lie `here`: (M, 2) crop pixels from the centre, and (M,) confidences."""
        descriptors = torch.cat([here.descriptors, there.descriptors], 1).to(self._offset_type)
        filled = pad(descriptors, (0, 0, 0, -len(descriptors) % OFFSET_ROWS))
        logits = self._net.fine_matcher(filled)[: len(descriptors)].float()
        shares = (SOFTMAX_TEMPERATURE * logits).softmax(-1)
        bins = torch.arange(CELL, device=self.device) - (CELL - 1) / 2
        by_row = shares.view(-1, CELL, CELL)
        expected = torch.stack([by_row.sum(1) @ bins, by_row.sum(2) @ bins], -1)
        return OFFSET_GAIN * expected * here.steps, shares.amax(-1)


def load_xfeat(path: Path, *, sparse: bool) -> XFeatModel:
    """XFeat's network with the weights of a file, ready to run; its keypoints only when `sparse`."""
    net = XFeatModel()
    fill(net, read_tensors(path, "XFeat"), path, "XFeat")
    net.eval().requires_grad_(False)
    if not sparse:
        net.keypoint_head = nn.Sequential()
    for layers in [module for module in net.modules() if isinstance(module, nn.Sequential)]:
        for i, norm in enumerate(layers):  # folding saves a pass over the largest maps
            if isinstance(norm, nn.BatchNorm2d):
                layers[i - 1], layers[i] = fuse_conv_bn_eval(layers[i - 1], norm), nn.Identity()  # type: ignore[type-var]
    return nn.Module.to(net, memory_format=torch.channels_last)  # type: ignore[call-overload]


def _mutual_nearest(
    descriptors0: Float[Tensor, "K0 C"], descriptors1: Float[Tensor, "K1 C"], min_cosine: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of both sides that are each other's nearest by cosine, and the cosines (M,).

    The similarity matrix is made in blocks of rows, one after the other in the same memory: so it is bounded, and new
    memory for each would take a sixth of the time on the CPU. A pair is mutual when the maximum of its row is that of
    its column.
    """
    if not (len(descriptors0) and len(descriptors1)):
        none = torch.zeros(0, dtype=torch.int64, device=descriptors0.device)
        return none, none, descriptors0.new_zeros(0)
    unit0, unit1 = normalize(descriptors0, dim=1), normalize(descriptors1, dim=1)
    on_cpu = unit0.device.type == "cpu"
    rows = min(len(unit0), max(1, (2**22 if on_cpu else 2**26) // len(unit1)))
    memory = unit1.new_empty((rows, len(unit1)))
    column_best = unit1.new_full((len(unit1),), -torch.inf)
    nearest, row_best = [], []
    for block in torch.split(unit0, rows):
        cosines = torch.mm(block, unit1.T, out=memory[: len(block)])
        if on_cpu:  # where numpy is several times as fast as torch
            index, highest = (torch.from_numpy(found) for found in (cosines.numpy().argmax(1), cosines.numpy().max(0)))
        else:
            index, highest = cosines.argmax(1), cosines.amax(0)
        nearest.append(index)
        row_best.append(cosines.gather(1, index[:, None])[:, 0])
        torch.maximum(column_best, highest, out=column_best)
    rows1, best = torch.cat(nearest), torch.cat(row_best)
    rows0 = torch.nonzero((best == column_best[rows1]) & (best > min_cosine))[:, 0]
    rows0 = rows0[_first_of_each(rows1[rows0])]  # equal descriptors tie: one match for each
    return rows0, rows1[rows0], best[rows0]


def _first_of_each(values: Tensor) -> Tensor:
    _, first = np.unique(values.cpu().numpy(), return_index=True)
    return torch.from_numpy(np.sort(first)).to(values.device)
