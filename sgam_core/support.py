"""Area pairs against the plain matches of the whole images: those that these do not support are not looked at.

Not in the paper, which matches every area pair that semantics propose. Plain matches that are mostly wrong still join
the right areas more often than chance does; where they do not, crops found nothing either (docs/research.md).
"""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter

from scipy.stats import binom

from sgam_core.types import AreaMatch, AreaState, Matches, PutativeAreas


def supported(putative: PutativeAreas, matches: Matches, max_chance: float, min_overlap: float) -> PutativeAreas:
    """The same, area pairs marked as skipped that plain matches join no more often than by chance, or only in part.

    Certain area pairs are put in order, those with most support first.

    Args: matches: of the whole images. max_chance: probability that as many of the matches that begin in the first area
        end in the second one, if they end there like all others do. min_overlap: share of the matches of either area
        that must lie in the other one; that of the first one is the paper's AOR, as far as matches can tell it.
    """

    def judged(area: AreaMatch) -> tuple[float, AreaMatch]:
        inside0, inside1 = area.area0.box.contains(matches.points0), area.area1.box.contains(matches.points1)
        joined, leaving, arriving = int((inside0 & inside1).sum()), int(inside0.sum()), int(inside1.sum())
        chance = float(binom.sf(joined - 1, leaving, inside1.mean())) if joined else 1.0
        reason = ""
        if chance > max_chance:
            reason = (
                f"{joined} of {leaving} whole-image matches in its first area end in its second one, no more than "
                "chance"
            )
        elif joined < min_overlap * max(leaving, arriving):
            reason = (
                f"{joined} whole-image matches lie in both its areas, {leaving} in the first, {arriving} in the "
                "second: they overlap in part"
            )
        return chance, replace(area, state=AreaState.SKIPPED, reason=reason) if reason else area

    confident = sorted((judged(area) for area in putative.confident), key=itemgetter(0))
    return replace(
        putative,
        confident=tuple(area for _, area in confident),
        doubtful=tuple(tuple(judged(area)[1] for area in group) for group in putative.doubtful),
    )
