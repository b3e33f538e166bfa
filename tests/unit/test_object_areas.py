import numpy as np
import pytest

from sgam_core.object_areas import (
    ObjectArea,
    border_labels,
    descriptor_distance,
    detect_object_areas,
    match_object_areas,
    scale_between,
)
from sgam_core.options import ObjectAreaOptions
from sgam_core.types import Box

OPTIONS = ObjectAreaOptions()


def labels(*blocks: tuple[int, int, int, int, int], background: int = 0) -> np.ndarray:
    """A 640 x 480 map of (label, x0, y0, x1, y1) blocks."""
    out = np.full((480, 640), background, np.int32)
    for label, x0, y0, x1, y1 in blocks:
        out[y0:y1, x0:x1] = label
    return out


def boxes(found) -> list[tuple]:
    return [(area.label, area.box.x0, area.box.y0, area.box.x1, area.box.y1) for area in found[0]]


def area(label: int, box: tuple[float, float, float, float], border=(), touches=False) -> ObjectArea:
    made = Box(x0=box[0], y0=box[1], x1=box[2], y1=box[3])
    return ObjectArea(
        label=label, box=made, border=frozenset(border), share=made.area / (640 * 480), touches_edge=touches
    )


def test_the_box_of_an_object_is_exact():
    assert boxes(detect_object_areas(labels((7, 100, 50, 300, 250)), (), OPTIONS)) == [(7, 100, 50, 300, 250)]


def test_void_ignored_and_small_labels_form_no_area():
    small = (3, 10, 10, 60, 70)  # 50 x 60 = 3000 < 1 % of 307200
    found = detect_object_areas(labels(small, (4, 100, 100, 200, 200), (5, 300, 100, 400, 200)), (5,), OPTIONS)
    assert [label for label, *_ in boxes(found)] == [4]


def test_near_objects_of_one_label_are_fused_and_far_ones_are_not():
    near = labels((2, 100, 100, 160, 180), (2, 190, 100, 250, 180))  # centres 90 px apart
    assert boxes(detect_object_areas(near, (), OPTIONS)) == [(2, 100, 100, 250, 180)]
    far = labels((2, 100, 100, 160, 180), (2, 220, 100, 280, 180))  # 120 px apart
    assert len(boxes(detect_object_areas(far, (), OPTIONS))) == 2


def test_long_boxes_are_dropped():
    assert boxes(detect_object_areas(labels((2, 10, 100, 630, 200)), (), OPTIONS)) == []


def test_limits_keep_the_largest_and_say_so():
    many = labels(*[(1, 10 + 130 * k, 10, 80 + 130 * k, 80 + 5 * k) for k in range(5)])
    found, notes = detect_object_areas(many, (), OPTIONS)
    assert [found_area.box.height for found_area in found] == [90, 85, 80, 75]
    assert notes == ("label 1: 5 areas, 4 kept (max_per_label)",)


def test_border_labels_need_a_long_run():
    scene = labels((2, 200, 200, 300, 300), background=1)
    scene[185:195, 200:219] = 3  # 19 px on the upper side at scale 1.2 (y = 190): too short
    scene[305:315, 200:220] = 4  # 20 px on the lower side (y = 309)
    found = border_labels(scene, Box(x0=200, y0=200, x1=300, y1=300), 20)
    assert found == {1, 2, 4}  # 2, its own, from the scale inside (0.8)


def test_sides_beyond_the_image_are_skipped():
    scene = labels((2, 0, 0, 100, 100), background=1)
    assert border_labels(scene, Box(x0=0, y0=0, x1=640, y1=480), 20) == {1, 2}  # only scale 0.8 is inside
    assert border_labels(np.full((480, 640), 5, np.int32), Box(x0=-200, y0=-200, x1=840, y1=680), 20) == frozenset()


def test_distance_counts_the_labels_of_the_pair_but_the_own_one():
    a, b = area(1, (0, 0, 100, 100), {2, 3}), area(1, (0, 0, 100, 100), {3, 4})
    pair = frozenset({1, 2, 3, 4, 5})
    assert descriptor_distance(a, b, pair, OPTIONS) == pytest.approx(2 / 4)
    assert descriptor_distance(a, b, pair, ObjectAreaOptions(distance="jaccard")) == pytest.approx(2 / 3)
    assert descriptor_distance(a, b, frozenset({1}), OPTIONS) == 0.0


def test_instances_are_told_apart_by_their_surroundings():
    left, right = area(1, (0, 0, 100, 100), {2}), area(1, (400, 0, 500, 100), {3})
    certain, doubtful, _ = match_object_areas([left, right], [right, left], frozenset({1, 2, 3}), OPTIONS)
    assert certain == [(0, 1), (1, 0)]
    assert doubtful == []


def test_instances_with_equal_surroundings_are_doubtful():
    twins = [area(1, (0, 0, 100, 100), {2}), area(1, (400, 0, 500, 100), {2})]
    certain, doubtful, _ = match_object_areas(twins, twins, frozenset({1, 2, 3}), OPTIONS)
    assert certain == []
    assert doubtful == [[(0, 0), (0, 1), (1, 0), (1, 1)]]


def test_an_area_that_fills_the_image_matches_only_a_much_smaller_one():
    whole, also_whole, small = area(1, (0, 0, 600, 480)), area(1, (0, 0, 620, 480)), area(1, (100, 100, 300, 300))
    assert match_object_areas([whole], [also_whole], frozenset({1}), OPTIONS)[0] == []
    assert match_object_areas([whole], [small], frozenset({1}), OPTIONS)[0] == [(0, 0)]
    assert match_object_areas([small], [whole], frozenset({1}), OPTIONS)[0] == [(0, 0)]


def test_a_match_far_from_the_common_scale_is_dropped():
    shown = [area(label, (0, 0, 100, 100)) for label in (1, 2, 3, 4)]
    twice = [area(label, (0, 0, 141, 141)) for label in (1, 2, 3)] + [area(4, (0, 0, 400, 400))]
    certain, _, _ = match_object_areas(shown, twice, frozenset({1, 2, 3, 4}), OPTIONS)
    assert certain == [(0, 0), (1, 1), (2, 2)]


def test_the_scale_between_images_is_the_median_over_whole_objects():
    areas0 = [area(1, (10, 10, 210, 210)), area(2, (10, 10, 310, 310)), area(3, (0, 0, 640, 480), touches=True)]
    areas1 = [area(1, (10, 10, 110, 110)), area(2, (10, 10, 160, 160)), area(3, (0, 0, 20, 20))]
    assert scale_between(areas0, areas1, [(0, 0), (1, 1), (2, 2)]) == pytest.approx(2.0)
    assert scale_between(areas0, areas1, [(2, 2)]) == 1.0
