"""Looks: how whole images are seen when they do not agree as they are. Not in the paper.

Point matchers see through neither quarter turns nor large changes of size. Where two whole images do not agree, they
are seen small with the second one turned, then with one of them made smaller. The look that finds clearly more stays,
and all that follows begins with its matches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sgam_core.options import TurningOptions, ZoomOptions


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """How two whole images are seen: their long sides at the matcher, and quarter turns anticlockwise of the second."""

    sizes: tuple[int, int]
    turns: int = 0

    @property
    def size_ratio(self) -> float:
        """Size of the second image over that of the first one."""
        return self.sizes[1] / self.sizes[0]


def best_look(
    plain: Look,
    agrees: Callable[[Look], bool],
    inliers: Callable[[Sequence[Look]], Sequence[int]],
    turning: TurningOptions,
    zoom: ZoomOptions,
) -> Look:
    """The look at which whole images agree clearly better than at the plain one, which it is where there is none.

    Args: agrees: whether they agree so well at a look that no other is needed. inliers: consistent matches of each.
    """
    look = plain
    if turning.enabled and not agrees(look):
        size = turning.image_size
        found = inliers([Look(sizes=(size, size), turns=turns) for turns in range(4)])
        best = int(np.argmax(found))
        if found[best] >= max(turning.min_inliers, turning.min_lead * found[0]):
            look = replace(plain, turns=best)
    if zoom.enabled and not agrees(look):
        large0, large1 = look.sizes
        small0, small1 = (max(round(zoom.share * side), 1) for side in look.sizes)
        smaller = [replace(look, sizes=sizes) for sizes in ((small0, large1), (large0, small1))]
        found = inliers([look, *smaller])
        best = int(np.argmax(found[1:]))
        if found[1 + best] >= max(zoom.min_inliers, zoom.min_lead * found[0]):
            look = smaller[best]
    return look
