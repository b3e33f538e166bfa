"""Metrics on constructed truth: numbers that can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sgam_core.errors import ShapeError
from sgam_core.types import Box
from sgam_sfm.evaluation import metrics, sfm_metrics
from sgam_sfm.evaluation.projection import inverse, lift, project, relative_pose
from sgam_sfm.scene import correspond, demo_views, depth_at

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
SIZE = (640, 480)


def pose(rotvec=(0.0, 0, 0), t=(0.0, 0, 0)) -> np.ndarray:
    return np.column_stack([Rotation.from_rotvec(rotvec, degrees=True).as_matrix(), np.array(t, float)])


def scene(count: int = 40, seed: int = 0, truth: np.ndarray | None = None):
    """Points (N, 3) in front of both cameras, their pixels in each, and the true pose of the pair."""
    rng = np.random.default_rng(seed)
    truth = pose((2, -5, 1), (0.5, 0.1, 0.05)) if truth is None else truth
    pixels0 = rng.uniform((40, 40), (600, 440), (count, 2))
    depth = rng.uniform(3, 6, count)
    return pixels0, project(lift(pixels0, depth, K), K, truth), depth, truth


# --- matches ---------------------------------------------------------------------------------------------------------


def test_one_point_moved_by_one_and_a_half_pixels_costs_exactly_one_match():
    points0, points1, depth, truth = scene()
    exact, by_depth = metrics.match_errors(points0, points1, K, K, truth, depth)
    assert by_depth.all()
    assert exact.max() < 1e-9
    points1[7] += [0.9, -1.2]
    moved, _ = metrics.match_errors(points0, points1, K, K, truth, depth)
    np.testing.assert_allclose(moved[7], 1.5)
    assert metrics.precision(exact, 1) == 1
    assert metrics.precision(moved, 1) == 39 / 40
    assert metrics.precision(moved, 1.5 + 1e-9) == 1
    halved, _ = metrics.match_errors(points0, points1, K, K, truth, depth, (0.5, 0.5))
    np.testing.assert_allclose(halved[7], 0.75)


def test_without_depth_the_error_is_the_mean_distance_to_the_epipolar_lines():
    # Sideways motion: the lines are the rows, so only the vertical part of a shift counts, in either image.
    points0, points1, _, truth = scene(truth=pose(t=(1, 0, 0)))
    points1[3] += [40, 1.5]
    errors, by_depth = metrics.match_errors(points0, points1, K, K, truth)
    assert not by_depth.any()
    np.testing.assert_allclose(errors[3], 1.5)
    np.testing.assert_allclose(np.delete(errors, 3), 0, atol=1e-9)
    scaled, _ = metrics.match_errors(points0, points1, K, K, truth, None, (1, 0.5))
    np.testing.assert_allclose(scaled[3], (1.5 + 0.75) / 2)


def test_matches_without_depth_fall_back_one_by_one_and_points_behind_the_camera_are_wrong():
    points0, points1, depth, _ = scene(truth=pose(t=(1, 0, 0)))
    depth[0] = np.nan
    depth[1] = 1.0
    backwards = pose(t=(1, 0, -2))
    errors, by_depth = metrics.match_errors(points0, points1, K, K, backwards, depth)
    assert list(by_depth[:3]) == [False, True, True]
    assert np.isfinite(errors[0])
    assert errors[1] == np.inf


def test_mma_is_the_mean_over_pairs_and_a_pair_without_match_counts_zero():
    errors = [np.array([0.5, 2.0]), np.zeros(0), np.array([0.1, 0.2, 0.3, 5.0])]
    assert metrics.mean_matching_accuracy(errors, 1) == pytest.approx((0.5 + 0 + 0.75) / 3)
    with pytest.raises(ShapeError, match="MMA of no pair"):
        metrics.mean_matching_accuracy([], 1)


def test_depth_is_interpolated_on_planes_and_taken_from_the_nearest_pixel_at_rims():
    depth = np.full((4, 4), 2.0)
    depth[:, 2:] = 4.0
    depth[3, 3] = 0
    # At twice the resolution of the map: (x, y) of the image is (x, y) / 2 of the map.
    points = np.array([[1.0, 1.0], [3.9, 3.0], [4.1, 3.0], [7.5, 7.5], [-0.1, 2], [8.0, 2]])
    np.testing.assert_allclose(metrics.depth_at(depth, points, (8, 8)), [2, 2, 4, np.nan, np.nan, np.nan])
    ramp = 1 / np.tile(np.linspace(0.30, 0.306, 4), (4, 1))  # a plane: inverse depth is linear
    np.testing.assert_allclose(1 / metrics.depth_at(ramp, np.array([[2.0, 2.0]]), (4, 4)), [0.303])


# --- MCN sampling ----------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 300), st.integers(1, 120), st.integers(0, 5))
def test_sampling_never_exceeds_the_limit_nor_repeats(count, limit, seed):
    points0, points1, _, _ = scene(count, seed)
    rows = metrics.sample_matches(points0, points1, SIZE, limit, np.random.default_rng(seed))
    assert len(rows) == min(count, limit)
    assert list(rows) == sorted(set(rows.tolist()))


def test_sampling_drops_duplicates_is_seeded_and_evens_out_the_image():
    points0, points1, _, _ = scene(100)
    doubled0, doubled1 = np.concatenate([points0, points0]), np.concatenate([points1, points1])
    np.testing.assert_array_equal(
        metrics.sample_matches(doubled0, doubled1, SIZE, 500, np.random.default_rng(0)), np.arange(100)
    )
    # 1,000 matches crowd into a corner of 10 x 10 %, 100 cover the rest: a plain draw of 100 would take about 9 there.
    rng = np.random.default_rng(1)
    crowd = rng.uniform((0, 0), (64, 48), (1000, 2))
    everywhere = np.concatenate([crowd, rng.uniform((0, 0), SIZE, (100, 2))])
    rows = metrics.sample_matches(everywhere, everywhere, SIZE, 100, np.random.default_rng(2))
    assert (rows >= 1000).sum() > 60
    again = metrics.sample_matches(everywhere, everywhere, SIZE, 100, np.random.default_rng(2))
    np.testing.assert_array_equal(rows, again)


# --- areas -----------------------------------------------------------------------------------------------------------


def test_area_overlap_of_a_fronto_parallel_plane_is_that_of_shifted_rectangles():
    # At depth 5 a sideways step of 1 moves the plane by 500 / 5 = 100 pixels to the right.
    depth = np.full((480, 640), 5.0)
    boxes = (Box(x0=100, y0=100, x1=200, y1=200), Box(x0=250, y0=100, x1=350, y1=150))
    found = metrics.area_overlap(boxes, (depth, depth), (SIZE, SIZE), (K, K), pose(t=(1, 0, 0)))
    # Area 0 lands on [200, 300) x [100, 200): half its width and half its height are inside area 1.
    assert found.forward == 0.25
    # Area 1 came from [150, 250) x [100, 150), the left half of which is area 0.
    assert found.backward == 0.5
    assert found.mean == 0.375
    assert (found.num_points0, found.num_points1, found.approximate) == (10_000, 5_000, False)


def test_area_overlap_counts_valid_depth_only_at_the_depth_map_s_own_resolution():
    depth = np.full((240, 320), 5.0)
    depth[:, 75:] = 0  # right of x = 150 nothing is known
    depth[0, 0] = np.nan
    boxes = (Box(x0=100, y0=100, x1=200, y1=200), Box(x0=200, y0=100, x1=250, y1=200))
    found = metrics.area_overlap(boxes, (depth, depth * 0), (SIZE, SIZE), (K, K), pose(t=(1, 0, 0)))
    assert (found.forward, found.num_points0) == (1.0, 25 * 50)
    assert np.isnan(found.backward)
    assert np.isnan(found.mean)


def test_area_overlap_of_triangulated_matches_says_that_it_is_approximate():
    points0, points1, _, truth = scene(200)
    wrong0, wrong1 = np.array([[150.0, 150.0]]), np.array([[150.0, 400.0]])
    points = (np.concatenate([points0, wrong0]), np.concatenate([points1, wrong1]))
    left = Box(x0=0, y0=0, x1=320, y1=480)
    middle = np.median(points1[left.contains(points0), 0])
    found = metrics.area_overlap_of_matches((left, Box(x0=0, y0=0, x1=middle, y1=480)), points, (K, K), truth)
    assert found.approximate
    assert found.num_points0 == left.contains(points0).sum()
    assert found.forward == pytest.approx(0.5, abs=1 / found.num_points0)
    nothing = metrics.area_overlap_of_matches((left, left), (np.zeros((0, 2)), np.zeros((0, 2))), (K, K), truth)
    assert nothing.num_points0 == 0
    assert np.isnan(nothing.forward)


def test_amp_is_the_share_above_the_threshold():
    assert metrics.area_matching_precision([0.7, 0.71, 0.2, 1.0, float("nan")]) == 0.5
    assert np.isnan(metrics.area_matching_precision([float("nan")]))


# --- poses -----------------------------------------------------------------------------------------------------------


def test_a_rotation_of_three_degrees_is_an_error_of_three():
    truth = pose((10, 20, 30), (1, 2, 3))
    turned = pose((0, 0, 3)) @ np.vstack([truth, [0, 0, 0, 1]])
    error = metrics.relative_pose_error(np.column_stack([turned[:, :3], truth[:, 3]]), truth)
    assert error.rotation == pytest.approx(3)
    assert error.translation == pytest.approx(0, abs=1e-6)
    assert error.max == pytest.approx(3)


def test_translation_is_sign_free_for_two_views_and_signed_after_sfm():
    truth, found = pose(t=(1, 0, 0)), pose(t=(-np.cos(np.deg2rad(4)), np.sin(np.deg2rad(4)), 0))
    assert metrics.relative_pose_error(found, truth).translation == pytest.approx(4)
    assert metrics.relative_pose_error(found, truth, signed=True).translation == pytest.approx(176)
    assert metrics.relative_pose_error(None, truth).max == 180
    assert metrics.relative_pose_error(found, pose()).translation == 0  # the true cameras coincide


@given(st.floats(1e-5, 179.9), st.floats(0.01, 100))
def test_rotation_error_is_the_angle_whatever_the_scale(angle, scale):
    truth = pose((15, -40, 5), (0.2, -1, 0.4))
    R = Rotation.from_rotvec(np.array([0.6, 0, 0.8]) * angle, degrees=True).as_matrix() @ truth[:, :3]
    error = metrics.relative_pose_error(np.column_stack([R, scale * truth[:, 3]]), truth)
    assert error.rotation == pytest.approx(angle, rel=1e-6)
    assert error.translation == pytest.approx(0, abs=1e-5)


def test_pose_is_recovered_from_matches_a_third_of_which_are_wrong_and_repeatably():
    points0, points1, _, truth = scene(300)
    points1[:100] = np.random.default_rng(3).uniform((0, 0), SIZE, (100, 2))
    found = metrics.estimate_relative_pose(points0, points1, K, K)
    assert found is not None
    assert metrics.relative_pose_error(found, truth, signed=True).max < 0.05
    again = metrics.estimate_relative_pose(points0, points1, K, K)
    np.testing.assert_array_equal(found, again)
    assert np.linalg.norm(found[:, 3]) == pytest.approx(1)


def test_points_far_beyond_fifty_baselines_still_settle_the_sign():
    points0, points1, _, truth = scene(200, truth=pose((1, 2, 0), (0.03, 0, 0)))
    found = metrics.estimate_relative_pose(points0, points1, K, K)
    assert found is not None
    assert metrics.relative_pose_error(found, truth, signed=True).max < 0.5


@pytest.mark.parametrize("count", [0, 4])
def test_too_few_matches_give_no_pose(count):
    points0, points1, _, _ = scene(count)
    assert metrics.estimate_relative_pose(points0, points1, K, K) is None


def test_identical_matches_do_not_end_the_run():
    same = np.full((20, 2), 100.0)
    assert metrics.relative_pose_error(metrics.estimate_relative_pose(same, same, K, K), pose(t=(1, 0, 0))).max <= 180


def test_auc_against_an_integral_by_hand():
    # Recall rises from (0, 0) to (2, 1/4) to (4, 2/4), then is level up to 5: (0.25 + 0.75 + 0.5) / 5.
    assert metrics.pose_auc([4, 180, 2, 8], [5]) == pytest.approx([0.3])
    # Up to 10: the third point is (8, 3/4): (0.25 + 0.75 + 2.5 + 1.5) / 10.
    assert metrics.pose_auc([4, 180, 2, 8], [5, 10]) == pytest.approx([0.3, 0.5])
    assert metrics.pose_auc([0, 0], [0.5, 20]) == pytest.approx([1, 1])
    assert metrics.pose_auc([180], [5, 10, 20]) == (0, 0, 0)
    with pytest.raises(ShapeError, match="AUC of 0 pose errors"):
        metrics.pose_auc([], [5])
    with pytest.raises(ShapeError, match="no NaN"):
        metrics.pose_auc([1, float("nan")], [5])


@given(st.lists(st.floats(0, 180), min_size=1, max_size=30), st.floats(0.1, 30))
def test_auc_lies_between_zero_and_the_recall_and_falls_when_an_error_grows(errors, threshold):
    (area,) = metrics.pose_auc(errors, [threshold])
    assert -1e-12 <= area <= np.mean(np.array(errors) < threshold) + 1e-12
    worse = [*errors[:-1], 180.0]
    assert metrics.pose_auc(worse, [threshold])[0] <= area + 1e-12


# --- reconstructions -------------------------------------------------------------------------------------------------

SIMILARITY = sfm_metrics.Similarity(
    scale=2.5,
    rotation=Rotation.from_rotvec([20, -70, 110], degrees=True).as_matrix(),
    translation=np.array([3.0, -1, 7]),
)


def cameras(count: int, line: bool = False) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    poses = {}
    for i in range(count):
        R = Rotation.from_rotvec(rng.uniform(-60, 60, 3), degrees=True).as_matrix()
        centre = np.array([i, 0.0, 0.0]) if line else rng.uniform(-5, 5, 3)
        poses[f"{i}.jpg"] = np.column_stack([R, -R @ centre])
    return poses


def in_another_world(true: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The poses in the world that SIMILARITY takes to the true one."""
    moved = {}
    for name, p in true.items():
        centre = (inverse(p)[:, 3] - SIMILARITY.translation) @ SIMILARITY.rotation / SIMILARITY.scale
        R = p[:, :3] @ SIMILARITY.rotation
        moved[name] = np.column_stack([R, -R @ centre])
    return moved


