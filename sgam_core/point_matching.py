"""Point matches of one pair: what the point matcher is asked for, and its points in image pixels (PM in the paper)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sgam_core.crops import box_crop, warped_alike, whole_crop
from sgam_core.errors import ShapeError
from sgam_core.landmarks import Vote, vote
from sgam_core.looks import Look
from sgam_core.options import CropOptions
from sgam_core.prediction import Estimate, MatchedArea
from sgam_core.protocols import PointMatcher
from sgam_core.types import AreaMatch, AreaState, Box, Crop, Image, Matches, PutativeAreas, TwoViewModel
from sgam_core.wording import counted


class PairPoints:
    """The point matcher's calls for one pair: whole images at most once a look, areas in one batch.

    look: how the matcher sees the images; may be set. pixels, seconds: spent in the matcher so far; pixels_of_areas: of
    these those of `inside`. notes: limits that were reached.
    """

    def __init__(
        self,
        image0: Image,
        image1: Image,
        matcher: PointMatcher,
        options: CropOptions,
        area_crop: Callable[[Image, Box, CropOptions], Crop],
    ) -> None:
        self.images, self.matcher, self.options, self.area_crop = (image0, image1), matcher, options, area_crop
        size0, size1 = (max(whole_crop(image, options).size) for image in self.images)
        self.look = Look(sizes=(size0, size1))
        self.pixels = self.pixels_of_areas = 0
        self.seconds = 0.0
        self.notes: tuple[str, ...] = ()
        self._seen: dict[Look, Matches] = {}
        self._models: dict[Look, TwoViewModel | None] = {}

    @property
    def whole_is_known(self) -> bool:
        return self.look in self._seen

    def whole(self) -> Matches:
        """Plain matches of the whole images."""
        return self._see(self.look)

    def agreement(self, estimate: Estimate) -> TwoViewModel | None:
        """The geometry of the whole images."""
        return self.model(self.look, estimate)

    def vote(self) -> Vote:
        """How image 1 lies and is sized against image 0, as their landmarks have it."""
        return vote(*(image.landmarks for image in self.images))

    def model(self, look: Look, estimate: Estimate) -> TwoViewModel | None:
        """The geometry of the whole images, seen so."""
        if look not in self._models:
            self._models[look] = estimate(self._see(look))
        return self._models[look]

    def whole_crops(self, look: Look) -> tuple[Crop, Crop]:
        """What the matcher sees."""
        crop0, crop1 = (
            whole_crop(image, replace(self.options, image_size=size))
            for image, size in zip(self.images, look.sizes, strict=True)
        )
        return crop0, crop1.turned(look.degrees)

    def _see(self, look: Look) -> Matches:
        """Plain matches of the whole images, seen so; found once."""
        if look not in self._seen:
            [self._seen[look]] = self._match([self.whole_crops(look)])
        return self._seen[look]

    def inside(
        self, putative: PutativeAreas, options: CropOptions, max_candidates: int
    ) -> tuple[list[MatchedArea], list[list[MatchedArea]]]:
        """Point matches inside all confident areas and the doubtful candidates that the limits allow."""
        limited = _limit_candidates(putative.doubtful, max_candidates)
        planned = [*putative.confident, *(candidate for group in limited for candidate in group)]
        (image0, image1), crop, degrees = self.images, self.area_crop, self.look.degrees
        crops = [
            (crop(image0, a.area0.box, options), crop(image1, a.area1.box, options).turned(degrees)) for a in planned
        ]
        chosen = self._within_budget(planned, crops, options.max_crop_pixels)
        found = dict(zip(chosen, self._match([crops[k] for k in chosen]), strict=True))
        areas = iter([self._matched(area, crops[k], found.get(k)) for k, area in enumerate(planned)])
        confident = [next(areas) for _ in putative.confident]
        return confident, [[next(areas) for _ in group] for group in limited]

    def guided(self, areas: Sequence[AreaMatch], warps: Sequence[np.ndarray | None]) -> list[MatchedArea]:
        """Point matches inside areas that say themselves how finely they are cropped.

        Args: warps: the affine map (2, 3) from image 0 to image 1 that the crops of each area are to look alike by.
        """
        crops = [self._guided_crops(area, warp) for area, warp in zip(areas, warps, strict=True)]
        found = zip(areas, crops, self._match(crops), strict=True)
        return [self._matched(area, pair, matches) for area, pair, matches in found]

    def _guided_crops(self, area: AreaMatch, warp: np.ndarray | None) -> tuple[Crop, Crop]:
        crop0 = _scaled_crop(self.images[0], area.area0.box, area.scale0)
        crop1 = _scaled_crop(self.images[1], area.area1.box, area.scale1)
        pair = (crop0, crop1.turned(self.look.degrees)) if warp is None else warped_alike(crop0, crop1, warp)
        return replace(pair[0], alike=True), replace(pair[1], alike=True)

    def _within_budget(
        self, planned: Sequence[AreaMatch], crops: Sequence[tuple[Crop, Crop]], max_pixels: int
    ) -> list[int]:
        """Rows to match: in order, until the pixel budget is spent."""
        budget = max_pixels or float("inf")
        spent, rows = 0, []
        for k, (area, pair) in enumerate(zip(planned, crops, strict=True)):
            if area.state is AreaState.SKIPPED:
                continue
            cost = sum(crop.size[0] * crop.size[1] for crop in pair)
            if spent + cost <= budget:
                spent += cost
                rows.append(k)
        self.pixels_of_areas += spent
        waiting = sum(area.state is not AreaState.SKIPPED for area in planned) - len(rows)
        if waiting:
            self.notes += (f"{counted(waiting, 'area match')} beyond the pixel budget (max_crop_pixels)",)
        return rows

    def _matched(self, area: AreaMatch, crops: tuple[Crop, Crop], found: Matches | None) -> MatchedArea:
        scales = {"scale0": crops[0].scale, "scale1": crops[1].scale}
        if found is None:
            reason = area.reason or "beyond the pixel budget (max_crop_pixels)"
            skipped = replace(area, state=AreaState.SKIPPED, reason=reason, **scales)  # type: ignore[arg-type]
            return MatchedArea(area=skipped, matches=Matches.empty())
        inside = area.area0.box.enlarged(self.options.keep).contains(found.points0)
        inside &= area.area1.box.enlarged(self.options.keep).contains(found.points1)
        matches = found.select(inside)
        counted = replace(area, num_matches=len(matches), **scales)  # type: ignore[arg-type]
        return MatchedArea(area=counted, matches=matches)

    def _match(self, crops: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """Run the point matcher and bring its points to image pixels."""
        if not crops:
            return []
        self.pixels += sum(crop.size[0] * crop.size[1] for pair in crops for crop in pair)
        start = time.perf_counter()
        matched = self.matcher.match(crops)
        self.seconds += time.perf_counter() - start
        _require_as_agreed(self.matcher, crops, matched)
        return [self._in_image(*pair, found) for pair, found in zip(crops, matched, strict=True)]

    def _in_image(self, crop0: Crop, crop1: Crop, found: Matches) -> Matches:
        """Matches of two crops in image pixels, without those outside of the crops."""
        inside = crop0.contains(found.points0) & crop1.contains(found.points1)
        if outside := int((~inside).sum()):
            self.notes += (f"{outside} of {len(found)} matches of a crop lie outside of it, and are dropped",)
            found = found.select(inside)
        return Matches(
            points0=crop0.to_image(found.points0),
            points1=crop1.to_image(found.points1),
            scores=found.scores,
            sigmas0=found.sigmas0 / np.float32(crop0.scale),
            sigmas1=found.sigmas1 / np.float32(crop1.scale),
        )


def _require_as_agreed(matcher: PointMatcher, crops: Sequence[tuple[Crop, Crop]], matched: Any) -> None:
    """Refuse what a point matcher may not return. Raises: ShapeError."""

    def wrong(what: str) -> ShapeError:
        return ShapeError(f"the point matcher {type(matcher).__name__} gave {what}")

    if not isinstance(matched, Sequence) or not all(isinstance(found, Matches) for found in matched):
        given = {type(found).__name__ for found in matched} if isinstance(matched, Sequence) else {"no list"}
        raise wrong(f"{', '.join(sorted(given))}; expected a list of sgam_core.Matches, one for each pair of crops")
    if len(matched) != len(crops):
        raise wrong(f"{len(matched)} Matches for {len(crops)} pairs of crops; expected one for each")
    for found in matched:
        if not all(np.isfinite(array).all() for array in (found.points0, found.points1, found.scores)):
            raise wrong("points or scores that are not finite; it is to leave such matches out")
        if len(found) and not (found.scores.min() >= 0 and found.scores.max() <= 1):
            raise wrong(f"scores from {found.scores.min():.3g} to {found.scores.max():.3g}; expected [0, 1]")
        if not (np.minimum(found.sigmas0, found.sigmas1) > 0).all():
            raise wrong("sigmas that are not above 0")


def _scaled_crop(image: Image, box: Box, scale: float) -> Crop:
    return box_crop(image, box, max(round(scale * max(box.width, box.height)), 1), max_upsampling=0)


def _limit_candidates(groups: Sequence[Sequence[AreaMatch]], max_candidates: int) -> list[list[AreaMatch]]:
    """The groups with the candidates beyond the limit marked as skipped, the farthest in descriptor distance first."""
    distances = sorted(
        (c.distance, g, k)
        for g, group in enumerate(groups)
        for k, c in enumerate(group)
        if c.state is not AreaState.SKIPPED
    )
    dropped = {(g, k) for _, g, k in distances[max_candidates:]}
    reason = "GP: limit of candidate pairs (max_candidates)"
    return [
        [replace(c, state=AreaState.SKIPPED, reason=reason) if (g, k) in dropped else c for k, c in enumerate(group)]
        for g, group in enumerate(groups)
    ]
