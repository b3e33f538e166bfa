"""Landmarks: SIFT keypoints of a small image, which tell how one image lies and is sized against another.

Every match of two landmarks is a vote for a turn and a change of size, and those of the right one agree, however few
they are: Hough's transform as in Lowe, Distinctive Image Features from Scale-Invariant Keypoints, IJCV 2004, Sec. 7.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from sgam_core.sift import strongest_sift

_LONG_SIDE = 512  # pixels of the image that landmarks are found in
_MOST = 1500  # in an image
_RATIO = 0.9  # of the distances to the nearest descriptor and to the second
_TURN_STEP, _TURN_REACH = 15, 22.5  # degrees between the turns that are voted for, and how far a vote reaches
_SIZE_STEP, _SIZE_REACH = 0.25, 0.4  # the same of sizes, powers of two
_LARGEST_SIZE = 3.5  # power of two: eleven times


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Landmarks:
    """SIFT keypoints of an image.

    descriptors: (N, 128) of length 1, to be compared by Hellinger's distance. angles: (N,) degrees, clockwise. sizes:
    (N,) share of the image's long side.
    """

    descriptors: Float32[np.ndarray, "N 128"]
    angles: Float32[np.ndarray, " N"]
    sizes: Float32[np.ndarray, " N"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Vote:
    """How image 1 lies and is sized against image 0, as most landmarks have it.

    degrees: by which image 1 is to be turned anticlockwise to lie as image 0 does, 0 to 345. growth: how much larger
    things are in image 1, both being resized to one long side. count: votes for it.
    """

    degrees: int
    growth: float
    count: int


def find_landmarks(gray: UInt8[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"] | None) -> Landmarks:
    """The landmarks of an image, inside its mask."""
    scale = min(_LONG_SIDE / max(gray.shape), 1.0)
    size = tuple(max(round(scale * side), 1) for side in gray.shape[::-1])
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    if mask is not None:
        mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT).astype(bool)
    keypoints, descriptors = strongest_sift(small, mask, _MOST)
    return Landmarks(
        descriptors=descriptors,
        angles=np.array([keypoint.angle for keypoint in keypoints], np.float32),
        sizes=np.array([keypoint.size for keypoint in keypoints], np.float32) / max(size),
    )


def vote(landmarks0: Landmarks, landmarks1: Landmarks) -> Vote:
    """The turn and the change of size that most matches of the landmarks of two images agree on."""
    rows0, rows1 = _matches(landmarks0.descriptors, landmarks1.descriptors)
    turns = landmarks1.angles[rows1] - landmarks0.angles[rows0]
    growths = np.log2(landmarks1.sizes[rows1] / landmarks0.sizes[rows0])
    turn_bins = np.arange(0, 360, _TURN_STEP)
    growth_bins = np.arange(-_LARGEST_SIZE, _LARGEST_SIZE + _SIZE_STEP / 2, _SIZE_STEP)
    by_turn = np.abs((turns - turn_bins[:, None] + 180) % 360 - 180) <= _TURN_REACH
    by_growth = np.abs(growths - growth_bins[:, None]) <= _SIZE_REACH
    counts = by_turn.astype(np.float32) @ by_growth.T.astype(np.float32)
    best_turn, best_growth = np.unravel_index(counts.argmax(), counts.shape)
    return Vote(
        degrees=int(turn_bins[best_turn]),
        growth=float(2 ** growth_bins[best_growth]),
        count=int(counts.max()),
    )


def _matches(
    descriptors0: Float32[np.ndarray, "N 128"], descriptors1: Float32[np.ndarray, "M 128"]
) -> tuple[Int[np.ndarray, " K"], Int[np.ndarray, " K"]]:
    """Rows of both that are each other's nearest, and clearly nearer than the second nearest."""
    if min(len(descriptors0), len(descriptors1)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    cosines = descriptors0 @ descriptors1.T
    nearest1 = cosines.argmax(axis=1)
    rows0 = np.flatnonzero(cosines.argmax(axis=0)[nearest1] == np.arange(len(cosines)))
    rows1 = nearest1[rows0]
    mutual = cosines[rows0]
    first = mutual[np.arange(len(rows0)), rows1]
    mutual[np.arange(len(rows0)), rows1] = -1
    clear = 1 - first < _RATIO**2 * (1 - mutual.max(axis=1))
    return rows0[clear], rows1[clear]