@pytest.mark.parametrize("line", [False, True])
@pytest.mark.parametrize("outliers", [0, 4])
def test_alignment_finds_a_known_similarity_in_spite_of_outliers(line, outliers):
    true = cameras(12, line)
    found = in_another_world(true)
    for i in range(outliers):
        found[f"{i}.jpg"] = pose((50 * i, 90, 0), (40, -3 * i, 8))
    similarity = sfm_metrics.align(found, true)
    assert similarity is not None
    assert similarity.scale == pytest.approx(2.5)
    np.testing.assert_allclose(similarity.rotation, SIMILARITY.rotation, atol=1e-7)
    np.testing.assert_allclose(similarity.translation, SIMILARITY.translation, atol=1e-6)
    assert len(similarity.inliers) == 12 - outliers
    errors = sfm_metrics.camera_errors(found, true, similarity)
    assert len(errors) == 12
    for name in similarity.inliers:
        assert errors[name].centre < 1e-6
        assert errors[name].rotation < 1e-4
    for i in range(outliers):
        assert errors[f"{i}.jpg"].centre > 1


def test_a_turn_about_a_line_that_centres_leave_open_is_no_error_of_cameras():
    rng = np.random.default_rng(0)
    true = {name: p.copy() for name, p in cameras(12, line=True).items()}
    for p in true.values():
        p[:, 3] += rng.normal(0, 0.15, 3)  # off a line of eleven
    found = in_another_world(true)
    for p in found.values():
        p[:, 3] += rng.normal(0, 0.02, 3)
    similarity = sfm_metrics.align(found, true)
    assert similarity is not None
    errors = sfm_metrics.camera_errors(found, true, similarity)
    assert max(error.rotation for error in errors.values()) < 1e-3
    turn = Rotation.from_matrix(similarity.rotation @ SIMILARITY.rotation.T).magnitude()
    assert np.rad2deg(turn) > 1  # of the centres alone


