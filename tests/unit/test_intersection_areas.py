import numpy as np
import pytest

from sgam_core.intersection_areas import (
    LabelCounts,
    detect_intersection_areas,
    match_intersection_areas,
    window_sizes,
)
from sgam_core.options import IntersectionAreaOptions

OPTIONS = IntersectionAreaOptions()


def corner(x: int, y: int) -> np.ndarray:
    """Four labels that meet at (x, y) in a 640 x 480 map."""
    labels = np.ones((480, 640), np.int32)
    labels[:y, x:], labels[y:, :x], labels[y:, x:] = 2, 3, 4
    return labels


def test_proportions_equal_a_plain_count():
    labels = np.random.default_rng(0).integers(0, 5, (427, 640)).astype(np.int32)
    counts = LabelCounts.of(labels)
    found = counts.proportions(*(np.array([v]) for v in (10, 20, 75, 90)))[0]
    window = labels[80:360, 40:300]
    np.testing.assert_allclose(found, [(window == k).mean() for k in counts.ids])
    beyond = counts.proportions(*(np.array([v]) for v in (-5, -5, 500, 500)))[0]
    np.testing.assert_allclose(beyond, [(labels == k).mean() for k in counts.ids])


def test_a_window_settles_where_the_labels_meet_evenly():
    found = detect_intersection_areas(LabelCounts.of(corner(300, 240)), 256, OPTIONS)
    assert len(found) == 1
    assert found[0].box.center == pytest.approx((300, 240), abs=4)
    np.testing.assert_allclose(found[0].proportions, [0.25] * 4, atol=0.02)


def test_windows_stay_inside_and_need_enough_labels():
    for area in detect_intersection_areas(LabelCounts.of(corner(40, 30)), 256, OPTIONS):
        assert area.box.x0 >= 0
        assert area.box.y0 >= 0
        assert area.box.x1 <= 640
        assert area.box.y1 <= 480
    two = np.ones((480, 640), np.int32)
    two[:, 320:] = 2
    assert detect_intersection_areas(LabelCounts.of(two), 256, OPTIONS) == ()


def test_void_is_content_but_no_label():
    labels = corner(300, 240)
    labels[labels >= 3] = 0
    assert detect_intersection_areas(LabelCounts.of(labels), 256, OPTIONS) == ()


def test_the_same_corner_is_found_and_matched_in_another_view():
    counts0, counts1 = LabelCounts.of(corner(300, 240)), LabelCounts.of(corner(380, 200))
    areas0, areas1 = (detect_intersection_areas(counts, 256, OPTIONS) for counts in (counts0, counts1))
    certain, doubtful, distances = match_intersection_areas(counts0, counts1, areas0, areas1, OPTIONS)
    assert certain == [(0, 0)]
    assert doubtful == []
    assert distances[0, 0] < 0.05


def test_labels_of_one_image_only_separate_windows():
    other = np.where(corner(300, 240) == 4, 9, corner(300, 240)).astype(np.int32)
    counts0, counts1 = LabelCounts.of(corner(300, 240)), LabelCounts.of(other)
    areas0, areas1 = (detect_intersection_areas(counts, 256, OPTIONS) for counts in (counts0, counts1))
    _, _, distances = match_intersection_areas(counts0, counts1, areas0, areas1, OPTIONS)
    assert distances[0, 0] == np.inf  # sqrt(2) / 4 = 0.35 apart, above 0.25


def test_windows_follow_the_scale_and_keep_its_ratio_where_they_do_not_fit():
    wide = LabelCounts.of(np.ones((640, 640), np.int32))
    assert window_sizes(wide, wide, 1.0, OPTIONS) == (256, 256)
    assert window_sizes(wide, wide, 2.0, OPTIONS) == (512, 256)
    assert window_sizes(wide, wide, 0.5, OPTIONS) == (256, 512)
    large, small = window_sizes(wide, wide, 3.0, OPTIONS)
    assert large == pytest.approx(576)  # 0.9 x 640
    assert large / small == pytest.approx(3.0)
    assert window_sizes(wide, wide, 100.0, OPTIONS) == window_sizes(wide, wide, 4.0, OPTIONS)
