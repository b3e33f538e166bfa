import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sgam_core import AreaMatcher, Box, CovisibleAreaMatcher, Image, Matches, match_described
from sgam_core.errors import OptionError
from sgam_core.options import CovisibleOptions, CropOptions, SGAMOptions
from tests.two_views import HEIGHT, WIDTH, two_views


def blank(name: str, width: int, height: int, **more) -> Image:
    return Image(name=name, pixels=np.zeros((height, width, 3), np.uint8), **more)


def propose(points0, points1, scores=None, sizes=((400, 300), (400, 300)), **options) -> list[tuple[Box, Box]]:
    matcher = CovisibleAreaMatcher(options=CovisibleOptions(**({"verify": False} | options)))
    d0, d1 = (matcher.describe(blank(name, *size), None) for name, size in zip("ab", sizes, strict=True))
    scores = np.ones(len(points0)) if scores is None else scores
    matches = Matches(points0=np.asarray(points0, float), points1=np.asarray(points1, float), scores=scores)
    return [(m.area0.box, m.area1.box) for m in matcher.match(d0, d1, lambda: matches).confident]


def box(x0, x1, y0, y1) -> Box:
    return Box(x0=x0, y0=y0, x1=x1, y1=y1)


STEPS = np.arange(100.0)
DIAGONAL = np.column_stack([100 + STEPS, 50 + STEPS / 2])  # x 100 to 199, y 50 to 99.5
INNER = np.column_stack([200 + STEPS, 100 + STEPS])


def test_the_box_leaves_out_the_outermost_matches_and_has_a_margin():
    # Of 100 the second from each side: x 101 to 198, y 50.5 to 99; margin 9.7 px of 97, then out to whole pixels.
    ((box0, box1),) = propose(DIAGONAL, INNER)
    assert box0 == box(91, 208, 40, 109)
    assert box1 == box(191, 308, 91, 208)


def test_without_quantile_and_margin_all_matches_are_enclosed():
    ((box0, _),) = propose(DIAGONAL, INNER, quantile=0, margin=0)
    assert box0 == box(100, 199, 50, 100)


def test_matches_weigh_as_their_score():
    strays = np.concatenate([DIAGONAL, [[10.0, 10.0]] * 5])
    others = np.concatenate([INNER, INNER[:5]])
    weak, strong = (np.r_[np.ones(100), np.full(5, score)] for score in (0.01, 1.0))
    assert propose(strays, others, weak, margin=0)[0][0] == box(101, 197, 50, 99)  # 2% of 100.05 is more than 2
    assert propose(strays, others, strong, margin=0)[0][0].x0 == 10
    assert propose(DIAGONAL, INNER, np.zeros(100), margin=0)[0][0] == box(100, 199, 50, 100)


def test_the_box_is_cut_at_the_images_borders():
    ((box0, box1),) = propose(DIAGONAL * 2, INNER, margin=0.5, quantile=0)
    assert box0 == box(101, 400, 1, 298)  # x 200 to 398, y 100 to 199, margin 99
    assert box1 == box(150, 349, 50, 249)  # margin 49.5


def test_too_few_matches_give_none():
    assert propose(DIAGONAL[:19], INNER[:19]) == []
    assert len(propose(DIAGONAL[:20], INNER[:20])) == 1
    assert propose(np.zeros((0, 2)), np.zeros((0, 2)), min_matches=0) == []


def test_matches_all_over_both_images_give_none_since_they_have_been_matched_so():
    corners = np.array([[0, 0], [399, 299]] * 20)
    assert propose(corners, corners) == []
    assert propose(corners, INNER[:40])[0][0] == box(0, 400, 0, 300)


def test_matches_in_one_point_give_a_box_of_one_pixel():
    assert propose(np.full((30, 2), 7.0), np.full((30, 2), 300.0)) == [(box(7, 8, 7, 8), box(300, 301, 299, 300))]


def test_matches_that_contradict_the_pairs_geometry_are_not_enclosed():
    views = two_views(300, noise=0.3, outliers=0.4, seed=1, window=(300, 200, 600, 500))
    matches, sizes = views.matches, ((WIDTH, HEIGHT), (WIDTH, HEIGHT))
    ((_, raw),) = propose(matches.points0, matches.points1, matches.scores, sizes)
    ((box0, box1),) = propose(matches.points0, matches.points1, matches.scores, sizes, verify=True)
    (left, top), (right, bottom) = views.exact1.min(axis=0), views.exact1.max(axis=0)
    true = box(left, right, top, bottom).enlarged(1.2)
    assert box0.area < 1.5 * 300 * 300
    assert box1.area < 1.5 * true.area < raw.area
    assert true.contains(np.array([box1.center]))[0]


