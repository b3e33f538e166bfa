"""Area pairs against the plain matches of the whole images: those that these do not support are not looked at.

Not in the paper, which matches every area pair that semantics propose. Plain matches that are mostly wrong still join
the right areas more often than chance does; where they do not, crops found nothing either (docs/research.md). Right
areas are often of unequal size, since an object goes on outside of one image, or its label does: they are cut to what
both show.
"""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter

import numpy as np
from scipy.special import gammaln

from sgam_core.covisible import Frame, enclosing_box
from sgam_core.options import GuidanceOptions
from sgam_core.types import AreaMatch, AreaState, Matches, PutativeAreas

_ALL = 0.95  # of the matches: an area that holds so many is what its whole image shows
_FEWEST = 8  # matches in both areas of such a pair


def supported(
    putative: PutativeAreas, matches: Matches, frame0: Frame, frame1: Frame, options: GuidanceOptions
) -> PutativeAreas:
    """The same, area pairs marked as skipped that plain matches join no more often than by chance, or only in part.

    Certain area pairs are cut to the ground that both areas show, and put in order, those with most support first.
    Doubtful ones stay whole: of those that share an area only one can be true.

    Args: matches: of the whole images. options: `max_chance`, the probability that so many matches lie in both areas,
        if those that begin in the first one end in the second one like all others do; `min_overlap`, the share of the
        matches of either area that must lie in the other one; that of the first one is the paper's AOR, as far as
        matches can tell it.
    """
    frames = (frame0, frame1)
    confident = sorted((_judged(area, matches, options, frames) for area in putative.confident), key=itemgetter(0))
    return replace(
        putative,
        confident=tuple(area for _, area in confident),
        doubtful=tuple(tuple(_judged(area, matches, options)[1] for area in group) for group in putative.doubtful),
    )


def _judged(
    area: AreaMatch, matches: Matches, options: GuidanceOptions, frames: tuple[Frame, Frame] | None = None
) -> tuple[float, AreaMatch]:
    """The probability of chance, and the area pair with its state. Args: frames: the images of what is to be cut."""
    joined, leaving, arriving = _counts(area, matches)
    chance = chance_of(joined, leaving, arriving, len(matches))
    if joined >= _FEWEST and max(leaving, arriving) >= _ALL * len(matches):
        chance = options.max_chance  # one image shows the other's area from near: chance tells nothing, overlap may
    if chance > options.max_chance:
        reason = f"{joined} of {leaving} whole-image matches lead from area to area: no more than chance"
        return chance, _skipped(area, reason)
    if frames is not None and joined >= max(options.min_matches, 1):
        area = _cut(area, matches.select(area.joins(matches)), frames, options)
        joined, leaving, arriving = _counts(area, matches)
    if joined < options.min_overlap * max(leaving, arriving):
        reason = f"its areas share {joined} of {leaving} and {arriving} whole-image matches: they overlap in part"
        return chance, _skipped(area, reason)
    return chance, area


def chance_of(joined: int, leaving: int, arriving: int, count: int) -> float:
    """The probability that of `count` matches at least so many both leave and arrive by chance (Fisher's exact test).

    The sum that `scipy.stats.hypergeom.sf` gives; importing that takes a third of the time in which a command starts.
    """
    shared = np.arange(joined, min(leaving, arriving) + 1)
    logs = _log_ways(arriving, shared) + _log_ways(count - arriving, leaving - shared) - _log_ways(count, leaving)
    return min(float(np.exp(logs).sum()), 1.0)


def _log_ways(number: int, chosen: np.ndarray | int) -> np.ndarray:
    """Of the ways to choose some of a number of things the logarithm; minus infinity where there are none."""
    return np.asarray(gammaln(number + 1) - gammaln(chosen + 1) - gammaln(number - chosen + 1))


def _counts(area: AreaMatch, matches: Matches) -> tuple[int, int, int]:
    """Matches in both areas, in the first one and in the second one."""
    inside0, inside1 = area.area0.box.contains(matches.points0), area.area1.box.contains(matches.points1)
    return int((inside0 & inside1).sum()), int(inside0.sum()), int(inside1.sum())


def _cut(area: AreaMatch, shared: Matches, frames: tuple[Frame, Frame], options: GuidanceOptions) -> AreaMatch:
    """The area pair cut to the ground of the matches that lie in both its areas."""
    box0, box1 = (
        enclosing_box(points, shared.scores, frame, options.quantile, options.margin)
        for points, frame in zip((shared.points0, shared.points1), frames, strict=True)
    )
    area0 = replace(area.area0, box=box0.within(area.area0.box))
    area1 = replace(area.area1, box=box1.within(area.area1.box))
    return replace(area, area0=area0, area1=area1)


def _skipped(area: AreaMatch, reason: str) -> AreaMatch:
    return replace(area, state=AreaState.SKIPPED, reason=reason)
