"""Crops as networks see them: padded at the right and the bottom, so that their pixels stay where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from sgam_core.types import Crop

Net = TypeVar("Net", bound=nn.Module)


def rgb_frames(crops: Sequence[Crop], multiple: int, device: torch.device) -> Float[Tensor, "B 3 H W"]:
    """Crops of equal size as one batch in [0, 1], both sides a multiple of `multiple`; their edges are repeated."""
    pixels = np.stack([crop.pixels() for crop in crops])
    images = torch.from_numpy(pixels).to(device).permute(0, 3, 1, 2).float() / 255
    width, height = crops[0].size
    padded = pad(images, (0, -width % multiple, 0, -height % multiple), mode="replicate")
    return padded.contiguous(memory_format=torch.channels_last)


def ready(net: Net, device: torch.device) -> Net:
    """A network of convolutions, ready to run; with channels last it takes about half the time on the CPU."""
    net.eval().requires_grad_(False).to(device)
    return nn.Module.to(net, memory_format=torch.channels_last)  # type: ignore[call-overload]