def test_a_quantile_that_leaves_nothing_is_refused():
    with pytest.raises(OptionError, match=r"quantile is 0.5; expected a number from 0 to 0.45"):
        CovisibleOptions(quantile=0.5)


def test_the_crop_is_the_box_at_the_size_of_a_whole_image_with_its_mask():
    mask = np.zeros((1000, 2000), bool)
    mask[:, 700:] = True
    crop = CovisibleAreaMatcher().crop(blank("a", 2000, 1000, mask=mask), box(500, 1300, 0, 500), CropOptions())
    assert crop.window == box(500, 1300, 0, 500)
    assert crop.size == (800, 500)
    np.testing.assert_array_equal(crop.mask(), mask[:500, 500:1300])
    options = CropOptions(area_size=100, image_size=400)
    assert CovisibleAreaMatcher().crop(blank("a", 2000, 1000), box(500, 1300, 0, 500), options).size == (400, 250)


class Centre:
    """A point matcher that finds a scene in the middle of both images, and nothing when `found` is 0."""

    def __init__(self, found: int) -> None:
        self.found, self.windows = found, []

    def match(self, pairs):
        self.windows += [(crop0.window, crop1.window) for crop0, crop1 in pairs]
        return [self._match(*pair) for pair in pairs]

    def _match(self, crop0, crop1) -> Matches:
        if not self.found:
            return Matches.empty()
        seen = two_views(self.found, noise=0.3, outliers=0.1, seed=1, window=(300, 200, 600, 500)).matches
        seen = seen.select(crop0.window.contains(seen.points0) & crop1.window.contains(seen.points1))
        points0, points1 = (
            p @ c.crop_from_image[:, :2].T + c.crop_from_image[:, 2]
            for p, c in ((seen.points0, crop0), (seen.points1, crop1))
        )
        return Matches(points0=points0, points1=points1, scores=seen.scores)


def run(found: int):
    matcher, points = CovisibleAreaMatcher(), Centre(found)
    images = blank("a", WIDTH, HEIGHT), blank("b", WIDTH, HEIGHT)
    described = [matcher.describe(image, None) for image in images]
    return match_described(*images, *described, matcher, points, SGAMOptions()), points


def test_the_area_goes_through_all_stages_and_the_matcher_sees_the_box_itself():
    result, points = run(500)
    (area,) = result.areas
    assert (area.state, area.area0.kind, result.fallback) == ("kept", "covisible", "")
    assert points.windows[1:] == [(area.area0.box, area.area1.box)]
    assert (result.matches.area_index == 0).sum() > 400


def test_images_without_matches_fall_back_to_whole_images():
    result, points = run(0)
    assert (result.fallback, result.areas, len(points.windows)) == ("no area match", (), 1)


sizes = st.tuples(st.integers(1, 1500), st.integers(1, 1500))


@settings(deadline=None)
@given(sizes, sizes, st.floats(0, 0.45), st.floats(0, 1), st.integers(0, 60), st.booleans(), st.booleans())
def test_boxes_lie_inside_and_swapping_the_images_swaps_them(size0, size1, quantile, margin, count, verify, border):
    options = CovisibleOptions(min_matches=3, quantile=quantile, margin=margin, verify=verify)
    rng = np.random.default_rng(count)
    points0, points1 = (rng.uniform(0, 1, (count, 2)) * size for size in (size0, size1))
    if border:
        points0, points1 = np.round(points0 / size0) * size0, np.round(points1 / size1) * size1
    matches = Matches(points0=points0, points1=points1, scores=rng.uniform(0, 1, count))
    matcher = CovisibleAreaMatcher(options=options)
    assert isinstance(matcher, AreaMatcher)
    d0, d1 = matcher.describe(blank("b", *size0), None), matcher.describe(blank("a", *size1), None)
    forth, back = matcher.match(d0, d1, lambda: matches), matcher.match(d1, d0, matches.swapped)
    assert forth == matcher.match(d0, d1, lambda: matches)
    assert [(m.area0, m.area1) for m in forth.confident] == [(m.area1, m.area0) for m in back.confident]
    for found in forth.confident:
        for b, (width, height) in ((found.area0.box, size0), (found.area1.box, size1)):
            assert 0 <= b.x0 < b.x1 <= width
            assert 0 <= b.y0 < b.y1 <= height


def test_a_crop_is_finer_than_the_whole_image_where_areas_are():
    image = Image(name="a", pixels=np.zeros((1000, 2000, 3), np.uint8))
    box = Box(x0=0, y0=0, x1=1600, y1=800)
    matcher = CovisibleAreaMatcher()
    for area_size, width in ((640, 1024), (1400, 1400)):
        assert matcher.crop(image, box, CropOptions(area_size=area_size, image_size=1024)).size[0] == width
