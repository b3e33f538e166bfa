"""LoFTR, on kornia's model: detector-free matching of cells of 8 pixels, refined in the second image (CVPR 2021).

Crops are padded with black at the right and the bottom to multiples of 8, as in training. Coarse cell (i, j) sits on
the corner of pixel (8 i, 8 j), so the padding adds no cell to the grid: it needs no mask in the network. Kornia's raw
keypoints have the corner origin of this project and are taken as they are.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.feature import LoFTR as Network
from kornia.feature.loftr.loftr import default_cfg
from torch import Tensor, nn

from sgam_core.errors import OptionError, WeightsError
from sgam_core.types import Crop, Matches
from sgam_sfm.machine import Precision, find_device, out_of_memory, runs_half
from sgam_sfm.matchers.frames import in_batches
from sgam_sfm.matchers.masks import wanted
from sgam_sfm.matchers.state_dicts import fill, read_tensors
from sgam_sfm.weights import LOFTR_INDOOR, LOFTR_OUTDOOR, find_weights

CELL = 8
CONFIG: dict[str, Any] = default_cfg  # of the pretrained models
BORDER_CELLS = CONFIG["match_coarse"]["border_rm"]  # rows and columns of cells that never match, on every side
CUDA_BATCH_PIXELS = 4 * 2**20
PRETRAINED = {"outdoor": LOFTR_OUTDOOR, "indoor_new": LOFTR_INDOOR}


class LoFTR:
    """Point matcher (`sgam_core.protocols.PointMatcher`): LoFTR with its pretrained or other weights.

    Pairs of equal padded sizes go through the network in batches; on the CPU one by one, which keeps results
    independent of what else is asked for. Equal input gives equal output; `seed` is accepted as by every matcher, but
    nothing here is random. Crops of at most 32 pixels on a side consist of border cells and have no matches. Memory
    grows with the product of the two crops' pixels. The score of a match is the network's confidence in its cells.

    Args:
        weights: `outdoor` (the default) or `indoor_new`, looked for in the torch-hub cache; or a checkpoint file: a
            state dict as kornia or the authors' repository names its parameters, plain or under `state_dict`.
        device: a torch device.
        precision: of the backbone; `auto`: half on CUDA, full elsewhere.
        min_confidence: matches exceed it; in [0, 1).
        corrected_encoding: whether the weights were trained with the corrected positional encoding, as `indoor_new`
            was; None: so when the file's name contains `indoor_new` or `indoor_ds_new`, the names it is published by.
        batch_pixels: padded pixels of both sides that go through the network together (a pair alone may exceed it);
            0: one pair at a time on the CPU, 4 megapixels elsewhere.

    Raises: WeightsError when there are no weights or a file does not hold LoFTR's; OptionError for wrong options, and
        by `match` when a pair does not fit into memory.
    """

    def __init__(
        self,
        *,
        weights: Path | None = None,
        device: str = "cpu",
        seed: int = 0,
        precision: Precision = "auto",
        min_confidence: float = 0.2,
        corrected_encoding: bool | None = None,
        batch_pixels: int = 0,
    ) -> None:
        if not 0 <= min_confidence < 1:
            raise OptionError(f"min_confidence is {min_confidence}; expected at least 0 and less than 1")
        if batch_pixels < 0:
            raise OptionError(f"batch_pixels is {batch_pixels}; expected at least 0")
        self.device = find_device(device)
        self.batch_pixels = batch_pixels or (1 if self.device.type == "cpu" else CUDA_BATCH_PIXELS)
        path = _find(weights)
        if corrected_encoding is None:
            corrected_encoding = any(name in path.name for name in ("indoor_new", "indoor_ds_new"))
        config = copy.deepcopy(CONFIG)
        config["match_coarse"]["thr"] = min_confidence
        config["coarse"]["temp_bug_fix"] = corrected_encoding
        self._net = _load(path, Network(None, config)).to(self.device)
        if runs_half(precision, self.device):
            self._net.backbone = _Half(self._net.get_submodule("backbone"))

    @torch.inference_mode()
    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """Match every pair of crops; see `PointMatcher.match`.

        Raises: OptionError when a pair does not fit into memory.
        """
        return in_batches(pairs, _padded, self.batch_pixels, self._match)

    def _match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """The matches of pairs of equal padded sizes, which go through the network together."""
        if min(side for crop in pairs[0] for side in _padded(crop)) <= 2 * BORDER_CELLS * CELL:
            return [Matches.empty()] * len(pairs)
        try:
            sides = (torch.from_numpy(_frames([pair[side] for pair in pairs])).to(self.device) for side in (0, 1))
            found = self._net(dict(zip(("image0", "image1"), sides, strict=True)))
        except (MemoryError, RuntimeError) as error:
            if not out_of_memory(error):
                raise
            (w0, h0), (w1, h1) = (crop.size for crop in pairs[0])
            raise OptionError(
                f"loftr: {len(pairs)} pair(s) of crops of {w0}x{h0} and {w1}x{h1} pixels do not fit into memory; "
                "lower --image-size for whole images, --area-size for areas"
            ) from error
        names = ("batch_indexes", "keypoints0", "keypoints1", "confidence")
        rows, points0, points1, scores = (found[name].cpu().numpy() for name in names)
        results = []
        for i, (crop0, crop1) in enumerate(pairs):
            good = (rows == i) & wanted(crop0, points0) & wanted(crop1, points1)
            results.append(Matches(points0=points0[good], points1=points1[good], scores=scores[good].clip(0, 1)))
        return results


class _Half(nn.Module):
    """The backbone, most of the work, in half precision; the sums of the attention over all cells would overflow."""

    def __init__(self, backbone: nn.Module) -> None:
        super().__init__()
        self.backbone = backbone

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        with torch.autocast(images.device.type, torch.float16):
            maps = self.backbone(images)
        return tuple(features.float() for features in maps)


def _padded(crop: Crop) -> tuple[int, int]:
    """The crop's (width, height) up to the next multiples of a cell."""
    width, height = (-(-side // CELL) * CELL for side in crop.size)
    return width, height


def _frames(crops: Sequence[Crop]) -> np.ndarray:
    """Crops of equal padded size as the network sees them: (B, 1, h, w) float32 in [0, 1]."""
    width, height = _padded(crops[0])
    frames = np.zeros((len(crops), 1, height, width), np.float32)
    for frame, crop in zip(frames, crops, strict=True):
        frame[0, : crop.size[1], : crop.size[0]] = crop.gray() / np.float32(255)
    return frames


def _find(weights: Path | None) -> Path:
    """The checkpoint of that name or path; a file named as a pretrained set comes before it."""
    name = "outdoor" if weights is None else str(weights)
    if weights is not None and weights.is_file():
        return weights
    if name not in PRETRAINED:
        known = " or ".join(PRETRAINED)
        raise WeightsError(f"no LoFTR weights at '{weights}'; give --weights a checkpoint file, or {known}")
    try:
        return find_weights(PRETRAINED[name])
    except WeightsError as error:
        raise WeightsError(f"{error} with --weights FILE") from error


def _load(path: Path, net: nn.Module) -> nn.Module:
    """The network with the weights of a checkpoint, ready to match."""
    content = read_tensors(path, "LoFTR")
    found = content.get("state_dict", content)
    if not isinstance(found, dict):
        raise WeightsError(f"'{path}' holds no state dict of LoFTR but a {type(content).__name__}")
    state = {str(key).removeprefix("matcher."): value for key, value in found.items()}
    fill(net, state, path, "LoFTR")
    # With channels last the whole takes three quarters of the time on the CPU.
    return nn.Module.to(net.eval().requires_grad_(False), memory_format=torch.channels_last)  # type: ignore[call-overload]
