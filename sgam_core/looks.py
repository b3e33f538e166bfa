"""Looks: how whole images are seen when they do not agree as they are. Not in the paper.

Point matchers see through neither large turns nor large changes of size. Where two whole images do not agree, their
landmarks vote how one lies and is sized against the other, and they are seen so: with the second one turned, one of
them made smaller, or both. Where that finds clearly more, all that follows begins with its matches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sgam_core.landmarks import Vote
from sgam_core.options import GuidanceOptions, LookOptions
from sgam_core.types import TwoViewModel


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """How two whole images are seen: their long sides at the matcher, and degrees anticlockwise of the second one."""

    sizes: tuple[int, int]
    degrees: int = 0

    @property
    def size_ratio(self) -> float:
        """Size of the second image over that of the first one."""
        return self.sizes[1] / self.sizes[0]


def best_look(
    plain: Look,
    vote: Callable[[], Vote],
    model: Callable[[Look], TwoViewModel | None],
    options: LookOptions,
    guidance: GuidanceOptions,
) -> Look:
    """The look that landmarks vote for, where whole images agree clearly better so; else the plain one.

    Args: vote: of the whole images' landmarks. model: the geometry of the whole images at a look. guidance: says when
        they agree.
    """
    if not options.enabled or agree(model(plain), options.sure_matches, guidance):
        return plain
    look = voted_look(plain, vote(), options)
    if look == plain:
        return plain
    before, after = (0 if (found := model(each)) is None else found.num_inliers for each in (plain, look))
    return look if after >= max(options.min_inliers, options.min_lead * before) else plain


def voted_look(plain: Look, vote: Vote, options: LookOptions) -> Look:
    """The look that a vote amounts to: a turn or a size that point matchers see through is left as it is."""
    if vote.count < options.min_votes:
        return plain
    degrees = vote.degrees if min(vote.degrees, 360 - vote.degrees) > options.min_turn else 0
    growth = vote.growth * plain.size_ratio
    if max(growth, 1 / growth) < options.min_growth:
        growth = 1.0
    size0, size1 = plain.sizes
    return Look(sizes=(max(round(size0 * min(growth, 1)), 1), max(round(size1 / max(growth, 1)), 1)), degrees=degrees)


def agree(model: TwoViewModel | None, sure_matches: int, guidance: GuidanceOptions) -> bool:
    """Whether whole images agree: so many of their matches, and a large share of all; never for 0 `sure_matches`."""
    if model is None or not sure_matches:
        return False
    return model.num_inliers >= sure_matches and model.inlier_ratio >= guidance.sure_inlier_ratio
