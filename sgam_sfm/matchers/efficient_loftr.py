"""Efficient LoFTR (Wang et al., CVPR 2024), with the networks of transformers and our own matching of their features.

Coarse cells of 8 pixels are matched by mutual likelihood; in the windows of two matched cells the best pair of fine
pixels is taken, and the second one is moved by the expectation over its 3x3 neighbours. transformers' own matching is
not used: see docs/matchers.md. The coordinates that result have the corner origin, as LoFTR's, whose training they
share: cell (i, j) sits on the corner of pixel (8 i, 8 j).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import interpolate, pad, scaled_dot_product_attention, softmax

from sgam_core.errors import OptionError, WeightsError
from sgam_core.types import Crop, Matches
from sgam_sfm.hub import load, load_network, transformers_for
from sgam_sfm.machine import find_device, out_of_memory
from sgam_sfm.matchers.frames import in_batches
from sgam_sfm.matchers.masks import wanted

HUB_ID = "zju-community/efficientloftr"
CELL = 8
MULTIPLE = 32  # sides of the network's input: cells are aggregated four by four
CUDA_BATCH_PIXELS = 4 * 2**20


class EfficientLoFTR:
    """Point matcher (`sgam_core.protocols.PointMatcher`): Efficient LoFTR.

    Crops are resized to the next multiples of 32 pixels, and points scaled back. Pairs of equal frames go through the
    network in batches; on the CPU one by one. Equal input gives equal output; `seed` is accepted as by every matcher,
    but nothing here is random. Memory grows with the product of the two crops' pixels. The score of a match is the
    likelihood of its cells.

    Args:
        weights: a folder as `hf download` writes it, or the model.safetensors in one; without it, the hub's model.
        device: a torch device.
        min_confidence: matches exceed it; in [0, 1). None: what the model's configuration says.
        batch_pixels: pixels of both frames that go through the network together (a pair alone may exceed it); 0: one
            pair at a time on the CPU, 4 megapixels elsewhere.

    Raises: WeightsError when there are no weights or they are not Efficient LoFTR's; OptionError for wrong options or
        when transformers is not installed, and by `match` when a pair does not fit into memory.
    """

    def __init__(
        self,
        *,
        weights: Path | None = None,
        device: str = "cpu",
        seed: int = 0,
        min_confidence: float | None = None,
        batch_pixels: int = 0,
    ) -> None:
        if min_confidence is not None and not 0 <= min_confidence < 1:
            raise OptionError(f"min_confidence is {min_confidence}; expected at least 0 and less than 1")
        if batch_pixels < 0:
            raise OptionError(f"batch_pixels is {batch_pixels}; expected at least 0")
        transformers = transformers_for("efficient-loftr")
        self.device = find_device(device)
        self.batch_pixels = batch_pixels or (1 if self.device.type == "cpu" else CUDA_BATCH_PIXELS)
        model = "efficient-loftr" if weights is None else f"efficient-loftr --weights {weights}"
        name = HUB_ID if weights is None else _folder(weights, model)
        config = load(transformers.AutoConfig.from_pretrained, name, model)
        if config.model_type != "efficientloftr":
            raise OptionError(f"'{model}' is a {config.model_type}; expected Efficient LoFTR, as {HUB_ID}")
        self._net = load_network(transformers.EfficientLoFTRForKeypointMatching, name, model, self.device)
        self.config = self._net.config
        self.min_confidence = config.coarse_matching_threshold if min_confidence is None else min_confidence

    @torch.inference_mode()
    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """Match every pair of crops; see `PointMatcher.match`.

        Raises: OptionError when a pair does not fit into memory.
        """
        return in_batches(pairs, frame_size, self.batch_pixels, self._match)

    def _match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """The matches of pairs of equal frames, which go through the network together."""
        try:
            coarse, fine = self._features(*(self._frames([pair[side] for pair in pairs]) for side in (0, 1)))
            return [
                self._matches(pair, (coarse[0][i], coarse[1][i]), (fine[0][i], fine[1][i]))
                for i, pair in enumerate(pairs)
            ]
        except (MemoryError, RuntimeError) as error:
            if not out_of_memory(error):
                raise
            (w0, h0), (w1, h1) = (crop.size for crop in pairs[0])
            raise OptionError(
                f"efficient-loftr: {len(pairs)} pair(s) of crops of {w0}x{h0} and {w1}x{h1} pixels do not fit into "
                "memory; lower --image-size for whole images, --area-size for areas"
            ) from error

    def _frames(self, crops: Sequence[Crop]) -> Float[Tensor, "B 1 h w"]:
        """Crops as the network sees them: grey, in [0, 1], resized to `frame_size`."""
        resized = [cv2.resize(crop.gray(), frame_size(crop)) for crop in crops]
        return torch.from_numpy(np.stack(resized)[:, None]).to(self.device).float() / 255

    def _features(
        self, frames0: Float[Tensor, "B 1 h0 w0"], frames1: Float[Tensor, "B 1 h1 w1"]
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Coarse features (B, C, h/8, w/8) and fine ones (B, c, h, w) of both sides, whose sizes may differ."""
        base = self._net.efficientloftr
        (*rest0, coarse0), (*rest1, coarse1) = base.backbone(frames0), base.backbone(frames1)
        position0, position1 = self._positions(coarse0), self._positions(coarse1)
        for layer in base.local_feature_transformer.layers:
            coarse0 = layer.self_attention(coarse0, position_embeddings=position0)
            coarse1 = layer.self_attention(coarse1, position_embeddings=position1)
            # The second side looks at the first one after it has changed: so the network was trained.
            coarse0 = _cross_attention(layer.cross_attention, coarse0, coarse1)
            coarse1 = _cross_attention(layer.cross_attention, coarse1, coarse0)
        coarse = [features / self.config.hidden_size**0.5 for features in (coarse0, coarse1)]
        fusion = self._net.refinement_layer
        fine = [
            fusion.forward_pyramid(features, rest[::-1]) for features, rest in zip(coarse, (rest0, rest1), strict=True)
        ]
        return coarse, fine

    def _positions(self, coarse: Float[Tensor, "B C h w"]) -> tuple[Tensor, ...]:
        waves = self._net.efficientloftr.rotary_emb(coarse)
        return tuple(wave.expand(len(coarse), -1, -1, -1).flatten(1, 2) for wave in waves)

    def _matches(self, pair: tuple[Crop, Crop], coarse: tuple[Tensor, Tensor], fine: tuple[Tensor, Tensor]) -> Matches:
        cells0, cells1, scores = self._cells(*coarse)
        moves0, moves1 = self._moves(*fine, cells0, cells1)
        sides = []
        for crop, cells, moves in zip(pair, (cells0, cells1), (moves0, moves1), strict=True):
            points = (CELL * cells + moves).cpu().numpy().astype(np.float64)
            sides.append(points * np.divide(crop.size, frame_size(crop)))
        good = wanted(pair[0], sides[0]) & wanted(pair[1], sides[1])
        likely = scores.cpu().numpy()[good]
        return Matches(points0=sides[0][good], points1=sides[1][good], scores=likely.clip(0, 1))

    def _cells(
        self, coarse0: Float[Tensor, "C h0 w0"], coarse1: Float[Tensor, "C h1 w1"]
    ) -> tuple[Int[Tensor, "M 2"], Int[Tensor, "M 2"], Float[Tensor, " M"]]:
        """Cells (x, y) that are each other's likeliest, apart from those at the border, and their likelihood."""
        similarity = coarse0.flatten(1).T @ coarse1.flatten(1) / self.config.coarse_matching_temperature
        likely = similarity
        if not self.config.coarse_matching_skip_softmax:
            likely = softmax(similarity, 0) * softmax(similarity, 1)
        border = self.config.coarse_matching_border_removal
        inner0, inner1 = (_inner(features, border) for features in (coarse0, coarse1))
        mutual = (likely == likely.amax(0)) & (likely == likely.amax(1, keepdim=True)) & (likely > self.min_confidence)
        rows, columns = torch.nonzero(mutual & inner0[:, None] & inner1, as_tuple=True)
        # Equal likelihoods, as in blank images, would give one cell several matches.
        first = torch.ones_like(rows, dtype=torch.bool)
        first[1:] = rows[1:] != rows[:-1]
        rows, columns = rows[first], columns[first]
        cells = (
            torch.stack([index % features.shape[2], index // features.shape[2]], 1)
            for index, features in ((rows, coarse0), (columns, coarse1))
        )
        return *cells, likely[rows, columns]

    def _moves(
        self,
        fine0: Float[Tensor, "c h0 w0"],
        fine1: Float[Tensor, "c h1 w1"],
        cells0: Int[Tensor, "M 2"],
        cells1: Int[Tensor, "M 2"],
    ) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M 2"]]:
        """Where in the windows of matched cells the points lie, from the cells' corners, in pixels of the frames."""
        size, count = self.config.fine_kernel_size, len(cells0)
        windows0 = _windows(fine0, cells0, size)  # (M, size^2, c)
        windows1 = _windows(pad(fine1, (1, 1, 1, 1)), cells1, size + 2)
        channels, last = windows0.shape[2], self.config.fine_matching_slice_dim
        first0, first1 = windows0[..., :-last], windows1[..., :-last]
        similarity = first0 @ first1.mT / channels
        likely = softmax(similarity, 1) * softmax(similarity, 2)
        likely = likely.reshape(count, size**2, size + 2, size + 2)[..., 1:-1, 1:-1].flatten(2)
        best = likely.flatten(1).argmax(1)
        pixel0, pixel1 = best // size**2, best % size**2
        offsets = [torch.stack([pixel % size, pixel // size], 1) - size // 2 + 0.5 for pixel in (pixel0, pixel1)]

        rows = torch.arange(count, device=best.device)
        second = (windows0[rows, pixel0, None, -last:] @ windows1[..., -last:].mT)[:, 0] / last**0.5
        second = second.reshape(count, size + 2, size + 2)
        step = torch.arange(3, device=best.device)
        down, across = (pixel1 // size)[:, None] + step, (pixel1 % size)[:, None] + step
        around = second[rows[:, None, None], down[:, :, None], across[:, None, :]].flatten(1)
        weights = softmax(around / self.config.fine_matching_regress_temperature, 1).reshape(count, 3, 3)
        expected = torch.stack([(weights.sum(axis) * (step - 1)).sum(1) for axis in (1, 2)], 1)
        return offsets[0], offsets[1] + expected


def frame_size(crop: Crop) -> tuple[int, int]:
    """The crop's (width, height) up to the next multiples of 32."""
    width, height = (-(-side // MULTIPLE) * MULTIPLE for side in crop.size)
    return width, height


def _folder(weights: Path, model: str) -> str:
    if weights.is_file() and weights.name != "model.safetensors":
        raise WeightsError(f"'{model}': expected model.safetensors with config.json beside it, or their folder")
    return str((weights.parent if weights.is_file() else weights).absolute())


def _cross_attention(
    block: Any, side: Float[Tensor, "B C h w"], other: Float[Tensor, "B C h1 w1"]
) -> Float[Tensor, "B C h w"]:
    """One side after a look at the other; transformers runs the block on sides of equal size only."""
    attention, step = block.attention, block.q_aggregation_kernel_size
    query, keys = (states.flatten(1, 2) for states in block.aggregation(side, other))
    parts = (attention.q_proj(query), attention.k_proj(keys), attention.v_proj(keys))
    q, k, v = (part.reshape(*part.shape[:2], -1, attention.head_dim).transpose(1, 2) for part in parts)
    seen = scaled_dot_product_attention(q, k, v, scale=attention.scaling).transpose(1, 2).flatten(2)
    batch, channels, height, width = side.shape
    coarser = attention.o_proj(seen).mT.reshape(batch, channels, height // step, width // step)
    message = interpolate(coarser, (height, width), mode="bilinear")
    update: Tensor = block.mlp(torch.cat([side, message], 1).permute(0, 2, 3, 1))
    return side + update.permute(0, 3, 1, 2)


def _inner(features: Float[Tensor, "C h w"], border: int) -> Tensor:
    """Which cells are not among the outermost `border` rows and columns, (h * w,)."""
    inner = torch.zeros(features.shape[1:], dtype=torch.bool, device=features.device)
    height, width = inner.shape
    inner[border : max(height - border, border), border : max(width - border, border)] = True
    return inner.flatten()


def _windows(fine: Float[Tensor, "c h w"], cells: Int[Tensor, "M 2"], size: int) -> Float[Tensor, "M n c"]:
    """The pixels of a window of every cell (x, y), row by row."""
    side = torch.arange(size, device=fine.device)
    x, y = (CELL * cells[:, axis, None] + side for axis in (0, 1))
    return fine[:, y[:, :, None], x[:, None, :]].flatten(2).permute(1, 2, 0)
