"""Looks: how whole images are seen when they do not agree as they are. Not in the paper.

Point matchers see through neither large turns nor large changes of size. Where two whole images do not agree, they
are seen small with the second one turned, then with one of them made smaller. The look that finds clearly more stays,
and all that follows begins with its matches. Most images that do not agree show different things: a glance at half the
size of a look, whose matches are only counted, spares them the look itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sgam_core.options import GuidanceOptions, TurningOptions, ZoomOptions
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

    @property
    def glance(self) -> Look:
        """The same at half the size."""
        return self.smaller(2, 2)

    def smaller(self, by0: float, by1: float) -> Look:
        """The same with either image so many times smaller."""
        size0, size1 = self.sizes
        return replace(self, sizes=(max(round(size0 / by0), 1), max(round(size1 / by1), 1)))


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
    if turning.enabled and not agree(models([look])[0], guidance.sure_matches, guidance):
        sizes = (turning.image_size, turning.image_size)
        upright, *turned = (Look(sizes=sizes, degrees=degrees) for degrees in range(0, 360, turning.step))
        turned = _promising(turned, look, counts, turning)
        if (best := _clearly_best(turned, upright, models, turning)) is not None:
            look = replace(plain, degrees=best.degrees)
    if zoom.enabled and not agree(models([look])[0], zoom.sure_matches, guidance):
        smaller = [look.smaller(zoom.factor, 1), look.smaller(1, zoom.factor)]
        smaller = _promising(smaller, look, counts, zoom)
        look = _clearly_best(smaller, look, models, zoom) or look
    return look


def agree(model: TwoViewModel | None, sure_matches: int, guidance: GuidanceOptions) -> bool:
    """Whether whole images agree: so many of their matches, and a large share of all; never for 0 `sure_matches`."""
    if model is None or not sure_matches:
        return False
    return model.num_inliers >= sure_matches and model.inlier_ratio >= guidance.sure_inlier_ratio


def _promising(
    looks: Sequence[Look], unchanged: Look, counts: Counts, options: TurningOptions | ZoomOptions
) -> list[Look]:
    """The looks at which a glance finds enough matches, for its size, against those of the images unchanged."""
    if not options.min_glance:
        return list(looks)
    glances = [look.glance for look in looks]
    [least] = _densities([unchanged], counts)
    found = zip(looks, _densities(glances, counts), strict=True)
    return [look for look, density in found if density >= options.min_glance * least]


def _densities(looks: Sequence[Look], counts: Counts) -> list[float]:
    """Matches by the size of the smaller image, squared."""
    return [count / min(look.sizes) ** 2 for look, count in zip(looks, counts(looks), strict=True)]


def _clearly_best(
    looks: Sequence[Look], unchanged: Look, models: Models, options: TurningOptions | ZoomOptions
) -> Look | None:
    """The look with most inliers, where they are enough against those of the images unchanged; None where not."""
    if not looks:
        return None
    found = _inliers(models(looks))
    best = int(np.argmax(found))
    if found[best] < options.min_inliers:  # of most pairs: the images unchanged need not be matched at this size
        return None
    return looks[best] if found[best] >= options.min_lead * _inliers(models([unchanged]))[0] else None


def _inliers(models: Sequence[TwoViewModel | None]) -> list[int]:
    return [0 if model is None else model.num_inliers for model in models]
