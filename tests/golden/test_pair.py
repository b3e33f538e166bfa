"""Real pairs with known geometry at 3072x2048: two of Herz-Jesus-P8 7 degrees apart, two 42 apart, two of a castle.

Recorded with xfeat-star and coseg of two images at their defaults: on the near pair 6 areas kept, 6,000 matches by
areas and 3,000 by the plain matcher; on the far one 2,000 matches within a pixel with warped crops, 1,100 without. The
bounds leave a third of room, and the comparisons are what the project promises.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sgam_core import AreaState, Image, SemanticAreaMatcher, SGAMOptions, WholeImages, match_described
from sgam_core.geometry import sampson_distance
from sgam_core.options import changed
from sgam_sfm.images import inspect_image, read_image
from sgam_sfm.matchers.xfeat import XFeatStar
from sgam_sfm.segmenters.coseg import CoSeg

pytestmark = pytest.mark.golden
NEAR, FAR = ("0004.jpg", "0005.jpg"), ("0000.jpg", "0007.jpg")


@pytest.fixture(scope="module")
def scene(data: Path) -> Path:
    return data / "strecha" / "Herz-Jesus-P8"


def true_f(scene: Path, names: tuple[str, str]) -> np.ndarray:
    """Fundamental matrix (3, 3) of the ground truth, corner origin."""
    K = np.loadtxt(scene / "images" / "K.txt").reshape(3, 3)
    K[:2, 2] += 0.5  # its origin is the centre of the first pixel
    poses = []
    for name in names:
        values = np.array((scene / "gt_dense_cameras" / f"{name}.camera").read_text().split(), float)
        R = values[12:21].reshape(3, 3).T
        poses.append((R, -R @ values[21:24]))
    (R0, t0), (R1, t1) = poses
    R = R1 @ R0.T
    x, y, z = t1 - R @ t0
    inverse = np.linalg.inv(K)
    return inverse.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R @ inverse


def read(scene: Path, names: tuple[str, str]) -> list[Image]:
    return [Image(name=name, pixels=read_image(scene / "images" / name)) for name in names]


def errors_px(scene: Path, names: tuple[str, str], result) -> np.ndarray:
    return np.sqrt(sampson_distance(true_f(scene, names), result.matches.points0, result.matches.points1))


@pytest.mark.parametrize(
    ("options", "least_areas"), [(SGAMOptions(), 2), (changed(SGAMOptions(), crop__max_crop_pixels=4_000_000), 3)]
)
def test_areas_match_more_points_more_precisely_than_whole_images(scene, tmp_path, options, least_areas):
    images = read(scene, NEAR)
    files = [inspect_image(scene / "images", name) for name in NEAR]
    labels = {file.name: found for file, found in CoSeg(cache_folder=tmp_path).segment(files, lambda _: None)}
    matcher, areas = XFeatStar(), SemanticAreaMatcher()
    described = [areas.describe(image, labels[image.name]) for image in images]
    by_areas = match_described(*images, *described, areas, matcher, options)
    plain = match_described(*images, None, None, WholeImages(), matcher, options)

    assert by_areas.fallback == ""
    assert sum(area.state is AreaState.KEPT for area in by_areas.areas) >= least_areas
    assert by_areas.two_view is not None
    assert by_areas.two_view.inlier_ratio > 0.8
    fine, coarse = (errors_px(scene, NEAR, result) for result in (by_areas, plain))
    assert len(fine) > 1.3 * len(coarse) > 1000
    assert np.median(fine) < min(np.median(coarse), 1.5)
    assert (fine < 3).mean() > 0.75


def test_warped_crops_find_more_where_the_views_are_far_apart(scene):
    images, matcher, areas = read(scene, FAR), XFeatStar(), SemanticAreaMatcher()
    nothing = [areas.describe(image, np.zeros((1, 1), np.int32)) for image in images]
    warped, upright = (
        errors_px(scene, FAR, match_described(*images, *nothing, areas, matcher, changed(SGAMOptions(), **options)))
        for options in ({}, {"guidance__max_bend": 0.0})
    )
    assert (warped < 1).sum() > 1.4 * (upright < 1).sum() > 700
    assert (warped < 0.25).sum() > 2 * (upright < 0.25).sum() > 700


def test_enlarged_crops_place_the_points_of_small_photos_more_exactly(scene):
    """Of photos of 640 px, far apart: 435 matches within half a pixel, 72 where nothing is enlarged."""
    size, areas, matcher = (640, 427), SemanticAreaMatcher(), XFeatStar()
    images = [
        replace(image, pixels=cv2.resize(image.pixels, size, interpolation=cv2.INTER_AREA))
        for image in read(scene, FAR)
    ]
    shrink = np.diag([3072 / 640, 2048 / 427, 1])
    nothing = [areas.describe(image, np.zeros((1, 1), np.int32)) for image in images]

    def exact(max_upsampling: float) -> int:
        options = changed(SGAMOptions(), guidance__max_upsampling=max_upsampling)
        matches = match_described(*images, *nothing, areas, matcher, options).matches
        F = shrink.T @ true_f(scene, FAR) @ shrink
        return int((sampson_distance(F, matches.points0, matches.points1) < 0.5**2).sum())

    assert exact(2.0) > 3 * exact(1.0) > 120


@pytest.mark.parametrize("seed", [0, 29])
def test_a_facade_whose_parts_look_alike_is_seen_in_one_place(data, seed):
    scene, names = data / "strecha" / "castle-P19", ("0012.jpg", "0015.jpg")
    K = np.loadtxt(scene / "images" / "K.txt").reshape(3, 3)
    K[:2, 2] += 0.5
    images, areas = [replace(image, camera_matrix=K) for image in read(scene, names)], SemanticAreaMatcher()
    nothing = [areas.describe(image, np.zeros((1, 1), np.int32)) for image in images]
    # With seed 29 the whole images agree on a mixture of two places.
    options = changed(SGAMOptions(), geometry__seed=seed)
    found = match_described(*images, *nothing, areas, XFeatStar(), options)
    assert found.fallback == ""
    assert {AreaState.KEPT, AreaState.REJECTED} == {area.state for area in found.areas}
    assert (errors_px(scene, names, found) < 4).mean() > 0.8
    assert len(found.matches) > 1500
