"""A2PM: any area matcher and any point matcher become one matcher (paper, Sec. III-A and III-D)."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8

from sgam_core.collection import collect, coverage, merge
from sgam_core.covisible import Frame
from sgam_core.crops import area_crop
from sgam_core.geometry import estimate_two_view, residuals
from sgam_core.guidance import guided_areas, warp_between
from sgam_core.looks import agree, best_look
from sgam_core.options import CropOptions, SGAMOptions
from sgam_core.point_matching import PairPoints
from sgam_core.prediction import Estimate, MatchedArea, predict
from sgam_core.protocols import AreaMatcher, PointMatcher
from sgam_core.rejection import reject
from sgam_core.semantic import SemanticAreaMatcher
from sgam_core.support import supported
from sgam_core.types import AreaMatch, AreaState, Image, Matches, PairResult, PutativeAreas, TwoViewModel
from sgam_core.uniqueness import without_contradictions


def match_pair(
    image0: UInt8[np.ndarray, "H W 3"],
    image1: UInt8[np.ndarray, "I V 3"],
    labels0: Int32[np.ndarray, "h w"],
    labels1: Int32[np.ndarray, "i v"],
    point_matcher: PointMatcher,
    options: SGAMOptions | None = None,
    *,
    camera0: Float[np.ndarray, "3 3"] | None = None,
    camera1: Float[np.ndarray, "3 3"] | None = None,
    mask0: Bool[np.ndarray, "H W"] | None = None,
    mask1: Bool[np.ndarray, "I V"] | None = None,
) -> PairResult:
    """Match two images by their semantic areas.

    Args: image0, image1 (H, W, 3) uint8 RGB; labels0, labels1 integer label maps in one label space, 0 = void, of any
        size with the image's aspect; point_matcher, see `PointMatcher`; camera0, camera1 (3, 3) pinhole matrices,
        corner origin, when known; mask0, mask1 (H, W), True where matches are wanted.
    Returns: matches in full-image pixels (corner origin), areas with their state, the two-view geometry.
    Raises: ShapeError for arrays of another shape or type.
    """
    options = options or SGAMOptions()
    area_matcher = SemanticAreaMatcher(options=options.semantic)
    first = Image(name="0", pixels=image0, mask=mask0, camera_matrix=camera0)
    second = Image(name="1", pixels=image1, mask=mask1, camera_matrix=camera1)
    described = (
        area_matcher.describe(first, np.asarray(labels0, np.int32)),
        area_matcher.describe(second, np.asarray(labels1, np.int32)),
    )
    return match_described(_by_content(first), _by_content(second), *described, area_matcher, point_matcher, options)


def _by_content(image: Image) -> Image:
    """An image whose name is that of no other, since point matchers keep features by name from pair to pair."""
    digest = hashlib.blake2b(repr(image.pixels.shape).encode(), digest_size=16)
    for array in (image.pixels, image.mask):
        if array is not None:
            digest.update(np.ascontiguousarray(array).data)
    return replace(image, name=digest.hexdigest())


def match_described(
    image0: Image,
    image1: Image,
    description0: Any,
    description1: Any,
    area_matcher: AreaMatcher,
    point_matcher: PointMatcher,
    options: SGAMOptions,
) -> PairResult:
    """The whole algorithm for two images whose areas have been described: SAM, PM, GP, GR, GMC, and guided areas.

    Where the area matcher has an attribute `guides` that is true, photos taken sideways or aslant are turned first,
    those taken from near are made smaller, and guided areas follow. Crops are those of `area_crop`, unless it has a
    method `crop(image, box, options)` of its own.
    """
    sizes = ((image.width, image.height) for image in (image0, image1))
    options = replace(options, crop=options.crop.of_shapes(*sizes))
    points = PairPoints(image0, image1, point_matcher, options.crop, getattr(area_matcher, "crop", area_crop))
    estimate = partial(
        estimate_two_view, camera0=image0.camera_matrix, camera1=image1.camera_matrix, options=options.geometry
    )
    clock = _Clock(points)

    plain = points.look
    guides = getattr(area_matcher, "guides", False)
    if guides:
        model = partial(points.model, estimate=estimate)
        points.look = best_look(plain, points.vote, model, options.looks, options.guidance)
    guides = guides and options.guidance.enabled
    found = _plain(points, estimate, options) if guides else None
    clock.lap("whole images")
    if found is None:
        crop = options.crop
        putative = area_matcher.match(description0, description1, points.whole)
        if guides:  # here areas are to find evidence: a finer look follows
            putative = supported(putative, points.whole(), Frame.of(image0), Frame.of(image1), options.guidance)
            crop = _evidence_crops(options)
        clock.lap("area matching")
        found = _by_areas(putative, crop, points, estimate, options, clock)
    if guides and not found.final:
        found = _guided(found, points, estimate, options) or found
    clock.lap("guided areas")
    coverage0, coverage1 = _coverages(found.areas, points)
    crop0, crop1 = points.whole_crops(plain)
    return PairResult(
        matches=found.matches,
        areas=tuple(area.area for area in found.areas),
        two_view=found.model,
        coverage0=coverage0,
        coverage1=coverage1,
        whole_scale0=crop0.scale,
        whole_scale1=crop1.scale,
        fallback=found.fallback,
        notes=found.notes + points.notes,
        turned=points.look.degrees,
        zoom=points.look.size_ratio / plain.size_ratio,
        pixels_matched=points.pixels,
        seconds=clock.seconds,
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Found:
    """What a round of matching found.

    areas: with their states; matches name them by their row. final: no finer round is worth its while.
    """

    matches: Matches
    model: TwoViewModel | None
    areas: tuple[MatchedArea, ...] = ()
    fallback: str = ""
    notes: tuple[str, ...] = ()
    final: bool = False


def _plain(points: PairPoints, estimate: Estimate, options: SGAMOptions) -> _Found | None:
    """The whole images, where they agree so well or so little that areas have nothing to add; None elsewhere.

    Too few matches for a geometry tell nothing: areas are then the only way to more.
    """
    model = points.agreement(estimate)
    found = partial(_Found, matches=points.whole(), model=model)
    if agree(model, options.guidance.sure_matches, options.guidance):
        return found(fallback="whole images agree, and crops would be no finer")
    if model is not None and model.inlier_ratio < options.guidance.min_inlier_ratio:
        return found(fallback="whole images do not agree", final=True)
    return None


def _evidence_crops(options: SGAMOptions) -> CropOptions:
    """Crops of the areas that are matched before the guided ones."""
    crop, guidance = options.crop, options.guidance
    budget = min(crop.max_crop_pixels or guidance.evidence_pixels, guidance.evidence_pixels)
    return replace(crop, area_size=min(crop.area_size, guidance.evidence_size), max_crop_pixels=budget)


def _by_areas(
    putative: PutativeAreas,
    crop: CropOptions,
    points: PairPoints,
    estimate: Estimate,
    options: SGAMOptions,
    clock: _Clock,
) -> _Found:
    """The paper's algorithm after SAM: PM, GP, GR, GMC."""
    confident, doubtful = points.inside(putative, crop, options.prediction.max_candidates)
    if options.collection.min_coverage >= 1:
        points.whole()  # GMC asks for them in any case, and GR judges better with them
    clock.lap("crops")
    areas = [*confident, *predict(confident, doubtful, estimate, options.geometry, options.prediction)]
    clock.lap("GP")
    verdict = reject(areas, points.whole, points.whole_is_known, estimate, options.geometry, options.rejection)
    clock.lap("GR")
    final = tuple(_final(area, verdict.fallback) for area in verdict.areas)
    if verdict.fallback:
        whole = points.whole()
        model = points.agreement(estimate)
        found = _Found(matches=whole, model=model, areas=final, fallback=verdict.fallback, notes=putative.notes)
    else:
        matches = _collected(final, verdict.model, points.whole, points, options)
        found = _Found(matches=matches, model=verdict.model, areas=final, notes=putative.notes)
    clock.lap("GMC")
    return found


