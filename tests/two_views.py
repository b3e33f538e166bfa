"""Two views of random points with exact truth, for tests of the geometry and of the stages that use it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sgam_core.types import Matches

WIDTH, HEIGHT = 1000, 750


@dataclass(frozen=True)
class TwoViews:
    """matches, first exact then noisy; camera (3, 3); exact0, exact1 the points without noise or outliers."""

    matches: Matches
    camera: np.ndarray
    exact0: np.ndarray
    exact1: np.ndarray


def two_views(
    count: int,
    *,
    noise: float,
    outliers: float,
    seed: int,
    depth_spread: float = 2.0,
    window: tuple[float, float, float, float] = (0, 0, WIDTH, HEIGHT),
) -> TwoViews:
    """`count` points seen in `window` of image 0; a share of them is replaced by outliers in image 1."""
    rng = np.random.default_rng(seed)
    camera = np.array([[900.0, 0, WIDTH / 2], [0, 900.0, HEIGHT / 2], [0, 0, 1]])
    exact0 = rng.uniform(window[:2], window[2:], (count, 2))
    depth = 5 + depth_spread * rng.uniform(-1, 1, count)
    rays = np.column_stack([exact0, np.ones(count)]) @ np.linalg.inv(camera).T
    rotation = cv2.Rodrigues(np.array([0.02, -0.15, 0.03]))[0]
    moved = (rays * depth[:, None]) @ rotation.T + np.array([0.9, 0.1, 0.05])
    exact1 = (moved @ camera.T)[:, :2] / moved[:, 2:]
    points0 = exact0 + rng.normal(0, noise, exact0.shape)
    points1 = exact1 + rng.normal(0, noise, exact1.shape)
    wrong = rng.permutation(count)[: round(outliers * count)]
    points1[wrong] = rng.uniform((0, 0), (WIDTH, HEIGHT), (len(wrong), 2))
    return TwoViews(
        matches=Matches(points0=points0, points1=points1, scores=rng.uniform(0.2, 1, count)),
        camera=camera,
        exact0=exact0,
        exact1=exact1,
    )
