"""Epipolar geometry: residuals and robust estimation. Everything here is in full-image pixels."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from sgam_core.errors import ShapeError
from sgam_core.options import GeometryOptions
from sgam_core.types import Matches, TwoViewModel


def sampson_distance(
    F: Float[np.ndarray, "3 3"], x0: Float[np.ndarray, "M 2"], x1: Float[np.ndarray, "L 2"]
) -> Float[np.ndarray, " M"]:
    """First-order squared distance of each match to x1' F x0 = 0.

    Args: F (3, 3) maps image-0 points to image-1 lines; x0, x1 (M, 2) pixels of the frame that F belongs to.
    Returns: (M,) squared pixels.
    Raises: ShapeError when x0 and x1 differ in length.
    Source: paper, Eq. 2; Hartley & Zisserman, section 11.4.
    """
    if len(x0) != len(x1):
        raise ShapeError(f"{len(x0)} points in image 0 and {len(x1)} in image 1; expected as many in both")
    lines1 = x0 @ F[:, :2].T + F[:, 2]
    lines0 = x1 @ F[:2, :] + F[2, :]
    algebraic = np.einsum("md,md->m", x1, lines1[:, :2]) + lines1[:, 2]
    gradient = (lines1[:, 0] ** 2 + lines1[:, 1] ** 2) + (lines0[:, 0] ** 2 + lines0[:, 1] ** 2)
    distances: np.ndarray = algebraic**2 / np.maximum(gradient, np.finfo(float).tiny)
    return distances


def residuals(F: Float[np.ndarray, "3 3"], matches: Matches) -> Float[np.ndarray, " M"]:
    """Sigma-normalised residuals r (M,): Sampson distance over the square of each match's coarser resolution."""
    r: np.ndarray = sampson_distance(F, matches.points0, matches.points1) / matches.sigmas.astype(np.float64) ** 2
    return r


def mean_residual(F: Float[np.ndarray, "3 3"], matches: Matches, tau: float) -> float:
    """Mean of min(r, tau); tau when there is no match.

    # Differs from the paper: Eq. 2 sums, so that areas with many matches always lose.
    """
    return float(np.minimum(residuals(F, matches), tau).mean()) if len(matches) else tau


def estimate_two_view(
    matches: Matches,
    camera0: Float[np.ndarray, "3 3"] | None,
    camera1: Float[np.ndarray, "3 3"] | None,
    options: GeometryOptions,
) -> TwoViewModel | None:
    """Robust epipolar geometry: essential when both cameras are known, else fundamental.

    Args: matches in full-image pixels; camera0, camera1 (3, 3) pinhole matrices or None.
    Returns: the model, or None when there are too few matches or no model is found.
    Source: MAGSAC++ as in OpenCV's USAC.
    """
    if len(matches) < options.min_matches:
        return None
    usac = cv2.UsacParams()
    usac.threshold = options.threshold * float(np.median(matches.sigmas))
    usac.confidence = 0.9999
    usac.score = cv2.SCORE_METHOD_MAGSAC
    usac.loMethod = cv2.LOCAL_OPTIM_SIGMA
    usac.randomGeneratorState = options.seed
    found: np.ndarray | None
    try:
        if camera0 is not None and camera1 is not None:
            usac.maxIterations = options.max_iterations_calibrated
            E, _ = cv2.findEssentialMat(matches.points0, matches.points1, camera0, camera1, None, None, usac)
            found = None if E is None else np.linalg.inv(camera1).T @ E[:3] @ np.linalg.inv(camera0)
        else:
            usac.maxIterations = options.max_iterations
            found, _ = cv2.findFundamentalMat(matches.points0, matches.points1, usac)
    except cv2.error:  # where local optimisation of planar matches leaves no model, OpenCV raises
        return None
    if found is None or found.shape != (3, 3) or not np.isfinite(found).all() or not found.any():
        return None
    F = found / np.linalg.norm(found)
    inlier = residuals(F, matches) <= options.max_residual
    return TwoViewModel(
        F=F,
        calibrated=camera0 is not None and camera1 is not None,
        num_inliers=int(inlier.sum()),
        num_matches=len(matches),
        planarity=_planarity(matches.select(inlier), usac.threshold),
    )


def _planarity(inliers: Matches, threshold: float) -> float:
    """Share of the inliers that one homography explains."""
    if len(inliers) < 4:
        return 1.0
    try:
        H, on_plane = cv2.findHomography(
            inliers.points0, inliers.points1, cv2.USAC_FAST, threshold, maxIters=500, confidence=0.99
        )
    except cv2.error:
        return 1.0
    return 1.0 if H is None else float(on_plane.mean())
