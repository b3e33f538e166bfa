"""Models in one frame, what a pair's two views differ by, and the errors of poses against the truth."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sgam_core.errors import InputError
from sgam_sfm.colmap.reading import read_poses_and_points
from sgam_sfm.comparison.harder import Window, cut_views
from sgam_sfm.comparison.report.bounds import Bounds, evenly_of
from sgam_sfm.comparison.report.runs import MethodRun, PairMatches, read_matches
from sgam_sfm.evaluation.ground_truth import GroundTruth, TrueView, read_ground_truth
from sgam_sfm.evaluation.metrics import estimate_relative_pose, relative_pose_error, sample_matches
from sgam_sfm.evaluation.projection import inverse, relative_pose
from sgam_sfm.evaluation.sfm_metrics import Similarity, align, pairwise_pose_errors
from sgam_sfm.pairs import Pair

_MIN_SHARED = 10  # points that two views must share for what they differ by to mean something
_FAR = 2.0  # times the distance within which 95 % of the points lie: nothing further is drawn


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Model:
    """A reconstruction. poses: world_from_cam (3, 4) by image name. points: some of its points."""

    poses: Mapping[str, np.ndarray]
    points: Float[np.ndarray, "N 3"]
    num_points: int


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewChange:
    """What two views of the same points differ by. angle: between the lines of sight, in degrees. scale: at least 1."""

    angle: float
    scale: float


class TrueViews(NamedTuple):
    """Cameras with a known pose.

    views: by image name. missing: why there is no view, empty when there are.
    """

    views: Mapping[str, TrueView]
    missing: str


def true_views(
    known: Mapping[str, Any] | None, names: Collection[str], windows: Mapping[str, Window] | None = None
) -> TrueViews:
    """The true cameras of images, from what compare.json knows of the truth.

    Args: windows: what is left of the images that the truth knows, where they were cut.
    """
    if known is None:
        return TrueViews({}, "no ground truth was given")
    try:
        truth: GroundTruth = read_ground_truth(Path(known["path"]), known["format"])
        found = truth.views_of(names)
    except InputError:
        return TrueViews({}, "the ground truth is no longer where it was")
    posed = {name: view for name, view in found.items() if view.cam_from_world is not None}
    views = cut_views(posed, windows or {})
    return TrueViews(views, "" if views else "the ground truth has no pose of these images")


def read_model(folder: Path, bounds: Bounds) -> Model:
    """A COLMAP model, with as many points as are drawn."""
    poses, points = read_poses_and_points(folder)
    drawn = points[evenly_of(range(len(points)), bounds.points)]
    return Model(
        poses={name: inverse(pose) for name, pose in poses.items()}, points=drawn.reshape(-1, 3), num_points=len(points)
    )


def aligned(model: Model, target: Mapping[str, np.ndarray]) -> Model | None:
    """The model in the frame of other poses (world_from_cam); None where too few images are in both."""
    estimated, true = ({name: inverse(pose) for name, pose in poses.items()} for poses in (model.poses, target))
    similarity = align(estimated, true)
    return None if similarity is None else moved(model, similarity)


def moved(model: Model, similarity: Similarity) -> Model:
    """The model after a similarity."""

    def pose(matrix: np.ndarray) -> np.ndarray:
        return np.column_stack([similarity.rotation @ matrix[:, :3], similarity(matrix[:, 3][None])[0]])

    poses = {name: pose(matrix) for name, matrix in model.poses.items()}
    return Model(poses=poses, points=similarity(model.points), num_points=model.num_points)


def upright(models: Sequence[Model]) -> Similarity:
    """The motion that turns what the cameras have above them up (+z), and what they look at to the back (+y)."""
    poses = [pose for model in models for pose in model.poses.values()]
    up, ahead = -np.mean([pose[:, 1] for pose in poses], axis=0), np.mean([pose[:, 2] for pose in poses], axis=0)
    up = _unit(up, np.array([0.0, 0, 1]))
    side = _unit(np.cross(ahead, up), np.cross(up, [0.6, 0.8, 0.1]))
    rotation = np.stack([_unit(side, side), np.cross(up, side / np.linalg.norm(side)), up])
    centre = np.median([pose[:, 3] for pose in poses], axis=0)
    return Similarity(scale=1.0, rotation=rotation, translation=-rotation @ centre)


def without_far_points(models: Sequence[Model]) -> list[Model]:
    """The models without points so far outside that nothing else could be seen beside them."""
    points = np.concatenate([model.points for model in models])
    if not len(points):
        return list(models)
    centre = np.median(points, axis=0)
    reach = _FAR * np.quantile(np.linalg.norm(points - centre, axis=1), 0.95)

    def near(model: Model) -> np.ndarray:
        return model.points[np.linalg.norm(model.points - centre, axis=1) <= reach]

    return [Model(poses=model.poses, points=near(model), num_points=model.num_points) for model in models]


def curve_errors(model: Model | None, views: Mapping[str, TrueView], bounds: Bounds) -> list[float]:
    """Sorted pose errors of a model, in degrees, of all pairs of true views; 180 where either has no pose in it."""
    chosen = evenly_of(sorted(views), bounds.curve_images)
    true = {name: pose for name in chosen if (pose := views[name].cam_from_world) is not None}
    poses = {} if model is None else {name: inverse(pose) for name, pose in model.poses.items() if name in true}
    return sorted(error.max for error in pairwise_pose_errors(poses, true).values())


def pair_errors(
    run: MethodRun,
    pairs: Collection[Pair],
    views: Mapping[str, TrueView],
    sizes: Mapping[str, tuple[int, int]],
    bounds: Bounds,
) -> dict[Pair, float]:
    """Error of the pose that a pair's raw matches give, in degrees; 180 where they give none."""
    found = {matches.pair: _pair_error(matches, views, sizes, bounds) for matches in read_matches(run.folder, pairs)}
    return {pair: found.get(pair, 180.0) for pair in pairs}