def _guided(first: _Found, points: PairPoints, estimate: Estimate, options: SGAMOptions) -> _Found | None:
    """A second, finer round where the first one agrees; None where there is nothing to gain, or it fails."""
    if first.model is None:
        return None
    agreeing = first.matches.select(residuals(first.model.F, first.matches) <= options.geometry.max_residual)
    frame0, frame1 = map(Frame.of, points.images)
    left = options.crop
    if left.max_crop_pixels:
        left = replace(left, max_crop_pixels=max(left.max_crop_pixels - points.pixels_of_areas, 1))
    proposed = guided_areas(agreeing, frame0, frame1, left, options.guidance)
    if not proposed:
        return None
    warps = [warp_between(agreeing, area, options.guidance) for area in proposed]
    looked = without_contradictions(points.guided(proposed, warps))
    verdict = reject(looked, points.whole, True, estimate, options.geometry, options.rejection)
    if verdict.fallback:
        return None
    known = agreeing
    if any(area.area.state is AreaState.REJECTED for area in looked):  # it agreed on both of two places
        known = _inside(agreeing, [area.area for area in verdict.areas if area.area.state is AreaState.KEPT])
    if verdict.model is None or not len(known):
        return None
    if (residuals(verdict.model.F, known) <= options.geometry.max_residual).mean() < options.guidance.min_agreement:
        return None
    areas = (*first.areas, *verdict.areas)
    matches = _collected(areas, verdict.model, lambda: first.matches, points, options, begin=len(first.areas))
    return _Found(matches=matches, model=verdict.model, areas=areas, notes=first.notes)


