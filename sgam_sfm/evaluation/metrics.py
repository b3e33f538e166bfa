"""Metrics of matches, areas, poses and reconstructions: pure functions of arrays.

Pixels are (x, y) with corner origin: the centre of the first pixel is (0.5, 0.5). A pose is cam_from_world (3, 4); the
pose of a pair is cam1_from_cam0 (3, 4); K is a pinhole matrix (3, 3) of the image's own pixels, and points are free of
lens distortion. Angles are degrees. `paper` is Zhang et al., SGAM.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from sgam_core.errors import ShapeError
from sgam_core.types import Box
from sgam_sfm.evaluation import projection

FAILED_DEG = 180.0
"""The error of a pose that could not be estimated."""

# --- matches ---------------------------------------------------------------------------------------------------------


def depth_at(
    depth: Float[np.ndarray, "h w"], points: Float[np.ndarray, "N 2"], size: tuple[int, int]
) -> Float[np.ndarray, " N"]:
    """Depth of what an image shows at pixels, from a depth map that may have another resolution.

    Args: depth (h, w), 0 or not finite where it is unknown; points (N, 2) pixels; size (width, height) of the image.
    Returns: (N,) in the unit of the map, NaN where unknown or outside. Inverse depth, which is linear on a plane, is
        interpolated where the four neighbours agree within 5 %, and the nearest taken at rims.
    """
    h, w = depth.shape
    at = points * [w / size[0], h / size[1]]
    inside = (at >= 0).all(1) & (at < [w, h]).all(1)
    at = np.where(inside[:, None], at, 0.5)
    inverse = 1 / np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    corner = np.floor(at - 0.5)
    fx, fy = (at - 0.5 - corner).T
    (x0, y0), (x1, y1) = corner.astype(int).T, corner.astype(int).T + 1
    x0, x1, y0, y1 = x0.clip(0), x1.clip(max=w - 1), y0.clip(0), y1.clip(max=h - 1)
    around = np.stack([inverse[y0, x0], inverse[y0, x1], inverse[y1, x0], inverse[y1, x1]])
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    smooth = around.max(0) <= 1.05 * around.min(0)  # False where any is unknown
    columns, rows = at.astype(int).T
    found: np.ndarray = np.where(
        inside, 1 / np.where(smooth, (weights * around).sum(0), inverse[rows, columns]), np.nan
    )
    return found


def match_errors(
    points0: Float[np.ndarray, "M 2"],
    points1: Float[np.ndarray, "M 2"],
    K0: Float[np.ndarray, "3 3"],
    K1: Float[np.ndarray, "3 3"],
    cam1_from_cam0: Float[np.ndarray, "3 4"],
    depth0: Float[np.ndarray, " M"] | None = None,
    scales: tuple[float, float] = (1.0, 1.0),
) -> tuple[Float[np.ndarray, " M"], Bool[np.ndarray, " M"]]:
    """Error of each match: reprojection through the depth where it is known, else symmetric epipolar distance.

    Args: depth0 (M,) depth at points0 in the unit of the pose, NaN where unknown. scales: what pixels of either image
        are multiplied by; 640 / width for errors at 640 wide, as the paper reports them.
    Returns: errors (M,) in pixels: |projection of point 0 - point 1| in image 1, or the mean of both distances of a
        point to its epipolar line; and which (M,) were judged by depth.
    Source: paper, Sec. IV-A (MMA); Hartley & Zisserman, section 11.1.
    """
    F = projection.fundamental(K0, K1, cam1_from_cam0)
    lines1, lines0 = projection.homogeneous(points0) @ F.T, projection.homogeneous(points1) @ F
    errors = (
        scales[0] * projection.line_distance(lines0, points0) + scales[1] * projection.line_distance(lines1, points1)
    ) / 2
    if depth0 is None:
        return errors, np.zeros(len(errors), bool)
    known = np.isfinite(depth0)
    projected = projection.project(projection.lift(points0[known], depth0[known], K0), K1, cam1_from_cam0)
    # A point that would lie behind camera 1 cannot be seen there: the match is wrong by any threshold.
    errors[known] = scales[1] * np.nan_to_num(np.linalg.norm(projected - points1[known], axis=1), nan=np.inf)
    return errors, known


def precision(errors: Float[np.ndarray, " M"], threshold: float) -> float:
    """Share of the matches of a pair whose error is at most `threshold` pixels; 0 when there is no match."""
    return float(np.mean(errors <= threshold)) if len(errors) else 0.0


def mean_matching_accuracy(errors: Sequence[Float[np.ndarray, " _"]], threshold: float) -> float:
    """MMA@threshold: mean over pairs of the precision; a pair without match counts 0.

    Args: errors: one array of match errors a pair, in pixels. Raises: ShapeError when there is no pair.
    Source: paper, Sec. IV-A; Dusmanu et al., D2-Net.
    """
    if not errors:
        raise ShapeError("MMA of no pair; expected the match errors of at least one")
    return float(np.mean([precision(of_pair, threshold) for of_pair in errors]))


def sample_matches(
    points0: Float[np.ndarray, "M 2"],
    points1: Float[np.ndarray, "M 2"],
    size0: tuple[int, int],
    limit: int,
    rng: np.random.Generator,
) -> Int[np.ndarray, " N"]:
    """At most `limit` matches, spread evenly over image 0, without duplicates: the paper's MCN sampling.

    Duplicates are matches whose both ends fall into the same pixels; the first stays. Of what is left, cells of image 0
    (as many as `limit`) give one match each, drawn at random, then a second one each, until the limit is reached.

    Args: size0 (width, height) of image 0 in pixels. Returns: rows (N,), ascending.
    Source: paper, appendix on the maximum correspondence number: "uniformly sample no more than MCN of points in the
        image space [...], duplicate correspondences are removed"; the cells are our reading of it.
    """
    pixels = np.floor(np.concatenate([points0, points1], axis=1)).astype(np.int64)
    rows = np.sort(np.unique(pixels, axis=0, return_index=True)[1])
    if len(rows) <= limit:
        return rows
    side = np.sqrt(size0[0] * size0[1] / limit)
    shuffled = rng.permutation(rows)
    cells = np.unique(np.floor(points0[shuffled] / side), axis=0, return_inverse=True)[1].ravel()
    by_cell = np.argsort(cells, kind="stable")
    first_of_cell = np.searchsorted(cells[by_cell], cells[by_cell])
    turn = np.empty(len(cells), np.int64)
    turn[by_cell] = np.arange(len(cells)) - first_of_cell
    return np.sort(shuffled[np.argsort(turn, kind="stable")[:limit]])


# --- areas -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class AreaOverlap:
    """Share of the points of area 0 that project inside area 1, and the other way; NaN where there is no point.

    num_points0, num_points1: points either share was taken over. approximate: they were triangulated from matches.
    """

    forward: float
    backward: float
    num_points0: int
    num_points1: int
    approximate: bool

    @property
    def mean(self) -> float:
        """The mean of both ways."""
        return (self.forward + self.backward) / 2


def area_overlap(
    boxes: tuple[Box, Box],
    depths: tuple[Float[np.ndarray, "h0 w0"], Float[np.ndarray, "h1 w1"]],
    sizes: tuple[tuple[int, int], tuple[int, int]],
    cameras: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]],
    cam1_from_cam0: Float[np.ndarray, "3 4"],
) -> AreaOverlap:
    """Area overlap ratio (AOR) from depth: over the pixels of an area with valid depth; occlusion is not considered.

    Args: depths (h, w), 0 or not finite where unknown, in the unit of the pose, of any resolution: their pixels are the
        points. sizes: (width, height) of either image, whose pixels the boxes and the cameras are in.
    Source: paper, Sec. IV-C (AOR); it reports the forward way.
    """
    points0, points1 = (_points_in_box(*side) for side in zip(boxes, depths, sizes, cameras, strict=True))
    forward = boxes[1].contains(projection.project(points0, cameras[1], cam1_from_cam0))
    backward = boxes[0].contains(projection.project(points1, cameras[0], projection.inverse(cam1_from_cam0)))
    return AreaOverlap(
        forward=_share(forward),
        backward=_share(backward),
        num_points0=len(forward),
        num_points1=len(backward),
        approximate=False,
    )


def area_overlap_of_matches(
    boxes: tuple[Box, Box],
    points: tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2"]],
    cameras: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]],
    cam1_from_cam0: Float[np.ndarray, "3 4"],
    max_error: float = 3.0,
) -> AreaOverlap:
    """AOR without depth, approximate: over matches triangulated under the given poses.

    Take matches that do not come from the areas that are judged (of the whole images, say): those lie inside both areas
    by construction.

    Args: points: pixels (M, 2) of the matches in either image. max_error: pixels of reprojection above which, or behind
        either camera, a triangulated point is left out.
    """
    points_in_cam0 = projection.triangulate(points, cameras, cam1_from_cam0)
    identity = np.eye(3, 4)
    projected = [
        projection.project(points_in_cam0, K, pose) for K, pose in zip(cameras, (identity, cam1_from_cam0), strict=True)
    ]
    errors = [np.linalg.norm(p - q, axis=1) for p, q in zip(projected, points, strict=True)]
    good = (errors[0] <= max_error) & (errors[1] <= max_error)  # False for NaN: behind a camera
    in0, in1 = (box.contains(p[good]) for box, p in zip(boxes, projected, strict=True))
    return AreaOverlap(
        forward=_share(in1[in0]),
        backward=_share(in0[in1]),
        num_points0=int(in0.sum()),
        num_points1=int(in1.sum()),
        approximate=True,
    )


def area_matching_precision(overlaps: Sequence[float], threshold: float = 0.7) -> float:
    """AMP@threshold: share of area matches whose AOR is above the threshold; NaN ones are left out, NaN when none is.

    Source: paper, Sec. IV-C (AMP).
    """
    return _share(np.array([overlap > threshold for overlap in overlaps if not np.isnan(overlap)], bool))


# --- poses -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseError:
    """Angles in degrees between an estimated and the true pose of a pair."""

    rotation: float
    translation: float

    @property
    def max(self) -> float:
        """The larger of both: what the AUC is taken over."""
        return max(self.rotation, self.translation)


FAILED_POSE = PoseError(rotation=FAILED_DEG, translation=FAILED_DEG)


def relative_pose_error(
    estimated: Float[np.ndarray, "3 4"] | None, true: Float[np.ndarray, "3 4"], *, signed: bool = False
) -> PoseError:
    """Rotation angle, and angle between the directions of translation, of cam1_from_cam0.

    Args: estimated: None when there is no estimate, an error of 180. signed: the direction of translation is known up
        to its sign, as after SfM; else t and -t are equal, as for two views.
    Returns: a translation error of 0 where the true baseline is zero, since its direction means nothing then.
    Source: paper, Sec. IV-B; Sun et al., LoFTR.
    """
    if estimated is None:
        return FAILED_POSE
    rotation = np.rad2deg(Rotation.from_matrix(estimated[:, :3] @ true[:, :3].T).magnitude())
    t, t_true = estimated[:, 3], true[:, 3]
    # By both cross and dot product, since the arc cosine is blind to small angles.
    angle = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(t, t_true)), t @ t_true))
    if np.linalg.norm(t_true) < 1e-9:
        angle = 0.0
    elif np.linalg.norm(t) == 0:
        angle = FAILED_DEG
    elif not signed:
        angle = min(angle, 180 - angle)
    return PoseError(rotation=float(rotation), translation=float(angle))


def estimate_relative_pose(
    points0: Float[np.ndarray, "M 2"],
    points1: Float[np.ndarray, "M 2"],
    K0: Float[np.ndarray, "3 3"],
    K1: Float[np.ndarray, "3 3"],
    threshold: float = 0.5,
    seed: int = 0,
) -> Float[np.ndarray, "3 4"] | None:
    """cam1_from_cam0 with a unit translation, from matches: a robust essential matrix, then the cheirality test.

    Args: threshold in pixels, divided by the mean focal length since the points are normalised. seed: of the samples.
    Returns: None when there are fewer than five matches or no model is found.
    Source: paper, Sec. IV-B; LoFTR's protocol, with MAGSAC++ of OpenCV's USAC.
    """
    if len(points0) < 5:
        return None
    usac = cv2.UsacParams()
    usac.threshold = threshold / float(np.mean([K0[0, 0], K0[1, 1], K1[0, 0], K1[1, 1]]))
    usac.confidence, usac.maxIterations, usac.randomGeneratorState = 0.99999, 10_000, seed
    usac.score, usac.loMethod = cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA
    rays0, rays1 = projection.normalised(points0, K0), projection.normalised(points1, K1)
    identity = np.eye(3)
    try:
        E, inlier = cv2.findEssentialMat(rays0, rays1, identity, identity, None, None, usac)
        if E is None or not np.isfinite(E).all():
            return None
        # Points count however far away they are: by default OpenCV leaves out those beyond 50 baselines.
        count, R, t, *_ = cv2.recoverPose(E[:3], rays0, rays1, identity, distanceThresh=1e9, mask=inlier.copy())
    except cv2.error:  # where local optimisation leaves no model, OpenCV raises
        return None
    return np.column_stack([R, t]) if count > 0 else None


def pose_auc(errors: Sequence[float] | np.ndarray, thresholds: Sequence[float]) -> tuple[float, ...]:
    """Area under the recall curve of pose errors up to each threshold, over the threshold: 1 is perfect.

    The curve is piecewise linear through (0, 0) and (error of the k-th best, k / N), and level from the last error
    below the threshold; the trapezoids are exact, without bins.
    Args: errors in degrees. Raises: ShapeError when there is none.
    Source: Sarlin et al., SuperGlue; paper, Sec. IV-B.
    """
    ordered = np.sort(np.asarray(errors, np.float64))
    if not len(ordered) or np.isnan(ordered).any():
        raise ShapeError(f"AUC of {len(ordered)} pose errors; expected at least one, and no NaN (180 for a failure)")
    x, y = np.r_[0.0, ordered], np.arange(len(ordered) + 1) / len(ordered)
    areas = []
    for threshold in thresholds:
        below = int(np.searchsorted(x, threshold))
        xs, ys = np.r_[x[:below], threshold], np.r_[y[:below], y[below - 1]]
        areas.append(float(np.diff(xs) @ (ys[1:] + ys[:-1]) / 2 / threshold))
    return tuple(areas)


def _points_in_box(box: Box, depth: np.ndarray, size: tuple[int, int], K: np.ndarray) -> np.ndarray:
    """Points (N, 3) in the camera's frame: of the pixels of a depth map whose centres lie in the box."""
    h, w = depth.shape
    x, y = (np.arange(w) + 0.5) * size[0] / w, (np.arange(h) + 0.5) * size[1] / h
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    flat = depth.ravel()
    use = box.contains(pixels) & np.isfinite(flat) & (flat > 0)
    return projection.lift(pixels[use], flat[use], K)


def _share(hits: np.ndarray) -> float:
    return float(hits.mean()) if len(hits) else float("nan")
