"""Pinhole geometry of a pair, as the metrics need it; conventions as in `metrics`."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float


def relative_pose(
    cam0_from_world: Float[np.ndarray, "3 4"], cam1_from_world: Float[np.ndarray, "3 4"]
) -> Float[np.ndarray, "3 4"]:
    """cam1_from_cam0 (3, 4) of two cameras."""
    R = cam1_from_world[:, :3] @ cam0_from_world[:, :3].T
    return np.column_stack([R, cam1_from_world[:, 3] - R @ cam0_from_world[:, 3]])


def inverse(pose: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
    """The pose (3, 4) the other way: world_from_cam of cam_from_world."""
    return np.column_stack([pose[:, :3].T, -pose[:, :3].T @ pose[:, 3]])


def homogeneous(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Points (N, 2) with a third coordinate of 1."""
    return np.column_stack([points, np.ones(len(points))])


def normalised(points: Float[np.ndarray, "N 2"], K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "N 2"]:
    """Pixels (N, 2) as points on the plane at depth 1 of their camera."""
    return np.ascontiguousarray((homogeneous(points) @ np.linalg.inv(K).T)[:, :2])


def lift(
    points: Float[np.ndarray, "N 2"], depth: Float[np.ndarray, " N"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "N 3"]:
    """Points (N, 3) in the camera's frame of pixels (N, 2) and their depth (N,) along its axis."""
    in_camera: np.ndarray = homogeneous(points) @ np.linalg.inv(K).T * depth[:, None]
    return in_camera


def project(
    points: Float[np.ndarray, "N 3"], K: Float[np.ndarray, "3 3"], pose: Float[np.ndarray, "3 4"]
) -> Float[np.ndarray, "N 2"]:
    """Pixels (N, 2) of points (N, 3) that the pose takes into the camera's frame; NaN behind the camera."""
    x = (points @ pose[:, :3].T + pose[:, 3]) @ K.T
    pixels: np.ndarray = x[:, :2] / np.where(x[:, 2:] > 0, x[:, 2:], np.nan)
    return pixels


def fundamental(
    K0: Float[np.ndarray, "3 3"], K1: Float[np.ndarray, "3 3"], cam1_from_cam0: Float[np.ndarray, "3 4"]
) -> Float[np.ndarray, "3 3"]:
    """F (3, 3), which maps pixels of image 0 to lines of image 1."""
    x, y, z = cam1_from_cam0[:, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    F: np.ndarray = np.linalg.inv(K1).T @ cross @ cam1_from_cam0[:, :3] @ np.linalg.inv(K0)
    return F


def line_distance(lines: Float[np.ndarray, "N 3"], points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    """Distance (N,) of each point to its line, in pixels."""
    distance = np.abs((lines * homogeneous(points)).sum(1))
    return distance / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), np.finfo(float).tiny)


def triangulate(
    points: tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2"]],
    cameras: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]],
    cam1_from_cam0: Float[np.ndarray, "3 4"],
) -> Float[np.ndarray, "M 3"]:
    """Points (M, 3) in the frame of camera 0, linearly; NaN at infinity."""
    if not len(points[0]):
        return np.zeros((0, 3))
    rays0, rays1 = (normalised(p, K).T for p, K in zip(points, cameras, strict=True))
    x: np.ndarray = cv2.triangulatePoints(np.eye(3, 4), cam1_from_cam0, rays0, rays1).T
    in_cam0: np.ndarray = x[:, :3] / np.where(x[:, 3:] != 0, x[:, 3:], np.nan)
    return in_cam0
