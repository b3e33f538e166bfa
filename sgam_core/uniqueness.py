"""A place of one image is one place in the other: of areas that say otherwise, those with most matches are right.

Not in the paper. What looks alike again and again, as windows of a facade do, is often matched along epipolar lines,
where no geometry tells right from wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from sgam_core.prediction import MatchedArea
from sgam_core.types import AreaState, Box

_FEWEST = 8  # matches that tell where an area puts a place
_SHARED = 0.25  # share of an area's matches on the ground of another one, from which on the two can be compared
_APART = 0.25  # of an area's long side: so far apart, two places are not one


def without_contradictions(areas: Sequence[MatchedArea]) -> list[MatchedArea]:
    """The areas, those rejected that put what an area with more matches shows elsewhere, in either image."""
    judged = list(areas)
    trusted: list[MatchedArea] = []
    for row in sorted(range(len(areas)), key=lambda row: (-len(areas[row].matches), row)):
        area = areas[row]
        if area.area.state is not AreaState.KEPT:
            continue
        if any(_contradict(area, other) or _contradict(other, area) for other in trusted):
            judged[row] = area.resolved(AreaState.REJECTED, "an area with more matches puts the same ground elsewhere")
        else:
            trusted.append(area)
    return judged


def _contradict(area: MatchedArea, other: MatchedArea) -> bool:
    """Whether, in either image, many of an area's points lie in the other one, which puts them elsewhere."""
    here, there = (area.matches.points0, area.matches.points1), (other.matches.points0, other.matches.points1)
    boxes = other.area.area0.box, other.area.area1.box
    return _elsewhere(here, there, boxes) or _elsewhere(here[::-1], there[::-1], boxes[::-1])


def _elsewhere(here: Sequence[np.ndarray], there: Sequence[np.ndarray], boxes: Sequence[Box]) -> bool:
    """Whether points of one area that lie in another one are put elsewhere than that one's own points.

    Args: here, there: (N, 2) and (M, 2) points of both areas, in one image and in the other. boxes: of the second area.
    """
    shared = boxes[0].contains(here[0])
    if shared.sum() < max(_FEWEST, _SHARED * len(here[0])) or len(there[0]) < _FEWEST:
        return False
    affine, _ = cv2.estimateAffine2D(there[0], there[1], method=cv2.LMEDS)
    if affine is None or not np.isfinite(affine).all():
        return False
    off: Float[np.ndarray, " N"] = np.linalg.norm(
        here[0][shared] @ affine[:, :2].T + affine[:, 2] - here[1][shared], axis=1
    )
    return bool(np.median(off) > _APART * max(boxes[1].width, boxes[1].height))
