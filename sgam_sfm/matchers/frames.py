"""Crops as networks see them: padded at the right and the bottom, so that their pixels stay where they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from sgam_core.types import Crop, Matches

Net = TypeVar("Net", bound=nn.Module)


def rgb_frames(crops: Sequence[Crop], multiple: int, device: torch.device) -> Float[Tensor, "B 3 H W"]:
    """Crops of equal size as one batch in [0, 1], both sides a multiple of `multiple`; their edges are repeated."""
    pixels = np.stack([crop.pixels() for crop in crops])
    images = torch.from_numpy(pixels).to(device).permute(0, 3, 1, 2).float() / 255
    width, height = crops[0].size
    padded = pad(images, (0, -width % multiple, 0, -height % multiple), mode="replicate")
    return padded.contiguous(memory_format=torch.channels_last)


def in_batches(
    pairs: Sequence[tuple[Crop, Crop]],
    frame_size: Callable[[Crop], tuple[int, int]],
    batch_pixels: int,
    match: Callable[[Sequence[tuple[Crop, Crop]]], list[Matches]],
) -> list[Matches]:
    """The matches of pairs, of which those whose frames have equal sizes are matched together.

    Args: frame_size: (width, height) of a crop as the network sees it. batch_pixels: of the frames of a batch, which
        has one pair at least. match: gives the matches of a batch.
    """
    results = [Matches.empty()] * len(pairs)
    by_size: dict[tuple[int, ...], list[int]] = {}
    for row, (crop0, crop1) in enumerate(pairs):
        by_size.setdefault(frame_size(crop0) + frame_size(crop1), []).append(row)
    for (width0, height0, width1, height1), same_size in by_size.items():
        count = max(1, batch_pixels // (width0 * height0 + width1 * height1))
        for start in range(0, len(same_size), count):
            batch = same_size[start : start + count]
            for row, matches in zip(batch, match([pairs[row] for row in batch]), strict=True):
                results[row] = matches
    return results


def ready(net: Net, device: torch.device) -> Net:
    """A network of convolutions, ready to run; with channels last it takes about half the time on the CPU."""
    net.eval().requires_grad_(False).to(device)
    return nn.Module.to(net, memory_format=torch.channels_last)  # type: ignore[call-overload]
