"""Judge the result of one pair against the truth: its matches, its pose, its areas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sgam_core import AreaMatch, Matches, PairResult
from sgam_core.types import AreaState, Box
from sgam_sfm.evaluation.ground_truth import FORMATS, GroundTruth, TrueView
from sgam_sfm.evaluation.metrics import (
    AreaOverlap,
    area_overlap,
    area_overlap_of_matches,
    depth_at,
    estimate_relative_pose,
    match_errors,
    precision,
    relative_pose_error,
    sample_matches,
)
from sgam_sfm.evaluation.projection import triangulate

PIXELS = (1, 2, 3, 5)
"""Thresholds of precision and MMA; the paper has 1, 2, 3."""
PAPER_WIDTH = 640
MAX_MATCHES = 500  # of a sample that a pose is estimated from, as in the paper
POSE_SAMPLES = 5
"""Of a pair: the paper draws one, and the AUC of some dozen pairs then moves by ten points with the seed."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TruePair:
    """What is true of a pair, whatever is matched. Everything is in the order of the pair.

    angle_deg: of the relative rotation. overlap: share of what the images show that the other shows too, mean of both
    ways. scale_change: size of a thing in one image over its size in the other, at least 1. approximate: overlap and
    scale change are of the matches of the whole images, not of depth. place: indoor, outdoor, empty where the format of
    the truth does not tell. num_labels: that both images show, each on at least 1 % of its pixels. None where nothing
    tells.
    """

    angle_deg: float
    overlap: float | None
    scale_change: float | None
    approximate: bool
    place: str = ""
    num_labels: int | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedArea:
    """An area match and its overlap. stage: `putative`, `predicted` (by GP), both before GR. kept: GR left it."""

    kind: str
    stage: str
    kept: bool
    overlap: AreaOverlap


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedPair:
    """How a pair came out.

    precision, precision_640: share of the matches within `PIXELS`, at the image's own pixels and at 640 wide.
    by_depth: share of the matches that depth judged. pose_errors_deg: of the pose from each sample of the matches, 180
    when there is none. fallback: as in `PairResult`. pixels_matched: of every point-matcher call. seconds: by stage.
    error: why the pair could not be matched; it counts as one without matches and pose.
    """

    num_matches: int
    precision: tuple[float, ...]
    precision_640: tuple[float, ...]
    by_depth: float
    pose_errors_deg: tuple[float, ...]
    areas: tuple[JudgedArea, ...]
    fallback: str
    pixels_matched: int
    seconds: Mapping[str, float] = field(default_factory=dict)
    error: str = ""

    @staticmethod
    def failed(error: str) -> JudgedPair:
        """A pair that could not be matched."""
        none = (0.0,) * len(PIXELS)
        return JudgedPair(
            num_matches=0,
            precision=none,
            precision_640=none,
            by_depth=0.0,
            pose_errors_deg=(180.0,) * POSE_SAMPLES,
            areas=(),
            fallback="",
            pixels_matched=0,
            error=error,
        )


def true_pair(truth: GroundTruth, views: tuple[TrueView, TrueView], whole: Matches) -> TruePair:
    """What is true of a pair. Args: whole: its whole-image matches, which stand in where there is no depth."""
    pose = truth.relative_pose(views[0].name, views[1].name)
    assert pose is not None  # pairs without one are not judged
    angle = float(np.rad2deg(np.arccos(np.clip((np.trace(pose[:, :3]) - 1) / 2, -1, 1))))
    depths = (truth.depth(views[0].name), truth.depth(views[1].name))
    frames = (_frame(views[0]), _frame(views[1]))
    found = _overlap(frames, views, depths, pose, whole)
    points = (views[0].undistorted(whole.points0), views[1].undistorted(whole.points1))
    cameras = (views[0].camera_matrix, views[1].camera_matrix)
    near = match_errors(*points, *cameras, pose)[0] <= max(PIXELS) if len(whole) else np.zeros(0, bool)
    scale = None
    if near.sum() >= 20:  # fewer tell nothing
        in0 = triangulate((points[0][near], points[1][near]), cameras, pose)
        z0, z1 = in0[:, 2], (in0 @ pose[:, :3].T + pose[:, 3])[:, 2]
        front = (z0 > 0) & (z1 > 0)
        if front.any():
            ratio = float(np.median((cameras[0][0, 0] / z0[front]) / (cameras[1][0, 0] / z1[front])))
            scale = max(ratio, 1 / ratio)
    return TruePair(
        angle_deg=angle,
        overlap=None if np.isnan(found.mean) else found.mean,
        scale_change=scale,
        approximate=found.approximate,
        place=FORMATS[truth.format].place,
    )