def test_camera_errors_are_in_the_unit_of_the_ground_truth():
    true = cameras(10)
    found = in_another_world(true)
    found["3.jpg"][:, 3] += [0, 0.2, 0]  # 0.2 of its own world is 0.5 of the true one
    found["4.jpg"] = np.column_stack([pose((0, 2, 0))[:, :3] @ found["4.jpg"][:, :3], found["4.jpg"][:, 3]])
    errors = sfm_metrics.camera_errors(found, true, SIMILARITY)
    assert errors["3.jpg"].centre == pytest.approx(0.5)
    assert errors["4.jpg"].rotation == pytest.approx(2)


def test_too_little_to_align_is_no_similarity():
    true = cameras(4)
    assert sfm_metrics.align({"0.jpg": true["0.jpg"]}, true) is None
    assert sfm_metrics.align({}, true) is None
    assert sfm_metrics.align({name: pose() for name in true}, true) is None
    two = {name: p for name, p in in_another_world(true).items() if name in ("0.jpg", "2.jpg")}
    similarity = sfm_metrics.align(two, true)
    assert similarity is not None
    assert similarity.scale == pytest.approx(2.5)


def test_pairwise_errors_ignore_the_world_and_punish_what_is_not_registered():
    true = cameras(5)
    found = in_another_world(true)
    del found["2.jpg"]
    errors = sfm_metrics.pairwise_pose_errors(found, true)
    assert len(errors) == 10
    missing = [pair for pair in errors if "2.jpg" in pair]
    assert len(missing) == 4
    assert all(errors[pair].max == 180 for pair in missing)
    assert all(error.max < 1e-4 for pair, error in errors.items() if pair not in missing)
    auc = metrics.pose_auc([error.max for error in errors.values()], [0.5, 1, 3, 5])
    assert auc == pytest.approx([0.6] * 4, abs=1e-4)


