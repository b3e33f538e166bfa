"""Metrics of a reconstruction: alignment to ground truth, errors of cameras, lengths of tracks.

Poses are cam_from_world (3, 4) by image name: plain arrays, so that any reconstruction can be judged. Angles are
degrees, distances the unit of the ground truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from sgam_core.errors import ShapeError
from sgam_sfm.evaluation.metrics import FAILED_POSE, PoseError, relative_pose_error
from sgam_sfm.evaluation.projection import relative_pose

Poses = Mapping[str, np.ndarray]
"""cam_from_world (3, 4) by image name."""

_MAX_HYPOTHESES = 2000


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Similarity:
    """x_true = scale * rotation @ x + translation, and the names of the images it was fitted to."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    inliers: tuple[str, ...] = ()

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        moved: np.ndarray = self.scale * points @ self.rotation.T + self.translation
        return moved


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraError:
    """How far an aligned camera is from the true one: centre in the unit of the ground truth, rotation in degrees."""

    centre: float
    rotation: float


def align(estimated: Poses, true: Poses, seed: int = 0) -> Similarity | None:
    """Robust similarity that takes a reconstruction's world to that of the ground truth.

    Every two images that both know make a hypothesis: rotation from their orientations, scale and translation from
    their centres. The one with the least median distance of centres wins (right while most images are), and is fitted
    again to the centres that it explains; their orientations stay decisive where the centres lie exactly on a line.
    Returns: None with fewer than two such images, or when all centres are one point.
    Source: Umeyama 1991 for the last fit; Rousseeuw 1984, least median of squares.
    """
    names = sorted({*estimated} & {*true})
    if len(names) < 2:
        return None
    source, target = (np.array([_centre(poses[name]) for name in names]) for poses in (estimated, true))
    turns = _turns(estimated, true, names)
    pairs = np.column_stack(np.triu_indices(len(names), 1))
    if len(pairs) > _MAX_HYPOTHESES:
        rng = np.random.default_rng(seed)
        pairs = pairs[rng.integers(len(pairs), size=_MAX_HYPOTHESES)]
    found = [fit for pair in pairs if (fit := _similarity(source[pair], target[pair], turns[pair])) is not None]
    if not found:
        return None
    distances = [np.linalg.norm(fit(source) - target, axis=1) for fit in found]
    best = min(range(len(found)), key=lambda i: (np.median(distances[i]), np.mean(distances[i])))
    # Rousseeuw's bound of what noise explains; the floor is rounding, where all fit exactly.
    floor = 1e-9 * np.ptp(target, axis=0).max()
    inlier = distances[best] <= max(2.5 * 1.4826 * np.median(distances[best]), floor)
    fitted = _umeyama(source[inlier], target[inlier]) or _similarity(source[inlier], target[inlier], turns[inlier])
    chosen = fitted or found[best]
    kept = tuple(name for name, use in zip(names, inlier, strict=True) if use)
    return Similarity(scale=chosen.scale, rotation=chosen.rotation, translation=chosen.translation, inliers=kept)


def camera_errors(estimated: Poses, true: Poses, similarity: Similarity) -> dict[str, CameraError]:
    """Error of every image that both know, by name, after alignment.

    Orientations are turned alike to agree with the true ones on the whole: centres that nearly lie on a line leave a
    turn about it open, which is no error of any camera.
    """
    turn = similarity.rotation
    if similarity.inliers:
        turn = _turns(estimated, true, similarity.inliers).mean().as_matrix()
    errors = {}
    for name in sorted({*estimated} & {*true}):
        centre = similarity(_centre(estimated[name])[None])[0]
        off = estimated[name][:, :3] @ turn.T @ true[name][:, :3].T
        errors[name] = CameraError(
            centre=float(np.linalg.norm(centre - _centre(true[name]))),
            rotation=float(np.rad2deg(Rotation.from_matrix(off).magnitude())),
        )
    return errors


def pairwise_pose_errors(estimated: Poses, true: Poses) -> dict[tuple[str, str], PoseError]:
    """Signed relative pose error of every two images of the ground truth; 180 where either is not registered.

    Feed the `max` of each to `pose_auc` at 0.5, 1, 3 and 5 degrees. Relative poses need no alignment.
    """
    errors = {}
    for pair in combinations(sorted(true), 2):
        known = all(name in estimated for name in pair)
        found = relative_pose(*(estimated[name] for name in pair)) if known else None
        truth = relative_pose(*(true[name] for name in pair))
        errors[pair] = relative_pose_error(found, truth, signed=True) if known else FAILED_POSE
    return errors


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackLengths:
    """Distinct images per 3D point: their mean, and how many points (values) are seen by how many images (keys)."""

    mean: float
    histogram: dict[int, int]


def track_lengths(point_ids: Int[np.ndarray, " O"], image_ids: Int[np.ndarray, " O"]) -> TrackLengths:
    """Distinct images per track, from one row an observation; an image that sees a point twice counts once.

    Returns: a mean of NaN and no histogram when there is no observation.
    Raises: ShapeError when the two differ in length.
    """
    if len(point_ids) != len(image_ids):
        raise ShapeError(f"{len(point_ids)} point ids and {len(image_ids)} image ids; expected one of each a row")
    if not len(point_ids):
        return TrackLengths(mean=float("nan"), histogram={})
    distinct = np.unique(np.stack([point_ids, image_ids], axis=1), axis=0)
    lengths = np.unique(distinct[:, 0], return_counts=True)[1]
    histogram = {int(length): int(count) for length, count in zip(*np.unique(lengths, return_counts=True), strict=True)}
    return TrackLengths(mean=float(lengths.mean()), histogram=histogram)


def _turns(estimated: Poses, true: Poses, names: Sequence[str]) -> Rotation:
    """What each image says of the rotation from the one world to the other."""
    return Rotation.from_matrix([true[name][:, :3].T @ estimated[name][:, :3] for name in names])


def _centre(pose: np.ndarray) -> np.ndarray:
    centre: np.ndarray = -pose[:, :3].T @ pose[:, 3]
    return centre


def _similarity(source: np.ndarray, target: np.ndarray, turns: Rotation) -> Similarity | None:
    """Rotation by the orientations alone, then scale and translation by the centres (N, 3)."""
    rotation = turns.mean().as_matrix()
    a, b = source - source.mean(0), target - target.mean(0)
    spread = (a**2).sum()
    scale = np.sqrt((b**2).sum() / spread) if spread > 0 else 0.0
    if not scale > 0:
        return None
    return Similarity(
        scale=float(scale), rotation=rotation, translation=target.mean(0) - scale * rotation @ source.mean(0)
    )


def _umeyama(source: np.ndarray, target: np.ndarray) -> Similarity | None:
    """Least squares; None where the centres (N, 3) do not settle the rotation."""
    a, b = source - source.mean(0), target - target.mean(0)
    U, s, Vt = np.linalg.svd(b.T @ a)
    if len(source) < 3 or s[1] < 1e-3 * s[0]:
        return None
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation, scale = U * flip @ Vt, float((s * flip).sum() / (a**2).sum())
    return Similarity(scale=scale, rotation=rotation, translation=target.mean(0) - scale * rotation @ source.mean(0))