def judge_pair(
    truth: GroundTruth,
    views: tuple[TrueView, TrueView],
    result: PairResult,
    whole: Matches,
    rng: np.random.Generator,
) -> JudgedPair:
    """Judge a result.

    Args: whole: whole-image matches of the pair, whose triangulation judges areas where there is no depth. rng: of the
        samples that poses are estimated from.
    """
    pose = truth.relative_pose(views[0].name, views[1].name)
    assert pose is not None
    matches = result.matches
    points0, points1 = views[0].undistorted(matches.points0), views[1].undistorted(matches.points1)
    depths = (truth.depth(views[0].name), truth.depth(views[1].name))
    at_points = None
    if depths[0] is not None and len(points0):
        at_points = depth_at(depths[0], points0, (views[0].width, views[0].height))
    cameras = (views[0].camera_matrix, views[1].camera_matrix)
    own, by_depth = match_errors(points0, points1, *cameras, pose, at_points)
    scales = (PAPER_WIDTH / views[0].width, PAPER_WIDTH / views[1].width)
    small, _ = match_errors(points0, points1, *cameras, pose, at_points, scales)
    errors = []
    for _ in range(POSE_SAMPLES):
        rows = sample_matches(points0, points1, (views[0].width, views[0].height), MAX_MATCHES, rng)
        estimated = estimate_relative_pose(points0[rows], points1[rows], *cameras, seed=int(rng.integers(2**31)))
        errors.append(relative_pose_error(estimated, pose).max)
    return JudgedPair(
        num_matches=len(matches),
        precision=tuple(precision(own, pixels) for pixels in PIXELS),
        precision_640=tuple(precision(small, pixels) for pixels in PIXELS),
        by_depth=float(by_depth.mean()) if len(by_depth) else 0.0,
        pose_errors_deg=tuple(errors),
        areas=tuple(
            _judged_area(area, views, depths, pose, whole)
            for area in result.areas
            if area.state in (AreaState.KEPT, AreaState.REJECTED)
        ),
        fallback=result.fallback,
        pixels_matched=result.pixels_matched,
        seconds=dict(result.seconds),
    )


def _judged_area(
    area: AreaMatch,
    views: tuple[TrueView, TrueView],
    depths: tuple[np.ndarray | None, np.ndarray | None],
    pose: np.ndarray,
    whole: Matches,
) -> JudgedArea:
    return JudgedArea(
        kind=area.area0.kind,
        stage="predicted" if area.predicted else "putative",
        kept=area.state is AreaState.KEPT,
        overlap=_overlap((area.area0.box, area.area1.box), views, depths, pose, whole),
    )


def _overlap(
    boxes: tuple[Box, Box],
    views: tuple[TrueView, TrueView],
    depths: tuple[np.ndarray | None, np.ndarray | None],
    pose: np.ndarray,
    whole: Matches,
) -> AreaOverlap:
    cameras = (views[0].camera_matrix, views[1].camera_matrix)
    if depths[0] is not None and depths[1] is not None:
        sizes = ((views[0].width, views[0].height), (views[1].width, views[1].height))
        return area_overlap(boxes, (depths[0], depths[1]), sizes, cameras, pose)
    points = (views[0].undistorted(whole.points0), views[1].undistorted(whole.points1))
    return area_overlap_of_matches(boxes, points, cameras, pose)


def _frame(view: TrueView) -> Box:
    return Box(x0=0, y0=0, x1=view.width, y1=view.height)


def areas_of(
    pairs: Sequence[JudgedPair], *, kind: str = "", stage: str = "", kept: bool | None = None
) -> list[AreaOverlap]:
    """The overlaps of all areas of a kind, a stage, and an outcome; of all areas by default."""
    return [
        area.overlap
        for pair in pairs
        for area in pair.areas
        if (not kind or area.kind == kind) and (not stage or area.stage == stage) and kept in (None, area.kept)
    ]
