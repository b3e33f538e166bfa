"""How much two cameras see of the same space, from their poses alone.

A share of what an image sees is measured on points of its view: a grid of pixels, each at a third, once and three times
a depth that is typical of the scene. The score of a pair is the share of these points that the other image sees too,
the mean of both ways. What stands between is not known, so the score is an upper limit where walls hide things.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Int

from sgam_sfm.evaluation.ground_truth.reading import scaled
from sgam_sfm.evaluation.ground_truth.types import TrueView
from sgam_sfm.evaluation.projection import inverse, lift
from sgam_sfm.pair_lists.ranking import ScoreRows

_GRID = (4, 3)  # pixels across and down: a step of the score is 1.4 %
_DEPTHS = (1 / 3, 1, 3)
_MAX_AXES = 300  # cameras whose axes are compared


def typical_depth(views: Sequence[TrueView]) -> float:
    """How far from the cameras the scene is about, in the unit of the poses.

    The median depth at which the optical axes of pairs pass each other, of pairs that differ by 10 to 60 degrees; where
    few of them meet in front of the cameras (rows of parallel ones, panoramas), the median distance of the cameras from
    their middle; 1 where they all stand in one place, since depth does not matter there.
    """
    views = [views[row] for row in np.linspace(0, len(views) - 1, min(len(views), _MAX_AXES)).round().astype(int)]
    centres = np.array([inverse(_pose(view))[:, 3] for view in views])
    axes = np.array([_pose(view)[2, :3] for view in views])
    cosine = axes @ axes.T
    first, second = np.nonzero((cosine > np.cos(np.radians(60))) & (cosine < np.cos(np.radians(10))))
    baseline, cosine = centres[second] - centres[first], cosine[first, second]
    # Where the axis of the first comes nearest to the axis of the second.
    depths = np.einsum("pk,pk->p", baseline, axes[first] - cosine[:, None] * axes[second]) / (1 - cosine**2)
    if (depths > 0).sum() > len(depths) / 2:
        return float(np.median(depths[depths > 0]))
    distance = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    return distance if distance > 0 else 1.0


def shared_view_scores(views: Sequence[TrueView], depth: float, max_rotation_deg: float) -> ScoreRows:
    """The score of pairs, in 0..1; -inf where the viewing directions differ by more than `max_rotation_deg`.

    Args: views: with a pose, N of them. depth: typical of the scene, in the unit of the poses.
    """
    directions = np.array([_pose(view)[2, :3] for view in views])
    cameras = np.array([_unit_camera(view) for view in views], np.float32)
    points = np.array([_seen_points(view, depth) for view in views], np.float32)
    least_cosine = np.cos(np.radians(max_rotation_deg)) - 1e-9

    def scores_of(rows: Int[np.ndarray, " B"]) -> Float32[np.ndarray, "B N"]:
        scores = np.full((len(rows), len(views)), -np.inf, np.float32)
        for place, row in enumerate(rows):
            near = np.flatnonzero(directions @ directions[row] >= least_cosine)
            # One product of large matrices each way, in place of one a pair.
            forth = (cameras[near].reshape(-1, 4) @ points[row].T).reshape(len(near), 3, -1)
            back = (points[near].reshape(-1, 4) @ cameras[row].T).reshape(len(near), -1, 3)
            shares = _share_inside(*np.moveaxis(forth, 1, 0)), _share_inside(*np.moveaxis(back, 2, 0))
            scores[place, near] = np.mean(shares, axis=0)
        return scores

    return scores_of


def _share_inside(
    x: Float32[np.ndarray, "M S"], y: Float32[np.ndarray, "M S"], z: Float32[np.ndarray, "M S"]
) -> Float[np.ndarray, " M"]:
    """The share of the points (x / z, y / z) that fall into an image of size 1."""
    inside = (x >= 0) & (x <= z) & (y >= 0) & (y <= z) & (z > 0)
    share: np.ndarray = inside.mean(axis=1)
    return share


def _unit_camera(view: TrueView) -> Float[np.ndarray, "3 4"]:
    """The projection of points of the world, of an image resized to 1 x 1."""
    camera: np.ndarray = scaled(view.camera_matrix, 1 / view.width, 1 / view.height) @ _pose(view)
    return camera


def _seen_points(view: TrueView, depth: float) -> Float[np.ndarray, "S 4"]:
    """Points of the world that the image sees, homogeneous."""
    steps = [(np.arange(count) + 0.5) / count for count in _GRID]
    pixels = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2) * (view.width, view.height)
    depths = np.repeat(np.array(_DEPTHS) * depth, len(pixels))
    in_camera = lift(np.tile(pixels, (len(_DEPTHS), 1)), depths, view.camera_matrix)
    world_from_cam = inverse(_pose(view))
    return np.column_stack([in_camera @ world_from_cam[:, :3].T + world_from_cam[:, 3], np.ones(len(depths))])


def _pose(view: TrueView) -> Float[np.ndarray, "3 4"]:
    if view.cam_from_world is None:
        raise ValueError(f"'{view.name}' has no pose")
    return view.cam_from_world
