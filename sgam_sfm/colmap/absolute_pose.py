"""The pose of one image against a model: matches with its images become 2D-3D correspondences.

A semi-dense matcher finds no keypoint of the model again, only spots near some: each match is carried to the nearest
keypoint that has a point in space, and its other end moves along with it.
"""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from sgam_core import Matches
from sgam_sfm.merging.affine import local_affine


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Landmarks:
    """The keypoints of a reference image that have a point in space. ids: of the points (K,), in the model."""

    keypoints: Float[np.ndarray, "K 2"]
    points_in_world: Float[np.ndarray, "K 3"]
    ids: Int[np.ndarray, " K"]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Correspondences:
    """Where an image shows points of the model: pixels (N, 2), the points (N, 3) and their ids (N,)."""

    pixels: Float[np.ndarray, "N 2"]
    points_in_world: Float[np.ndarray, "N 3"]
    ids: Int[np.ndarray, " N"]

    def select(self, rows: Int[np.ndarray, " K"]) -> Correspondences:
        """Some of them."""
        return Correspondences(pixels=self.pixels[rows], points_in_world=self.points_in_world[rows], ids=self.ids[rows])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Pose:
    """Where an image was taken.

    camera: with the focal length that was found, when none was known. inliers: (N,) of the correspondences, num_points
    different points of the model.
    """

    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera
    inliers: Bool[np.ndarray, " N"]
    num_points: int


def landmarks_of(model: pycolmap.Reconstruction, image: pycolmap.Image) -> Landmarks:
    """The landmarks of an image of a model."""
    seen = [point for point in image.points2D if point.has_point3D()]
    return Landmarks(
        keypoints=np.array([point.xy for point in seen], np.float64).reshape(-1, 2),
        points_in_world=np.array([model.point3D(p.point3D_id).xyz for p in seen], np.float64).reshape(-1, 3),
        ids=np.array([point.point3D_id for point in seen], np.int64),
    )


def carry_to_landmarks(
    matches: Matches, landmarks: Landmarks, trusted: Bool[np.ndarray, " M"], radius_px: float
) -> Correspondences:
    """What one reference gives: at most one correspondence for each of its landmarks, from the match nearest to it.

    Args: matches: side 0 is the image, side 1 the reference. trusted: matches that agree with the pair's geometry; how
        a step in the reference continues in the image is learnt from them. radius_px: in matcher pixels.
    """
    if not len(matches) or not len(landmarks.ids):
        return Correspondences(pixels=np.zeros((0, 2)), points_in_world=np.zeros((0, 3)), ids=np.zeros(0, np.int64))
    distances, nearest = cKDTree(landmarks.keypoints).query(matches.points1)
    distances = distances / matches.sigmas1
    order = np.argsort(distances, kind="stable")
    _, first = np.unique(nearest[order], return_index=True)
    rows = order[first]
    rows = rows[distances[rows] <= radius_px]
    steps = landmarks.keypoints[nearest[rows]] - matches.points1[rows]
    image_from_reference = local_affine(matches.points1, matches.points0, trusted)[rows]
    return Correspondences(
        pixels=matches.points0[rows] + (image_from_reference @ steps[:, :, None])[:, :, 0],
        points_in_world=landmarks.points_in_world[nearest[rows]],
        ids=landmarks.ids[nearest[rows]],
    )


def joined(parts: Sequence[Correspondences]) -> Correspondences:
    """The correspondences of several references; a point that several of them gave is there as often."""
    return Correspondences(
        pixels=np.concatenate([np.zeros((0, 2)), *(part.pixels for part in parts)]),
        points_in_world=np.concatenate([np.zeros((0, 3)), *(part.points_in_world for part in parts)]),
        ids=np.concatenate([np.zeros(0, np.int64), *(part.ids for part in parts)]),
    )


def estimate_pose(found: Correspondences, camera: pycolmap.Camera, *, max_error_px: float, seed: int) -> Pose | None:
    """COLMAP's absolute pose, robust and refined; the focal length too, when the camera does not know it.

    Returns: None when the correspondences fit no pose. The camera that is given stays as it is.
    """
    camera = deepcopy(camera)
    estimation, refinement = pycolmap.AbsolutePoseEstimationOptions(), pycolmap.AbsolutePoseRefinementOptions()
    estimation.ransac.max_error, estimation.ransac.random_seed = max_error_px, seed
    estimation.estimate_focal_length = refinement.refine_focal_length = not camera.has_prior_focal_length
    pose = pycolmap.estimate_and_refine_absolute_pose(
        found.pixels, found.points_in_world, camera, estimation, refinement
    )
    if pose is None:
        return None
    inliers = np.asarray(pose["inlier_mask"], bool)
    return Pose(
        cam_from_world=pose["cam_from_world"],
        camera=camera,
        inliers=inliers,
        num_points=len(np.unique(found.ids[inliers])),
    )
