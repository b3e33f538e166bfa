"""How pairs are chosen: by order, by descriptors, by shared points, by poses; hand-made truth."""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own)
from itertools import combinations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from sgam_core import Box
from sgam_sfm.evaluation.ground_truth import TrueView
from sgam_sfm.pair_lists.covisibility import shared_point_scores
from sgam_sfm.pair_lists.graph import connected_parts
from sgam_sfm.pair_lists.ranking import best_partners, cosine_scores
from sgam_sfm.pair_lists.sequences import beyond, find_sequences, following
from sgam_sfm.pair_lists.shared_view import shared_view_scores, typical_depth
from tests.room import Room


def ranked(scores, num: int = 0, min_score: float = -np.inf, rows=None) -> list[tuple[int, int]]:
    scores = np.array(scores, np.float32)
    rows = np.arange(len(scores)) if rows is None else np.array(rows)
    found = best_partners(rows, lambda block: scores[block].copy(), num, min_score, lambda amount: None)
    return [tuple(pair) for pair in found.tolist()]


SCORES = [[9, 0.9, 0.1, 0.2], [0.9, 9, 0.5, 0.3], [0.1, 0.5, 9, 0.4], [0.2, 0.3, 0.4, 9]]


def test_a_pair_stands_when_either_image_chose_the_other_and_none_with_itself():
    assert ranked(SCORES, num=1) == [(0, 1), (1, 2), (2, 3)]
    assert ranked(SCORES, num=1, min_score=0.5) == [(0, 1), (1, 2)]
    assert ranked(SCORES, min_score=0.3) == [(0, 1), (1, 2), (1, 3), (2, 3)]
    assert ranked(SCORES) == list(combinations(range(4), 2))
    assert ranked(SCORES, num=1, rows=[3]) == [(2, 3)]


def test_equal_scores_prefer_the_earlier_image_and_unwanted_pairs_never_come():
    assert ranked(np.zeros((5, 5)), num=1) == [(0, 1), (0, 2), (0, 3), (0, 4)]
    assert ranked(np.full((3, 3), -np.inf), num=2) == []


def test_blocks_of_rows_make_the_list_that_one_block_makes(monkeypatch):
    scores = np.random.default_rng(0).normal(size=(50, 50))
    expected = ranked(scores, num=4)
    told = []
    monkeypatch.setattr("sgam_sfm.pair_lists.ranking._BLOCK", 7)
    sizes = []

    def scores_of(block):
        sizes.append(len(block))
        return scores[block].astype(np.float32)

    found = best_partners(np.arange(50), scores_of, 4, -np.inf, told.append)
    assert [tuple(pair) for pair in found.tolist()] == expected
    assert max(sizes) == 7
    assert sum(told) == 50


def test_cosine_similarity_ignores_length_and_bears_zeros():
    scores = cosine_scores(np.array([[2, 0], [5, 5], [0, -1], [0, 0]], np.float32))(np.array([0, 3]))
    np.testing.assert_allclose(scores, [[1, 0.70711, 0, 0], [0, 0, 0, 0]], atol=1e-5)


def test_frames_are_ordered_by_the_value_of_their_numbers_folder_by_folder():
    names = ("b/frame10.jpg", "b/frame2.jpg", "frame02.jpg", "frame1.jpg", "frame10.jpg", "frame2.jpg", "x.jpg")
    ordered = [[names[row] for row in sequence] for sequence in find_sequences(names)]
    assert ordered == [
        ["b/frame2.jpg", "b/frame10.jpg"],
        ["frame1.jpg", "frame02.jpg", "frame2.jpg", "frame10.jpg", "x.jpg"],
    ]


@pytest.mark.parametrize("overlap", [1, 3, 20])
@pytest.mark.parametrize("quadratic", [False, True])
def test_sequential_pairs_are_colmaps(tmp_path, overlap, quadratic):
    count = 15
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        camera_id = database.write_camera(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 64, 48))
        for number in range(1, count + 1):
            image = pycolmap.Image(name=f"{number:03}.jpg", camera_id=camera_id, image_id=number)
            database.write_image(image)
        options = pycolmap.SequentialPairingOptions()
        options.overlap, options.quadratic_overlap = overlap, quadratic
        level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 3
        expected = pycolmap.SequentialPairGenerator(options, database).all_pairs()
        pycolmap.logging.minloglevel = level
    found = following(np.arange(1, count + 1), overlap, quadratic=quadratic)
    assert sorted(map(tuple, found.tolist())) == sorted(map(tuple, expected))


