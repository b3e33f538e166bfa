import numpy as np
import pytest

from sgam_sfm.matchers.subpixel import local_affines, refine
from tests.textures import similarity, transfer, view

TURN = np.array([[1.1, -0.3], [0.2, 0.9]])


def test_local_affines_are_exact_on_an_affine_map_in_spite_of_wrong_matches():
    rng = np.random.default_rng(0)
    points0 = rng.uniform(0, 300, (200, 2))
    points1 = points0 @ TURN.T + [5, -3]
    wrong = rng.random(200) < 0.15
    points1[wrong] = rng.uniform(0, 300, (wrong.sum(), 2))
    affines = local_affines(points0, points1)
    assert np.median(np.abs(affines - TURN)[~wrong]) < 0.01
    assert (np.abs(affines - TURN).max((1, 2))[~wrong] < 0.1).mean() > 0.95


@pytest.mark.parametrize(
    ("points0", "points1"),
    [
        (np.zeros((0, 2)), np.zeros((0, 2))),
        (np.eye(3, 2), np.eye(3, 2) * 2),  # too few
        (np.full((9, 2), 4.0), np.full((9, 2), 4.0)),  # all in one place
        (np.indices((4, 4)).reshape(2, -1).T * 9.0, np.indices((4, 4)).reshape(2, -1).T * [9.0, -9.0]),  # mirrored
    ],
)
def test_local_affines_are_the_identity_where_the_matches_do_not_tell(points0, points1):
    affines = local_affines(points0, points1)
    assert affines.shape == (len(points0), 2, 2)
    np.testing.assert_allclose(affines, np.tile(np.eye(2), (len(points0), 1, 1)), atol=1e-12)


def test_points_on_a_line_leave_the_direction_across_it_alone():
    along = np.arange(20.0)[:, None] * [10.0, 0.0]
    affines = local_affines(along, 2 * along)
    np.testing.assert_allclose(affines, np.tile([[2.0, 0], [0, 1]], (20, 1, 1)), atol=0.01)


@pytest.mark.parametrize(("scale", "degrees"), [(1.0, 0), (1.3, 10), (0.8, -25)])
def test_refine_recovers_a_warp_to_a_twentieth_of_a_pixel(scale, degrees):
    size = (320, 240)
    warp = similarity(scale, degrees, (3.37, -2.61), (160, 120))
    gray0, gray1 = (view(h, size)[..., 0].astype(np.float32) for h in (np.eye(3), warp))
    rng = np.random.default_rng(1)
    points0 = rng.uniform([90, 60], [230, 180], (150, 2))
    truth = transfer(warp, points0)
    affines = np.tile(warp[:2, :2], (150, 1, 1))
    points1, correlation = refine(0.6 * gray0 + 20, gray1, points0, truth + rng.uniform(-4, 4, (150, 2)), affines)
    errors = points1 - truth
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.05
    assert np.abs(np.median(errors, axis=0)).max() < 0.02  # no bias, whatever the pixel origin
    assert (np.linalg.norm(errors, axis=1) < 0.5).mean() > 0.9
    assert np.median(correlation) > 0.99


def test_more_points_than_opencv_takes_at_once_are_refined_as_few_are():
    gray = view(np.eye(3), (320, 240))[..., 0].astype(np.float32)
    points = np.tile(np.random.default_rng(0).uniform([90, 60], [230, 180], (50, 2)), (700, 1))
    affines = np.tile(np.eye(2), (len(points), 1, 1))
    few, many = (refine(gray, gray, points[:n], points[:n] + 0.4, affines[:n], strides=(1,)) for n in (50, 35_000))
    np.testing.assert_allclose(many[0], np.tile(few[0], (700, 1)), atol=1e-6)
    np.testing.assert_allclose(many[1], np.tile(few[1], 700), atol=1e-6)


def test_a_patch_without_texture_correlates_with_nothing():
    flat = np.full((50, 60), 7, np.float32)
    point = np.array([[30.0, 25.0]])
    points1, correlation = refine(flat, flat, point, point, np.eye(2)[None])
    np.testing.assert_allclose(points1, point)
    assert correlation.tolist() == [0]
