import numpy as np
import pytest

from sgam_core.errors import InputError, OptionError, ShapeError
from sgam_core.types import Matches
from sgam_sfm.merging.affine import local_affine
from sgam_sfm.merging.alignment import align_keypoints, offsets_of
from sgam_sfm.merging.clusters import merge_image
from sgam_sfm.merging.keypoints import KeypointOptions
from sgam_sfm.merging.merge import merge_keypoints, merging
from sgam_sfm.merging.tracks import Tracks
from tests.textures import similarity, transfer, view


def matches(points0, points1, scores=None, sigma=1.0):
    points0, points1 = np.array(points0, float).reshape(-1, 2), np.array(points1, float).reshape(-1, 2)
    sigmas = np.full(len(points0), sigma)
    return Matches(
        points0=points0,
        points1=points1,
        scores=np.ones(len(points0)) if scores is None else np.array(scores),
        sigmas0=sigmas,
        sigmas1=sigmas,
    )


A, B, C = [[10.5, 10.5], [40.0, 80.0]], [[20.5, 12.5], [50.0, 82.0]], [[31.5, 9.5], [61.0, 79.0]]


def test_three_images_with_exact_points_share_their_keypoints():
    merged = merge_keypoints({("a", "b"): matches(A, B), ("a", "c"): matches(A, C), ("b", "c"): matches(B, C)})
    for name, points in zip("abc", (A, B, C), strict=True):
        np.testing.assert_allclose(merged.keypoints[name], points, atol=1e-6)
    for pair in merged.matches:
        assert merged.matches[pair].dtype == np.uint32
        np.testing.assert_array_equal(merged.matches[pair], [[0, 0], [1, 1]])
        np.testing.assert_array_equal(merged.scores[pair], [1, 1])
    assert (merged.num_raw, merged.num_duplicates, merged.num_conflicts, merged.num_inconsistent) == (6, 0, 0, 0)


def test_a_match_is_dropped_whose_keypoint_lies_in_masked_ground(tmp_path):
    raw = [(("a", "b"), matches(A, B), None), (("a", "c"), matches(A, C), None), (("b", "c"), matches(B, C), None)]
    masks = {"a": np.ones((100, 50), bool), "b": None, "c": np.ones((90, 61), bool)}  # the second of c is at x = 61
    masks["a"][10, 10] = False
    for limit in (1.0, 0.0):
        options = KeypointOptions(max_residual_sigmas=limit)
        with merging(raw, tmp_path, options, masks=masks.get) as merged:
            np.testing.assert_allclose(merged.keypoints["a"], A[1:], atol=1e-6)
            np.testing.assert_allclose(merged.keypoints["b"], B, atol=1e-6)
            np.testing.assert_allclose(merged.keypoints["c"], C[:1], atol=1e-6)
            assert {pair: rows.tolist() for pair, rows in merged.matches.items()} == {
                ("a", "b"): [[0, 1]],
                ("a", "c"): [],
                ("b", "c"): [[0, 0]],
            }
            assert (merged.num_matches, merged.num_inconsistent) == (2, 4)


def test_a_cluster_is_the_mean_weighted_by_score_over_sigma_squared():
    keypoints, index = merge_image(
        np.array([[10.0, 10.0], [10.3, 10.0]]), np.array([1.0, 1.2]), np.array([0.5, 0.72]), radius_px=0.5
    )
    np.testing.assert_array_equal(index, [0, 0])
    np.testing.assert_allclose(keypoints, [[10.15, 10.0]])  # 0.5 / 1 and 0.72 / 1.44 weigh the same


def test_a_coarse_point_joins_a_fine_cluster_without_moving_it():
    keypoints, index = merge_image(
        np.array([[13.0, 10.0], [10.0, 10.0]]), np.array([4.0, 1.0]), np.array([1.0, 0.1]), radius_px=1.0
    )
    np.testing.assert_array_equal(index, [0, 0])
    np.testing.assert_array_equal(keypoints, [[10.0, 10.0]])