def test_loops_are_looked_for_beyond_neighbours():
    sequences = [np.array([0, 2, 4]), np.array([1, 3])]
    scores = beyond(lambda rows: np.ones((len(rows), 5), np.float32), sequences, 1)(np.array([2, 3]))
    np.testing.assert_array_equal(np.isfinite(scores), [[0, 1, 0, 1, 0], [1, 0, 1, 0, 1]])


def test_shared_points_are_counted():
    seen = [np.array(ids, np.int64) for ids in ([7, 8, 9], [8, 9, 10], [], [2**40, 9])]
    scores = shared_point_scores(seen)(np.array([0, 2, 3]))
    np.testing.assert_array_equal(scores, [[3, 2, 0, 1], [0, 0, 0, 0], [1, 1, 0, 2]])
    np.testing.assert_array_equal(shared_point_scores([seen[2]] * 2)(np.array([1])), [[0, 0]])


def test_connected_parts_of_pairs():
    pairs = [("d", "e"), ("a", "b"), ("f", "e")]
    assert connected_parts(pairs) == [("d", "e", "f"), ("a", "b")]
    assert connected_parts([]) == []


def camera(name: str, centre, turn_deg: float = 0.0) -> TrueView:
    """100 x 100 pixels, 90 degrees wide, looking along +z turned about y."""
    R = Rotation.from_euler("y", -turn_deg, degrees=True).as_matrix()
    return TrueView(
        name=name,
        width=100,
        height=100,
        camera_matrix=np.array([[50.0, 0, 50], [0, 50, 50], [0, 0, 1]]),
        cam_from_world=np.column_stack([R, -R @ np.array(centre, float)]),
    )


def scores_of(*views: TrueView, depth: float = 1.0, max_rotation_deg: float = 60.0) -> np.ndarray:
    return shared_view_scores(views, depth, max_rotation_deg)(np.arange(len(views)))


def test_a_step_aside_costs_more_of_what_is_near():
    # A step of 1 is 3/2 of the view at depth 1/3, 1/2 at 1 and 1/6 at 3: of columns at 1/8, 3/8, 5/8, 7/8 none, two,
    # three remain.
    np.testing.assert_allclose(scores_of(camera("a", (0, 0, 0)), camera("b", (1, 0, 0)))[0], [1, 5 / 12])


def test_views_that_turn_away_are_no_pair():
    views = [
        camera("a", (0, 0, 0)),
        camera("b", (0, 0, 0), 50),
        camera("c", (0, 0, 0), 61),
        camera("d", (0, 0, 0), 180),
    ]
    scores = scores_of(*views)
    assert scores[0, 1] == 0.5  # of columns at -37, -14, 14 and 37 degrees those within 5 to 95
    assert scores[0, 2] == scores[0, 3] == -np.inf
    assert scores_of(*views, max_rotation_deg=180)[0, 3] == 0
    np.testing.assert_array_equal(scores, scores.T)


def test_the_depth_is_where_optical_axes_meet():
    ring = [
        camera(str(turn), (-4 * np.sin(np.radians(turn)), 0, -4 * np.cos(np.radians(turn))), turn)
        for turn in (0, 30, 55)
    ]
    assert typical_depth(ring) == pytest.approx(4)
    row = [camera(str(x), (x, 0, 0)) for x in (0, 1, 2, 3, 4)]
    assert typical_depth(row) == 1  # distances from the middle: 2, 1, 0, 1, 2
    assert typical_depth([camera("a", (5, 5, 5)), camera("b", (5, 5, 5), 30)]) == 1


def test_scores_from_poses_rank_the_pairs_of_the_room_as_their_surfaces_do(room: Room):
    names = sorted(room.views)
    views = [room.views[name] for name in names]
    posed = [
        TrueView(
            name=view.name,
            width=view.width,
            height=view.height,
            camera_matrix=view.camera_matrix,
            cam_from_world=view.cam_from_world,
        )
        for view in views
    ]
    assert 2 < typical_depth(posed) < 8  # the room is 6 m wide
    scores = scores_of(*posed, depth=typical_depth(posed))
    pairs = list(combinations(range(len(names)), 2))
    true = []
    for i, j in pairs:
        boxes = [Box(x0=0, y0=0, x1=view.width, y1=view.height) for view in (views[i], views[j])]
        true.append(room.overlap(names[i], boxes[0], names[j], boxes[1]))
    guessed = [max(scores[i, j], 0) for i, j in pairs]
    assert np.corrcoef(true, guessed)[0, 1] > 0.7
