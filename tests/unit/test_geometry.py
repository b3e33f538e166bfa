import numpy as np
import pytest

from sgam_core.errors import ShapeError
from sgam_core.geometry import estimate_two_view, mean_residual, residuals, sampson_distance
from sgam_core.options import GeometryOptions
from sgam_core.types import Matches
from tests.two_views import two_views

SIDEWAYS = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # pure translation along x: lines are y1 = y0


def test_sampson_distance_equals_the_hand_computed_value():
    # Lines are horizontal: a match that is 3 px off vertically is 3^2 / 2 from the nearest exact match.
    x0, x1 = np.array([[10.0, 20.0], [700.5, 0.5]]), np.array([[50.0, 23.0], [10.0, 0.5]])
    np.testing.assert_allclose(sampson_distance(SIDEWAYS, x0, x1), [4.5, 0.0], atol=1e-12)


def test_sampson_distance_does_not_depend_on_the_scale_of_f():
    x0, x1 = np.array([[10.0, 20.0]]), np.array([[50.0, 23.0]])
    np.testing.assert_allclose(sampson_distance(1e-6 * SIDEWAYS, x0, x1), [4.5])


def test_sampson_distance_names_both_lengths():
    with pytest.raises(ShapeError, match="1 points in image 0 and 2 in image 1; expected as many in both"):
        sampson_distance(SIDEWAYS, np.zeros((1, 2)), np.zeros((2, 2)))


def test_residuals_are_divided_by_the_square_of_the_coarser_sigma():
    matches = Matches(
        points0=np.array([[10.0, 20.0]] * 2),
        points1=np.array([[50.0, 23.0]] * 2),
        scores=np.ones(2),
        sigmas0=np.array([1.0, 1.0]),
        sigmas1=np.array([1.0, 3.0]),
    )
    np.testing.assert_allclose(residuals(SIDEWAYS, matches), [4.5, 0.5])
    assert mean_residual(SIDEWAYS, matches, tau=2.5) == pytest.approx((2.5 + 0.5) / 2)
    assert mean_residual(SIDEWAYS, Matches.empty(), tau=9.0) == 9.0


@pytest.mark.parametrize("calibrated", [True, False])
def test_robust_estimate_finds_the_truth_among_outliers(calibrated):
    scene = two_views(400, noise=0.3, outliers=0.4, seed=3)
    cameras = (scene.camera, scene.camera) if calibrated else (None, None)
    model = estimate_two_view(scene.matches, *cameras, GeometryOptions())
    assert model is not None
    assert model.calibrated is calibrated
    exact = sampson_distance(model.F, scene.exact0, scene.exact1)
    assert np.sqrt(exact).mean() < 0.5
    assert 0.58 < model.inlier_ratio < 0.70
    assert model.planarity < 0.5


def test_a_plane_shows_as_planarity():
    scene = two_views(400, noise=0.2, outliers=0.0, seed=1, depth_spread=0.0)
    model = estimate_two_view(scene.matches, scene.camera, scene.camera, GeometryOptions())
    assert model is not None
    assert model.planarity > 0.95


def test_too_few_matches_give_no_model():
    scene = two_views(14, noise=0, outliers=0, seed=0)
    assert estimate_two_view(scene.matches, None, None, GeometryOptions()) is None


def test_repeated_points_give_no_exception():
    same = Matches(points0=np.ones((40, 2)), points1=np.ones((40, 2)), scores=np.ones(40))
    estimate_two_view(same, None, None, GeometryOptions())


def test_estimates_repeat_bit_by_bit():
    scene = two_views(300, noise=0.5, outliers=0.5, seed=5)
    first, second = (estimate_two_view(scene.matches, None, None, GeometryOptions()) for _ in range(2))
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.F, second.F)


def test_planar_matches_that_leave_opencv_without_a_model_have_no_geometry():
    rng = np.random.default_rng(12851)  # found by trying: OpenCV raises an error here
    count = int(rng.integers(8, 60))
    points0 = rng.uniform(0, (160, 120), (count, 2))
    H = np.eye(3)
    H[:2, :2] += rng.normal(0, 0.1, (2, 2))
    H[:2, 2] = rng.normal(0, 8, 2)
    mapped = np.c_[points0, np.ones(count)] @ H.T
    points1 = mapped[:, :2] / mapped[:, 2:] + rng.normal(0, 1, (count, 2))
    matches = Matches(points0=points0, points1=points1, scores=np.ones(count))
    assert estimate_two_view(matches, None, None, GeometryOptions(threshold=1.5)) is None
