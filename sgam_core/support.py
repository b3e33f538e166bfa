"""Area pairs against the plain matches of the whole images: those that these do not support are not looked at.

Not in the paper, which matches every area pair that semantics propose. Plain matches that are mostly wrong still join
the right areas more often than chance does; where they do not, crops found nothing either (docs/research.md).
"""

from __future__ import annotations

from dataclasses import replace

from scipy.stats import binom

from sgam_core.types import AreaMatch, AreaState, Matches, PutativeAreas


def supported(putative: PutativeAreas, matches: Matches, max_chance: float) -> PutativeAreas:
    """The same, area pairs marked as skipped that plain matches join no more often than by chance.

    Args: matches: of the whole images. max_chance: probability that as many of the matches that begin in the first area
        end in the second one, if they end there like all others do.
    """

    def judged(area: AreaMatch) -> AreaMatch:
        inside0, inside1 = area.area0.box.contains(matches.points0), area.area1.box.contains(matches.points1)
        joined, leaving = int((inside0 & inside1).sum()), int(inside0.sum())
        share = inside1.mean() if len(matches) else 0.0
        if joined and binom.sf(joined - 1, leaving, share) <= max_chance:
            return area
        reason = (
            f"{joined} of {leaving} whole-image matches in its first area end in its second one, no more than chance"
        )
        return replace(area, state=AreaState.SKIPPED, reason=reason)

    return replace(
        putative,
        confident=tuple(judged(area) for area in putative.confident),
        doubtful=tuple(tuple(judged(area) for area in group) for group in putative.doubtful),
    )
