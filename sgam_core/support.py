"""Area pairs against the plain matches of the whole images: those that these do not support are not looked at.

Not in the paper, which matches every area pair that semantics propose. Plain matches that are mostly wrong still join
the right areas more often than chance does; where they do not, crops found nothing either (docs/research.md).
"""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter

from scipy.stats import binom

from sgam_core.types import AreaMatch, AreaState, Matches, PutativeAreas


def supported(putative: PutativeAreas, matches: Matches, max_chance: float) -> PutativeAreas:
    """The same, area pairs marked as skipped that plain matches join no more often than by chance.

    Certain area pairs are put in order, those with most support first.

    Args: matches: of the whole images. max_chance: probability that as many of the matches that begin in the first area
        end in the second one, if they end there like all others do.
    """

    def judged(area: AreaMatch) -> tuple[float, AreaMatch]:
        inside0, inside1 = area.area0.box.contains(matches.points0), area.area1.box.contains(matches.points1)
        joined, leaving = int((inside0 & inside1).sum()), int(inside0.sum())
        chance = float(binom.sf(joined - 1, leaving, inside1.mean())) if joined else 1.0
        if chance <= max_chance:
            return chance, area
        reason = (
            f"{joined} of {leaving} whole-image matches in its first area end in its second one, no more than chance"
        )
        return chance, replace(area, state=AreaState.SKIPPED, reason=reason)

    confident = sorted((judged(area) for area in putative.confident), key=itemgetter(0))
    return replace(
        putative,
        confident=tuple(area for _, area in confident),
        doubtful=tuple(tuple(judged(area)[1] for area in group) for group in putative.doubtful),
    )