def _pair_error(
    matches: PairMatches,
    views: Mapping[str, TrueView],
    sizes: Mapping[str, tuple[int, int]],
    bounds: Bounds,
) -> float:
    sides = [views[name] for name in matches.pair]
    rng = np.random.default_rng(0)
    size0 = sizes[matches.pair[0]]
    rows = sample_matches(matches.points0, matches.points1, size0, bounds.pose_matches, rng)
    straight = [
        view.undistorted(points[rows] * [view.width / sizes[name][0], view.height / sizes[name][1]])
        for view, name, points in zip(sides, matches.pair, matches[1:], strict=True)
    ]
    pose = estimate_relative_pose(straight[0], straight[1], sides[0].camera_matrix, sides[1].camera_matrix)
    first, second = (view.cam_from_world for view in sides)
    assert first is not None  # `true_views` has only such
    assert second is not None
    return relative_pose_error(pose, relative_pose(first, second)).max


def view_changes(
    pairs: Collection[Pair], views: Mapping[str, TrueView], points: Float[np.ndarray, "N 3"]
) -> dict[Pair, ViewChange]:
    """What the true views of pairs differ by, over the points in both; pairs that share too few are left out."""
    depths = {
        name: _visible_depths(view, points) for name in {n for pair in pairs for n in pair} if (view := views[name])
    }
    found = {}
    for pair in pairs:
        shared = np.isfinite(depths[pair[0]]) & np.isfinite(depths[pair[1]])
        if np.count_nonzero(shared) >= _MIN_SHARED:
            found[pair] = _view_change(
                [views[name] for name in pair], [depths[n][shared] for n in pair], points[shared]
            )
    return found


def _view_change(sides: Sequence[TrueView], depths: Sequence[np.ndarray], points: np.ndarray) -> ViewChange:
    rays = [points - _centre(view) for view in sides]
    rays = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    angles = np.rad2deg(np.arccos(np.clip((rays[0] * rays[1]).sum(1), -1, 1)))
    scales = [view.camera_matrix[0, 0] / depth for view, depth in zip(sides, depths, strict=True)]
    ratio = float(np.median(scales[1] / scales[0]))
    return ViewChange(angle=float(np.median(angles)), scale=max(ratio, 1 / ratio))


def _visible_depths(view: TrueView, points: np.ndarray) -> np.ndarray:
    """Depth (N,) of each point in a view, NaN outside of it."""
    assert view.cam_from_world is not None
    in_camera = points @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
    depth = np.where(in_camera[:, 2] > 0, in_camera[:, 2], np.nan)
    x, y = (in_camera @ view.camera_matrix.T)[:, :2].T / depth
    inside = (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)  # False for NaN
    return np.where(inside, depth, np.nan)


def _centre(view: TrueView) -> np.ndarray:
    assert view.cam_from_world is not None
    return inverse(view.cam_from_world)[:, 3]


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """The direction of a vector; of another one where it has none."""
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else otherwise / max(float(np.linalg.norm(otherwise)), 1e-12)
