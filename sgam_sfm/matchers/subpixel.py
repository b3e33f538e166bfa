"""Photometric refinement of rough matches: Lucas-Kanade on patches that are warped by the matches around them.

Plain tracking compares upright patches of equal size, which fails as soon as the views differ in scale or rotation.
Rough matches already tell how the surroundings map, so each patch is compared through its own local affine map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.spatial import cKDTree

from sgam_core.types import Crop, Matches
from sgam_sfm.matchers.masks import wanted

RADIUS = 7  # samples from the centre of a patch to its side
SIDE = 2 * RADIUS + 1
ITERATIONS = 4  # per stride
MIN_CONTRAST = 1.0  # standard deviation of a patch in gray levels, below which there is nothing to align
MIN_NEIGHBOURS = 4  # for an affine map, which has three unknowns a row
OUTLYING = 0.1  # this far off the local map (in radii of the neighbourhood) a neighbour loses half its say
PRIOR = 1e-3  # towards the identity, for neighbours on a line
MIN_CORRELATION = 0.6  # of two patches that may move a match
MAX_SHIFT = 2.0  # crop pixels; a larger one has slid along an edge
_PATCHES_AT_ONCE = 2**13  # 15 MB each time that they are sampled; OpenCV takes less than 2**15

_span = np.arange(-RADIUS, RADIUS + 1, dtype=np.float32)
_GRID = np.stack(np.meshgrid(_span, _span), -1).reshape(-1, 2)
_WINDOW = np.exp(-(_GRID**2).sum(1) / RADIUS**2)
_WINDOW /= _WINDOW.sum()


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
    *,
    strides: tuple[int, ...] = (4, 2, 1),
) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, " M"]]:
    """Move points1 to where image 1 looks most like image 0 around points0, whatever the brightness and contrast.

    Patches are made and compared some thousands at a time, which bounds the memory that they take.

    Args: gray0, gray1 intensities; points in pixels, corner origin; affines: the linear maps from image 0 to image 1;
        strides: pixels between the samples of a patch, coarse to fine. A stride reaches about three times as far.
    Returns: the new points1, and the correlation of each pair of patches in [-1, 1], 0 where there is no texture.
    Source: inverse compositional alignment (Baker & Matthews, IJCV 2004) of a translation, the affine part held.
    """
    moved, correlation = points1.copy(), np.zeros(len(points0))
    smooth = [(stride, _smoothed(gray0, stride), _smoothed(gray1, stride)) for stride in strides]
    for begin in range(0, len(points0), _PATCHES_AT_ONCE):
        here = slice(begin, begin + _PATCHES_AT_ONCE)
        moved[here], correlation[here] = _aligned_patches(smooth, points0[here], points1[here], affines[here])
    return moved, correlation


def _aligned_patches(
    smooth: Sequence[tuple[int, np.ndarray, np.ndarray]], points0: np.ndarray, points1: np.ndarray, affines: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`refine` of as many points as there is memory for.

    Args: smooth: a stride, and both images as they are sampled with it.
    """
    correlation = np.zeros(len(points0))
    for stride, smooth0, smooth1 in smooth:
        template, contrast0 = _patches(smooth0, points0, stride * _GRID)
        slopes = np.gradient(template.reshape(-1, SIDE, SIDE), stride, axis=(2, 1))
        slope_x, slope_y = (slope.reshape(len(points0), -1) for slope in slopes)
        weighted = np.stack([slope_x * _WINDOW, slope_y * _WINDOW], 1)
        hessians = np.stack([weighted @ slope[..., None] for slope in (slope_x, slope_y)], 2)[..., 0].astype(np.float64)
        hessians += (1e-3 * np.trace(hessians, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(2)
        offsets1 = (stride * _GRID @ affines.swapaxes(1, 2)).astype(np.float32)
        for _ in range(ITERATIONS):
            patches, _ = _patches(smooth1, points1, offsets1)
            steps = np.linalg.solve(hessians, weighted @ (patches - template)[..., None])
            steps *= np.minimum(1, stride / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9))
            points1 = points1 - (affines @ steps)[..., 0]
    patches, contrast1 = _patches(smooth1, points1, offsets1)
    textured = np.minimum(contrast0, contrast1) > MIN_CONTRAST
    correlation[textured] = ((template * patches) @ _WINDOW)[textured]
    return points1, correlation.clip(-1, 1)


def aligned(
    crop0: Crop,
    crop1: Crop,
    matches: Matches,
    grays: tuple[UInt8[np.ndarray, "h0 w0"], UInt8[np.ndarray, "h1 w1"]] | None = None,
) -> Matches:
    """The matches with their second points moved to where the patches agree; where they do not, as they were.

    The scores fall by the share of the patches that does not correlate.

    Args: grays: of both crops, for a caller that has kept them.
    """
    grays = grays or (crop0.gray(), crop1.gray())
    gray0, gray1 = (gray.astype(np.float32) for gray in grays)
    affines = local_affines(matches.points0, matches.points1)
    points1, correlations = refine(gray0, gray1, matches.points0, matches.points1, affines, strides=(1,))
    near = np.linalg.norm(points1 - matches.points1, axis=1) < MAX_SHIFT
    better = near & (correlations > MIN_CORRELATION) & wanted(crop1, points1)
    return replace(
        matches,
        points1=np.where(better[:, None], points1, matches.points1),
        scores=matches.scores * (1 + correlations) / 2,
    )


def _smoothed(gray: np.ndarray, stride: int) -> np.ndarray:
    return gray if stride == 1 else cv2.GaussianBlur(gray, (0, 0), stride / 2)


def _patches(gray: np.ndarray, points: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intensities (M, P) at `offsets` around each point, with mean 0 and deviation 1 under the window.

    Also returns what their deviation was (M,).
    """
    x, y = (points - 0.5).astype(np.float32).T  # OpenCV's first pixel is centred on 0
    patches = cv2.remap(
        gray, x[:, None] + offsets[..., 0], y[:, None] + offsets[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
    )
    patches -= (patches @ _WINDOW)[:, None]
    deviation = np.sqrt(patches**2 @ _WINDOW)
    return np.divide(patches, np.maximum(deviation, 1e-6)[:, None], out=patches), deviation
