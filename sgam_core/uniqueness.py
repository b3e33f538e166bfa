"""A place of one image is one place in the other: of areas that say otherwise, those with most matches are right.

Not in the paper. What looks alike again and again, as windows of a facade do, is often matched along epipolar lines,
where no geometry tells right from wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from sgam_core.prediction import MatchedArea
from sgam_core.types import AreaState, Box, Matches

_FEWEST = 8  # points beside those of other areas that tell whether these put the place elsewhere
_SHARED = 0.25  # and their share of all
_BESIDE = 0.05  # of an area's long side: so near, two points show one place
_APART = 0.25  # of an area's long side: so far apart, they do not


def without_contradictions(areas: Sequence[MatchedArea]) -> list[MatchedArea]:
    """The areas, those rejected that put what areas with more matches show elsewhere, in either image."""
    judged, trusted = list(areas), Matches.empty()
    for row in sorted(range(len(areas)), key=lambda row: (-len(areas[row].matches), row)):
        area = areas[row]
        if area.area.state is not AreaState.KEPT:
            continue
        if _contradicts(area, trusted):
            judged[row] = area.resolved(AreaState.REJECTED, "areas with more matches put the same ground elsewhere")
        else:
            trusted = Matches.concatenate([trusted, area.matches])
    return judged


def _contradicts(area: MatchedArea, trusted: Matches) -> bool:
    here, there = (area.matches.points0, area.matches.points1), (trusted.points0, trusted.points1)
    boxes = area.area.area0.box, area.area.area1.box
    return _elsewhere(here, there, boxes) or _elsewhere(here[::-1], there[::-1], boxes[::-1])


def _elsewhere(
    here: Sequence[Float[np.ndarray, "_ 2"]], there: Sequence[Float[np.ndarray, "_ 2"]], boxes: Sequence[Box]
) -> bool:
    """Whether most of an area's points that lie beside others in one image are apart from them in the other one.

    Args: here, there: points of the area and those others, in the one image and in the other. boxes: the area's.
    """
    if not len(there[0]):
        return False
    near, far = (share * max(box.width, box.height) for share, box in zip((_BESIDE, _APART), boxes, strict=True))
    distances, nearest = cKDTree(there[0]).query(here[0])
    beside = distances < near
    if beside.sum() < max(_FEWEST, _SHARED * len(here[0])):
        return False
    off = np.linalg.norm(here[1][beside] - there[1][nearest[beside]], axis=1)
    return bool(np.median(off) > far)