def test_pairwise_translation_is_signed():
    true = {"a": pose(), "b": pose(t=(1, 0, 0))}
    errors = sfm_metrics.pairwise_pose_errors({"a": pose(), "b": pose(t=(-1, 0, 0))}, true)
    assert errors["a", "b"].translation == pytest.approx(180)


def test_tracks_count_distinct_images(unchecked):
    lengths = sfm_metrics.track_lengths(np.array([1, 1, 1, 7, 7, 7]), np.array([0, 1, 2, 4, 4, 5]))
    assert lengths.mean == 2.5
    assert lengths.histogram == {2: 1, 3: 1}
    assert sfm_metrics.track_lengths(np.zeros(0, int), np.zeros(0, int)).histogram == {}
    with pytest.raises(ShapeError, match="2 point ids and 1 image ids"):
        sfm_metrics.track_lengths(np.array([1, 2]), np.array([1]))


def test_relative_pose_chains():
    a, b = pose((1, 2, 3), (4, 5, 6)), pose((-30, 2, 9), (0, 1, 0))
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    in_a, in_b = (points @ p[:, :3].T + p[:, 3] for p in (a, b))
    ab = relative_pose(a, b)
    np.testing.assert_allclose(in_a @ ab[:, :3].T + ab[:, 3], in_b)