def test_two_fine_points_near_each_other_stay_two_although_a_coarse_one_is_near_both():
    keypoints, index = merge_image(
        np.array([[10.0, 10.0], [12.0, 10.0], [11.2, 10.0]]), np.array([1.0, 1.0, 4.0]), np.ones(3), radius_px=1.0
    )
    np.testing.assert_array_equal(keypoints, [[10.0, 10.0], [12.0, 10.0]])
    np.testing.assert_array_equal(index, [0, 1, 1])


def test_the_densest_spot_becomes_the_cluster():
    points = np.array([[10.0, 0.0], [10.9, 0.0], [10.9, 0.0], [11.8, 0.0]])
    keypoints, index = merge_image(points, np.ones(4), np.ones(4), radius_px=1.0)
    np.testing.assert_array_equal(index, [0, 0, 0, 0])
    np.testing.assert_allclose(keypoints, [[10.9, 0.0]])


def test_a_weaker_match_that_would_put_two_spots_of_an_image_into_a_track_is_refused():
    pairs = {
        ("a", "b"): matches([[10, 10]], [[20, 10]], [0.9]),
        ("b", "c"): matches([[20, 10]], [[30, 10]], [0.8]),
        ("a", "c"): matches([[60, 10]], [[30, 10]], [0.3]),
    }
    merged = merge_keypoints(pairs)
    assert merged.num_conflicts == 1
    assert len(merged.matches["a", "c"]) == 0
    np.testing.assert_allclose(merged.keypoints["a"], [[10, 10]])


def test_an_inlier_joins_before_a_stronger_outlier():
    pairs = {
        ("a", "b"): matches([[10, 10]], [[20, 10]], [0.9]),
        ("b", "c"): matches([[20, 10]], [[30, 10]], [0.8]),
        ("a", "c"): matches([[60, 10]], [[30, 10]], [0.3]),
    }
    inliers = {("a", "b"): np.array([False]), ("b", "c"): np.array([True]), ("a", "c"): np.array([True])}
    merged = merge_keypoints(pairs, inliers=inliers)
    assert len(merged.matches["a", "b"]) == 0
    np.testing.assert_allclose(merged.keypoints["a"], [[60, 10]])


def test_of_matches_from_one_keypoint_to_two_the_better_one_is_kept():
    merged = merge_keypoints({("a", "b"): matches([[10, 10], [10, 10]], [[20, 10], [70, 10]], [0.4, 0.7])})
    np.testing.assert_allclose(merged.keypoints["b"], [[70, 10]])
    np.testing.assert_array_equal(merged.matches["a", "b"], [[0, 0]])
    np.testing.assert_allclose(merged.scores["a", "b"], [0.7])
    assert merged.num_conflicts == 1


def test_repeated_matches_become_one_with_the_best_score():
    merged = merge_keypoints({("a", "b"): matches([[10, 10], [10, 10]], [[20, 10], [20, 10]], [0.4, 0.7])})
    np.testing.assert_allclose(merged.scores["a", "b"], [0.7])
    assert merged.num_duplicates == 1


def test_tracks_side_by_side_are_joined_only_when_enough_images_show_both():
    # b sees the spot 2 px further right for c than for a, and so does every image: two tracks, one spot.
    left, right = {"a": 10.0, "b": 20.0, "c": 30.0}, {"a": 12.0, "b": 22.0, "d": 42.0}

    def match(track, first, second):
        return matches([[track[first], 5.0]], [[track[second], 5.0]])

    pairs = {
        ("a", "b"): Matches.concatenate([match(left, "a", "b"), match(right, "a", "b")]),
        ("b", "c"): match(left, "b", "c"),
        ("b", "d"): match(right, "b", "d"),
    }
    joined = merge_keypoints(pairs, KeypointOptions(track_radius_px=3, min_shared_images=2))
    assert {name: len(points) for name, points in joined.keypoints.items()} == {"a": 1, "b": 1, "c": 1, "d": 1}
    spot = {name: float(points[0, 0]) for name, points in joined.keypoints.items()}
    # One spot between both: every image keeps its distance to the others, so no match is stretched.
    assert spot["b"] - spot["a"] == pytest.approx(10, abs=1e-3)
    assert spot["c"] - spot["b"] == pytest.approx(10, abs=0.02)
    assert spot["d"] - spot["b"] == pytest.approx(20, abs=0.02)
    assert 10.5 < spot["a"] < 11.5
    for options in (KeypointOptions(track_radius_px=3, min_shared_images=3), KeypointOptions(track_radius_px=1)):
        assert len(merge_keypoints(pairs, options).keypoints["b"]) == 2


