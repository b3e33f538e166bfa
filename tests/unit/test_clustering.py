import numpy as np
import pytest

from sgam_sfm.segmenters.clustering import adjusted_rand_index, kmeans, principal_components, stable_clusters


def blobs(num_blobs: int, per_blob: int = 60, spread: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Points about the corners of a simplex, and the blob each belongs to."""
    rng = np.random.default_rng(5)
    truth = np.repeat(np.arange(num_blobs), per_blob)
    points = 10 * np.eye(num_blobs)[truth] + spread * rng.standard_normal((len(truth), num_blobs))
    return points.astype(np.float32), truth


def test_adjusted_rand_index_by_hand():
    """Table [[2, 1], [0, 2]]: pairs together 1 + 1 = 2; 3 + 1 = 4 and 1 + 3 = 4 by margins; expected 4 * 4 / 10."""
    labels0, labels1 = np.array([0, 0, 0, 1, 1]), np.array([0, 0, 1, 1, 1])
    assert adjusted_rand_index(labels0, labels1) == pytest.approx((2 - 1.6) / (4 - 1.6))


def test_adjusted_rand_index_of_renamed_and_of_single_clusters():
    labels = np.array([0, 1, 1, 2, 2, 2])
    assert adjusted_rand_index(labels, np.array([3, 0, 0, 1, 1, 1])) == pytest.approx(1)
    assert adjusted_rand_index(np.zeros(4, int), np.zeros(4, int)) == 1


def test_adjusted_rand_index_of_unrelated_partitions_is_about_zero():
    rng = np.random.default_rng(0)
    assert abs(adjusted_rand_index(rng.integers(0, 5, 5000), rng.integers(0, 5, 5000))) < 0.01


def test_kmeans_finds_separate_blobs():
    points, truth = blobs(4)
    clusters = kmeans(points, 4, np.random.default_rng(0))
    assert adjusted_rand_index(clusters.assignment, truth) == pytest.approx(1)
    for blob in range(4):
        center = clusters.centers[clusters.assignment[truth == blob][0]]
        np.testing.assert_allclose(center, points[truth == blob].mean(axis=0), atol=1e-5)
    expected = sum(np.square(points[truth == b] - points[truth == b].mean(axis=0)).sum() for b in range(4))
    assert clusters.inertia == pytest.approx(expected, rel=1e-4)


def test_kmeans_of_fewer_or_equal_points():
    points = np.arange(6, dtype=np.float32).reshape(3, 2)
    assert sorted(kmeans(points, 8, np.random.default_rng(0)).assignment) == [0, 1, 2]
    same = kmeans(np.ones((5, 2), np.float32), 3, np.random.default_rng(0))
    assert same.inertia == 0
    assert len(set(same.assignment)) == 1


def test_stable_clusters_choose_the_true_number():
    points, truth = blobs(5)
    clusters, agreement = stable_clusters(points, (3, 4, 5, 7, 9), num_runs=4, tolerance=0.02, seed=0)
    assert len(clusters.centers) == 5
    assert adjusted_rand_index(clusters.assignment, truth) == pytest.approx(1)
    assert agreement[5] == pytest.approx(1)
    assert list(agreement) == [3, 4, 5, 7, 9]
    assert max(agreement[k] for k in (3, 4, 7, 9)) < 0.95


def test_principal_components_keep_distances_within_the_subspace():
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.standard_normal((12, 3)))[0]
    samples = (rng.standard_normal((200, 3)) @ basis.T + rng.standard_normal(12)).astype(np.float32)
    project = principal_components(samples, 3)
    assert project.basis.shape == (12, 3)
    projected = project(samples)
    np.testing.assert_allclose(projected.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(
        np.linalg.norm(projected[0] - projected[1:], axis=1),
        np.linalg.norm(samples[0] - samples[1:], axis=1),
        rtol=1e-4,
    )
    assert np.all(np.diff(projected.var(axis=0)) < 0)