# --- the demo's room, whose truth is exact ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room_views():
    """Two neighbouring views and a depth map of the first, at half its width, by rays through its pixels' centres."""
    views = demo_views(width=320)[2:4]
    x, y = (2 * axis.ravel() + 1.0 for axis in np.meshgrid(np.arange(160), np.arange(120)))
    return views, depth_at(np.stack([x, y], axis=1), views[0]).reshape(120, 160)


def test_reprojection_through_a_depth_map_agrees_with_rays_cast_at_the_points(room_views):
    (view0, view1), depth_map = room_views
    points0 = np.random.default_rng(0).uniform((5, 5), (view0.width - 5, view0.height - 5), (500, 2))
    points1, visible = correspond(points0, view0, view1)
    assert visible.sum() > 100
    points0, points1 = points0[visible], points1[visible]
    cameras = (view0.camera_matrix, view1.camera_matrix)
    truth = relative_pose(view0.cam_from_world, view1.cam_from_world)
    depth = metrics.depth_at(depth_map, points0, (view0.width, view0.height))
    errors, by_depth = metrics.match_errors(points0, points1, *cameras, truth, depth)
    assert by_depth.all()
    assert np.median(errors) < 0.01
    assert metrics.precision(errors, 1) > 0.9
    epipolar, _ = metrics.match_errors(points0, points1, *cameras, truth)
    assert epipolar.max() < 1e-6


def test_area_overlap_agrees_with_rays_cast_from_the_area(room_views):
    (view0, view1), depth_map = room_views
    size = (view0.width, view0.height)
    boxes = (Box(x0=100, y0=80, x1=220, y1=180), Box(x0=60, y0=60, x1=200, y1=200))
    found = metrics.area_overlap(
        boxes,
        (depth_map, np.zeros((240, 320))),
        (size, size),
        (view0.camera_matrix, view1.camera_matrix),
        relative_pose(view0.cam_from_world, view1.cam_from_world),
    )
    points0 = np.random.default_rng(1).uniform((100, 80), (220, 180), (4000, 2))
    expected = boxes[1].contains(correspond(points0, view0, view1)[0]).mean()
    assert 0.3 < expected < 0.9
    assert found.forward == pytest.approx(expected, abs=0.03)