def test_a_track_keeps_the_finer_of_two_keypoints_that_become_one():
    points = np.array([[10.0, 10.0], [12.0, 10.0], [50.0, 50.0]])
    tracks = Tracks(points, np.array([0, 0, 1]), np.array([3.0, 1.0, 1.0]), 1.0)
    tracks.join(np.array([[0, 2], [1, 2]]))
    _, standing, track = tracks.linked(np.repeat([[0], [1], [2]], 2, axis=1))
    assert len(set(track.tolist())) == 1
    np.testing.assert_array_equal(standing, [[1, 1], [1, 1], [2, 2]])


def test_a_match_far_from_its_aligned_keypoints_is_dropped():
    steps = np.array([[0.0, 0.0], [4.0, 0.0]])
    pairs = {("a", "b"): matches(steps + 10, steps * [[1, 1], [2, 1]] + 20)}  # b is 4 px out for the second match
    options = KeypointOptions(cluster_radius_px=0.1, track_radius_px=9, min_shared_images=2, max_residual_sigmas=1)
    assert len(merge_keypoints(pairs, options).matches["a", "b"]) == 0
    kept = merge_keypoints(pairs, KeypointOptions(cluster_radius_px=0.1, track_radius_px=9, max_residual_sigmas=0))
    assert len(kept.matches["a", "b"]) == 1


def test_local_affine_recovers_a_rotation_with_zoom_despite_outliers():
    rng = np.random.default_rng(0)
    points0 = rng.uniform(0, 200, (200, 2))
    linear = np.array([[0.0, -2.0], [2.0, 0.0]])
    points1 = points0 @ linear.T + 7
    points1[:10] += 500
    np.testing.assert_allclose(np.median(local_affine(points0, points1, np.ones(200, bool)), axis=0), linear, atol=0.02)


def test_local_affine_of_three_matches_is_the_identity():
    np.testing.assert_array_equal(
        local_affine(np.eye(3)[:, :2], np.ones((3, 2)), np.ones(3, bool)), np.tile(np.eye(2), (3, 1, 1))
    )


def test_align_keypoints_weighs_by_variance_and_carries_matches_along_the_affine_map():
    # x1 = 5 + 2 (x0 - 1) with x0 held at 1.5 by a hundredfold weight of its own point: x1 = 6.
    keypoints, index, affine = np.array([[1.5, 0.0], [5.0, 0.0]]), np.array([[0, 1]]), np.array([[2.0, 0.0, 0.0, 2.0]])
    match, slots = np.array([[1.0, 0.0, 5.0, 0.0]]), np.full(2, -1)
    offsets = offsets_of(keypoints, index, match, affine)
    np.testing.assert_allclose(offsets, [[-1.0, 0.0]])
    sigmas, track, weight = np.array([1e-3, 1e3]), np.array([7]), np.array([1.0])
    align_keypoints(keypoints, sigmas, slots, index, track, offsets, affine, weight)
    np.testing.assert_allclose(keypoints, [[1.5, 0.0], [6.0, 0.0]], atol=1e-3)
    np.testing.assert_allclose(offsets_of(keypoints, index, match, affine), [[0.0, 0.0]], atol=1e-3)
    np.testing.assert_array_equal(slots, [-1, -1])


def test_empty_pairs_and_an_empty_collection_give_empty_keypoints():
    merged = merge_keypoints({("a", "b"): Matches.empty(), ("b", "c"): matches([[1, 2]], [[3, 4]])})
    assert merged.keypoints["a"].shape == (0, 2)
    assert merged.matches["a", "b"].shape == (0, 2)
    np.testing.assert_array_equal(merged.matches["b", "c"], [[0, 0]])
    assert merge_keypoints({}).keypoints == {}
    assert merge_keypoints({("a", "b"): Matches.empty()}).num_raw == 0


