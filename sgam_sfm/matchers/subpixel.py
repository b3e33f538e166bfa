"""Photometric refinement of rough matches: Lucas-Kanade on patches that are warped by the matches around them.

Plain tracking compares upright patches of equal size, which fails as soon as the views differ in scale or rotation.
Rough matches already tell how the surroundings map, so each patch is compared through its own local affine map.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree

RADIUS = 8  # samples from the centre of a patch to its side
STRIDES = (4, 2, 1)  # pixels between samples, coarse to fine
ITERATIONS = 6  # per stride
MIN_NEIGHBOURS = 4  # for an affine map, which has three unknowns a row
OUTLYING = 0.1  # this far off the local map (in radii of the neighbourhood) a neighbour loses half its say
PRIOR = 1e-3  # towards the identity, for neighbours on a line


def local_affines(
    points0: Float[np.ndarray, "M 2"], points1: Float[np.ndarray, "M 2"], neighbours: int = 12
) -> Float[np.ndarray, "M 2 2"]:
    """The linear part of the map from image 0 to image 1 around each match, from the matches nearest in image 0.

    Least squares, reweighted against wrong neighbours. The identity where there are too few matches, or where the map
    would mirror a patch or change its area more than ninefold.
    """
    identity = np.tile(np.eye(2), (len(points0), 1, 1))
    if len(points0) < MIN_NEIGHBOURS:
        return identity
    distances, near = cKDTree(points0).query(points0, k=min(neighbours, len(points0)))
    radius = np.maximum(distances[:, -1:, None], 1e-9)
    source = (points0[near] - points0[:, None]) / radius
    source = np.concatenate([source, np.ones((*near.shape, 1))], -1)
    target = (points1[near] - points1[:, None]) / radius
    weights = np.ones(near.shape)
    for _ in range(5):
        weighted = (source * weights[..., None]).swapaxes(1, 2)
        maps = np.linalg.solve(weighted @ source + PRIOR * np.eye(3), weighted @ target + PRIOR * np.eye(3, 2))
        residuals = np.linalg.norm(source @ maps - target, axis=-1)
        weights = 1 / (1 + (residuals / OUTLYING) ** 2)
    affines = maps[:, :2].swapaxes(1, 2)
    areas = np.linalg.det(affines)
    plausible = (areas > 1 / 9) & (areas < 9)
    return np.where(plausible[:, None, None], affines, identity)


def refine(
    gray0: Float32[np.ndarray, "h0 w0"],
    gray1: Float32[np.ndarray, "h1 w1"],
    points0: Float[np.ndarray, "M 2"],
    points1: Float[np.ndarray, "M 2"],
    affines: Float[np.ndarray, "M 2 2"],
) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, " M"]]:
    """Move points1 to where image 1 looks most like image 0 around points0, whatever the brightness and contrast.

    Args: gray0, gray1 intensities; points in pixels, corner origin; affines: the linear maps from image 0 to image 1.
    Returns: the new points1, and the correlation of each pair of patches in [-1, 1], 0 where there is no texture.
    Source: inverse compositional alignment (Baker & Matthews, IJCV 2004) of a translation, the affine part held.
    """
    correlation = np.zeros(len(points0))
    if len(points0) == 0:
        return points1, correlation
    span = np.arange(-RADIUS, RADIUS + 1, dtype=np.float64)
    grid = np.stack(np.meshgrid(span, span), -1).reshape(-1, 2)
    window = np.exp(-(grid**2).sum(1) / RADIUS**2)
    window /= window.sum()
    for stride in STRIDES:
        smooth0, smooth1 = _smoothed(gray0, stride), _smoothed(gray1, stride)
        template, contrast = _standardised(_sample(smooth0, points0[:, None] + stride * grid), window)
        slopes = np.stack(np.gradient(template.reshape(-1, len(span), len(span)), stride, axis=(2, 1)), -1)
        slopes = slopes.reshape(len(points0), -1, 2)
        steepest = (slopes * window[:, None]).swapaxes(1, 2)
        hessians = steepest @ slopes
        hessians += (1e-3 * np.trace(hessians, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(2)
        surroundings1 = stride * grid @ affines.swapaxes(1, 2)
        for _ in range(ITERATIONS):
            patches, _ = _standardised(_sample(smooth1, points1[:, None] + surroundings1), window)
            steps = np.linalg.solve(hessians, steepest @ (patches - template)[..., None])
            steps *= np.minimum(1, stride / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9))
            points1 = points1 - (affines @ steps)[..., 0]
    patches, contrast1 = _standardised(_sample(smooth1, points1[:, None] + surroundings1), window)
    textured = (contrast > 1) & (contrast1 > 1)
    correlation[textured] = ((template * patches) @ window)[textured]
    return points1, correlation.clip(-1, 1)


def _smoothed(gray: np.ndarray, stride: int) -> np.ndarray:
    return gray if stride == 1 else cv2.GaussianBlur(gray, (0, 0), stride / 2)


def _sample(gray: np.ndarray, points: np.ndarray) -> np.ndarray:
    x, y = np.moveaxis(points.astype(np.float32) - np.float32(0.5), -1, 0)  # OpenCV's first pixel is centred on 0
    return cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _standardised(patches: np.ndarray, window: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Patches (M, P) with mean 0 and deviation 1 under the window, and what their deviation was (M,)."""
    centred = patches - (patches @ window)[:, None]
    deviation = np.sqrt(centred**2 @ window)
    return centred / np.maximum(deviation, 1e-6)[:, None], deviation
