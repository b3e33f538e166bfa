"""Mutual nearest neighbours that pass the ratio test (Lowe, IJCV 2004)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sgam_core.errors import OptionError
from sgam_sfm.matchers.sparse import Assignment, Features

BLOCK_ELEMENTS = 2**22  # of the similarity matrix that are held at once


class RatioAssignment:
    """Assigns features that are each other's nearest, and nearer than `max_ratio` times the second on both sides.

    The score of a match is 1 less the larger of its two ratios.
    """

    def __init__(self, max_ratio: float) -> None:
        if not 0 < max_ratio <= 1:
            raise OptionError(f"max_ratio is {max_ratio}; expected more than 0 and at most 1")
        self.max_ratio = max_ratio

    def __call__(self, pairs: Sequence[tuple[Features, Features]]) -> list[Assignment]:
        return [self._assign(side0.descriptors, side1.descriptors) for side0, side1 in pairs]

    def _assign(self, unit0: Float[Tensor, "K0 C"], unit1: Float[Tensor, "K1 C"]) -> Assignment:
        if min(len(unit0), len(unit1)) < 2:  # a ratio takes two
            none = torch.zeros(0, dtype=torch.int64, device=unit0.device)
            return Assignment(none, none, unit0.new_zeros(0))
        nearest, cosines0, cosines1 = two_nearest(unit0, unit1)
        ratios0, ratios1 = _ratios(cosines0), _ratios(cosines1)
        mutual = cosines0[:, 0] == cosines1[nearest, 0]
        ratios = torch.maximum(ratios0, ratios1[nearest])
        rows0 = torch.nonzero(mutual & (ratios < self.max_ratio))[:, 0]
        return Assignment(rows0, nearest[rows0], 1 - ratios[rows0])


def two_nearest(unit0: Float[Tensor, "K0 C"], unit1: Float[Tensor, "K1 C"]) -> tuple[Tensor, Tensor, Tensor]:
    """Each row's nearest (K0,), and the two highest cosines of each row (K0, 2) and of each column (K1, 2).

    The similarity matrix is made in blocks of rows, so that memory is bounded.
    """
    nearest, rows = [], []
    columns = unit1.new_full((2, len(unit1)), -torch.inf)
    for block in torch.split(unit0, max(1, BLOCK_ELEMENTS // len(unit1))):
        cosines = block @ unit1.T
        best = cosines.topk(2, dim=1)
        nearest.append(best.indices[:, 0])
        rows.append(best.values)
        columns = torch.cat([columns, cosines.topk(min(2, len(block)), dim=0).values]).topk(2, dim=0).values
    return torch.cat(nearest), torch.cat(rows), columns.T


def _ratios(cosines: Float[Tensor, "K 2"]) -> Float[Tensor, " K"]:
    """Distance to the nearest over that to the second; 1 where both are 0."""
    first, second = (2 - 2 * cosines).clamp(min=1e-12).sqrt().unbind(1)
    return first / second
