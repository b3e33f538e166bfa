import itertools
from unittest import mock

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sgam_core.types import Matches
from sgam_sfm.merging.keypoints import CollectionKeypoints, KeypointOptions
from sgam_sfm.merging.merge import merge_keypoints
from sgam_sfm.merging.tracks import Tracks

NAMES = ("a", "b", "c", "d")


@st.composite
def collections(draw):
    """Crowded points of mixed sigma, right and wrong matches: every rule has something to do."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spots = rng.uniform(0, draw(st.sampled_from([15.0, 60.0])), (12, 2))
    pairs = {}
    for pair in itertools.combinations(NAMES, 2):
        count = draw(st.integers(0, 12))
        noise = rng.normal(0, 0.5, (2, count, 2)).round(1)
        shown = rng.integers(0, len(spots), (2, count))
        shown[1] = np.where(rng.random(count) < 0.8, shown[0], shown[1])
        points = spots[shown] + noise
        sigmas = rng.choice([1.0, 1.5, 4.0], (2, count))
        pairs[pair] = Matches(
            points0=points[0], points1=points[1], scores=rng.random(count), sigmas0=sigmas[0], sigmas1=sigmas[1]
        )
    return pairs


options = st.builds(
    KeypointOptions,
    cluster_radius_px=st.sampled_from([0.1, 0.33, 2.0]),
    track_radius_px=st.sampled_from([0.0, 2.0, 6.0]),
    min_shared_images=st.integers(0, 3),
    max_residual_sigmas=st.sampled_from([0.0, 1.0]),
)


def tracks(merged: CollectionKeypoints) -> list[list[tuple[str, int]]]:
    """Connected keypoints, by flooding: shares nothing with the union-find under test."""
    linked: dict[tuple[str, int], set[tuple[str, int]]] = {}
    for (a, b), rows in merged.matches.items():
        for i, j in rows.tolist():
            linked.setdefault((a, i), set()).add((b, j))
            linked.setdefault((b, j), set()).add((a, i))
    found = []
    while linked:
        track, front = [], {next(iter(linked))}
        while front:
            track += front
            front = {n for node in front for n in linked.pop(node)} & linked.keys()
        found.append(track)
    return found


@settings(max_examples=60, deadline=None)
@given(collections(), options)
def test_what_colmap_needs_holds(pairs, options):
    merged = merge_keypoints(pairs, options)
    for (a, b), rows in merged.matches.items():
        assert (rows < [[len(merged.keypoints[a]), len(merged.keypoints[b])]]).all()
        assert len(np.unique(rows[:, 0])) == len(np.unique(rows[:, 1])) == len(rows)
        assert len(merged.scores[a, b]) == len(rows)
    for track in tracks(merged):
        assert len({name for name, _ in track}) == len(track)
    matched = {node for track in tracks(merged) for node in track}
    assert matched == {(name, row) for name, points in merged.keypoints.items() for row in range(len(points))}
    assert all(np.isfinite(points).all() for points in merged.keypoints.values())
    exported = sum(map(len, merged.matches.values()))
    dropped = merged.num_duplicates + merged.num_conflicts + merged.num_inconsistent
    assert exported + dropped == merged.num_raw == sum(map(len, pairs.values()))


@settings(max_examples=30, deadline=None)
@given(collections(), st.permutations(list(itertools.combinations(NAMES, 2))), st.sets(st.integers(0, 5)))
def test_the_order_of_pairs_changes_nothing_and_a_reversed_pair_has_reversed_matches(pairs, order, reversed_rows):
    expected = merge_keypoints(pairs)
    shuffled = {}
    for row, pair in enumerate(order):
        shuffled[pair[::-1] if row in reversed_rows else pair] = (
            pairs[pair].swapped() if row in reversed_rows else pairs[pair]
        )
    merged = merge_keypoints(shuffled)
    for name in expected.keypoints:
        np.testing.assert_array_equal(merged.keypoints[name], expected.keypoints[name])
    for (a, b), rows in merged.matches.items():
        np.testing.assert_array_equal(rows, expected.matches[a, b] if a < b else expected.matches[b, a][:, ::-1])
        np.testing.assert_array_equal(merged.scores[a, b], expected.scores[min(a, b), max(a, b)])


@settings(max_examples=15, deadline=None)
@given(collections(), st.integers(1, 40), st.integers(1, 40))
def test_the_size_of_the_pieces_changes_nothing(pairs, matches_at_once, rows_a_part):
    expected = merge_keypoints(pairs)
    with (
        mock.patch("sgam_sfm.merging.raw._AT_ONCE", matches_at_once),
        mock.patch("sgam_sfm.merging.linking.ROWS_A_PART", rows_a_part),
        mock.patch("sgam_sfm.merging.settling.ROWS_A_PART", rows_a_part),
        mock.patch("sgam_sfm.merging.scratch._BUFFERED", 8 * rows_a_part),
        mock.patch("sgam_sfm.merging.scratch._ROWS_AT_ONCE", rows_a_part),
    ):
        merged = merge_keypoints(pairs)
    for name in expected.keypoints:
        np.testing.assert_array_equal(merged.keypoints[name], expected.keypoints[name])
    for pair in expected.matches:
        np.testing.assert_array_equal(merged.matches[pair], expected.matches[pair])
        np.testing.assert_array_equal(merged.scores[pair], expected.scores[pair])


@settings(max_examples=30, deadline=None)
@given(collections(), st.sampled_from([0.5, 2.0, 8.0]))
def test_a_larger_image_with_a_larger_sigma_gives_the_same_tracks(pairs, zoom):
    expected = merge_keypoints(pairs, KeypointOptions(max_residual_sigmas=0))
    zoomed = {
        pair: Matches(
            points0=m.points0 * zoom,
            points1=m.points1 * zoom,
            scores=m.scores,
            sigmas0=m.sigmas0 * zoom,
            sigmas1=m.sigmas1 * zoom,
        )
        for pair, m in pairs.items()
    }
    merged = merge_keypoints(zoomed, KeypointOptions(max_residual_sigmas=0))
    for pair, rows in expected.matches.items():
        np.testing.assert_array_equal(merged.matches[pair], rows)
    for name, points in expected.keypoints.items():
        np.testing.assert_allclose(merged.keypoints[name], points * zoom, atol=1e-3 * zoom)


def one_after_the_other(points, images, sigmas, edges, radius):
    """What `Tracks.join` and `join_tracks` must come to, edge by edge: track and standing keypoint of every keypoint.

    edges: (a, b, images that both tracks must be in).
    """
    root, stands = list(range(len(images))), list(range(len(images)))
    members = [{image: keypoint} for keypoint, image in enumerate(images.tolist())]
    for a, b, min_shared in edges:
        if (a := root[a]) == (b := root[b]):
            continue
        a, b = (b, a) if len(members[a]) < len(members[b]) else (a, b)
        shared = [(members[a][image], members[b][image]) for image in members[a].keys() & members[b].keys()]
        near = [np.linalg.norm(points[p] - points[q]) <= radius * max(sigmas[p], sigmas[q]) for p, q in shared]
        if len(shared) < min_shared or not all(near):
            continue
        members[a] = members[b] | members[a]
        for p, q in shared:
            stays, goes = (q, p) if sigmas[q] < sigmas[p] else (p, q)
            stands = [stays if keypoint == goes else keypoint for keypoint in stands]
            members[a][int(images[p])] = stays
        root = [a if track == b else track for track in root]
    return root, stands


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 2**26]))
def test_joining_is_what_it_says(seed, most_rearranged):
    rng = np.random.default_rng(seed)
    count, num_images, num_edges = (int(rng.integers(1, top)) for top in (60, 8, 120))
    points, images = rng.uniform(0, rng.choice([5, 20, 100]), (count, 2)), rng.integers(0, num_images, count)
    sigmas, radius = rng.choice([1.0, 1.0, 2.0], count), float(rng.choice([0, 2, 5]))
    edges, half = rng.integers(0, count, (num_edges, 2)), num_edges // 2
    made = Tracks(points, images, sigmas, radius)
    made.join(edges[:half])
    with mock.patch("sgam_sfm.merging.tracks._MOST_REARRANGED", most_rearranged):
        made.join_tracks(np.array_split(edges[half:], 2), min_shared=1)
    needed = [(a, b, int(row >= half)) for row, (a, b) in enumerate(edges.tolist())]
    root, stands = one_after_the_other(points, images, sigmas, needed, radius)
    kept, standing, track = made.linked(np.repeat(np.arange(count)[:, None], 2, axis=1))
    np.testing.assert_array_equal(kept, np.arange(count))
    np.testing.assert_array_equal(track, root)
    np.testing.assert_array_equal(standing, np.column_stack([stands, stands]))