def _inside(matches: Matches, areas: Sequence[AreaMatch]) -> Matches:
    """The matches that lie in any of the area matches."""
    inside = np.zeros(len(matches), bool)
    for area in areas:
        inside |= area.joins(matches)
    return matches.select(inside)


def _collected(
    areas: Sequence[MatchedArea],
    model: TwoViewModel | None,
    coarser: Callable[[], Matches],
    points: PairPoints,
    options: SGAMOptions,
    begin: int = 0,
) -> Matches:
    """The matches of the kept areas from row `begin` on, and the coarser ones where these leave ground (GMC)."""
    kept = [(row, area) for row, area in enumerate(areas) if row >= begin and area.area.state is AreaState.KEPT]
    inside = [replace(area.matches, area_index=np.full(len(area.matches), row, np.int32)) for row, area in kept]
    covered = min(_coverages(areas[begin:], points))
    collected = collect(inside, covered, model, coarser, options.collection)
    return merge(inside, collected, options.collection)


def _coverages(areas: Sequence[MatchedArea], points: PairPoints) -> tuple[float, float]:
    """Share of each image inside the areas that are kept."""
    kept = [area.area for area in areas if area.area.state is AreaState.KEPT]
    image0, image1 = points.images
    return (
        coverage([area.area0.box for area in kept], image0.width, image0.height),
        coverage([area.area1.box for area in kept], image1.width, image1.height),
    )


def match_whole(image0: Image, image1: Image, point_matcher: PointMatcher, options: CropOptions) -> Matches:
    """Plain matches of two whole images, in image pixels."""
    return PairPoints(image0, image1, point_matcher, options, area_crop).whole()


class WholeImages:
    """The area matcher `none`: proposes no area, so that the point matcher sees whole images. The baseline."""

    needs_labels = False

    def describe(self, image: Image, labels: Int32[np.ndarray, "H W"] | None) -> None:
        """Nothing to describe."""

    def match(self, description0: None, description1: None, match_whole: Callable[[], Matches]) -> PutativeAreas:
        """No areas."""
        return PutativeAreas()


def _final(area: MatchedArea, fallback: str) -> MatchedArea:
    """The area, rejected when it was fine itself but its pair fell back."""
    if fallback and area.area.state is AreaState.KEPT:
        return area.resolved(AreaState.REJECTED, f"pair fell back: {fallback}")
    return area


class _Clock:
    """Seconds by stage; the point matcher's are told apart, whichever stage called it."""

    def __init__(self, points: PairPoints) -> None:
        self._points = points
        self._last = self._now()
        self.seconds: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """What passed since the last lap belongs to the stage."""
        now = self._now()
        self.seconds[stage] = now - self._last
        self.seconds["point matching"] = self._points.seconds
        self._last = now

    def _now(self) -> float:
        """Time not spent in the point matcher."""
        return time.perf_counter() - self._points.seconds
