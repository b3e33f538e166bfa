"""One real pair with known geometry: Herz-Jesus-P8, images 0004 and 0005 at 3072x2048, 7 degrees apart.

Recorded with xfeat-star and coseg of two images at their defaults: 6 areas kept, 6,000 matches by areas and 3,000 by
the plain matcher; the bounds leave a third of room, and the comparison of the two is what the project promises.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sgam_core import AreaState, Image, SemanticAreaMatcher, SGAMOptions, WholeImages, match_described
from sgam_core.geometry import sampson_distance
from sgam_sfm.images import inspect_image, read_image
from sgam_sfm.matchers.xfeat import XFeatStar
from sgam_sfm.segmenters.coseg import CoSeg

pytestmark = pytest.mark.golden
NAMES = ("0004.jpg", "0005.jpg")


@pytest.fixture(scope="module")
def scene(data: Path) -> Path:
    return data / "strecha" / "Herz-Jesus-P8"


@pytest.fixture(scope="module")
def true_f(scene: Path) -> np.ndarray:
    """Fundamental matrix (3, 3) of the ground truth, corner origin."""
    K = np.loadtxt(scene / "images" / "K.txt").reshape(3, 3)
    K[:2, 2] += 0.5  # its origin is the centre of the first pixel
    poses = []
    for name in NAMES:
        values = np.array((scene / "gt_dense_cameras" / f"{name}.camera").read_text().split(), float)
        R = values[12:21].reshape(3, 3).T
        poses.append((R, -R @ values[21:24]))
    (R0, t0), (R1, t1) = poses
    R = R1 @ R0.T
    x, y, z = t1 - R @ t0
    inverse = np.linalg.inv(K)
    return inverse.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R @ inverse


@pytest.fixture(scope="module")
def images(scene: Path) -> list[Image]:
    return [Image(name=name, pixels=read_image(scene / "images" / name)) for name in NAMES]


def errors_px(true_f: np.ndarray, result) -> np.ndarray:
    return np.sqrt(sampson_distance(true_f, result.matches.points0, result.matches.points1))


def test_areas_match_more_points_more_precisely_than_whole_images(scene, images, true_f, tmp_path):
    files = [inspect_image(scene / "images", name) for name in NAMES]
    labels = {file.name: found for file, found in CoSeg(cache_folder=tmp_path).segment(files, lambda _: None)}
    matcher, options, areas = XFeatStar(), SGAMOptions(), SemanticAreaMatcher()
    described = [areas.describe(image, labels[image.name]) for image in images]
    by_areas = match_described(*images, *described, areas, matcher, options)
    plain = match_described(*images, None, None, WholeImages(), matcher, options)

    assert by_areas.fallback == ""
    assert sum(area.state is AreaState.KEPT for area in by_areas.areas) >= 3
    assert by_areas.two_view is not None
    assert by_areas.two_view.inlier_ratio > 0.8
    fine, coarse = errors_px(true_f, by_areas), errors_px(true_f, plain)
    assert len(fine) > 1.3 * len(coarse) > 1000
    assert np.median(fine) < min(np.median(coarse), 1.5)
    assert (fine < 3).mean() > 0.75
