"""Looks: how whole images are seen when they do not agree as they are. Not in the paper.

Point matchers see through neither large turns nor large changes of size. Where two whole images do not agree, they
are seen with the second one turned, then with one of them made smaller. The look that finds clearly more stays, and all
that follows begins with its matches. Most images that do not agree show different things: a glance, the same look but
smaller, whose matches are only counted, spares them the look itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sgam_core.options import GuidanceOptions, TurningOptions, ZoomOptions
from sgam_core.types import TwoViewModel

_RIVAL = 0.5  # of the best glance: what finds less is no rival


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """How two whole images are seen: their long sides at the matcher, and degrees anticlockwise of the second one."""

    sizes: tuple[int, int]
    degrees: int = 0

    @property
    def size_ratio(self) -> float:
        """Size of the second image over that of the first one."""
        return self.sizes[1] / self.sizes[0]

    def smaller(self, by0: float, by1: float) -> Look:
        """The same with either image so many times smaller."""
        size0, size1 = self.sizes
        return replace(self, sizes=(max(round(size0 / by0), 1), max(round(size1 / by1), 1)))

    def within(self, size: int) -> Look:
        """The same with neither image larger than a size."""
        return replace(self, sizes=(min(self.sizes[0], size), min(self.sizes[1], size)))


Counts = Callable[[Sequence[Look]], Sequence[int]]
Models = Callable[[Sequence[Look]], Sequence[TwoViewModel | None]]


def best_look(
    plain: Look,
    counts: Counts,
    models: Models,
    turning: TurningOptions,
    zoom: ZoomOptions,
    guidance: GuidanceOptions,
) -> Look:
    """The look at which whole images agree clearly better than at the plain one, which it is where there is none.

    Args: counts, models: matches of the whole images at each look, and their geometry. guidance: says when they agree.
    """
    look = plain
    if turning.enabled and not agree(models([look])[0], turning.sure_matches, guidance):
        turned = [replace(look, degrees=degrees) for degrees in range(turning.step, 360, turning.step)]
        glances = [turn.within(turning.glance_size) for turn in turned]
        turned = _promising(turned, glances, look, counts, turning.min_glance)
        look = _clearly_best(turned, look, models, turning) or look
    if zoom.enabled and not agree(models([look])[0], zoom.sure_matches, guidance):
        smaller = [look.smaller(zoom.factor, 1), look.smaller(1, zoom.factor)]
        glances = [size.smaller(2, 2) for size in smaller]
        smaller = _promising(smaller, glances, look, counts, zoom.min_glance)
        look = _clearly_best(smaller, look, models, zoom) or look
    return look


def agree(model: TwoViewModel | None, sure_matches: int, guidance: GuidanceOptions) -> bool:
    """Whether whole images agree: so many of their matches, and a large share of all; never for 0 `sure_matches`."""
    if model is None or not sure_matches:
        return False
    return model.num_inliers >= sure_matches and model.inlier_ratio >= guidance.sure_inlier_ratio


def _promising(
    looks: Sequence[Look], glances: Sequence[Look], unchanged: Look, counts: Counts, min_glance: float
) -> list[Look]:
    """The looks whose glances find enough matches for their size, against the images unchanged and the best glance."""
    if not min_glance:
        return list(looks)
    [plain], found = _densities([unchanged], counts), _densities(glances, counts)
    least = max(min_glance * plain, _RIVAL * max(found))
    return [look for look, density in zip(looks, found, strict=True) if density >= least > 0]


def _densities(looks: Sequence[Look], counts: Counts) -> list[float]:
    """Matches by the size of the smaller image, squared."""
    return [count / min(look.sizes) ** 2 for look, count in zip(looks, counts(looks), strict=True)]


def _clearly_best(
    looks: Sequence[Look], unchanged: Look, models: Models, options: TurningOptions | ZoomOptions
) -> Look | None:
    """The look with most inliers, where they are enough against those of the images unchanged; None where not."""
    if not looks:
        return None
    before, *found = (0 if model is None else model.num_inliers for model in models([unchanged, *looks]))
    best = int(np.argmax(found))
    return looks[best] if found[best] >= max(options.min_inliers, options.min_lead * before) else None
