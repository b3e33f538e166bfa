"""GR: area matches that contradict the others are rejected (paper, Sec. III-C2 and Alg. 1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sgam_core.geometry import mean_residual, residuals
from sgam_core.options import GeometryOptions, RejectionOptions
from sgam_core.prediction import Estimate, MatchedArea
from sgam_core.types import AreaState, Matches, TwoViewModel
from sgam_core.wording import counted

_NO_GEOMETRY = "no geometry: the areas' matches give none"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Verdict:
    """Every area with its state, the geometry of the survivors, and why the areas cannot be used (empty: they can)."""

    areas: tuple[MatchedArea, ...]
    model: TwoViewModel | None
    fallback: str = ""


def reject(
    areas: Sequence[MatchedArea],
    match_whole: Callable[[], Matches],
    whole_is_known: bool,
    estimate: Estimate,
    geometry: GeometryOptions,
    options: RejectionOptions,
) -> Verdict:
    """Judge the kept areas; others pass through unchanged.

    Args: match_whole gives the whole-image matches; they join the pool when they exist already (whole_is_known), and
        are asked for when a single area has nothing to be compared with.
    """
    candidates = [area for area in areas if area.area.state is AreaState.KEPT]
    if not candidates:
        return Verdict(areas=tuple(areas), model=None, fallback=_why_none(areas))
    whole = Matches.empty()
    if options.rule == "consensus":
        single = len(candidates) == 1
        whole = match_whole() if whole_is_known or single else whole
        judged, model, fallback = _consensus(candidates, whole, single, estimate, geometry, options)
    else:
        judged = _RULES[options.rule](candidates, estimate, geometry, options)
        model, fallback = None, ""
    verdicts = {id(before): after for before, after in zip(candidates, judged, strict=True)}
    judged_all = [verdicts.get(id(area), area) for area in areas]
    kept = [area for area in judged_all if area.area.state is AreaState.KEPT]
    if not kept and not fallback:
        fallback = f"GR rejected all: {counted(len(candidates), 'area match')}"
    if not fallback:
        pool = _pool(kept, options.max_pooled)
        model = estimate(Matches.concatenate([pool, _best(whole, len(pool))])) or model
        fallback = "" if model is not None else _NO_GEOMETRY
    areas = tuple(_counted(area, model, geometry) for area in judged_all)
    return Verdict(areas=areas, model=model, fallback=fallback)


def _why_none(areas: Sequence[MatchedArea]) -> str:
    if not areas:
        return "no area match"
    if all(area.area.state is AreaState.SKIPPED for area in areas):
        return "every area match was skipped"
    return "no area match left after GP"


def _consensus(
    candidates: Sequence[MatchedArea],
    whole: Matches,
    single: bool,
    estimate: Estimate,
    geometry: GeometryOptions,
    options: RejectionOptions,
) -> tuple[list[MatchedArea], TwoViewModel | None, str]:
    """One robust geometry of all areas' matches judges each of them, and leaves the kept ones their inliers.

    # Differs from the paper: there, areas keep their outliers, and with phi < 1 its threshold lies below every value it
    # is compared with, since an area's own geometry already minimises its own distance.
    """
    pool = _pool(candidates, options.max_pooled)
    if single and len(whole) >= geometry.min_matches:
        model = estimate(whole)
    else:
        model = estimate(Matches.concatenate([pool, _best(whole, len(pool))]))
    if model is None:
        return list(candidates), None, _NO_GEOMETRY
    ratio = float((residuals(model.F, pool) <= geometry.max_residual).mean()) if len(pool) else 0.0
    if ratio < options.min_pool_inlier_ratio and not single:
        agree = f"{ratio:.2f} of their matches fit one geometry, below {options.min_pool_inlier_ratio:.2f}"
        return list(candidates), model, f"areas disagree: {agree}"
    return [_judge(candidate, model, geometry, options) for candidate in candidates], model, ""


def _judge(
    candidate: MatchedArea, model: TwoViewModel, geometry: GeometryOptions, options: RejectionOptions
) -> MatchedArea:
    inlier = residuals(model.F, candidate.matches) <= geometry.max_residual
    count, total = int(inlier.sum()), len(candidate.matches)
    if count < options.min_inliers:
        return candidate.resolved(AreaState.REJECTED, f"GR: {count} inliers of {total}, below {options.min_inliers}")
    if total - count > options.max_outlier_share * total:
        return candidate.resolved(AreaState.REJECTED, f"GR: {count} inliers of {total}, the rest contradict the pair")
    return replace(candidate, matches=candidate.matches.select(inlier))


def _paper(
    candidates: Sequence[MatchedArea], estimate: Estimate, geometry: GeometryOptions, options: RejectionOptions
) -> list[MatchedArea]:
    """Eq. 3 to 5 with means, leave-one-out: an area by the others' geometries, the others by its own."""
    models = [estimate(candidate.matches) for candidate in candidates]
    cross = np.array([[_distance(model, other, geometry) for other in candidates] for model in models])
    number = len(candidates)
    if number == 1:
        consistency = cross.diagonal()
    else:
        off = ~np.eye(number, dtype=bool)
        by_others, of_others = (np.where(off, table, 0).sum(1) / (number - 1) for table in (cross.T, cross))
        consistency = (by_others + of_others) / 2
    bound = float(np.median(consistency)) / max(options.phi, 1e-9)
    return _threshold(candidates, consistency, bound)


def _paper_literal(
    candidates: Sequence[MatchedArea], estimate: Estimate, geometry: GeometryOptions, options: RejectionOptions
) -> list[MatchedArea]:
    """Alg. 1 as printed, sums included. Degenerate: with phi < 1 no area can stay below the threshold."""
    models = [estimate(candidate.matches) for candidate in candidates]

    def total(model: TwoViewModel | None, other: MatchedArea) -> float:
        return float("inf") if model is None else float(residuals(model.F, other.matches).sum())

    cross = np.array([[total(model, other) for other in candidates] for model in models])
    return _threshold(candidates, cross.mean(axis=1), options.phi * float(cross.diagonal().mean()))


def _threshold(candidates: Sequence[MatchedArea], consistency: np.ndarray, bound: float) -> list[MatchedArea]:
    return [
        candidate
        if value <= bound and np.isfinite(value)
        else candidate.resolved(AreaState.REJECTED, f"GR: consistency {value:.3g} above {bound:.3g}")
        for candidate, value in zip(candidates, consistency.tolist(), strict=True)
    ]


def _distance(model: TwoViewModel | None, area: MatchedArea, geometry: GeometryOptions) -> float:
    return geometry.tau if model is None else mean_residual(model.F, area.matches, geometry.tau)


def _keep_all(
    candidates: Sequence[MatchedArea], estimate: Estimate, geometry: GeometryOptions, options: RejectionOptions
) -> list[MatchedArea]:
    return list(candidates)


_RULES = {"paper": _paper, "paper-literal": _paper_literal, "none": _keep_all}


def _pool(areas: Sequence[MatchedArea], max_per_area: int) -> Matches:
    """The best matches of every area, so that none outvotes the others."""
    return Matches.concatenate([_best(area.matches, max_per_area) for area in areas])


def _best(matches: Matches, count: int) -> Matches:
    return matches.select(np.sort(np.argsort(-matches.scores, kind="stable")[:count]))


def _counted(area: MatchedArea, model: TwoViewModel | None, geometry: GeometryOptions) -> MatchedArea:
    """The area with its number of inliers."""
    if model is None:
        return area
    inliers = int((residuals(model.F, area.matches) <= geometry.max_residual).sum())
    return replace(area, area=replace(area.area, num_inliers=inliers))