def test_wrong_input_is_named():
    with pytest.raises(InputError, match=r"^pair \('a', 'a'\) matches an image with itself; remove it from the pairs$"):
        merge_keypoints({("a", "a"): Matches.empty()})
    with pytest.raises(InputError, match=r"^the pair of 'a' and 'b' comes in both orders; keep one of them$"):
        merge_keypoints({("a", "b"): Matches.empty(), ("b", "a"): Matches.empty()})
    with pytest.raises(ShapeError, match=r"are bool \(2,\); expected bool \(0,\), one per match$"):
        merge_keypoints({("a", "b"): Matches.empty()}, inliers={("a", "b"): np.ones(2, bool)})
    with pytest.raises(OptionError, match=r"^cluster_radius_px is 0; expected a positive number$"):
        KeypointOptions(cluster_radius_px=0)
    with pytest.raises(OptionError, match=r"^track_radius_px is -1; expected 0 \(off\) or a positive number$"):
        KeypointOptions(track_radius_px=-1)


def test_keypoints_are_measured_again_in_the_photos(tmp_path):
    size = (320, 240)
    warps = {
        "a": np.eye(3),
        "b": similarity(1.15, 8, (6.4, -3.3), (160, 120)),
        "c": similarity(0.9, -6, (-4.7, 5.6), (160, 120)),
    }
    photos = {name: view(warp, size)[..., 0] for name, warp in warps.items()}
    spots = np.stack(np.meshgrid(np.arange(50, 270, 9), np.arange(50, 190, 9)), -1).reshape(-1, 2) + 0.5
    rng = np.random.default_rng(0)
    noisy = {name: transfer(warp, spots) + rng.normal(0, 0.5, spots.shape) for name, warp in warps.items()}
    pairs = [
        ((one, other), matches(noisy[one], noisy[other], sigma=2.0), None)
        for one, other in (("a", "b"), ("a", "c"), ("b", "c"))
    ]

    def error(options):
        with merging(pairs, tmp_path, options, photos.__getitem__) as merged:
            index = merged.matches["a", "b"]
            points0, points1 = (merged.keypoints[name][index[:, side]] for side, name in enumerate("ab"))
        distances = np.linalg.norm(transfer(warps["b"], points0) - points1, axis=1)
        return len(index), float(np.median(distances))

    before, after = (error(KeypointOptions(refine=refine)) for refine in (False, True))
    assert after[0] > 0.9 * before[0] > 100
    assert before[1] > 0.3
    assert after[1] < 0.1  # of which the local maps between noisy matches are most


def test_local_maps_are_exact_for_matches_in_the_order_of_a_grid():
    spots = np.stack(np.meshgrid(np.arange(50.0, 270, 9), np.arange(50.0, 190, 9)), -1).reshape(-1, 2)
    warp = similarity(1.15, 8, (6.4, -3.3), (160, 120))
    maps = local_affine(spots, transfer(warp, spots), np.ones(len(spots), bool))
    np.testing.assert_allclose(maps, np.broadcast_to(warp[:2, :2], maps.shape), atol=5e-3)


def test_a_match_far_from_all_trusted_ones_follows_the_map_of_the_whole_pair():
    points0, turn = np.random.default_rng(0).uniform(0, 1000, (400, 2)), np.array([[0.0, -1.5], [1.5, 0.0]])
    points0[0] = 500
    trusted = np.linalg.norm(points0 - 500, axis=1) > 300
    points1 = np.where(trusted[:, None], points0 @ turn.T + 5, 0)
    np.testing.assert_allclose(local_affine(points0, points1, trusted)[0], turn, atol=0.01)


def test_local_maps_of_coinciding_and_of_collinear_matches_are_finite():
    for points in (np.full((20, 2), 7.0), np.column_stack([np.arange(20.0), np.full(20, 3.0)])):
        maps = local_affine(points, points + 4, np.ones(20, bool))
        np.testing.assert_allclose(maps, np.broadcast_to(np.eye(2), maps.shape), atol=1e-6)


def test_more_keypoints_than_have_numbers_are_told(monkeypatch):
    monkeypatch.setattr("sgam_sfm.merging.merge._MOST_KEYPOINTS", 2)
    with pytest.raises(InputError, match=r"^matches have more than 2 keypoints in 2 of 2 images; match the"):
        merge_keypoints({("a", "b"): matches(A, B)})
